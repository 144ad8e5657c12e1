"""The bias of estimates: Q(R), the squared difference of neighbouring radii, and the squared bias
that explains it."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Exponents = TypeVar("Exponents", float, np.ndarray)

AT_EDGES, BY_CURVATURE = (1, 4.327), (4, 16 / 9)
"""Exponents q of the squared bias and what it is then in units of Q. At an edge a disk whose centre
is u R away loses the share g(u) = (acos u - u sqrt(1 - u^2)) / pi, and the ratio is the integral of
g(u)^2 over that of (g(u) - g(2u))^2. Curvature has the bias c R^2 against c (R^2 - R^2 / 4)."""
LEAST_BIAS, MOST_BIAS = 0.003, 1.0
"""Tuned: squared relative bias that disks of the ladder's largest radius can have, however little
of it a short pilot sees. (In Cornell boxes, a corridor, rooms lit through a door or a window it is
0.002 to 0.04.)"""
LEAST_CORRECTED = 1e-4
"""Tuned: the same of estimates that are corrected at edges (1e-4 to 1.6e-3 in Cornell boxes)."""
LEAST_DEEPER = 3e-4
"""Tuned: the same of indirect light that is gathered one vertex further than the camera sees, where
blur averages out (1e-4 to 5e-4 in two Cornell boxes, a corridor, rooms lit through a door or a
window)."""
MISFIT_OF_LAW = 0.15
"""Tuned: relative error of the law itself, beyond the noise of Q."""


def expected_square(samples: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted mean over pixels of E[samples]^2, without bias: products of different iterations
    only. `samples`: (iterations, ..., pixels)."""
    m = samples.shape[0]
    products = samples.sum(axis=0) ** 2 - (samples**2).sum(axis=0)
    return np.mean(weights * products, axis=-1) / (m * (m - 1))


def jackknife(samples: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`expected_square` and its standard error, by leaving out one iteration at a time (the
    jackknife): neighbouring pixels share photons, so that pixels are no independent samples."""
    value, m = expected_square(samples, weights), samples.shape[0]
    if m < 3:
        return value, np.abs(value)
    left_out = np.stack([expected_square(np.delete(samples, i, 0), weights) for i in range(m)])
    return value, np.sqrt((m - 1) / m * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))


def squared_difference(samples: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Q(R) and its standard error, one a radius; zero for the smallest, which has no neighbour.

    `samples`: (iterations, radii, pixels); `weights`: (pixels,).
    """
    steps = np.diff(samples, axis=1)
    difference, error = jackknife(steps, weights)
    return np.concatenate([[0.0], difference]), np.concatenate([[0.0], error])


def squared_bias_over_difference(exponent: Exponents) -> Exponents:
    """bias^2(R) over Q(R), where both grow as R^exponent: exact for edges and for curvature,
    geometric between."""
    (low, at_edges), (high, by_curvature) = AT_EDGES, BY_CURVATURE
    return at_edges * (by_curvature / at_edges) ** ((exponent - low) / (high - low))


def expected_squared_bias(
    radii: np.ndarray,
    difference: np.ndarray,
    error: np.ndarray,
    iterations: int,
    wanted: np.ndarray,
    least: float = LEAST_BIAS,
) -> np.ndarray:
    """Squared bias at the radii `wanted`: the mean over laws bias^2 = c R^q, each weighted by how
    well it explains Q, the `difference` at the ladder's `radii` with its standard `error`.

    The laws are flat in q between 1 and 4, and in the logarithm of the squared bias at the largest
    radius, which is `least` or more. The `error` of Q is itself estimated from a few `iterations`,
    and often too small by far: misfits follow Student's distribution.
    """
    exponents = np.linspace(AT_EDGES[0], BY_CURVATURE[0], 31)[:, None, None]
    at_largest = np.geomspace(least, MOST_BIAS, 100)[None, :, None]
    law = (
        at_largest / squared_bias_over_difference(exponents) * (radii[1:] / radii[-1]) ** exponents
    )
    spread = np.hypot(error[1:], MISFIT_OF_LAW * law) + 1e-12
    freedom = max(iterations - 1, 1)
    misfit = np.sum(
        (freedom + 1) * np.log1p(((difference[1:] - law) / spread) ** 2 / freedom)
        + 2 * np.log(spread),
        axis=-1,
    )
    weight = np.exp(-0.5 * (misfit - misfit.min()))
    weight /= weight.sum()
    bias = at_largest * (wanted / radii[-1]) ** exponents
    return np.einsum("qh,qhr->r", weight, bias)
