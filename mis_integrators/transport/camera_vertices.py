"""Camera sub-paths as nothing but vertices: where light sub-paths are joined to them afterwards, and the emission that they meet.

A vertex remembers the step that led to it, from the last vertex that scattered smoothly (its `parent`): weights walk back along these steps.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .camera_pass import behind_emitters, start_camera_paths
from .junctions import Junction, scattered_mean
from .lenses import Lens
from .packing import Store
from .random import next_2d
from .records import Layout
from .subpaths import NO_PARENT, keep_vertex, new_vertices, vertex_layout

STEP = ("near", "geometry", "forward", "back", "scattered", "row")
"""What vertices and hits remember of the step from their parent: one over the area density with which it was made [m^2] (over that per solid angle [sr] for
hits; zero where a delta function scattered on the way); the geometric term [1/m^2] (hits: the cosine at the parent), as `soften` leaves it;
densities per projected solid angle at the parent, of the camera's side for this step and of the light's for the one before; the parent's BSDF,
channel mean [1/sr]; its row (see `soften`)."""
HIT = ("light_mean", "start", "across")
"""What a hit knows besides: `Lights.start_density` and `forward_density` of the emitter's point, and its light, channel mean, over the former."""



def hit_layout():
    """Fields of a hit of an emitter beyond the first vertex: `value` (throughput included), number of the path, `depth` in segments, `parent`, and the
    fields of `STEP` and `HIT`."""
    return Layout({"value": mi.Spectrum, "path": mi.UInt32, **{name: mi.Float for name in STEP}, "depth": mi.UInt32, "parent": mi.UInt32,
                   **{name: mi.Float for name in HIT}})


