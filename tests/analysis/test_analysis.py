"""Measures of `mis_integrators.analysis` on synthetic images with known answers.

Tolerances of random figures are five standard errors of the figure itself (false alarms: 6e-7
each); coverages are binomial, judged at four standard deviations (6e-5 each). All seeds are fixed.
"""

import math

from mis_integrators.analysis.confidence import (
    Interval,
    log_ratio_error,
    log_slope,
    mean_interval,
    ratio_interval,
    slope_interval,
)
from mis_integrators.analysis.metrics import (
    RELATIVE_OFFSET,
    References,
    artefact_share,
    decompose,
    efficiency,
    errors,
    flip,
    median_of_means,
    squared_errors,
    trimmed_mean,
)

import numpy as np
import pytest

SHAPE = (96, 112, 3)
OFFSET, NOISE, REFERENCE_NOISE = 0.2, 0.5, 0.4


def truth():
    y, x, c = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1], 0:3]
    return 1.5 + np.sin(x / 17) * np.cos(y / 11) + 0.2 * c


def noisy(image, sigma, seed):
    return image + np.random.default_rng(seed).normal(0, sigma, image.shape)


def references(noise=REFERENCE_NOISE):
    return References(
        noisy(truth(), noise, 1), noisy(truth(), noise, 2), "synthetic", noisy=noise > 0
    )


def render(seed, offset=OFFSET):
    return noisy(truth() + offset, NOISE, 100 + seed)


def exact_divisor():
    return truth() ** 2 + RELATIVE_OFFSET


# --- Metrics ------------------------------------------------------------------


def test_squared_error_is_free_of_the_references_noise():
    products = squared_errors(render(0), references())
    allowed = 5 * products.std() / math.sqrt(products.size)
    found = errors(render(0), references())
    assert found.mse == pytest.approx(products.mean())
    assert abs(found.mse - (OFFSET**2 + NOISE**2)) < allowed
    # else the noise of the references, left in, would pass
    assert allowed < 0.2 * REFERENCE_NOISE**2


def test_relative_squared_error():
    expected = ((OFFSET**2 + NOISE**2) / exact_divisor()).mean()
    assert errors(render(0), references(0)).relmse == pytest.approx(expected, rel=0.03)
    assert errors(render(0), references()).relmse == pytest.approx(expected, rel=0.1)


def test_error_of_a_perfect_image_is_none_however_noisy_the_references():
    products = squared_errors(truth(), references())
    assert abs(errors(truth(), references()).mse) < 5 * products.std() / math.sqrt(products.size)


def test_absolute_percentage_error_and_mean():
    found = errors(truth() * 1.1 + 0.01, references(0))
    assert found.mape == pytest.approx(np.mean((0.1 * truth() + 0.01) / (truth() + 0.1)))
    assert found.mean_ratio == pytest.approx((1.1 * truth().mean() + 0.01) / truth().mean())


def test_robust_errors_forget_outliers():
    image = render(0)
    spoiled = image.copy()
    spoiled[::40, ::50] = 1e4  # 9 of 10752 pixels: fewer than one in a thousand
    clean, found = errors(image, references()), errors(spoiled, references())
    assert found.mse > 100 * clean.mse
    for name in ("mse_trimmed", "relmse_trimmed"):
        assert getattr(found, name) == pytest.approx(getattr(clean, name), rel=0.05)
    spoiled = image.copy()
    spoiled[[5, 50, 70], [7, 70, 20]] = 1e4
    assert errors(spoiled, references()).relmse_median == pytest.approx(
        clean.relmse_median, rel=0.1
    )


def test_trimming_does_not_favour_either_sign():
    """A perfect image has no error, trimmed or not, however noisy the references are."""
    products = squared_errors(truth(), references()).mean(axis=-1)
    assert abs(errors(truth(), references()).mse_trimmed) < 5 * products.std() / math.sqrt(
        products.size
    )


def test_robust_means_of_known_values():
    assert trimmed_mean(np.arange(1000.0)) == pytest.approx(np.arange(999).mean())
    assert trimmed_mean(np.arange(10.0), 0.25) == pytest.approx(3.0)
    assert trimmed_mean(np.array([1.0, 2.0, -50.0, 3.0]), 0.25) == pytest.approx(2.0)
    assert median_of_means(np.full(100, 3.0)) == 3.0
    many = np.random.default_rng(5).normal(2.0, 1.0, 30000)
    assert median_of_means(many) == pytest.approx(2.0, abs=5 * 1.2533 / math.sqrt(30000))


def test_bias_and_variance_apart():
    found = decompose([render(seed) for seed in range(4)], references(0.1))
    bias2, variance = ((value / exact_divisor()).mean() for value in (OFFSET**2, NOISE**2))
    assert found.bias2 == pytest.approx(bias2, rel=0.15)
    assert found.variance == pytest.approx(variance, rel=0.05)
    assert found.bias_share == pytest.approx(OFFSET**2 / (OFFSET**2 + NOISE**2), rel=0.15)
    unbiased = decompose([render(seed, offset=0) for seed in range(4)], references(0.1))
    assert abs(unbiased.bias_share) < 0.03


