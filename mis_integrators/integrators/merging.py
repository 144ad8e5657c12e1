"""Merging the kept vertices of light sub-paths with those of camera sub-paths: what `vcm` and the
plugins of resampled connections share."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import to_numpy
from ..mis.vertex_merging import Merging
from ..paths.light_classes import CLASSES, LightClasses
from ..paths.subpaths import STATES, on_surfaces, read_vertices
from ..paths.vertex import in_medium
from ..photons.gather import KeptVertices, gather_photons
from ..photons.kernel_sums import ball_volume
from ..photons.points import Points, gather_in_balls
from ..photons.vertex_map import vertex_map, vertex_map_in_media
from ..pilot.result import RADIUS_WITHOUT_VERTICES

RADIUS_SHARE = 0.004
"""Tuned: the automatic radius, in units of the spread of what the camera sees."""
WIDER_BALLS = 4.0
"""Radius of balls in media, in that of disks on surfaces. A ball finds 85 R sigma times as many
photons as a disk of radius R then; as wide as the disk, it would find hardly any."""


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


def merging_of(traits, radius, light_paths: int):
    """The `Merging` of disks of a radius (width one) with so many light sub-paths."""
    disk = dr.pi * dr.square(radius) * light_paths
    if not traits.has_media:
        return Merging(disk)
    return Merging(disk, ball_volume(WIDER_BALLS * radius) * light_paths)


def merged_light(
    traits, light, capacity, states, z, active, weigher, radius, light_paths, max_depth, spectral
):
    """Radiance that the vertices `light` (as of `trace_light_subpaths`, with the weights' `states`)
    bring to the camera vertices `z` (records), by class where these have a `mark`: a list.
    `weigher(photon_map)` makes what weighs them (`weigh` of `gather_photons`); `light_paths`: the
    sub-paths whose vertices they are."""
    marked, wavelengths = "mark" in z, spectral["wavelengths"]
    vertices, count, _ = light
    on_surface = active
    if traits.has_media:
        vertices, count = on_surfaces(vertices, count, capacity, states)
        on_surface = active & ~in_medium(z["n"])
    photon_map = vertex_map(vertices, count, capacity, traits.bounds, radius, states)
    parts = gather_photons(
        photon_map,
        KeptVertices(traits, z, wavelengths, on_surface),
        [radius],
        light_paths,
        max_depth,
        weigher(photon_map),
        marked=marked,
    )
    if not traits.has_media:
        return parts
    inside, ball = active & in_medium(z["n"]), WIDER_BALLS * radius
    photon_map = vertex_map_in_media(*light[:2], capacity, ball, states)
    record = {**z, "d": -z["towards"], "medium": z["above"], "first": z.get("mark")}
    record["throughput"] = dr.select(inside, z["throughput"], 0)
    in_media = gather_in_balls(
        photon_map,
        Points.of(traits, record, wavelengths),
        [ball],
        light_paths,
        max_depth,
        weigher(photon_map),
        marked=marked,
        straight=True,
    )
    return [a + b for a, b in zip(parts, in_media)]


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
