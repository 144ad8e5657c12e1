"""Density estimation: radiance that photons bring to stored camera vertices."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import unpack_depth, unpack_direction, unpack_normal
from ..core.spectra import channel_mean
from ..core.traits import lookup
from ..photons.queries import LAST_VERTEX
from .grid import for_each_photon, read_power

SAME_SURFACE_COSINE = 0.7
"""Photons merge only with vertices whose geometric normals differ by less than 45 degrees."""
SAME_SURFACE_OFFSET = 0.5
"""... and that lie closer than this share of the radius along the normal (steps, thin objects)."""
SAME_PLANE_COSINE_SQUARED = 0.9999
LARGEST_COSINE_RATIO = 4.0
"""Bound on shading over geometric cosine of a photon's direction, which grazing light on smoothed
meshes would exceed."""


def gather_photons(
    traits,
    photon_map,
    vertices,
    radii,
    wavelengths,
    light_path_count,
    max_depth: int,
    only_last: bool,
    grey: bool = False,
    weigh=None,
):
    """Radiance that the photons of `photon_map` bring to the camera paths of `vertices`, for each
    radius of the list `radii` (ascending; each of width one, or one a vertex), from one visit of
    the photons within the largest.

    Constant kernel on a disk: the sum over photons of f x flux, over (pi radius^2 x light
    sub-paths). Flux through the surface carries the geometric cosine where the photon landed,
    `path`'s scattering integral the shading one at the vertex, hence the ratio of the two.
    `weigh(index, f, p, back, active)`, if given, is the weight (a spectrum) of photon `index` of
    the map where the vertex scatters it with value f (a spectrum, without cosine) and a camera path
    would go there with density p per projected solid angle; `back()` computes the density with
    which a light sub-path would go on from there to the vertex before. Returns a list with a
    `Spectrum` of the vertices' width for each radius, throughput included; with `grey` the mean
    over its channels (fewer sums to keep for many radii).
    """
    ray = mi.Ray3f(vertices["ray_o"], vertices["ray_d"], 0, wavelengths)
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
    factor = mi.Spectrum(throughput) * vertices.get("scale", 1)
    lambert_f, lambert_p = mi.Spectrum(0), mi.Float(0)
    if traits.has_lambertian:
        upright = mi.Vector3f(0, 0, dr.select(facing > 0, mi.Float(1), mi.Float(-1)))
        if weigh is None:
            constant = bsdf.eval(context, si, upright, active & lambertian)
        else:
            constant, lambert_p = bsdf.eval_pdf(context, si, upright, active & lambertian)
            lambert_f = mi.Spectrum(constant)
        factor *= dr.select(lambertian, constant, 1)

    def visit(index, record, offset, distance_squared, hit, totals):
        normal = unpack_normal(record.w)
        alike = dr.dot(normal, si.n)
        hit &= (alike > 0) & (dr.square(alike) > SAME_SURFACE_COSINE**2 * dr.squared_norm(normal))
        if max_depth > 0:
            hit &= unpack_depth(record.w) + depth <= max_depth
        flux, packed = read_power(photon_map.power, index, hit)
        towards = unpack_direction(packed)
        if traits.has_rough:
            towards = dr.normalize(towards)
        wo = si.to_local(towards)  # a Lambertian needs only the ratio of its cosines
        cosine = dr.dot(si.n, towards)
        length_squared = dr.squared_norm(normal)
        flat = (
            dr.square(alike) > SAME_PLANE_COSINE_SQUARED * length_squared
        )  # then without the stored normal's rounding
        landing = dr.select(
            flat, dr.abs(cosine), dr.abs(dr.dot(normal, towards)) * dr.rsqrt(length_squared)
        )
        landing = dr.maximum(dr.maximum(landing, dr.abs(wo.z) * (1 / LARGEST_COSINE_RATIO)), 1e-6)
        value = mi.Spectrum(0)
        if traits.has_lambertian:
            front = (wo.z * facing > 0) & (cosine * geometric_side > 0)
            value = mi.Spectrum(dr.select(front & lambertian, dr.abs(wo.z), 0))
        if traits.has_rough and weigh is None:
            value = dr.select(lambertian, value, bsdf.eval(context, si, wo, hit & ~lambertian))
        if weigh is not None:
            f, p = lambert_f, lambert_p
            if traits.has_rough:
                rough, pdf = bsdf.eval_pdf(context, si, wo, hit & ~lambertian)
                scale = dr.rcp(dr.maximum(dr.abs(wo.z), 1e-6))
                value = dr.select(lambertian, value, rough)
                f, p = (
                    dr.select(lambertian, lambert_f, rough * scale),
                    dr.select(lambertian, lambert_p, pdf * scale),
                )

            def back():
                if not traits.has_rough:
                    return lambert_p
                view = mi.SurfaceInteraction3f(si)
                view.wi = mi.Vector3f(wo)
                pdf = bsdf.pdf(
                    mi.BSDFContext(mi.TransportMode.Importance), view, si.wi, hit & ~lambertian
                )
                return dr.select(
                    lambertian, lambert_p, pdf * dr.rcp(dr.maximum(dr.abs(facing), 1e-6))
                )

            value *= dr.select(dr.max(value) > 0, weigh(index, f, p, back, hit), 0)
        value *= flux * dr.rcp(landing)
        if grey:
            value = channel_mean(value * factor)
        height = dr.abs(dr.dot(offset, si.n))
        return tuple(
            total
            + dr.select(
                hit
                & (distance_squared < dr.square(radius))
                & (height < SAME_SURFACE_OFFSET * radius),
                value,
                0,
            )
            for total, radius in zip(totals, radii)
        )

    zero = mi.Float(0) if grey else mi.Spectrum(0)
    totals = for_each_photon(
        photon_map, si.p, radii[-1], active, visit, tuple(type(zero)(zero) for _ in radii)
    )
    return [
        dr.select(
            active,
            (total if grey else total * factor) / (dr.pi * dr.square(radius) * light_path_count),
            0,
        )
        for total, radius in zip(totals, radii)
    ]


def mean_photon_count(photon_map, vertices, radius):
    """Photons within `radius` of a vertex, on average over the used vertices (a number; what a
    gather costs)."""
    active = dr.max(vertices["throughput"]) > 0
    p = vertices["ray_o"] + vertices["ray_d"] * vertices["hit"].t
    (count,) = for_each_photon(
        photon_map,
        p,
        radius,
        active,
        lambda index, record, offset, distance_squared, hit, counts: (
            counts[0] + dr.select(hit, mi.UInt32(1), 0),
        ),
        (mi.UInt32(0),),
    )
    used = int(dr.count(active)[0])
    return float(dr.sum(mi.Float(count))[0]) / used if used else 0.0
