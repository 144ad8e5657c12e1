"""Merge radii that differ from photon to photon, by the light around a photon.

Where caustic photons are few, each shows as a disk of its own. Such a photon gets a larger radius
(a sample-point estimator of density: Breiman, Meisel and Purcell 1977, Variable kernel estimates of
multivariate densities; Abramson 1982). As the radius is a function of where a photon lands and of
what it carries, and of nothing else that an iteration has traced, each photon brings its own light,
on a larger disk.

Radii are R, 2 R, 4 R and so on: photons lie in tiers, one for each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .light_cells import GRIDS, LightCells

TIERS = GRIDS + 1
"""Radii that photons may have, at most."""
MOST_OF_LIGHT = 1 / 64
"""Tuned: what a photon may bring of the light around it in the whole render."""


def last_tier(radius, largest):
    """The last tier whose radius is not above the `largest`, by that of the first one."""
    return int(math.log2(min(max(largest / radius, 1), 1 << (TIERS - 1))))


@dataclass
class LightAround:
    """The light of photons on surfaces, and the tiers that photons get by it."""

    cells: LightCells
    """The radius is that of the first tier. The last tier needs no grid."""
    times: mi.Float
    """The light of the whole render over that which is counted here."""
    last: mi.UInt32
    """The last tier that photons may have."""

    @classmethod
    def empty(cls, radius, quantum, times, photons, largest):
        """Without light. The first three are numbers, see the fields; `photons`: how many there
        will be, about; `largest`: no photon has a larger radius."""
        return cls(
            LightCells.empty(radius, quantum, photons),
            dr.opaque(mi.Float, times),
            dr.opaque(mi.UInt32, last_tier(radius, largest)),
        )

    def tier(self, p, flux, radius, active):
        """The tier, from 0, of photons at `p`: the first on whose disks they bring no more than
        `MOST_OF_LIGHT` of the light; else the `last`. `radius`: of the first tier in this
        iteration; smaller disks hold less light."""
        cells = self.cells
        shrunk = dr.square(radius / cells.radius)
        wanted = mi.Float(cells.quanta(flux)) * dr.rcp(MOST_OF_LIGHT * self.times * shrunk)

        def look_further(tier, searching):
            searching &= cells.around(p, tier, searching) < wanted
            tier = dr.select(searching, tier + 1, tier)
            return tier, searching & (tier < self.last)

        state = mi.UInt32(0), mi.Bool(active) & (self.last > 0)
        tier, _ = dr.while_loop(
            state, lambda tier, searching: searching, look_further, label="tier of a photon"
        )
        return tier
