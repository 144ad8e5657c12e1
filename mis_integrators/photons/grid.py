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

from .photon import landing_of, power_layout, read_landing, surface_layout

RUN = 32
"""Photons of a row that a query tests at once: one bit of a word each."""
KEPT_RUNS = 4
"""Tuned: runs with hits that a query keeps before it visits these."""


def table_size(capacity):
    """Table entries (a power of two) for `capacity` photons: two or more each, so that small grids
    fit."""
    return 1 << max(10, min(24, (2 * max(capacity, 2) - 1).bit_length()))


def longest_row(size):
    """Cells that a row may have: the table goes on for as many entries, so that no row wraps around
    within itself."""
    return size // 4


class Table:
    """The table of a grid for `capacity` photons: its `size`, and the `longest` row that it may
    have. Its size is no literal of kernels, which would be compiled anew for each."""

    def __init__(self, capacity):
        self.size = table_size(capacity)
        self.mask = dr.opaque(mi.UInt32, self.size - 1)
        self.longest = dr.opaque(mi.Int32, longest_row(self.size))

    @property
    def room(self):
        """Entries that the table takes, with those beyond its end."""
        return self.size + longest_row(self.size)

    def first_entry(self, number):
        """The first entry of the `number`-th of several tables (an array)."""
        return number * (self.mask + 1 + mi.UInt32(self.longest))


class Grid:
    """Cells of edge `cell` (width one) or, where rows of such cells would not fit into the `table`
    (a `Table`), of the next larger one, over a bounding box, with two cells of margin.

    Odd numbers of columns and rows keep slices apart when numbers wrap around the table, whose size
    is a power of two. It may be a part of a larger one, from entry `first` on.
    """

    def __init__(self, bbox, cell, table, first=0):
        self.origin, self.table, self.first = mi.Point3f(bbox.min), table, first
        extent = mi.Vector3f(bbox.max - bbox.min)
        self.cell = dr.maximum(cell, extent.x / mi.Float(table.longest - 8))
        self.columns = (mi.UInt32(dr.floor(extent.x / self.cell)) + 5) | 1
        self.lines = (mi.UInt32(dr.floor(extent.y / self.cell)) + 5) | 1

    def coordinates(self, p):
        """Integer cell coordinates of points `p`."""
        return mi.Vector3i(dr.floor((p - self.origin) / self.cell)) + 2

    def row_number(self, y, z):
        """A number that tells row (y, z) from all others of the box, and rows near one another in
        any."""
        return mi.UInt32(z) * self.lines + mi.UInt32(y)

    def row(self, y, z):
        """Table entry of the cell x = 0 of row (y, z); x counts up from there."""
        return ((self.row_number(y, z) * self.columns) & self.table.mask) + self.first


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
        return cls(Grid(bbox, cell, Table(capacity)), **arrays)


def sort_by_cell(grid, p, active, tables=1):
    """Sorts photons at `p` by the grid's cells: `(start, target)`, the first photon of each table
    entry, and the place of each photon. Three passes: count, prefix sum, scatter (the last one is
    left to the caller). `tables`: how many there are, one for each value of the grid's `first`."""
    coordinates = grid.coordinates(p)
    slot = grid.row(coordinates.y, coordinates.z) + dr.minimum(
        mi.UInt32(coordinates.x), mi.UInt32(grid.table.longest - 4)
    )
    counts = dr.zeros(mi.UInt32, tables * grid.table.room)
    rank = dr.scatter_inc(counts, slot, active)
    dr.eval(counts, rank, slot)
    start = dr.prefix_sum(counts)
    dr.eval(start)
    return start, dr.gather(mi.UInt32, start, slot, active) + rank


def build_photon_map(surface, power, count, bbox, cell, capacity: int, kind: str, mis_words=None):
    """Sorts photons into a grid of cells of edge `cell` (width one) over `bbox`.

    `kind`: "all", "caustic" or "indirect" selects the photons; `mis_words` (None: there are none)
    stay unsorted.
    """
    grid = Grid(bbox, cell, Table(capacity))
    record, active = read_photons(surface, count, capacity)
    landing = landing_of(record)
    if kind != "all":
        active &= landing.caustic == (kind == "caustic")
    start, surface, power, target = sorted_photons(grid, record, power, active)
    place = None if mis_words is None else places_before(target, active)
    return PhotonMap(grid, start, surface, power, mis_words, place)


