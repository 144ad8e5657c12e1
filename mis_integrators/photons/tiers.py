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
    places_before,
    read_photons,
    sorted_photons,
)
from .light_around import TIERS
from .light_cells import flux_of, tier_radius
from .photon import landing_of

LEFT_TO_DENOISER = 3
"""Tuned: the last tier whose photons have disks of a pixel's size in images that will be denoised.
They bring at most `MOST_OF_LIGHT` of what falls within eight pixels."""


class TieredMap:
    """Sorted photons, tier by tier. `arrays`: `start`, `surface` and `power` as of a `PhotonMap`,
    and `tier_radius`, that of the first tier; where photons carry something for weights,
    `mis_words` and `place`, too, and `around`, the `LightAround` that tells the tiers."""

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
        words = (self._arrays.get(name) for name in ("mis_words", "place"))
        photon_map = PhotonMap(grid, start, surface, power, *words)
        return photon_map, tier_radius(radius, number), count

    def radii_of(self, p, flux, first, lobe_width, left, active):
        """Radii of the disks of photons of that `flux`, would they land at `p` (of a map whose
        photons carry something); other arguments as of `gather_tiers` and `tiers_of`."""
        radius, around = self._arrays["tier_radius"], self._arrays["around"]
        number = tiers_of(around, p, flux, radius, left, active)
        return disk_of(number, tier_radius(radius, number), first, lobe_width)


def tier_table(capacity):
    """The `Table` of each tier. Few photons are caustic ones: a quarter of the usual one does."""
    return Table(capacity // 4)


def tier_grid(bbox, table, radius, number):
    """The grid of a tier; `radius`: of the first."""
    return Grid(bbox, tier_radius(radius, number), table, table.first_entry(number))


def disk_of(number, radius, first, lobe_width):
    """The radius of the disk in which a vertex gathers photons of the tier `number`, whose `radius`
    suits those that scatter evenly: where lobes are narrower by `lobe_width`, so is the disk, down
    to the `first`. A glossy floor would else show a blurred image of what the photons come from."""
    return dr.select(number > 0, dr.maximum(lobe_width * radius, first), first)


def tiers_of(around, p, flux, radius, left, active):
    """Tiers of photons as of `LightAround.tier`, but those up to `left` are the first."""
    number = around.tier(p, flux, radius, active)
    return dr.select(number > left, number, 0)


def build_tiered_map(surface, power, count, bbox, radius, capacity, around, left=0, mis_words=None):
    """The `TieredMap` of the caustic photons, which lie in the tiers that the light `around` them
    says (a `LightAround`), but those of tiers up to `left` in the first; other arguments as of
    `build_photon_map`."""
    record, active = read_photons(surface, count, capacity)
    landing = landing_of(record)
    active &= landing.caustic
    number = tiers_of(around, landing.p, flux_of(power, active), radius, left, active)
    grid = tier_grid(bbox, tier_table(capacity), radius, number)
    start, surface, power, target = sorted_photons(grid, record, power, active, TIERS)
    arrays = {"start": start, "surface": surface, "power": power, "tier_radius": radius}
    if mis_words is not None:
        place = places_before(target, active)
        arrays |= {"mis_words": mis_words, "place": place, "around": around}
    return TieredMap(arrays, bbox, capacity)


def gather_tiers(tiered, vertices, first, light_path_count, max_depth, weigher=None, marked=False):
    """`gather_photons` of all tiers, each with its `disk_of` the vertices: those of the first tier
    have the radius `first` (of width one, or one a vertex). `weigher(photon_map, radii)`: what
    makes `weigh` of a tier's map (None: no weights). Other arguments and result as there, but that
    there is one estimate, not one for each radius."""

    def step(number, totals):
        photon_map, radius, count = tiered.tier(number)
        there = copy.copy(vertices)
        there.active = vertices.active & (count > 0)
        disk = disk_of(number, radius, first, vertices.lobe_width)
        parts = gather_photons(
            photon_map,
            there,
            [disk],
            light_path_count,
            max_depth,
            weigher and weigher(photon_map, [disk]),
            marked=marked,
            height=radius,
        )
        return number + 1, [total + part for total, part in zip(totals, parts)]

    totals = [mi.Spectrum(0) for _ in range(len(CLASSES) if marked else 1)]
    return dr.while_loop(
        (mi.UInt32(0), totals), lambda number, totals: number < TIERS, step, label="tiers"
    )[1]
