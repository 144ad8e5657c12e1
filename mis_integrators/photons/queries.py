"""Camera sub-paths that gather photons: direct light on the way, and the vertices at which photons
are to be gathered."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..core.packing import Store, pack_direction
from ..core.power_heuristic import mis_power
from ..core.recording import lanes
from ..core.records import Layout
from ..core.spectra import channel_mean
from ..paths.bent_surfaces import FLAGS
from ..paths.camera import trace_camera, whole_or_nothing
from ..paths.light_classes import class_of, scattered_history, start_of_camera_path
from ..paths.lobes import EVEN, even_bound, even_part
from ..paths.media import direct_light, next_hit_either, next_hit_straight_on
from ..paths.setting import CameraPass, Limits, World
from ..paths.subpaths import selected, smooth_at
from ..paths.vertex import PhaseOrBSDF, Sides
from .beams import FIRST, LEVEL_SHIFT, LONG, SHORT, beam_layout, new_beams
from .disk_walls import coverage_layout
from .hits import chance_layout, new_hits, write_hit
from .points import new_points, point_layout

LAST_VERTEX = 1 << 31
"""Bit of a vertex' depth that says that all photons are wanted there, else only caustic ones."""
EVEN_PART = 1 << 30
"""Bit that says that only the even part of the BSDF scatters those that are not caustic."""
DEPTH = EVEN_PART - 1
"""What a vertex' depth has besides."""
PIXEL_DISK = 0.35
"""Tuned: radius of a `pixel_disk` over the width of a pixel. (With 0.5 the denoised walls of a room
lit through glass have a texture.)"""
BEAMS_KEPT = 0.25
"""Tuned: where photons are joined with the sensor, the share of the beams beyond the first segment
that are kept, and count for all. They take most of the time then, and their noise is each pixel's
own."""
BEAM = 1 << 24
"""Numbers of paths' vertices (see `PathNumbers.at`) that tell which beams are kept begin here."""
NO_VERTEX = 0xFFFFFFFF
"""Place of vertices that are not kept."""
STATE = ("weights.0", "weights.1", "weights.2")
"""What a vertex buffer calls the state of the weights."""


def query_layout():
    """Fields of a camera vertex that waits for photons: the ray that led to it and what it met,
    from which the surface interaction is made again; the path's throughput up to it, its path's
    number, and its depth in segments (with `LAST_VERTEX` and `EVEN_PART`)."""
    return Layout(
        {
            "ray_o": mi.Point3f,
            "path": mi.UInt32,
            "ray_d": mi.Vector3f,
            "depth": mi.UInt32,
            "hit": mi.PreliminaryIntersection3f,
            "throughput": mi.Spectrum,
        }
    )


def query_at(at, last, even=False):
    """The record of `query_layout` of where a camera path has arrived (a `CameraArrival`); `last`:
    whether all photons are wanted there; `even`: all of these for the even part of the BSDF."""
    bits = dr.select(last, mi.UInt32(LAST_VERTEX), 0)
    bits |= dr.select(even, mi.UInt32(LAST_VERTEX | EVEN_PART), 0)
    return {
        "ray_o": at.ray.o,
        "ray_d": at.ray.d,
        "hit": at.hit,
        "throughput": at.throughput,
        "path": at.path,
        "depth": at.depth | bits,
    }


def weight_layout():
    """Fields of the weights there: their `STATE`, and the weight of direct light, `share`."""
    return Layout(dict.fromkeys((*STATE, "share"), mi.Spectrum))


