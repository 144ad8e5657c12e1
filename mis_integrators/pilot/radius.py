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
Corrected estimates
    At edges part of the disk holds no surface, and the plain estimate is too dark. The corrected
    one divides by the share of the disk that probe rays find covered; it is too bright in clutter,
    where there is no edge. How much plain estimates lack of what the correction adds is measured
    (`edges.py`). What either does wrong then is added to the fitted bias.
Minimised
    bias^2(R) + V(R) / n(R), over R and over plain or corrected estimates, where n(R) is the number
    of iterations that there will be: larger disks and probe rays make an iteration dearer
    (`cost.py`). Where the camera sees the vertices that gather it is the product of both measures
    that is least: close to a bright lamp blur may be little of all pixels' relative error, and most
    of the absolute one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .bias import LEAST_BIAS, LEAST_CORRECTED, expected_squared_bias, squared_difference
from .edges import light_lost_at_edges
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
    """Squared bias and variance of the estimates from one kind of photons. Both are
    dictionaries, False: plain estimates, True: corrected ones. They are empty where the pilot found
    no photon."""

    ladder: np.ndarray
    fine: np.ndarray
    """Radii to choose from."""
    squared_bias: dict[bool, np.ndarray]
    """At the fine radii."""
    noise: dict[bool, Noise]
    """Of an iteration of the render, at the ladder."""

    def at(self, radius: float, corrected: bool, light_share: float = 1.0) -> tuple[float, float]:
        """Squared bias and variance at a radius, with that share of the light sub-paths."""
        if corrected not in self.noise:
            return 0.0, 0.0
        bias = between(np.array([radius]), self.fine, self.squared_bias[corrected])
        variance = between(np.array([radius]), self.ladder, self.noise[corrected].at(light_share))
        return float(bias[0]), float(variance[0])

    def after(self, iterations: np.ndarray, corrected: bool, light_share: float) -> np.ndarray:
        """The mean squared errors of so many iterations with each of the fine radii."""
        variance = between(self.fine, self.ladder, self.noise[corrected].at(light_share))
        return self.squared_bias[corrected] + variance / iterations


def error_by_radius(
    radii: np.ndarray,
    plain: np.ndarray,
    corrected: np.ndarray | None,
    weights: np.ndarray,
    photons_only: bool = True,
    alike: bool = False,
    light_paths: float = 1.0,
    filter_share: float = 1.0,
) -> ErrorByRadius:
    """The `ErrorByRadius` of estimates at the `radii` of the ladder. A ladder of one radius is
    given: its disks are so small that they do not blur.

    Parameters
    ----------
    plain : (iterations, radii, groups, pixels)
        Estimates of independent iterations, by the groups of camera paths of `denoiser`.
    corrected : as `plain`, or None
        The same corrected at edges.
    weights : (pixels,)
        Of the pixels' squared errors, see `noise.MEASURES`.
    photons_only, alike, light_paths, filter_share
        See `noise.noise_by_radius`.
    """
    fine = np.exp(np.linspace(np.log(radii[0]), np.log(radii[-1]), 16 * len(radii)))
    if not np.any(plain):
        return ErrorByRadius(radii, fine, {}, {})
    noise = {
        which: noise_by_radius(
            radii, samples, weights, photons_only, alike, light_paths, filter_share
        )
        for which, samples in ((False, plain), (True, corrected))
        if samples is not None
    }
    plain = plain.mean(axis=2)
    at_edges: dict[bool, np.ndarray | float] = {False: 0.0}
    best, least = plain, LEAST_BIAS
    if corrected is not None:
        corrected = corrected.mean(axis=2)
        added, lacking, deviation = light_lost_at_edges(plain, corrected, weights)
        wrong = {False: lacking**2 + deviation**2, True: (1 - lacking) ** 2 + deviation**2}
        at_edges = {which: between(fine, radii, added * wrong[which]) for which in wrong}
        best = plain + lacking[:, None] * (corrected - plain)
        least *= (LEAST_CORRECTED / LEAST_BIAS) ** min(max(lacking[-1], 0.0), 1.0)
    blur = np.zeros(len(fine))
    if len(radii) > 1:
        difference, error = squared_difference(best, weights)
        blur = expected_squared_bias(radii, difference, error, len(plain), fine, least)
    return ErrorByRadius(
        radii,
        fine,
        {which: blur + at_edges[which] for which in noise},
        noise,
    )


class RadiusChoice(NamedTuple):
    """A radius, and whether estimates are corrected at edges."""

    radius: float
    corrected: bool


def best_radius(
    errors: Sequence[ErrorByRadius],
    iterations: Callable[[np.ndarray, bool], np.ndarray],
    used: tuple[float, bool] | None = None,
    reluctance: float = 0.0,
    light_share: float = 1.0,
) -> RadiusChoice:
    """The `RadiusChoice` with the least product of the `errors`, bias^2 + V / n, one for each
    measure. Where the pilot found no photon it is a middling radius.

    Parameters
    ----------
    iterations
        n: how many iterations of given radii (fine) and correction there will be.
    used : (radius, corrected)
        A choice that is kept unless the errors fall by more than the share `reluctance`.
    light_share
        Of the light sub-paths, those that an iteration has.
    """
    radii, fine = errors[0].ladder, errors[0].fine
    choices = []
    for corrected in errors[0].squared_bias:
        n = iterations(fine, corrected)
        predicted = np.prod([each.after(n, corrected, light_share) for each in errors], axis=0)
        at = int(np.argmin(predicted))
        candidates = [(float(predicted[at]), float(fine[at]))]
        if used is not None and used[1] == corrected:
            at = int(np.argmin(np.abs(np.log(fine / used[0]))))
            candidates.append((float(predicted[at]) * (1 - reluctance) ** len(errors), used[0]))
        choices += [(error, RadiusChoice(radius, corrected)) for error, radius in candidates]
    if not choices:
        return RadiusChoice(float(radii[middle_index(radii)]), False)
    return min(choices)[1]


def between(wanted: np.ndarray, radii: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values at the radii `wanted`, from those at `radii` by power laws."""
    return np.exp(np.interp(np.log(wanted), np.log(radii), np.log(np.maximum(values, 1e-30))))
