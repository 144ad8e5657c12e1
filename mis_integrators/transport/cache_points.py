"""Which cache points a place in the scene listens to: a table over the cells of a grid and the six directions that a surface can face.

A cache point knows something about light that surfaces near it with a similar normal share. The nearest ones are found once for each
cell and facing, by brute force; after that a look-up is one gather, cheap enough for path loops. What it returns is a function of place and normal
alone, constant within a cell: weights made of it are the same for every technique that makes a path.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .packing import to_numpy

CELLS = 1 << 14
"""Cells of the grid at most; times six facings and the number of neighbours, four bytes each."""
FINENESS = 0.75
"""Edge of a cell over the cache points' spacing, unless that makes too many cells."""
FACINGS = 6
NORMAL_COST = 8.0
"""Squared distance, in units of the cache points' spacing, that a cache point facing the other way seems farther; a right angle: half of it."""


class CacheGrid:
    """The `neighbors` nearest cache points of every cell and facing.

    Parameters: `points`, `normals` (`Point3f`, `Normal3f` of width C >= 1, evaluated; unit normals on the side that the camera path came from),
    `neighbors` (N_c; if C is smaller, neighbours repeat).

    Attributes: `table` (uint32, indices of cache points: entry `rows()` times N_c and on, nearest first), `spread` (float, one a row: mean squared
    distance of the row's neighbours from the cell's centre [length^2]), `rows` (number of rows), `spacing` (of the cache points [length]), `normal_cost` (what a right angle
    between normals costs [length^2]).
    """

    def __init__(self, points, normals, neighbors):
        self.neighbors = neighbors
        p = to_numpy(points).astype(np.float64).T
        low, high = p.min(axis=0), p.max(axis=0)
        size = np.maximum(high - low, 1e-4 * max(np.max(high - low), 1e-12))
        # Surfaces: C points cover about the box's faces, each an equal share.
        area = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
        self.spacing = float(np.sqrt(area / len(p)))
        self.normal_cost = 0.5 * NORMAL_COST * self.spacing ** 2
        edge = FINENESS * self.spacing
        while np.prod(np.maximum(np.ceil(size / edge), 1)) > CELLS:
            edge *= 1.05
        self.resolution = [int(n) for n in np.maximum(np.ceil(size / edge), 1)]
        self._low = dr.opaque(mi.Point3f, [float(x) for x in low])
        self._scale = dr.opaque(mi.Float, 1 / edge)
        self._cells = dr.opaque(mi.Point3u, self.resolution)         # as literals they would have path kernels compiled anew for each seed
        self.rows = FACINGS * int(np.prod(self.resolution))
        self.table, self.spread = _nearest(self, mi.Point3f(points), mi.Normal3f(normals), len(p), dr.opaque(mi.Float, edge))
        dr.eval(self.table, self.spread)

    def tables(self):
        """Every evaluated array that `row` and its users read, for `dr.freeze` to track."""
        return [self.table, self.spread, self._low, self._scale, self._cells]

    def row(self, p, n):
        """Row of a point on a surface with normal `n`, on the side at hand; places outside the grid belong to its border."""
        nx, ny, _ = self._cells
        x, y, z = mi.Point3u(dr.clip((p - self._low) * self._scale, 0, mi.Point3f(self._cells - 1)))
        return ((z * ny + y) * nx + x) * FACINGS + facing(n)

    def neighbor(self, row, number, active=True):
        """Index of the cache point `number` (0: nearest) of a row."""
        return dr.gather(mi.UInt32, self.table, row * self.neighbors + number, active)


def facing(n):
    """Which of the six axis directions a normal is nearest to."""
    x, y, z = dr.abs(n.x), dr.abs(n.y), dr.abs(n.z)
    axis = dr.select((x >= y) & (x >= z), mi.UInt32(0), dr.select(y >= z, mi.UInt32(1), mi.UInt32(2)))
    component = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z))
    return 2 * axis + dr.select(component < 0, mi.UInt32(1), mi.UInt32(0))


@dr.syntax
def _nearest(grid, points, normals, count: int, edge):
    """Neighbour table and spread of all rows, by trying every cache point for each; `edge`: opaque."""
    rows = dr.arange(mi.UInt32, grid.rows)
    cell = rows // FACINGS
    direction = rows % FACINGS
    nx, ny, _ = grid._cells
    centre = mi.Point3f(mi.Float(cell % nx) + 0.5, mi.Float((cell // nx) % ny) + 0.5, mi.Float(cell // (nx * ny)) + 0.5) * edge + grid._low
    sign = dr.select(direction % 2 == 1, mi.Float(-1), mi.Float(1))
    axis = mi.Vector3f(dr.select(direction // 2 == 0, sign, 0), dr.select(direction // 2 == 1, sign, 0),
                       dr.select(direction // 2 == 2, sign, 0))
    cost_unit = dr.opaque(mi.Float, grid.normal_cost)
    last = dr.opaque(mi.UInt32, count)
    best = [mi.Float(dr.inf) for _ in range(grid.neighbors)]
    found = [mi.UInt32(0) for _ in range(grid.neighbors)]
    index = mi.UInt32(0)
    while index < last:
        p = dr.gather(mi.Point3f, points, index)
        n = dr.gather(mi.Normal3f, normals, index)
        cost = dr.squared_norm(p - centre) + cost_unit * (1 - dr.dot(n, axis))
        candidate = mi.UInt32(index)
        for place in dr.hint(range(grid.neighbors), mode='scalar'):
            nearer = cost < best[place]
            best[place], cost = dr.select(nearer, cost, best[place]), dr.select(nearer, best[place], cost)
            found[place], candidate = dr.select(nearer, candidate, found[place]), dr.select(nearer, found[place], candidate)
        index += 1
    table = dr.empty(mi.UInt32, grid.rows * grid.neighbors)
    spread = mi.Float(0)
    for place in dr.hint(range(grid.neighbors), mode='scalar'):
        taken = found[place] if place < count else found[place % count]
        dr.scatter(table, taken, rows * grid.neighbors + place)
        spread += dr.squared_norm(dr.gather(mi.Point3f, points, taken) - centre) / grid.neighbors
    return table, spread
