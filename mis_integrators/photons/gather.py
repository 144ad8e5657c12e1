"""Density estimation: radiance that photons bring to camera vertices.

Photons near a vertex count as if they had met it (Jensen 1996, Realistic image synthesis using
photon mapping). One visit of them serves all plugins that merge; these differ in how a vertex
scatters (`QueryVertices`, `KeptVertices`) and in the weight of each photon.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.traits import lookup
from ..paths.bent_surfaces import FLAGS
from ..paths.lobes import even_bound, even_part
from ..paths.subpaths import vertex_bsdf_of
from ..paths.vertex import SMALLEST_COSINE, per_projected, upright
from .disk_walls import Hidden
from .grid import for_each_photon
from .kernel_sums import KernelSums, disk_area
from .queries import DEPTH, EVEN_PART
from .scattering import Scattering

SAME_SURFACE_COSINE = 0.7
"""Tuned: photons merge only with vertices whose geometric normals differ by less than 45
degrees."""
SAME_SURFACE_OFFSET = 0.5
"""Tuned: ... and that lie closer than this share of the radius along the normal (steps, thin
objects)."""
SAME_PLANE_COSINE_SQUARED = 0.9999
OFF_SHEET = 0.1
"""Tuned: photons further from the vertex' sheet than this share of the radius are on another one,
such as the next slat of a blind, and must be seen. (Without that the blinds of an office are 1.8
times too bright.)"""
LARGEST_COSINE_RATIO = 4.0
"""Tuned: bound on shading over geometric cosine of a photon's direction, which grazing light on
smoothed meshes would exceed."""


class QueryVertices:
    """Vertices that wait for photons (fields as of `queries.read_queries`).

    Lambertian ones scatter every photon alike, but for its cosine: their BSDF is evaluated once,
    and in scenes that have no others none is evaluated for a photon.

    `takes`: which of them take photons; `scale` (a spectrum): a weight that all photons of a vertex
    have; `parted`: the even part of the BSDF scatters alone, where the vertices say so;
    `lobe_widths` (a `LobeWidths`): tells their `lobe_width`, else one.
    """

    def __init__(
        self, traits, record, wavelengths, takes=True, scale=1, parted=False, lobe_widths=None
    ):
        throughput, depth = record["throughput"], record["depth"]
        active = (dr.max(throughput) > 0) & takes
        ray = mi.Ray3f(record["ray_o"], record["ray_d"], 0, wavelengths)
        si = record["hit"].compute_surface_interaction(ray, FLAGS, active)
        self.traits, self.si, self.bsdf, self.active = traits, si, si.bsdf(), active
        self.p, self.n, self.plane, self.depth = si.p, si.n, si.n, depth & DEPTH
        self.path = record["path"]
        self.facing = mi.Frame3f.cos_theta(si.wi)
        self.side = dr.dot(si.n, -ray.d)
        self.first = record.get("first")
        self.factor = mi.Spectrum(throughput) * scale
        self.lobe_width = 1 if lobe_widths is None else lobe_widths.at(self.bsdf, si, active)
        self.even = self.even_bound = None
        if parted:
            self.even = (depth & EVEN_PART) != 0
            self.even_bound = even_bound(self.bsdf, si, active & self.even)
        self.lambertian, self.f, self.pdf = mi.Bool(True), mi.Spectrum(0), mi.Float(0)
        if traits.has_rough:
            self.lambertian = lookup(traits.lambertian, self.bsdf, mi.Bool, active)
        if traits.has_lambertian:
            constant, self.pdf = self.bsdf.eval_pdf(
                mi.BSDFContext(), si, upright(si), active & self.lambertian
            )
            self.f = mi.Spectrum(constant)
            self.factor *= dr.select(self.lambertian, constant, 1)

    def scatter(self, towards, weighted, active):
        """The `Scattering` of light from `towards` (any length); if not `weighted`, its `f` and `p`
        are none."""
        if self.traits.has_rough:
            towards = dr.normalize(towards)  # a Lambertian needs only the ratio of cosines
        wo = self.si.to_local(towards)
        value, f, p = mi.Spectrum(0), self.f, self.pdf
        if self.traits.has_lambertian:
            front = (wo.z * self.facing > 0) & (dr.dot(self.n, towards) * self.side > 0)
            value = mi.Spectrum(dr.select(front & self.lambertian, dr.abs(wo.z), 0))
        if self.traits.has_rough:
            rough = active & ~self.lambertian
            if weighted:
                rough_value, pdf = self.bsdf.eval_pdf(mi.BSDFContext(), self.si, wo, rough)
                scale = per_projected(wo.z)
                f = dr.select(self.lambertian, f, rough_value * scale)
                p = dr.select(self.lambertian, p, pdf * scale)
            else:
                rough_value = self.bsdf.eval(mi.BSDFContext(), self.si, wo, rough)
            if self.even is not None:
                even = even_part(self.even_bound, rough_value, wo)
                rough_value = dr.select(self.even, even, rough_value)
            value = dr.select(self.lambertian, value, rough_value)
        return Scattering(
            towards, dr.abs(wo.z), value, f, p, lambda: self._density_back(wo, active)
        )

    def _density_back(self, wo, active):
        """Density per projected solid angle with which light from `wo` goes on to where the camera
        path came from."""
        if not self.traits.has_rough:
            return self.pdf
        view = mi.SurfaceInteraction3f(self.si)
        view.wi = mi.Vector3f(wo)
        context = mi.BSDFContext(mi.TransportMode.Importance)
        pdf = self.bsdf.pdf(context, view, self.si.wi, active & ~self.lambertian)
        pdf *= per_projected(self.facing)
        return dr.select(self.lambertian, self.pdf, pdf)


class KeptVertices:
    """Kept vertices of camera sub-paths (records as of `subpaths.read_vertices`)."""

    plane = None

    def __init__(self, traits, record, wavelengths, active):
        self.bsdf = vertex_bsdf_of(traits, record, wavelengths, active)
        self.p, self.n, self.depth = record["p"], record["n"], record["depth"]
        self.towards, self.factor, self.active = record["towards"], record["throughput"], active
        self.first = record.get("mark")

    def scatter(self, towards, weighted, active):
        """The `Scattering` of light from `towards` (any length)."""
        towards = dr.normalize(towards)
        value, p, back = self.bsdf.f_and_pdfs(self.towards, towards, active)
        shading = dr.abs(dr.dot(self.bsdf.ns, towards))
        cosine = dr.maximum(dr.abs(dr.dot(self.n, towards)), SMALLEST_COSINE)
        return Scattering(towards, shading, value, value * dr.rcp(cosine), p, lambda: back)


def same_surface(landing, n):
    """Whether photons landed on a surface like that of vertices with normals `n`."""
    alike = dr.dot(landing.n, n)
    return (alike > 0) & (dr.square(alike) > SAME_SURFACE_COSINE**2 * dr.squared_norm(landing.n))


def same_side(landing, n, towards):
    """Whether light from `towards` comes to the same side of the surface where it landed as at
    vertices with normals `n`. Else it grazes the inside of a thin curved sheet, as of a lampshade,
    and would shine through it."""
    return dr.dot(landing.n, towards) * dr.dot(n, towards) > 0


def within_disk(offset, distance_squared, n, radius, height=None):
    """Whether photons, `offset` from vertices, lie within a radius and close to their plane:
    relative to the radius `height` (None: the same)."""
    most = SAME_SURFACE_OFFSET * (radius if height is None else height)
    return (distance_squared < dr.square(radius)) & (dr.abs(dr.dot(offset, n)) < most)


def off_sheet(landing, offset, n):
    """How far photons, `offset` from vertices with normals `n`, are from the sheet of these: a
    chord of a circle is at right angles to the sum of the normals at its ends."""
    return 0.5 * dr.abs(dr.dot(offset, n + dr.normalize(landing.n)))


def landing_cosine(normal, scattering, plane):
    """Geometric cosine of photons where they landed, bounded below; `normal`: the one stored there,
    of any length. Where it is that of the `plane` through the vertex (None: unknown), but for its
    rounding, the plane's cosine."""
    towards = scattering.towards
    length_squared = dr.squared_norm(normal)
    cosine = dr.abs(dr.dot(normal, towards)) * dr.rsqrt(length_squared)
    if plane is not None:
        alike_squared = dr.square(dr.dot(normal, plane))
        flat = alike_squared > SAME_PLANE_COSINE_SQUARED * length_squared
        cosine = dr.select(flat, dr.abs(dr.dot(plane, towards)), cosine)
    least = scattering.shading * (1 / LARGEST_COSINE_RATIO)
    return dr.maximum(dr.maximum(cosine, least), SMALLEST_COSINE)


