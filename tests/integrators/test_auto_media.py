"""The plugin `bdpm_auto` in participating media: what it rests its choice on, the choice for each
kind of scene, and the image that follows.

Comparisons of renders: false-alarm rate 1e-6 each; an error of 2 % of the whole image and of 6 % of
a quarter is seen with a probability of 0.95 (`comparing`).
"""

import json
from pathlib import Path

from mis_integrators.core.film import direct_channels

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from foggy import agree_with_volpath, batch, grid, orbit, pockets, world
from selection import extended
from test_bdpt_media import FOG, ball, fog_scene, homogeneous
from worlds import look

BUNDLED = Path(__file__).parents[2] / "scenes" / "media"


def auto(**parameters):
    return mi.load_dict({"type": "bdpm_auto", "max_depth": 6, **parameters})


def plain():
    """Fog above a floor, under a lamp that camera paths find."""
    return fog_scene(homogeneous(0.3))


def caustic():
    """A ball of glass in fog, under a lamp that camera paths cannot meet."""
    glass = ball({"type": "dielectric"}, exterior=FOG)
    spot = {"type": "spot", "to_world": look((1, 2.5, 1), (0, 0, 0)), "intensity": 30.0}
    return fog_scene(homogeneous(0.3), lamp=None, spot=spot, glass=glass)


def decided(scene, spp=8, seconds=None, **parameters):
    """A session after its first iteration."""
    session = auto(**parameters).session(scene, seed=3, spp=spp)
    if seconds:
        session.plan_time(seconds)
    session.iterate()
    return session


def set_price_of_photons(monkeypatch, paths, enough=0.0):
    """Lets an iteration of photons cost as much as so many camera paths, and so many photons be
    enough."""
    from mis_integrators.integrators import media_choice  # of the active variant

    monkeypatch.setattr(media_choice, "PATHS_AN_ITERATION", paths)
    monkeypatch.setattr(media_choice, "ENOUGH", enough)


def reasons(session):
    return " ".join(v for k, v in session.settings.items() if k.startswith("choice.because"))


# --- What the choice rests on ---------------------------------------------------------------------


def test_trial_is_what_an_iteration_renders(rgb):
    """All camera paths of an iteration, as the trial traces them, sum to that iteration's image:
    the same random numbers."""
    scene = world(orbit(1)[0], grid(pockets, scale=3.0))
    multiview = mi.load_dict({"type": "volpath_multiview", "max_depth": 6, "camera_paths": 1})
    session = multiview.session(scene, seed=3)
    radiance = np.array(session.radiance(0, dr.arange(mi.UInt32, session.views.paths)))
    session.iterate(0)
    assert radiance.mean() == pytest.approx(session.image()[:, :, :3].mean(), rel=1e-3)


# --- The choice -----------------------------------------------------------------------------------


def test_caustics_that_camera_paths_cannot_see(rgb, monkeypatch):
    """However dear photons were, and however few."""
    set_price_of_photons(monkeypatch, 1e4, enough=1e4)
    session = decided(caustic())
    assert session.settings["choice"] == "bdpm" and session.settings["bdd"] == 0
    assert "not volpath_multiview: it cannot see the caustics" in reasons(session)


@pytest.mark.parametrize("name, chosen", [("fog_caustic", "bdpm"), *extended(("fog_spot", "bdpm"))])
def test_bundled_scenes(rgb, name, chosen):
    """By the settings that users have."""
    scene = mi.load_file(str(BUNDLED / f"{name}.xml"), resx=32, resy=32)
    assert decided(scene, max_depth=16).settings["choice"] == chosen


def test_few_photons_tell_nothing(rgb, monkeypatch):
    """However cheap they were: the pilot does not even run. By the settings that users have, too
    few are left where most light sub-paths miss the fog."""
    set_price_of_photons(monkeypatch, 1e-4, enough=0.3)
    session = decided(plain())
    assert session.settings["choice"] == "volpath_multiview"
    assert "too few to try them" in reasons(session)
    assert "choice.relmse.bdpm" not in session.settings


@pytest.mark.long
def test_the_cheaper_wins(rgb, monkeypatch):
    """The same scene, the same pilot: what is chosen follows the cost."""
    found = {}
    for price in (1e-4, 1e4):
        set_price_of_photons(monkeypatch, price)
        found[price] = decided(plain()).settings
    cheap, dear = found[1e-4], found[1e4]
    assert cheap["choice"] == "bdpm" and dear["choice"] == "volpath_multiview"
    assert cheap["choice.relmse.bdpm"] < cheap["choice.relmse.volpath_multiview"]
    assert dear["choice.relmse.bdpm"] > dear["choice.relmse.volpath_multiview"]


def test_prediction_is_checked(rgb, monkeypatch):
    """The error that is predicted for camera paths is what renders have: within a factor of two,
    the pilot's pixels being few."""
    set_price_of_photons(monkeypatch, 1.0)
    session = decided(plain(), spp=16)
    predicted = session.settings["choice.mse.volpath_multiview"]
    multiview = mi.load_dict({"type": "volpath_multiview", "max_depth": 6, "camera_paths": 16})
    images = []
    for seed in range(12):
        one = multiview.session(session.scene, seed=seed)
        one.iterate()
        images.append(one.image()[:, :, :3].mean(axis=-1))
    mean, noise = np.mean(images, axis=0), np.sort(np.var(images, axis=0, ddof=1).ravel())
    usual = np.mean(np.minimum(mean, np.quantile(mean, 0.9)))
    assert 0.5 < predicted / (noise[: int(0.999 * noise.size)].mean() / usual**2) < 2