def test_bias_and_variance_add_up_to_the_error():
    images = [render(seed) for seed in range(3)]
    assert decompose(images, references()).total == pytest.approx(
        np.mean([errors(image, references()).relmse for image in images])
    )
    assert decompose(images[:1], references()) is None


def test_efficiency():
    assert efficiency(0.25, 8.0) == 0.5
    assert efficiency(0.0, 8.0) == math.inf


def test_flip():
    pytest.importorskip("flip_evaluator")
    exact = references(0)
    same, same_map = flip(truth(), exact)
    little, little_map = flip(truth() * 1.05, exact)
    much, _ = flip(truth() * 1.5, exact)
    assert same == pytest.approx(0, abs=1e-6) and same_map.shape == SHAPE[:2]
    assert 0.005 < little < much < 1
    assert little == pytest.approx(little_map.mean(), rel=1e-4)


# --- Confidence ---------------------------------------------------------------


def covered(trials, make, true):
    """Share of `trials` intervals that hold the true value."""
    return np.mean(
        [
            low <= true <= high
            for _, low, high in (make(np.random.default_rng(trial)) for trial in range(trials))
        ]
    )


def assert_coverage(share, trials, level=0.95):
    assert abs(share - level) < 4 * math.sqrt(level * (1 - level) / trials)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_coverage_of_means(count):
    assert_coverage(covered(3000, lambda rng: mean_interval(rng.normal(3, 2, count)), 3), 3000)


@pytest.mark.parametrize("level", [0.8, 0.99])
def test_coverage_at_another_level(level):
    assert_coverage(
        covered(3000, lambda rng: mean_interval(rng.normal(3, 2, 4), level), 3), 3000, level
    )


def test_coverage_of_ratios_of_pairs():
    """A machine's drift, common to both of a pair, cancels; the interval is narrower than that of
    unpaired figures."""

    def pair(rng):
        drift = rng.normal(1, 0.2, 5)
        return drift * rng.normal(2, 0.1, 5), drift * rng.normal(1, 0.05, 5)

    assert_coverage(covered(3000, lambda rng: ratio_interval(*pair(rng)), 2), 3000)
    values, base = pair(np.random.default_rng(1))
    assert log_ratio_error(values, base) < 0.7 * log_ratio_error(values, np.roll(base, 1))


def test_coverage_of_slopes():
    times = 2.0 ** np.arange(5)

    def run(rng):
        return times, times**-0.8 * np.exp(rng.normal(0, 0.1, 5))

    assert_coverage(
        covered(2000, lambda rng: slope_interval([run(rng) for _ in range(3)]), -0.8), 2000
    )


def test_coverage_of_the_error_of_renders():
    """The whole way: renders against noisy references that change, too, errors with their interval
    over seeds."""
    flat = np.ones((12, 12, 3))

    def interval(rng):
        r = References(
            flat + rng.normal(0, 0.1, flat.shape), flat + rng.normal(0, 0.1, flat.shape), "", False
        )
        return mean_interval(
            [errors(flat + OFFSET + rng.normal(0, NOISE, flat.shape), r).mse for _ in range(3)]
        )

    assert_coverage(covered(1000, interval, OFFSET**2 + NOISE**2), 1000)


def test_slope_of_a_power_law():
    times = np.array([1, 2, 4, 8.0])
    assert log_slope(times, 3 / times) == pytest.approx(-1)
    assert log_slope(times, [1, 0.5, -1, 0.125]) == pytest.approx(-1)
    assert math.isnan(log_slope(times, [1, 0.5, -1, 0]))
    assert math.isnan(slope_interval([(times, -times)]).value)


def test_too_few_renders_have_no_interval():
    assert math.isnan(mean_interval([1.0]).low) and math.isnan(ratio_interval([2.0], [1.0]).low)
    assert ratio_interval([2.0], [1.0]).value == 2
    assert (
        str(Interval(2.0, math.nan, math.nan)) == "2"
        and str(Interval(2.0, 1.0, 4.0)) == "2 (1 to 4)"
    )


# --- Artefacts ------------------------------------------------------------------------------------


def test_artefacts_are_what_stands_out_from_the_others_noise():
    """A normal error is above ten times the median of squared ones, 4.55 variances, for 3.3 % of
    the pixels; ten dots of 40 standard deviations, on top of an image that is less noisy than the
    other, are found, and nothing else. (Noise of 0.1 would have to be 21 of its standard
    deviations.)"""
    rng, dark = np.random.default_rng(5), np.zeros((128, 160, 3))
    references = References(dark, dark, "here", noisy=False)
    other = rng.normal(0, 1, dark.shape[:2])[..., None] * np.ones(3)
    own = artefact_share(other, other, references)
    # Five standard deviations of the share, and as much for medians of 256 pixels.
    assert own == pytest.approx(0.0329, abs=10 * (0.0329 / dark[..., 0].size) ** 0.5)
    image = rng.normal(0, 0.1, dark.shape[:2])[..., None] * np.ones(3)
    assert artefact_share(image, other, references) == 0
    image[::16, 5][:8] += 40
    image[3, 7:9] -= 40
    assert artefact_share(image, other, references) == 10 / dark[..., 0].size
