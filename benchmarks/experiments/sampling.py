"""How fast the noise of images falls with iterations: independent numbers against low-discrepancy
ones, at the same radius. Variances are over renders of different seeds, pixel by pixel."""

from __future__ import annotations

import argparse

from mis_integrators.analysis.confidence import log_slope
from mis_integrators.analysis.metrics import trimmed_mean
from mis_integrators.analysis.variance_maps import relative_variance
from mis_integrators.integrators.common import SAMPLERS

import numpy as np

from common.methods import Method
from common.references import colours
from common.rows import Row, save, show, tell
from common.scene_files import OpenScene, bundled, merge_radius, open_scene
from report.figures import draw_convergence_of_samplers

CHOSEN = ("caustics", "cornell_area", "cornell_glossy", "corridor")
"""Bundled scenes: light that only photons bring, and rooms of more and more glossy surfaces."""
COLUMNS = (
    "scene",
    "method",
    "sampler",
    "iterations",
    "variance",
    "relative variance",
    "relative variance trimmed",
)


def default_scenes() -> list:
    """The bundled scenes that are measured unless said otherwise."""
    return [path for path in bundled() if path.stem in CHOSEN]


def run(options: argparse.Namespace) -> None:
    """The sub-command ``sampling``."""
    rows: list[Row] = []
    slopes: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, (options.size, options.size))
        for method in options.integrators:
            found = converge(opened, method, options)
            rows += found
            slopes += fit(found)
        show(f"{opened.name}: variance of images", rows, COLUMNS)
        save(options.out, "sampling", rows, vars(options))
        save(options.out, "sampling_slopes", slopes, vars(options))
    show("Variance is proportional to iterations to the power of the slope", slopes)
    draw_convergence_of_samplers(options.out / "sampling.png", rows)


def converge(opened: OpenScene, method: Method, options: argparse.Namespace) -> list[Row]:
    """A row for each sampler and power of two of iterations, up to those of the options."""
    seeds, given = options.seeds, {}
    if method.plugin.startswith("bdpm"):
        given["initial_radius"] = merge_radius(opened, options)
    rows: list[Row] = []
    for sampler in SAMPLERS:
        used = Method(
            method.label, method.plugin, {**given, **method.parameters, "sampler": sampler}
        )
        images: dict[int, list[np.ndarray]] = {}
        for seed in range(seeds):
            tell(f"{opened.name}: {method.label}, {sampler}, seed {seed + 1} of {seeds}")
            session = used.integrator(opened).session(opened.scene, opened.sensor, seed=seed)
            for done in range(1, options.iterations + 1):
                session.iterate()
                if done & (done - 1) == 0:
                    images.setdefault(done, []).append(colours(session))
        mean = np.mean(images[max(images)], axis=0)
        for done, found in images.items():
            rows.append(
                {
                    "scene": opened.name,
                    "method": method.label,
                    "sampler": sampler,
                    "iterations": done,
                    **_figures(np.var(found, axis=0, ddof=1), mean),
                }
            )
    return rows


def _figures(variance: np.ndarray, mean: np.ndarray) -> dict[str, float]:
    relative = relative_variance(variance, mean)
    return {
        "variance": float(variance.mean()),
        "relative variance": float(relative.mean()),
        "relative variance trimmed": trimmed_mean(relative),
    }


def fit(rows: list[Row]) -> list[Row]:
    """The exponents of iterations in the variances of one method, a row for each sampler."""
    return [
        {
            "scene": mine[0]["scene"],
            "method": mine[0]["method"],
            "sampler": sampler,
            **{
                name: log_slope([row["iterations"] for row in mine], [row[name] for row in mine])
                for name in ("variance", "relative variance", "relative variance trimmed")
            },
        }
        for sampler in SAMPLERS
        if (mine := [row for row in rows if row["sampler"] == sampler])
    ]
