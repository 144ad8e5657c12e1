"""The statistics that the other tests lean on: quantiles, false-alarm rate, and power shown by
injected errors."""

from mis_integrators.analysis.confidence import t_quantile, t_two_sided

import numpy as np
import pytest
from comparing import (
    BLOCK,
    WHOLE,
    Estimate,
    assert_frequencies,
    assert_powerful,
    block_means,
    chi2_tail,
    differences,
    extrapolate,
    smallest_visible,
)


def batches(rng, count, noise, blocks=9, channels=3):
    """Batches of normal region means around 1, the whole image being the mean of its blocks."""
    tiles = 1 + noise * rng.standard_normal((count, blocks, channels))
    return np.concatenate([tiles.mean(axis=1, keepdims=True), tiles], axis=1)


@pytest.mark.parametrize(
    "freedom, t, tail", [(1, 1.0, 0.5), (10, 2.228, 0.05), (30, 3.646, 0.001), (1e6, 4.8916, 1e-6)]
)
def test_student_t(freedom, t, tail):
    assert t_two_sided(t, freedom) == pytest.approx(tail, rel=2e-3)
    assert t_quantile(tail, freedom) == pytest.approx(t, rel=1e-3)


@pytest.mark.parametrize(
    "freedom, x, tail", [(10, 18.307, 0.05), (100, 149.45, 0.001), (5, 35.89, 1e-6)]
)
def test_chi_square_tail(freedom, x, tail):
    assert np.log(chi2_tail(x, freedom)) == pytest.approx(np.log(tail), rel=0.03)


def test_false_alarm_rate():
    """At 5 % a comparison, 400 comparisons of equal things give 20 +- 4 alarms: fewer than 40 with
    probability 1 - 3e-5; the whole image repeats what its blocks say, and grey what the channels
    say, so there are rather fewer than 20."""
    rng = np.random.default_rng(1)
    alarms = sum(
        bool(
            differences(
                Estimate.of(batches(rng, 16, 0.1)), Estimate.of(batches(rng, 24, 0.03)), 0.05
            )
        )
        for _ in range(400)
    )
    assert 2 <= alarms < 40


@pytest.mark.parametrize("where, size", [("whole", WHOLE), ("block", BLOCK)])
def test_power(where, size):
    """An error of 1 % of the whole or 3 % of a block is seen in at least 95 of 100 cases, once
    `assert_powerful` is content."""
    rng = np.random.default_rng(2)
    factor = np.ones(10) if where == "block" else np.full(10, 1 + size)
    if where == "block":
        factor[4] += size
    seen = 0
    for _ in range(200):
        noise, count = 0.02, 16
        while True:
            a, b = Estimate.of(batches(rng, count, noise)), Estimate.of(batches(rng, count, noise))
            visible = smallest_visible(a, b)
            if visible[0] <= WHOLE and visible[1:].max() <= BLOCK:
                break
            count += 8
        assert_powerful(a, b)
        seen += bool(differences(a * factor, b))
    assert seen >= 184, seen  # 190 expected at the limit; below 184 with probability 0.02


def test_weak_comparison_is_refused():
    rng = np.random.default_rng(3)
    a, b = (Estimate.of(batches(rng, 8, 0.1)) for _ in range(2))
    with pytest.raises(AssertionError, match="too weak"):
        assert_powerful(a, b)


def test_block_means():
    image = np.arange(36.0).reshape(6, 6, 1)
    means = block_means(image, 3)
    assert means.shape == (10, 1)
    assert (
        means[0] == image.mean()
        and means[1] == image[:2, :2].mean()
        and means[6] == image[2:4, 4:].mean()
    )


def test_extrapolation_to_radius_zero():
    rng = np.random.default_rng(4)
    radii = (0.4, 0.2, 0.1)
    estimates = [Estimate.of(batches(rng, 400, 0.05) * (2 - 0.7 * r * r)) for r in radii]
    at_zero = extrapolate(radii, estimates)
    assert not differences(at_zero, Estimate.exact(np.full((10, 3), 2.0)))
    assert differences(estimates[0], Estimate.exact(np.full((10, 3), 2.0)))


def test_frequencies():
    rng = np.random.default_rng(5)
    expected = np.linspace(5, 200, 40)
    assert_frequencies(rng.poisson(expected), expected)
    with pytest.raises(AssertionError, match="chi-square"):
        assert_frequencies(rng.poisson(expected * np.where(np.arange(40) % 2, 1.3, 0.7)), expected)
