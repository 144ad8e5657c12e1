"""Where resampled connections and their weights meet.

Hooks of `transport.subpaths` and `transport.camera_vertices`, and what resampling makes of each technique of a joint path. All techniques of a path
evaluate one function: a technique that joins a light sub-path Y to the camera vertex z is taken to draw it with

    q/p = a(z) r(Y, z) + b(z),    r = f_y rho G softened,    G softened = G d^2 / (d^2 + h(z)^2)

a, b, h and the lengths' shares Q_s/Q are looked up by the place of z and the side from which the light comes (`CacheGrid.row`); they are averages over
the N_c cache points there, made once before the first iteration. So the weights depend neither on an iteration's light sub-paths nor on its cache of
pmfs, and the sum of the techniques stays unbiased. h^2 is the mean squared distance of the cache points: the cached pmf, made for their places, does not know
that G has a pole at z. Left out are visibility (the ends of a joint path see each other), the camera's BSDF of `f_y_f_yz`, and delta functions' weights;
colours enter by channel means.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.light_ends import END
from ..transport.proposals import UNIFORM_SHARE
from ..weights import bidirectional as theory
from ..weights import resampling

LENGTHS = 16
"""Lengths of light sub-paths whose shares are told apart; longer ones count with the last."""


class ResampledWeights:
    """`lights`, `grid` (a `CacheGrid`), `records` (float, four a row: a, b, h^2, 0), `shares` (float, `LENGTHS` a row), M light sub-paths, N draws; `aware`: whether
    the weights know of the resampling (else every technique has the density of its path alone); `ratio`: N_t, light sub-paths that are joined to
    the sensor over camera paths, of all the film."""

    states = END

    def __init__(self, lights, grid, records, shares, M, N, aware, ratio):
        self.lights, self.grid, self.records, self.shares = lights, grid, records, shares
        self.M, self.N, self.aware, self.ratio = M, N, aware, ratio

    # ------------------------------------------------------------------ resampling

    def row(self, p, n):
        """Row of a place, `n` its normal on the light's side."""
        return self.grid.row(p, n) if self.aware else mi.UInt32(0)

    def softened(self, row, geometry, squared):
        """The geometric term without its pole; unchanged for lights infinitely far away."""
        if not self.aware:
            return geometry
        spread = dr.gather(mi.Float, self.records, 4 * row + 2)
        return geometry * dr.rcp(1 + spread * dr.rcp(squared))

    def gain(self, r, row, s, active=True):
        """p_t / p of the technique that joins a light sub-path of `s` vertices, which sends r = q*/p, to a camera vertex of that row."""
        if not self.aware:
            return mi.Float(1)
        record = dr.gather(mi.Vector4f, self.records, row, active)
        share = dr.gather(mi.Float, self.shares, row * LENGTHS + dr.minimum(dr.maximum(s, 1), LENGTHS) - 1, active)
        return resampling.gain(record.x * r + record.y, share, self.M, self.N)

    # ------------------------------------------------------------------ hooks of the light sub-paths

    @staticmethod
    def blank(width):
        return [dr.zeros(mi.Float, width) for _ in range(3)]

    def lit(self, si, source, reachable, active, flux):
        ds = dr.copy(source)
        ds.d = ds.p - si.p
        ds.dist = dr.norm(ds.d)
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        ds.d = dr.select(active, dr.select(infinite, si.to_world(si.wi), ds.d * dr.rcp(ds.dist)), mi.Vector3f(0, 0, 1))
        start = self.lights.start_density(si, ds, active)
        across = self.lights.forward_density(si, ds, active)
        made = across * dr.abs(dr.dot(si.n, ds.d))
        strength = dr.select(self.lights.untold(ds.emitter, active), self.lights.total_power, dr.mean(flux))
        row = self.row(si.p, dr.mulsign(si.n, dr.dot(si.n, ds.d)))
        better = self.gain(strength * self.softened(row, made, dr.select(infinite, dr.inf, dr.square(ds.dist))), row, mi.UInt32(1), active)
        met = self.lights.can_be_met(ds.emitter, active)
        return [dr.select(reachable, better * theory.reciprocal(made), 0),
                dr.select(reachable & met, theory.reciprocal(start * across), 0), strength]

    def left(self, state, p_forward, p_back, delta, scattered):
        near, far, strength = state
        return [near, dr.select(delta, far, theory.far_of(near + p_back * far, p_forward)),
                dr.select(delta, strength, dr.minimum(strength * scattered * theory.reciprocal(p_forward), theory.LARGEST))]

    def arrived(self, state, density, si, squared, depth):
        row = self.row(si.p, dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi))))
        better = self.gain(state[2] * self.softened(row, density, squared), row, depth)
        return [dr.select(density > 0, better * theory.reciprocal(density), 0), state[1], state[2]]

    # ------------------------------------------------------------------ techniques

    def seen_by_sensor(self, connection, light):
        """Weight of a `LensConnection` of a light vertex (t = 1)."""
        a_light = light["near"] + connection.back * light["far"]
        return theory.connection(connection.density * (1 / self.ratio), a_light, 0, 0, 1)


def tabulate(grid, Q, Q_s, proposals, proposals_s):
    """`(records, shares)` of the rows, as `ResampledWeights` takes them.

    `Q` (C), `Q_s` (C x LENGTHS): integrals at the C cache points; `proposals`: light vertices that a light sub-path has on average, `proposals_s`:
    of each length. NumPy arrays. Cache points that no light reaches have the uniform pmf.
    """
    near = np.array(grid.table).reshape(-1, grid.neighbors)
    dark = ~(Q > 0)
    inverse = np.where(dark, 0, 1 / np.where(dark, 1, Q))
    uniform = UNIFORM_SHARE + (1 - UNIFORM_SHARE) * dark[near].mean(axis=1)
    a = (1 - UNIFORM_SHARE) * inverse[near].mean(axis=1)
    b = uniform / max(proposals, 1e-9)
    shares = (1 - UNIFORM_SHARE) * (Q_s * inverse[:, None])[near].mean(axis=1) + uniform[:, None] * (proposals_s / max(proposals, 1e-9))
    records = np.stack([a, b, np.array(grid.spread), np.zeros_like(a)], axis=1)
    return mi.Float(records.ravel().astype(np.float32)), mi.Float(shares.ravel().astype(np.float32))
