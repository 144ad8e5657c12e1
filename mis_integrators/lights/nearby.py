"""Which emitter next-event estimation asks at a point: by what each brings to the place around it.

A choice by power alone starves a lamp that is weak but near, or a spot whose cone is narrow: what
it lights is noise. So a box around what the camera sees is divided into cells, and each has
probabilities of its own, by the light that reaches points in it (as the spatial light distribution
of the renderer pbrt-v3, Pharr, Jakob and Humphreys 2016, but with visibility). A share of the
choices ignores what is in the way, or is even: points of a cell may miss what the edge of a shadow
or a cone leaves in it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.random import next_2d, streams
from ..core.spectra import channel_mean
from ..core.traits import scene_bounds
from ..paths.camera_rays import sample_camera_ray
from .environment_sampler import SPREAD_WAVELENGTHS
from .histograms import draw_cell

CELLS = 16
"""Tuned: cells along the longest edge of the scene's box."""
VIEW_RAYS = 4096
"""Tuned: camera rays that tell where the box is."""
POINTS = 32
"""Tuned: points of a cell at which light is looked for."""
MOST_SAMPLES = 1 << 22
"""Points times emitters at most: cells are larger where there are many emitters."""
BLIND_SHARE = 0.2
"""Tuned: share of the choices that does not know what is hidden: half of it goes with the light if
nothing stood between, half is even among the emitters that shine."""


def box_of_view(scene, sensor):
    """Lowest corner and extents, (3,) each, of a box around what a sensor sees, and as far beyond
    on all sides as that is wide, but no larger than the scene's (a ground plane may be wide)."""
    box = scene_bounds(scene)
    low, high = np.array(box.min), np.array(box.max)
    if sensor is None:
        return low, high - low
    rng = streams(dr.arange(mi.UInt32, VIEW_RAYS), dr.opaque(mi.UInt32, 0x76696577))
    ray, _ = sample_camera_ray(sensor, sensor.shutter_open(), 0.5, next_2d(rng), next_2d(rng))
    hit = scene.ray_intersect_preliminary(mi.Ray3f(ray))
    seen = np.array(ray(hit.t)).T[np.array(hit.is_valid())]
    if not len(seen):
        return low, high - low
    near, far = np.quantile(seen, [0.01, 0.99], axis=0)
    width = (far - near).max()
    low, high = np.maximum(near - width, low), np.minimum(far + width, high)
    return low, np.maximum(high - low, 0)


