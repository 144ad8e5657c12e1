"""Variance of the mean of numbers that Owen's scrambling ties together, from their own
differences."""

import itertools

from mis_integrators.core import segments
from mis_integrators.core.sequences import SampleSequence
from mis_integrators.core.stratified_variance import (
    GROUP,
    contrasts,
    groups_of_alike,
    variance_by_power,
    variance_law,
    variance_ratio,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

SIZE = 48


# --- What is known without samples --------------------------------------------


@pytest.mark.parametrize("power", [1, 1.5, 2, 3])
def test_law_is_a_sum_of_covariances(power):
    """Against the matrix of all covariances of 64 points, for the first n of them, and for sets
    with holes. In part k of the integrand two points of the same block of 2^k are tied together if
    they are in different halves: one of the 2^(k - 1) points there has the opposite value."""
    number = np.arange(64)
    covariance = 2.0 ** (7 * (1 - power)) * np.eye(64)
    for k in range(1, 8):
        part = 2.0 ** ((k - 1) * (1 - power)) - 2.0 ** (k * (1 - power))
        same_block = number[:, None] >> k == number >> k
        same_half = number[:, None] >> (k - 1) == number >> (k - 1)
        covariance += part * (np.eye(64) - (same_block & ~same_half) / 2 ** (k - 1))
    for below, beyond in (*((n, ()) for n in range(1, 65)), (0, (3,)), (5, (6, 7, 12, 40, 41))):
        which = [*range(below), *beyond]
        expected = covariance[np.ix_(which, which)].sum() / len(which) ** 2
        assert variance_law(power, below, beyond) == pytest.approx(expected, rel=1e-12)
    for m in (1, 2, 8, 64):
        assert variance_law(power, m) == pytest.approx(m**-power, rel=1e-12)


def test_variance_by_power_of_known_laws():
    """Exact for independent numbers, and wherever one knows V within the blocks; beyond, half of
    the power above one is left. What has no noise has none, and where the last contrast is
    the only one or shows nothing, the power is one, as it is beyond what is known to last."""
    lengths = 2.0 ** np.arange(5)
    for count in (1, 3, 32, 33, 1000):
        assert variance_by_power(lengths, 1 / (2 * lengths), count) == pytest.approx(1 / count)
    steep = lengths**-1.5 - (2 * lengths) ** -1.5
    left = variance_by_power(lengths, steep, 32)
    assert left == pytest.approx(steep[-1] * 2**0.125 / (2**1.25 - 1))
    assert variance_by_power(lengths, steep, 4) == pytest.approx(4**-1.5 - 32**-1.5 + left)
    assert variance_by_power(lengths, steep, 512) == pytest.approx(left * 16**-1.25)
    assert variance_by_power(lengths, 0 * lengths, 8) == pytest.approx(0, abs=1e-20)
    assert variance_by_power(lengths, np.array([2.0, 1, 1, 1, 0]), 64) == pytest.approx(0.25)
    assert variance_by_power(lengths, steep, 2048) == pytest.approx(left * 16**-1.25 / 4)
    assert variance_by_power(lengths[:1], np.array([0.5]), 10) == pytest.approx(0.1)


def test_contrasts_are_those_of_complete_blocks():
    """Of seven segments of three iterations, the fourth of which lacks some."""
    means = np.random.default_rng(1).normal(size=(8, 2, 3))
    complete = np.array([1, 1, 1, 0, 1, 1, 1, 0], bool)
    lengths, found, counts = contrasts(means, complete, 3)
    np.testing.assert_array_equal(lengths, [3])
    np.testing.assert_array_equal(counts, [2])
    expected = ((means[0] - means[1]) ** 2 + (means[4] - means[5]) ** 2) / 8
    np.testing.assert_allclose(found, [expected])
    lengths, found, counts = contrasts(means, np.arange(8) != 3, 3)
    np.testing.assert_array_equal(lengths, [3, 6])
    np.testing.assert_array_equal(counts, [3, 1])
    halves = (means[4:6].mean(axis=0) - means[6:].mean(axis=0)) ** 2 / 4
    np.testing.assert_allclose(found[1], halves)
    assert not len(contrasts(means, np.arange(8) % 2 == 0, 3)[0])


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (5, 7), (64, 33), (17, 16)])
def test_groups_are_of_like_pixels(shape):
    """All pixels have one, of `GROUP` pixels at least (as far as there are so many) and less than
    twice as many; in a picture that is no larger than a tile they do not overlap in value."""
    values = np.random.default_rng(2).random(shape)
    groups = groups_of_alike(values)
    count = np.bincount(groups.ravel())
    assert groups.shape == shape and count.min() >= min(GROUP, values.size)
    assert count.max() < 2 * GROUP
    if max(shape) < 24:
        spans = sorted(
            (values[groups == g].min(), values[groups == g].max()) for g in range(len(count))
        )
        assert all(one[1] < other[0] for one, other in itertools.pairwise(spans))


