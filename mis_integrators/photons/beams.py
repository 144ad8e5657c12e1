"""The beam radiance estimate: light that volume photons bring to camera paths, along all of their
way through media at once (Jarosz, Zwicker and Jensen 2008, The beam radiance estimate for
volumetric photon mapping).

The pieces of a camera path's way through media are stored as beams. Photons within the radius of a
beam count by a constant kernel on the disk across the beam, times the phase function and the share
of light that gets from the photon to the camera. There are two kinds of beams (Jarosz et al. 2011,
A comprehensive theory of volumetric radiance estimation using photon points and beams):

- long ones, where a path goes straight on to the next surface (`paths.media.pass_straight`): the
  share of light is computed. All photons count.
- short ones, where a path may scatter on the way (`paths.media.fly`): they end there, and that a
  path gets as far as a photon has the share as its probability. Only caustic photons count: what
  other light there is, the path finds from where it scatters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.packing import unpack_direction
from ..core.recording import lanes
from ..core.records import Layout
from ..core.traits import MediaTraits
from ..paths.media import phase_of_photons, point_in
from .grid import Query, visit_hits
from .kernel_sums import KernelSums, disk_area
from .volume import number_of_medium, read_place

SHORT, LONG = 0, 1 << 31
"""Bit of a beam's depth that tells its kind."""
FIRST = 1 << 30
"""Bit that says that the path has scattered smoothly nowhere before."""
LEVEL_SHIFT = 27
"""Where under weights the three bits of the number of smooth vertices before begin."""
LEAST_COVERAGE = 0.25
"""Share of a disk that photons may lie in, at least: planes stand for walls, which may be bent."""
SLACK = 2e-3
"""Cells that queries reach beyond the radius, for rounding."""


def beam_layout():
    """Fields of a beam: its ray, `length`, the path's throughput at its beginning, the number of
    the path, its depth in segments with this one (with `LONG` and `FIRST`), the medium, and its
    `paths.media.Walls`, normals packed."""
    return Layout(
        {
            "o": mi.Point3f,
            "path": mi.UInt32,
            "d": mi.Vector3f,
            "depth": mi.UInt32,
            "throughput": mi.Spectrum,
            "length": mi.Float,
            "medium": mi.MediumPtr,
            "normal_behind": mi.UInt32,
            "behind": mi.Float,
            "normal_ahead": mi.UInt32,
            "ahead": mi.Float,
        }
    )


def new_beams(capacity):
    """Room for `capacity` beams; unused ones are zero."""
    return dr.zeros(mi.UInt32, beam_layout().words * capacity)


def read_beams(words):
    """All beams of a buffer, a dictionary of their fields."""
    return beam_layout().read(words, lanes(beam_layout().capacity(words)))


