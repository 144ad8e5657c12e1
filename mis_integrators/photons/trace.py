"""Light sub-paths and the photons they leave."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.records import write_packets
from ..paths.light import trace_light
from ..paths.setting import LightPass, Limits, World
from ..paths.subpaths import selected
from ..paths.vertex import PhaseOrBSDF
from .photon import new_photons, write_photon
from .volume import new_volume_photons, write_volume_photon


class PhotonVisitor:
    """Stores photons (a `LightVisitor`). Its state is that of `light_state`, if there is one, and
    if they are `marked`, whether what a sub-path met first scattered by a delta function. In scenes
    with media there is room for `volume_capacity` volume photons."""

    def __init__(self, capacity, keep_direct, light_state, marked, volume_capacity):
        self.keep_direct, self.light_state, self.marked = keep_direct, light_state, marked
        self.in_media = light_state is not None and light_state.in_media
        surface, power = new_photons(capacity)
        self.store = Store(
            surface=surface,
            power=power,
            room=dr.opaque(mi.UInt32, capacity),
            count=dr.zeros(mi.UInt32, 1),
        )
        if light_state is not None:
            self.store.mis_words = light_state.layout.room(capacity)
        if volume_capacity:
            self.store.place, self.store.volume_power = new_volume_photons(volume_capacity)
            self.store.volume_room = dr.opaque(mi.UInt32, volume_capacity)
            self.store.volume_count = dr.zeros(mi.UInt32, 1)
            if self.in_media:
                self.store.volume_mis_words = light_state.layout.room(volume_capacity)

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
        if at.scatters is not None:
            self._leave_in_medium(sums, mark, at, active & at.scatters)
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

    def _leave_in_medium(self, sums, mark, at, keep):
        """Stores volume photons."""
        store = self.store
        slot = dr.scatter_inc(store.volume_count, mi.UInt32(0), keep)
        keep &= slot < store.volume_room
        photon = {
            "p": at.si.p,
            "towards": at.towards,
            "flux": at.flux,
            "depth": at.depth,
            "caustic": at.had_delta & ~at.scattered,
            "medium": at.medium,
        }
        if self.marked:
            photon["delta_at_light"] = mark[0]
        write_volume_photon(store.place, store.volume_power, slot, photon, keep)
        if self.in_media:
            words = self.light_state.volume_words(sums)
            write_packets(store.volume_mis_words, words, slot, keep)

    def leave(self, state, at, wo, delta, active):
        sums, mark = state
        if self.light_state is not None:
            sums = self.light_state.scatter(sums, at.si, PhaseOrBSDF.at(at), wo, active & ~delta)
        return [sums, [dr.select(at.first, delta, before) for before in mark]]

    def cross(self, before, after, crosses):
        return selected(crosses, before, after)


def trace_light_paths(
    world: World,
    limits: Limits,
    light_pass: LightPass,
    capacity: int,
    keep_direct: bool = False,
    light_state=None,
    marked: bool = False,
    volume_capacity: int = 0,
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

    In scenes with media, which need a `volume_capacity`, the last element of the result is a tuple
    of its own, of the photons in media: all places where sub-paths scatter there, the first one
    included. It is `(place, power, count)`, see `volume.new_volume_photons`, and with a
    `light_state` for photons `in_media` what `volume_words` of that returns for each, as records of
    its `layout`.
    """
    visitor = PhotonVisitor(capacity, keep_direct, light_state, marked, volume_capacity)
    trace_light(world, limits, light_pass, visitor)
    store = visitor.store
    photons = store.surface, store.power, store.count
    if light_state is not None:
        photons = *photons, store.mis_words
    if volume_capacity:
        in_media = store.place, store.volume_power, store.volume_count
        if visitor.in_media:
            in_media = *in_media, store.volume_mis_words
        photons = *photons, in_media
    return photons
