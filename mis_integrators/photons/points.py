"""Point-point density estimation in media: radiance that volume photons bring to camera vertices
that lie there.

Photons within the radius count by a constant kernel on the ball around the vertex (Jensen and
Christensen 1998, Efficient simulation of light transport in scenes with participating media using
photon maps). Compared with beams (`photons.beams`), only photons around one point of the camera's
way count, so that the estimate is noisier. But what a vertex gathers depends on the path up to
there alone, as weights of several strategies need it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.recording import lanes
from ..core.records import Layout
from ..core.traits import MediaTraits
from ..paths.media import phase_of_photons, scattered_share
from .grid import DiskQuery, visit_hits
from .kernel_sums import KernelSums, ball_volume
from .scattering import Scattering
from .volume import number_of_medium, read_place

SMALLEST_SCATTERING = 1e-12
"""Stands for the scattering coefficient where a medium only absorbs: no photon is left there."""


def point_layout():
    """Fields of a camera vertex in a medium that waits for photons: position, number of the path,
    direction `d` of the ray that led there, `depth` in segments, the path's throughput with this
    scattering's albedo, the medium."""
    return Layout(
        {
            "p": mi.Point3f,
            "path": mi.UInt32,
            "d": mi.Vector3f,
            "depth": mi.UInt32,
            "throughput": mi.Spectrum,
            "medium": mi.MediumPtr,
        }
    )


def new_points(capacity):
    """Room for `capacity` vertices; unused ones are zero."""
    return dr.zeros(mi.UInt32, point_layout().words * capacity)


def read_points(words, first=0, count=None):
    """The vertices of a buffer, or `count` of them from place `first` on: a dictionary."""
    index = lanes(point_layout().capacity(words) if count is None else count) + first
    return point_layout().read(words, index)


@dataclass
class Points:
    """Vertices in media, one a lane: the fields of `point_layout`, which are `active`, which have
    scattered nowhere before (`first`; None: nobody asks), their coefficients, and the scene's
    `MediaTraits`."""

    p: mi.Point3f
    d: mi.Vector3f
    depth: mi.UInt32
    throughput: mi.Spectrum
    medium: mi.MediumPtr
    active: mi.Bool
    first: mi.Bool | None
    wavelengths: mi.Float
    scattering: mi.Spectrum
    albedo: mi.Spectrum
    extinction: mi.Float
    traits: MediaTraits

    @classmethod
    def of(cls, traits, record, wavelengths):
        """The vertices of records as of `read_points` (a `first` among them, if there is one)."""
        active = dr.max(record["throughput"]) > 0
        medium = dr.select(active, record["medium"], dr.zeros(mi.MediumPtr))
        where = medium, record["p"], wavelengths, active
        sigma_s, albedo, extinction = scattered_share(*where)
        if traits.has_flakes:
            sigma_s, _, _ = scattered_share(*where, -record["d"])
        return cls(
            record["p"],
            record["d"],
            record["depth"],
            record["throughput"],
            medium,
            active,
            record.get("first"),
            wavelengths,
            sigma_s,
            albedo,
            extinction,
            traits,
        )

    def scattering_around(self, p, active):
        """Scattering coefficient [1/m] by which the power that photons at `p` have left per volume
        is divided: the larger one of theirs and the vertex's own, so that at the rim of a cloud
        neither makes a firefly. Where the medium is even both are the same."""
        if not self.traits.has_grids:
            return dr.maximum(self.scattering, SMALLEST_SCATTERING)
        medium = dr.select(active, self.medium, dr.zeros(mi.MediumPtr))
        there, _, _ = scattered_share(medium, p, self.wavelengths, active, -self.d)
        return dr.maximum(dr.maximum(there, self.scattering), SMALLEST_SCATTERING)

    def phase(self, towards, active):
        """`Scattering` of light sub-paths from `towards` (a unit vector): there are no cosines."""
        where = self.medium, self.p, self.wavelengths, -self.d, towards, active
        value, pdf, adjoint = phase_of_photons(self.traits, *where)
        f = value * self.albedo
        value = mi.Spectrum(value) * adjoint
        return Scattering(towards, mi.Float(1), value, f, pdf, lambda: pdf * adjoint)


class BallQuery(DiskQuery):
    """The rows of volume photons within `radius` of points."""

    def read(self, index):
        """The `VolumeLanding` of photons `index`, and its offset from the points."""
        landing = read_place(self.photon_map.place, index)
        return landing, landing.p - self.p


def takes(points, landing, straight):
    """Whether photons (`VolumeLanding`) count for the points: those in the same medium; light that
    comes straight from a light (`straight`) is next-event estimation's, if it is not asked for."""
    own = landing.medium == number_of_medium(points.medium)
    return own if straight else own & (landing.caustic | (landing.depth > 1))


def gather_in_balls(
    photon_map,
    points,
    radii,
    light_path_count,
    max_depth: int,
    weigh,
    grey=False,
    marked=False,
    straight=False,
):
    """Radiance that volume photons bring to vertices in media, for each radius of a list: the sum
    over photons of phase function x flux over the scattering coefficient, over (4/3 pi radius^3 x
    light sub-paths).

    A photon has the albedo of its scattering in its flux, and the camera's throughput has that of
    its own: what is divided by is the coefficient of both. Parameters and result are those of
    `gather.gather_photons`; `weigh` is called with a `VolumeLanding`; `straight`: as of `takes`.
    """
    sums = KernelSums(radii, points.throughput, grey, marked)

    def visit(index, landing, offset, distance_squared, hit, totals):
        hit &= takes(points, landing, straight)
        if max_depth > 0:
            hit &= landing.depth + points.depth <= max_depth
        flux, delta_at_light, towards = sums.read(photon_map, index, hit)
        scattering = points.phase(dr.normalize(towards), hit)
        value = flux * scattering.value / points.scattering_around(landing.p, hit)
        value *= dr.select(hit, weigh(index, landing, scattering, hit), 0)
        inside = [hit & (distance_squared < dr.square(radius)) for radius in radii]
        return sums.add(totals, value, inside, points, landing, delta_at_light)

    query = BallQuery(photon_map, points.p, radii[-1], points.active)
    totals = visit_hits(query, visit, sums.zeros())
    return sums.estimates(totals, ball_volume, light_path_count, points.active)


def mean_count_in_balls(photon_map, points, radius):
    """Photons within `radius` of a vertex, on average over the used ones (a number)."""
    query = BallQuery(photon_map, points.p, radius, points.active)
    (count,) = visit_hits(
        query,
        lambda index, landing, offset, distance_squared, hit, counts: (
            counts[0] + dr.select(hit & takes(points, landing, False), mi.UInt32(1), 0),
        ),
        (mi.UInt32(0),),
    )
    used = int(dr.count(points.active)[0])
    return float(dr.sum(mi.Float(count))[0]) / used if used else 0.0
