"""Whether `bdpm_auto` is ever behind: its errors over those of the better `path` and of the best
method that was compared, over scenes and rendering times."""

from __future__ import annotations

import argparse

import numpy as np

from common.methods import PATH_TRACERS
from common.rooms import write_rooms
from common.rows import Row, save, show
from common.scene_files import bundled
from experiments.compare import compare, measure_scene, over
from report.results import BEHIND

AUTO = "bdpm_auto"
BOUNDS = (BEHIND, 1.15, 1.3)
"""Ratios below which rows are counted."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``choice``."""
    rows: list[Row] = []
    rooms = write_rooms(options.out / "rooms", options.rooms)
    scenes = [*(options.scenes or ([] if rooms else bundled())), *rooms]
    for path in scenes:
        for seconds in options.times:
            options.time = seconds
            found = compare(measure_scene(path, options, []))
            rows += judged(found, seconds, "denoised " if options.denoise else "")
            save(options.out, "choice", rows, vars(options))
        show(f"{AUTO} on {path.stem}: errors over those of others", rows[-len(options.times) :])
    show("all rows", rows)
    show("share of the rows at most so far behind", shares(rows))


def judged(compared: list[Row], seconds: float, kind: str) -> list[Row]:
    """One row for `bdpm_auto` among the rows of `compare`, if it could render the scene: its errors
    (of the images' `kind`) over those of the better `path` and of the best method, each measure by
    itself."""
    mine = next((row for row in compared if row["method"] == AUTO), None)
    if mine is None:
        return []
    row = {"scene": mine["scene"], "seconds": seconds}
    for measure in ("relMSE", "MSE"):
        name = f"{kind}{measure}"
        row[f"{name} / best path"] = mine[f"{name} / best path"]
        row[f"{name} / best"] = over(mine[name], min(other[name] for other in compared))
    beside = [r for r in compared if str(r["method"]).partition(":")[0] in PATH_TRACERS]
    own = f"{kind}artefacts"
    of_path = min((other[own] for other in beside), default=float("nan"))
    row |= {own: mine.get(own, float("nan")), f"{own} of path": of_path}
    best = min(compared, key=lambda other: other[f"{kind}relMSE"])
    chosen = str(mine["settings"]).partition("choice=")[2].partition(" ")[0]
    return [{**row, "chosen": chosen, "best": best["method"]}]


def shares(rows: list[Row]) -> list[Row]:
    """Of each ratio that is known anywhere: the shares of rows within the `BOUNDS`, the geometric
    mean, the largest."""
    ratios = [name for name in rows[0] if " / best" in name] if rows else []
    found = []
    for name in ratios:
        values = np.array([row[name] for row in rows], float)
        values = values[np.isfinite(values)]
        if not values.size:
            continue
        found.append(
            {
                "ratio": name,
                **{f"<= {bound:g}": float(np.mean(values <= bound)) for bound in BOUNDS},
                "geometric mean": float(np.exp(np.mean(np.log(np.maximum(values, 1e-6))))),
                "largest": float(values.max()),
            }
        )
    return found
