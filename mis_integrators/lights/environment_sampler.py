"""Directions towards an environment, drawn by its radiance.

Mitsuba's environments bring samplers of their own, most of which draw nearly in proportion to the
radiance. Not all do: that of `sunsky` gives a wide sun a share that falls with its area, so that a
sun of 10 degrees, three quarters of the light, has a fiftieth of the directions. Where that is so,
half of the directions come from a table of the radiance instead.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.random import next_2d, streams
from ..core.spectra import channel_mean
from .histograms import draw_cell, in_square_cell, split, square_cell

TABLE_CELLS = 256
"""Tuned: cells along each edge of the table of a hemisphere: half a degree each."""
LOOKS = 4
"""Tuned: directions in each cell that tell its radiance."""
TABLE_SHARE = 0.5
"""Tuned: share of the directions that come from the table, if any do: the second moment of radiance
over density is then at most twice that of the table alone, or of the environment's own sampler."""
WORTH_A_TABLE = 0.5
"""Tuned: none do if that leaves more than this of the second moment."""
TRIALS = 1 << 15
"""Tuned: directions that tell how good the environment's own sampler is."""
SPREAD_WAVELENGTHS = 450, 520, 590, 640
"""Wavelengths [nm] at which lights are looked at where no path brings its own."""


def point(p, time):
    """An interaction at `p` for which lights can be looked at."""
    it = dr.zeros(mi.Interaction3f)
    it.p, it.time = p, time
    if mi.is_spectral:
        it.wavelengths = mi.UnpolarizedSpectrum(*SPREAD_WAVELENGTHS)
    return it


def radiance(emitter, towards, active=True):
    """Of an environment from directions `towards` it, mean over the channels."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(towards))
    si.wi = -towards
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(*SPREAD_WAVELENGTHS)
    return channel_mean(emitter.eval(si, active)) + dr.zeros(mi.Float, dr.width(towards))


def _hemisphere_cell(towards):
    """Number of a direction's cell, row by row: those of the upper hemisphere first."""
    up = mi.Vector3f(towards.x, towards.y, dr.abs(towards.z))
    place = mi.warp.uniform_hemisphere_to_square(up)
    cell = square_cell(place.x, place.y, TABLE_CELLS)
    return cell + dr.select(towards.z < 0, mi.UInt32(TABLE_CELLS**2), 0)


def _direction_in(cell, offset):
    """The direction in a cell at `offset`, a pair of numbers in [0, 1)."""
    below = cell >= TABLE_CELLS**2
    place = in_square_cell(cell - dr.select(below, TABLE_CELLS**2, 0), offset, TABLE_CELLS)
    d = mi.warp.square_to_uniform_hemisphere(mi.Point2f(*place))
    d.z = dr.select(below, -d.z, d.z)
    return d


class EnvironmentSampler:
    """Of one environment. `by_table`: whether its own sampler is mended by a table."""

    def __init__(self, emitter):
        rng = streams(dr.arange(mi.UInt32, TRIALS), mi.UInt32(0x656E7673))
        ds, weight = emitter.sample_direction(point(mi.Point3f(0), mi.Float(0)), next_2d(rng))
        own, light = (x + dr.zeros(mi.Float, TRIALS) for x in (ds.pdf, channel_mean(weight)))
        dr.eval(own, light, ds.d)
        self._drawn, self._light = ds.d, np.nan_to_num(np.array(light, np.float64), posinf=0)
        moment = _second_moment(self._light, 1)
        self.by_table = moment * WORTH_A_TABLE > 1  # no sampler does better than one
        if self.by_table:
            self._make_table(emitter)
            ratio = np.array(dr.select(own > 0, own / self.density(own, ds.d), 0))
            self.by_table = _second_moment(self._light, ratio) < WORTH_A_TABLE * moment

    def _make_table(self, emitter):
        cells = 2 * TABLE_CELLS**2
        cell = dr.arange(mi.UInt32, cells * LOOKS) // LOOKS
        rng = streams(dr.arange(mi.UInt32, cells * LOOKS), mi.UInt32(0x7461626C))
        found = radiance(emitter, _direction_in(cell, next_2d(rng))).numpy().reshape(cells, LOOKS)
        pmf = np.nan_to_num(np.maximum(found, 0), posinf=0).mean(axis=1, dtype=np.float64)
        pmf /= max(pmf.sum(), 1e-300)
        rows = pmf.reshape(2 * TABLE_CELLS, TABLE_CELLS)
        in_row = np.cumsum(rows, axis=1) / np.maximum(rows.sum(axis=1, keepdims=True), 1e-300)
        self._pmf, self._in_row = (from_numpy(mi.Float, x.ravel()) for x in (pmf, in_row))
        self._rows = from_numpy(mi.Float, np.cumsum(rows.sum(axis=1)))

    def power(self, cell_of, cells):
        """Radiance times solid angle of each of so many `cells` of directions; `cell_of`: numbers
        of the cells of directions."""
        drawn = np.array(cell_of(self._drawn))
        return np.bincount(drawn, self._light, cells) / TRIALS

    def tables(self):
        """Every evaluated array that the sampling routines read, for `dr.freeze` to track."""
        return [self._pmf, self._rows, self._in_row] if self.by_table else []

    def from_table(self, sample, active=True):
        """Which of the directions that these pairs of uniform numbers stand for come from the
        table, these directions, and the pairs for both ways. Only where there is a table."""
        turned, left = split(sample.x, TABLE_SHARE)
        turned &= active
        sample = mi.Point2f(dr.select(active, left, sample.x), sample.y)
        row, down = draw_cell(self._rows, mi.UInt32(0), 2 * TABLE_CELLS, sample.x, turned)
        first = row * TABLE_CELLS
        column, along = draw_cell(self._in_row, first, TABLE_CELLS, sample.y, turned)
        return turned, _direction_in(first + column, mi.Point2f(along, down)), sample

    def density(self, own_pdf, towards, active=True):
        """Density per solid angle, where the environment's own sampler has `own_pdf`."""
        if not self.by_table:
            return own_pdf
        cells = 2 * TABLE_CELLS**2
        probability = dr.gather(mi.Float, self._pmf, _hemisphere_cell(towards), active)
        by_table = probability * (cells / (4 * dr.pi))
        return (1 - TABLE_SHARE) * own_pdf + TABLE_SHARE * by_table


def _second_moment(light, ratio):
    """Of radiance over density, relative to its squared mean, by directions whose radiance is
    `light` times the density with which they were drawn; `ratio`: that density over the other."""
    return float(np.mean(light**2 * ratio) / max(np.mean(light) ** 2, 1e-300))