# --- Numbers whose mean is known ----------------------------------------------


def points(count, seed):
    """Scrambled Sobol' points, a sequence a pixel: (count, SIZE^2, 2)."""
    index, group = np.divmod(np.arange(count * SIZE**2), SIZE**2)
    number = group * count + index
    seed, first = dr.opaque(mi.UInt32, seed), dr.opaque(mi.UInt32, 0)
    paths = SampleSequence(seed, first, count, True).of_paths(mi.UInt32(number))
    x, y = paths.at(0).next_floats(2)
    return np.stack([np.array(x), np.array(y)], axis=-1).astype(float).reshape(count, -1, 2)


# Integrands, one a pixel: values at points, and integrals.


def noise(points, random):
    return random.normal(size=points.shape[:2]), 0.0


def smooth(points, random):
    rate = 1 + random.random(points.shape[1])
    x, y = points[..., 0], points[..., 1]
    return np.exp(rate * x) * np.cos(y), np.expm1(rate) / rate * np.sin(1)


def edge(points, random):
    slope = 0.2 + 0.6 * random.random(points.shape[1])
    return (points[..., 1] < slope * points[..., 0]).astype(float), slope / 2


def noisy_edge(points, random):
    values, integral = edge(points, random)
    return values + 0.15 * random.normal(size=values.shape), integral


def estimate(values):
    """Mean of each pixel, its naive variance, and the estimated one, from (iterations, SIZE^2)
    values."""
    n = len(values)
    mean, naive = values.mean(axis=0), values.var(axis=0, ddof=1) / n
    length, complete = segments.complete(n, (), n)
    rest = np.zeros((segments.SEGMENTS * length - n, SIZE**2))
    deviations = np.concatenate([values - mean, rest])
    means = deviations.reshape(segments.SEGMENTS, length, SIZE, SIZE).mean(axis=1)
    ratio = variance_ratio(means, complete, length, naive.reshape(SIZE, SIZE), n)
    return mean, naive, naive * ratio.ravel()


@pytest.mark.parametrize("n", [2, 3, 8, 13, 16, 64, 100, 256])
@pytest.mark.parametrize(
    "integrand, lowest, highest",
    # The law is known for noise alone. A jump across two dimensions (power 1.5) is taken for a
    # mixture of powers 1 and 2, which is too careful; so are two iterations.
    [(noise, 0.85, 1.15), (smooth, 0.75, 1.6), (edge, 0.8, 2.1), (noisy_edge, 0.8, 1.7)],
)
def test_variance_is_that_of_the_mean(rgb, integrand, lowest, highest, n):
    """Over four times 2304 pixels. The mean squared error and the mean estimate have standard
    deviations of 1.5 % (sqrt(2 / 9216)) and 2 %, their ratio one below 3 %. The limits for noise
    are 5 of these away: false alarms 1e-6 a case. Those for the other integrands hold the factor
    that the law adds, and are as far from what was measured (0.9 to 1.9)."""
    error, naive, estimated = (0.0, 0.0, 0.0)
    for seed in range(4):
        values, integral = integrand(points(n, seed), np.random.default_rng((seed, n)))
        mean, its_naive, its_estimate = estimate(values)
        assert np.isfinite(its_estimate).all() and (its_estimate >= 0).all()
        error += np.square(mean - integral).mean()
        naive += its_naive.mean()
        estimated += its_estimate.mean()
    if n > 3:
        assert lowest < estimated / error < highest, estimated / error
    else:  # nothing tells how fast the variance falls: no less than is known
        assert lowest < estimated / error <= naive / error * 1.5
    if integrand is not noise and n >= 16:
        assert naive / error > 2.5  # what it would be for independent iterations


def test_lone_dots_and_darkness():
    """Black pixels, pixels that only one iteration lights, values that are hardly numbers: the
    ratio is finite and not negative; where no contrast is seen, it is one."""
    for n in (2, 3, 7, 8, 9, 17, 100):
        for scale in (1.0, 1e-160, 1e150):
            values = np.zeros((n, SIZE**2))
            values[-1, 5] = values[0, 7] = values[n // 2, 1000] = scale
            with np.errstate(under="ignore"):
                _, naive, estimated = estimate(values)
            assert np.isfinite(estimated).all() and (estimated >= 0).all()
            assert (estimated[naive == 0] == 0).all()
    values = np.zeros((9, SIZE**2))
    values[8] = 1  # an iteration that no complete pair of segments holds
    _, naive, estimated = estimate(values)
    np.testing.assert_array_equal(estimated, naive)


def test_ratio_without_complete_blocks_is_one():
    means = np.random.default_rng(3).normal(size=(8, 20, 20))
    ratio = variance_ratio(means, np.arange(8) % 2 == 1, 1, np.ones((20, 20)), 0, (1, 3, 5, 7))
    np.testing.assert_array_equal(ratio, 1)
