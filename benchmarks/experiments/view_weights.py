"""MIS and MWIS of ``volpath_multiview`` pixel by pixel: relative variance and bias against the
share of the weights that other views bring."""

from __future__ import annotations

import argparse
from itertools import pairwise

from mis_integrators.analysis.metrics import RELATIVE_OFFSET

import numpy as np

from common.rows import Row, console, save, show, tell
from experiments.multiview import Together, load
from report.figures import draw_by_share

ESTIMATORS = ("weighted sum", "mis", "mwis")
"""The sum of weighted samples over their expected number; that with the fluctuation of the weights
taken away (what `weights=mis` gives); the ratio of the sums."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``view-weights``."""
    rows: list[Row] = []
    for path in options.scenes:
        rows += measure(path, options)
        save(options.out, "view_weights", rows, vars(options))
    show("Relative variance by the share of other views", rows)
    for path in options.scenes:
        mine = [row for row in rows if row["scene"] == path.stem]
        curves = {
            name: [
                (row["share of others"], row[f"{name} variance"] / row["weighted sum variance"])
                for row in mine
            ]
            for name in ESTIMATORS
        }
        chart = options.out / f"view_weights_{path.stem}.png"
        draw_by_share(chart, curves)
        console.print(f"chart: {chart}")


def measure(path, options: argparse.Namespace) -> list[Row]:
    """A row for each group of pixels of like share: all three estimators made of the same
    samples."""
    scene, parameters = load(path, options.scale)
    session = Together(scene, {**parameters, "camera_paths": 1}).session
    images: dict[str, list[np.ndarray]] = {name: [] for name in ESTIMATORS}
    for seed in range(options.seeds):
        session.restart(seed)
        for _ in range(options.iterations):
            session.iterate()
        for name, image in estimates(session).items():
            images[name].append(image)
        tell(f"{path.stem}: {seed + 1} of {options.seeds} seeds")
    others = 1 - own_share(session, options.iterations * options.seeds)
    mean = np.mean(images["mis"], axis=0)
    divisor = mean**2 + RELATIVE_OFFSET
    found = {name: np.stack(stack) for name, stack in images.items()}
    edges = np.quantile(others, np.linspace(0, 1, options.groups + 1))
    rows = []
    for low, high in pairwise(edges):
        group = (others >= low) & ((others < high) | (high == edges[-1]))
        row: Row = {
            "scene": path.stem,
            "share of others": float(others[group].mean()),
            "pixels": int(group.sum()),
        }
        for name, stack in found.items():
            row[f"{name} variance"] = float((stack.var(axis=0, ddof=1) / divisor)[group].mean())
        bias = (found["mwis"].mean(axis=0) - mean) / np.sqrt(divisor)
        row["mwis bias"] = float(bias[group].mean())
        rows.append(row)
    return rows


def estimates(session) -> dict[str, np.ndarray]:
    """The parts of the pictures that all views share, by each estimator: (pixels of all views,
    3)."""
    sums = session.accumulator
    total = (sums.shared[0] + sums.shared[1])[:, :, :3] / (sums.expected * sums.iterations)
    sums.ratio = False
    mis = sums._colour()
    sums.ratio = True
    mwis = sums._colour()
    sums.ratio = False
    return {name: pixels(session, image) for name, image in zip(ESTIMATORS, (total, mis, mwis))}


def own_share(session, iterations: int) -> np.ndarray:
    """The weight that each view's own paths bring to its pixels (pixels of all views,), smoothed
    over 5 x 5 pixels."""
    splat = session._splat

    def own_only(scene, tables, pivots, radiance, connections, *more):
        return splat(
            scene,
            tables,
            pivots,
            radiance,
            {**connections, "ratio": 0 * connections["ratio"]},
            *more,
        )

    session._splat = own_only
    session._freeze()
    session.restart(10_000)
    for _ in range(iterations):
        session.iterate()
    sums = session.accumulator
    return np.clip(
        pixels(
            session,
            (sums.shared[0] + sums.shared[1])[:, :, 3:] / (sums.expected * sums.iterations),
            5,
        )[:, 0],
        0,
        1,
    )


def pixels(session, image, smooth: int = 1) -> np.ndarray:
    """All views' pixels of the common image, each averaged with its neighbours of its own view."""
    image, views, found = np.array(image, dtype=np.float64), session.views, []
    for (width, height), top in zip(views.sizes, views.tops):
        one = image[top : top + height, views.margin : views.margin + width]
        wide = np.pad(one, ((smooth // 2,) * 2, (smooth // 2,) * 2, (0, 0)), mode="edge")
        found.append(
            np.mean(
                [wide[y : y + height, x : x + width] for y in range(smooth) for x in range(smooth)],
                axis=0,
            ).reshape(-1, image.shape[2])
        )
    return np.concatenate(found)
