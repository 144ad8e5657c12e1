"""Photon maps of kept vertices: light sub-paths that are joined can be merged, too."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..paths.subpaths import STATES, read_vertices
from ..paths.vertex import in_medium
from .grid import build_photon_map
from .photon import new_photons, write_photon
from .volume import build_volume_map, new_volume_photons, write_volume_photon

UPRIGHT = 0, 0, 1
"""Stands for unit vectors in places that hold none."""


def state_layout(states):
    """What such photons have of the weights: the state of their vertex, numbers of these names."""
    return Layout(dict.fromkeys(states, mi.Float))


def _photons(vertices, count, capacity, states):
    """Kept vertices as photons: places, those that hold one, the vertices' records, and what both
    kinds of photons have of them."""
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    fields = ("p", "n", "depth", "towards", "throughput", "mark", "media", *states)
    y = read_vertices(vertices, index, active, fields, states)
    photon = {
        "p": y["p"],
        "towards": dr.select(active, y["towards"], mi.Vector3f(*UPRIGHT)),
        "flux": y["throughput"],
        "depth": y["depth"],
        "caustic": mi.Bool(False),
    }
    if "mark" in y:
        photon["delta_at_light"] = y["mark"]
    return index, active, y, photon


def vertex_map(vertices, count, capacity: int, bounds, cell, states=STATES):
    """A `PhotonMap` of all kept light vertices, whose weights have these `states`; its mis_words
    are records of `state_layout`. Arguments as of `build_photon_map`. If the vertices are marked,
    so are the photons."""
    index, active, y, photon = _photons(vertices, count, capacity, states)
    photon["n"] = dr.select(active, y["n"], mi.Vector3f(*UPRIGHT))
    surface, power = new_photons(capacity)
    mis_words = state_layout(states).room(capacity)
    write_photon(surface, power, index, photon, active)
    state_layout(states).write(mis_words, y, index, active)
    dr.eval(surface, power, mis_words)
    return build_photon_map(surface, power, count, bounds, cell, capacity, "all", mis_words)


def vertex_map_in_media(vertices, count, capacity: int, radius, states=STATES):
    """The same, a `VolumeMap`, of those that lie in media."""
    _, active, y, photon = _photons(vertices, count, capacity, states)
    photon["medium"] = y["above"]
    keep = active & in_medium(y["n"])
    found = dr.zeros(mi.UInt32, 1)
    slot = dr.scatter_inc(found, mi.UInt32(0), keep)
    place, power = new_volume_photons(capacity)
    mis_words = state_layout(states).room(capacity)
    write_volume_photon(place, power, slot, photon, keep)
    state_layout(states).write(mis_words, y, slot, keep)
    dr.eval(place, power, mis_words, found)
    return build_volume_map(place, power, found, radius, capacity, mis_words)


def state_of(photon_map, index, active, states=STATES):
    """The weights' state of photons `index` of a `vertex_map`, a list."""
    place = photon_map.place_of_mis_words(index, active)
    record = state_layout(states).read(photon_map.mis_words, place, active)
    return [record[name] for name in states]
