"""The weights of Nabata, Iwasaki and Dobashi as their paper has them (equations 37 to 44), with the
cache points of its section 5.

A camera vertex z chooses one of its N_c cache points, or the virtual one, and connects to a light
sub-path Y that is drawn from its pmf. Each (camera vertex, cache point) is a technique of its own,
and its density is

    P_c p_t,    p_t = (1/(M p) + (1 - Q_s/(M Q)) / (N q))^-1,    q = q*/Q,    P_c = 1/(N_c + 1)

with q* at the cache point, visibility included, by the very function that makes the pmfs
(`resampling.cache_targets`), and Q and Q_s of that cache point from the M light sub-paths of the
iteration before: then weights do not depend on what is drawn from. Nothing is bounded but by
single precision. Cache points belong to places: which side of a surface the light comes from does
not matter, so that all techniques of a path ask the same ones.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..paths.vertex import VertexBSDF
from ..weights import resampling
from .resampling import LENGTHS, ResampledWeights


class PublishedWeights(ResampledWeights):
    """`targets`: `CacheTargets`; `Q` (float, one a cache point), `shares` (float, `LENGTHS` a cache
    point): Q and Q_s/Q; `uniform` (float, `LENGTHS` + 1): for the virtual cache point the shares of
    light vertices of each length, and last their number for each light sub-path; M light sub-paths,
    N draws; `ratio`: N_t.

    The state of a light sub-path also has the vertex that it comes from (`SurfaceInteraction3f`),
    and the strength with which it arrived there.
    """

    def __init__(self, lights, targets, Q, shares, uniform, M, N, ratio):
        super().__init__(lights, targets.grid, None, shares, M, N, True, ratio, targets.traits)
        self.targets, self.Q, self.uniform = targets, Q, uniform
        self.kernels = tuple(f"kernel.{number}" for number in range(targets.grid.neighbors))
        self.light_kernels = tuple(f"light_{name}" for name in self.kernels)

    # ------------------------------------------------------------------ resampling

    def row(self, p, n, d):
        return self.grid.row(p, n)

    def softened(self, geometry, squared):
        return geometry

    def gains(self, r, row, s, active=True):
        """P_c p_t / p of each cache point's technique, the virtual one last, for a light sub-path
        of `s` vertices whose q*/p at the row's cache points are `r` (a list)."""
        place = dr.minimum(dr.maximum(s, 1), LENGTHS) - 1
        chance = resampling.cache_point_probability(self.grid.neighbors)
        result = []
        for number, ratio in enumerate(r):
            point = self.grid.neighbor(row, number, active)
            Q = dr.gather(mi.Float, self.Q, point, active)
            share = self.share_of_length(self.shares, point * LENGTHS + place, active)
            q_over_p = resampling.proposal_weight(ratio, Q)
            result.append(chance * resampling.gain(q_over_p, share, self.M, self.N))
        share = self.share_of_length(self.uniform, place, active)
        ends = dr.gather(mi.Float, self.uniform, mi.UInt32(LENGTHS), active)
        q_over_p = resampling.uniform_density_ratio(ends)
        return [*result, chance * resampling.gain(q_over_p, share, self.M, self.N)]

    @staticmethod
    def share_of_length(shares, place, active):
        """Q_s/Q."""
        return dr.gather(mi.Float, shares, place, active)

    def gain(self, r, row, s, active=True):
        """The sum of `gains`: what resampling makes of all techniques at one camera vertex."""
        return sum(self.gains(r, row, s, active))

    @staticmethod
    def sent(strength, scattered, kernels):
        return [strength * kernel for kernel in kernels]

    def kernels_of_vertex(self, row, p, vertex_bsdf, to_light, active):
        """What `p` sends to the cache points of the vertex before it, over the strength."""
        return self.targets.of_vertex(mi.UInt32(row), p, vertex_bsdf, to_light, active)

    def kernels_of_light(self, row, ds, mean, active):
        """What the point of a light sends to the cache points of the vertex that sees it as `ds`,
        over `mean`, its light there over the density of the start."""
        sent = self.targets.of_light(mi.UInt32(row), start_of(ds, ds.d), active)
        return [r * dr.rcp(dr.maximum(mean, 1e-20)) for r in sent]

    # --- light sub-paths -------------------------------------------------------------------------

    def blank(self, width):
        vertex = dr.zeros(mi.SurfaceInteraction3f, width)
        return [*super().blank(width), vertex, dr.zeros(mi.Float, width)]

    def init_light(self, si, source, reachable, active, flux):
        return [*super().init_light(si, source, reachable, active, flux), si, mi.Float(0)]

    def scatter(self, state, p_forward, p_back, delta, scattered, vertex):
        after = super().scatter(state, p_forward, p_back, delta, scattered, vertex)
        return [*after[:-1], state[2]]

    def gain_of_start(self, si, ds, made, strength, active):
        row = self.row(si.p, si.n, ds.d)
        sent = self.targets.of_light(row, start_of(ds, ds.d), active)
        return self.gain(sent, row, mi.UInt32(1), active)

    def gain_of_vertex(self, state, density, si, squared, s):
        *_, before, strength = state
        active = density > 0
        towards = before.to_world(before.wi)
        vertex_bsdf = VertexBSDF.at(self.targets.traits, before, before.bsdf(), active)
        row = self.row(si.p, si.n, towards)
        kernels = self.targets.of_vertex(row, before.p, vertex_bsdf, towards, active)
        return self.gain(self.sent(strength, None, kernels), row, s, active)

    @staticmethod
    def depart(state, si, mask):
        *others, before, strength = state
        return [*others, dr.select(mask, si, before), strength]


def start_of(ds, d):
    """The point of a light that is seen as `ds` in direction `d`, as of `read_starts`."""
    infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
    place = dr.select(infinite, mi.Point3f(d), ds.p)
    return {"emitter": ds.emitter, "p": place, "n": ds.n, "uv": ds.uv}


def published_tables(Q_s, Q, ends_s):
    """`(Q, shares, uniform)` as `PublishedWeights` takes them, of what
    `resampling.cache_targets.integrals` found; Q_s/Q of cache points without light are those of the
    light vertices."""
    ends = dr.sum(ends_s)
    of_ends = ends_s * dr.rcp(dr.maximum(ends, 1e-9))
    index = dr.arange(mi.UInt32, dr.width(Q_s))
    mine = dr.gather(mi.Float, Q, index // LENGTHS)
    shares = dr.select(
        mine > 0,
        Q_s * dr.select(mine > 0, dr.rcp(mine), 0),
        dr.gather(mi.Float, of_ends, index % LENGTHS),
    )
    uniform = dr.concat((of_ends, ends))
    dr.eval(shares, uniform)
    return Q, shares, uniform


def unknown_tables(points):
    """The same where nothing is known yet."""
    tables = dr.zeros(mi.Float, points), dr.zeros(mi.Float, points * LENGTHS)
    uniform = dr.full(mi.Float, 1, LENGTHS + 1)
    dr.eval(*tables, uniform)
    return *tables, uniform