def grid_shape(extents, emitters):
    """Cells along each edge of a box with such `extents` (3,), near to cubes: (3,) integers."""
    extents = np.maximum(np.asarray(extents, np.float64), 1e-3 * max(*extents, 1e-30))
    most = max(MOST_SAMPLES // (POINTS * emitters), 1)
    for along in range(CELLS, 1, -1):
        shape = np.maximum(np.ceil(extents / extents.max() * along - 1e-6), 1).astype(int)
        if np.prod(shape) <= most:
            return shape
    return np.ones(3, int)


def smoothed(grid):
    """Mixed with the neighbours' along the first three axes: a cell that missed the edge of a cone
    learns of it from them. The rest of the array's shape stays."""
    for axis in range(3):
        edges = [(1, 1) if axis == k else (0, 0) for k in range(grid.ndim)]
        padded = np.pad(grid, edges, mode="edge")
        before, here, after = (
            np.take(padded, range(k, k + grid.shape[axis]), axis) for k in range(3)
        )
        grid = 0.25 * before + 0.5 * here + 0.25 * after
    return grid


def probabilities(visible, light, shines):
    """Probabilities of the emitters in each cell: (cells, emitters).

    Parameters
    ----------
    visible, light : (x, y, z, emitters)
        What the emitters bring to the cells, mean over points, and what they would bring if nothing
        stood between.
    shines : (emitters,)
        Chosen evenly among those that are True, where nothing is known.
    """
    shares = np.tile(shines / max(np.count_nonzero(shines), 1), (int(np.prod(light.shape[:3])), 1))
    for found, kept in ((light, 0.5), (visible, BLIND_SHARE)):
        near = smoothed(found).reshape(len(shares), -1) * shines
        total = near.sum(axis=1, keepdims=True)
        known = np.divide(near, total, out=shares.copy(), where=total > 0)
        shares = (1 - kept) * known + kept * shares
    return shares


class NearbyChoice:
    """The choice among the emitters of `lights` (a `Lights`; `shines`: which of them emit
    anything) at points of its scene; `sensor`: whose view matters (or None)."""

    def __init__(self, lights, shines, sensor):
        low, extents = box_of_view(lights.scene, sensor)
        shape = grid_shape(extents, len(shines))
        self.count = len(shines)
        scale = shape / np.maximum(extents, 1e-30)
        self._shape = mi.Vector3u([dr.opaque(mi.UInt32, int(x)) for x in shape])
        self._low = mi.Point3f([dr.opaque(mi.Float, float(x)) for x in low])
        self._scale = mi.Vector3f([dr.opaque(mi.Float, float(x)) for x in scale])
        visible, light = (
            found.reshape(*shape[::-1], self.count)
            for found in self._light(lights, int(np.prod(shape)))
        )
        pmf = probabilities(visible, light, np.asarray(shines, bool))
        self._pmf = from_numpy(mi.Float, pmf.ravel())
        self._cdf = from_numpy(mi.Float, np.cumsum(pmf, axis=1).ravel())

    def tables(self):
        """Every evaluated array that is read."""
        return [self._pmf, self._cdf, self._shape, self._low, self._scale]

    def _light(self, lights, cells):
        """Mean light of the emitters that reaches points of each cell, and that would if nothing
        stood between: (cells times emitters,) each."""
        points = cells * self.count * POINTS
        lane = dr.arange(mi.UInt32, points)
        cell, emitter = lane // (POINTS * self.count), lane // POINTS % self.count
        point = cell * POINTS + lane % POINTS  # the same for all emitters
        rng = streams(point, dr.opaque(mi.UInt32, 0x6E656172))
        place = mi.Vector3u(
            cell % self._shape.x,
            cell // self._shape.x % self._shape.y,
            cell // (self._shape.x * self._shape.y),
        )
        within = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
        ref = dr.zeros(mi.Interaction3f, points)
        ref.p = self._low + (mi.Vector3f(place) + within) / self._scale
        if mi.is_spectral:
            ref.wavelengths = mi.UnpolarizedSpectrum(*SPREAD_WAVELENGTHS)
        ds, weight = lights.sample_emitter(
            ref, lights.pointer(emitter), emitter, next_2d(rng), mi.Bool(True)
        )
        value = channel_mean(weight)
        lit = dr.isfinite(value) & (value > 0)
        hidden = lights.scene.ray_test(lights.shadow_ray(ref, ds, lights.guide is not None), lit)
        light = dr.block_sum(dr.select(lit, value, 0), POINTS)
        visible = dr.block_sum(dr.select(lit & ~hidden, value, 0), POINTS)
        return np.array(visible) / POINTS, np.array(light) / POINTS

    def _first(self, p):
        """Where the probabilities of the cell around `p` begin; places outside belong to cells at
        the border."""
        cell = []
        for x, low, scale, cells in zip(p, self._low, self._scale, self._shape):
            place = (x - low) * scale  # perhaps not a number, on lanes that have ended
            inside = dr.select(place > 0, dr.minimum(place, mi.Float(cells) - 1), 0)
            cell.append(mi.UInt32(inside))
        return (cell[0] + self._shape.x * (cell[1] + self._shape.y * cell[2])) * self.count

    def sample(self, p, u):
        """An emitter's number and its probability at the points `p`, from uniform numbers `u`."""
        first = self._first(p)
        index, _ = draw_cell(self._cdf, first, self.count, u)
        return index, dr.gather(mi.Float, self._pmf, first + index)

    def probability(self, p, index):
        """Probability of emitter `index` at the points `p`."""
        return dr.gather(mi.Float, self._pmf, self._first(p) + index)
