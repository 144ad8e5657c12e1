"""The target q* of light sub-paths at cache points: what the end of one sends to the cache points
near a place, visibility included.

Cached pmfs and the weights of Nabata et al. evaluate this one function, so what the weights take
for the probability of a draw is that probability. Colours enter by the product of channel means.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean
from ..paths.sensor import unblocked
from ..paths.subpaths import seen_normal, vertex_bsdf_of
from ..paths.vertex import in_medium
from .light_vertices import sent_by_starts

TARGETS = "f_y_rho_g_v", "f_y_f_yz"
"""Names of the targets: without and with the BSDF at the camera's end."""


def receiving_cosine(traits, z, d):
    """Cosine with which cache points `z` (records, `through` among them) receive light from the
    directions `d`: on surfaces zero from behind, unless they transmit; one in media."""
    cosine = dr.dot(seen_normal(z), d)
    cosine = dr.select(z["through"], dr.abs(cosine), dr.maximum(cosine, 0))
    return dr.select(in_medium(z["n"]), 1, cosine) if traits.has_media else cosine


class CacheTargets:
    """`cache`: records of the cache points (as of `read_vertices`, and `through`: whether their
    BSDF transmits); `grid`: the `CacheGrid` of their places; `target`: one of `TARGETS`; `time`,
    `wavelengths`: of the paths; `reach` [m]: longer than any line within the scene."""

    def __init__(self, scene, traits, lights, cache, grid, target, time, wavelengths, reach):
        self.scene, self.traits, self.lights = scene, traits, lights
        self.cache, self.grid, self.target = cache, grid, target
        self.time, self.wavelengths, self.reach = time, wavelengths, reach

    def read(self, point, active):
        """The cache points of these numbers."""
        return {
            name: dr.gather(type(values), values, point, active)
            for name, values in self.cache.items()
        }

    def received(self, z, d, active):
        """What a cache point `z` makes of light from direction `d`: the cosine, or its BSDF with
        the cosine, channel mean."""
        if self.target == TARGETS[0]:
            return receiving_cosine(self.traits, z, d)
        vertex_bsdf = vertex_bsdf_of(self.traits, z, self.wavelengths, active)
        return channel_mean(vertex_bsdf.f_and_pdfs(z["towards"], d, active)[0])

    def of_vertex(self, row, p, vertex_bsdf, to_light, active):
        """For each cache point of a row: what the vertex `p` sends there of light that comes from
        `to_light`, for a sub-path of strength one (`LightConnection.mean` is its product with the
        geometric term and the strength)."""
        result = []
        for number in range(self.grid.neighbors):
            z = self.read(self.grid.neighbor(row, number, active), active)
            offset = p - z["p"]
            squared = dr.maximum(dr.squared_norm(offset), 1e-20)
            distance = dr.sqrt(squared)
            d = offset * dr.rcp(distance)
            value, *_ = vertex_bsdf.f_and_pdfs(-d, to_light, active)
            sent = vertex_bsdf.scattered_mean(value, to_light, active)
            sent *= dr.abs(dr.dot(vertex_bsdf.n, d)) * dr.rcp(squared)
            result.append(self._seen(z, d, distance, sent, active))
        return result

    def of_light(self, row, start, active):
        """The same for points of lights (`light_starts.read_starts`), emitted light and the density
        of the start included."""
        result = []
        for number in range(self.grid.neighbors):
            z = self.read(self.grid.neighbor(row, number, active), active)
            ds, _, _, mean, _ = sent_by_starts(
                self.lights, start, z["p"], self.time, self.wavelengths, active
            )
            result.append(self._seen(z, ds.d, ds.dist, mean, active))
        return result

    def _seen(self, z, d, distance, sent, active):
        """q*/p, zero where something stands between."""
        r = sent * self.received(z, d, active)
        active = active & (r > 0) & dr.isfinite(r)
        distance = dr.minimum(distance, self.reach)
        return dr.select(unblocked(self.scene, z["p"], z["n"], d, distance, active), r, 0)


def integrals(r, vertices, lengths, width, M):
    """Estimates of Q_s, Q = sum of Q_s, and the mean number of light vertices of each length that a
    light sub-path has: `(Q_s, Q, ends_s)`, evaluated arrays with `lengths` entries a cache point,
    one, and `lengths`.

    `r` (float, C x `width`, one row a cache point): q*/p of the light vertices of M sub-paths, zero
    in unused places; `vertices` (uint32, alike): their s, zero in unused places. Longer sub-paths
    than `lengths` count with the last.
    """
    index = dr.arange(mi.UInt32, dr.width(r))
    used = vertices > 0
    length = dr.minimum(dr.maximum(vertices, 1), lengths) - 1
    points = dr.width(r) // width
    Q_s, ends_s = dr.zeros(mi.Float, points * lengths), dr.zeros(mi.Float, lengths)
    dr.scatter_reduce(
        dr.ReduceOp.Add, Q_s, r * (1 / M), index // width * lengths + length, used & (r > 0)
    )
    first = used & (index < width)  # the same at all cache points
    dr.scatter_reduce(dr.ReduceOp.Add, ends_s, mi.Float(1 / M), length, first)
    dr.eval(Q_s, ends_s)
    Q = dr.block_sum(Q_s, lengths)
    dr.eval(Q)
    return Q_s, Q, ends_s
