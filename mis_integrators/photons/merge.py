"""Merging kept vertices: light that light sub-paths bring to the vertices of camera paths by ending
close to them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import (
    bits_float,
    float_bits,
    pack_direction,
    pack_surface,
    unpack_depth,
    unpack_direction,
    unpack_normal,
)
from ..paths.subpaths import STATES, read_vertices, vertex_bsdf_of
from .gather import LARGEST_COSINE_RATIO, SAME_SURFACE_COSINE, SAME_SURFACE_OFFSET
from .grid import build_photon_map, for_each_photon, read_power
from .trace import photon_words


def vertex_map(vertices, count, capacity: int, bounds, cell):
    """A `PhotonMap` of all kept light vertices; its mis_words are their states. Arguments as of
    `build_photon_map`."""
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    y = read_vertices(
        vertices, index, active, ("p", "n", "depth", "towards", "throughput", *STATES)
    )
    words = photon_words()
    surface, power, mis_words = (dr.empty(mi.UInt32, size * capacity) for size in (4, words, 2))
    position, normal = (
        y["p"],
        pack_surface(dr.select(active, y["n"], mi.Vector3f(0, 0, 1)), y["depth"], mi.Bool(False)),
    )
    dr.scatter(surface, mi.Vector4u(*(float_bits(x) for x in position), normal), index, active)
    record = [float_bits(x) for x in y["throughput"]]
    record += [pack_direction(dr.select(active, y["towards"], mi.Vector3f(0, 0, 1)))]
    record += [mi.UInt32(0)] * (words - len(record))
    if words == 2:
        dr.scatter(power, mi.Vector2u(*record), index, active)
    else:
        for part in range(words // 4):
            dr.scatter(
                power,
                mi.Vector4u(*record[4 * part : 4 * part + 4]),
                words // 4 * index + part,
                active,
            )
    dr.scatter(mis_words, mi.Vector2u(*(float_bits(y[name]) for name in STATES)), index, active)
    dr.eval(surface, power, mis_words)
    return build_photon_map(surface, power, count, bounds, cell, capacity, "all", mis_words)


def merge(
    traits,
    photon_map,
    camera,
    radius,
    wavelengths,
    light_path_count: int,
    max_depth: int,
    weigh,
    active,
):
    """Radiance (a spectrum, throughput included) that the light vertices of `photon_map` within
    `radius` bring to camera vertices (records as of `read_vertices`).

    Constant kernel on a disk, with the tests of `gather_photons` for one surface. `weigh(state,
    back_at_light, back_at_camera)` is the weight of one merge: the light vertex' state, and the
    densities per projected solid angle with which the camera's side goes on to the vertex before
    it, and the light's side to the camera's.
    """
    vertex_bsdf = vertex_bsdf_of(traits, camera, wavelengths, active)
    n = camera["n"]
    landing_least = 1 / LARGEST_COSINE_RATIO

    def visit(index, record, offset, distance_squared, hit, totals):
        normal = unpack_normal(record.w)
        alike = dr.dot(normal, n)
        length_squared = dr.squared_norm(normal)
        hit &= (alike > 0) & (dr.square(alike) > SAME_SURFACE_COSINE**2 * length_squared)
        hit &= dr.abs(dr.dot(offset, n)) < SAME_SURFACE_OFFSET * radius
        if max_depth > 0:
            hit &= unpack_depth(record.w) + camera["depth"] <= max_depth
        flux, packed = read_power(photon_map.power, index, hit)
        towards = dr.normalize(unpack_direction(packed))
        value, p_camera, p_light = vertex_bsdf.f_and_pdfs(camera["towards"], towards, hit)
        shading = dr.abs(dr.dot(vertex_bsdf.ns, towards))
        landing = dr.abs(dr.dot(normal, towards)) * dr.rsqrt(length_squared)
        landing = dr.maximum(dr.maximum(landing, shading * landing_least), 1e-6)
        hit &= dr.max(value) > 0
        state = dr.gather(
            mi.Vector2u, photon_map.mis_words, photon_map.place_of_mis_words(index, hit), hit
        )
        share = weigh([bits_float(state.x), bits_float(state.y)], p_camera, p_light)
        return (totals[0] + dr.select(hit, value * flux * (share * dr.rcp(landing)), 0),)

    (total,) = for_each_photon(photon_map, camera["p"], radius, active, visit, (mi.Spectrum(0),))
    return dr.select(
        active, camera["throughput"] * total / (dr.pi * dr.square(radius) * light_path_count), 0
    )
