"""Veach's balance and power heuristics from ratios of densities, for any number of strategies.

Sources: Veach, Robust Monte Carlo methods for light transport simulation, PhD thesis (1997),
balance heuristic (9.8), power heuristic (9.13); the running sums as in Georgiev et al., Light
transport simulation with vertex connection and merging (2012), doi 10.1145/2366145.2366211.

Densities of whole paths overflow, ratios between neighbouring strategies do not: ratios[k] is the
density of strategy k over that of strategy k + 1, times the ratio of their numbers of samples, both
for the same joint path; no unit, from 0 to infinity (0/0, a path that neither can make, is the
caller's to avoid). Any array shape that broadcasts, NumPy or Dr.Jit, elementwise and without
branches.
"""

from __future__ import annotations

from collections.abc import Sequence

from . import Array
from .recursion import at_least, at_most

LIMIT = 1e12
"""Bound on ratio^beta and its inverse. It moves weights by 1e-12 and keeps infinity times zero from
happening: a strategy with density zero between two others leaves their ratio unknown, and here they
share alike. Bounded ratios are still those of some densities: the weights' sum stays one. In single
precision the sums overflow after three such ratios in one direction; the weight is zero then, as it
should be (up to seven strategies: more could come back from there)."""


def bounded_power(ratio: Array, beta: float = 2) -> Array:
    """ratio^beta, within 1/LIMIT ... LIMIT."""
    return at_most(at_least(ratio, LIMIT ** (-1 / beta)), LIMIT ** (1 / beta)) ** beta


def add_ratio(total: Array, ratio: Array, beta: float = 2) -> Array:
    """S' = ratio^beta (1 + S): one step of a running sum along a path.

    S: sum of (density of strategy j / density of this one)^beta over the strategies j on one side
    of this one (zero for the outermost); ratio: density of this strategy over that of the next one
    away from that side; S': the same sum for the next one. One sum grows from the camera, another
    one from the light; where they meet, `weight` is the heuristic's. beta = 1: balance heuristic.
    """
    return bounded_power(ratio, beta) * (1 + total)


def weight(before: Array, after: Array) -> Array:
    """w = 1 / (1 + S_before + S_after) (Veach 9.8, 9.13): the strategy with the sums of `add_ratio`
    on its two sides."""
    return 1 / (1 + before + after)


def heuristic_weights(ratios: Sequence[Array], beta: float = 2) -> list[Array]:
    """Weights of len(ratios) + 1 strategies, a list; their sum is one. beta = 1: balance (Veach
    9.8), 2: power heuristic (9.13)."""
    powers = [bounded_power(ratio, beta) for ratio in ratios]
    before, after = [0.0], [0.0]
    for power in powers:
        before.append(add_ratio(before[-1], power, 1))
    for power in reversed(powers):
        after.insert(0, add_ratio(after[0], 1 / power, 1))
    return [weight(b, a) for b, a in zip(before, after)]
