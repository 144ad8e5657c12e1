"""Light and camera sub-paths whose smooth vertices are kept, so that they can be joined afterwards.

Vertices of all sub-paths lie in one flat buffer each (`new_vertices`), in no particular order;
`parent` leads from a vertex to the one before it. Delta scattering leaves no vertex, but counts as
a segment; a BSDF with both parts leaves a vertex and its delta part goes on.

What weights must know of a sub-path travels with it as a state, a list of floats: `weights` is a
`mis.state.ConnectionState`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.records import Layout
from .camera import trace_camera, whole_or_nothing, within_crop
from .light import trace_light
from .light_classes import class_of, scattered_history, start_of_camera_path
from .media import direct_light, next_hit
from .sensor import Lens
from .setting import CameraPass, LightPass, Limits, World
from .vertex import Sides, VertexBSDF, facing, in_medium

Array = Any

NO_PARENT = 0xFFFFFFFF
STATES = ("d_vcm", "d_vc")
"""What the buffers call the numbers of a state."""


def vertex_layout(states=STATES):
    """Fields of a kept vertex: position `p`, number of the sub-path `path`, `throughput` (light:
    flux; camera: importance) that arrives, `value` and `density` as of `VertexBSDF`, the state of
    the weights, geometric normal `n`, direction `towards` the vertex before, `depth` in segments,
    shading normal `ns`, `number` among the sub-path's kept vertices."""
    return Layout(
        {
            "p": mi.Point3f,
            "path": mi.UInt32,
            "throughput": mi.Spectrum,
            "density": mi.Float,
            "ns": mi.Vector3f,
            "depth": mi.UInt32,
            "towards": mi.Vector3f,
            "number": mi.UInt32,
            "value": mi.Spectrum,
            "n": mi.Vector3f,
            **dict.fromkeys(states, mi.Float),
        }
    )


def hit_record():
    """The record of what a ray has met, apart from the other fields: few passes read it."""
    return Layout({"hit": mi.PreliminaryIntersection3f})


def media_record():
    """The record of the media on both sides of a vertex (`vertex.Sides`)."""
    return Layout({"above": mi.MediumPtr, "below": mi.MediumPtr})


@dataclass(frozen=True)
class Kept:
    """Kept vertices: their buffer (`new_vertices`), how many there are (width one), and how many
    there is room for."""

    vertices: dict[str, Array]
    count: Array
    capacity: int


def new_vertices(traits, capacity, states=STATES, marked=False):
    """Room for `capacity` vertices, a dictionary: `words` (records of `vertex_layout`), `parent`
    (the place of the vertex before, or `NO_PARENT`), and where surfaces are not all Lambertian
    `hit` (records of `hit_record`), from which the surface interaction is made again;
    with media also `media` (records of `media_record`). Only the places below the count are
    valid.

    If they are `marked`, for the classes of light, also `mark`: of light sub-paths whether what
    they met first scattered by a delta function, of camera sub-paths whether they have scattered
    smoothly nowhere before."""
    buffer = {
        "words": vertex_layout(states).room(capacity),
        "parent": dr.empty(mi.UInt32, capacity),
    }
    if traits.has_rough:
        buffer["hit"] = hit_record().room(capacity)
    if traits.has_media:
        buffer["media"] = media_record().room(capacity)
    if marked:
        buffer["mark"] = dr.zeros(mi.Bool, capacity)
    return buffer


