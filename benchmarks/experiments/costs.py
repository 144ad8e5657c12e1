"""Prices of events: fits what iterations cost to what they do, over scenes, in units of one segment
of Mitsuba's `path`.

Processor time is measured, not the clock's: other work on the machine disturbs it less. The
sessions take turns.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from mis_integrators.integrators import costs
from mis_integrators.integrators.choice import CANDIDATES
from mis_integrators.integrators.unidirectional import PathSession
from mis_integrators.paths.path_length_statistics import mean_segments

import mitsuba as mi
import numpy as np

from common.rows import show, tell
from common.scene_files import open_scene, scaled_size
from common.turns import processor_seconds

PLUGINS = tuple(CANDIDATES)
RADII = (1.0, 2.0)
"""Multiples of the automatic radius, so that the price of a gathered photon shows."""
ITERATIONS, SKIPPED = 8, 2
TARGET = Path(costs.__file__).with_name("costs.json")


def run(options: argparse.Namespace) -> None:
    """The sub-command ``costs``: measures, prints how well the fit explains each measurement, and
    writes the prices."""
    rows = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        tell(opened.name)
        rows += measured(opened, options.plugins)
    prices, table = dict(costs.PRICES), []
    for plugin in options.plugins:
        own = [row for row in rows if row["plugin"] == plugin]
        prices[plugin] = fit(own)
        for row in own:
            predicted = costs.cost(plugin, row["events"], prices)
            table.append(
                {
                    "scene": row["scene"],
                    "method": row["method"],
                    "cost": row["cost"],
                    "predicted / cost": predicted / row["cost"],
                }
            )
    show(
        "Cost of an iteration, in segments of path a pixel",
        table,
        ("scene", "method", "cost", "predicted / cost"),
    )
    TARGET.write_text(
        json.dumps(
            {
                plugin: {name: round(value, 5) for name, value in price.items()}
                for plugin, price in prices.items()
            },
            indent=1,
        )
        + "\n"
    )
    tell(f"prices written to {TARGET}")


def measured(opened, plugins) -> list[dict]:
    """One row a method and radius: events a pixel, and cost in units of a segment of `path`."""
    scene, sensor = opened.scene, opened.sensor
    first = mi.load_dict({"type": "bdpm", "camera_paths": 1, **opened.inherited})
    segments = mean_segments(
        scene, sensor, 1, 1, int(np.prod(opened.size)), first.max_depth, first.rr_depth
    )
    sessions = []
    for plugin in PLUGINS:
        if plugin not in (*plugins, "path"):
            continue
        given = {**opened.inherited, "direct_paths": 1, **CANDIDATES[plugin]}
        if plugin == "path":
            session = PathSession(first, scene, sensor, 0, None)
            sessions.append((plugin, plugin, session, costs.events(session, segments, None, 0.0)))
            continue
        pilot = mi.load_dict({"type": plugin, **given}).session(scene, sensor)
        pilot.iterate()
        if pilot.prediction is None:
            continue
        for factor in RADII:
            session = mi.load_dict({"type": plugin, **given}).session(scene, sensor)
            learned = pilot.learned
            radii = {kind: radius * factor for kind, radius in learned["radii"].items()}
            session.recall({**learned, "radii": radii})
            session.iterate()
            counted = costs.events(
                session, segments, session.last_vertex, pilot.prediction.gathered * factor**2
            )
            sessions.append((plugin, f"{plugin} x {factor:g}", session, counted))
    by_label = {label: session for _, label, session, _ in sessions}
    took = processor_seconds(by_label, ITERATIONS, SKIPPED)
    unit = took["path"] / float(sum(segments))
    return [
        {
            "scene": opened.name,
            "plugin": plugin,
            "method": label,
            "events": counted,
            "cost": took[label] / unit,
        }
        for plugin, label, _, counted in sessions
    ]


def fit(rows: list[dict]) -> dict[str, float]:
    """Prices, none negative, that explain the costs with the least squared relative error."""
    counts = np.array([row["events"] for row in rows])
    cost = np.array([row["cost"] for row in rows])
    if rows[0]["plugin"] == "path":
        return dict(zip(costs.EVENTS, (1.0, 0.0, 0.0, 0.0)))
    used = list(range(counts.shape[1]))
    while True:  # least squares, dropping the most negative price until none is
        solution, *_ = np.linalg.lstsq(
            counts[:, used] / cost[:, None], np.ones(len(cost)), rcond=None
        )
        if solution.min() >= 0:
            break
        del used[int(np.argmin(solution))]
    prices = np.zeros(counts.shape[1])
    prices[used] = solution
    return dict(zip(costs.EVENTS, prices.tolist()))
