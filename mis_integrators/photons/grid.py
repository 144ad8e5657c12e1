"""The photon map: photons sorted by the cells of a spatial grid, and the query that visits those
within a radius.

Cells are numbered along x, then y, then z, modulo the size of a table: small grids fit it, larger
ones wrap around. The cells of one row (equal y and z) are neighbours in memory, so a query reads
one contiguous range of photons a row. Rows that share their place with others are told apart by the
photons' own positions, so that no photon is visited twice.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import bits_float, unpack_caustic
from .trace import photon_words

RUN = 32
"""Photons of a row that a query tests at once: one bit of a word each."""
KEPT_RUNS = 4
"""Runs with hits that a query keeps before it visits these."""


def table_size(capacity):
    """Table entries (a power of two) for `capacity` photons: two or more each, so that small grids
    fit."""
    return 1 << max(10, min(24, (2 * max(capacity, 2) - 1).bit_length()))


def longest_row(size):
    """Cells that a row may have: the table goes on for as many entries, so that no row wraps around
    within itself."""
    return size // 4


def smallest_cell(bbox, capacity):
    """The smallest cell size with which a row of cells still fits into the table."""
    extent = float(bbox.max.x - bbox.min.x)
    return extent / (longest_row(table_size(capacity)) - 8)


class Grid:
    """Cells of edge `cell` (width one) over a bounding box, with two cells of margin.

    Odd numbers of columns and rows keep layers apart when numbers wrap around a table whose size is
    a power of two.
    """

    def __init__(self, bbox, cell, size):
        self.origin, self.cell, self.size = mi.Point3f(bbox.min), cell, size
        extent = mi.Vector3f(bbox.max - bbox.min)
        self.columns = (mi.UInt32(dr.floor(extent.x / cell)) + 5) | 1
        self.lines = (mi.UInt32(dr.floor(extent.y / cell)) + 5) | 1

    def coordinates(self, p):
        """Integer cell coordinates of points `p`."""
        return mi.Vector3i(dr.floor((p - self.origin) / self.cell)) + 2

    def row_number(self, y, z):
        """A number that tells row (y, z) from all others of the box, and rows near one another in
        any."""
        return mi.UInt32(z) * self.lines + mi.UInt32(y)

    def row(self, y, z):
        """Table entry of the cell x = 0 of row (y, z); x counts up from there."""
        return (self.row_number(y, z) * self.columns) & (self.size - 1)


class PhotonMap:
    """Sorted photons: a `grid`, `start` (first photon of each table entry), `surface` and `power`
    as in `trace_light_paths`. Its `mis_words` stay where light sub-paths left them, for few of them
    are ever read: `place` tells of each sorted photon where."""

    def __init__(self, grid, start, surface, power, mis_words=None, place=None):
        self.grid, self.start, self.surface, self.power, self.mis_words, self.place = (
            grid,
            start,
            surface,
            power,
            mis_words,
            place,
        )

    def arrays(self):
        """What a recorded function can take; `with_grid` makes the map of it again."""
        arrays = {"start": self.start, "surface": self.surface, "power": self.power}
        return (
            arrays
            if self.mis_words is None
            else {**arrays, "mis_words": self.mis_words, "place": self.place}
        )

    def place_of_mis_words(self, index, active):
        """Where among the `mis_words` those of photon `index` are."""
        return dr.gather(mi.UInt32, self.place, index, active)

    @classmethod
    def with_grid(cls, arrays, bbox, cell, capacity: int):
        """The map of `arrays`, built with the same box, cell size and capacity."""
        return cls(Grid(bbox, cell, table_size(capacity)), **arrays)


def build_photon_map(surface, power, count, bbox, cell, capacity: int, kind: str, mis_words=None):
    """Sorts photons into a grid of cells of edge `cell` (width one) over `bbox`.

    `kind`: "all", "caustic" or "indirect" selects the photons; `mis_words` (None: there are none)
    stay unsorted. Three passes over the photons: count, prefix sum, scatter.
    """
    size = table_size(capacity)
    grid = Grid(bbox, cell, size)
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    record = dr.gather(mi.Vector4u, surface, index, active)
    if kind != "all":
        active &= unpack_caustic(record.w) == (kind == "caustic")
    p = mi.Point3f(bits_float(record.x), bits_float(record.y), bits_float(record.z))
    coordinates = grid.coordinates(p)
    slot = grid.row(coordinates.y, coordinates.z) + dr.minimum(
        mi.UInt32(coordinates.x), longest_row(size) - 4
    )
    counts = dr.zeros(mi.UInt32, size + longest_row(size))
    rank = dr.scatter_inc(counts, slot, active)
    dr.eval(counts, rank, slot)
    start = dr.prefix_sum(counts)
    dr.eval(start)
    target = dr.gather(mi.UInt32, start, slot, active) + rank
    sorted_surface = dr.empty(mi.UInt32, 4 * capacity)
    dr.scatter(sorted_surface, record, target, active)
    words = photon_words()
    sorted_power = _moved(power, words, capacity, index, target, active)
    place = None
    if mis_words is not None:
        place = dr.empty(mi.UInt32, capacity)
        dr.scatter(place, index, target, active)
    dr.eval(sorted_surface, sorted_power, place)
    return PhotonMap(grid, start, sorted_surface, sorted_power, mis_words, place)


def _moved(source, words, capacity, index, target, active):
    """Records of `words` words (2, or a multiple of 4) copied from places `index` to places
    `target`."""
    result = dr.empty(mi.UInt32, words * capacity)
    packet = mi.Vector2u if words == 2 else mi.Vector4u
    parts = max(words // 4, 1)
    for part in range(parts):
        dr.scatter(
            result,
            dr.gather(packet, source, parts * index + part, active),
            parts * target + part,
            active,
        )
    return result


def read_power(power, index, active):
    """Flux (a `Spectrum`, for one light sub-path) and packed direction of the photons `index` of an
    array of power records."""
    words = photon_words()
    if words == 2:
        record = dr.gather(mi.Vector2u, power, index, active)
        return mi.Spectrum(bits_float(record.x)), record.y
    if words == 4:
        record = dr.gather(mi.Vector4u, power, index, active)
        return mi.Spectrum(
            bits_float(record.x), bits_float(record.y), bits_float(record.z)
        ), record.w
    record = dr.gather(mi.Vector4u, power, 2 * index, active)
    direction = dr.gather(mi.UInt32, power, 8 * index + 4, active)
    return mi.Spectrum(*[bits_float(record[i]) for i in range(4)]), direction


def for_each_photon(photon_map, p, radius, active, visit, state):
    """Calls `visit(index, record, offset, distance_squared, hit, state) -> state` for photons
    within `radius` of `p`.

    Lanes of a CPU's SIMD unit wait for one another in every loop, and two photons in three of the
    cells around `p` miss, so what is dear to do with a hit must not go in step with the misses. Row
    by row of cells, runs of up to `RUN` photons are tested for distance only; the hits of a run are
    kept as a word of bits. Once a lane keeps `KEPT_RUNS` runs with hits, or has seen all rows, the
    hits of all of these are visited. `hit` marks the lanes whose photon belongs to the row that has
    been read (another one may share its place); `record` holds the photon's surface words, `offset`
    is its position minus `p`. `state` is a tuple of Dr.Jit arrays.
    """
    grid = photon_map.grid
    inverse = dr.rcp(grid.cell)
    local = (p - grid.origin) * inverse
    reach = radius * inverse * 1.0001
    first_y, last_y = (
        mi.Int32(dr.floor(local.y - reach)) + 2,
        mi.Int32(dr.floor(local.y + reach)) + 2,
    )
    first_z, last_z = (
        mi.Int32(dr.floor(local.z - reach)) + 2,
        mi.Int32(dr.floor(local.z + reach)) + 2,
    )
    last_z = dr.select(active, last_z, first_z - 1)
    radius_squared = dr.square(radius)

    def read(index):
        record = dr.gather(mi.Vector4u, photon_map.surface, index)
        position = mi.Point3f(bits_float(record.x), bits_float(record.y), bits_float(record.z))
        return record, position, position - p

    def test(index, bit, hits):
        _, _, offset = read(index)
        return (
            index + 1,
            bit << 1,
            hits | dr.select(dr.squared_norm(offset) < radius_squared, bit, 0),
        )

    def search(y, z, start, end, runs):
        first, last = _photons_of_row(photon_map, y, z, local, reach)
        on = start < end  # still in a row that is longer than a run
        start, end = dr.select(on, start, first), dr.select(on, end, last)
        until = dr.minimum(start + RUN, end)
        *_, hits = dr.while_loop(
            (mi.UInt32(start), mi.UInt32(1), mi.UInt32(0)),
            lambda index, bit, hits: index < until,
            test,
            label="photons tested",
        )
        runs = _chosen(hits != 0, [(start, hits, grid.row_number(y, z)), *runs[:-1]], runs)
        done, wrap = until >= end, y >= last_y
        y, z = dr.select(done, dr.select(wrap, first_y, y + 1), y), dr.select(done & wrap, z + 1, z)
        return y, z, dr.select(done, 0, until), dr.select(done, 0, end), runs

    def meet(runs, state):
        start, hits, row = runs[0]
        index = start + dr.tzcnt(hits)
        record, position, offset = read(index)
        own = grid.coordinates(position)
        state = visit(
            index,
            record,
            offset,
            dr.squared_norm(offset),
            grid.row_number(own.y, own.z) == row,
            state,
        )
        hits &= hits - 1
        return _chosen(hits == 0, [*runs[1:], _no_run()], [(start, hits, row), *runs[1:]]), state

    def search_and_meet(y, z, start, end, state):
        runs = [_no_run() for _ in range(KEPT_RUNS)]
        y, z, start, end, runs = dr.while_loop(
            (y, z, start, end, runs),
            lambda y, z, start, end, runs: (z <= last_z) & (runs[-1][1] == 0),
            search,
            label="rows",
        )
        _, state = dr.while_loop(
            (runs, state), lambda runs, state: runs[0][1] != 0, meet, label="photons met"
        )
        return y, z, start, end, state

    begin = mi.Int32(first_y), mi.Int32(first_z), mi.UInt32(0), mi.UInt32(0), state
    return dr.while_loop(begin, lambda y, z, *_: z <= last_z, search_and_meet, label="photons")[-1]


def _no_run():
    """A run without hits: its first photon, its hits (a bit each), the number of its row."""
    return mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)


def _chosen(condition, these, others):
    """`dr.select` for lists of runs."""
    return [
        tuple(dr.select(condition, a, b) for a, b in zip(this, other))
        for this, other in zip(these, others)
    ]


def _photons_of_row(photon_map, y, z, local, reach):
    """First photon, and the one after the last, of the cells of row (y, z) within `reach` of
    `local` (both in cells)."""
    grid = photon_map.grid
    longest = longest_row(grid.size)
    low_y, low_z = mi.Float(y - 2), mi.Float(z - 2)
    distance_y = dr.maximum(dr.maximum(low_y - local.y, local.y - low_y - 1), 0)
    distance_z = dr.maximum(dr.maximum(low_z - local.z, local.z - low_z - 1), 0)
    left = dr.square(reach) - dr.square(distance_y) - dr.square(distance_z)
    half = dr.safe_sqrt(left) + 1e-3
    first_x = dr.clip(mi.Int32(dr.floor(local.x - half)) + 2, 0, longest - 4)
    last_x = dr.clip(mi.Int32(dr.floor(local.x + half)) + 2, -1, longest - 4)
    base = grid.row(y, z)
    near = (left > -1e-3) & (last_x >= first_x)
    return (
        dr.gather(mi.UInt32, photon_map.start, base + mi.UInt32(first_x), near),
        dr.gather(mi.UInt32, photon_map.start, base + mi.UInt32(last_x) + 1, near),
    )