def places_before(target, active):
    """Where photons that have gone to the places `target` were before, by where they are now."""
    place = dr.empty(mi.UInt32, dr.width(target))
    dr.scatter(place, dr.arange(mi.UInt32, dr.width(target)), target, active)
    dr.eval(place)
    return place


def read_photons(surface, count, capacity):
    """Records of `surface_layout`, and which of them are photons."""
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    return surface_layout().read(surface, index, active), active


def sorted_photons(grid, record, power, active, tables=1):
    """Photons with the `record` of `surface_layout`, sorted: `start` as of `sort_by_cell`, both
    records, and where each photon has gone."""
    capacity = power_layout().capacity(power)
    index = dr.arange(mi.UInt32, capacity)
    start, target = sort_by_cell(grid, record["p"], active, tables)
    sorted_surface = surface_layout().room(capacity)
    surface_layout().write(sorted_surface, record, target, active)
    sorted_power = power_layout().move(power, index, target, active)
    dr.eval(sorted_surface, sorted_power)
    return start, sorted_surface, sorted_power, target


def for_each_photon(photon_map, p, radius, active, visit, state):
    """Calls `visit(index, landing, offset, distance_squared, hit, state) -> state` for photons
    within `radius` of `p` (see `visit_hits`).

    `hit` marks the lanes whose photon belongs to the row that has been read (another one may share
    its place); `landing` is the photon's `Landing`, `offset` its position minus `p`. `state` is a
    tree of Dr.Jit arrays.
    """
    return visit_hits(DiskQuery(photon_map, p, radius, active), visit, state)


def visit_hits(query, visit, state):
    """Calls `visit`, as of `for_each_photon`, for the photons that a `Query` finds.

    Lanes of a CPU's SIMD unit wait for one another in every loop, and two photons in three of the
    cells around `p` miss, so what is dear to do with a hit must not go in step with the misses. Row
    by row of cells, runs of up to `RUN` photons are tested for distance only; the hits of a run are
    kept as a word of bits. Once a lane keeps `KEPT_RUNS` runs with hits, or has seen all rows, the
    hits of all of these are visited.
    """

    def meet(runs, state):
        start, hits, row = runs[0]
        index = start + dr.tzcnt(hits)
        landing, offset = query.read(index)
        own = query.row_of(landing.p) == row
        state = visit(index, landing, offset, query.distance_squared(offset), own, state)
        hits &= hits - 1
        return _chosen(hits == 0, [*runs[1:], _no_run()], [(start, hits, row), *runs[1:]]), state

    def search_and_meet(place, state):
        place, runs = dr.while_loop(
            (place, [_no_run() for _ in range(KEPT_RUNS)]),
            lambda place, runs: query.unfinished(place) & (runs[-1][1] == 0),
            query.search,
            label="rows",
        )
        _, state = dr.while_loop(
            (runs, state), lambda runs, state: runs[0][1] != 0, meet, label="photons met"
        )
        return place, state

    return dr.while_loop(
        (query.begin(), state),
        lambda place, state: query.unfinished(place),
        search_and_meet,
        label="photons",
    )[-1]


