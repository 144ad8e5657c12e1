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

from ..core.spectra import channel_mean
from .grid import read_photons, table_size
from .photon import power_layout, surface_layout

TIERS = 7
"""Radii that photons may have, at most."""
MOST_OF_LIGHT = 1 / 64
"""Tuned: what a photon may bring of the light around it in the whole render."""
QUANTA = 16
"""Light is counted in whole numbers, so that the order of photons does not matter: so many for a
photon of mean flux, and one at least."""
BRIGHTEST = 1 << 16
"""... and at most so many for any."""
MOST_PLACES = 1 << 22
"""Places of a tier's table at most (bounds memory)."""


def tier_radius(radius, tier):
    """The merge radius of photons of a tier, from that of the first one."""
    return radius * mi.Float(mi.UInt32(1) << tier)


def last_tier(radius, largest):
    """The last tier whose radius is not above the `largest`, by that of the first one."""
    return int(math.log2(min(max(largest / radius, 1), 1 << (TIERS - 1))))


@dataclass
class LightAround:
    """The light of photons on surfaces, in cells of a grid for each tier but the last.

    Cells are as wide as the tier's radius. The light around a point is that of the eight cells
    nearest to it, a cube as wide as the disk.

    Each tier has a table, and a hash of a cell's coordinates is its place there. A second hash, its
    fingerprint, is stored with its light, so that empty cells are known from others. Where several
    cells share a place, the one with the largest fingerprint has the light of all, and the others
    have none.
    """

    radius: mi.Float
    """Of the first tier."""
    quantum: mi.Float
    """Flux of a quantum, see `QUANTA`."""
    times: mi.Float
    """The light of the whole render over that which is counted here."""
    cells: mi.UInt32
    """By tier and place in the table: quanta, and the cell's fingerprint."""
    mask: mi.UInt32
    """Places in the table of a tier (a power of two), less one."""
    last: mi.UInt32
    """The last tier that photons may have."""

    @classmethod
    def empty(cls, radius, quantum, times, photons, largest):
        """Without light. The first three are numbers, see the fields; `photons`: how many there
        will be, about; `largest`: no photon has a larger radius."""
        numbers = (dr.opaque(mi.Float, number) for number in (radius, quantum, times))
        places = min(table_size(photons), MOST_PLACES)
        cells = dr.zeros(mi.UInt32, 2 * (TIERS - 1) * places)
        return cls(
            *numbers,
            cells,
            dr.opaque(mi.UInt32, places - 1),
            dr.opaque(mi.UInt32, last_tier(radius, largest)),
        )

    def add(self, surface, power, count):
        """Adds the photons of a light pass (as of `trace_light_paths`)."""
        record, active = read_photons(surface, count, surface_layout().capacity(surface))
        p, quanta = record["p"], self._quanta(flux_of(power, active))
        for tier in range(TIERS - 1):
            place, fingerprint = self._place(mi.Vector3i(dr.floor(self._local(p, tier))), tier)
            for operation, value, word in (
                (dr.ReduceOp.Add, quanta, 0),
                (dr.ReduceOp.Max, fingerprint, 1),
            ):
                dr.scatter_reduce(
                    operation, self.cells, value, 2 * place + word, active, dr.ReduceMode.Direct
                )
        dr.eval(self.cells)

    def tier(self, p, flux, radius, active):
        """The tier, from 0, of photons at `p`: the first on whose disks they bring no more than
        `MOST_OF_LIGHT` of the light; else the `last`. `radius`: of the first tier in this
        iteration; smaller disks hold less light."""
        shrunk = dr.square(radius / self.radius)
        wanted = mi.Float(self._quanta(flux)) * dr.rcp(MOST_OF_LIGHT * self.times * shrunk)

        def look_further(tier, searching):
            searching &= self._around(p, tier, searching) < wanted
            tier = dr.select(searching, tier + 1, tier)
            return tier, searching & (tier < self.last)

        state = mi.UInt32(0), mi.Bool(active) & (self.last > 0)
        tier, _ = dr.while_loop(
            state, lambda tier, searching: searching, look_further, label="tier of a photon"
        )
        return tier

    def _around(self, p, tier, active):
        """Quanta in the cube around `p`."""
        corner = mi.Vector3i(dr.floor(self._local(p, tier) - 0.5))
        total = mi.UInt32(0)
        for number in range(8):
            cell = corner + mi.Vector3i(number & 1, number >> 1 & 1, number >> 2)
            place, fingerprint = self._place(cell, tier)
            light, found = dr.gather(mi.Vector2u, self.cells, place, active)
            total += dr.select(found == fingerprint, light, 0)
        return mi.Float(total)

    def _local(self, p, tier):
        """Points in units of a tier's cells."""
        return p * dr.rcp(tier_radius(self.radius, tier))

    def _place(self, cell, tier):
        """Where the tables have a cell, and its fingerprint."""
        x, y, z = (mi.UInt32(axis) for axis in cell)
        place, fingerprint = mi.sample_tea_32(x + z * 0x9E3779B1, y)
        return (place & self.mask) + tier * (self.mask + 1), fingerprint

    def _quanta(self, flux):
        return mi.UInt32(dr.clip(flux / self.quantum, 1, BRIGHTEST) + 0.5)


def flux_of(power, active):
    """Mean over the channels of the flux of all `active` photons."""
    layout = power_layout()
    record = layout.read(power, dr.arange(mi.UInt32, layout.capacity(power)), active)
    return channel_mean(dr.abs(record["flux"]))  # a mark is a sign
