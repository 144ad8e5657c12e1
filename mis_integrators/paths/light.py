"""The tracer of light sub-paths: one loop, for photons as for vertices that are joined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from ..core.random import next_1d_and_2d
from ..core.traits import lookup
from .media import begin_flights, interaction_at, medium_behind, next_hit, sample_phase
from .perturbed import sample_perturbed
from .roulette import russian_roulette
from .setting import LightPass, Limits, World

Array = State = Any

PATHS_PER_LANE = 8
"""Tuned: light sub-paths that a SIMD lane of a CPU traces one after the other: a lane whose path
has ended starts the next at once, instead of waiting for the longest path beside it. (A GPU needs
the paths side by side.)"""


def lane_count(n_paths):
    """Lanes that trace so many light sub-paths."""
    return (
        -(-n_paths // PATHS_PER_LANE) if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else n_paths
    )


def scatter_light(traits, si, bsdf, rng, active, medium=None, scatters=None):
    """Samples where a light sub-path goes on from a surface, or, where it `scatters`, in a medium.

    Returns `(bs, delta, weight, wo, active)`: Mitsuba's BSDF sample, whether a delta function
    scattered, the flux's factor, the direction in world space, and the paths that go on: those end
    for which shading and geometric normal disagree about the side. The factor includes the adjoint
    one of shading normals (Veach 1997, section 5.3).
    """
    if traits.has_media:
        within = active & scatters
        active = active & ~within
    if traits.has_perturbed:
        perturbed = lookup(traits.perturbed, bsdf, mi.Bool, active)
        bs, delta, weight = sample_perturbed(bsdf, si, rng, perturbed, active)
    else:
        context = mi.BSDFContext(mi.TransportMode.Importance)
        bs, weight = bsdf.sample(context, si, *next_1d_and_2d(rng, active), active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    if traits.has_media:
        bs, weight = sample_phase(traits, medium, si, *next_1d_and_2d(rng), bs, weight, within)
        delta &= ~within
    wo = si.to_world(bs.wo)
    wi_shading, wo_shading = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo)
    wi_geometric, wo_geometric = dr.dot(si.n, si.to_world(si.wi)), dr.dot(si.n, wo)
    active = active & (wi_geometric * wi_shading > 0) & (wo_geometric * wo_shading > 0)
    adjoint = dr.abs(wi_shading * wo_geometric / (wo_shading * wi_geometric))
    if traits.has_perturbed:
        adjoint = dr.select(perturbed, dr.abs(wo_geometric / wi_geometric), adjoint)
    if traits.has_media:
        adjoint, active = dr.select(within, 1, adjoint), active | within
    return bs, delta, weight * adjoint, wo, active


@dataclass
class LightArrival:
    """Light sub-paths at a surface, one a lane.

    `si`, `hit`: the interaction, and what it is computed from; `bsdf`: of the surface; `towards`:
    unit vector to where the sub-path came from; `flux` [W] that one sub-path carries; `path`: its
    number; `depth`: segments so far; `first`: no surface was met before; `source`: the point of
    the light, valid where `first`; `had_delta`: met a delta surface, or started out of reach of
    next-event estimation; `scattered`: met a smooth surface; `sent`: the flux with which it
    started, valid where `first`. In scenes with media, `medium`: the one that it comes through, and
    `scatters`: it scatters there, at no surface (`interaction_at`).
    """

    si: mi.SurfaceInteraction3f
    hit: mi.PreliminaryIntersection3f
    bsdf: mi.BSDFPtr
    towards: mi.Vector3f
    flux: mi.Spectrum
    path: mi.UInt32
    depth: mi.UInt32
    first: mi.Bool
    source: mi.DirectionSample3f
    had_delta: mi.Bool
    scattered: mi.Bool
    sent: mi.Spectrum
    medium: Any = None
    scatters: Any = None


class LightVisitor(Protocol):
    """What is done at the surfaces that light sub-paths meet. Its state, arrays in lists or
    dictionaries, travels with them."""

    def blank(self, lanes: int) -> State:
        """The state before any sub-path."""

    def begin(self, state: State) -> State:
        """The state of a sub-path that starts."""

    def arrive(self, state: State, at: LightArrival, active: Array) -> State:
        """The state at a surface; here photons and vertices are stored."""

    def leave(
        self, state: State, at: LightArrival, wo: Array, delta: Array, active: Array
    ) -> State:
        """The state after scattering into the local direction `wo`, by a delta function or not."""

    def cross(self, before: State, after: State, crosses: Array) -> State:
        """As of `CameraVisitor`."""


@dr.syntax
def trace_light(world: World, limits: Limits, light_pass: LightPass, visitor: LightVisitor):
    """Traces the light sub-paths of a pass and shows each surface that they meet to the `visitor`,
    which stores what is to be kept.

    A sub-path goes on only where another segment and one to the camera fit into
    `limits.max_depth`. Shading normals: Veach 1997, section 5.3.
    """
    # What the loop reads must be plain variables: Dr.Jit would take a dataclass for its state.
    scene, lights, traits = world.scene, world.lights, world.traits
    max_depth, rr_depth = limits.max_depth, limits.rr_depth
    wavelengths = light_pass.wavelengths
    shutter_open, shutter_time = light_pass.shutter_open, light_pass.shutter_time
    lanes = lane_count(light_pass.count)
    lane = dr.arange(mi.UInt32, lanes)
    sequence, first = light_pass.sequence, mi.UInt32(light_pass.first)
    count, stride = dr.opaque(mi.UInt32, light_pass.count), dr.opaque(mi.UInt32, lanes)
    next_path = mi.UInt32(lane)
    path = mi.UInt32(lane)
    ray = dr.zeros(mi.Ray3f, lanes)
    flux = dr.zeros(mi.Spectrum, lanes)
    strength = dr.zeros(mi.Float, lanes)  # for roulette: one over the flux at the start
    had_delta = dr.full(mi.Bool, False, lanes)
    scattered = dr.full(mi.Bool, False, lanes)
    depth = dr.zeros(mi.UInt32, lanes)
    state = visitor.blank(lanes)
    active = dr.full(mi.Bool, False, lanes)
    flight = begin_flights(traits, None)
    # Where it comes from, until it scatters first: it may pass surfaces before.
    start = []
    if traits.has_media:
        start = [dr.zeros(mi.DirectionSample3f), dr.zeros(mi.Spectrum), mi.Bool(False)]

    while dr.hint(active | (next_path < count), label="light sub-paths"):
        # ---- Start the lane's next path where one has ended
        begin = ~active & (next_path < count)
        source = dr.zeros(mi.DirectionSample3f)
        if begin:
            rng = sequence.of_paths(first + next_path).at(0)
            time = mi.Float(shutter_open)
            if dr.hint(shutter_time > 0, mode="scalar"):
                time += rng.next_float32() * shutter_time
            ray, flux, had_delta, source = lights.sample_emission(rng, time, wavelengths)
            strength = dr.rcp(dr.maximum(dr.max(flux), 1e-38))
            scattered = mi.Bool(False)
            depth = mi.UInt32(0)
            state = visitor.begin(state)
            active = dr.max(flux) > 0
            path = mi.UInt32(next_path)
            next_path += stride
            if dr.hint(traits.has_media, mode="scalar"):
                flight = begin_flights(traits, lights.medium_at(source.emitter))
                start = [source, mi.Spectrum(flux), mi.Bool(True)]

        # ---- Arrive
        depth += 1
        numbers = sequence.of_paths(first + path)
        sent = flux
        if dr.hint(traits.has_media, mode="scalar"):
            hit, ray, flight, flux = next_hit(scene, traits, ray, flight, numbers, flux, active)
            medium, event, scatters = flight
            active &= hit.is_valid() | scatters
            si = interaction_at(hit, ray, scatters, active)
            rng = numbers.at(event)
            source, sent, fresh = start
        else:
            medium = scatters = None
            hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            active &= hit.is_valid()
            si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active=active)
            rng = numbers.at(depth)
            fresh = begin
        before, arrived = state, mi.Bool(active)
        at = LightArrival(
            si,
            hit,
            si.bsdf(ray),
            -ray.d,
            flux,
            path,
            depth,
            fresh,
            source,
            had_delta,
            scattered,
            sent,
            medium,
            scatters,
        )
        state = visitor.arrive(state, at, active)

        # ---- Go on: the next surface needs one more segment, and the sensor one after it
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth + 2 <= max_depth
        begun = depth >= rr_depth
        if dr.hint(traits.has_media, mode="scalar"):
            bs, delta, weight, wo, arrived = scatter_light(
                traits, si, at.bsdf, rng, arrived, medium, scatters
            )
            crosses = arrived & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            active &= arrived & ~crosses
            state = visitor.leave(state, at, bs.wo, delta, active)
            state = visitor.cross(before, state, crosses)
            had_delta |= delta & ~crosses
            scattered |= ~delta
            depth -= dr.select(crosses, mi.UInt32(1), mi.UInt32(0))
            active |= crosses
            begun &= ~crosses
            start = [source, sent, fresh & crosses]
            flight = [medium_behind(si, medium, wo, active), event, scatters]
        else:
            bs, delta, weight, wo, active = scatter_light(traits, si, at.bsdf, rng, active)
            state = visitor.leave(state, at, bs.wo, delta, active)
            had_delta |= delta
            scattered |= ~delta
        flux *= weight
        ray = si.spawn_ray(wo)
        flux, active = russian_roulette(rng, flux, dr.max(flux) * strength, 1, begun, active)