def keep_vertex(store, at, throughput, number, parent, state, keep, mark=None):
    """Writes the vertex at which sub-paths have arrived into the buffer; returns the place (valid
    if there was room for it).

    `at`: a `LightArrival` or `CameraArrival`, with the `vertex_bsdf` there; `state`: by name.
    """
    slot = dr.scatter_inc(store.count, mi.UInt32(0), keep)
    keep = keep & (slot < store.room)
    values = {
        "p": at.si.p,
        "n": at.vertex_bsdf.n,
        "ns": at.vertex_bsdf.ns,
        "towards": at.towards,
        "throughput": throughput,
        "value": at.vertex_bsdf.value,
        "density": at.vertex_bsdf.density,
        "path": at.path,
        "depth": at.depth,
        "number": number,
        **state,
    }
    vertex_layout(tuple(state)).write(store.vertices["words"], values, slot, keep)
    dr.scatter(store.vertices["parent"], parent, slot, keep)
    if "hit" in store.vertices:
        hit_record().write(store.vertices["hit"], {"hit": at.hit}, slot, keep)
    if "media" in store.vertices:
        sides = at.vertex_bsdf.sides
        values = {"above": sides.above, "below": sides.below}
        media_record().write(store.vertices["media"], values, slot, keep)
    if mark is not None:
        dr.scatter(store.vertices["mark"], mark, slot, keep)
    return slot


def read_vertices(vertices, index, active, only=None, states=STATES):
    """The vertices at places `index`, a dictionary of all their fields (or those named in `only`);
    zero on inactive lanes."""
    record = vertex_layout(states).read(vertices["words"], index, active, only)
    if "parent" in vertices and (only is None or "parent" in only):
        record["parent"] = dr.gather(mi.UInt32, vertices["parent"], index, active)
    if "mark" in vertices and (only is None or "mark" in only):
        record["mark"] = dr.gather(mi.Bool, vertices["mark"], index, active)
    if "hit" in vertices and (only is None or "hit" in only):
        record |= hit_record().read(vertices["hit"], index, active)
    if "media" in vertices and (only is None or "media" in only):
        record |= media_record().read(vertices["media"], index, active)
    return record


def on_surfaces(vertices, count, capacity, states=STATES):
    """Those of `count` kept vertices (places without parents) that lie on surfaces, in a buffer of
    their own: `(vertices, count)`. For scenes with media."""
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    record = read_vertices(vertices, index, active, states=states)
    keep = active & ~in_medium(record["n"])
    found = dr.zeros(mi.UInt32, 1)
    slot = dr.scatter_inc(found, mi.UInt32(0), keep)
    dr.eval(slot, found)
    chosen = {"words": vertex_layout(states).room(capacity)}
    vertex_layout(states).write(chosen["words"], record, slot, keep)
    if "mark" in vertices:
        chosen["mark"] = dr.zeros(mi.Bool, capacity)
        dr.scatter(chosen["mark"], record["mark"], slot, keep)
    return chosen, found


def seen_normal(vertex):
    """Geometric normal of vertices, as read by `read_vertices`, on the side that their sub-path
    came from."""
    return dr.mulsign(vertex["n"], dr.dot(vertex["n"], vertex["towards"]))


def selected(mask, yes, no):
    """Element by element, of states that hold lists or dictionaries, too."""
    if isinstance(yes, dict):
        return {name: selected(mask, yes[name], no[name]) for name in yes}
    if isinstance(yes, list):
        return [selected(mask, a, b) for a, b in zip(yes, no)]
    return dr.select(mask, yes, no)


def vertex_bsdf_of(traits, record, wavelengths, active):
    """The `VertexBSDF` of kept vertices, as read by `read_vertices`; without `hit` only where they
    are Lambertian."""
    si = bsdf = None
    if "hit" in record:
        hit, d = record["hit"], -record["towards"]
        hit.shape = dr.select(active, hit.shape, dr.zeros(mi.ShapePtr))
        rough = active & (record["density"] < 0)
        ray = mi.Ray3f(record["p"] - d * hit.t, d, 0, wavelengths)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, rough)
        bsdf = si.bsdf()
    return VertexBSDF(
        traits,
        record["n"],
        record["ns"],
        record["value"],
        record["density"],
        si,
        bsdf,
        sides_of(record, wavelengths) if traits.has_media else None,
    )


def sides_of(record, wavelengths):
    """The `Sides` of kept vertices."""
    return Sides(record["above"], record["below"], record["p"], wavelengths)


def smooth_at(at, active):
    """Where sub-paths have arrived at a smooth vertex: of a surface, or in a medium."""
    smooth = mi.has_flag(at.bsdf.flags(), mi.BSDFFlags.Smooth)
    return active & (smooth if at.scatters is None else smooth | at.scatters)


