"""Drawing light vertices from the pmfs of single cache points, as Nabata et al. do.

The cache points near a place, and one virtual cache point whose pmf is uniform (their section 5.2),
are chosen with equal probabilities. The virtual one is what unbiasedness needs: the others draw
nothing that they do not see.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def cumulative_pmfs(r, width):
    """`(sums, totals)`: cumulative sums, up to one in each row, of pmfs in proportion to `r`
    (float, C x `width`, one row a cache point), and the sum of each row (where that is zero, so are
    the cumulative sums)."""
    sums = dr.block_prefix_sum(r, width, exclusive=False)
    place = dr.arange(mi.UInt32, dr.width(r))
    total = dr.gather(mi.Float, sums, (place // width) * width + (width - 1))
    end = dr.arange(mi.UInt32, dr.width(r) // width) * width + (width - 1)
    sums_to_one = dr.minimum(sums * dr.select(total > 0, dr.rcp(total), 0), 1)
    return sums_to_one, dr.gather(mi.Float, sums, end)


class CachePmfs:
    """The pmfs of a `grid` of cache points: `cumulative` and `totals` as of `cumulative_pmfs`, `r`
    and `width` as there; `count` (uint32 of width one): light vertices in use, the first ones."""

    def __init__(self, grid, cumulative, totals, r, count, width):
        self.grid, self.cumulative, self.totals, self.r = grid, cumulative, totals, r
        self.count, self.techniques = count, grid.neighbors + 1
        self.width, self.steps = dr.opaque(mi.UInt32, width), width.bit_length()

    def draw(self, row, rng, active=True):
        """A cache point of each row, and a light vertex from its pmf: `(which, vertex, drawn)`,
        where `which` = N_c is the virtual cache point; nothing is drawn from a pmf that is zero
        everywhere."""
        techniques, neighbors = self.techniques, self.grid.neighbors
        which = dr.minimum(mi.UInt32(rng.next_float32(active) * techniques), techniques - 1)
        u = rng.next_float32(active)
        real = active & (which < neighbors)
        point = self.grid.neighbor(row, which, real)
        start = point * self.width
        end = start + (self.width - 1)
        chosen = dr.binary_search(
            0,
            1 << self.steps,
            lambda i: dr.gather(mi.Float, self.cumulative, dr.minimum(start + i, end), real) <= u,
        )
        vertex = dr.select(real, chosen, mi.UInt32(u * mi.Float(self.count)))
        drawn = ~real | (dr.gather(mi.Float, self.totals, point, real) > 0)
        vertex = dr.minimum(vertex, dr.maximum(self.count, 1) - 1)
        return which, vertex, active & drawn

    def probabilities(self, row, vertex, active=True):
        """What each cache point of the row, and last the virtual one, draws the light vertex with
        (a list)."""
        result = []
        for number in range(self.grid.neighbors):
            start = self.grid.neighbor(row, number, active) * self.width
            upper = dr.gather(mi.Float, self.cumulative, start + vertex, active)
            lower = dr.gather(mi.Float, self.cumulative, start + vertex - 1, active & (vertex > 0))
            result.append(dr.maximum(upper - lower, 0))
        return [*result, dr.rcp(mi.Float(dr.maximum(self.count, 1)))]

    def ratios(self, row, vertex, active=True):
        """r = q*/p of the light vertex at each cache point of the row (a list)."""
        return [
            dr.gather(
                mi.Float,
                self.r,
                self.grid.neighbor(row, number, active) * self.width + vertex,
                active,
            )
            for number in range(self.grid.neighbors)
        ]
