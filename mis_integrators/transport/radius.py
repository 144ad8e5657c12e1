"""The automatic merge radius: noise against blur, both measured in a short pilot.

A kernel of radius R has a bias that grows with R and a variance that falls with it. A few pilot iterations gather at a ladder of
radii at once, on a subset of the pixels. From them, for each radius of the ladder,

- the variance of a pixel over iterations, V(R), and
- the squared difference of the expected images at neighbouring radii, Q(R), without bias: products of different iterations only.

Neighbours differ by a factor 2. Where the bias grows like R^2 (curvature) its square is 1.8 Q; where it sits in a strip of width R
(edges) it is 2 Q: 1.9 Q serves both. The error of n iterations is then 1.9 Q(R) + V(R) / n, and its minimum is the radius. All in
relative terms, pixel by pixel.
"""

from __future__ import annotations

import numpy as np

LADDER_STEPS = 7
STEP = 2.0
LARGEST_SHARE = 0.08
"""Largest radius of the ladder in units of the spread of the points where photons are gathered."""
BIAS_FACTOR = 1.9


def ladder(points, weights):
    """Radii to try (ascending, factor 2), from the gather points (3, n) with their path weights (n,)."""
    used = points[:, weights > 0]
    if used.shape[1] == 0:
        return None
    low, high = np.percentile(used, [2, 98], axis=1)
    spread = np.linalg.norm(high - low) / 3 ** 0.5
    return max(spread, 1e-6) * LARGEST_SHARE * STEP ** -np.arange(LADDER_STEPS - 1, -1, -1.0)


def relative_weights(mean):
    """Weights 1 / (mean^2 + 0.1 <mean>^2) of squared errors: relative error, without letting dark pixels rule. The overall mean <mean>
    leaves out the brightest twentieth (visible lamps)."""
    usual = np.mean(np.minimum(mean, np.quantile(mean, 0.95)))
    return 1 / (mean ** 2 + 0.1 * usual ** 2 + 1e-30)


def noise_of_photons(radii, variance, floor):
    """V(R), no smaller than what the larger radii say: the noise of photons falls with the area of the disk, above a `floor` that is not theirs.
    Small disks seldom meet the rare bright photons that large ones have seen."""
    photons = np.maximum(variance - floor, 0) * radii ** 2
    return floor + np.maximum.accumulate(photons[::-1])[::-1] / radii ** 2


def noise_and_difference(radii, samples, weights, at_first_vertex=True):
    """V and Q of the module's docstring, one a radius, with Q's standard error.

    `samples`: (iterations, radii, pixels) gathered values of independent iterations; `weights`: (pixels,); `at_first_vertex`: whether all
    noise is the photons', because the vertices that gather are those which the camera sees.
    """
    m = samples.shape[0]
    variance = np.mean(weights * samples.var(axis=0, ddof=1), axis=1)
    variance = noise_of_photons(radii, variance, 0.0 if at_first_vertex else variance.min())
    steps = np.diff(samples, axis=1)                                      # (m, radii - 1, pixels)
    pairs = weights * (steps.sum(axis=0) ** 2 - (steps ** 2).sum(axis=0)) / (m * (m - 1))
    difference = np.concatenate([[0.0], pairs.mean(axis=1)])
    # Neighbouring pixels share photons: the error comes from leaving out one iteration at a time.
    total = steps.sum(axis=0)
    left_out = np.stack([np.mean(weights * ((total - s) ** 2 - ((steps ** 2).sum(axis=0) - s ** 2)), axis=1)
                         / ((m - 1) * (m - 2)) for s in steps]) if m > 2 else np.repeat(difference[None, 1:], m, axis=0)
    error = np.concatenate([[0.0], np.sqrt((m - 1) / m * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))])
    return variance, difference, error


def expected_difference(radii, difference, error, wanted):
    """Q at the radii `wanted`, from noisy values at the ladder: the mean over power laws a R^q, each weighted by how well it explains
    the values (flat in q between 1, edges, and 4, curvature, and in the logarithm of a).

    Radii above the second that stands clearly out of its noise are left out: Q saturates, and small radii are what is asked for.
    """
    clear = np.flatnonzero((difference > 3 * error) & (difference > 0))
    used = slice(1, clear[1] + 1 if len(clear) > 1 else len(radii))
    slopes = np.linspace(1, 4, 31)[:, None, None]
    heights = np.geomspace(1e-9, 10, 200)[None, :, None]                  # Q at the largest radius
    law = heights * (radii[used] / radii[-1]) ** slopes
    spread = np.hypot(error[used], 0.15 * law) + 1e-12
    misfit = np.sum(((difference[used] - law) / spread) ** 2 + 2 * np.log(spread), axis=-1)
    weight = np.exp(-0.5 * (misfit - misfit.min()))
    weight /= weight.sum()
    return np.einsum("qh,qhr->r", weight, heights * (wanted / radii[-1]) ** slopes)


def best_radius(radii, samples, mean, iterations, at_first_vertex=True):
    """The radius that minimises the predicted relative error.

    `radii`: the ladder; `samples`, `at_first_vertex`: see `noise_and_difference`; `mean`: (pixels,) mean radiance; `iterations(R)`: how many iterations
    there will be, a function of the radius, so that larger gathers are charged for.
    Returns `(radius, predicted error at it)`.
    """
    variance, difference, error = noise_and_difference(radii, samples, relative_weights(mean), at_first_vertex)
    fine = np.exp(np.linspace(np.log(radii[0]), np.log(radii[-1]), 16 * len(radii)))
    noise = np.exp(np.interp(np.log(fine), np.log(radii), np.log(np.maximum(variance, 1e-30))))
    predicted = BIAS_FACTOR * expected_difference(radii, difference, error, fine) + noise / iterations(fine)
    best = int(np.argmin(predicted))
    return float(fine[best]), float(predicted[best])
