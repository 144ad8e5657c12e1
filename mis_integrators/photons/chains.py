"""Sub-paths whose smooth vertices are kept as chains: each has a link to the one before it.

What a weight must know of a path's vertices is computed after tracing, over flat arrays of these
vertices, and not in a path loop. Camera sub-paths leave the vertices at which photons are gathered,
with the light of next-event estimation apart, to be weighted later. Light sub-paths leave photons,
each with the vertex that it comes from, seen from where it landed.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.records import Layout
from ..core.spectra import channel_mean
from ..paths.camera import trace_camera
from ..paths.light import trace_light
from ..paths.vertex import f_and_p
from .queries import LAST_VERTEX, Queries, QueryVisitor, query_at, query_layout
from .trace import PhotonVisitor

NONE = (1 << 32) - 1
"""Place of a vertex that does not exist."""


def link_layout():
    """Fields of a link. Of a camera vertex: `before`, the place of the vertex before it, and BSDF
    `f` (mean over the channels) and density `p` with which the camera path scattered there, per
    projected solid angle. Of a photon: `before`, the place of the photon that landed where this one
    comes from, and `f`, `p` there, of a camera path that goes on to where that one comes from."""
    return Layout({"before": mi.UInt32, "f": mi.Float, "p": mi.Float})


def mean_f_and_p(si, bsdf, wo, mask):
    """`paths.vertex.f_and_p`, the BSDF's mean over the channels; zero but for the lanes `mask`."""
    value, pdf = f_and_p(si, bsdf, wo, mask)
    return dr.select(mask, channel_mean(value), 0), dr.select(mask, pdf, 0)


# ---------------------------------------------------------------- camera sub-paths


@dataclass
class CameraChains:
    """Vertices of camera sub-paths, in sections of `capacity` places, one for each number of a
    vertex on its path.

    `words`: records of `queries.query_layout`, zero in places that are not used; `links`: records
    of `link_layout`; `met`, `found`: radiance that a path brings from its vertex by emission that
    it meets next and by next-event estimation (spectra), throughput included; `count`: vertices
    that wanted a place in each section.
    """

    capacity: int
    words: mi.UInt32
    links: mi.UInt32
    met: mi.Spectrum
    found: mi.Spectrum
    count: mi.UInt32

    def section(self, number):
        """Places of the vertices with a number."""
        return dr.arange(mi.UInt32, self.capacity) + number * self.capacity

    def record(self, place, active=True):
        """Vertices at these places: the fields of `query_layout` (throughput zero: none)."""
        return query_layout().read(self.words, place, active)

    def link(self, place, active=True):
        """Links of the vertices at these places."""
        return link_layout().read(self.links, place, active)

    def light(self, place, active=True):
        """Direct light at the vertices at these places."""
        met, found = (dr.gather(mi.Spectrum, x, place, active) for x in (self.met, self.found))
        return met + found


class ChainVisitor(QueryVisitor):
    """Stores camera vertices up to number `last` as `CameraChains`. Direct light at vertices beyond
    number `first` is kept with them, and does not count for the path's radiance.

    Its state: that of a `QueryVisitor`, and the `link`: the place of the last vertex that scattered
    smoothly, the place of this one, and `f` and `p` of that scattering."""

    def __init__(self, world, limits, first, last, capacity, beyond):
        queries = Queries(
            bdd=last, capacity=0, has_caustics=True, has_indirect=True, one_vertex=True
        )
        super().__init__(world, limits, queries, None, 1.0, beyond, None)
        self.kept_to, self.capacity, room = first, capacity, capacity * (last + 1)
        self.store = Store(
            words=dr.zeros(mi.UInt32, query_layout().words * room),
            links=link_layout().room(room),
            met=dr.zeros(mi.Spectrum, room),
            found=dr.zeros(mi.Spectrum, room),
            count=dr.zeros(mi.UInt32, last + 1),
        )

    def begin(self, n_paths, splat, aperture):
        link = [mi.UInt32(NONE), mi.UInt32(NONE), mi.Float(0), mi.Float(0)]
        return {**super().begin(n_paths, splat, aperture), "link": link}

    def emission(self, state, at, active):
        before = state["link"][0]
        light = super().emission(state, at, active)
        apart = active & (state["vertex"] > self.kept_to + 1) & (before != NONE)
        dr.scatter(self.store.met, light, before, apart & (dr.max(light) > 0))
        return dr.select(apart, 0, light)

    def arrive(self, state, at, rng, active):
        before, _, f, p = state["link"]
        number = state["vertex"]
        state, direct = super().arrive(state, at, rng, active)
        smooth = active & mi.has_flag(at.bsdf.flags(), mi.BSDFFlags.Smooth)
        wants = smooth & (dr.max(at.throughput) > 0)
        here = dr.scatter_inc(self.store.count, number, wants)
        wants &= here < self.capacity
        here += number * self.capacity
        query_layout().write(self.store.words, query_at(at, mi.Bool(True)), here, wants)
        link = {"before": before, "f": f, "p": p}
        link_layout().write(self.store.links, link, here, wants)
        apart = number > self.kept_to
        dr.scatter(self.store.found, direct, here, wants & apart)
        here = dr.select(wants, here, mi.UInt32(NONE))
        return {**state, "link": [before, here, f, p]}, dr.select(apart, 0, direct)

    def _ask_for_photons(self, state, at, smooth):
        """All vertices are stored, see `arrive`."""

    def leave(self, state, at, rng, bs, weight, delta, active):
        before, here, f, p = state["link"]
        scattered = active & ~delta
        new_f, new_p = mean_f_and_p(at.si, at.bsdf, bs.wo, scattered)
        state, weight, active = super().leave(state, at, rng, bs, weight, delta, active)
        link = [
            dr.select(scattered, here, before),
            here,
            dr.select(scattered, new_f, f),
            dr.select(scattered, new_p, p),
        ]
        return {**state, "link": link}, weight, active