def new_vertex_buffer(capacity, weighted=False, split=False, cones=False, hits=False, edges=False):
    """Room for `capacity` camera vertices, a dictionary: `words` (records of `query_layout`; unused
    ones are zero), if `weighted`, `weights` (records of `weight_layout`), and if light is `split`
    into classes, `first`: whether the path has scattered smoothly nowhere before. With `cones`,
    `pixel`: how wide a pixel is there; 0 where the path has scattered smoothly before, or a lens
    has its focus (`RayCones.pixel_width`). With `hits`, those of lights that are met by chance
    (records of `hits.chance_layout`; zero: none). With `edges`, `coverage`: that of the merge disk
    (records of `disk_walls.coverage_layout`)."""
    buffer = {"words": dr.zeros(mi.UInt32, query_layout().words * capacity)}
    if weighted:
        buffer["weights"] = weight_layout().room(capacity)
    if split:
        buffer["first"] = dr.zeros(mi.Bool, capacity)
    if cones:
        buffer["pixel"] = dr.zeros(mi.Float, capacity)
    if hits:
        buffer["hits"] = new_hits(capacity)
    if edges:
        buffer["coverage"] = dr.zeros(mi.UInt32, coverage_layout().words * capacity)
    return buffer


def read_queries(vertices, first=0, count=None):
    """The vertices of a buffer, or `count` of them from place `first` on: a dictionary of all
    their fields. Unused places have throughput zero; their weights are anything."""
    layout = query_layout()
    index = lanes(layout.capacity(vertices["words"]) if count is None else count)
    if count is not None:
        index += first
    record = layout.read(vertices["words"], index)
    if "weights" in vertices:
        record |= weight_layout().read(vertices["weights"], index)
    if "first" in vertices:
        record["first"] = dr.gather(mi.Bool, vertices["first"], index)
    if "pixel" in vertices:
        record["pixel"] = dr.gather(mi.Float, vertices["pixel"], index)
    if "hits" in vertices:
        record["hits"] = chance_layout().read(vertices["hits"], index)
    return record


def takes_photons(record, kind):
    """Which vertices (fields as of `read_queries`) gather photons of a kind: "seen_caustic" those
    that the camera sees, where a buffer knows these, "caustic" then all others."""
    if kind == "indirect":
        return (record["depth"] & LAST_VERTEX) != 0
    if "pixel" in record:
        return (record["pixel"] > 0) == (kind == "seen_caustic")
    return mi.Bool(True)


def pixel_disk(record):
    """Radii of disks that near pixels hardly share, at vertices that the camera sees (fields as of
    `read_queries`)."""
    return PIXEL_DISK * record["pixel"]


@dataclass(frozen=True, kw_only=True)
class Queries:
    """Where photons are asked for.

    `bdd`: the last smooth camera vertex, counted from 0; `capacity`: vertices that there is room
    for (under weights, in each section); `has_caustics`, `has_indirect`: kinds of photons that
    there are; `one_vertex`: no path asks twice (without weights, the first vertex of each has the
    place of its number, further ones have places beyond these); `beams`: how many beams of each
    kind there is room for (0: none are kept); `narrow`: the `NarrowSurfaces` at which none but
    caustic photons are gathered, but for the even part of their BSDF if it has one, and which the
    `bdd` does not count (None: there are none); `points`: in media, too, photons are asked for at
    vertices (under weights); `cones` (`RayCones`, or None): they tell how wide pixels are at
    vertices that the camera sees;
    `near_zone` (a `NearZone`, or None): volume photons beyond it are joined with the sensor. Then
    photons bring all light of media on the way to the first smooth surface: all segments before it
    have long beams, the first one those within the zone. `meets_lights`: lights that paths meet
    behind delta surfaces are kept with the smooth vertex before, if it is on a surface; `edges`
    (`coverage.Edges`, or None): where merge disks are of no use there are none but caustic photons,
    and the `bdd` does not count the vertex; elsewhere the coverage is kept.
    """

    bdd: int
    capacity: int
    has_caustics: bool
    has_indirect: bool
    one_vertex: bool
    beams: int = 0
    narrow: Any = None
    points: bool = False
    cones: Any = None
    near_zone: Any = None
    meets_lights: bool = False
    edges: Any = None