class Query:
    """The rows of cells near something, one after the other; the photons of each row are tested in
    runs.

    A subclass says which rows there are (`begin`, `unfinished`, `next_row`), where the photons of
    each are (`photons_of_row`, `number`), what is read of them (`read`), and which are hits
    (`is_hit`). A place is what tells the row, and where in a row longer than a run the query has
    stopped: the next photon and the row's end (0, 0 before the row).
    """

    def __init__(self, photon_map, radius):
        self.photon_map, self.grid = photon_map, photon_map.grid
        self.radius_squared = dr.square(radius)

    def distance_squared(self, offset):
        """Squared distance of photons that lie so far from the query's point."""
        return dr.squared_norm(offset)

    def is_hit(self, offset):
        """Whether they lie within the radius."""
        return self.distance_squared(offset) < self.radius_squared

    def row_of(self, position):
        """Number of the row in which photons lie."""
        own = self.grid.coordinates(position)
        return self.grid.row_number(own.y, own.z)

    def search(self, place, runs):
        """Tests one run of photons: the next place, and the kept runs with this one before them if
        it has hits."""
        *row, start, end = place
        first, last = self.photons_of_row(*row)
        on = start < end  # still in a row that is longer than a run
        start, end = dr.select(on, start, first), dr.select(on, end, last)
        until = dr.minimum(start + RUN, end)
        run = start, self._hits(start, until), self.number(*row)
        runs = _chosen(run[1] != 0, [run, *runs[:-1]], runs)
        done = until >= end
        row = self.next_row(*row, done)
        return (*row, dr.select(done, 0, until), dr.select(done, 0, end)), runs

    def _hits(self, start, until):
        """Which photons of a run are hits: a bit each."""

        def test(index, bit, hits):
            _, offset = self.read(index)
            hit = self.is_hit(offset)
            return index + 1, bit << 1, hits | dr.select(hit, bit, 0)

        *_, hits = dr.while_loop(
            (mi.UInt32(start), mi.UInt32(1), mi.UInt32(0)),
            lambda index, bit, hits: index < until,
            test,
            label="photons tested",
        )
        return hits


class DiskQuery(Query):
    """The rows (y, z) within `radius` of points `p`."""

    def __init__(self, photon_map, p, radius, active):
        super().__init__(photon_map, radius)
        self.p = p
        inverse = dr.rcp(self.grid.cell)
        self.local = (p - self.grid.origin) * inverse
        self.reach = radius * inverse * 1.0001
        self.first_y, self.last_y = self._cells(self.local.y)
        self.first_z, self.last_z = self._cells(self.local.z)
        self.last_z = dr.select(active, self.last_z, self.first_z - 1)

    def _cells(self, center):
        """First and last cell along an axis."""
        first, last = dr.floor(center - self.reach), dr.floor(center + self.reach)
        return mi.Int32(first) + 2, mi.Int32(last) + 2

    def begin(self):
        """The first place."""
        return mi.Int32(self.first_y), mi.Int32(self.first_z), mi.UInt32(0), mi.UInt32(0)

    def unfinished(self, place):
        """Whether there are rows left."""
        return place[1] <= self.last_z

    def read(self, index):
        """The `Landing` of photons `index`, and its offset from the points."""
        landing = read_landing(self.photon_map.surface, index)
        return landing, landing.p - self.p

    def photons_of_row(self, y, z):
        """First photon, and the one after the last, of the cells of a row within the radius."""
        return _photons_of_row(self.photon_map, y, z, self.local, self.reach)

    def number(self, y, z):
        """The row's number."""
        return self.grid.row_number(y, z)

    def next_row(self, y, z, done):
        """The row after this one, where that is `done`."""
        wrap = y >= self.last_y
        z = dr.select(done & wrap, z + 1, z)
        return dr.select(done, dr.select(wrap, self.first_y, y + 1), y), z


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
    longest = grid.table.longest
    low_y, low_z = mi.Float(y - 2), mi.Float(z - 2)
    distance_y = dr.maximum(dr.maximum(low_y - local.y, local.y - low_y - 1), 0)
    distance_z = dr.maximum(dr.maximum(low_z - local.z, local.z - low_z - 1), 0)
    left = dr.square(reach) - dr.square(distance_y) - dr.square(distance_z)
    half = dr.safe_sqrt(left) + 1e-3
    first_x = dr.clip(mi.Int32(dr.floor(local.x - half)) + 2, 0, longest - 4)
    last_x = dr.clip(mi.Int32(dr.floor(local.x + half)) + 2, -1, longest - 4)
    base = grid.row(y, z)
    # Rows outside of the box hold nothing, and would have the numbers of others inside.
    near = (left > -1e-3) & (last_x >= first_x) & (mi.UInt32(y) < grid.lines)
    return (
        dr.gather(mi.UInt32, photon_map.start, base + mi.UInt32(first_x), near),
        dr.gather(mi.UInt32, photon_map.start, base + mi.UInt32(last_x) + 1, near),
    )
