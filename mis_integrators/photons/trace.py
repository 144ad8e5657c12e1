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
    """Stores photons (a `LightVisitor`). Its state is that of `light_state`, if there is one, and
    if they are `marked`, whether what a sub-path met first scattered by a delta function."""

    def __init__(self, capacity, keep_direct, light_state, marked):
        self.keep_direct, self.light_state, self.marked = keep_direct, light_state, marked
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
        sums = [] if self.light_state is None else self.light_state.init()
        return [sums, [mi.Bool(False)] if self.marked else []]

    def arrive(self, state, at, active):
        sums, mark = state
        if self.light_state is not None:
            straight = active & at.first & ~at.had_delta
            sums = self.light_state.first_vertex(sums, at.si, at.source, straight)
        slot, keep = self.keep(at, mark, active)
        if self.light_state is not None:
            words = self.light_state.words(sums)
            write_packets(self.store.mis_words, words, slot, keep)
        return [sums, mark]

    def keep(self, at, mark, active):
        """Stores the photons that are to be kept: their places, and which they are."""
        store = self.store
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
        if self.marked:
            photon["delta_at_light"] = mark[0]
        write_photon(store.surface, store.power, slot, photon, keep)
        return slot, keep

    def leave(self, state, at, wo, delta, active):
        sums, mark = state
        if self.light_state is not None:
            sums = self.light_state.scatter(sums, at.si, at.bsdf, wo, active & ~delta)
        return [sums, [dr.select(at.first, delta, before) for before in mark]]


def trace_light_paths(
    world: World,
    limits: Limits,
    light_pass: LightPass,
    capacity: int,
    keep_direct: bool = False,
    light_state=None,
    marked: bool = False,
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
    `layout`. If they are to be `marked`, their flux is, see `photon.write_photon`.
    """
    visitor = PhotonVisitor(capacity, keep_direct, light_state, marked)
    trace_light(world, limits, light_pass, visitor)
    store = visitor.store
    photons = store.surface, store.power, store.count
    return photons if light_state is None else (*photons, store.mis_words)
