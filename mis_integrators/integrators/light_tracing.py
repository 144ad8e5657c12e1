"""How many light sub-paths are worth joining to the sensor, for each camera path: as many as have
the least error in a given time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..pilot.noise import relative_weights, trimmed_mean
from . import costs

LEAST_LIGHT_TRACING, MOST_LIGHT_TRACING = 1 / 8, 8.0
"""Bounds of the ratio."""
MOST_CHOSEN = 1.0
"""The most that a pilot chooses. More light sub-paths take time from the rare paths that it does
not see: with 2.6 of them the squared error of `caustics` at equal time was 1.2 times as large as
with one, and in a window's light nothing was gained."""
TILE = 8
"""Pixels along the edge of a square whose brightness and noise are looked at together: a single
iteration knows little of one pixel."""
RARE_TILES = 0.02
"""Share of them that is left out, one at least: a single path that meets a lamp by way of glass
would outweigh all others."""


@dataclass
class LightTracingNoise:
    """Relative variances of a pixel, in an iteration with one light sub-path for each camera
    path."""

    light: float
    """Of what light sub-paths bring to the sensor."""
    camera: float
    """Of everything else: connections, emission met."""


def best_ratio(noise, light_cost, camera_cost):
    """Light sub-paths for each camera path: n that makes (camera + light / n) (camera_cost + n
    light_cost) least, n^2 = light camera_cost / (camera light_cost), from `LEAST_LIGHT_TRACING` to
    `MOST_CHOSEN`. `light_cost`, `camera_cost`: of a light sub-path and of a camera path, in the
    same unit."""
    square = noise.light * camera_cost / max(noise.camera * light_cost, 1e-30)
    return float(np.clip(np.sqrt(square), LEAST_LIGHT_TRACING, MOST_CHOSEN))


def path_costs(plugin, vertices, camera_paths):
    """Costs of a light sub-path and of a camera path of `plugin`, which have so many `vertices` (a
    pair) on average: a segment more than those."""
    price, (light, camera) = costs.PRICES[plugin], vertices
    return price["light"] * (1 + light), price["camera"] * (1 + camera) + price[
        "pixel"
    ] / camera_paths


def events(session):
    """Events a pixel of an iteration of a session that connects to resampled light sub-paths, in
    the order of `costs.EVENTS`; it has rendered one."""
    (light, camera), paths = session.vertices, session.integrator.camera_paths
    return paths * (1 + camera), paths * session.light_tracing * (1 + light), 0.0, 1.0


def observed_noise(corner, values, camera_paths, light, squares, weight):
    """The `LightTracingNoise` of one iteration.

    NumPy arrays: `corner` (2 x paths): pixels of camera paths, column and line; `values` (paths):
    their radiance, the `camera_paths` of a pixel one after the other; `light`, `squares` (height x
    width): in each pixel the sums of filter weight times light that meets the sensor, and times the
    square of that; `weight` (height x width): the expected sum of filter weights. Where a pixel has
    one camera path, its neighbour's stands for a second.

    Light that all camera paths of an iteration draw from makes their noise alike; that part is not
    seen.
    """
    height, width = weight.shape
    columns = -(-width // TILE)
    count = columns * -(-height // TILE)

    def tile_means(column, line, *values):
        """Means over the tiles, `nan` where there is nothing."""
        tile = (
            np.clip(line, 0, height - 1) // TILE * columns + np.clip(column, 0, width - 1) // TILE
        )
        number = np.bincount(tile, minlength=count)
        return [
            np.divide(
                np.bincount(tile, value, count), number, np.full(count, np.nan), where=number > 0
            )
            for value in values
        ]

    group_size = max(camera_paths, 2)
    groups = len(values) // group_size
    group = values[: groups * group_size].reshape(groups, group_size)
    camera, seen = tile_means(
        *corner[:, : groups * group_size : group_size],
        group.var(axis=1, ddof=1) / camera_paths,
        group.mean(axis=1),
    )
    line, column = np.indices(weight.shape)
    weight = np.maximum(weight, 1e-6)
    light, sensed = tile_means(
        column.ravel(),
        line.ravel(),
        (light / weight).ravel(),
        (squares / weight / camera_paths).ravel(),
    )
    met = np.isfinite(seen)
    sensed, camera = sensed[met], camera[met]
    relative = relative_weights((seen + light)[met])
    return LightTracingNoise(
        *(trimmed_mean(relative * noise, RARE_TILES, 1) for noise in (sensed, camera))
    )
