"""Where resampled connections and their weights meet.

The state of light sub-paths (that half of `mis.state.ConnectionState`), what camera sub-paths ask
(`paths.camera_vertices`), and what resampling makes of each technique of a joint path. All
techniques of a path evaluate one function: a technique that joins a light sub-path Y to the camera
vertex z is taken to draw it with

    q/p = (a + c) r + b,
    r = f_y rho G softened,    G softened = G d^2 / (d^2 + h^2)

where a, c and b are the cached pmfs' visible, blind and uniform parts (`proposals`). The record of
z, the two numbers a + c and b, and the lengths' shares Q_s/Q are looked up by place and by the side
from which the light comes (`CacheGrid.row`); they are averages over the N_c cache points there,
made once from the light sub-paths of the first iteration (which weights by densities alone). So the
weights depend neither on an iteration's own light sub-paths nor on its pmfs, and the
sum of the techniques stays unbiased. h is the spacing of the cache points: the cached pmf, made for
their places, does not know that G has a pole at z. Left out are visibility (the ends of a joint
path see each other), transmittance, the camera's BSDF of `f_y_f_yz`, the guess of the weight that
the pmfs contain (`guessed_weight`), and delta functions' weights; colours enter by channel means.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.spectra import channel_mean
from ..paths.light_starts import light_seen_from
from ..paths.vertex import facing, in_medium
from ..resampling.light_vertices import END
from ..resampling.proposals import BLIND_SHARE, uniform_share
from ..weights import bidirectional as theory
from ..weights import resampling
from .step_sums import LightEnd, sum_before
from .vertex_merging import eta_at

LENGTHS = 16
"""Tuned: lengths of light sub-paths whose shares are told apart; longer ones count with the
last."""
MANY = 100
"""Tuned: light sub-paths from which on Q_s / (M Q), at most 1 / M, is not worth a lookup."""
LEAST_GAIN, MOST_GAIN = 1.0, 2.0
"""Tuned: a draw counts as so many connections to a light sub-path of its own. A cache that promises
more is not to be believed (fireflies). Where it promises less, a heuristic that goes by second
moments would hand paths to techniques that are noisier: what is drawn seldom is mostly small. That
is so the more, the more there is to draw from: with a single light sub-path the formula stands."""


class ResampledWeights:
    """`lights`, `grid` (a `CacheGrid`), `records` (float, two a row: a + c, b), `shares` (float,
    `LENGTHS` a row), M light sub-paths, N draws; `aware`: whether the weights know of the
    resampling (else every technique has the density of its path alone); `ratio`: N_t, light
    sub-paths that are joined to the sensor over camera paths, of all the film; `traits`: a
    `SceneTraits`; `merging`: a `vertex_merging.Merging`, or None.

    Merging is one more technique at each vertex, with the density of both sub-paths up to there
    times eta (`vertex_merging.eta_at`; Georgiev et al. 2012). It takes all light sub-paths, and
    nothing is resampled."""

    states = END
    kernels: tuple[str, ...] = ()
    light_kernels: tuple[str, ...] = ()
    """What vertices and hits keep besides (`paths.camera_vertices`): nothing."""

    def __init__(self, lights, grid, records, shares, M, N, aware, ratio, traits, merging=None):
        self.lights, self.grid, self.records, self.shares = lights, grid, records, shares
        self.M, self.N, self.aware, self.ratio = M, N, aware, ratio
        self.traits, self.merging = traits, merging

    def eta_at(self, vertex):
        """As of `vertex_merging.eta_at`."""
        return eta_at(self.merging, vertex)

    # ------------------------------------------------------------------ resampling

    def row(self, p, n, d):
        """Row of a place with the geometric normal `n` (zero in media), from which the light is in
        direction `d`."""
        return self.grid.row(p, dr.mulsign(n, dr.dot(n, d))) if self.aware else mi.UInt32(0)

    @staticmethod
    def kernels_of_vertex(row, p, vertex_bsdf, to_light, active):
        return []

    @staticmethod
    def kernels_of_light(row, ds, mean, active):
        return []

    @staticmethod
    def sent(strength, scattered, kernels):
        """r = q*/p of a light sub-path with `strength`, whose end has `scattered`, its BSDF times
        the geometric term."""
        return strength * scattered

    def softened(self, geometry, squared):
        """The geometric term without its pole; unchanged for lights infinitely far away."""
        if not self.aware:
            return geometry
        return geometry * dr.rcp(1 + self.grid.squared_spacing * dr.rcp(squared))

    def gain(self, r, row, s, active=True):
        """p_t / p of the technique that joins a light sub-path of `s` vertices, which sends r =
        q*/p, to a camera vertex of that row."""
        if not self.aware:
            return mi.Float(1)
        record = dr.gather(mi.Vector2f, self.records, row, active)
        share = mi.Float(0)
        if self.M < MANY:
            share = dr.gather(
                mi.Float,
                self.shares,
                row * LENGTHS + dr.minimum(dr.maximum(s, 1), LENGTHS) - 1,
                active,
            )
        return dr.clip(
            resampling.gain(record.x * r + record.y, share, self.M, self.N),
            LEAST_GAIN * (1 - 1 / self.M),
            MOST_GAIN * self.N,
        )

    # --- light sub-paths -------------------------------------------------------------------------

    def blank(self, width):
        return [dr.zeros(mi.Float, width) for _ in range(3)]

    def init_light(self, si, source, reachable, active, flux):
        ds = light_seen_from(si, source, active)
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        ds.d = dr.select(active & infinite, si.to_world(si.wi), ds.d)
        start = self.lights.pdf_emission_origin(si, ds, active)
        across = self.lights.pdf_emission_area(si, ds, active)
        made = across * facing(self.traits, si.n, ds.d)
        strength = dr.select(
            self.lights.has_unknown_pdf(ds.emitter, active),
            self.lights.total_power,
            channel_mean(flux),
        )
        better = self.gain_of_start(si, ds, made, strength, active)
        met = self.lights.can_be_met(ds.emitter, active)
        return [
            dr.select(reachable, better * theory.reciprocal(made), 0),
            dr.select(reachable & met, theory.reciprocal(start * across), 0),
            strength,
        ]

    def gain_of_start(self, si, ds, made, strength, active):
        """Gain of joining the point of a light, which `si` sees as `ds`, to `si`. `made` [1/m^2]:
        density with which a light sub-path from there makes `si`."""
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        r = strength * self.softened(made, dr.select(infinite, dr.inf, dr.square(ds.dist)))
        return self.gain(r, self.row(si.p, si.n, ds.d), mi.UInt32(1), active)

    def gain_of_vertex(self, state, density, si, squared, s):
        """Gain of joining a light sub-path of `s` vertices to `si`, where it went on to with
        `density` [1/m^2], over the squared distance `squared`; `state`: before `si`."""
        row = self.row(si.p, si.n, si.to_world(si.wi))
        return self.gain(state[2] * self.softened(density, squared), row, s)

    @staticmethod
    def depart(state, si, mask):
        return state

    def scatter(self, state, p_forward, p_back, delta, scattered, vertex):
        d_vcm, d_vc, strength, *others = state
        return [
            d_vcm,
            dr.select(delta, d_vc, theory.d_vc_of(self._nearer(state, p_back, vertex), p_forward)),
            dr.select(
                delta,
                strength,
                dr.minimum(
                    strength * scattered * theory.reciprocal(p_forward), theory.LARGEST_RATIO
                ),
            ),
            *others,
        ]

    def propagate(self, state, density, si, squared, depth):
        better = self.gain_of_vertex(state, density, si, squared, depth)
        return [dr.select(density > 0, better * theory.reciprocal(density), 0), *state[1:]]

    def _nearer(self, state, p_back, vertex):
        """A_i, of all techniques nearer to the light than joining the vertex with that state."""
        d_vcm, d_vc = state[:2]
        return d_vcm + p_back * d_vc + self.eta_at(vertex)

    # ------------------------------------------------------------------ techniques

    def seen_by_sensor(self, connection, light):
        """Weight of a `LensConnection` of a light vertex (t = 1)."""
        a_light = self._nearer([light["d_vcm"], light["d_vc"]], connection.back, light)
        return theory.connection(connection.density * (1 / self.ratio), a_light, 0, 0, 1)

    def merged(self, camera, z, state, f, back_at_light, back_at_camera, segments, active):
        """Weight of merging the camera vertices `z` (records of the buffer `camera`) with light
        vertices of that `state`, on paths of so many segments. `f` [1/sr]: the BSDF, channel mean;
        `back_at_light`, `back_at_camera`: densities per projected solid angle with which the
        camera's side goes on to the vertex before the light's, and the light's to the camera's."""
        (d_vcm, d_vc, strength), eta = state, self.eta_at(z)
        end = LightEnd(mi.Float(1), strength, f, back_at_camera, segments, [], eta)
        from_here_on = sum_before(camera, z, z["parent"], end, self, active)
        return eta * dr.rcp(from_here_on + d_vcm + back_at_light * d_vc)


def guessed_weight(traits, z, joined, eta=0.0):
    """Weight that joining the cache point `z` (a record of a camera vertex) to a light vertex that
    sends `joined` would have among itself, the techniques nearer to the light, if the surface at
    `z` is diffuse or the medium isotropic, and those next to the camera: joining `z` with what is
    before it, and merging there with `eta` [m^2]; all as if nothing was resampled.

    What is drawn should be proportional to weight times contribution. By q* alone long light
    sub-paths matter as much as direct light, though each of them is one of many ways to make its
    path."""
    cosine, onwards = facing(traits, z["n"], joined.d), dr.inv_pi
    if traits.has_media:
        onwards = dr.select(in_medium(z["n"]), dr.inv_four_pi, dr.inv_pi)
    return dr.rcp(
        1
        + dr.minimum(
            cosine * (onwards * joined.mis_sum + joined.pdf_area * (z["d_vcm"] + eta)),
            theory.LARGEST_RATIO,
        )
    )


def uniform_tables(grid):
    """`(records, shares)` of the rows that have every draw count as one connection, where nothing
    is known of Q and Q_s."""
    return tuple(
        from_numpy(mi.Float, np.tile(values, grid.rows))
        for values in ([0.0, 1.0], np.ones(LENGTHS))
    )


def tabulate(grid, Q_s, Q_blind, ends_s):
    """`(records, shares)` of the rows, as `ResampledWeights` takes them.

    NumPy arrays: `Q_s` (C x LENGTHS), integrals at the C cache points, visibility included;
    `Q_blind` (C), of all lengths, visibility not; `ends_s` (LENGTHS): light vertices that a light
    sub-path has of each length on average.
    """
    neighbours = np.array(grid.table).reshape(-1, grid.neighbors)

    def inverse(Q):
        return np.where(Q > 0, 1 / np.where(Q > 0, Q, 1), 0)

    Q = Q_s.sum(axis=1)
    own = uniform_share(np.minimum(Q * inverse(Q_blind), 1))
    blind = np.where(Q > 0, BLIND_SHARE, 1)
    ends = max(ends_s.sum(), 1e-9)
    uniform = np.where(Q_blind > 0, own, 1)[neighbours].mean(axis=1)
    # What a darker neighbour has least of is what matters here: 1/Q of the mean, not the mean of
    # 1/Q.
    a = ((1 - own) * (1 - blind))[neighbours].mean(axis=1) * inverse(Q[neighbours].mean(axis=1))
    c = ((1 - own) * blind)[neighbours].mean(axis=1) * inverse(Q_blind[neighbours].mean(axis=1))
    shares = (Q_s * inverse(Q)[:, None])[neighbours].mean(axis=1) + (~(Q > 0))[neighbours].mean(
        axis=1
    )[:, None] * (ends_s / ends)
    records = np.stack([a + c, uniform / ends], axis=1)
    return tuple(from_numpy(mi.Float, values.ravel()) for values in (records, shares))
