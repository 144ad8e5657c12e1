"""Through which parts of the faces of a box light from far away comes in.

A window is where it is, whatever the direction of the light: one histogram over the six faces
serves all directions, and learns from few records what one histogram for each direction does not.
It serves light sub-paths, as a density of lines, and direct light, as one of directions.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from .histograms import draw_cell, in_square_cell, smoothed, square_cell

FACE_CELLS = 64
"""Tuned: cells along each edge of a face."""
FACES = 6
"""Numbers 2 a (the lower face across axis a) and 2 a + 1 (the upper one)."""
LEVEL_SHARES = (0.4, 0.2, 0.15, 0.15, 0.1)
"""Tuned: shares of the histograms at full, half, quarter, ... resolution."""
LEAST_EXTENT = 0.02
"""Tuned: least edge of the box, in units of its longest."""
MARGIN = 0.1
"""Tuned: how far from the box a place may be that still looks through its faces for light, in units
of the box' edges."""


class PortalDistribution:
    """A histogram over the faces of the box `low` to `high`: of the places where lines come out of
    the box towards the light. Two densities follow it: of lines, in each direction over the plane
    across it, and of directions from a point in the box.

    Parameters: `low`, `high`, arrays (3,); `points`, `towards` (3, n): places, most of them in the
    box, and directions in which they see light; `weights` (n,).
    """

    def __init__(self, low, high, points, towards, weights):
        extent = np.maximum(high - low, LEAST_EXTENT * max(np.max(high - low), 1e-6))
        centre = (low + high) / 2
        self._low, self._extent = (
            dr.opaque(mi.Vector3f, [float(x) for x in v]) for v in (centre - extent / 2, extent)
        )
        face, cell, inside = (
            np.array(x) for x in self._exit(mi.Vector3f(towards), mi.Point3f(points))[:3]
        )
        cells = FACE_CELLS**2
        histogram = np.bincount(
            (face * cells + cell)[inside], weights[inside], FACES * cells
        ).reshape(FACES, FACE_CELLS, FACE_CELLS)
        histogram = smoothed(histogram, LEVEL_SHARES).reshape(FACES, cells)
        histogram /= max(histogram.sum(), 1e-300)
        self._light = from_numpy(mi.Float, histogram.ravel())
        self._of_face = from_numpy(mi.Float, histogram.sum(axis=1))
        self._face_cdf = from_numpy(mi.Float, np.cumsum(histogram.sum(axis=1)))
        self._cdf = from_numpy(
            mi.Float,
            (
                np.cumsum(histogram, axis=1)
                / np.maximum(histogram.sum(axis=1, keepdims=True), 1e-300)
            ).ravel(),
        )
        axes = np.array([[1, 2], [0, 2], [0, 1]])
        self._cell_area = from_numpy(mi.Float, np.prod(extent[axes], axis=1) / cells)  # one an axis

    def tables(self):
        """Every evaluated array that the densities and their samples read, for `dr.freeze` to
        track."""
        return [
            self._low,
            self._extent,
            self._light,
            self._of_face,
            self._face_cdf,
            self._cdf,
            self._cell_area,
        ]

    def _exit(self, towards, p):
        """Face and cell at which the lines along `towards` through `p` come out of the box, whether
        they meet it, and how far from `p` that is."""
        slope = dr.rcp(dr.select(dr.abs(towards) > 1e-9, towards, 1e-9))
        near, far = (self._low - p) * slope, (self._low + self._extent - p) * slope
        near, far = dr.minimum(near, far), dr.maximum(near, far)
        leaves = dr.min(far)
        meets = dr.max(near) < leaves
        axis = dr.select(
            far.x <= leaves, mi.UInt32(0), dr.select(far.y <= leaves, mi.UInt32(1), mi.UInt32(2))
        )
        upper = _component(towards, axis) > 0
        place = (p + leaves * towards - self._low) / self._extent
        u, v = dr.select(axis == 0, place.y, place.x), dr.select(axis == 2, place.y, place.z)
        return (
            2 * axis + dr.select(upper, mi.UInt32(1), 0),
            square_cell(u, v, FACE_CELLS),
            meets,
            leaves,
        )

    def _faces(self, towards):
        """For each axis: the face that looks `towards` the light, and cosine times histogram of
        it."""
        faces = [2 * axis + dr.select(towards[axis] > 0, mi.UInt32(1), 0) for axis in range(3)]
        return faces, [
            dr.abs(towards[axis]) * dr.gather(mi.Float, self._of_face, face)
            for axis, face in enumerate(faces)
        ]

    def lit(self, towards):
        """Whether the faces that look `towards` the light let in any."""
        return sum(self._faces(towards)[1]) > 0

    def density(self, towards, p, active=True):
        """Density of the line along `towards` through `p`, per unit area across it."""
        face, cell, meets, _ = self._exit(towards, p)
        total = sum(self._faces(towards)[1])
        return dr.select(
            meets & (total > 0), self._per_area(face, cell, active & meets) * dr.rcp(total), 0
        )

    def sample(self, towards, sample, jitter, active=True):
        """A point where a line along `towards` comes out of the box, from two uniform numbers;
        `jitter`: two more that place it within its cell, or `None` (then what those two leave over
        does)."""
        faces, lights = self._faces(towards)
        u = sample.x * sum(lights)
        second, third = u >= lights[0], u >= lights[0] + lights[1]
        u = dr.select(third, u - lights[0] - lights[1], dr.select(second, u - lights[0], u))
        u *= dr.rcp(
            dr.maximum(dr.select(third, lights[2], dr.select(second, lights[1], lights[0])), 1e-30)
        )
        face = dr.select(third, faces[2], dr.select(second, faces[1], faces[0]))
        cell, leftover = self._cell_of_face(face, u, active)
        return self._place(face, cell, mi.Point2f(leftover, sample.y) if jitter is None else jitter)

    # ------------------------------------------------------------------ directions from a point

    def near(self, p):
        """Whether points are in the box or next to it."""
        offset = dr.abs(mi.Vector3f(p) - self._low - 0.5 * self._extent)
        return dr.all(offset <= (0.5 + MARGIN) * self._extent)

    def direction_density(self, p, towards, active=True):
        """Density per solid angle of `sample_direction`."""
        face, cell, meets, distance = self._exit(towards, p)
        meets &= active & (distance > 0)
        cosine = dr.maximum(dr.abs(_component(towards, face // 2)), 1e-9)
        return dr.select(
            meets, self._per_area(face, cell, meets) * dr.square(distance) * dr.rcp(cosine), 0
        )

    def sample_direction(self, p, sample, active=True):
        """Directions from `p` towards a point of the histogram, from two uniform numbers, and
        whether it is one at which they come out of the box: seen from outside of it some are
        not."""
        face, u = draw_cell(self._face_cdf, mi.UInt32(0), FACES, sample.x, active)
        cell, leftover = self._cell_of_face(face, u, active)
        offset = self._place(face, cell, mi.Point2f(leftover, sample.y)) - p
        towards = offset * dr.rsqrt(dr.maximum(dr.squared_norm(offset), 1e-30))
        leaves, _, meets, distance = self._exit(towards, p)
        return towards, meets & (distance > 0) & (leaves == face)

    # ------------------------------------------------------------------

    def _per_area(self, face, cell, active):
        """The histogram as a density per unit area of the faces."""
        light = dr.gather(mi.Float, self._light, face * FACE_CELLS**2 + cell, active)
        return light * dr.rcp(dr.gather(mi.Float, self._cell_area, face // 2, active))

    def _cell_of_face(self, face, u, active):
        """A cell of faces, from uniform numbers, and what these leave over."""
        cells = FACE_CELLS**2
        return draw_cell(self._cdf, face * cells, cells, u, active)

    def _place(self, face, cell, offset):
        """The point of a face that lies in a cell at `offset`, a pair of numbers in [0, 1)."""
        axis, across = face // 2, mi.Float(face % 2)
        a, b = in_square_cell(cell, offset, FACE_CELLS)
        place = mi.Vector3f(
            dr.select(axis == 0, across, a),
            dr.select(axis == 1, across, dr.select(axis == 0, a, b)),
            dr.select(axis == 2, across, b),
        )
        return mi.Point3f(self._low + place * self._extent)


def _component(v, axis):
    """The component of a vector along each lane's own axis (0, 1 or 2)."""
    return dr.select(axis == 0, v.x, dr.select(axis == 1, v.y, v.z))
