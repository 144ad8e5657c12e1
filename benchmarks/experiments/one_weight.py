"""The weights of `bdpm_opt2` with one weight for direct light and photons at the last vertex, as
the papers have it, in place of two: what the second weight brings.

Everything else stays: the cells, their estimates, the means over directions. The deepest response
and weight are those of `weights.recursion`, with b/L of the cells.
"""

from __future__ import annotations

import contextlib

from mis_integrators.mis import optimal
from mis_integrators.weights import recursion


def second_sum_over_luminance(node):
    """b/L: the mean BSDF value, times the share of light that photons bring."""
    luminance = node.direct + node.indirect
    smallest = recursion.SMALLEST_DENOMINATOR
    return node.kernel * node.indirect / recursion.at_least(luminance, smallest)


class OneWeightNode(optimal.Node):
    """A `Node` where direct light and photons share the last weight."""

    def final_response(self, n, r):
        c = second_sum_over_luminance(self)
        return recursion.deepest_response(n, self.direct + self.indirect, c, r)


def last_weight(u, r, node):
    """w of the last strategy, u = e drive."""
    return recursion.deepest_weight(u, 1, r, second_sum_over_luminance(node))


@contextlib.contextmanager
def one_weight():
    """Sessions of `bdpm_opt2` that are made and run within this have one weight there. (With more
    strategies direct light at other vertices would be weighted so, too.)"""
    weights = optimal.OptimalWeights
    kept = optimal.Node, weights.direct_weight, weights.final_weight
    optimal.Node = OneWeightNode
    weights.direct_weight = weights.final_weight = staticmethod(last_weight)
    try:
        yield
    finally:
        optimal.Node = kept[0]
        weights.direct_weight, weights.final_weight = map(staticmethod, kept[1:])