class QueryVisitor:
    """Direct light, and vertices that wait for photons (a `CameraVisitor`).

    `first` is what emission, and direct light at the first smooth vertex, count, which other paths
    see, too; `beyond` what direct light counts beyond that, if it is not the same.

    Its state, by name: `vertex`, smooth vertices left behind, those passed not counted (the last
    one counts as the `bdd`-th); `met`, whether there was any of these; `behind_delta`, whether the
    last vertex scattered by a delta function; `scatter_pdf`, the density of the last smooth
    scattering; `origin`, the last smooth vertex; `share`, the weight of direct light there;
    `times`, how many times light counts that is found there; `sums`, the state of `weights`;
    `history`, what `classes` carry along; `cone`, with the queries' `cones` the path's; `left`,
    where paths meet lights by chance, the place of the last smooth vertex, the cosine at which they
    left it, and what photons would keep of their flux from here to there; `rest`, where BSDFs are
    parted, the share of light that photons have not brought at the last smooth vertex; `asked`,
    where paths may do so again, whether they have; `clear`, in scenes with media, the share of
    light that has got through these without being scattered; and `wall`, where beams are kept, the
    normal of the surface that the path has left last, zero after a vertex in a medium. The last
    eight are lists.

    In media, paths scatter until they have left `bdd` smooth vertices behind, and go straight on
    from there; where photons are asked for at points, until they have left one more behind. Where
    photons are joined with the sensor, paths go straight on to the first one on a surface, too.
    """

    def __init__(self, world, limits, queries, weights, first, beyond, classes):
        self.scene, self.lights, self.traits = world.scene, world.lights, world.traits
        self.hide_emitters, self.queries, self.weights = limits.hide_emitters, queries, weights
        self.bdd, self.classes = queries.bdd, classes
        self.parts = queries.narrow is not None and queries.narrow.parted
        self.first, self.beyond = first, beyond
        self.sections = 1 if weights is None else self.bdd + 1
        self.asks_again = weights is None and not queries.one_vertex
        self.by_light = weights is not None and weights.weighs_points_of_lights
        self.store = Store(
            vertices=new_vertex_buffer(
                queries.capacity * self.sections,
                weights is not None,
                classes is not None,
                queries.cones is not None,
                queries.meets_lights,
                queries.edges is not None,
            ),
            room=dr.opaque(mi.UInt32, queries.capacity),
            count=dr.zeros(mi.UInt32, self.sections),
        )
        self.flights = self.bdd + queries.points
        self.flies = self.traits.has_media and self.flights > (queries.near_zone is not None)
        # Half transparent boundaries are none for the light that is met beyond the last vertex.
        self.passes_masks = self.traits.has_media and self.traits.has_null_vertices
        self.deepest = limits.max_depth - 1 if limits.max_depth > 0 else None
        self.kinds = [LONG]
        asked_on_the_way = queries.has_caustics or weights is not None
        if self.flies and asked_on_the_way and not queries.points:
            self.kinds.append(SHORT)
        if queries.beams:
            room = len(self.kinds) * queries.beams
            self.store.beams = new_beams(room)
            if weights is not None:
                self.store.beam_weights = weight_layout().room(room)
            self.store.beam_room = dr.opaque(mi.UInt32, queries.beams)
            # One each: what a loop has counted up, no other one can within the same iteration.
            self.store.beam_count = {kind: dr.zeros(mi.UInt32, 1) for kind in self.kinds}
        if queries.points:
            room = queries.capacity * self.sections
            self.store.points = {"words": new_points(room), "weights": weight_layout().room(room)}
            if classes is not None:
                self.store.points["first"] = dr.zeros(mi.Bool, room)
            self.store.point_count = dr.zeros(mi.UInt32, self.sections)

    def begin(self, n_paths, splat, aperture):
        one = mi.Float(1)
        if self.asks_again:  # each path's first vertex has the place of its number
            self.store.count = dr.full(mi.UInt32, n_paths, 1)
        return {
            "vertex": mi.UInt32(0),
            "met": mi.Bool(False),
            "behind_delta": mi.Bool(False),
            "scatter_pdf": one,
            "origin": dr.zeros(mi.Interaction3f),
            "share": mi.Spectrum(1),
            "times": mi.Float(self.first),
            "sums": [] if self.weights is None else self.weights.init(n_paths),
            "history": [] if self.classes is None else start_of_camera_path(),
            "cone": [] if self.queries.cones is None else self.queries.cones.begin(),
            "left": [mi.UInt32(0), one, mi.Spectrum(1)] if self.queries.meets_lights else [],
            "rest": [mi.Spectrum(1)] if self.parts else [],
            "asked": [mi.Bool(False)] if self.asks_again else [],
            "clear": [mi.Spectrum(1)] if self.traits.has_media else [],
            "wall": [mi.Normal3f(0)] if self.queries.beams else [],
        }

    def travel(self, state, ray, flight, numbers, throughput, path, depth, active, unseen):
        brought = throughput * state["rest"][0] if self.parts else throughput
        if self.queries.near_zone is not None:
            kept = numbers.at(BEAM + depth).next_float32() < BEAMS_KEPT
            brought = dr.select(depth == 0, brought, dr.select(kept, brought / BEAMS_KEPT, 0))
        begun = mi.Point3f(ray.o)
        wall = state["wall"][0] if state["wall"] else None
        keep = self._keep_beams(state, brought, path, depth + 1, LONG)
        if self.flies:
            keep_short = None
            if SHORT in self.kinds:
                keep_short = self._keep_beams(state, brought, path, depth + 1, SHORT)
            flies = state["vertex"] < self.flights
            if self.queries.near_zone is not None:
                flies &= state["vertex"] > 0
            hit, ray, flight, kept = next_hit_either(
                self.scene,
                self.traits,
                ray,
                flight,
                numbers,
                throughput,
                keep_short,
                keep,
                flies,
                active,
                unseen,
                wall,
            )
        else:
            hit, ray, flight, kept = next_hit_straight_on(
                self.scene, self.traits, ray, flight, numbers, keep, active, unseen, wall
            )
        state = {**state, "clear": [state["clear"][0] * kept]}
        if self.queries.cones is not None:  # boundaries have been passed on the way
            passed = dr.norm(ray.o - begun)
            cone = self.queries.cones.grown(state["cone"], ray.d, passed, depth == 0, active)
            state["cone"] = cone
        return state, hit, ray, flight, throughput * kept

    def _keep_beams(self, state, throughput, path, depth, kind):
        """What keeps the beams of paths (see `pass_straight`, `fly`): long ones after `bdd` smooth
        vertices, short ones before; with a near zone also long ones before the first vertex."""
        if not self.queries.beams:
            return lambda *piece: None
        vertex = state["vertex"]
        store, wanted = self.store, mi.Bool(True)
        if kind == LONG:
            wanted &= vertex == self.bdd
        zone = self.queries.near_zone
        if zone is not None:
            first = depth == 1
            wanted |= vertex == 0
        if self.deepest is not None:
            wanted &= mi.Int32(depth) <= self.deepest
        depth = depth | mi.UInt32(kind)
        stored = {}
        if self.weights is not None:
            depth |= vertex << LEVEL_SHIFT
            stored = {**self._stored(state), "share": mi.Spectrum(1)}
        if self.classes is not None:
            depth |= dr.select(state["history"][0] == 0, mi.UInt32(FIRST), 0)

        def keep(start, medium, length, kept, walls, mask):
            if zone is not None:
                length = dr.select(first, dr.minimum(length, zone.reach(start)), length)
                mask = mask & (length > 0)
            light = throughput * kept
            mask = mask & wanted & (dr.max(light) > 0)
            slot = dr.scatter_inc(store.beam_count[kind], mi.UInt32(0), mask)
            mask &= slot < store.beam_room
            slot += self.kinds.index(kind) * self.queries.beams
            beam = {
                "o": start.o,
                "d": start.d,
                "length": length,
                "throughput": light,
                "path": path,
                "depth": depth,
                "medium": medium,
                "normal_behind": pack_direction(walls.normal_behind),
                "behind": walls.behind,
                "normal_ahead": pack_direction(walls.normal_ahead),
                "ahead": walls.ahead,
            }
            beam_layout().write(store.beams, beam, slot, mask)
            if stored:
                weight_layout().write(store.beam_weights, stored, slot, mask)

        return keep

    def emission(self, state, at, active):
        met, behind_delta, share_here = state["met"], state["behind_delta"], state["share"]
        origin, scatter_pdf = state["origin"], state["scatter_pdf"]
        ds = mi.DirectionSample3f(self.scene, at.si, origin)
        shown = active & (~met | ~behind_delta)
        if self.hide_emitters:
            shown &= (at.depth > 1) | at.si.is_valid()
        later = shown & met
        light_pdf = self.lights.pdf_direct(origin, ds, later)
        if self.by_light:
            share_here = share_here * self.weights.next_event_weight(
                state["sums"], origin, ds, later
            )
        share = dr.select(met, mis_power(scatter_pdf, light_pdf) * share_here, mi.Spectrum(1))
        kept = mi.Bool(False)
        if self.queries.meets_lights:
            kept = active & met & behind_delta
        emitted = ds.emitter.eval(at.si, shown | kept)
        if self.queries.meets_lights:
            self._keep_hit(state["left"], at, emitted, scatter_pdf, kept)
        light = at.throughput * emitted
        light *= share
        light *= state["times"]
        if self.classes is not None:
            self.classes.add("met", at.path, class_of(*state["history"]), light, shown)
        return dr.select(shown, light, 0)

    def _keep_hit(self, left, at, emitted, scatter_pdf, met):
        """Keeps the light that paths have met behind delta surfaces, `emitted` there, with the
        vertex before these, which they have `left`."""
        slot, cosine, kept = left
        light = at.throughput * emitted
        write_hit(
            self.store.vertices["hits"],
            slot,
            self.lights,
            at.si,
            at.ray,
            light,
            kept * emitted,
            cosine,
            scatter_pdf,
            met & (dr.max(light) > 0) & (slot < self.store.room),
        )

    def unfinished(self, state, at):
        if self.passes_masks:
            return mi.Bool(True)
        unfinished = state["vertex"] <= self.bdd
        if self.queries.meets_lights:
            unfinished |= mi.has_flag(at.bsdf.flags(), mi.BSDFFlags.Delta)
        return unfinished

    def arrive(self, state, at, rng, active):
        vertex, weights, bsdf = state["vertex"], self.weights, at.bsdf
        state, smooth = dict(state), smooth_at(at, active)
        if self.passes_masks or self.queries.meets_lights:
            smooth &= vertex <= self.bdd
        at.ends = vertex >= self.bdd  # the path's last smooth vertex
        at.even = mi.Bool(False)
        if self.queries.narrow is not None:
            at.narrow = self.queries.narrow.at(bsdf, at.si, smooth)
            if self.parts:
                at.parted = at.narrow & self.queries.narrow.has_even_part(bsdf, smooth)
                at.even = at.parted & at.ends
                at.rest = dr.select(smooth, state["rest"][0], 1)
                state["rest"] = selected(smooth, [mi.Spectrum(1)], state["rest"])
                at.throughput = at.throughput * at.rest
                smooth &= dr.max(at.rest) > 0
            at.ends &= ~at.narrow
        if self.queries.edges is not None:
            ends = smooth & (at.ends | at.even)
            at.coverage, at.edge = self.queries.edges.at(self.scene, at, ends)
            at.ends, at.even = at.ends & ~at.edge, at.even & ~at.edge
        if self.beyond is not None:
            # Other paths go straight through media.
            unseen = state["met"] | at.scatters if self.flies else state["met"]
            state["times"] = dr.select(smooth & unseen, self.beyond, state["times"])
        if weights is not None:
            scattering = self._scattering(at)
            state["sums"], share = weights.propagate(
                state["sums"], at.si, scattering, vertex, smooth
            )
            state["share"] = dr.select(smooth, share, state["share"])
            at.ends |= weights.ends(scattering, vertex, smooth)
        if self.queries.cones is not None:
            state["cone"] = self.queries.cones.arrived(state["cone"], at, active)
        direct = mi.Spectrum(0)
        if not self.lights.dark:
            direct = self._direct(state, at, rng, smooth) * state["times"]
            if self.classes is not None:
                number = class_of(state["history"][0] + 1, mi.Bool(False))
                self.classes.add("next_event", at.path, number, direct, smooth)
        at.slot = self._ask_for_photons(state, at, smooth)
        return state, direct

    def _scattering(self, at):
        """What scatters there: a BSDF, or where paths scatter in media a `PhaseOrBSDF`."""
        return PhaseOrBSDF.at(at) if self.flies else at.bsdf

    def _direct(self, state, at, rng, smooth):
        """Radiance of direct light at smooth vertices, by next-event estimation."""
        si, weights, share_here = at.si, self.weights, state["share"]
        if self.traits.has_media:
            sides = Sides.at(si, at.medium)
            ds, light, light_pdf = direct_light(
                self.scene, self.traits, self.lights, si, sides, rng, smooth
            )
        else:
            ds, light, light_pdf = self.lights.sample_direct(si, rng, smooth)
        wo = si.to_local(ds.d)
        reached = smooth & (dr.max(light) > 0)  # elsewhere `ds` may not even be a number
        scattering, lit = self._scattering(at), reached if self.flies else smooth
        response, response_pdf = scattering.eval_pdf(mi.BSDFContext(), si, wo, lit)
        if self.by_light:
            left = weights.scatter(
                state["sums"], si, scattering, mi.BSDFSample3f(wo), state["vertex"], reached
            )
            share_here = share_here * weights.next_event_weight(left, si, ds, reached)
        share = dr.select(ds.delta, 1, mis_power(light_pdf, response_pdf)) * share_here
        return dr.select(smooth, at.throughput * share * response * light, 0)

    def _ask_in_medium(self, state, at, wants):
        """Stores the vertices in media at which photons are to be gathered."""
        store = self.store
        section = dr.select(at.ends, mi.UInt32(self.bdd), state["vertex"])
        slot = dr.scatter_inc(store.point_count, section, wants)
        wants &= slot < store.room
        slot += section * store.room
        point = {
            "p": at.si.p,
            "path": at.path,
            "d": at.ray.d,
            "depth": at.depth,
            "throughput": at.throughput,
            "medium": at.medium,
        }
        point_layout().write(store.points["words"], point, slot, wants)
        weight_layout().write(store.points["weights"], self._stored(state), slot, wants)
        if self.classes is not None:
            dr.scatter(store.points["first"], state["history"][0] == 0, slot, wants)

    def _stored(self, state):
        """What is kept with a vertex for the weights."""
        return {**dict(zip(STATE, self.weights.stored(state["sums"]))), "share": state["share"]}

    def _ask_for_photons(self, state, at, smooth):
        """Stores the vertices at which photons are to be gathered; returns their places."""
        weights, store, queries = self.weights, self.store, self.queries
        last = at.ends | (weights is not None)
        wants = smooth & (dr.max(at.throughput) > 0)
        if queries.points:
            self._ask_in_medium(state, at, wants & at.scatters)
        if self.flies:
            wants &= ~at.scatters
        if not queries.has_caustics:
            wants &= (last | at.even) & queries.has_indirect
        slot = mi.UInt32(at.path)
        if weights is not None:
            section = dr.select(at.ends, mi.UInt32(self.bdd), state["vertex"])
            slot = dr.scatter_inc(store.count, section, wants)
            wants &= slot < store.room
            slot += section * store.room
        elif state["asked"]:
            asked = state["asked"][0]
            further = dr.scatter_inc(store.count, mi.UInt32(0), wants & asked)
            slot = dr.select(asked, further, slot)
            state["asked"] = [asked | wants]
            wants &= slot < store.room
        if not queries.capacity:
            return slot
        query = query_at(at, last, at.even)
        query_layout().write(store.vertices["words"], query, slot, wants)
        if weights is not None:
            weight_layout().write(store.vertices["weights"], self._stored(state), slot, wants)
        if self.classes is not None:
            dr.scatter(store.vertices["first"], state["history"][0] == 0, slot, wants)
        if state["cone"]:
            width = dr.select(state["met"], 0, queries.cones.pixel_width(state["cone"]))
            dr.scatter(store.vertices["pixel"], width, slot, wants)
        if queries.edges is not None:
            share, walls = at.coverage
            record = {**vars(walls), "bare": 1 - share}
            coverage_layout().write(store.vertices["coverage"], record, slot, wants)
        return slot

    def leave(self, state, at, rng, bs, weight, delta, active):
        vertex, state = state["vertex"], dict(state)
        if not self.traits.has_light_surfaces:
            active &= delta | ~at.ends
        if self.queries.meets_lights:
            active &= delta | (vertex <= self.bdd)
        elif self.passes_masks:
            active &= vertex <= self.bdd
        scattered = active & ~delta
        if state["cone"]:
            specular = active & delta & ~state["met"]
            si = at.hit.compute_surface_interaction(at.ray, FLAGS, specular)
            state["cone"] = self.queries.cones.bent(state["cone"], si, at.towards, bs, specular)
        if state["left"]:
            cosine = dr.abs(dr.dot(at.si.n, at.si.to_world(bs.wo)))
            # Light that reaches places in media is that of volume photons alone.
            slot = dr.select(at.scatters, NO_VERTEX, at.slot) if self.flies else at.slot
            now = [slot, cosine, mi.Spectrum(1)]
            *place, kept = state["left"]
            sent = kept * weight * dr.square(bs.eta)  # radiance falls with the squared index
            kept = dr.select(active & delta, sent, kept)
            state["left"] = selected(scattered, now, [*place, kept])
        if self.weights is not None:
            state["sums"] = self.weights.scatter(
                state["sums"], at.si, self._scattering(at), bs, vertex, scattered
            )
        if state["wall"]:
            state["wall"] = selected(active, [at.si.n], state["wall"])  # zero in media
        if state["history"]:
            state["history"] = scattered_history(state["history"], delta, active)
        passed = mi.Bool(False)
        if self.queries.narrow is not None:
            passed = at.narrow & ~at.ends
            if self.parts:
                evenly = (bs.sampled_type & EVEN) != 0
                passed &= ~(at.parted & ~at.even & evenly)
                rest = self._rest(at, rng, bs, weight, scattered)
                state["rest"] = selected(scattered, [rest], state["rest"])
                weight = weight * at.rest
                active &= dr.max(at.rest) > 0
        if self.queries.edges is not None:
            passed = passed | at.edge
        beyond = dr.select(at.ends, mi.UInt32(self.bdd), vertex) + 1
        beyond = dr.select(passed, vertex, beyond)
        state |= {
            "vertex": dr.select(scattered, beyond, vertex),
            "met": state["met"] | scattered,
            "behind_delta": mi.Bool(delta),
            "scatter_pdf": dr.select(scattered, bs.pdf, state["scatter_pdf"]),
            "origin": dr.select(scattered, mi.Interaction3f(at.si), state["origin"]),
        }
        return state, weight, active

    def _rest(self, at, rng, bs, weight, active):
        """The share of the light from where paths go on that photons do not bring, those gathered
        for the even part of the BSDF. By roulette, so that few paths go on for little: it is none,
        or its largest channel one."""
        active = active & at.even
        whole = weight * bs.pdf
        even = even_part(even_bound(at.bsdf, at.si, active), whole, bs.wo)
        share = dr.select(whole > 0, even * dr.rcp(dr.maximum(whole, 1e-30)), 1)
        rest = 1 - dr.clip(mi.Spectrum(share), 0, 1)
        largest = dr.max(rest)
        rest = dr.select(rng.next_float32() < largest, rest * dr.rcp(largest), 0)
        return dr.select(active, rest, 1)

    def cross(self, before, after, crosses):
        passed = {name: after[name] for name in ("cone", "wall", "asked", "rest")}
        return selected(crosses, {**before, **passed}, after)

    def alpha(self, state, visible):
        if not self.traits.has_media:
            return whole_or_nothing(visible)
        return dr.select(visible, 1, 1 - channel_mean(state["clear"][0]))


