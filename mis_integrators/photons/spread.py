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

    The cells are as wide as the layer's radius. They share a table by a hash of their coordinates:
    where two share a place, photons are spread less than they might be. The light around a point is
    that in the eight cells nearest to it, a cube as wide as the disk.
    """

    radius: mi.Float
    """Of the first layer."""
    quantum: mi.Float
    """Flux of a quantum, see `QUANTA`."""
    times: mi.Float
    """The light of the whole render, in units of what is counted here."""
    light: mi.UInt32
    """Quanta by layer and place in the table."""

    @property
    def size(self):
        """Places in the table of a layer (a power of two)."""
        return dr.width(self.light) // LAYERS

    def add(self, surface, power, count):
        """Adds the photons of a light pass (as of `trace_light_paths`)."""
        index = dr.arange(mi.UInt32, surface_layout().capacity(surface))
        active = index < count
        p = surface_layout().read(surface, index, active)["p"]
        quanta = self._quanta(flux_of(power_layout().read(power, index, active)))
        for layer in range(LAYERS):
            cell = mi.Vector3i(dr.floor(self._local(p, layer)))
            dr.scatter_add(self.light, quanta, self._place(cell, layer), active)
        dr.eval(self.light)

    def layer(self, p, flux, active):
        """The layer, from 0, of photons at `p`: the first on whose disks they bring no more than
        `MOST_OF_DISK` of the light; else the last."""
        quanta = mi.Float(self._quanta(flux))
        found = mi.UInt32(LAYERS - 1)
        for layer in range(LAYERS - 2, -1, -1):
            enough = quanta <= MOST_OF_DISK * self.times * self._around(p, layer, active)
            found = dr.select(enough, mi.UInt32(layer), found)
        return found

    def _around(self, p, layer, active):
        """Quanta in the cube around `p`."""
        corner = mi.Vector3i(dr.floor(self._local(p, layer) - 0.5))
        total = mi.UInt32(0)
        for number in range(8):
            cell = corner + mi.Vector3i(number & 1, number >> 1 & 1, number >> 2)
            total += dr.gather(mi.UInt32, self.light, self._place(cell, layer), active)
        return mi.Float(total)

    def _local(self, p, layer):
        """Points in units of a layer's cells."""
        return p * dr.rcp(layer_radius(self.radius, layer))

    def _place(self, cell, layer):
        """Where the table has the light of a cell."""
        x, y, z = (mi.UInt32(axis) for axis in cell)
        mixed = x * 0x9E3779B1 ^ y * 0x85EBCA77 ^ z * 0xC2B2AE3D
        mixed ^= mixed >> 15
        return (mixed & (self.size - 1)) + layer * self.size

    def _quanta(self, flux):
        return mi.UInt32(dr.minimum(flux / self.quantum, BRIGHTEST) + 0.5)


def flux_of(record):
    """Mean over the channels of the flux in records of `power_layout`."""
    return channel_mean(dr.abs(record["flux"]))  # a mark is a sign