class VertexVisitor:
    """Keeps the smooth vertices of light sub-paths (a `LightVisitor`).

    Its state, by name: `number`, how many vertices a sub-path has kept; `parent`, the place of the
    last one; `density` of its direction (per solid angle; zero after a delta function); `origin`,
    the last surface's point; `sums`, the state of `weights`; and `mark`, a list: if vertices are
    `marked`, their mark.
    """

    def __init__(self, traits, weights, n_paths, capacity, marked):
        self.traits, self.weights, self.marked = traits, weights, marked
        self.store = Store(
            vertices=new_vertices(traits, capacity, weights.states, marked),
            room=dr.opaque(mi.UInt32, capacity),
            count=dr.zeros(mi.UInt32, 1),
            lengths=dr.zeros(mi.UInt32, n_paths),
        )

    def blank(self, lanes):
        return {
            "number": dr.zeros(mi.UInt32, lanes),
            "parent": dr.full(mi.UInt32, NO_PARENT, lanes),
            "density": dr.zeros(mi.Float, lanes),
            "origin": dr.zeros(mi.Point3f, lanes),
            "sums": self.weights.blank(lanes),
            "mark": self._unmarked(),
        }

    def _unmarked(self):
        return [mi.Bool(False)] if self.marked else []

    def begin(self, state):
        nothing = {"number": mi.UInt32(0), "parent": mi.UInt32(NO_PARENT), "mark": self._unmarked()}
        return {**state, **nothing}

    def arrive(self, state, at, active):
        si, weights, number = at.si, self.weights, state["number"]
        first = active & at.first
        squared = dr.maximum(dr.squared_norm(si.p - state["origin"]), 1e-20)
        arrival = state["density"] * facing(self.traits, si.n, at.towards) * dr.rcp(squared)
        sums = selected(
            first,
            weights.init_light(si, at.source, ~at.had_delta, first, at.sent),
            weights.propagate(state["sums"], arrival, si, squared, at.depth),
        )
        smooth = smooth_at(at, active)
        at.vertex_bsdf = VertexBSDF.at(
            self.traits, si, at.bsdf, smooth, at.medium, self.weights.merging is not None
        )
        slot = keep_vertex(
            self.store,
            at,
            at.flux,
            number,
            state["parent"],
            dict(zip(weights.states, sums)),
            smooth,
            *state["mark"],
        )
        number = dr.select(smooth, number + 1, number)
        dr.scatter(self.store.lengths, number, at.path, smooth)
        parent = dr.select(smooth, slot, state["parent"])
        return {**state, "number": number, "parent": parent, "sums": sums}

    def leave(self, state, at, wo, delta, active):
        si, away, sums = at.si, at.si.to_world(wo), state["sums"]
        value, p_back, p_forward = at.vertex_bsdf.f_and_pdfs(away, at.towards, active & ~delta)
        mean = at.vertex_bsdf.scattered_mean(value, at.towards, active)
        left = self.weights.scatter(sums, p_forward, p_back, delta, mean, at.vertex_bsdf)
        return {
            **state,
            "density": dr.select(delta, 0, p_forward * facing(self.traits, si.n, away)),
            "origin": mi.Point3f(si.p),
            "sums": self.weights.depart(selected(active, left, sums), si, active),
            "mark": [dr.select(at.first, delta, before) for before in state["mark"]],
        }

    def cross(self, before, after, crosses):
        return crossed(before, after, crosses)


def crossed(before, after, crosses):
    """The state of sub-paths that keep vertices, as of `CameraVisitor.cross`: a vertex that one has
    kept stays kept."""
    return selected(crosses, {**before, "number": after["number"]}, after)


