"""Merging the kept vertices of light sub-paths with those of camera sub-paths: what `vcm` and the
plugins of resampled connections share."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import to_numpy
from ..paths.light_classes import CLASSES, LightClasses
from ..paths.subpaths import STATES, on_surfaces, read_vertices
from ..paths.vertex import in_medium
from ..photons.gather import KeptVertices, gather_photons
from ..photons.vertex_map import vertex_map
from ..pilot.result import RADIUS_WITHOUT_VERTICES

RADIUS_SHARE = 0.004
"""Tuned: the automatic radius, in units of the spread of what the camera sees."""


def automatic_radius(traits, camera=None, found: int = 0, states=STATES):
    """Merge radius [m]: a share of the spread of the vertices on surfaces that camera paths meet
    first, among the `found` kept vertices `camera`: the diagonal, over the root of three, of the
    box that leaves out 2 % of them at either end of each axis. Of the scene's bounds where they
    meet none."""
    bounded = RADIUS_WITHOUT_VERTICES * traits.extent
    if not found:
        return bounded
    index = dr.arange(mi.UInt32, found)
    vertices = read_vertices(camera, index, True, ("p", "number", "n"), states)
    merged = (vertices["number"] == 0) & ~in_medium(vertices["n"])
    points = to_numpy(vertices["p"])[:, np.array(merged)]
    if not points.shape[1]:
        return bounded
    low, high = np.percentile(points, [2, 98], axis=1)
    return max(RADIUS_SHARE * float(np.linalg.norm(high - low)) / 3**0.5, 1e-3 * bounded)


def map_of_surfaces(traits, light, capacity: int, radius, states=STATES):
    """The `vertex_map` of the vertices of `trace_light_subpaths` that lie on surfaces."""
    vertices, count, _ = light
    if traits.has_media:
        vertices, count = on_surfaces(vertices, count, capacity, states)
    return vertex_map(vertices, count, capacity, traits.bounds, radius, states)


def merged_light(traits, photon_map, z, active, weigh, radius, light_paths, max_depth, spectral):
    """Radiance that the photons of a map bring to the camera vertices `z` (records) on surfaces, by
    class where these have a `mark`, and the lanes that may have some: `(parts, active)`.
    `light_paths`, whose photons they are; `weigh`: as of `gather_photons`."""
    if traits.has_media:
        active &= ~in_medium(z["n"])
    vertices = KeptVertices(traits, z, spectral["wavelengths"], active)
    parts = gather_photons(
        photon_map, vertices, [radius], light_paths, max_depth, weigh, marked="mark" in z
    )
    return parts, active


def with_merged(radiance, entries, parts, z, active, paths: int):
    """Radiance of `paths` camera paths, and the entries of its classes, with `merged_light` added
    to those of the vertices `z`."""
    total, (merged, *others) = mi.Spectrum(radiance), parts
    dr.scatter_reduce(dr.ReduceOp.Add, total, sum(others, merged), z["path"], active)
    if others:
        names = [f"merged.{name}" for name in CLASSES]
        classes = LightClasses(paths, entries, names)
        for number, (name, part) in enumerate(zip(names, parts)):
            classes.add(name, z["path"], mi.UInt32(number), part, active)
        entries = classes.entries
    return total, entries