def gather_photons(
    photon_map,
    vertices,
    radii,
    light_path_count,
    max_depth: int,
    weigh=None,
    grey: bool = False,
    marked: bool = False,
    height=None,
):
    """Radiance that photons bring to camera paths, for each radius of a list, from one visit of
    those within the largest.

    Constant kernel on a disk: the sum over photons of BSDF x flux, over (pi radius^2 x light
    sub-paths). Flux through the surface carries the geometric cosine where the photon landed,
    `path`'s scattering integral the shading one at the vertex, hence the ratio of the two.

    Parameters
    ----------
    photon_map : PhotonMap
    vertices : QueryVertices or KeptVertices
    radii : ascending; each of width one, or one a vertex
    light_path_count : light sub-paths that made the photons
    max_depth : segments of a whole path (negative: unlimited)
    weigh : None, or the weight of a photon, ``weigh(index, landing, scattering, active)``, a
        spectrum or a number, or a list with one for each radius: its index in the map, its
        `Landing` and its `Scattering`
    grey : sums the mean over channels only (fewer sums to keep for many radii)
    marked : the photons are (`photon.write_photon`)
    height : the radius by which photons are close to a vertex' plane (None: that of the disk)

    Returns
    -------
    For each radius a `Spectrum` (`grey`: a `Float`) of the vertices' width, throughput included; if
    `marked` and not `grey` three, one for each of `light_classes.CLASSES`.
    """
    sums = KernelSums(radii, vertices.factor, grey, marked)
    brought = _brought_by(sums, photon_map, vertices, max_depth, weigh, height)

    def visit(index, landing, offset, distance_squared, hit, totals):
        return sums.add(totals, *brought(index, landing, offset, distance_squared, hit))

    active = vertices.active
    totals = for_each_photon(photon_map, vertices.p, radii[-1], active, visit, sums.zeros())
    return sums.estimates(totals, disk_area, light_path_count, active)


