"""``volpath_multiview`` against ``volpath`` by the number of views: error x time for the first 2,
4, 8, ... views of a scene, and pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from mis_integrators.volume.views import views_of

from common.races import Race
from common.rows import Row, save, show
from common.scene_files import BUNDLED
from experiments.multiview import load, race
from report import sections
from report.figures import draw_densities
from report.page import Page

SCENES = [
    BUNDLED / "multiview" / f"{name}.xml" for name in ("smoke_orbit", "light_field", "fly_through")
]
"""Scenes whose views overlap."""
COUNTS = (2, 4, 8, 16, 32, 64)
FEW = 16
"""Number of views below which there is no less time, or starting kernels is all that `volpath`
would do."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``views``."""
    page = Page("Many views", options.out / "views.html")
    page.add(section(options, options.out))
    page.write()
    print(f"page: {page.path}")


def section(options: argparse.Namespace, folder: Path) -> str:
    """The section of a page: charts, pictures of some views, the table; CSV and JSON on the way.
    `options`: `view_scenes`, `view_counts`, `view_time`, `view_seeds`, `view_scale`,
    `view_weights`."""
    rows: list[Row] = []
    races: dict[str, Race] = {}
    for path in options.view_scenes:
        for count in options.view_counts:
            scene, parameters = load(path, options.view_scale, count)
            if sum(len(views_of(sensor)) for sensor in scene.sensors()) < count:
                break
            methods = {
                f"volpath_multiview:weights={weights}": {"weights": weights}
                for weights in options.view_weights
            }
            how = argparse.Namespace(
                time=options.view_time * max(count, FEW), seeds=options.view_seeds
            )
            found = race(scene, parameters, methods, f"{path.stem}, {count} views", how)
            rows += [_row(path.stem, name, found) for name in methods]
            races[path.stem] = found
            save(options.out, "view_counts", rows, vars(options))
    title = "Relative variance x time of volpath_multiview over that of volpath"
    show(f"{title}, by the number of views", rows)
    draw_densities(folder / "multiview_densities.png")
    return sections.view_counts(rows, races, folder)


def _row(scene: str, name: str, found: Race) -> Row:
    return {
        "scene": scene,
        "views": found.views,
        "method": name,
        "ratio": found.cost(name) / found.cost("volpath"),
        "variance x s": found.cost(name),
        "volpath variance x s": found.cost("volpath"),
        "samples": found.samples(name),
        "volpath samples": found.samples("volpath"),
        "seconds": found.seconds(name),
    }
