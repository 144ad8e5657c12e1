"""Which cache points a place in the scene listens to: a table over the cells of a grid and the six
directions that a surface can face; in scenes with media also over places in these.

A cache point knows something about light that surfaces near it with a similar normal share, or
places in media near one that lies there itself. The nearest ones are found once for each cell and
facing; after that a look-up is one gather, cheap
enough for path loops. What it returns is a function of place and normal alone, constant within a
cell: weights made of it are the same for every technique that makes a path.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy, to_numpy
from ..paths.vertex import in_medium

CELLS = 1 << 14
"""Cells of the grid at most; times six facings and the number of neighbours, four bytes each."""
FINENESS = 0.75
"""Tuned: edge of a cell over the cache points' spacing, unless that makes too many cells."""
BLOCK = 4
"""Edge of a block of cells that are searched together, in cells."""
FACINGS = 6
"""Directions of surfaces. With media there is one facing more."""
NORMAL_COST = 8.0
"""Tuned: squared distance, in units of the cache points' spacing, that a cache point facing the
other way seems farther; a right angle, or a surface seen from a medium and the other way round:
half of it."""


class CacheGrid:
    """The `neighbors` nearest cache points of every cell and facing.

    Parameters: `points`, `normals` (`Point3f`, `Normal3f` of width C >= 1, evaluated; unit normals
    on the side that the camera path came from, zero in media), `neighbors` (N_c; if C is smaller,
    neighbours repeat), `media`: whether places may lie in media.

    Attributes: `table` (uint32, indices of cache points: entry `rows` times N_c and on, nearest
    first), `rows` (number of rows), `spacing` (of the cache points [length]) and `squared_spacing`
    (opaque, [length^2]).
    """

    def __init__(self, points, normals, neighbors, media=False):
        self.neighbors, self.media = neighbors, media
        self.facings = FACINGS + media
        p = to_numpy(points).astype(np.float64).T
        low, high = p.min(axis=0), p.max(axis=0)
        size = np.maximum(high - low, 1e-4 * max(np.max(high - low), 1e-12))
        # Surfaces: C points cover about the box's faces, each an equal share. (A few hundred that
        # fill a box have about the same spacing.)
        area = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
        self.spacing = float(np.sqrt(area / len(p)))
        edge = FINENESS * self.spacing
        while np.prod(np.maximum(np.ceil(size / edge), 1)) > CELLS:
            edge *= 1.05
        self.resolution = [int(n) for n in np.maximum(np.ceil(size / edge), 1)]
        self.squared_spacing = dr.opaque(mi.Float, self.spacing**2)
        self._low = dr.opaque(mi.Point3f, [float(x) for x in low])
        self._scale = dr.opaque(mi.Float, 1 / edge)
        self._cells = dr.opaque(
            mi.Point3u, self.resolution
        )  # as literals they would have path kernels compiled anew for each seed
        self.rows = self.facings * int(np.prod(self.resolution))
        nx, ny, nz = self.resolution
        x, y, z = (
            np.tile(np.arange(nx), ny * nz),
            np.tile(np.repeat(np.arange(ny), nx), nz),
            np.repeat(np.arange(nz), nx * ny),
        )
        centres = (np.stack([x, y, z], axis=1) + 0.5) * edge + low
        blocks = ((z // BLOCK) * ny + y // BLOCK) * nx + x // BLOCK
        self.table = from_numpy(
            mi.UInt32,
            _nearest(
                centres,
                blocks,
                p,
                turned_away(to_numpy(normals).astype(np.float64), self.facings),
                neighbors,
                0.5 * NORMAL_COST * self.spacing**2,
            ).ravel(),
        )

    def tables(self):
        """Every evaluated array that `row` and the grid's users read, for `dr.freeze` to track."""
        return [self.table, self.squared_spacing, self._low, self._scale, self._cells]

    def row(self, p, n):
        """Row of a point on a surface with normal `n`, on the side at hand (zero in media); places
        outside the grid belong to its border."""
        nx, ny, _ = self._cells
        x, y, z = mi.Point3u(dr.clip((p - self._low) * self._scale, 0, mi.Point3f(self._cells - 1)))
        towards = facing(n)
        if self.media:
            towards = dr.select(in_medium(n), mi.UInt32(FACINGS), towards)
        return ((z * ny + y) * nx + x) * self.facings + towards

    def neighbor(self, row, number, active=True):
        """Index of the cache point `number` (0: nearest) of a row."""
        return dr.gather(mi.UInt32, self.table, row * self.neighbors + number, active)


def facing(n):
    """Which of the six axis directions a normal is nearest to."""
    x, y, z = dr.abs(n.x), dr.abs(n.y), dr.abs(n.z)
    axis = dr.select(
        (x >= y) & (x >= z), mi.UInt32(0), dr.select(y >= z, mi.UInt32(1), mi.UInt32(2))
    )
    component = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z))
    return 2 * axis + dr.select(component < 0, mi.UInt32(1), mi.UInt32(0))


