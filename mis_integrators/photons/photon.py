"""One photon in memory: a 16-byte record with what tells whether a query wants it, and another one
with the light that it carries."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ..core.packing import (
    pack_direction,
    pack_surface,
    unpack_caustic,
    unpack_depth,
    unpack_direction,
    unpack_normal,
    with_mark,
)
from ..core.records import Layout


def surface_layout():
    """Position `p`; `surface`: normal, depth and kind as of `packing.pack_surface`."""
    return Layout({"p": mi.Point3f, "surface": mi.UInt32})


def power_layout():
    """`flux` that one light sub-path carries, a number a channel or wavelength; `towards`: packed
    direction to where it came from."""
    return Layout({"flux": mi.Spectrum, "towards": mi.UInt32})


def new_photons(capacity):
    """Room for the two records of each photon: `(surface, power)`."""
    return surface_layout().room(capacity), power_layout().room(capacity)


def write_photon(surface, power, slot, photon, active):
    """Writes photons to the places `slot`. `photon`: by name, `p`, geometric normal `n`, `towards`,
    `flux`, `depth` in segments, and whether it is a `caustic` one. Where light is split into
    classes, `delta_at_light`, too: whether what it met first scattered by a delta function; the
    flux then has that as its mark (`packing.with_mark`)."""
    word = pack_surface(photon["n"], photon["depth"], photon["caustic"])
    surface_layout().write(surface, {"p": photon["p"], "surface": word}, slot, active)
    towards = pack_direction(photon["towards"])
    flux = photon["flux"]
    if "delta_at_light" in photon:
        flux = with_mark(flux, photon["delta_at_light"])
    power_layout().write(power, {"flux": flux, "towards": towards}, slot, active)


@dataclass
class Landing:
    """Where a photon landed: position, normal (not normalised), depth, kind."""

    p: mi.Point3f
    n: mi.Vector3f
    depth: mi.UInt32
    caustic: mi.Bool


def read_landing(surface, index, active=True):
    """The `Landing` of photons `index`."""
    return landing_of(surface_layout().read(surface, index, active))


def landing_of(record):
    """The `Landing` that a record of `surface_layout` describes."""
    word = record["surface"]
    return Landing(record["p"], unpack_normal(word), unpack_depth(word), unpack_caustic(word))


def read_power(power, index, active=True):
    """Flux (a `Spectrum`, for one light sub-path) of photons `index`, and direction to where they
    came from (not normalised). The flux may have a mark, see `write_photon`."""
    record = power_layout().read(power, index, active)
    return record["flux"], unpack_direction(record["towards"])
