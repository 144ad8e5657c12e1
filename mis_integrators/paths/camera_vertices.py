"""Camera sub-paths as nothing but vertices: where light sub-paths are joined to them afterwards,
and the emission that they meet.

A vertex remembers the step that led to it, from the last vertex that scattered smoothly (its
`parent`): weights walk back along these steps.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from ..core.records import Layout
from ..core.spectra import channel_mean
from .camera import trace_camera, whole_or_nothing, within_crop
from .media import next_hit
from .sensor import Lens
from .setting import CameraPass, Limits, World
from .subpaths import NO_PARENT, crossed, keep_vertex, new_vertices, smooth_at
from .vertex import VertexBSDF, facing

STEP = ("d_vcm", "geometry", "forward", "back", "scattered", "row")
"""What vertices and hits remember of the step from their parent: one over the area density with
which it was made [m^2] (over that per solid angle [sr] for hits; zero where a delta function
scattered on the way); the geometric term [1/m^2] (hits: the cosine at the parent), as `weights`
leaves it; densities per projected solid angle at the parent, of the camera's side for this step and
of the light's for the one before; the parent's BSDF, channel mean [1/sr]; its row (see
`weights`)."""
LEFT = 5
"""Entries of what `leave` returns before those that `weights` adds."""
HIT = ("light_mean", "start", "across")
"""What a hit knows besides: `Lights.pdf_emission_origin` and `pdf_emission_area` of the emitter's
point, and its light, channel mean, over the former."""


def hit_layout(weights):
    """Fields of a hit of an emitter beyond the first vertex: `value` (throughput included), number
    of the path, `depth` in segments, `parent`, the fields of `STEP` and `HIT`, and the kernels of
    `weights`: those of the parent, and those of the emitter."""
    return Layout(
        {
            "value": mi.Spectrum,
            "path": mi.UInt32,
            **dict.fromkeys(STEP, mi.Float),
            "depth": mi.UInt32,
            "parent": mi.UInt32,
            **dict.fromkeys((*HIT, *weights.kernels, *weights.light_kernels), mi.Float),
        }
    )


def not_left(weights, width):
    """What `leave` returns before anything was left: densities of both sides, BSDF, row and cosine
    of the last vertex that scattered smoothly, and its kernels."""
    others = LEFT - 1 + len(weights.kernels)
    return [dr.ones(mi.Float, width), *[dr.zeros(mi.Float, width) for _ in range(others)]]


def leave(weights, left, si, vertex_bsdf, value, p_forward, p_back, wo, mask):
    """After the lanes `mask` have scattered smoothly towards `wo`: what the next vertex must know
    of this one."""
    row = mi.Float(weights.row(si.p, si.n, wo))
    mean = vertex_bsdf.scattered_mean(value, wo, mask)
    new = [p_forward, p_back, mean, row, facing(vertex_bsdf.traits, si.n, wo)]
    new += weights.kernels_of_vertex(left[3], si.p, vertex_bsdf, wo, mask)
    return [dr.select(mask, a, b) for a, b in zip(new, left)]


def step_to_vertex(weights, left, density, cosine, squared):
    """The fields of `STEP`, and the parent's kernels, at a vertex that was sampled with `density`
    per solid angle (zero: by a delta function) and meets the ray under `cosine`."""
    forward, back, scattered, row, there, *kernels = left
    d_vcm = dr.select(density > 0, squared * dr.rcp(dr.maximum(density * cosine, 1e-20)), 0)
    geometry = weights.softened(there * cosine * dr.rcp(squared), squared)
    return [dr.minimum(d_vcm, 1e15), geometry, forward, back, scattered, row, *kernels]


def step_to_hit(lights, weights, left, density, origin, ds, light, squared, mask):
    """The fields of `STEP` and `HIT`, and the kernels, of emission `light` met in the point or
    direction `ds`, seen from the vertex `origin`."""
    forward, back, scattered, row, there, *kernels = left
    start = lights.pdf_emission_origin(origin, ds, mask)
    geometry = weights.softened(there, squared)
    d_vcm = dr.select(density > 0, dr.rcp(dr.maximum(density, 1e-20)), 0)
    light_mean = channel_mean(light) * dr.rcp(dr.maximum(start, 1e-20))
    return dict(
        zip(
            (*STEP, *HIT, *weights.kernels, *weights.light_kernels),
            (
                d_vcm,
                geometry,
                forward,
                back,
                scattered,
                row,
                light_mean,
                start,
                lights.pdf_emission_area(origin, ds, mask),
                *kernels,
                *weights.kernels_of_light(row, ds, light_mean, mask),
            ),
        )
    )


class StepVisitor:
    """Keeps the smooth vertices of camera sub-paths with the steps that led to them, and the lights
    that they meet (a `CameraVisitor`).

    Its state, by name: `number`, how many vertices a sub-path has kept; `parent`, the place of the
    last one that scattered smoothly; `density` of its direction (per solid angle; zero after a
    delta function); `origin`, the last vertex of whichever kind; and `left`, what `leave` returns.
    """

    def __init__(self, world, limits, sensor, weights, ratio, capacity, hit_capacity):
        self.scene, self.lights, self.traits = world.scene, world.lights, world.traits
        self.film, self.lens = sensor.film(), Lens(sensor)
        self.weights, self.ratio = weights, ratio
        self.steps, self.hit = (*STEP, *weights.kernels), hit_layout(weights)
        self.hide_emitters = limits.hide_emitters
        self.store = Store(
            vertices=new_vertices(self.traits, capacity, self.steps),
            room=dr.opaque(mi.UInt32, capacity),
            count=dr.zeros(mi.UInt32, 1),
            hits=self.hit.room(hit_capacity),
            hit_room=dr.opaque(mi.UInt32, hit_capacity),
            hit_count=dr.zeros(mi.UInt32, 1),
        )

    def begin(self, n_paths, splat, aperture):
        self.inside, self.aperture = within_crop(self.film, splat), aperture
        return {
            "number": mi.UInt32(0),
            "parent": mi.UInt32(NO_PARENT),
            "density": mi.Float(0),
            "origin": dr.zeros(mi.Interaction3f),
            "left": not_left(self.weights, n_paths),
        }

    def travel(self, state, ray, flight, numbers, throughput, path, depth, active, unseen):
        hit = next_hit(self.scene, self.traits, ray, flight, numbers, throughput, active, unseen)
        return state, *hit

    def emission(self, state, at, active):
        store, si, origin = self.store, at.si, state["origin"]
        ds = mi.DirectionSample3f(self.scene, si, origin)
        shown = active & (ds.emitter != None)  # noqa: E711 (array comparison)
        if self.hide_emitters:
            shown &= at.visible  # what is behind nothing but null surfaces is hidden, too
        light = ds.emitter.eval(si, shown)
        value = at.throughput * light
        met = shown & (at.depth > 1) & (dr.max(value) > 0)
        slot = dr.scatter_inc(store.hit_count, mi.UInt32(0), met)
        met &= slot < store.hit_room
        squared = dr.maximum(dr.squared_norm(si.p - origin.p), 1e-20)
        squared = dr.select(si.is_valid(), squared, dr.inf)
        left, density = state["left"], state["density"]
        values = step_to_hit(
            self.lights, self.weights, left, density, origin, ds, light, squared, met
        )
        values |= {"value": value, "path": at.path, "depth": at.depth, "parent": state["parent"]}
        self.hit.write(store.hits, values, slot, met)
        return dr.select(shown & (at.depth == 1), value, 0)

    def unfinished(self, state, at):
        return mi.Bool(True)

    def arrive(self, state, at, rng, active):
        si, number = at.si, state["number"]
        smooth = smooth_at(at, active)
        squared = dr.maximum(dr.squared_norm(si.p - state["origin"].p), 1e-20)
        cosine = facing(self.traits, si.n, at.towards)
        step = step_to_vertex(self.weights, state["left"], state["density"], cosine, squared)
        if self.lens.connects:
            first = active & (at.depth == 1)
            seen = first & self.inside
            of_rays = cosine * self.lens.density(si.p, si.time, self.aperture, seen)
            of_rays = dr.select(of_rays > 0, self.ratio * dr.rcp(dr.maximum(of_rays, 1e-20)), 0)
            step[0] = dr.select(first, of_rays, step[0])
        merges = self.weights.merging is not None
        at.vertex_bsdf = VertexBSDF.at(self.traits, si, at.bsdf, smooth, at.medium, merges)
        wanted = smooth & (dr.max(at.throughput) > 0)
        step, parent = dict(zip(self.steps, step)), state["parent"]
        at.slot = keep_vertex(self.store, at, at.throughput, number, parent, step, wanted)
        return {**state, "number": dr.select(wanted, number + 1, number)}, mi.Spectrum(0)

    def leave(self, state, at, rng, bs, weight, delta, active):
        si, wo, smoothly = at.si, at.si.to_world(bs.wo), active & ~delta
        value, p_forward, p_back = at.vertex_bsdf.f_and_pdfs(at.towards, wo, smoothly)
        scattered = at.vertex_bsdf, value, p_forward, p_back, wo, smoothly
        state = {
            **state,
            "parent": dr.select(smoothly, at.slot, state["parent"]),
            "density": dr.select(delta, 0, p_forward * facing(self.traits, si.n, wo)),
            "origin": mi.Interaction3f(si),
            "left": leave(self.weights, state["left"], si, *scattered),
        }
        return state, weight, active

    def cross(self, before, after, crosses):
        return crossed(before, after, crosses)

    def alpha(self, state, visible):
        return whole_or_nothing(visible)


def trace_camera_vertices(
    world: World,
    limits: Limits,
    camera_pass: CameraPass,
    weights,
    ratio,
    capacity: int,
    hit_capacity: int,
):
    """Traces the camera paths of a pass.

    Returns `(radiance, alpha, splat position, vertices, count, hits, hit count)`: the light that
    the camera's rays meet at once; vertices as of `subpaths.new_vertices` with the fields of
    `STEP`; records of `hit_layout`. Counts have width one; if they exceed the capacities the
    surplus is missing. The first vertex has one over the density of camera rays there, over the
    whole crop window, times `ratio`, as its `d_vcm`, and no parent.

    `weights.row(p, n, d)` numbers places with geometric normals `n`, from which the light is in the
    direction `d`; `weights.softened(geometry, squared)` may change the geometric term of a step
    that starts there, with its squared distance (infinite for environments). `weights.kernels` and
    `light_kernels` name more numbers that vertices keep of their parents, and hits of themselves;
    `kernels_of_vertex` and `kernels_of_light` compute them (lists).
    """
    visitor = StepVisitor(world, limits, camera_pass.sensor, weights, ratio, capacity, hit_capacity)
    radiance, alpha, splat = trace_camera(world, limits, camera_pass, visitor)
    store = visitor.store
    return radiance, alpha, splat, store.vertices, store.count, store.hits, store.hit_count