def trace_light_subpaths(
    world: World,
    limits: Limits,
    light_pass: LightPass,
    weights,
    capacity: int,
    marked: bool = False,
):
    """Traces the light sub-paths of a pass.

    Returns `(vertices, count, lengths)`: the kept vertices, how many there were (width one; more
    than `capacity`: the surplus is missing), and the number of kept vertices of each path.
    `throughput` is flux through the surface, for one sub-path. `marked`: as of `new_vertices`.
    """
    visitor = VertexVisitor(world.traits, weights, light_pass.count, capacity, marked)
    trace_light(world, limits, light_pass, visitor)
    store = visitor.store
    return store.vertices, store.count, store.lengths


class CameraVertexVisitor:
    """Keeps the smooth vertices of camera sub-paths, and weights the light that they meet and that
    next-event estimation finds (a `CameraVisitor`).

    Its state, by name: `number`, `parent`, `density` and `sums` as of `VertexVisitor`; `origin`,
    the last vertex of whichever kind; and `history`, a list: with `classes` what these carry along.
    """

    def __init__(self, world, limits, sensor, weights, capacity, ledger, shortest, classes):
        self.scene, self.lights, self.traits = world.scene, world.lights, world.traits
        self.film, self.lens = sensor.film(), Lens(sensor)
        self.weights, self.ledger, self.classes = weights, ledger, classes
        self.hide_emitters = limits.hide_emitters
        self.deepest = limits.max_depth - shortest if limits.max_depth > 0 else None
        self.store = Store(
            vertices=new_vertices(self.traits, capacity, weights.states, classes is not None),
            room=dr.opaque(mi.UInt32, capacity),
            count=dr.zeros(mi.UInt32, 1),
        )

    def begin(self, n_paths, splat, aperture):
        self.inside, self.aperture = within_crop(self.film, splat), aperture
        return {
            "number": mi.UInt32(0),
            "parent": mi.UInt32(NO_PARENT),
            "density": mi.Float(0),
            "origin": dr.zeros(mi.Interaction3f),
            "sums": self.weights.blank(n_paths),
            "history": [] if self.classes is None else start_of_camera_path(),
        }

    def travel(self, state, ray, flight, numbers, throughput, path, depth, active, unseen):
        hit = next_hit(self.scene, self.traits, ray, flight, numbers, throughput, active, unseen)
        return state, *hit

    def emission(self, state, at, active):
        lights, origin = self.lights, state["origin"]
        ds = mi.DirectionSample3f(self.scene, at.si, origin)
        shown = active & (ds.emitter != None)  # noqa: E711 (array comparison)
        if self.hide_emitters:
            shown &= at.visible  # what is behind nothing but null surfaces is hidden, too
        later = shown & (at.depth > 1)
        share = self.weights.hit_emitter(
            state["sums"],
            lights.pdf_direct(origin, ds, later),
            lights.emission_over_nee_pdf(origin, ds, later),
            state["density"],
        )
        share = dr.select(later, share, 1)
        light = at.throughput * ds.emitter.eval(at.si, shown)
        if self.ledger is not None:
            self.ledger.hit_emitter(at.path, at.depth, light, share, shown)
        if self.classes is not None:
            self.classes.add("met", at.path, class_of(*state["history"]), light * share, shown)
        return dr.select(shown, light * share, 0)

    def unfinished(self, state, at):
        return mi.Bool(True)

    def arrive(self, state, at, rng, active):
        si, weights, history = at.si, self.weights, state["history"]
        number, parent = state["number"], state["parent"]
        smooth = smooth_at(at, active)
        cosine = facing(self.traits, si.n, at.towards)
        first = active & (at.depth == 1)
        of_rays = mi.Float(0)
        if self.lens.connects:
            seen = first & self.inside
            of_rays = cosine * self.lens.density(si.p, si.time, self.aperture, seen)
        squared = dr.maximum(dr.squared_norm(si.p - state["origin"].p), 1e-20)
        arrival = state["density"] * cosine * dr.rcp(squared)
        sums = selected(
            first,
            weights.init_camera(of_rays, first),
            weights.propagate(state["sums"], arrival, si, squared, at.depth),
        )
        at.vertex_bsdf = VertexBSDF.at(
            self.traits, si, at.bsdf, smooth, at.medium, self.weights.merging is not None
        )
        direct = mi.Spectrum(0)
        if not self.lights.dark:
            direct = self._direct(sums, at, rng, smooth)
            if self.classes is not None:
                kind = class_of(history[0] + 1, mi.Bool(False))
                self.classes.add("next_event", at.path, kind, direct, smooth)
        wanted = smooth & (dr.max(at.throughput) > 0)
        if self.deepest is not None:
            wanted &= mi.Int32(at.depth) <= self.deepest
        mark = [history[0] == 0] if history else []
        weighed = dict(zip(weights.states, sums))
        slot = keep_vertex(self.store, at, at.throughput, number, parent, weighed, wanted, *mark)
        number = dr.select(wanted, number + 1, number)
        parent = dr.select(wanted, slot, parent)
        return {**state, "number": number, "parent": parent, "sums": sums}, direct

    def _direct(self, sums, at, rng, smooth):
        """Radiance of direct light at smooth vertices, by next-event estimation."""
        si, lights = at.si, self.lights
        if self.traits.has_media:
            ds, light, light_pdf = direct_light(
                self.scene, self.traits, lights, si, at.vertex_bsdf.sides, rng, smooth
            )
        else:
            ds, light, light_pdf = lights.sample_direct(si, rng, smooth)
        reached = smooth & (dr.max(light) > 0)
        # elsewhere the direction may not even be a number
        direction = dr.select(reached, ds.d, mi.Vector3f(0, 0, 1))
        response, p_camera, p_light = at.vertex_bsdf.f_and_pdfs(at.towards, direction, reached)
        cosine = facing(self.traits, si.n, direction)
        share = self.weights.next_event(
            sums,
            light_pdf,
            cosine * lights.emission_over_nee_pdf(si, ds, reached),
            p_camera * cosine,
            p_light,
            ds.delta,
            at.vertex_bsdf,
        )
        light = at.throughput * response * light
        if self.ledger is not None:
            self.ledger.next_event(at.path, at.depth + 1, light, share, reached)
        return dr.select(reached, light * share, 0)

    def leave(self, state, at, rng, bs, weight, delta, active):
        si, wo, sums = at.si, at.si.to_world(bs.wo), state["sums"]
        value, p_forward, p_back = at.vertex_bsdf.f_and_pdfs(at.towards, wo, active & ~delta)
        mean = at.vertex_bsdf.scattered_mean(value, wo, active)
        left = self.weights.scatter(sums, p_forward, p_back, delta, mean, at.vertex_bsdf)
        history = state["history"]
        state = {
            **state,
            "density": dr.select(delta, 0, p_forward * facing(self.traits, si.n, wo)),
            "origin": mi.Interaction3f(si),
            "sums": selected(active, left, sums),
            "history": scattered_history(history, delta, active) if history else [],
        }
        return state, weight, active

    def cross(self, before, after, crosses):
        return crossed(before, after, crosses)

    def alpha(self, state, visible):
        return whole_or_nothing(visible)


def trace_camera_subpaths(
    world: World,
    limits: Limits,
    camera_pass: CameraPass,
    weights,
    capacity: int,
    ledger=None,
    shortest: int = 2,
    classes=None,
):
    """Traces the camera paths of a pass, with the light that they meet and that next-event
    estimation finds at each smooth vertex, weighted.

    Returns `(radiance, alpha, splat position, vertices, count)`: the kept vertices are those
    that a light sub-path, of at least `shortest` segments with what joins the two, may be
    joined with; `count` as in `trace_light_subpaths`. `ledger`, if given, learns every
    contribution (`integrators.pyramid`): `hit_emitter(path, depth, value, share, mask)` and
    `next_event(...)`, with the length of the joint path in segments, and the weight apart.
    `classes` (a `LightClasses` with the entries `met` and `next_event`): learns the radiance by
    class; the vertices are then marked.
    """
    visitor = CameraVertexVisitor(
        world, limits, camera_pass.sensor, weights, capacity, ledger, shortest, classes
    )
    radiance, alpha, splat = trace_camera(world, limits, camera_pass, visitor)
    return radiance, alpha, splat, visitor.store.vertices, visitor.store.count
