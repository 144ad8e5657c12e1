"""Variance of one iteration at equal radius: numbers against the best single strategy, and maps side by side."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from methods import Method
from mis_integrators.analysis.metrics import trimmed_mean
from mis_integrators.analysis.variance_maps import best_single, relative_variance, share_worse
from mis_integrators.transport.traits import scene_bounds
from reports import Row, save, show, tell
from scene_files import OpenScene, open_scene, scaled_size

COLUMNS = ("scene", "N_B", "method", "relative variance", "ratio to best single", "untrimmed ratio",
           "time ratio", "equal-time ratio", "blocks worse")


def run(options: argparse.Namespace) -> None:
    """The sub-command ``variance``."""
    rows: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        radius = options.radius or options.radius_share * float(np.linalg.norm(np.array(scene_bounds(opened.scene).extents())))
        for camera_paths in options.camera_paths:
            rows += compare(opened, radius, camera_paths, options)
            show(f"{opened.name}: one iteration, radius {radius:.3g}", [r for r in rows if r["scene"] == opened.name], COLUMNS)
            save(options.out, "variance", rows, vars(options))
    for camera_paths in options.camera_paths:
        summarise([row for row in rows if row["N_B"] == camera_paths], camera_paths)


def compare(opened: OpenScene, radius: float, camera_paths: int, options: argparse.Namespace) -> list[Row]:
    """A row a method; pictures and maps go to a PNG."""
    common = {"initial_radius": radius, "camera_paths": camera_paths, "variance": True}
    images, variances, seconds = [], [], []
    for method in options.integrators:
        integrator = Method(method.label, method.plugin, {**common, **method.parameters}).integrator(opened)
        session = integrator.session(opened.scene, opened.sensor, seed=1)
        session.iterate()
        session.iterate()
        start = time.perf_counter()
        while session.iterations < options.iterations + 2:
            session.iterate()
            tell(f"{opened.name}: {method.label} {session.iterations}")
        seconds.append((time.perf_counter() - start) / options.iterations)
        image = session.image()
        images.append(image[..., :3])
        variances.append(image[..., -3:] * session.iterations)
    mean = np.mean(images, axis=0)
    maps = [relative_variance(variance, mean) for variance in variances]
    singles = [number for number, method in enumerate(options.integrators) if method.plugin == "bdpm"]
    best = best_single([maps[number] for number in singles])
    number_of_best = next(number for number in singles if maps[number] is best)
    rows: list[Row] = []
    for method, mine, spent in zip(options.integrators, maps, seconds):
        ratio = trimmed_mean(mine) / trimmed_mean(best)
        rows.append({
            "scene": opened.name,
            "N_B": camera_paths,
            "method": method.label,
            "relative variance": trimmed_mean(mine),
            "ratio to best single": ratio,
            "untrimmed ratio": float(mine.mean() / best.mean()),
            "time ratio": spent / seconds[number_of_best],
            "equal-time ratio": ratio * spent / seconds[number_of_best],
            "blocks worse": share_worse(mine, best),
        })
    draw(options.out / f"variance_{opened.name}_{camera_paths}.png", [m.label for m in options.integrators], images, maps, rows)
    return rows


def summarise(rows: list[Row], camera_paths: int) -> None:
    """Geometric means over the scenes."""
    table = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        table.append({"method": method, **{
            name: float(np.exp(np.mean([np.log(row[name]) for row in mine])))
            for name in ("ratio to best single", "equal-time ratio")},
            "worst scene": max(row["ratio to best single"] for row in mine)})
    show(f"Geometric means over the scenes, N_B = {camera_paths}", table)


def draw(path: Path, labels: list[str], images, maps, rows: list[Row]) -> None:
    """Pictures above, variance maps on one logarithmic scale below."""
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = maps[0].shape
    figure, axes = plt.subplots(2, len(maps), figsize=(2.6 * len(maps) + 0.6, 5.2 * height / width + 1.1), squeeze=False,
                                layout="constrained")
    logs = [np.log10(np.maximum(m, 1e-9)) for m in maps]
    low, high = np.percentile(np.concatenate([m.ravel() for m in logs]), [1, 99.5])
    white = np.quantile(images[0], 0.98)
    for column, (label, image, log, row) in enumerate(zip(labels, images, logs, rows)):
        axes[0, column].imshow(np.clip(image / white, 0, 1) ** (1 / 2.2))
        axes[0, column].set_title(label.replace(":", "\n"), fontsize=9)
        shown = axes[1, column].imshow(log, vmin=low, vmax=high, cmap="magma")
        axes[1, column].set_title(f"{row['ratio to best single']:.2f} x best single", fontsize=9)
    for axis in axes.flat:
        axis.set_axis_off()
    figure.colorbar(shown, ax=axes.ravel().tolist(), label="log10 relative variance", shrink=0.6, pad=0.01)
    figure.savefig(path, dpi=110)
    plt.close(figure)
