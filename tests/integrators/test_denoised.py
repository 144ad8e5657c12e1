"""Renders that will be denoised: the parameter `denoised`."""

from pathlib import Path

import mis_integrators  # noqa: F401 (registers the plugins)
from mis_integrators.pilot.denoiser import GROUPS, LEFT

import mitsuba as mi
import numpy as np
import pytest
from comparing import in_one_thread

SCENE = Path(__file__).parents[2] / "scenes" / "cornell_glossy.xml"
SIZE, BLOCK, RENDERS = 48, 6, 24


@pytest.fixture
def scene(rgb):
    return mi.load_file(str(SCENE), resx=str(SIZE), resy=str(SIZE))


@in_one_thread
def renders(scene, spp=4, **parameters):
    """Images of as many seeds, mean over the channels: (renders, height, width)."""
    integrator = mi.load_dict({"max_depth": 6, **parameters})
    images = [
        np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3].mean(axis=2)
        for seed in range(RENDERS)
    ]
    return np.array(images, dtype=np.float64)


def blocks(images):
    """Means of square blocks: (renders, blocks)."""
    cells = SIZE // BLOCK
    return images.reshape(-1, cells, BLOCK, cells, BLOCK).mean(axis=(2, 4)).reshape(-1, cells**2)


def relative_variance(values):
    """Median over the places: lamps and their edges have no say."""
    return np.median(values.var(axis=0, ddof=1) / values.mean(axis=0) ** 2)


OPT2 = {"type": "bdpm_opt2", "mix_diffuse": True, "direct_paths": 16}


@pytest.mark.extended
def test_means_stay(scene):
    """Of 64 blocks, by weights for a denoiser and by others, with a radius that blurs little (5.3
    standard errors of t with 46 degrees: 3e-6 a block, 2e-4 in all; 10 % are seen)."""
    a, b = (blocks(renders(scene, **OPT2, initial_radius=0.03, denoised=d)) for d in (False, True))
    error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / RENDERS)
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) / error).max() < 5.3
    assert np.median(5.3 * error / a.mean(axis=0)) < 0.1, "test too weak"


@pytest.mark.extended
def test_noise_moves_from_near_pixels_together_to_each_apart(scene):
    """With disks of five pixels, weights for a denoiser leave less noise in blocks of 36 pixels,
    and more in pixels alone. (The seeds are fixed; the ratios are about 0.7 and 2.5.)"""
    before, after = (renders(scene, **OPT2, initial_radius=0.2, denoised=d) for d in (False, True))
    assert relative_variance(blocks(after)) < 0.85 * relative_variance(blocks(before))
    assert relative_variance(after) > 1.2 * relative_variance(before)


@pytest.mark.long
def test_what_is_chosen_knows_of_the_denoiser(scene):
    """Two groups of paths in the pilot; a predicted error that is less, as it is that which a
    denoiser leaves; fewer paths for direct light, whose noise it takes away; and optimal weights
    go on beyond diffuse vertices."""
    found = {}
    for flag in (False, True):
        session = mi.load_dict({"type": "bdpm_opt2", "denoised": flag}).session(scene, spp=16)
        assert session.integrator.mix_diffuse is flag
        session.iterate()
        assert session.prediction.pixels.groups == (GROUPS if flag else 1)
        found[flag] = session
    raw, denoised = found[False], found[True]
    for measure, error in raw.prediction.errors.items():
        left = denoised.prediction.errors[measure]
        assert left.after(16) < 0.8 * error.after(16), measure
    assert denoised.direct_light.mean_paths < raw.direct_light.mean_paths
    assert denoised.settings["denoised"] is True


def test_of_the_noise_of_path_a_denoiser_leaves_its_share(scene):
    """As of the noise of camera paths under photons. Both are judged by the same samples, and by
    means of pixels that differ a little. (The noise of sequences hangs on how many samples there is
    time for.)"""
    variances = []
    for flag in (False, True):
        session = mi.load_dict(
            {"type": "bdpm_auto", "denoised": flag, "sampler": "independent"}
        ).session(scene, spp=16)
        session.iterate()
        trials = {trial.plugin: trial for trial in session.decision.trials}
        assert set(trials) == {"path", "bdpm"}
        variances.append([trials["path"].parts[measure][1] for measure in ("relmse", "mse")])
    np.testing.assert_allclose(np.divide(*variances[::-1]), LEFT, rtol=0.3)
    assert session.decision.session.integrator.denoised
    assert session.image()[..., session.channels.index("direct_light.R")].any()


def test_path_is_no_candidate_where_layers_split_the_light(scene):
    auto = mi.load_dict({"type": "bdpm_auto", "denoised": True, "aovs": "c:caustic"})
    session = auto.session(scene, spp=16)
    session.start()
    assert session.decision.plugin == "bdpm"
    assert "not path: it does not split the light" in session.decision.reasons