@pytest.mark.parametrize(
    "scene, parameters, why",
    [
        (lambda: world(batch(orbit(3)), homogeneous()), {}, "several views"),
        (plain, {"max_depth": 1}, "needs no photons"),
        (lambda: fog_scene(grid(pockets, scale=3.0)), {}, "media of grids"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_photons_are_not_for(rgb, scene, parameters, why):
    session = decided(scene(), **parameters)
    assert session.settings["choice"] == "volpath_multiview" and why in reasons(session)
    assert np.isfinite(session.image()).all()


# --- The image ------------------------------------------------------------------------------------


@pytest.mark.parametrize("chosen", ["bdpm", "volpath_multiview"])
def test_image_is_that_of_the_integrator_chosen(rgb, monkeypatch, chosen):
    """With its channels; and the same seed makes the same choice."""
    set_price_of_photons(monkeypatch, 1e-4 if chosen == "bdpm" else 1e4)
    scene = plain()
    session = decided(scene, spp=3, variance=True)
    for _ in range(2):
        session.iterate()
    assert session.settings["choice"] == chosen and session.iterations_planned == 3
    own = {"bdd": 0} if chosen == "bdpm" else {"camera_paths": 1}
    alone = mi.load_dict({"type": chosen, "max_depth": 6, "variance": True, **own})
    alone = alone.session(scene, seed=3, spp=3)
    for _ in range(3):
        alone.iterate()
    assert np.allclose(session.image(), alone.image(), rtol=1e-3, atol=1e-5)
    assert session.channels == alone.channels and "var.R" in session.channels
    again = decided(scene, spp=3, variance=True)
    assert again.learned["plugin"] == session.learned["plugin"]
    # Threads add in any order.
    assert again.learned["errors"] == pytest.approx(session.learned["errors"], rel=1e-4)


@pytest.mark.parametrize("chosen", ["bdpm", "volpath_multiview"])
def test_what_was_decided_can_be_recalled(rgb, monkeypatch, chosen):
    """Another session of the same render goes on with the same integrator, without a pilot; sums
    and shapes are those of the integrator chosen."""
    set_price_of_photons(monkeypatch, 1e-4 if chosen == "bdpm" else 1e4)
    scene = plain()
    first, second = (auto().session(scene, seed=3) for _ in range(2))
    for session in (first, second):
        session.keep_variance()
        session.plan_time(1000.0)
    first.iterate()
    second.recall(json.loads(json.dumps(first.learned)))
    assert second.settings == first.settings and second.decision.trials == []
    assert second.camera_paths == first.camera_paths
    shapes = {name: tensor.shape for name, tensor in first.sums.tensors.items()}
    assert {name: tuple(shape) for name, shape in shapes.items()} == second.sum_shapes()
    for session in (first, second):
        while session.iterations < 2:
            session.iterate()
    assert np.allclose(first.image(), second.image(), rtol=1e-3, atol=1e-5)
    assert np.allclose(first.estimate()[1], second.estimate()[1], rtol=1e-2, atol=1e-6)


def test_means(rgb, monkeypatch):
    """Of camera paths, whose mean is that of `volpath` without any blur."""
    set_price_of_photons(monkeypatch, 1e4)
    agree_with_volpath(auto(camera_paths=16), plain())


def test_trial_on_some_of_the_pixels(rgb, monkeypatch):
    """Camera paths are tried on the pixels of the pilot, and render all of a larger film."""
    set_price_of_photons(monkeypatch, 1e4)
    scene = plain()
    film = mi.traverse(scene)
    film["sensor.film.size"] = [72, 71]
    film.update()
    session = decided(scene, spp=1)
    assert session.settings["choice"] == "volpath_multiview"
    own = mi.load_dict({"type": "volpath_multiview", "max_depth": 6, "camera_paths": 1})
    own = own.session(scene, seed=3, spp=1)
    own.iterate()
    np.testing.assert_allclose(session.image(), own.image(), rtol=1e-4, atol=1e-5)
    assert own.image().shape[:2] == (71, 72) and own.image().mean() > 0


@pytest.mark.parametrize("chosen", ["bdpm", "volpath_multiview"])
def test_denoised(rgb, monkeypatch, chosen):
    """Photons keep direct light apart for the denoiser, camera paths have nothing to keep apart;
    the channels are those that the integrator names."""
    set_price_of_photons(monkeypatch, 1e-6 if chosen == "bdpm" else 1e4)
    session = decided(plain(), denoised=True)
    assert session.settings["choice"] == chosen
    named = session.integrator.aov_names()
    assert "direct_light.R" in named and session.channels[-len(named) :] == named
    image = session.image()
    assert image.shape[2] == len(session.channels)
    direct = image[..., [session.channels.index(name) for name in direct_channels()]]
    assert direct.any() == (chosen == "bdpm")