@dataclass
class Beams:
    """Beams of a buffer (`new_beams`), one a lane: the fields of `beam_layout` (normals unpacked,
    towards the beam), which are `active`, `long` and `first`, under weights their `level`, and the
    `extinction` by which light falls along them (zero for short ones and in heterogeneous
    media)."""

    o: mi.Point3f
    d: mi.Vector3f
    length: mi.Float
    throughput: mi.Spectrum
    path: mi.UInt32
    depth: mi.UInt32
    medium: mi.MediumPtr
    normal_behind: mi.Vector3f
    behind: mi.Float
    normal_ahead: mi.Vector3f
    ahead: mi.Float
    active: mi.Bool
    long: mi.Bool
    first: mi.Bool
    level: mi.UInt32
    extinction: mi.Spectrum
    wavelengths: mi.Float
    traits: MediaTraits

    @classmethod
    def read(cls, words, wavelengths, traits):
        """All beams of a buffer."""
        record = read_beams(words)
        active = dr.max(record["throughput"]) > 0
        medium = dr.select(active, record["medium"], dr.zeros(mi.MediumPtr))
        at_start = point_in(medium, record["o"], mi.Float(0), wavelengths, -record["d"])
        long, first = (record["depth"] & LONG) != 0, (record["depth"] & FIRST) != 0
        even = active & long & medium.is_homogeneous()
        _, _, sigma_t = medium.get_scattering_coefficients(at_start, even)
        extinction = dr.select(even, sigma_t, 0)
        normals = {}
        for name, towards in (("normal_behind", record["d"]), ("normal_ahead", -record["d"])):
            normal = dr.normalize(unpack_direction(record[name]))
            normals[name] = dr.mulsign(normal, dr.dot(normal, towards))
        level = (record["depth"] >> LEVEL_SHIFT) & 7
        record["depth"] &= (1 << LEVEL_SHIFT) - 1
        record |= {"medium": medium, **normals, "long": long, "first": first}
        record |= {"level": level, "extinction": extinction}
        return cls(**record, active=active, wavelengths=wavelengths, traits=traits)

    def takes(self, landing, all_kinds=False):
        """Whether photons (`VolumeLanding`) are of a kind that counts, in the beams' own medium."""
        own = landing.medium == number_of_medium(self.medium)
        return own if all_kinds else own & (self.long | landing.caustic)

    def between_walls(self, p):
        """Whether points lie on the beam's side of the tangent planes of its walls. Behind a thin
        wall there may be light that does not get through."""
        begins = dr.dot(p - self.o + self.d * self.behind, self.normal_behind) > 0
        ends = dr.dot(p - self.o - self.d * self.ahead, self.normal_ahead) > 0
        return (~dr.isfinite(self.behind) | begins) & (~dr.isfinite(self.ahead) | ends)

    def coverage(self, along, radius):
        """Share of the disk of that radius across the beam, at a distance `along` it, that lies
        `between_walls`: only there are photons. `LEAST_COVERAGE` at least."""
        begins = _side(self.normal_behind, self.d, self.behind + along, radius)
        ends = _side(self.normal_ahead, self.d, self.ahead - along, radius)
        # Walls cut the same part of the disk, or opposite ones.
        alike = dr.dot(dr.cross(self.normal_behind, self.d), dr.cross(self.normal_ahead, self.d))
        both = dr.select(alike > 0, dr.minimum(begins, ends), begins + ends - 1)
        return dr.maximum(both, LEAST_COVERAGE)

    def phase(self, p, towards, active):
        """The phase function [1/sr] at points `p`, for light sub-paths from `towards` that go on to
        the camera, and the density with which camera paths go there."""
        where = self.medium, p, self.wavelengths, -self.d, towards, active
        value, pdf, adjoint = phase_of_photons(self.traits, *where)
        return value * adjoint, pdf


def _side(normal, d, distance, radius):
    """Share of a disk, across the direction `d` and so far from a plane along it, on the near side
    of the plane: the disk's centre is `distance` |n.d| / |n x d| from the line that cuts it, and a
    line at x radii from the centre cuts off (arccos x - x sqrt(1 - x^2)) / pi."""
    cosine = dr.abs(dr.dot(normal, d))
    sine = dr.safe_sqrt(1 - dr.square(cosine))
    x = distance * cosine * dr.rcp(dr.maximum(sine, 1e-6) * radius)
    x = dr.clip(dr.select(dr.isfinite(distance), x, 1), 0, 1)
    return 1 - (dr.acos(x) - x * dr.safe_sqrt(1 - x * x)) * dr.inv_pi