def trace_camera_chains(world, limits, camera_pass, first, last, capacity, beyond=None):
    """Traces the camera paths of a pass to their smooth vertex of number `last`.

    Direct light and emission as in `queries.trace_camera_paths`, but direct light at vertices
    beyond number `first` is left to the caller. Returns `(radiance, alpha, splat position,
    CameraChains)`."""
    visitor = ChainVisitor(world, limits, first, last, capacity, beyond)
    radiance, alpha, splat = trace_camera(world, limits, camera_pass, visitor)
    store = visitor.store
    chains = CameraChains(capacity, store.words, store.links, store.met, store.found, store.count)
    return radiance, alpha, splat, chains


# ---------------------------------------------------------------- light sub-paths


@dataclass
class PhotonChains:
    """Photons and where they come from, in the order in which light sub-paths have left them.

    `surface`, `power`, `count`: as of `trace.trace_light_paths`; `words`: for each photon the
    vertex that last scattered it smoothly, seen from where it goes on to the photon, as a record of
    `queries.query_layout` (throughput zero: it comes straight from a light); `links`: records of
    `link_layout`."""

    surface: mi.UInt32
    power: mi.UInt32
    count: mi.UInt32
    words: mi.UInt32
    links: mi.UInt32

    def record(self, place, active=True):
        """The vertices that photons come from."""
        return query_layout().read(self.words, place, active)

    def link(self, place, active=True):
        """Links of photons."""
        return link_layout().read(self.links, place, active)


class ChainedPhotonVisitor(PhotonVisitor):
    """Stores photons as `PhotonChains`.

    Its state: the vertex that has last scattered smoothly (a ray that meets it from where the
    sub-path goes on, what it meets, and whether there is one), the place of the photon there, and
    `f` and `p` there; the place of the photon at this surface."""

    def __init__(self, capacity, keep_direct):
        super().__init__(capacity, keep_direct, None, False, 0)
        self.store.words = dr.zeros(mi.UInt32, query_layout().words * capacity)
        self.store.links = link_layout().room(capacity)

    def begin(self, state):
        ray = [mi.Point3f(0), mi.Vector3f(0, 0, 1)]
        hit = dr.zeros(mi.PreliminaryIntersection3f)
        link = [mi.UInt32(NONE), mi.Float(0), mi.Float(0)]
        return [ray, hit, mi.Bool(False), link, mi.UInt32(NONE)]

    def arrive(self, state, at, active):
        (o, d), hit, exists, (before, f, p), _ = state
        slot, keep = self.keep(at, [], active)
        vertex = {
            "ray_o": o,
            "ray_d": d,
            "hit": hit,
            "throughput": dr.select(exists, mi.Spectrum(1), 0),
            "path": at.path,
            "depth": mi.UInt32(LAST_VERTEX),
        }
        query_layout().write(self.store.words, vertex, slot, keep)
        link_layout().write(self.store.links, {"before": before, "f": f, "p": p}, slot, keep)
        return [[o, d], hit, exists, [before, f, p], dr.select(keep, slot, mi.UInt32(NONE))]

    def leave(self, state, at, wo, delta, active):
        (o, d), hit, exists, (before, f, p), here = state
        scattered = active & ~delta
        view = mi.SurfaceInteraction3f(at.si)
        view.wi = mi.Vector3f(wo)
        new_f, new_p = mean_f_and_p(view, at.bsdf, at.si.wi, scattered)
        # A ray from the other side, as long as the one that led here.
        towards = at.si.to_world(wo)
        length = dr.select(scattered, at.hit.t, 1)
        new_hit = mi.PreliminaryIntersection3f(at.hit)
        new_hit.t = length
        ray = [
            dr.select(scattered, at.si.p + length * towards, o),
            dr.select(scattered, mi.Vector3f(-towards), d),
        ]
        link = [
            dr.select(scattered, dr.select(exists, here, mi.UInt32(NONE)), before),
            dr.select(scattered, new_f, f),
            dr.select(scattered, new_p, p),
        ]
        return [ray, dr.select(scattered, new_hit, hit), exists | scattered, link, here]


def trace_photon_chains(world, limits, light_pass, capacity, keep_direct=False):
    """Traces the light sub-paths of a pass: `PhotonChains`. Which photons are kept: as in
    `trace.trace_light_paths`. If `count` exceeds `capacity` the surplus is missing: repeat the pass
    with more room."""
    visitor = ChainedPhotonVisitor(capacity, keep_direct)
    trace_light(world, limits, light_pass, visitor)
    store = visitor.store
    return PhotonChains(store.surface, store.power, store.count, store.words, store.links)
