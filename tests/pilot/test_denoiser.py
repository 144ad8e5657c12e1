"""Noise that a denoiser leaves."""

from mis_integrators.pilot import radius
from mis_integrators.pilot.denoiser import LEFT, variance_left
from mis_integrators.pilot.noise import direct_variance, noise_by_radius

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

RADII = 0.01 * 2.0 ** np.arange(7)
PIXELS, ITERATIONS = 4096, 8


@hypothesis.given(
    st.floats(0, 10), st.floats(0, 10), st.integers(0, 2**32 - 1), st.sampled_from([1, 2])
)
@hypothesis.settings(max_examples=30)
def test_shared_and_own_noise(shared, own, seed, groups):
    """F + LEFT B with two groups of paths, all noise with one; within 5.3 standard errors over
    4096 pixels (1e-7 an example)."""
    random = np.random.default_rng(seed)
    of_photons = np.sqrt(shared) * random.normal(size=(ITERATIONS, 3, 1, PIXELS))
    samples = 7 + of_photons + np.sqrt(own) * random.normal(size=(ITERATIONS, 3, groups, PIXELS))
    expected = shared + own * (LEFT if groups == 2 else 1)
    found = variance_left(samples)
    assert found.shape == (3, PIXELS)
    error = 2 * (shared + own) / np.sqrt((ITERATIONS - 1) * PIXELS) + 1e-12
    assert np.abs(found.mean(axis=1) - expected).max() < 5.3 * error


def samples_of(seed, groups):
    """A pilot whose photon noise falls as 1 / R^2, whose camera paths add much noise that no radius
    lessens and that a denoiser takes away, and whose blur grows as R^2."""
    random = np.random.default_rng(seed)
    shape = ITERATIONS, len(RADII), groups, PIXELS
    scale = (RADII / RADII[3])[:, None, None]
    photons = random.normal(size=(ITERATIONS, 1, 1, PIXELS)) * (0.05 / scale)
    paths = random.normal(size=shape) * (3.0 / scale)
    return 1 + 0.05 * scale**2 + photons + paths


@pytest.mark.parametrize("seed", range(3))
def test_radius_for_a_denoiser(seed):
    """Noise that the denoiser takes away no longer calls for large disks: the radius is that of the
    least bias^2 + (F + LEFT B) / n, within a factor of 1.5, and smaller than that of all noise."""
    n = 16.0
    fine = np.exp(np.linspace(np.log(RADII[0]), np.log(RADII[-1]), 500))
    scale = fine / RADII[3]
    chosen = {}
    for groups, left in ((1, 1.0), (2, LEFT)):
        errors = radius.error_by_radius(RADII, samples_of(seed, groups), np.ones(PIXELS))
        chosen[groups] = radius.best_radius([errors], lambda _: n)
        true = (0.05 * scale**2) ** 2 + (0.05**2 + left * 9) / scale**2 / n
        best = fine[np.argmin(true)]
        assert best / 1.5 < chosen[groups] < 1.5 * best, (chosen, best)
    assert chosen[2] < 0.8 * chosen[1]


FEW = 3
"""The fewest iterations of a pilot."""


@pytest.mark.parametrize("shared", [0.0, 0.3])
@pytest.mark.parametrize("deeper", [0.0, 0.3])
def test_few_iterations_tell_the_noise(shared, deeper):
    """What near pixels share, by the areas of disks (`shared`) or whatever their size (`deeper`),
    beside what camera paths make, of which a tenth is there at every radius. All radii together
    tell it: in units of the noise before the denoiser, with standard errors below 0.6 % (1.1 % at
    the largest radius), of which five are allowed. Where nothing is shared none of 200 pilots is
    off by more than 0.7 % (2.4 %). Taken radius by radius, the error at large ones would count a
    thousand times at small ones."""
    area, random = (RADII / RADII[-1]) ** 2, np.random.default_rng(11)
    own, by_disk = 0.1 + 0.9 / area, shared / area
    drawn = 5 + np.sqrt(deeper) * random.normal(size=(FEW, 1, 1, PIXELS))
    drawn = drawn + np.sqrt(own)[:, None, None] * random.normal(size=(FEW, len(RADII), 2, PIXELS))
    drawn += np.sqrt(by_disk)[:, None, None] * random.normal(size=(FEW, len(RADII), 1, PIXELS))
    found = noise_by_radius(RADII, drawn, np.ones(PIXELS), photons_only=False).at()
    allowed = np.full(len(RADII), 0.03 if shared or deeper else 0.01)
    allowed[-1] = 0.055 if shared or deeper else 0.03
    apart = np.abs(found - (LEFT * own + by_disk + deeper)) / (own + by_disk + deeper)
    assert np.all(apart < allowed), apart


def test_noise_of_camera_paths_alone_is_not_shared():
    """`LEFT` of it, within 5.3 standard errors of 4096 pixels, of which 0.1 % are left out."""
    samples = 2 + np.random.default_rng(3).normal(size=(FEW, 2, PIXELS))
    error = np.sqrt(2 / ((FEW - 1) * PIXELS))
    found = direct_variance(samples, np.ones(PIXELS)) / LEFT
    assert found == pytest.approx(1, abs=5.3 * error + 0.01)
