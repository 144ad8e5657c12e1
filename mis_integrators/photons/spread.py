"""Merge radii that differ from photon to photon: how far the light of a caustic photon is spread.

Where caustic photons are few, each shows as a disk of its own. Such a photon gets a larger radius,
by what light there is around it (a sample-point estimator of density: Breiman, Meisel and Purcell
1977, Variable kernel estimates of multivariate densities; Abramson 1982). As the radius is a
function of where a photon lands and of what it carries, and of nothing else that an iteration has
traced, each photon spreads its own light, and none is lost or made.

Radii are R, 2 R, 4 R and so on: photons lie in layers, one for each.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean
from .grid import table_size
from .photon import power_layout, surface_layout

LAYERS = 5
"""Radii that photons may have."""
MOST_OF_DISK = 1 / 16
"""Tuned: what a photon may bring of the light that falls on its disk in the whole render."""
QUANTA = 16
"""Light is counted in whole numbers, so that the order of photons does not matter: so many for a
photon of mean flux."""
BRIGHTEST = 1 << 16
"""... and at most so many for any."""


def layer_radius(radius, layer):
    """The merge radius of photons of a layer, from that of the first one."""
    return radius * mi.Float(mi.UInt32(1) << layer)


@dataclass
class LightAround:
    """The light of photons on surfaces, in cells of a grid for each of the `LAYERS`.

    The cells are as wide as the layer's radius. A hash of their coordinates says where each is in a
    table, and another hash, its name there, which cell it is. Where cells share a place, the one
    whose name is larger has the light of all, and the others none. The light around a point is that
    in the eight cells nearest to it, a cube as wide as the disk.
    """

    radius: mi.Float
    """Of the first layer."""
    quantum: mi.Float
    """Flux of a quantum, see `QUANTA`."""
    times: mi.Float
    """The light of the whole render, in units of what is counted here."""
    cells: mi.UInt32
    """By layer and place in the table: quanta, and the cell's name (two numbers each)."""

    @classmethod
    def none(cls, radius, quantum, times, capacity):
        """No light yet. The first three are numbers, see the fields; `capacity`: photons of a
        pass."""
        numbers = (dr.opaque(mi.Float, number) for number in (radius, quantum, times))
        return cls(*numbers, dr.zeros(mi.UInt32, 2 * LAYERS * table_size(capacity)))

    @property
    def size(self):
        """Places in the table of a layer (a power of two)."""
        return dr.width(self.cells) // (2 * LAYERS)

    def add(self, surface, power, count):
        """Adds the photons of a light pass (as of `trace_light_paths`)."""
        index = dr.arange(mi.UInt32, surface_layout().capacity(surface))
        active = index < count
        p = surface_layout().read(surface, index, active)["p"]
        quanta = self._quanta(flux_of(power_layout().read(power, index, active)))
        for layer in range(LAYERS):
            cell = mi.Vector3i(dr.floor(self._local(p, layer)))
            place, name = self._place(cell, layer)
            for operation, value, slot in (
                (dr.ReduceOp.Add, quanta, 2 * place),
                (dr.ReduceOp.Max, name, 2 * place + 1),
            ):
                dr.scatter_reduce(operation, self.cells, value, slot, active, dr.ReduceMode.Direct)
        dr.eval(self.cells)

    def layer(self, p, flux, active):
        """The layer, from 0, of photons at `p`: the first on whose disks they bring no more than
        `MOST_OF_DISK` of the light; else the last."""
        wanted = mi.Float(self._quanta(flux)) * dr.rcp(MOST_OF_DISK * self.times)

        def look(layer, searching):
            searching &= self._around(p, layer, searching) < wanted
            layer = dr.select(searching, layer + 1, layer)
            return layer, searching & (layer < LAYERS - 1)

        state = mi.UInt32(0), mi.Bool(active)
        layer, _ = dr.while_loop(state, lambda layer, searching: searching, look, label="layer")
        return layer

    def _around(self, p, layer, active):
        """Quanta in the cube around `p`."""
        corner = mi.Vector3i(dr.floor(self._local(p, layer) - 0.5))
        total = mi.UInt32(0)
        for number in range(8):
            cell = corner + mi.Vector3i(number & 1, number >> 1 & 1, number >> 2)
            place, name = self._place(cell, layer)
            light, found = dr.gather(mi.Vector2u, self.cells, place, active)
            total += dr.select(found == name, light, 0)
        return mi.Float(total)

    def _local(self, p, layer):
        """Points in units of a layer's cells."""
        return p * dr.rcp(layer_radius(self.radius, layer))

    def _place(self, cell, layer):
        """Where the table has a cell, and its name."""
        x, y, z = (mi.UInt32(axis) for axis in cell)
        place, name = mi.sample_tea_32(x + z * 0x9E3779B1, y)
        return (place & (self.size - 1)) + layer * self.size, name

    def _quanta(self, flux):
        return mi.UInt32(dr.minimum(flux / self.quantum, BRIGHTEST) + 0.5)


def flux_of(record):
    """Mean over the channels of the flux in records of `power_layout`."""
    return channel_mean(dr.abs(record["flux"]))  # a mark is a sign