class BeamQuery(Query):
    """The rows within `radius` of beams.

    Rows (y, z) are visited in slabs of the axis along which the beam is longer, the `main` one.
    A row's place is that of its slab, and the rows of the slab before it. The beam begins where it
    enters the `box` of the photons, `skipped` after its own beginning.
    """

    def __init__(self, photon_map, beams, radius):
        super().__init__(photon_map, radius)
        grid, box, active = self.grid, photon_map.box, beams.active
        margin = 1.001 * radius
        self.skipped, end = _within(box.min - margin, box.max + margin, beams)
        active = active & (self.skipped < end)
        self.o = beams.o + beams.d * dr.select(active, self.skipped, 0)
        self.d, self.length = beams.d, dr.select(active, end - self.skipped, 0)
        inverse = dr.rcp(grid.cell)
        self.reach = radius * inverse * 1.0001 + SLACK
        o, d = (self.o - grid.origin) * inverse, self.d * inverse
        self.main_y = dr.abs(d.y) >= dr.abs(d.z)
        self.x = o.x, d.x
        self.main = dr.select(self.main_y, o.y, o.z), dr.select(self.main_y, d.y, d.z)
        self.other = dr.select(self.main_y, o.z, o.y), dr.select(self.main_y, d.z, d.y)
        self.first, self.last = self._cells(self.main, 0, self.length)
        self.last = dr.select(active, self.last, self.first - 1)

    def _cells(self, line, begin, end):
        """First and last cell within reach of a stretch, along an axis."""
        a, b = line[0] + line[1] * begin, line[0] + line[1] * end
        first = dr.floor(dr.minimum(a, b) - self.reach)
        last = dr.floor(dr.maximum(a, b) + self.reach)
        return mi.Int32(first), mi.Int32(last)

    def _near(self, line, cell, begin, end):
        """The part of a stretch that is within reach of a cell, along an axis."""
        inverse = dr.select(dr.abs(line[1]) > 1e-20, dr.rcp(line[1]), 1e20)
        cell = mi.Float(cell)
        a = (cell - self.reach - line[0]) * inverse
        b = (cell + 1 + self.reach - line[0]) * inverse
        return dr.maximum(dr.minimum(a, b), begin), dr.minimum(dr.maximum(a, b), end)

    def _slab(self, slab):
        """The part of the beam within reach of a slab, and the first and last row there."""
        begin, end = self._near(self.main, slab, 0, self.length)
        first, last = self._cells(self.other, begin, end)
        return begin, end, first, dr.select(begin <= end, last, first - 1)

    def _row(self, slab, row):
        """Cell coordinates (y, z) of a row."""
        return dr.select(self.main_y, slab, row) + 2, dr.select(self.main_y, row, slab) + 2

    def begin(self):
        return mi.Int32(self.first), mi.Int32(0), mi.UInt32(0), mi.UInt32(0)

    def unfinished(self, place):
        return place[0] <= self.last

    def read(self, index):
        """The `VolumeLanding` of photons `index`, and its offset from the beam's beginning."""
        landing = read_place(self.photon_map.place, index)
        return landing, landing.p - self.o

    def distance_squared(self, offset):
        """Squared distance from the beam's line."""
        return dr.squared_norm(offset - self.d * dr.dot(offset, self.d))

    def is_hit(self, offset):
        along = dr.dot(offset, self.d)
        near = dr.squared_norm(offset - self.d * along) < self.radius_squared
        return near & (along >= 0) & (along < self.length)

    def photons_of_row(self, slab, number):
        """First photon, and the one after the last, of the cells of a row within reach."""
        begin, end, first, last = self._slab(slab)
        row = first + number
        begin, end = self._near(self.other, row, begin, end)
        first_x, last_x = self._cells(self.x, begin, end)
        most = self.grid.table.longest - 4
        first_x, last_x = dr.clip(first_x + 2, 0, most), dr.clip(last_x + 2, -1, most)
        near = (begin <= end) & (row <= last) & (last_x >= first_x)
        y, z = self._row(slab, row)
        # Rows outside of the box hold nothing, and would have the numbers of others inside.
        near &= mi.UInt32(y) < self.grid.lines
        base = self.grid.row(y, z)
        start = self.photon_map.start
        return (
            dr.gather(mi.UInt32, start, base + mi.UInt32(first_x), near),
            dr.gather(mi.UInt32, start, base + mi.UInt32(last_x) + 1, near),
        )

    def number(self, slab, number):
        """The row's number."""
        _, _, first, _ = self._slab(slab)
        return self.grid.row_number(*self._row(slab, first + number))

    def next_row(self, slab, number, done):
        """The row after this one, where that is `done`."""
        _, _, first, last = self._slab(slab)
        wrap = first + number >= last
        following = dr.select(done, dr.select(wrap, 0, number + 1), number)
        return dr.select(done & wrap, slab + 1, slab), following