def turned_away(n, facings):
    """For each facing, how far the normals `n` (3, C) are turned away from it: 0, 1 at a right
    angle, 2 (facings, C). Zero normals, in media, are at a right angle to all facings but their
    own, and surfaces to that."""
    axes = [n[direction // 2] * (-1 if direction % 2 else 1) for direction in range(FACINGS)]
    return 1 - np.array([*axes, 1 - np.sum(n * n, axis=0)][:facings])


def _nearest(centres, blocks, p, turned, neighbors, normal_cost):
    """The table, a NumPy array (rows, neighbors).

    `centres` (cells, 3) of the cells, `blocks` (cells,) numbers of the blocks that they belong to,
    `p` (C, 3) of the cache points, `turned` as of `turned_away`, `normal_cost` of a right angle
    between normals [length^2]. Only points that can be among the nearest somewhere in a block are
    tried for its cells."""
    wanted = min(neighbors, len(p))
    table = np.empty((len(centres), len(turned), wanted), dtype=np.uint32)
    order = np.argsort(blocks, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(blocks[order])) + 1)
    middles = np.array(
        [(centres[cells].min(axis=0) + centres[cells].max(axis=0)) / 2 for cells in members]
    )
    reach = np.array(
        [
            np.linalg.norm(centres[cells] - middle, axis=1).max()
            for cells, middle in zip(members, middles)
        ]
    )[:, None]
    distance = np.sqrt(_squared(middles, p))
    for direction, away in enumerate(normal_cost * turned):
        at_most = np.partition((distance + reach) ** 2 + away, wanted - 1, axis=1)[
            :, wanted - 1 : wanted
        ]
        possible = np.maximum(distance - reach, 0) ** 2 + away <= at_most * (1 + 1e-6)
        for cells, candidates in zip(members, map(np.flatnonzero, possible)):
            cost = _squared(centres[cells], p[candidates]) + away[candidates]
            table[cells, direction] = candidates[least_columns(cost, wanted)]
    return table[:, :, np.arange(neighbors) % wanted].reshape(
        -1, neighbors
    )  # fewer cache points than neighbours repeat


def least_columns(cost, wanted):
    """Columns of the `wanted` least entries of each row of `cost` (NumPy, at least as wide), least
    first: (rows, wanted). They are overwritten."""
    lines, columns = np.arange(len(cost)), np.empty((len(cost), wanted), dtype=np.intp)
    for place in range(wanted):
        columns[:, place] = cost.argmin(axis=1)
        cost[lines, columns[:, place]] = np.inf
    return columns


def _squared(a, b):
    """Squared distances between points (n, 3) and (m, 3): (n, m)."""
    return sum((a[:, None, axis] - b[None, :, axis]) ** 2 for axis in range(3))
