"""Drawing light vertices for camera vertices, from the pmfs of near cache points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

UNIFORM_SHARE = 0.1
"""Share of draws that ignore the cache: what no near cache point sees is still drawn."""


def cumulative_sums(r, count, width):
    """Cumulative sums, up to one in each row, of the pmfs of C cache points over up to `width` light vertices.

    `r` (float, C x width, one row a cache point): q*/p of each light vertex, zero in unused places; `count` (uint32 of width one): light vertices in
    use, the first ones. A row without any light is uniform.
    """
    place = dr.arange(mi.UInt32, dr.width(r))
    sums = dr.block_prefix_sum(r, width, exclusive=False)
    total = dr.gather(mi.Float, sums, (place // width) * width + (width - 1))
    column = mi.Float(dr.minimum(place % width + 1, count))
    some = total > 0
    return dr.select(some, dr.minimum(sums * dr.rcp(dr.select(some, total, 1)), 1), column / mi.Float(dr.maximum(count, 1)))


class Proposals:
    """For every row of a `CacheGrid` a mixture of the pmfs of its cache points: `cumulative` as of `cumulative_sums`, `count` and `width` as there.

    The probability of a light vertex is what the cumulative sums give it: they are what is drawn from, rounding included.
    """

    def __init__(self, grid, cumulative, count, width):
        self.grid, self.cumulative, self.count, self.width = grid, cumulative, count, width

    def draw(self, row, rng, active=True):
        """Light vertex for each row: one of the row's cache points at random, then a light vertex from its pmf, or any at the uniform share."""
        which = dr.minimum(mi.UInt32(rng.next_float32(active) * self.grid.neighbors), self.grid.neighbors - 1)
        start = self.grid.neighbor(row, which, active) * self.width
        uniform = rng.next_float32(active) < UNIFORM_SHARE
        u = rng.next_float32(active)
        chosen = dr.binary_search(0, self.width, lambda i: dr.gather(mi.Float, self.cumulative, start + dr.minimum(i, self.width - 1), active) <= u)
        anywhere = mi.UInt32(u * mi.Float(self.count))
        last = dr.maximum(self.count, 1) - 1
        return dr.minimum(dr.select(uniform, anywhere, chosen), last)

    def probability(self, row, vertex, active=True):
        """P_r of the light vertex `vertex`: the mean of the row's pmfs, mixed with the uniform one."""
        mean = mi.Float(0)
        for number in range(self.grid.neighbors):
            start = self.grid.neighbor(row, number, active) * self.width
            upper = dr.gather(mi.Float, self.cumulative, start + vertex, active)
            lower = dr.gather(mi.Float, self.cumulative, start + vertex - 1, active & (vertex > 0))
            mean += dr.maximum(upper - lower, 0)
        return mean * ((1 - UNIFORM_SHARE) / self.grid.neighbors) + UNIFORM_SHARE / mi.Float(dr.maximum(self.count, 1))
