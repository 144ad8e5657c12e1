"""The merge radius that minimises the predicted error, from what a short pilot measures.

A pilot estimates a few thousand pixels in a few independent iterations, at a ladder of radii R that
double from one to the next, all from the same photons. Let x(R) be the estimate of a pixel in one
iteration, and <.> the weighted mean over pixels, by two measures of error, relative and absolute
(`noise.MEASURES`).

Measured
    V(R) = <Var[x(R)]>, the noise of one iteration (`noise.py`), or what a denoiser leaves of it
    (`denoiser.py`), and
    Q(R) = <(E[x(R)] - E[x(R / 2)])^2>, the squared difference of neighbouring radii, from products
    of different iterations only, and so without bias (`bias.py`).
Fitted
    bias^2(R) = c R^q, with q between 1 (the bias sits in strips of width R along edges) and 4 (it
    is curvature). Then Q is c R^q over a known constant. Few iterations do not tell c and q: all
    laws count, by how well they explain Q (`bias.expected_squared_bias`).
Indirect light
    At edges part of the disk holds no surface, and a plain estimate is too dark. The corrected one
    divides by the share of the disk that probe rays find covered. Where the camera does not see the
    vertices that gather, a pixel has many disks, and their blur averages out. Little of the bias
    may show then: the laws begin at a smaller one.
Minimised
    bias^2(R) + V(R) / n(R) over R, where n(R) is the number of iterations that there will be:
    larger disks make an iteration dearer (`cost.py`). Where the camera sees the vertices that
    gather it is the product of both measures that is least: close to a bright lamp blur may be
    little of all pixels' relative error, and most of the absolute one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .bias import LEAST_BIAS, expected_squared_bias, squared_difference
from .noise import Noise, noise_by_radius

LADDER_STEPS = 7
"""Tuned: radii of the ladder."""
STEP = 2.0
LARGEST_SHARE = 0.08
"""Tuned: largest radius of the ladder in units of the spread of the points where photons are
gathered."""


def ladder(points: np.ndarray, weights: np.ndarray) -> np.ndarray | None:
    """Radii to try (ascending, factor `STEP`), from the gather points (3, n) with their path
    weights (n,); None where no weight is positive."""
    used = points[:, weights > 0]
    if used.shape[1] == 0:
        return None
    low, high = np.percentile(used, [2, 98], axis=1)
    spread = np.linalg.norm(high - low) / 3**0.5
    return ladder_from(max(spread, 1e-6) * LARGEST_SHARE)


def ladder_from(largest: float) -> np.ndarray:
    """The radii of a ladder with this one as its largest."""
    return largest * STEP ** -np.arange(LADDER_STEPS - 1, -1, -1.0)


def largest_radius(extent: float) -> float:
    """The largest radius of a ladder that suits a whole scene, by the diagonal of its bounds."""
    return LARGEST_SHARE * extent / 3**0.5


def middle_index(radii: np.ndarray) -> int:
    """The place of a middling radius of the ladder: little bias, little noise."""
    return len(radii) * 2 // 3


class ErrorByRadius(NamedTuple):
    """Squared bias and variance of the estimates from one kind of photons; None where the pilot
    found no photon."""

    ladder: np.ndarray
    fine: np.ndarray
    """Radii to choose from."""
    squared_bias: np.ndarray | None
    """At the fine radii."""
    noise: Noise | None
    """Of an iteration of the render, at the ladder."""

    def at(self, radius: float, light_share: float = 1.0) -> tuple[float, float]:
        """Squared bias and variance at a radius, with that share of the light sub-paths."""
        if self.squared_bias is None or self.noise is None:
            return 0.0, 0.0
        bias = between(np.array([radius]), self.fine, self.squared_bias)
        variance = between(np.array([radius]), self.ladder, self.noise.at(light_share))
        return float(bias[0]), float(variance[0])

    def after(self, iterations: np.ndarray, light_share: float) -> np.ndarray:
        """The mean squared errors of so many iterations with each of the fine radii; there are
        photons."""
        assert self.squared_bias is not None and self.noise is not None
        variance = between(self.fine, self.ladder, self.noise.at(light_share))
        return self.squared_bias + variance / iterations


def error_by_radius(
    radii: np.ndarray,
    samples: np.ndarray,
    weights: np.ndarray,
    photons_only: bool = True,
    alike: bool = False,
    light_paths: float = 1.0,
    filter_share: float = 1.0,
    least_bias: float | None = None,
) -> ErrorByRadius:
    """The `ErrorByRadius` of estimates at the `radii` of the ladder. A ladder of one radius is
    given: its disks are so small that they do not blur.

    Parameters
    ----------
    samples : (iterations, radii, groups, pixels)
        Estimates of independent iterations, by the groups of camera paths of `denoiser`.
    weights : (pixels,)
        Of the pixels' squared errors, see `noise.MEASURES`.
    photons_only, alike, light_paths, filter_share
        See `noise.noise_by_radius`.
    least_bias
        Squared, at the largest radius: `bias.LEAST_BIAS`, or another one.
    """
    fine = np.exp(np.linspace(np.log(radii[0]), np.log(radii[-1]), 16 * len(radii)))
    if not np.any(samples):
        return ErrorByRadius(radii, fine, None, None)
    noise = noise_by_radius(radii, samples, weights, photons_only, alike, light_paths, filter_share)
    blur = np.zeros(len(fine))
    if len(radii) > 1:
        difference, error = squared_difference(samples.mean(axis=2), weights)
        least = LEAST_BIAS if least_bias is None else least_bias
        blur = expected_squared_bias(radii, difference, error, len(samples), fine, least)
    return ErrorByRadius(radii, fine, blur, noise)


def best_radius(
    errors: Sequence[ErrorByRadius],
    iterations: Callable[[np.ndarray], np.ndarray],
    used: float | None = None,
    reluctance: float = 0.0,
    light_share: float = 1.0,
) -> float:
    """The radius with the least product of the `errors`, bias^2 + V / n, one for each measure.
    Where the pilot found no photon it is a middling one.

    Parameters
    ----------
    iterations
        n: how many iterations of given radii (fine) there will be.
    used
        A radius that is kept unless the errors fall by more than the share `reluctance`.
    light_share
        Of the light sub-paths, those that an iteration has.
    """
    radii, fine = errors[0].ladder, errors[0].fine
    if errors[0].squared_bias is None:
        return float(radii[middle_index(radii)])
    n = iterations(fine)
    predicted = np.prod([each.after(n, light_share) for each in errors], axis=0)
    best = int(np.argmin(predicted))
    if used is not None:
        kept = int(np.argmin(np.abs(np.log(fine / used))))
        if predicted[kept] * (1 - reluctance) ** len(errors) < predicted[best]:
            return used
    return float(fine[best])


def between(wanted: np.ndarray, radii: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at the radii `wanted`, from those at `radii` by power laws."""
    return np.exp(np.interp(np.log(wanted), np.log(radii), np.log(np.maximum(values, 1e-30))))
