"""Camera sub-paths: direct light on the way, and the vertices at which photons are to be
gathered."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.random import next_2d, streams
from ..lights.lights import mis_power
from .camera_rays import sample_camera_ray
from .roulette import russian_roulette


def film_samples(sensor, index, camera_paths: int, rng):
    """Film positions of camera paths `index` (in pixels, crop offset included), in the order pixel
    by pixel, row by row.

    Returns `(position in [0, 1]^2 of the crop window, position for splatting)`; with a film that
    samples its border the grid covers the border too, as in Mitsuba's own integrators.
    """
    film = sensor.film()
    width, _ = film_size(sensor)
    pixel = index // camera_paths
    corner = (
        mi.Vector2i(mi.Int32(pixel % width), mi.Int32(pixel // width))
        - border_size(film)
        + mi.Vector2i(film.crop_offset())
    )
    position = mi.Vector2f(corner) + mi.Vector2f(next_2d(rng))
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    unit = (position - mi.ScalarVector2f(film.crop_offset())) * scale
    splat = mi.Vector2f(corner) if film.rfilter().is_box_filter() else position
    return mi.Point2f(unit), mi.Point2f(splat)


def film_size(sensor):
    """Width and height, in pixels, of what camera paths are sent through: the crop window, with its
    border where the film samples it."""
    film = sensor.film()
    return tuple(int(size) + 2 * border_size(film) for size in film.crop_size())


def border_size(film):
    """Pixels beyond each edge of the crop window that camera paths are sent through, too."""
    return film.rfilter().border_size() if film.sample_border() else 0


def film_sample_count(sensor):
    """Pixels that camera paths are sent through."""
    width, height = film_size(sensor)
    return width * height


def within_crop(film, splat):
    """Whether positions for splatting lie in the crop window, and not in a border that the film
    samples besides."""
    if not film.sample_border():
        return mi.Bool(True)
    offset, size = mi.ScalarVector2f(film.crop_offset()), mi.ScalarVector2f(film.crop_size())
    return dr.all((splat >= offset) & (splat < offset + size))


def start_camera_paths(
    sensor, seed, first, stride: int, n_paths: int, camera_paths: int, wavelength_sample
):
    """Camera rays of `n_paths` paths, numbers `first`, `first + stride`, ... of `film_samples`.

    Returns `(path, active, rng, ray, weight, splat, aperture)`: the index of each, whether there is
    a path of that number, its random numbers, the ray and its weight, the position for splatting,
    and the sample that chose the point of the lens.
    """
    path = dr.arange(mi.UInt32, n_paths)
    number = path * stride + first
    active = number < film_sample_count(sensor) * camera_paths
    rng = streams(number, seed)
    unit, splat = film_samples(sensor, number, camera_paths, rng)
    aperture = next_2d(rng) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += rng.next_float32() * sensor.shutter_open_time()
    ray, weight = sample_camera_ray(sensor, time, wavelength_sample, unit, aperture, active)
    return path, active, rng, mi.Ray3f(ray), weight, splat, aperture


def with_gaps(first, skip, n_paths: int, camera_paths: int):
    """What `start_camera_paths`, with a `stride` of one, takes as `first` to leave out `skip`
    numbers after each pixel's `camera_paths`."""
    return first + dr.arange(mi.UInt32, n_paths) // camera_paths * skip


def behind_emitters(scene, integrator, hit, ray, active):
    """Camera rays that meet an emitter's shape, and their hits, moved on to what is behind it
    (`hide_emitters`)."""
    on_light = active & hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 (array comparison)
    behind = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, on_light).spawn_ray(ray.d)
    hit[on_light] = integrator.skip_area_emitters(scene, behind, True, on_light)
    ray.o[on_light] = behind.o
    return hit, ray


def new_vertex_buffer(capacity, weighted=False):
    """Room for `capacity` camera vertices that wait for photons: what rebuilds the surface
    interaction there, the path's throughput up to it, its path's number, and its depth in segments
    with the top bit set where all photons are wanted (else only caustic ones); if `weighted`, the
    state of the weights there. Unused places have throughput zero."""
    extra = (
        {name: dr.empty(mi.Spectrum, capacity) for name in (*STATE, "share")} if weighted else {}
    )
    return extra | {
        "ray_o": dr.empty(mi.Point3f, capacity),
        "ray_d": dr.empty(mi.Vector3f, capacity),
        "hit": dr.empty(mi.PreliminaryIntersection3f, capacity),
        "throughput": dr.zeros(mi.Spectrum, capacity),
        "path": dr.empty(mi.UInt32, capacity),
        "depth": dr.empty(mi.UInt32, capacity),
    }


