"""Ends of light sub-paths that camera vertices can be joined with: starts on emitters, and kept
vertices of the light sub-paths."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean
from ..paths.light_starts import read_starts
from ..paths.media import transmitted
from ..paths.sensor import unblocked
from ..paths.subpaths import read_vertices, sides_of, vertex_bsdf_of
from ..paths.vertex import SMALLEST_COSINE, facing

END = ("d_vcm", "d_vc", "strength")
"""Fields that the ends' states have."""


@dataclass
class LightConnection:
    """What the end of a light sub-path sends to a point, one a lane.

    `d`, `distance`: from the point to the end (infinite for emitters that are); `light` (spectrum):
    per solid angle if the sub-path's density were one there, that is, times what the point's BSDF
    makes of it (cosine included) it is the contribution over the sub-path's density; unoccluded;
    `mean`: its channel mean without colours along the sub-path mixed (a product of channel means);
    `pdf_area` [1/m^2]: density per area across `d` with which the sub-path would go on to the
    point; `mis_sum`: techniques nearer to the light than this one, over the density per solid angle
    at the point with which the camera's side would make the end; `vertices`: how many the light
    sub-path has; `mark`: of its kept vertices, where these are marked (None elsewhere).
    """

    d: mi.Vector3f
    distance: mi.Float
    light: mi.Spectrum
    mean: mi.Float
    pdf_area: mi.Float
    mis_sum: mi.Float
    vertices: mi.UInt32
    mark: mi.Bool | None = None


class LightVertices:
    """Ends of M light sub-paths. The first M are starts (`light_starts`), the others the vertices
    at the places `list` of a buffer of `subpaths`, whose states have the fields `END`.

    `count`: how many ends there are (uint32 of width one); `eta_at`: the weights' (None: nothing is
    merged).
    """

    def __init__(self, traits, lights, starts, paths, vertices, places, count, reach, eta_at=None):
        self.traits, self.lights, self.starts, self.paths = traits, lights, starts, paths
        self.vertices, self.places, self.count, self.reach = vertices, places, count, reach
        self.eta_at = eta_at or (lambda vertex: 0)

    def send(self, p, index, time, wavelengths, active):
        """What the ends `index` send to points `p`: a `LightConnection`."""
        surface = active & (index >= self.paths)
        place = dr.gather(mi.UInt32, self.places, index - self.paths, surface)
        y = read_vertices(self.vertices, place, surface, states=END)
        offset = y["p"] - p
        squared = dr.maximum(dr.squared_norm(offset), 1e-20)
        distance = dr.sqrt(squared)
        d = offset * dr.rcp(distance)
        vertex_bsdf = vertex_bsdf_of(self.traits, y, wavelengths, surface)
        value, back, forward = vertex_bsdf.f_and_pdfs(-d, y["towards"], surface)
        leaving = facing(self.traits, y["n"], d) * dr.rcp(squared)
        landing = dr.maximum(facing(self.traits, y["n"], y["towards"]), SMALLEST_COSINE)
        joined = LightConnection(
            d,
            distance,
            value
            * vertex_bsdf.adjoint(-d, y["towards"], surface)
            * y["throughput"]
            * (leaving * dr.rcp(landing)),
            y["strength"] * vertex_bsdf.scattered_mean(value, y["towards"], surface) * leaving,
            forward * leaving,
            leaving * (y["d_vcm"] + back * y["d_vc"] + self.eta_at(y)),
            y["depth"] + 1,
        )

        start = active & (index < self.paths)
        x = read_starts(self.starts, index, start)
        ds, per, light, mean, pdf_area = sent_by_starts(self.lights, x, p, time, wavelengths, start)
        met = start & self.lights.can_be_met(ds.emitter, start)
        return LightConnection(
            dr.select(start, ds.d, joined.d),
            dr.select(start, ds.dist, joined.distance),
            dr.select(active, dr.select(start, light, joined.light), 0),
            dr.select(start, mean, joined.mean),
            dr.select(start, pdf_area, joined.pdf_area),
            dr.select(start, dr.select(met, per, 0), joined.mis_sum),
            dr.select(start, 1, joined.vertices),
            y["mark"] if "mark" in y else None,
        )

    def unblocked(self, scene, p, n, joined, active):
        """Whether nothing stands between points `p` (geometric normals `n`) and the ends that sent
        `joined`."""
        return unblocked(scene, p, n, joined.d, dr.minimum(joined.distance, self.reach), active)

    def transmitted(self, scene, z, joined, wavelengths, rng, active):
        """Share of light (spectrum) that media and boundaries leave between camera vertices `z`
        (records) and the ends that sent `joined`."""
        p, n, d, distance = z["p"], z["n"], joined.d, dr.minimum(joined.distance, self.reach)
        sides = sides_of(z, wavelengths)
        return transmitted(scene, self.traits, p, n, sides, d, distance, wavelengths, rng, active)


def sent_by_starts(lights, starts, p, time, wavelengths, active):
    """What points of lights (`read_starts`) send to points `p`: `(ds, per, light, mean, pdf_area)`,
    the direction sample, one over the density of the start, and the others as of
    `LightConnection`."""
    reference = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    reference.p, reference.time, reference.wavelengths = p, time, wavelengths
    ds, light = lights.emitted(
        reference, starts["emitter"], starts["p"], starts["n"], starts["uv"], active
    )
    density = lights.pdf_emission_origin(reference, ds, active)
    pdf_area = lights.pdf_emission_area(reference, ds, active)
    per = dr.select(density > 0, dr.rcp(dr.maximum(density, 1e-20)), 0)
    light *= per
    mean = dr.select(
        lights.has_unknown_pdf(ds.emitter, active),
        lights.total_power * pdf_area,
        channel_mean(light),
    )
    return ds, per, light, mean, pdf_area


def list_light_vertices(vertices, count, lengths, first, paths: int, capacity: int, room: int):
    """Places of the vertices of the light sub-paths `first`, `first + 1`, ..., `paths` of them, in
    the order of paths and of each one's vertices, and their number (width one; above `room`: the
    surplus is missing). `lengths`: how many vertices each sub-path has."""
    start = dr.prefix_sum(lengths)
    dr.eval(start)
    last = first + (paths - 1)
    before = dr.gather(mi.UInt32, start, first)
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    vertex = read_vertices(vertices, index, active, ("path", "number"), END)
    active &= (vertex["path"] >= first) & (vertex["path"] < first + paths)
    rank = dr.gather(mi.UInt32, start, vertex["path"], active) + vertex["number"] - before
    places = dr.zeros(mi.UInt32, room)
    dr.scatter(places, index, rank, active & (rank < dr.opaque(mi.UInt32, room)))
    return places, dr.gather(mi.UInt32, start, last) + dr.gather(mi.UInt32, lengths, last) - before
