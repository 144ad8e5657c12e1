"""What photons bring to camera paths by constant kernels, for several radii at once."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import read_mark
from ..core.spectra import channel_mean
from ..paths.light_classes import CLASSES, by_class_of_photons
from .photon import read_power


class KernelSums:
    """Sums over photons, for each of the `radii`: of what they bring by each class of light where
    they are `marked` (`photon.write_photon`), else of all. `throughput`: what the camera paths
    carry. `grey`: sums means over the channels, throughput included, and no classes (fewer sums to
    keep for many radii).
    """

    def __init__(self, radii, throughput, grey, marked):
        self.radii, self.throughput, self.grey, self.marked = radii, throughput, grey, marked
        self.split = marked and not grey
        self.classes = len(CLASSES) if self.split else 1

    def zeros(self):
        """The sums before the first photon."""
        count = self.classes * len(self.radii)
        return tuple(mi.Float(0) if self.grey else mi.Spectrum(0) for _ in range(count))

    def read(self, photon_map, index, active):
        """Flux of photons `index`, `delta_at_light` as of `photon.write_photon` (False where they
        are not marked), and the direction to where they came from (not normalised)."""
        flux, towards = read_power(photon_map.power, index, active)
        return (*read_mark(flux), towards) if self.marked else (flux, mi.Bool(False), towards)

    def add(self, totals, value, inside, asking, landing, delta_at_light, weights=None):
        """The sums with the `value` of one photon more, `inside` each radius or not. `asking`: what
        gathers it; `landing`: where it landed; `weights`: of the value, for each radius."""
        if self.grey:
            value = channel_mean(value * self.throughput)
        values = [value]
        if self.split:
            values = by_class_of_photons(value, landing.depth, asking.first, delta_at_light)
        weights = weights or [1] * len(inside)
        found = [
            dr.select(i, value * weight, 0)
            for i, weight in zip(inside, weights)
            for value in values
        ]
        return tuple(total + value for total, value in zip(totals, found))

    def estimates(self, totals, measure, light_path_count, active):
        """Radiance: the sums over (the kernel's `measure(radius)` x light sub-paths)."""
        factor = 1 if self.grey else self.throughput
        radii = [radius for radius in self.radii for _ in range(self.classes)]
        return [
            dr.select(active, total * factor / (measure(radius) * light_path_count), 0)
            for total, radius in zip(totals, radii)
        ]


def disk_area(radius):
    """pi radius^2."""
    return dr.pi * dr.square(radius)


def ball_volume(radius):
    """4/3 pi radius^3."""
    return (4 / 3 * dr.pi) * radius * dr.square(radius)
