"""Where transport and the heuristics of connections meet: Veach's weights as the state of sub-paths
(see `weights.bidirectional`).

The weights are functions of the joint path alone. Not in them: Russian roulette, and the choices at
delta surfaces, taken as alike from both sides. They cost noise, never light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..paths.light_starts import light_seen_from
from ..paths.subpaths import STATES
from ..paths.vertex import in_medium
from ..weights import bidirectional as theory


@dataclass
class Merging:
    """Merge radii in terms of densities: `disk` [m^2], the area of a disk on surfaces times the
    light sub-paths that each camera path merges with, and in scenes with media `ball` [m^3], that
    of the volume of a ball (else None)."""

    disk: mi.Float
    ball: mi.Float | None = None


def eta_at(merging: Merging | None, vertex):
    """eta [m^2] at a vertex (`n` and `density` of a `VertexBSDF` or of a kept one): merges there
    over the density with which one side makes it. Volume photons lie as densely as light sub-paths
    scatter, so that in media it is `ball` times the extinction. Zero where nothing merges."""
    if merging is None:
        return 0.0
    n, density = (
        (vertex["n"], vertex["density"]) if isinstance(vertex, dict) else (vertex.n, vertex.density)
    )
    if merging.ball is None:
        return merging.disk
    return dr.select(in_medium(n), merging.ball * density, merging.disk)


class ConnectionWeights:
    """The state of sub-paths (`mis.state.ConnectionState`), and the weights of joined sub-paths.

    `beta`: Veach's exponent; `ratio`: light sub-paths over camera paths, of the whole crop window;
    `merging`: a `Merging`, or None.

    In media densities per volume hold the extinction at the vertex. That stands in both densities
    of each ratio p>(x_s) / p<(x_s) and cancels, so the equations are those of surfaces, with
    cosines of one. Transmittance, which differs between the two segments, is left out of both: it
    has no closed form in heterogeneous media. Weights still are functions of the path alone.
    """

    states = STATES

    def __init__(self, lights, beta, ratio, merging=None, media=False):
        self.lights, self.beta, self.ratio, self.merging = lights, beta, ratio, merging
        self.media = media

    @staticmethod
    def blank(width):
        """A state of that width."""
        return [dr.zeros(mi.Float, width), dr.zeros(mi.Float, width)]

    # ------------------------------------------------------------------ hooks of the sub-paths

    def init_light(self, si, source, reachable, active, flux=None):
        ds = light_seen_from(si, source, active)
        cosine = dr.maximum(dr.abs(dr.dot(si.n, ds.d)), 1e-6)
        if self.media:
            cosine = dr.select(in_medium(si.n), 1, cosine)
        direct = self.lights.pdf_direct(si, ds, active)
        d_vcm, d_vc = theory.light_start(
            cosine * self.lights.emission_over_nee_pdf(si, ds, active), direct * dr.rcp(cosine)
        )
        flags = ds.emitter.flags()
        met = ~(
            mi.has_flag(flags, mi.EmitterFlags.DeltaPosition)
            | mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        )
        return [dr.select(reachable, d_vcm, 0), dr.select(reachable & met, d_vc, 0)]

    def init_camera(self, density, active):
        return [
            dr.select(active & (density > 0), theory.camera_start(density, self.ratio), 0),
            mi.Float(0),
        ]

    def scatter(self, state, p_forward, p_back, delta, scattered, vertex):
        d_vcm, d_vc = state
        nearer = self._nearer(state, p_back, vertex)
        return [d_vcm, dr.select(delta, d_vc, theory.d_vc_of(nearer, p_forward))]

    @staticmethod
    def depart(state, si, mask):
        return state

    def propagate(self, state, density, si=None, squared=None, depth=None):
        return [dr.select(density > 0, theory.reciprocal(density), 0), state[1]]

    def hit_emitter(self, state, direct, emission, sampled):
        ratio = dr.select(sampled > 0, direct * theory.reciprocal(sampled), 0)
        return theory.hit_emitter(ratio, direct * emission, state[1], self.beta)

    def next_event(self, state, direct, emission, sampled, p_back, delta, vertex):
        ratio = dr.select(delta, 0, sampled * theory.reciprocal(direct))
        nearer = self._nearer(state, p_back, vertex)
        return theory.connection(ratio, 1, emission, nearer, self.beta)

    # ------------------------------------------------------------------ joined sub-paths

    def _nearer(self, state, p_back, vertex):
        return theory.nearer(*state, p_back, self.beta, eta_at(self.merging, vertex))

    def connected(self, connection, camera, light):
        """Weight of a `Connection` of two kept vertices."""
        a_light, a_camera = (
            self._nearer([vertex[name] for name in self.states], back, vertex)
            for vertex, back in (
                (light, connection.back_at_light),
                (camera, connection.back_at_camera),
            )
        )
        return theory.connection(
            connection.density_at_light, a_light, connection.density_at_camera, a_camera, self.beta
        )

    def merged(self, camera, state, back_at_light, back_at_camera):
        """Weight of merging a camera vertex with a light vertex of that `state`. `back_at_light`,
        `back_at_camera`: densities per projected solid angle with which the camera's side goes on
        to the vertex before it, and the light's side to the camera's."""
        a_light = theory.nearer(*state, back_at_light, self.beta)
        a_camera = theory.nearer(camera["d_vcm"], camera["d_vc"], back_at_camera, self.beta)
        return theory.merge_weight(a_light, a_camera, eta_at(self.merging, camera), self.beta)

    def seen_by_sensor(self, connection, light):
        """Weight of a `LensConnection` of a light vertex."""
        state = [light[name] for name in self.states]
        a_light = self._nearer(state, connection.back, light)
        return theory.connection(connection.density * (1 / self.ratio), a_light, 0, 0, self.beta)