def trace_camera_paths(
    world: World,
    limits: Limits,
    camera_pass: CameraPass,
    queries: Queries,
    weights=None,
    first=1.0,
    beyond=None,
    classes=None,
):
    """Traces the camera paths of a pass to their `queries.bdd`-th smooth vertex.

    On the way: emission seen directly or through delta surfaces; at every smooth vertex up to the
    `bdd`-th, direct light by next-event estimation combined with BSDF sampling (power heuristic).
    Light that reaches a smooth vertex through delta surfaces belongs to caustic photons and is left
    out; where `queries` say that paths meet lights, that which they have met there is kept with the
    vertex. Delta vertices do not count; a BSDF with both parts is a smooth vertex whose delta part
    goes on. At `queries.narrow` vertices and `queries.edges` there is direct light, but they do not
    count, either.
    Where such a vertex would be the last one, and its BSDF has an even part, photons are gathered
    for that, and what the path finds from the next smooth vertex on counts for the rest of the
    BSDF. Where it would not, it counts if it scatters the path evenly.

    Returns `(radiance, alpha, splat position, vertices, count)`: the vertices at which photons are
    to be gathered, as made by `new_vertex_buffer`, and how many wanted a place in it (width one).

    In media, paths scatter until they have left `bdd` smooth vertices behind, those in media among
    them, with direct light at each. From there they go straight on to the next surface; what light
    they lack is that of volume photons along that way, and of caustic ones along the way before.
    With `weights` all of these count along all of the way: the number of the segment's last vertex,
    and the state of the weights before it, are kept with each beam (`beam_weights`).
    Where `queries` have room for beams, of each kind, `vertices` have two entries more, `beams`
    (see `beams.new_beams`) and `beam_count`, how many of one kind wanted a place. Where they ask at
    `points`, paths scatter once more, and `vertices` have the entry `points`: vertices in media
    (`words`: see `points.new_points`), in sections as those on surfaces, with the same `weights`
    and `first`.

    With `weights` (a `mis.state.MergeState`) all photons are wanted at every smooth vertex, and
    direct light at each is weighted. The vertex buffer is then one section for each smooth vertex
    of the path, of `capacity` each (a path's last vertex in the last section), and `count` has one
    entry for each.

    `first`: what emission, and direct light at the first smooth vertex, count; `beyond` (one a
    path): what direct light counts at later ones, and emission met from there. `classes` (a
    `LightClasses` with the entries `met` and `next_event`): learns the radiance by class; the
    vertex buffer then has what photons' classes need.
    """
    visitor = QueryVisitor(world, limits, queries, weights, first, beyond, classes)
    radiance, alpha, splat = trace_camera(world, limits, camera_pass, visitor)
    store = visitor.store
    if queries.beams:
        count = functools.reduce(dr.maximum, store.beam_count.values())
        store.vertices |= {"beams": store.beams, "beam_count": count}
        if weights is not None:
            store.vertices["beam_weights"] = store.beam_weights
    count = store.count
    if queries.points:
        store.vertices["points"] = store.points
        count = dr.maximum(count, store.point_count)
    return radiance, alpha, splat, store.vertices, count
