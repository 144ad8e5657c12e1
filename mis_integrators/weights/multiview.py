"""Weights of views that can make each other's paths.

Source: Fraboni, Webanck, Bonneel, Iehl, Volumetric Multi-View Rendering (Computer Graphics Forum
2022). A path x_i of view i becomes x_k in view k. Of all densities only the ratios r_k = p_k(x_k)
|dx_k/dx_i| / p_i(x_i) matter, numbers of samples included (r_i = 1; 0 where view k cannot make the
path). Along the shifts the chain rule makes r_k / sum r the same whichever view's path they were
computed from.

Every function works on numbers, NumPy and Dr.Jit arrays. What a path adds to view j is `gain` times
f(x_j)/p_j(x_j) of the shifted path, a plain sample of view j.
"""

from __future__ import annotations

from . import Array
from .recursion import at_most

HEURISTICS = ("mis", "power", "mwis", "none")
LARGEST_SUMMAND = 1e36
"""Stands for infinity: sums of a hundred are single precision numbers."""


def summand(heuristic: str, ratio: Array, exponent: float = 2.0) -> Array:
    """What each view that can make the path adds to the sum that `gain` needs; `exponent`: of the
    power heuristic."""
    if heuristic == "power":
        return at_most(ratio, LARGEST_SUMMAND ** (1 / exponent)) ** exponent
    return 1.0 + 0 * ratio if heuristic == "none" else ratio


def gain(ratio: Array, total: Array) -> Array:
    """w_{i->j} p_j(x_j) |dx_j/dx_i| / p_i(x_i): the weight of the path in view j times what turns
    f/p_{i->j} into f/p_j.

    `total` is the sum of the `summand` over all views that can make the path, the path's own
    included. Only there do heuristics differ:
    mis:   w = 1 / S_r with S_r = sum_k r_k (balance heuristic); mwis has the same numerator, and
           its weights (1 / S_r) p_jj / p_ij = r_j / S_r
    are this very gain. power: w = 1 / sum_k r_k^alpha.
    none:  w = 1 / (number of views that can make the path), whatever their densities.
    """
    return ratio / total
