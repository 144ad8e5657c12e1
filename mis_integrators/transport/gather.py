"""Density estimation: radiance that photons bring to stored camera vertices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .camera_pass import LAST_VERTEX
from .packing import unpack_depth, unpack_direction, unpack_normal
from .photon_map import for_each_photon, read_power
from .traits import lookup

SAME_SURFACE_COSINE = 0.7
"""Photons merge only with vertices whose geometric normals differ by less than 45 degrees."""
SAME_SURFACE_OFFSET = 0.5
"""... and that lie closer than this share of the radius along the normal (steps, thin objects)."""
SMALLEST_COSINE = 1e-3


def gather_photons(scene, traits, photon_map, vertices, radius, light_paths, max_depth: int, only_last: bool):
    """Radiance that the photons of `photon_map` add to each camera path, per vertex of `vertices`.

    Constant kernel on the disk of `radius` (width one, or one a vertex): the sum over photons of f x flux, over
    (pi radius^2 x light sub-paths). Flux through the surface carries the geometric cosine, `path`'s scattering integral the
    shading one, hence the ratio of the two at each photon. Returns a `Spectrum` of the vertices' width, throughput included.
    """
    ray = mi.Ray3f(vertices["ray_o"], vertices["ray_d"])
    throughput, depth = vertices["throughput"], vertices["depth"]
    active = dr.max(throughput) > 0
    if only_last:
        active &= (depth & LAST_VERTEX) != 0
    depth = depth & (LAST_VERTEX - 1)
    si = vertices["hit"].compute_surface_interaction(ray, mi.RayFlags.All, active)
    bsdf = si.bsdf()
    context = mi.BSDFContext()
    facing = mi.Frame3f.cos_theta(si.wi)
    lambertian = mi.Bool(True)
    if traits.has_rough:
        lambertian = lookup(traits.lambertian, bsdf, mi.Bool, active)
    geometric_side = dr.dot(si.n, -ray.d)
    largest_offset = SAME_SURFACE_OFFSET * radius

    def visit(index, record, offset, distance_squared, hit, state):
        (total,) = state
        hit &= dr.dot(unpack_normal(record.w), si.n) > SAME_SURFACE_COSINE
        hit &= dr.abs(dr.dot(offset, si.n)) < largest_offset
        if max_depth > 0:
            hit &= unpack_depth(record.w) + depth <= max_depth
        flux, packed = read_power(photon_map, index, hit)
        towards = unpack_direction(packed)
        wo = si.to_local(towards)
        cosine = dr.dot(si.n, towards)
        scale = dr.rcp(dr.maximum(dr.abs(cosine), SMALLEST_COSINE))
        value = mi.Spectrum(0)
        if traits.has_lambertian:
            front = (wo.z * facing > 0) & (cosine * geometric_side > 0)
            value = mi.Spectrum(dr.select(front & lambertian, dr.abs(wo.z), 0))
        if traits.has_rough:
            rough = hit & ~lambertian
            value = dr.select(lambertian, value, bsdf.eval(context, si, wo, rough))
        return (total + dr.select(hit, flux * value * scale, 0),)

    (total,) = for_each_photon(photon_map, si.p, radius, active, visit, (mi.Spectrum(0),))
    if traits.has_lambertian:
        upright = mi.Vector3f(0, 0, dr.select(facing > 0, mi.Float(1), mi.Float(-1)))
        reflectance = bsdf.eval(context, si, upright, active & lambertian)
        total = dr.select(lambertian, total * reflectance, total)
    return dr.select(active, throughput * total / (dr.pi * dr.square(radius) * light_paths), 0)
