"""Photon maps whose photons have different merge radii (see `spread`): a grid for each radius.

A query goes from layer to layer, and visits in each the photons within that layer's radius. So few
photons with large radii cost little among many with small ones.
"""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi

from ..paths.light_classes import CLASSES
from .gather import gather_photons
from .grid import Grid, PhotonMap, smallest_cell, sort_by_cell, table_room, table_size
from .photon import landing_of, power_layout, surface_layout
from .spread import LAYERS, flux_of, layer_radius


class LayeredMap:
    """Sorted photons (see `PhotonMap`), layer by layer. `radius`: of the first layer; `count`: the
    photons of each; `smallest`: least edge of a cell."""

    def __init__(self, arrays, bbox, capacity):
        self._arrays = arrays
        self.start, self.surface, self.power = (
            arrays[name] for name in ("start", "surface", "power")
        )
        self.radius, self.count = arrays["layer_radius"], arrays["layer_count"]
        self.bbox, self.capacity = bbox, capacity

    def arrays(self):
        """What a recorded function can take; the map can be made of it again."""
        return self._arrays

    @staticmethod
    def has_made(arrays):
        """Whether the arrays are those of such a map, not of a `PhotonMap`."""
        return "layer_radius" in arrays

    def layer(self, number):
        """The `PhotonMap` of a layer, its radius, and how many photons it has."""
        grid = layer_grid(self.bbox, self.radius, self.capacity, number)
        return (
            PhotonMap(grid, self.start, self.surface, self.power),
            layer_radius(self.radius, number),
            dr.gather(mi.UInt32, self.count, number),
        )


def layer_grid(bbox, radius, capacity, number):
    """The grid of a layer; `radius`: of the first."""
    size = table_size(capacity)
    cell = dr.maximum(layer_radius(radius, number), smallest_cell(bbox, capacity))
    return Grid(bbox, cell, size, number * table_room(size))


def build_layered_map(surface, power, count, bbox, radius, capacity, around):
    """The `LayeredMap` of the caustic photons, which lie in the layers that the light `around` them
    says (a `LightAround`); other arguments as of `build_photon_map`."""
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    record = surface_layout().read(surface, index, active)
    landing = landing_of(record)
    active &= landing.caustic
    flux = flux_of(power_layout().read(power, index, active))
    number = around.layer(landing.p, flux, active)
    in_layers = dr.zeros(mi.UInt32, LAYERS)
    dr.scatter_add(in_layers, mi.UInt32(1), number, active)
    grid = layer_grid(bbox, radius, capacity, number)
    start, target = sort_by_cell(grid, landing.p, active, LAYERS)
    sorted_surface = surface_layout().room(capacity)
    surface_layout().write(sorted_surface, record, target, active)
    sorted_power = power_layout().move(power, index, target, active)
    dr.eval(sorted_surface, sorted_power, in_layers)
    arrays = {
        "start": start,
        "surface": sorted_surface,
        "power": sorted_power,
        "layer_radius": radius,
        "layer_count": in_layers,
    }
    return LayeredMap(arrays, bbox, capacity)


def gather_layers(layered, vertices, light_path_count, max_depth, weigh=None, marked=False):
    """`gather_photons` of all layers, each with its radius. Arguments and result as there, but that
    there is one estimate, not one for each radius."""

    def step(number, totals):
        photon_map, radius, count = layered.layer(number)
        there = copy.copy(vertices)
        there.active &= count > 0
        parts = gather_photons(
            photon_map, there, [radius], light_path_count, max_depth, weigh, marked=marked
        )
        return number + 1, [total + part for total, part in zip(totals, parts)]

    totals = [mi.Spectrum(0) for _ in range(len(CLASSES) if marked else 1)]
    return dr.while_loop(
        (mi.UInt32(0), totals), lambda number, totals: number < LAYERS, step, label="layers"
    )[1]