LAST_VERTEX = 1 << 31
STATE = ("weights.0", "weights.1", "weights.2")
"""What a vertex buffer calls the state of the weights."""


@dr.syntax
def trace_camera_paths(
    scene,
    sensor,
    integrator,
    lights,
    traits,
    seed,
    first,
    stride: int,
    n_paths: int,
    camera_paths: int,
    wavelength_sample,
    bdd: int,
    max_depth: int,
    rr_depth: int,
    hide_emitters: bool,
    capacity: int,
    has_caustics: bool,
    has_indirect: bool,
    one_vertex: bool,
    weights=None,
):
    """Traces `n_paths` camera paths, numbers `first`, `first + stride`, ... of `film_samples`, to
    their `bdd`-th smooth vertex.

    On the way: emission seen directly or through delta surfaces; at every smooth vertex up to the
    `bdd`-th, direct light by next-event estimation combined with BSDF sampling (power heuristic).
    Light that reaches a smooth vertex through delta surfaces belongs to caustic photons and is left
    out. Delta vertices do not count; a BSDF with both parts is a smooth vertex whose delta part
    goes on.

    Returns `(radiance, alpha, splat position, vertices, count)`: the vertices at which photons are
    to be gathered, as made by `new_vertex_buffer`, and how many wanted a place in it (width one).
    With `one_vertex` each path owns the place of its number.

    With `weights` (a `mis.state.MergeState`) all photons are wanted at every smooth vertex, and
    direct light at each is weighted. The vertex buffer is then one section for each smooth vertex
    of the path, of `capacity` each (a path's last vertex in the last section), and `count` has one
    entry for each.
    """
    path, active, rng, ray, sensor_weight, splat, _ = start_camera_paths(
        sensor, seed, first, stride, n_paths, camera_paths, wavelength_sample
    )

    throughput = mi.Spectrum(sensor_weight)
    radiance = mi.Spectrum(0)
    vertex = mi.UInt32(0)  # smooth vertices left behind
    depth = mi.UInt32(0)  # segments so far
    behind_delta = mi.Bool(False)  # last vertex scattered by a delta function
    eta = mi.Float(1)
    scatter_pdf = mi.Float(1)  # of the last smooth vertex
    origin = dr.zeros(mi.Interaction3f)  # the last smooth vertex
    context = mi.BSDFContext()
    sections = 1
    state = []
    if dr.hint(weights is not None, mode="scalar"):
        sections = bdd + 1
        state = weights.init(n_paths)
    share_here = mi.Spectrum(1)  # weight of the direct light at the last smooth vertex
    by_light = weights is not None and weights.weighs_points_of_lights
    store = Store(
        vertices=new_vertex_buffer(capacity * sections, weights is not None),
        count=dr.zeros(mi.UInt32, sections),
    )
    environment_shows = (scene.environment() is not None) and not hide_emitters
    visible = mi.Bool(environment_shows)
    if dr.hint(max_depth == 0, mode="scalar"):
        active &= False

    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if dr.hint(hide_emitters, mode="scalar"):
        hit, ray = behind_emitters(scene, integrator, hit, ray, active)

    while dr.hint(active, label="camera paths"):
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active=active)
        depth += 1

        # ---- Emission met by the path
        if dr.hint(traits.has_light_surfaces, mode="scalar"):
            ds = mi.DirectionSample3f(scene, si, origin)
            shown = active & ((vertex == 0) | ~behind_delta)
            if dr.hint(hide_emitters, mode="scalar"):
                shown &= (depth > 1) | si.is_valid()
            light_pdf = lights.pdf_direct(origin, ds, shown & (vertex > 0))
            weight_here = share_here
            if dr.hint(by_light, mode="scalar"):
                weight_here = weights.next_event_weight(state, origin, ds, shown & (vertex > 0))
            share = dr.select(
                vertex == 0, mi.Spectrum(1), mis_power(scatter_pdf, light_pdf) * weight_here
            )
            radiance[shown] += throughput * share * ds.emitter.eval(si, shown)

        active &= si.is_valid() & (vertex <= bdd)
        met = mi.Bool(active)  # a surface, perhaps the last one
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth < max_depth
        bsdf = si.bsdf(ray)
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

        if dr.hint(weights is not None, mode="scalar"):
            state, arrived_share = weights.propagate(state, si, bsdf, vertex, smooth)
            share_here = dr.select(smooth, arrived_share, share_here)
        ends = vertex >= bdd  # the path's last smooth vertex
        if dr.hint(weights is not None, mode="scalar"):
            ends |= weights.ends(bsdf, vertex, smooth)

        # ---- Direct light
        if dr.hint(not lights.dark, mode="scalar"):
            ds, light, light_pdf = lights.sample_direct(si, rng, smooth)
            towards = si.to_local(ds.d)
            response, response_pdf = bsdf.eval_pdf(context, si, towards, smooth)
            weight_here = share_here
            if dr.hint(by_light, mode="scalar"):
                reached = smooth & (dr.max(light) > 0)  # elsewhere `ds` may not even be a number
                left = weights.scatter(state, si, bsdf, mi.BSDFSample3f(towards), vertex, reached)
                weight_here = weights.next_event_weight(left, si, ds, reached)
            share = dr.select(ds.delta, 1, mis_power(light_pdf, response_pdf)) * weight_here
            radiance[smooth] += throughput * share * response * light

        # ---- Ask for photons
        last = vertex == bdd
        wants = smooth & (dr.max(throughput) > 0)
        kept = mi.Float(1)
        if dr.hint(weights is not None, mode="scalar"):
            last |= True
            if dr.hint(sections > 1, mode="scalar"):
                kept = weights.merge_probability(state, share_here, vertex, ends)
                wants &= rng.next_float32(wants) < kept
        if dr.hint(not has_caustics, mode="scalar"):
            wants &= last & has_indirect
        slot = mi.UInt32(path)
        if dr.hint(not one_vertex, mode="scalar"):
            section = mi.UInt32(0)
            if dr.hint(weights is not None, mode="scalar"):
                section = dr.select(ends, mi.UInt32(bdd), vertex)
            slot = dr.scatter_inc(store.count, section, wants)
            wants &= slot < capacity
            slot += section * capacity
        merged = throughput * dr.rcp(dr.select(wants, kept, 1))
        if dr.hint(capacity > 0, mode="scalar"):
            dr.scatter(store.vertices["ray_o"], ray.o, slot, wants)
            dr.scatter(store.vertices["ray_d"], ray.d, slot, wants)
            dr.scatter(store.vertices["hit"], hit, slot, wants)
            dr.scatter(store.vertices["throughput"], merged, slot, wants)
            dr.scatter(store.vertices["path"], path, slot, wants)
            dr.scatter(
                store.vertices["depth"],
                depth | dr.select(last, mi.UInt32(LAST_VERTEX), mi.UInt32(0)),
                slot,
                wants,
            )
            if dr.hint(weights is not None, mode="scalar"):
                for name, value in dr.hint(list(zip(STATE, weights.stored(state))), mode="scalar"):
                    dr.scatter(store.vertices[name], value, slot, wants)
                dr.scatter(store.vertices["share"], share_here, slot, wants)

        # ---- Go on
        bs, weight = bsdf.sample(context, si, rng.next_float32(met), next_2d(rng, met), met)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        visible |= met & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        if dr.hint(not traits.has_light_surfaces, mode="scalar"):
            active &= delta | ~ends
        if dr.hint(weights is not None, mode="scalar"):
            state = weights.scatter(state, si, bsdf, bs, vertex, active & ~delta)
            if dr.hint(sections > 1, mode="scalar"):
                kept_on = dr.select(active & ~delta, weights.continue_probability(state, vertex), 1)
                active &= rng.next_float32(active) < kept_on
                weight *= dr.rcp(dr.select(active, kept_on, 1))
        throughput *= weight
        eta *= bs.eta
        ray = si.spawn_ray(si.to_world(bs.wo))
        scattered = active & ~delta
        origin[scattered] = mi.Interaction3f(si)
        scatter_pdf[scattered] = bs.pdf
        vertex[scattered] = dr.select(ends, mi.UInt32(bdd), vertex) + 1
        behind_delta = mi.Bool(delta)
        throughput, active = russian_roulette(
            rng, throughput, dr.max(throughput), eta, depth >= rr_depth, active
        )
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    alpha = dr.select(visible, mi.Float(1), mi.Float(0))
    return radiance, alpha, splat, store.vertices, store.count