@dr.syntax
def trace_camera_vertices(scene, sensor, integrator, lights, traits, soften, seed, first, n_paths: int, camera_paths: int, wavelength_sample,
                          ratio: float, max_depth: int, rr_depth: int, hide_emitters: bool, capacity: int, hit_capacity: int):
    """Traces `n_paths` camera paths, numbers `first`, `first + 1`, ... of `film_samples`.

    Returns `(radiance, alpha, splat position, vertices, count, hits, hit count)`: the light that the camera's rays meet at once; vertices as of
    `subpaths.new_vertices` with the fields of `STEP`; records of `hit_layout`. Counts have width one; if they exceed the capacities the surplus is missing. The
    first vertex has one over the density of camera rays there, over the whole crop window, times `ratio`, as its `near`, and no parent.

    `soften.row(p, n)` numbers places, with the normal on the side of the light; `soften.softened(row, geometry, squared)` may change the geometric
    term of a step that starts there, with its squared distance (infinite for environments).
    """
    path, active, rng, ray, sensor_weight, splat, aperture = start_camera_paths(sensor, seed, first, 1, n_paths, camera_paths, wavelength_sample)
    lens = Lens(sensor)
    film = sensor.film()
    offset, size = mi.ScalarVector2f(film.crop_offset()), mi.ScalarVector2f(film.crop_size())
    inside = mi.Bool(True)
    if dr.hint(film.sample_border(), mode='scalar'):
        inside = dr.all((splat >= offset) & (splat < offset + size))
    throughput = mi.Spectrum(sensor_weight)
    radiance = mi.Spectrum(0)
    depth = mi.UInt32(0)
    number = mi.UInt32(0)
    parent = mi.UInt32(NO_PARENT)                    # the last vertex that scattered smoothly
    eta = mi.Float(1)
    density = mi.Float(0)                            # with which the direction was sampled, per solid angle; zero after a delta function
    forward, back, scattered, row = mi.Float(1), mi.Float(0), mi.Float(0), mi.UInt32(0)
    cosine_there = mi.Float(0)                       # at the parent
    origin = dr.zeros(mi.Interaction3f)              # the last vertex, of whichever kind
    context = mi.BSDFContext()
    store = Store(vertices=new_vertices(traits, capacity, STEP), count=dr.zeros(mi.UInt32, 1), hits=hit_layout().room(hit_capacity),
                  hit_count=dr.zeros(mi.UInt32, 1))
    visible = mi.Bool((scene.environment() is not None) and not hide_emitters)
    if dr.hint(max_depth == 0, mode='scalar'):
        active &= False

    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    if dr.hint(hide_emitters, mode='scalar'):
        hit, ray = behind_emitters(scene, integrator, hit, ray, active)

    while dr.hint(active, label="camera vertices"):
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active=active)
        depth += 1
        towards = -ray.d
        squared = dr.maximum(dr.squared_norm(si.p - origin.p), 1e-20)

        # ---- Emission met by the path
        if dr.hint(traits.has_light_surfaces, mode='scalar'):
            ds = mi.DirectionSample3f(scene, si, origin)
            shown = active & (ds.emitter != None)  # noqa: E711 (array comparison)
            if dr.hint(hide_emitters, mode='scalar'):
                shown &= visible                     # what is behind nothing but null surfaces is hidden, too
            light = ds.emitter.eval(si, shown)
            radiance[shown & (depth == 1)] += throughput * light
            met = shown & (depth > 1) & (dr.max(light * throughput) > 0)
            start = lights.start_density(origin, ds, met)
            slot = dr.scatter_inc(store.hit_count, mi.UInt32(0), met)
            met &= slot < hit_capacity
            softened = soften.softened(row, cosine_there, dr.select(si.is_valid(), squared, dr.inf))
            step = (dr.select(density > 0, dr.rcp(density), 0), softened, forward, back, scattered, mi.Float(row))
            values = dict(zip(STEP, step)) | {
                "value": throughput * light, "path": path, "depth": depth, "parent": parent, "start": start,
                "light_mean": dr.mean(light) * dr.rcp(dr.maximum(start, 1e-20)), "across": lights.forward_density(origin, ds, met)}
            hit_layout().write(store.hits, values, slot, met)

        active &= si.is_valid()
        bsdf = si.bsdf(ray)
        if dr.hint(max_depth > 0, mode='scalar'):
            visible |= active & (depth >= max_depth) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            active &= depth < max_depth
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)

        # ---- Keep the vertex
        cosine = dr.abs(dr.dot(si.n, towards))
        begin = active & (depth == 1)
        near = dr.select(density > 0, squared * dr.rcp(dr.maximum(density * cosine, 1e-20)), 0)
        if dr.hint(lens.connects, mode='scalar'):
            of_rays = cosine * lens.density(si.p, si.time, aperture, begin & inside)
            near = dr.select(begin, dr.select(of_rays > 0, ratio * dr.rcp(dr.maximum(of_rays, 1e-20)), 0), near)
        geometry = soften.softened(row, cosine_there * cosine * dr.rcp(squared), squared)
        step = (dr.minimum(near, 1e15), geometry, forward, back, scattered, mi.Float(row))
        junction = Junction.at(traits, si, bsdf, smooth)
        wanted = smooth & (dr.max(throughput) > 0)
        slot = keep_vertex(store, junction, si, hit, towards, throughput, path, depth, number, parent, step, STEP, capacity, wanted)
        number = dr.select(wanted, number + 1, number)

        # ---- Go on
        bs, weight = bsdf.sample(context, si, rng.next_float32(active), next_2d(rng, active), active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        visible |= active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        wo = si.to_world(bs.wo)
        value, p_forward, p_back = junction.between(towards, wo, active & ~delta)
        left = active & ~delta
        parent = dr.select(left, slot, parent)
        forward = dr.select(left, p_forward, forward)
        back = dr.select(left, p_back, back)
        scattered = dr.select(left, scattered_mean(value, si.n, wo), scattered)
        row = dr.select(left, soften.row(si.p, dr.mulsign(si.n, dr.dot(si.n, wo))), row)
        cosine_there = dr.select(left, dr.abs(dr.dot(si.n, wo)), cosine_there)
        density = dr.select(delta, 0, p_forward * dr.abs(dr.dot(si.n, wo)))
        origin = mi.Interaction3f(si)
        throughput *= weight
        eta *= bs.eta
        ray = si.spawn_ray(wo)
        strength = dr.max(throughput)
        active &= strength > 0
        survival = dr.minimum(strength * dr.square(eta), 0.95)
        roulette = active & (depth >= rr_depth)
        active &= ~roulette | (rng.next_float32(roulette) < survival)
        throughput = dr.select(roulette, throughput * dr.rcp(survival), throughput)
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    alpha = dr.select(visible, mi.Float(1), mi.Float(0))
    return radiance, alpha, splat, store.vertices, store.count, store.hits, store.hit_count


@dr.syntax
def sum_before(vertices, step, parent, p_made, strength, scattered, back, segments, gain, active):
    """Sum over the techniques nearer to the camera than the one at hand, of their samples times densities, over the density of the latter.

    `step`, `parent`: those of the vertex, or hit, at the camera's end; `p_made` [1/m^2]: the density with which the light's side makes it; `strength`:
    flux, over the density of that; `scattered`, `back`: BSDF there, and density per projected solid angle with which the light's side goes on
    to the parent; `segments`: of the joint path. `gain(r, row, s, active)`: what resampling makes of the technique that joins a light sub-path of s
    vertices, which sends r = q*/p, to a vertex of that row. Joining to the sensor (the last step, without a parent) has the gain one.
    """
    layout = vertex_layout(STEP)
    near, geometry, forward, back_there, scattered_there, row = (mi.Float(step[name]) for name in STEP)
    parent = mi.UInt32(parent)
    ratio = mi.Float(p_made)
    strength = mi.Float(strength)
    scattered, back = mi.Float(scattered), mi.Float(back)
    active = mi.Bool(active)
    total = mi.Float(0)
    while dr.hint(active, label="techniques"):
        joined = parent != NO_PARENT
        depth = layout.read(vertices["words"], parent, active & joined, ("depth",))["depth"]
        better = gain(strength * scattered * geometry, mi.UInt32(row), segments - depth, active & joined)
        total = dr.select(active, total + ratio * near * dr.select(joined, better, 1), total)
        ratio = dr.minimum(ratio * (back * dr.rcp(dr.maximum(forward, 1e-20))), 1e15)
        strength = dr.minimum(strength * (scattered * dr.rcp(dr.maximum(back, 1e-20))), 1e15)
        back, scattered = mi.Float(back_there), mi.Float(scattered_there)
        active &= joined & (ratio > 0)
        record = layout.read(vertices["words"], parent, active, STEP)
        near, geometry, forward = record["near"], record["geometry"], record["forward"]
        back_there, scattered_there, row = record["back"], record["scattered"], record["row"]
        parent = dr.gather(mi.UInt32, vertices["parent"], parent, active)
    return total
