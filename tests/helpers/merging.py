"""Weights of merges, by the code that makes them."""

from mis_integrators.integrators.merging import merged_light
from mis_integrators.paths.subpaths import media_record, vertex_layout

import drjit as dr
import mitsuba as mi
import numpy as np

NEAR = 1e-4
"""Merge radius: a vertex is merged with that of its own path only."""


def light_buffer(traits, y, states):
    """A buffer of light vertices, `y` (a record of all fields), one a lane."""
    count = dr.width(y["p"])
    index = dr.arange(mi.UInt32, count)
    buffer = {"words": vertex_layout(states).room(count)}
    vertex_layout(states).write(buffer["words"], y, index, True)
    if traits.has_media:
        buffer["media"] = media_record().room(count)
        media_record().write(buffer["media"], y, index, True)
    dr.eval(buffer)
    return buffer


def weights_of_merges(traits, y, z, valid, weigher, states):
    """Weights of merging light vertices `y` with camera vertices `z` (records; lane by lane), and
    where something was merged: what each brings over what it would bring without weights (NumPy).
    `weigher`: as of `merged_light`."""
    count = dr.width(y["p"])
    y["n"] = dr.select(valid, y["n"], mi.Vector3f(0, 0, 1))
    light = light_buffer(traits, y, states), mi.UInt32([count]), None
    brought = []
    for each in (weigher, lambda photon_map: lambda *of_photon: mi.Float(1)):
        radius, spectral = dr.opaque(mi.Float, NEAR), {"wavelengths": []}
        (radiance,) = merged_light(
            traits, light, count, states, z, valid, each, radius, 1, -1, spectral
        )
        brought.append(np.array(dr.mean(radiance)))
    return brought[0] / np.maximum(brought[1], 1e-30), mi.Bool(brought[1] > 0)
