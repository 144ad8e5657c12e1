"""What an iteration costs: prices of events, counted and not clocked, so that a decision does not
hang on how busy a machine is.

The unit is the cost of one segment of Mitsuba's `path` (a ray, its surface, a shadow ray). The
prices in `costs.json` were fitted to the bundled scenes by ``benchmarks/run.py costs``.
"""

from __future__ import annotations

import json
from pathlib import Path

EVENTS = ("camera", "light", "gathered", "pixel")
"""A pixel's camera segments, light segments, and photons within its merge disk; and what does not
depend on any of them."""
PRICES = json.loads(Path(__file__).with_name("costs.json").read_text())


def events(session, segments, last_vertex, gathered, camera_paths=1):
    """Events of an iteration of so many camera paths a pixel, in the order of `EVENTS`.

    `segments`: `paths.path_length_statistics.mean_segments`; `last_vertex`: the last smooth vertex
    that shades (`None`: all); `gathered`: photons within a vertex's merge disks.
    """
    camera = float(sum(segments if last_vertex is None else segments[: last_vertex + 1]))
    paths = getattr(session, "chosen_light_paths", 0) * session.camera_paths / session.path_count
    light = paths * (1 + getattr(session, "photons_a_path", 0))
    return camera_paths * camera, light, camera_paths * gathered, 1.0


def of_direct_paths(session, segments):
    """Cost of the camera paths that see direct light only, beside the first: they are as far as the
    first smooth vertex what `path` is, whose segments are the unit."""
    return session.direct_light.mean_paths * float(segments[0])


def of_light_apart(path, segments):
    """Cost of tracing a camera path again, up to so many segments, for the light of `path` that is
    kept apart."""
    return min(float(sum(segments)), path.segments_apart)


def cost(plugin, counted, prices=PRICES):
    """Cost of an iteration of `plugin` with these events a pixel, in segments of `path`."""
    return sum(prices[plugin][name] * count for name, count in zip(EVENTS, counted))
