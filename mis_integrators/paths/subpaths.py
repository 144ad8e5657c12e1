"""Light and camera sub-paths whose smooth vertices are kept, so that they can be joined afterwards.

Vertices of all sub-paths lie in one flat buffer each (`new_vertices`), in no particular order;
`parent` leads from a vertex to the one before it. Delta scattering leaves no vertex, but counts as
a segment; a BSDF with both parts leaves a vertex and its delta part goes on.

What weights must know of a sub-path travels with it as a state, a list of floats: `weights` is a
`mis.state.ConnectionState`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.random import next_2d
from ..core.records import Layout
from .camera_pass import behind_emitters, start_camera_paths, with_gaps, within_crop
from .light import trace_light
from .roulette import russian_roulette
from .sensor import Lens
from .vertex import VertexBSDF, scattered_mean

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


def new_vertices(traits, capacity, states=STATES):
    """Room for `capacity` vertices, a dictionary: `words` (records of `vertex_layout`), `parent`
    (the place of the vertex before, or `NO_PARENT`), and where surfaces are not all Lambertian
    `hit`, from which the surface interaction is made again. Only the places below the count are
    valid."""
    buffer = {
        "words": vertex_layout(states).room(capacity),
        "parent": dr.empty(mi.UInt32, capacity),
    }
    if traits.has_rough:
        buffer["hit"] = dr.empty(mi.PreliminaryIntersection3f, capacity)
    return buffer


def keep_vertex(
    store,
    vertex_bsdf,
    si,
    hit,
    towards,
    throughput,
    path,
    depth,
    number,
    parent,
    state,
    states,
    keep,
):
    """Writes a vertex into the buffer; returns the place (valid if there was room for it)."""
    slot = dr.scatter_inc(store.count, mi.UInt32(0), keep)
    keep = keep & (slot < store.room)
    values = {
        "p": si.p,
        "n": vertex_bsdf.n,
        "ns": vertex_bsdf.ns,
        "towards": towards,
        "throughput": throughput,
        "value": vertex_bsdf.value,
        "density": vertex_bsdf.density,
        "path": path,
        "depth": depth,
        "number": number,
        **dict(zip(states, state)),
    }
    vertex_layout(states).write(store.vertices["words"], values, slot, keep)
    dr.scatter(store.vertices["parent"], parent, slot, keep)
    if "hit" in store.vertices:
        dr.scatter(store.vertices["hit"], hit, slot, keep)
    return slot


def read_vertices(vertices, index, active, only=None, states=STATES):
    """The vertices at places `index`, a dictionary of all their fields (or those named in `only`);
    zero on inactive lanes."""
    record = vertex_layout(states).read(vertices["words"], index, active, only)
    for name in ("parent", "hit"):
        if name in vertices and (only is None or name in only):
            record[name] = dr.gather(type(vertices[name]), vertices[name], index, active)
    return record


def seen_normal(vertex):
    """Geometric normal of vertices, as read by `read_vertices`, on the side that their sub-path
    came from."""
    return dr.mulsign(vertex["n"], dr.dot(vertex["n"], vertex["towards"]))


def _either(mask, yes, no):
    """Element by element, of two states."""
    return [dr.select(mask, a, b) for a, b in zip(yes, no)]


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
        traits, record["n"], record["ns"], record["value"], record["density"], si, bsdf
    )


class VertexVisitor:
    """Keeps the smooth vertices of light sub-paths (a `LightVisitor`).

    Its state: how many vertices a sub-path has kept, the place of the last one, the density of its
    direction (per solid angle; zero after a delta function), the last surface's point, and the
    state of `weights`.
    """

    def __init__(self, traits, weights, n_paths, capacity):
        self.traits, self.weights = traits, weights
        self.store = Store(
            vertices=new_vertices(traits, capacity, weights.states),
            room=dr.opaque(mi.UInt32, capacity),
            count=dr.zeros(mi.UInt32, 1),
            lengths=dr.zeros(mi.UInt32, n_paths),
        )

    def blank(self, lanes):
        number, parent = dr.zeros(mi.UInt32, lanes), dr.full(mi.UInt32, NO_PARENT, lanes)
        density, origin = dr.zeros(mi.Float, lanes), dr.zeros(mi.Point3f, lanes)
        return [number, parent, density, origin, self.weights.blank(lanes)]

    def begin(self, state):
        _, _, density, origin, sums = state
        return [mi.UInt32(0), mi.UInt32(NO_PARENT), density, origin, sums]

    def arrive(self, state, at, active):
        number, parent, density, origin, sums = state
        si, weights = at.si, self.weights
        first = active & at.first
        squared = dr.maximum(dr.squared_norm(si.p - origin), 1e-20)
        arrival = density * dr.abs(dr.dot(si.n, at.towards)) * dr.rcp(squared)
        sums = _either(
            first,
            weights.init_light(si, at.source, ~at.had_delta, first, at.flux),
            weights.propagate(sums, arrival, si, squared, at.depth),
        )
        smooth = active & mi.has_flag(at.bsdf.flags(), mi.BSDFFlags.Smooth)
        at.vertex_bsdf = VertexBSDF.at(self.traits, si, at.bsdf, smooth)
        slot = keep_vertex(
            self.store,
            at.vertex_bsdf,
            si,
            at.hit,
            at.towards,
            at.flux,
            at.path,
            at.depth,
            number,
            parent,
            sums,
            weights.states,
            smooth,
        )
        number = dr.select(smooth, number + 1, number)
        dr.scatter(self.store.lengths, number, at.path, smooth)
        return [number, dr.select(smooth, slot, parent), density, origin, sums]

    def leave(self, state, at, wo, delta, active):
        number, parent, _, _, sums = state
        si, away = at.si, at.si.to_world(wo)
        value, p_back, p_forward = at.vertex_bsdf.f_and_pdfs(away, at.towards, active & ~delta)
        mean = scattered_mean(value, si.n, at.towards)
        sums = _either(active, self.weights.scatter(sums, p_forward, p_back, delta, mean), sums)
        density = dr.select(delta, 0, p_forward * dr.abs(dr.dot(si.n, away)))
        return [number, parent, density, mi.Point3f(si.p), sums]


def trace_light_subpaths(
    scene,
    lights,
    traits,
    weights,
    seed,
    n_paths: int,
    capacity: int,
    wavelengths,
    shutter_open: float,
    shutter_time: float,
    max_depth: int,
    rr_depth: int,
):
    """Traces `n_paths` light sub-paths.

    Returns `(vertices, count, lengths)`: the kept vertices, how many there were (width one; more
    than `capacity`: the surplus is missing), and the number of kept vertices of each path.
    `throughput` is flux through the surface, for one sub-path.
    """
    visitor = VertexVisitor(traits, weights, n_paths, capacity)
    trace_light(
        scene,
        lights,
        traits,
        visitor,
        seed,
        n_paths,
        wavelengths,
        shutter_open,
        shutter_time,
        max_depth,
        rr_depth,
    )
    store = visitor.store
    return store.vertices, store.count, store.lengths


@dr.syntax
def trace_camera_subpaths(
    scene,
    sensor,
    integrator,
    lights,
    traits,
    weights,
    seed,
    first,
    skip,
    n_paths: int,
    camera_paths: int,
    wavelength_sample,
    max_depth: int,
    rr_depth: int,
    hide_emitters: bool,
    capacity: int,
    ledger=None,
    shortest: int = 2,
):
    """Traces `n_paths` camera paths, numbers `first`, `first + 1`, ... of `film_samples`, but
    without `skip` of them after each pixel's, with the light that they meet and that next-event
    estimation finds at each smooth vertex, weighted.

    Returns `(radiance, alpha, splat position, vertices, count)`: the kept vertices are those that a
    light sub-path, of at least `shortest` segments with what joins the two, may be joined with;
    `count` as in `trace_light_subpaths`. `ledger`, if given, learns every contribution: `met(path,
    depth, value, share, mask)` and `direct(...)`, with the length of the joint path in segments,
    and the weight apart.
    """
    first = with_gaps(first, skip, n_paths, camera_paths)
    path, active, rng, ray, sensor_weight, splat, aperture = start_camera_paths(
        sensor, seed, first, 1, n_paths, camera_paths, wavelength_sample
    )
    lens = Lens(sensor)
    inside = within_crop(sensor.film(), splat)
    throughput = mi.Spectrum(sensor_weight)
    radiance = mi.Spectrum(0)
    depth = mi.UInt32(0)
    number = mi.UInt32(0)
    parent = mi.UInt32(NO_PARENT)
    eta = mi.Float(1)
    state = weights.blank(n_paths)
    density = mi.Float(
        0
    )  # with which the direction was sampled, per solid angle; zero after a delta function
    origin = dr.zeros(mi.Interaction3f)  # the last vertex, of whichever kind
    context = mi.BSDFContext()
    store = Store(
        vertices=new_vertices(traits, capacity, weights.states),
        room=dr.opaque(mi.UInt32, capacity),
        count=dr.zeros(mi.UInt32, 1),
    )
    visible = mi.Bool((scene.environment() is not None) and not hide_emitters)
    if dr.hint(max_depth == 0, mode="scalar"):
        active &= False

    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if dr.hint(hide_emitters, mode="scalar"):
        hit, ray = behind_emitters(scene, integrator, hit, ray, active)

    while dr.hint(active, label="camera sub-paths"):
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active=active)
        depth += 1
        towards = -ray.d

        # ---- Emission met by the path
        if dr.hint(traits.has_light_surfaces, mode="scalar"):
            ds = mi.DirectionSample3f(scene, si, origin)
            shown = active & (ds.emitter != None)  # noqa: E711 (array comparison)
            if dr.hint(hide_emitters, mode="scalar"):
                shown &= visible  # what is behind nothing but null surfaces is hidden, too
            later = shown & (depth > 1)
            share = weights.hit_emitter(
                state,
                lights.pdf_direct(origin, ds, later),
                lights.emission_over_nee_pdf(origin, ds, later),
                density,
            )
            share = dr.select(later, share, 1)
            light = throughput * ds.emitter.eval(si, shown)
            radiance[shown] += light * share
            if dr.hint(ledger is not None, mode="scalar"):
                ledger.hit_emitter(path, depth, light, share, shown)

        active &= si.is_valid()
        met = mi.Bool(active)  # a surface, perhaps the last one
        bsdf = si.bsdf(ray)
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth < max_depth
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

        # ---- Arrive
        cosine = dr.abs(dr.dot(si.n, towards))
        begin = active & (depth == 1)
        of_rays = mi.Float(0)
        if dr.hint(lens.connects, mode="scalar"):
            of_rays = cosine * lens.density(si.p, si.time, aperture, begin & inside)
        squared = dr.maximum(dr.squared_norm(si.p - origin.p), 1e-20)
        arrival = density * cosine * dr.rcp(squared)
        state = _either(
            begin,
            weights.init_camera(of_rays, begin),
            weights.propagate(state, arrival, si, squared, depth),
        )
        vertex_bsdf = VertexBSDF.at(traits, si, bsdf, smooth)

        # ---- Direct light
        if dr.hint(not lights.dark, mode="scalar"):
            ds, light, light_pdf = lights.sample_direct(si, rng, smooth)
            reached = smooth & (dr.max(light) > 0)
            direction = dr.select(
                reached, ds.d, mi.Vector3f(0, 0, 1)
            )  # elsewhere it may not even be a number
            response, p_camera, p_light = vertex_bsdf.f_and_pdfs(towards, direction, reached)
            facing = dr.abs(dr.dot(si.n, direction))
            share = weights.next_event(
                state,
                light_pdf,
                facing * lights.emission_over_nee_pdf(si, ds, reached),
                p_camera * facing,
                p_light,
                ds.delta,
            )
            light = throughput * response * light
            radiance[reached] += light * share
            if dr.hint(ledger is not None, mode="scalar"):
                ledger.next_event(path, depth + 1, light, share, reached)

        # ---- Keep the vertex
        wanted = smooth & (dr.max(throughput) > 0)
        if dr.hint(max_depth > 0, mode="scalar"):
            wanted &= depth + shortest <= max_depth
        slot = keep_vertex(
            store,
            vertex_bsdf,
            si,
            hit,
            towards,
            throughput,
            path,
            depth,
            number,
            parent,
            state,
            weights.states,
            wanted,
        )
        number = dr.select(wanted, number + 1, number)
        parent = dr.select(wanted, slot, parent)

        # ---- Go on
        bs, weight = bsdf.sample(context, si, rng.next_float32(met), next_2d(rng, met), met)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        visible |= met & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        wo = si.to_world(bs.wo)
        value, p_forward, p_back = vertex_bsdf.f_and_pdfs(towards, wo, active & ~delta)
        state = _either(
            active,
            weights.scatter(state, p_forward, p_back, delta, scattered_mean(value, si.n, wo)),
            state,
        )
        density = dr.select(delta, 0, p_forward * dr.abs(dr.dot(si.n, wo)))
        origin = mi.Interaction3f(si)
        throughput *= weight
        eta *= bs.eta
        ray = si.spawn_ray(wo)
        throughput, active = russian_roulette(
            rng, throughput, dr.max(throughput), eta, depth >= rr_depth, active
        )
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    return (
        radiance,
        dr.select(visible, mi.Float(1), mi.Float(0)),
        splat,
        store.vertices,
        store.count,
    )
