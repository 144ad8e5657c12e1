"""Light sub-paths and the photons they leave."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.records import write_packets
from ..paths.light import trace_light
from ..paths.setting import LightPass, Limits, World
from .photon import new_photons, write_photon


class PhotonVisitor:
    """Stores photons (a `LightVisitor`). Its state is that of `light_state`, if there is one."""

    def __init__(self, capacity, keep_direct, light_state):
        self.keep_direct, self.light_state = keep_direct, light_state
        surface, power = new_photons(capacity)
        self.store = Store(
            surface=surface,
            power=power,
            room=dr.opaque(mi.UInt32, capacity),
            count=dr.zeros(mi.UInt32, 1),
        )
        if light_state is not None:
            self.store.mis_words = light_state.layout.room(capacity)

    def blank(self, lanes):
        return self.begin([])

    def begin(self, state):
        return [] if self.light_state is None else self.light_state.init()

    def arrive(self, state, at, active):
        store = self.store
        if self.light_state is not None:
            straight = active & at.first & ~at.had_delta
            state = self.light_state.first_vertex(state, at.si, at.source, straight)
        keep = active & mi.has_flag(at.bsdf.flags(), mi.BSDFFlags.Smooth)
        keep &= at.scattered | at.had_delta | self.keep_direct
        slot = dr.scatter_inc(store.count, mi.UInt32(0), keep)
        keep &= slot < store.room
        photon = {
            "p": at.si.p,
            "n": at.si.n,
            "towards": at.towards,
            "flux": at.flux,
            "depth": at.depth,
            "caustic": ~at.scattered,
        }
        write_photon(store.surface, store.power, slot, photon, keep)
        if self.light_state is not None:
            write_packets(store.mis_words, self.light_state.words(state), slot, keep)
        return state

    def leave(self, state, at, wo, delta, active):
        if self.light_state is None:
            return state
        return self.light_state.scatter(state, at.si, at.bsdf, wo, active & ~delta)


def trace_light_paths(
    world: World,
    limits: Limits,
    light_pass: LightPass,
    capacity: int,
    keep_direct: bool = False,
    light_state=None,
):
    """Traces the light sub-paths of a pass and stores photons on surfaces that scatter smoothly.

    Stored are photons of two or more segments that have scattered smoothly at least once
    ("indirect"), and photons that have met only delta surfaces on the way from the emitter
    ("caustic"); a photon's first smooth vertex straight from the emitter is next-event estimation's
    business and is stored with `keep_direct` only (of kind "caustic"). A photon's depth is its
    number of segments from the emitter.

    Returns `(surface, power, count)`: the records of `photon.surface_layout` and `power_layout`, in
    no particular order, and the number of photons, of width one. If it exceeds `capacity` the
    surplus is missing: repeat the pass with more room. Shading normals: Veach 1997, section 5.3
    (adjoint factor); where maps perturb normals inside BSDFs, these are evaluated from the camera's
    side instead.

    With a `light_state` (a `mis.state.LightState`) the result has a fourth array: records of its
    `layout`.
    """
    visitor = PhotonVisitor(capacity, keep_direct, light_state)
    trace_light(world, limits, light_pass, visitor)
    store = visitor.store
    photons = store.surface, store.power, store.count
    return photons if light_state is None else (*photons, store.mis_words)
