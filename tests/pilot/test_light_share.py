"""How many light sub-paths an iteration has, on made-up pilots whose noise is known exactly."""

from mis_integrators.pilot.cost import CAMERA_SHARE
from mis_integrators.pilot.denoiser import LEFT
from mis_integrators.pilot.noise import noise_by_radius
from mis_integrators.pilot.result import PilotSamples, measure
from mis_integrators.pilot.setting import (
    FEWEST_LIGHT_PATHS,
    LIGHT_SHARES,
    PilotSetting,
    light_shares,
    pilot_pixels,
)

import numpy as np
import pytest

RADII = 0.01 * 2.0 ** np.arange(7)
SIZE, ITERATIONS = 64, 16


def setting_of(denoised, shares=LIGHT_SHARES, first_vertex=False, seconds=None):
    return PilotSetting(
        SIZE,
        SIZE * SIZE,
        1.0,
        ("indirect",),
        first_vertex,
        False,
        1,
        None,
        seconds,
        1.0,
        denoised,
        shares,
    )


def choice_of(setting, photons, paths, seed=0):
    """What a pilot chooses that finds noise of camera paths, of variance `paths`; noise of photons,
    of variance `photons` at a middling radius; and blur that is small there, and soon is not."""
    pixels, random = pilot_pixels(setting), np.random.default_rng(seed)
    groups, count = pixels.groups, pixels.count
    shared = np.sqrt(photons) * random.normal(size=(ITERATIONS, 1, 1, count))
    own = np.sqrt(paths) * random.normal(size=(ITERATIONS, 1, groups, count))
    scale = (RADII / RADII[3])[:, None, None]
    gathered = 1 + 0.005 * scale**2 + own + shared / scale
    samples = PilotSamples(
        {"indirect": RADII},
        {"indirect": 0.0},
        {"indirect": gathered},
        np.zeros((ITERATIONS, groups, count)),
        np.zeros(count),
    )
    result = measure(setting, pixels, samples, 1.0)
    return result, result.choose(1000)


def test_of_camera_noise_a_filter_leaves_its_share():
    """Of what is there at every radius, and of nothing else."""
    random = np.random.default_rng(5)
    own = random.normal(size=(ITERATIONS, 1, 1, 4096))
    shared = random.normal(size=(ITERATIONS, 1, 1, 4096)) / (RADII / RADII[3])[:, None, None]
    weights = np.ones(4096)
    all_of_it, left = (
        noise_by_radius(RADII, own + shared, weights, photons_only=False, filter_share=share)
        for share in (1.0, 0.3)
    )
    assert left.floor == pytest.approx(0.3 * all_of_it.floor) and left.floor > 0.25
    np.testing.assert_array_equal(left.photons, all_of_it.photons)


@pytest.mark.parametrize("denoised", [False, True])
@pytest.mark.parametrize("ratio", [0.02, 0.2, 2.0, 20.0])
def test_share_is_that_of_the_least_error_in_the_time(denoised, ratio):
    """(F / share + B) ((1 - s) share + s) is least at share = sqrt(F s / (B (1 - s))), F the noise
    of photons at the radius chosen and B what counts of that of camera paths. The shares are powers
    of two: within one of them, for the radius gives way a little, too."""
    left = LEFT if denoised else 1.0
    result, choice = choice_of(setting_of(denoised), ratio * left, 1.0)
    errors = result.errors["relmse"]["indirect"]
    noise = errors.noise
    at_radius = np.interp(choice.radii["indirect"], RADII, noise.photons)
    best = np.sqrt(at_radius / noise.floor * CAMERA_SHARE / (1 - CAMERA_SHARE))
    best = np.clip(best, LIGHT_SHARES[-1], 1)
    assert abs(np.log2(choice.light_share / best)) <= 1


def test_floor_is_the_noise_of_camera_paths():
    """LEFT B with two groups, where photons' noise is at no radius small; the error of a variance
    of 16 iterations of 4096 pixels is 0.6 %: five of them."""
    random = np.random.default_rng(4)
    shape = ITERATIONS, 1, 2, SIZE * SIZE
    shared = 3 * random.normal(size=(ITERATIONS, 1, 1, SIZE * SIZE)) * np.ones((1, 7, 1, 1))
    samples = 5 + shared + random.normal(size=shape)
    noise = noise_by_radius(RADII, samples, np.ones(SIZE * SIZE), photons_only=False)
    assert noise.floor == pytest.approx(LEFT, rel=0.03)
    assert noise.at()[-1] == pytest.approx(9 + LEFT, rel=0.03)
    assert noise.at(0.5)[-1] == pytest.approx(18 + LEFT, rel=0.03)


def test_noise_of_photons_alone_wants_all_of_them():
    """Gathers at what the camera sees; and wherever the number is given."""
    assert choice_of(setting_of(False, first_vertex=True), 1.0, 0.1)[1].light_share == 1
    assert choice_of(setting_of(False, shares=(1.0,)), 0.01, 1.0)[1].light_share == 1


def test_kept_choices_keep_their_share():
    """A choice is kept unless another is better by the reluctance to render anew."""
    result, choice = choice_of(setting_of(False), 0.2, 1.0)
    near = result._choose(choice.light_share * 2, 1000, None, 0.0)
    assert result.choose(1000, near, reluctance=0.5).light_share == near.light_share
    assert result.choose(1000, near, reluctance=0.0).light_share == choice.light_share
    far = result._choose(LIGHT_SHARES[-1], 1000, None, 0.0)
    assert far.light_share < choice.light_share < near.light_share
    assert result.choose(1000, far, reluctance=0.05).light_share == choice.light_share


def test_an_iteration_fits_into_the_time():
    """Photons make all of the noise, so that all of them would be best; where there is no time for
    all, as many as there is time for. A choice that has taken all of the time is kept."""
    result, _ = choice_of(setting_of(False, first_vertex=True, seconds=1.0), 1.0, 0.0)
    assert result.choose(5.0).light_share == 1
    fits = result.choose(0.8)
    assert fits.light_share < 1 and fits.prediction.iterations >= 1
    assert (
        result.cost(fits) <= 0.8 < result.cost(result._choose(2 * fits.light_share, 0.8, None, 0))
    )
    assert result.choose(0.01).light_share == LIGHT_SHARES[-1]
    late = result._choose(1.0, 0.01, None, 0.0)
    assert result.choose(0.01, late, reluctance=1.0).light_share == 1


def test_few_light_paths_are_not_made_fewer():
    """An iteration of fewer than `FEWEST_LIGHT_PATHS` takes no less time."""
    assert light_shares(100) == light_shares(FEWEST_LIGHT_PATHS) == (1.0,)
    assert light_shares(4 * FEWEST_LIGHT_PATHS) == (1.0, 0.5, 0.25)
    assert light_shares(1280 * 720) == LIGHT_SHARES
