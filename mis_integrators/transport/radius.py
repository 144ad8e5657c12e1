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
    """Weights 1 / (mean^2 + 0.1 <mean>^2) of squared errors: relative error, without letting dark pixels rule."""
    return 1 / (mean ** 2 + 0.1 * np.mean(mean) ** 2 + 1e-30)


def noise_and_difference(samples, weights):
    """V and Q of the module's docstring, one a radius, with Q's standard error.

    `samples`: (iterations, radii, pixels) gathered values of independent iterations; `weights`: (pixels,).
    """
    m = samples.shape[0]
    variance = np.mean(weights * samples.var(axis=0, ddof=1), axis=1)
    steps = np.diff(samples, axis=1)                                      # (m, radii - 1, pixels)
    pairs = weights * (steps.sum(axis=0) ** 2 - (steps ** 2).sum(axis=0)) / (m * (m - 1))
    difference = np.concatenate([[0.0], pairs.mean(axis=1)])
    # Neighbouring pixels share photons: the error comes from leaving out one iteration at a time.
    total = steps.sum(axis=0)
    left_out = np.stack([np.mean(weights * ((total - s) ** 2 - ((steps ** 2).sum(axis=0) - s ** 2)), axis=1)
                         / ((m - 1) * (m - 2)) for s in steps]) if m > 2 else np.repeat(difference[None, 1:], m, axis=0)
    error = np.concatenate([[0.0], np.sqrt((m - 1) / m * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))])
    return variance, difference, error


def smooth_difference(radii, difference, error):
    """Q(R) as a power law a R^q, 1 <= q <= 4: `(a, q)`.

    Fitted in logarithms to the smallest radii at which Q stands out of its noise (larger ones saturate). Where none does, the
    law goes through what the largest radius may hide, Q plus two standard errors, with q = 3.
    """
    clear = np.flatnonzero((difference > 2.5 * error) & (difference > 0))[:3]
    if len(clear) == 0:
        return (max(difference[-1], 0) + 2 * error[-1]) / radii[-1] ** 3, 3.0
    x, y = np.log(radii[clear]), np.log(difference[clear])
    q = 3.0
    if len(clear) > 1:
        weight = 1 / (0.05 + (error[clear] / difference[clear])) ** 2
        center = np.average(x, weights=weight)
        slope = np.sum(weight * (x - center) * (y - np.average(y, weights=weight))) / np.sum(weight * (x - center) ** 2)
        q = float(np.clip(slope, 1.0, 4.0))
    return float(np.exp(np.mean(y - q * x))), q


def best_radius(radii, samples, mean, iterations):
    """The radius that minimises the predicted relative error.

    `radii`: the ladder; `samples`: see `noise_and_difference`; `mean`: (pixels,) mean radiance; `iterations(R)`: how many iterations
    there will be, a function of the radius, so that larger gathers are charged for.
    Returns `(radius, predicted error at it)`.
    """
    variance, difference, error = noise_and_difference(samples, relative_weights(mean))
    a, q = smooth_difference(radii, difference, error)
    fine = np.exp(np.linspace(np.log(radii[0]), np.log(radii[-1]), 16 * len(radii)))
    noise = np.exp(np.interp(np.log(fine), np.log(radii), np.log(np.maximum(variance, 1e-30))))
    predicted = BIAS_FACTOR * a * fine ** q + noise / iterations(fine)
    best = int(np.argmin(predicted))
    return float(fine[best]), float(predicted[best])