def gather_seen(
    scene,
    photon_map,
    vertices,
    walls,
    radii,
    light_path_count,
    max_depth: int,
    grey: bool = False,
    marked: bool = False,
):
    """Radiance as of `gather_photons` at `QueryVertices`, without the photons that are hidden from
    them: those behind `DiskWalls` (a list: for each radius) or on another sheet must be seen."""
    sums = KernelSums(radii, vertices.factor, grey, marked)
    brought = _brought_by(sums, photon_map, vertices, max_depth)

    def visit(index, landing, offset, distance_squared, hit, state):
        before, behind, hidden = state
        value, inside, *rest = brought(index, landing, offset, distance_squared, hit)
        apart = off_sheet(landing, offset, vertices.n)
        is_behind = [each.behind(offset) | (apart > OFF_SHEET * r) for each, r in zip(walls, radii)]
        clear = [here & ~there for here, there in zip(inside, is_behind)]
        before = sums.add(before, value, clear, *rest)
        inside = [here & there for here, there in zip(inside, is_behind)]
        behind = sums.add(behind, value, inside, *rest)
        brings = value * vertices.factor
        hidden = [
            each.add(landing.p, vertices.path, brings, offset, here)
            for each, here in zip(hidden, inside)
        ]
        return before, behind, hidden

    active = vertices.active
    state = sums.zeros(), sums.zeros(), [Hidden.none() for _ in radii]
    before, behind, hidden = for_each_photon(
        photon_map, vertices.p, radii[-1], active, visit, state
    )
    seen = [
        there
        for each, around in zip(hidden, walls)
        for there in [each.seen(scene, vertices, around)] * sums.classes
    ]
    totals = [a + dr.select(there, b, 0) for a, there, b in zip(before, seen, behind)]
    return sums.estimates(totals, disk_area, light_path_count, active)


def _brought_by(sums, photon_map, vertices, max_depth, weigh=None, height=None):
    """A function of a photon, called as `for_each_photon` does (but for the state): what it brings,
    and what `KernelSums.add` wants to know besides."""
    radii = sums.radii

    def brought(index, landing, offset, distance_squared, hit):
        hit &= same_surface(landing, vertices.n)
        if max_depth > 0:
            hit &= landing.depth + vertices.depth <= max_depth
        flux, delta_at_light, towards = sums.read(photon_map, index, hit)
        hit &= same_side(landing, vertices.n, towards)
        value, weights = _contribution(flux, towards, vertices, index, landing, weigh, hit)
        # The largest radius is tested again, too: without, kernels are slower by some per cent.
        inside = [hit & within_disk(offset, distance_squared, vertices.n, r, height) for r in radii]
        return value, inside, vertices, landing, delta_at_light, weights

    return brought


def _contribution(flux, towards, vertices, index, landing, weigh, active):
    """What photons `index` bring, BSDF x flux x weight, over the cosine where they landed; and the
    weights that are not in it, one for each radius (None: none)."""
    scattering = vertices.scatter(towards, weigh is not None, active)
    value, weights = scattering.value, None
    if weigh is not None:
        lit = active & (dr.max(value) > 0)
        weights = weigh(index, landing, scattering, lit)
        if not isinstance(weights, list):
            value *= dr.select(lit, weights, 0)
            weights = None
    return value * flux * dr.rcp(landing_cosine(landing.n, scattering, vertices.plane)), weights


def mean_photon_count(photon_map, vertices, radius):
    """Photons within `radius` of a vertex, on average over the used vertices (a number; what a
    gather costs). `vertices`: as of `read_queries`."""
    active = dr.max(vertices["throughput"]) > 0
    p = vertices["ray_o"] + vertices["ray_d"] * vertices["hit"].t
    (count,) = for_each_photon(
        photon_map,
        p,
        radius,
        active,
        lambda index, landing, offset, distance_squared, hit, counts: (
            counts[0] + dr.select(hit, mi.UInt32(1), 0),
        ),
        (mi.UInt32(0),),
    )
    used = int(dr.count(active)[0])
    return float(dr.sum(mi.Float(count))[0]) / used if used else 0.0
