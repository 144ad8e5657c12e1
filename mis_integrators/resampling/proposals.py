"""Drawing light vertices for camera vertices, from the pmfs of near cache points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

UNIFORM_SHARE = 0.03, 0.2
"""Tuned: share of draws that ignore the cache, for what no near cache point is sent: where a cache
point sees all light, and where it sees none."""
BLIND_SHARE = 0.4
"""Tuned: share of the cached pmfs that ignores what stands between: a cache point in the shadow
knows little of a place near it in the light."""


def uniform_share(visible):
    """Share of draws that ignore a cache point whose light is to the share `visible` seen from it:
    what lies half in the shadow has neighbours that see other things. Dr.Jit and NumPy alike."""
    return UNIFORM_SHARE[1] + (UNIFORM_SHARE[0] - UNIFORM_SHARE[1]) * visible


def arriving(r, seen):
    """What arrives of `r`: where nothing stands between (`seen` bool), or the share that media
    leave of it (`seen` float)."""
    return dr.select(seen, r, 0) if dr.is_mask_v(seen) else r * seen


def cumulative_sums(r, seen, count, width):
    """Cumulative sums, up to one in each row, of the pmfs of C cache points over up to `width`
    light vertices; and `uniform_share` of each row.

    `r` (float, C x width, one row a cache point): q*/p of each light vertex if nothing stood
    between, zero in unused places; `seen` (bool, alike): whether nothing does, or in scenes with
    media (float) the share that arrives; `count` (uint32 of width one): light vertices in use, the
    first ones. The pmf is that of what is seen, with
    `BLIND_SHARE` of what is not told apart; one of the two alone if the other is nothing, uniform
    if both are.
    """
    place = dr.arange(mi.UInt32, dr.width(r))
    last = (place // width) * width + (width - 1)
    all_sums, seen_sums = (
        dr.block_prefix_sum(x, width, exclusive=False) for x in (r, arriving(r, seen))
    )
    every, some = (dr.gather(mi.Float, x, last) for x in (all_sums, seen_sums))
    uniform = mi.Float(dr.minimum(place % width + 1, count)) / mi.Float(dr.maximum(count, 1))
    blind = dr.select(every > 0, dr.minimum(all_sums / dr.select(every > 0, every, 1), 1), uniform)
    share = dr.select(some > 0, mi.Float(BLIND_SHARE), 1)
    sums = dr.fma(
        share, blind, (1 - share) * dr.minimum(seen_sums / dr.select(some > 0, some, 1), 1)
    )
    end = dr.arange(mi.UInt32, dr.width(r) // width) * width + (width - 1)
    every, some = (dr.gather(mi.Float, x, end) for x in (all_sums, seen_sums))
    visible = dr.select(every > 0, some / dr.select(every > 0, every, 1), 0)
    return sums, uniform_share(dr.minimum(visible, 1))


class Proposals:
    """For every row of a `CacheGrid` a mixture of the pmfs of its cache points: `cumulative` and
    `uniform` as of `cumulative_sums`, `count` and `width` as there.

    The probability of a light vertex is what the cumulative sums give it: they are what is drawn
    from, rounding included.
    """

    def __init__(self, grid, cumulative, uniform, count, width):
        self.grid, self.cumulative, self.uniform, self.count = grid, cumulative, uniform, count
        self.width, self.steps = dr.opaque(mi.UInt32, width), width.bit_length()

    def draw(self, row, rng, active=True):
        """Light vertex for each row: one of the row's cache points at random, then a light vertex
        from its pmf, or any at the uniform share."""
        which = dr.minimum(
            mi.UInt32(rng.next_float32(active) * self.grid.neighbors), self.grid.neighbors - 1
        )
        point = self.grid.neighbor(row, which, active)
        start = point * self.width
        uniform = rng.next_float32(active) < dr.gather(mi.Float, self.uniform, point, active)
        u = rng.next_float32(active)
        end = start + (self.width - 1)
        chosen = dr.binary_search(
            0,
            1 << self.steps,
            lambda i: dr.gather(mi.Float, self.cumulative, dr.minimum(start + i, end), active) <= u,
        )
        anywhere = mi.UInt32(u * mi.Float(self.count))
        last = dr.maximum(self.count, 1) - 1
        return dr.minimum(dr.select(uniform, anywhere, chosen), last)

    def probability(self, row, vertex, active=True):
        """P_r of the light vertex `vertex`: the mean of the row's pmfs, mixed with the uniform
        one."""
        mean, uniform = mi.Float(0), mi.Float(0)
        for number in range(self.grid.neighbors):
            point = self.grid.neighbor(row, number, active)
            start, share = point * self.width, dr.gather(mi.Float, self.uniform, point, active)
            upper = dr.gather(mi.Float, self.cumulative, start + vertex, active)
            lower = dr.gather(mi.Float, self.cumulative, start + vertex - 1, active & (vertex > 0))
            mean += (1 - share) * dr.maximum(upper - lower, 0)
            uniform += share
        return (mean + uniform / mi.Float(dr.maximum(self.count, 1))) / self.grid.neighbors