def _within(low, high, beams):
    """Where beams enter a box and leave it: distances from their beginning, the first one not
    smaller than the second where they miss it."""
    begin, end = mi.Float(0), mi.Float(beams.length)
    for axis in range(3):
        o, d = beams.o[axis], beams.d[axis]
        inverse = dr.select(dr.abs(d) > 1e-20, dr.rcp(d), 1e20)
        a, b = (low[axis] - o) * inverse, (high[axis] - o) * inverse
        begin = dr.maximum(begin, dr.minimum(a, b))
        end = dr.minimum(end, dr.maximum(a, b))
    return begin, end


def gather_along(
    photon_map,
    beams,
    radii,
    light_path_count,
    max_depth,
    grey=False,
    marked=False,
    weigh=None,
    near_zone=None,
):
    """Radiance that volume photons bring to camera paths along beams, for each radius of a list:
    the sum over photons of phase function x flux x transmittance to the beam's beginning, over
    (pi radius^2 x light sub-paths) (Jarosz et al. 2008, with a constant kernel). The radius is the
    photon's own share of that of the list. Of a disk that walls cut, only what lies between them
    counts (`Beams.coverage`).

    Parameters and result are those of `gather.gather_photons`, but for ``weigh(index, pdf,
    active)``: the weight (a number) of a photon to which camera paths would go on with density
    `pdf`. Photons count for beams in their own medium only, not behind the surface that ends the
    beam, and for short beams, unless they are weighed, only caustic ones.

    Where a `near_zone` (a `NearZone`) is given, beams of first segments have its radius, and gather
    the photons within it only.
    """
    if near_zone is not None:
        seen = beams.depth == 1
        radii = [dr.select(seen, near_zone.radius, radius) for radius in radii]
    query = BeamQuery(photon_map, beams, radii[-1])
    sums = KernelSums(radii, beams.throughput, grey, marked)

    def visit(index, landing, offset, distance_squared, hit, totals):
        hit &= beams.takes(landing, weigh is not None) & beams.between_walls(landing.p)
        if near_zone is not None:
            hit &= ~seen | near_zone.holds(landing.p)
        if max_depth > 0:
            hit &= landing.depth + beams.depth <= max_depth
        flux, delta_at_light, towards = sums.read(photon_map, index, hit)
        along = query.skipped + dr.dot(offset, query.d)
        phase, pdf = beams.phase(landing.p, dr.normalize(towards), hit)
        value = flux * phase
        if weigh is not None:
            value *= dr.select(hit, weigh(index, pdf, hit), 0)
        value *= dr.exp(-beams.extinction * along)
        share = dr.square(landing.share)
        inside = [hit & (distance_squared < dr.square(radius) * share) for radius in radii]
        own = [dr.rcp(beams.coverage(along, radius * landing.share)) for radius in radii]
        return sums.add(totals, value / share, inside, beams, landing, delta_at_light, own)

    totals = visit_hits(query, visit, sums.zeros())
    return sums.estimates(totals, disk_area, light_path_count, beams.active)


def mean_count_along(photon_map, beams, radius, paths, near_zone=None):
    """Photons within `radius` of the beams of a camera path that a query has to look at, on average
    over `paths` of them (a number). Where there is a `near_zone`, first segments have another
    radius, and do not count."""
    if near_zone is not None:
        beams = replace(beams, active=beams.active & (beams.depth > 1))
    query = BeamQuery(photon_map, beams, radius)
    (count,) = visit_hits(
        query,
        lambda index, landing, offset, distance_squared, hit, counts: (
            counts[0] + dr.select(hit & beams.takes(landing), mi.UInt32(1), 0),
        ),
        (mi.UInt32(0),),
    )
    return float(dr.sum(mi.Float(count))[0]) / paths
