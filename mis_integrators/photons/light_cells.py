"""The light of photons in the cells of grids, from fine ones to coarse ones.

Cells of the first grid (of tier 0) are as wide as a radius, those of each further one twice as
wide. The light around a point is that of the eight cells nearest to it: a cube twice as wide as
they are.

Each grid has a table, and a hash of a cell's coordinates is its place there. A second hash, its
fingerprint, is stored with its light, so that empty cells are known from others. Where several
cells share a place, the one with the largest fingerprint has the light of all, and the others have
none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean
from .grid import table_size
from .photon import power_layout

GRIDS = 6
"""How many there are."""
QUANTA = 16
"""Light is counted in whole numbers, so that the order of photons does not matter: so many for a
photon of mean flux, and one at least."""
BRIGHTEST = 1 << 16
"""... and at most so many for any."""
MOST_PLACES = 1 << 22
"""Places of a grid's table at most (bounds memory)."""


@dataclass
class LightCells:
    """The light of photons, by cell."""

    radius: mi.Float
    """Width of the cells of the first grid."""
    quantum: mi.Float
    """Flux of a quantum, see `QUANTA`."""
    words: mi.UInt32
    """By grid and place in its table: quanta, and the cell's fingerprint."""
    mask: mi.UInt32
    """Places in the table of a grid (a power of two), less one."""

    @classmethod
    def empty(cls, radius, quantum, photons):
        """Without light. `radius`, `quantum`: numbers, see the fields; `photons`: how many there
        will be, about."""
        places = min(table_size(photons), MOST_PLACES)
        return cls(
            dr.opaque(mi.Float, radius),
            dr.opaque(mi.Float, quantum),
            dr.zeros(mi.UInt32, 2 * GRIDS * places),
            dr.opaque(mi.UInt32, places - 1),
        )

    def add(self, p, flux, active):
        """Adds photons at `p`, with the mean `flux` of their channels."""
        quanta = self.quanta(flux)
        for tier in range(GRIDS):
            place, fingerprint = self._place(mi.Vector3i(dr.floor(self._local(p, tier))), tier)
            for operation, value, word in (
                (dr.ReduceOp.Add, quanta, 0),
                (dr.ReduceOp.Max, fingerprint, 1),
            ):
                dr.scatter_reduce(
                    operation, self.words, value, 2 * place + word, active, dr.ReduceMode.Direct
                )
        dr.eval(self.words)

    def around(self, p, tier, active):
        """Quanta in the cube around `p`."""
        corner = mi.Vector3i(dr.floor(self._local(p, tier) - 0.5))
        offsets = [mi.Vector3i(n & 1, n >> 1 & 1, n >> 2) for n in range(8)]
        return mi.Float(sum(self._in_cell(corner + offset, tier, active) for offset in offsets))

    def in_cell_of(self, p, tier, active):
        """Quanta in the cell that `p` lies in."""
        return mi.Float(self._in_cell(mi.Vector3i(dr.floor(self._local(p, tier))), tier, active))

    def _in_cell(self, cell, tier, active):
        place, fingerprint = self._place(cell, tier)
        light, found = dr.gather(mi.Vector2u, self.words, place, active)
        return dr.select(found == fingerprint, light, 0)

    def quanta(self, flux):
        """Those of a photon."""
        return mi.UInt32(dr.clip(flux / self.quantum, 1, BRIGHTEST) + 0.5)

    def _local(self, p, tier):
        """Points in units of a grid's cells."""
        return p * dr.rcp(tier_radius(self.radius, tier))

    def _place(self, cell, tier):
        """Where the tables have a cell, and its fingerprint."""
        x, y, z = (mi.UInt32(axis) for axis in cell)
        place, fingerprint = mi.sample_tea_32(x + z * 0x9E3779B1, y)
        return (place & self.mask) + tier * (self.mask + 1), fingerprint


def tier_radius(radius, tier):
    """Width of the cells of a grid, from that of the first one."""
    return radius * mi.Float(mi.UInt32(1) << tier)


def flux_of(power, active):
    """Mean over the channels of the flux of all `active` photons."""
    layout = power_layout()
    record = layout.read(power, dr.arange(mi.UInt32, layout.capacity(power)), active)
    return channel_mean(dr.abs(record["flux"]))  # a mark is a sign


def quantum_of(power, count):
    """The quantum that suits photons (as of `trace_light_paths`): their mean flux, to the next
    lower power of two, over `QUANTA`. (A sum of floats depends on their order a little.)"""
    index = dr.arange(mi.UInt32, power_layout().capacity(power))
    total = float(dr.sum(flux_of(power, index < count))[0])
    mean = total / max(int(count[0]), 1)
    return (2.0 ** math.floor(math.log2(mean)) if 0 < mean < math.inf else 1.0) / QUANTA
