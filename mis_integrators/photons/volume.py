"""Volume photons: what light sub-paths leave where they scatter in media, and the map of them.

A photon carries its flux after the scattering's albedo, so that the sum of photons over a volume
estimates the light that is scattered there: fluence times the scattering coefficient, integrated.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.packing import DEPTH_BITS, MAX_DEPTH, pack_direction, with_mark
from ..core.recording import lanes
from ..core.records import Layout
from .grid import Grid, Table, places_before, sort_by_cell
from .light_cells import flux_of
from .photon import power_layout

CELL = 2.0
"""Tuned: edge of a cell of the grid, in radii; at least."""


def place_layout():
    """Position `p`; `word`: depth, kind, medium and share of the radius, as of `pack_place`."""
    return Layout({"p": mi.Point3f, "word": mi.UInt32})


CAUSTIC = 1 << DEPTH_BITS
"""Bit of a photon's word that says of which kind it is."""
MEDIUM_SHIFT, MOST_MEDIA = DEPTH_BITS + 1, (1 << 16) - 1
SHARE_SHIFT, SHARE_STEPS = DEPTH_BITS + 17, 4
"""Where the share of the radius is in a word; steps for each halving of it."""
LEAST_SHARE = 1 / 32
"""Tuned: of the radius, what a photon has at least."""


def pack_place(depth, caustic, medium):
    """A path depth (saturated at `MAX_DEPTH`), the photon's kind (caustic or not), and the number
    of a medium in 16 bits. The share of the radius is one."""
    word = dr.minimum(depth, MAX_DEPTH) | (number_of_medium(medium) << MEDIUM_SHIFT)
    return word | dr.select(caustic, mi.UInt32(CAUSTIC), 0)


def with_share(word, share):
    """A word of `pack_place` with that share of the radius, from `LEAST_SHARE` to one, in six
    bits."""
    return word | (mi.UInt32(dr.round(-SHARE_STEPS * dr.log2(share))) << SHARE_SHIFT)


def number_of_medium(medium):
    """Dr.Jit's registry number of media (0: none), of which there are hardly `MOST_MEDIA`."""
    return dr.reinterpret_array(mi.UInt32, medium) & MOST_MEDIA


def medium_of(number):
    """The medium of a number, as of `number_of_medium`."""
    return dr.reinterpret_array(mi.MediumPtr, number)


@dataclass
class VolumeLanding:
    """Where a volume photon was left: position, depth in segments, number of the medium, kind; and
    its radius over that of the query."""

    p: mi.Point3f
    depth: mi.UInt32
    medium: mi.UInt32
    caustic: mi.Bool
    share: mi.Float


def read_place(place, index, active=True):
    """The `VolumeLanding` of photons `index`."""
    return landing_of(place_layout().read(place, index, active))


def landing_of(record):
    """The `VolumeLanding` that a record of `place_layout` describes."""
    word = record["word"]
    medium = (word >> MEDIUM_SHIFT) & MOST_MEDIA
    share = dr.exp2(mi.Float(word >> SHARE_SHIFT) * (-1 / SHARE_STEPS))
    return VolumeLanding(record["p"], word & MAX_DEPTH, medium, (word & CAUSTIC) != 0, share)


def read_places(place, count):
    """The records of all photons of a buffer, and which of them are photons."""
    index = lanes(place_layout().capacity(place))
    active = index < dr.gather(mi.UInt32, count, 0)
    return place_layout().read(place, index, active), active


def new_volume_photons(capacity):
    """Room for the two records of each volume photon: `(place, power)`; the latter as of
    `photon.power_layout`."""
    return place_layout().room(capacity), power_layout().room(capacity)


def write_volume_photon(place, power, slot, photon, active):
    """Writes photons to the places `slot`. `photon`: by name, `p`, `towards`, `flux`, `depth`,
    `medium`, whether it is a `caustic` one, and where light is split into classes,
    `delta_at_light` (see `photon.write_photon`)."""
    word = pack_place(photon["depth"], photon["caustic"], photon["medium"])
    place_layout().write(place, {"p": photon["p"], "word": word}, slot, active)
    flux = photon["flux"]
    if "delta_at_light" in photon:
        flux = with_mark(flux, photon["delta_at_light"])
    towards = pack_direction(photon["towards"])
    power_layout().write(power, {"flux": flux, "towards": towards}, slot, active)


@dataclass
class Box:
    """A bounding box (as `mi.BoundingBox3f`, which no recording takes)."""

    min: mi.Point3f
    max: mi.Point3f


class VolumeMap:
    """Sorted volume photons: their `box`, a `grid` over it, `start` (first photon of each table
    entry), `place` and `power`. Under weights there are also `mis_words`, as light sub-paths have
    left them, and for each sorted photon its `number` among them."""

    def __init__(self, box, grid, start, place, power, mis_words=None, number=None):
        self.box, self.grid, self.start, self.place, self.power = box, grid, start, place, power
        self.mis_words, self.number = mis_words, number

    def arrays(self):
        """What a recorded function can take; `with_grid` makes the map of it again."""
        names = ["start", "place", "power"]
        if self.mis_words is not None:
            names += ["mis_words", "number"]
        return {
            **{name: getattr(self, name) for name in names},
            "low": self.box.min,
            "high": self.box.max,
            "cell": self.grid.cell,
        }

    def place_of_mis_words(self, index, active):
        """Where among the `mis_words` those of photon `index` are."""
        return dr.gather(mi.UInt32, self.number, index, active)

    @classmethod
    def with_grid(cls, arrays, capacity: int):
        """The map of `arrays`, built for the same capacity."""
        arrays = dict(arrays)
        box = Box(arrays.pop("low"), arrays.pop("high"))
        return cls(box, Grid(box, arrays.pop("cell"), Table(capacity)), **arrays)


def cell_size(radius, density, count):
    """The edge of cells for queries of a radius. Where the `density` of so many photons (width one)
    is known, cells are no smaller than holds one of them in the median: to visit an empty cell
    takes as long as to visit a photon."""
    if density is None:
        return CELL * radius
    return dr.maximum(CELL * radius, dr.rcp(dr.cbrt(density.median_of(mi.Float(count)))))


def build_volume_map(place, power, count, radius, capacity: int, mis_words=None, density=None):
    """Sorts volume photons into a grid over the box that holds them all. `mis_words` (None: there
    are none) stay unsorted. Photons have the share of the `radius` that their `density` says (a
    `VolumeDensity`; None: all of it)."""
    index = dr.arange(mi.UInt32, capacity)
    record, active = read_places(place, count)
    p = record["p"]
    if density is not None:
        share = density.share(p, flux_of(power, active), active)
        record["word"] = with_share(record["word"], share)
    box = Box(
        mi.Point3f(*(_extreme(dr.min, x, active, dr.inf) for x in p)),
        mi.Point3f(*(_extreme(dr.max, x, active, -dr.inf) for x in p)),
    )
    grid = Grid(box, cell_size(radius, density, count), Table(capacity))
    start, target = sort_by_cell(grid, p, active)
    sorted_place = place_layout().room(capacity)
    place_layout().write(sorted_place, record, target, active)
    sorted_power = power_layout().move(power, index, target, active)
    number = None
    if mis_words is not None:
        number = places_before(target, active)
    dr.eval(sorted_place, sorted_power, number)
    return VolumeMap(box, grid, start, sorted_place, sorted_power, mis_words, number)


def _extreme(reduce, values, active, neutral):
    """The smallest or largest of the active values; zero where there are none."""
    found = reduce(dr.select(active, values, neutral))
    return dr.select(dr.isfinite(found), found, 0)
