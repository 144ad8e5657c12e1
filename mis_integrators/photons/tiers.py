"""Photon maps whose photons have different merge radii (see `light_around`): a grid for each.

A query goes from tier to tier, and visits in each the photons within that tier's radius. So few
photons with large radii cost little among many with small ones.
"""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi

from ..paths.light_classes import CLASSES
from .gather import gather_photons
from .grid import (
    Grid,
    PhotonMap,
    Table,
    read_photons,
    sorted_photons,
)
from .light_around import TIERS
from .light_cells import flux_of, tier_radius
from .photon import landing_of

AT_NARROW_LOBES = 2.0
"""Tuned: how many times larger disks are at surfaces with narrow lobes, where one photon in the
lobe brings as much as many elsewhere."""
LEFT_TO_DENOISER = 3
"""Tuned: the last tier whose photons have disks of a pixel's size in images that will be denoised.
They bring at most `MOST_OF_LIGHT` of what falls within eight pixels."""


class TieredMap:
    """Sorted photons, tier by tier. `arrays`: `start`, `surface` and `power` as of a `PhotonMap`,
    and `tier_radius`, that of the first tier."""

    def __init__(self, arrays, bbox, capacity):
        self._arrays, self.bbox, self.table = arrays, bbox, tier_table(capacity)

    def arrays(self):
        """What a recorded function can take; the map can be made of it again."""
        return self._arrays

    @staticmethod
    def has_made(arrays):
        """Whether the arrays are those of such a map, not of a `PhotonMap`."""
        return "tier_radius" in arrays

    def tier(self, number):
        """The `PhotonMap` of a tier, its radius, and how many photons it has."""
        start, surface, power, radius = (
            self._arrays[name] for name in ("start", "surface", "power", "tier_radius")
        )
        grid = tier_grid(self.bbox, self.table, radius, number)
        last = self.table.first_entry(number + 1) - 1  # where no photon is
        count = dr.gather(mi.UInt32, start, last) - dr.gather(mi.UInt32, start, grid.first)
        return PhotonMap(grid, start, surface, power), tier_radius(radius, number), count


def tier_table(capacity):
    """The `Table` of each tier. Few photons are caustic ones: a quarter of the usual one does."""
    return Table(capacity // 4)


def tier_grid(bbox, table, radius, number):
    """The grid of a tier; `radius`: of the first."""
    return Grid(bbox, tier_radius(radius, number), table, table.first_entry(number))


def build_tiered_map(surface, power, count, bbox, radius, capacity, around, left=0):
    """The `TieredMap` of the caustic photons, which lie in the tiers that the light `around` them
    says (a `LightAround`), but those of tiers up to `left` in the first; other arguments as of
    `build_photon_map`."""
    record, active = read_photons(surface, count, capacity)
    landing = landing_of(record)
    active &= landing.caustic
    number = around.tier(landing.p, flux_of(power, active), radius, active)
    number = dr.select(number > left, number, 0)
    grid = tier_grid(bbox, tier_table(capacity), radius, number)
    start, surface, power, _ = sorted_photons(grid, record, power, active, TIERS)
    arrays = {"start": start, "surface": surface, "power": power, "tier_radius": radius}
    return TieredMap(arrays, bbox, capacity)


def gather_tiers(
    tiered, vertices, first, light_path_count, max_depth, weigh=None, marked=False, narrow=False
):
    """`gather_photons` of all tiers, each with its radius, which at vertices with `narrow` lobes is
    `AT_NARROW_LOBES` times as large, but the first with the radius `first` (of width one, or one a
    vertex). Other arguments and result as there, but that there is one estimate, not one for each
    radius."""
    wider = dr.select(narrow, mi.Float(AT_NARROW_LOBES), 1)

    def step(number, totals):
        photon_map, radius, count = tiered.tier(number)
        there = copy.copy(vertices)
        there.active = vertices.active & (count > 0)
        parts = gather_photons(
            photon_map,
            there,
            [dr.select(number > 0, radius * wider, first)],
            light_path_count,
            max_depth,
            weigh,
            marked=marked,
            height=radius,
        )
        return number + 1, [total + part for total, part in zip(totals, parts)]

    totals = [mi.Spectrum(0) for _ in range(len(CLASSES) if marked else 1)]
    return dr.while_loop(
        (mi.UInt32(0), totals), lambda number, totals: number < TIERS, step, label="tiers"
    )[1]
