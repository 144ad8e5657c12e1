"""Merge radii of volume photons that differ from photon to photon, by how densely they lie.

Close to a lamp, and where glass focuses, light in a medium changes over less than a radius that
suits the rest of the scene. There photons lie densely, and smaller disks hold enough of them. By
the square-root law of Abramson (1982, On bandwidth variation in kernel estimates) a photon's radius
is R sqrt(D / d), with d the density of photons around it and D that of the median photon; but not
above R.

A dim photon counts less for the density around it than a bright one, and one that is brighter than
those around it lies in a sparse place: density is light over the photon's own. As it is a function
of where a photon lies and of what it carries, and of nothing else that an iteration has traced,
each photon brings its own light.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .light_cells import GRIDS, LightCells, flux_of, quantum_of, tier_radius
from .volume import LEAST_SHARE, read_places

ENOUGH = 32
"""Tuned: photons in a cell that tell of the density there."""


@dataclass
class VolumeDensity:
    """How densely volume photons lie."""

    cells: LightCells
    median: mi.Float
    """Density [1/volume] at half of the light."""
    photons: mi.Float
    """How many there were."""

    @classmethod
    def of(cls, place, power, count, largest):
        """That of the photons of a light pass (as of `trace_light_paths`). `largest`: the widest
        cells are so wide (a number)."""
        record, active = read_places(place, count)
        p, flux = record["p"], flux_of(power, active)
        finest = largest / 2 ** (GRIDS - 1)
        photons = int(count[0])
        cells = LightCells.empty(finest, quantum_of(power, count), photons)
        cells.add(p, flux, active)
        light = dr.select(active, flux, 0)
        median = weighted_median(np.array(density_in(cells, p, flux, active)), np.array(light))
        return cls(cells, dr.opaque(mi.Float, median), dr.opaque(mi.Float, max(photons, 1)))

    def median_of(self, count):
        """The median density of so many photons of the same light; not zero."""
        return dr.maximum(self.median * count / self.photons, 1e-30)

    def share(self, p, flux, active):
        """The radius of photons at `p`, over that of the sparsest ones; one where no density was
        found."""
        there = density_in(self.cells, p, flux, active)
        return dr.select(there > 0, dr.clip(dr.sqrt(self.median / there), LEAST_SHARE, 1), 1)


def density_in(cells, p, flux, active):
    """Density around photons at `p`: that of the smallest cell that has `ENOUGH`, else of the
    widest."""
    own = mi.Float(cells.quanta(flux))

    def look_further(tier, found, searching):
        found = dr.select(searching, cells.in_cell_of(p, tier, searching), found)
        searching &= (found < ENOUGH * own) & (tier < GRIDS - 1)
        return dr.select(searching, tier + 1, tier), found, searching

    tier, found, _ = dr.while_loop(
        (mi.UInt32(0), mi.Float(0), mi.Bool(active)),
        lambda tier, found, searching: searching,
        look_further,
        label="density of volume photons",
    )
    return found * dr.rcp(own * tier_radius(cells.radius, tier) ** 3)


def weighted_median(values, weights):
    """The value that half of the weight is not above, (n,) each; 0 where there is none."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order], dtype=np.float64)
    if not len(total) or total[-1] <= 0:
        return 0.0
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
