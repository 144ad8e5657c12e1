"""Pictures that sub-commands leave as PNG: variance maps, charts of weights, shifted densities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mis_integrators.analysis import charts
from mis_integrators.volume.shifts import SHIFTS, Sections, majorant_at, optical_depth

import numpy as np


def draw_variance_maps(
    path: Path, labels: Sequence[str], images: Sequence, maps: Sequence, ratios: Sequence[float]
) -> None:
    """The methods' pictures, their maps of relative variance below, and its ratio to that of the
    best single strategy."""
    notes = [f"{ratio:.2f} x best single" for ratio in ratios]
    charts.save(charts.variance_maps(list(labels), images, maps, notes), path)


def draw_by_share(path: Path, curves: Mapping[str, list[tuple[float, float]]]) -> None:
    """Variances of estimators against the share of the weights that other views bring."""
    charts.save(charts.by_share(curves), path)


def draw_convergence_of_samplers(path: Path, rows: Sequence[Mapping]) -> None:
    """Variances of images against iterations: rows as of `experiments.sampling`."""
    charts.save(charts.convergence_of_samplers(rows), path)


def draw_mape_over_time(path: Path, rows: Sequence[Mapping]) -> None:
    """MAPE of several methods against rendering seconds: rows as of
    `experiments.published.over_time`."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4.5))
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        axis.loglog(
            [row["seconds"] for row in mine], [row["MAPE"] for row in mine], "o-", label=method
        )
    axis.set(xlabel="rendering time [s]", ylabel="MAPE", title=rows[0]["scene"])
    axis.legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_densities(path: Path) -> None:
    """Figure 3 of the paper: densities of interactions shifted from a segment on [0, 9] to one on
    [0, 3], next to the target's own: tentative, null and real."""
    import matplotlib.pyplot as plt

    target = Sections([0.0], [3.0], [2.0])

    def real(t):  # extinction on the target
        return 1.0 + 0.8 * np.sin(2.5 * t)

    grid = np.linspace(1e-4, 3 - 1e-4, 600)
    own = 2.0 * np.exp(-optical_depth(target, grid))
    rng = np.random.default_rng(0)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), sharey=True)
    for axis, majorant in zip(axes, (0.2, 0.7, 2.0)):
        base = Sections([0.0, 4.5], [4.5, 9.0], [majorant * 1.5, majorant * 0.5])
        axis.plot(grid, own, "k", label="tentative")
        axis.plot(grid, own * (1 - real(grid) / 2), "k--", label="null")
        axis.plot(grid, own * real(grid) / 2, "k:", label="real")
        for name in ("raw_depth", "majorant_optical_depth", "primary_sample"):
            # Density of one interaction at t' if the base places the first one: p(t) / |S'|, p the
            # free flight of the base.
            t = np.sort(rng.uniform(0, 9, 4000))
            shifted = SHIFTS[name](base, target, t)
            density = majorant_at(base, t) * np.exp(-optical_depth(base, t)) / shifted.jacobian
            axis.plot(shifted.t, density, label=name.replace("_", " "))
        axis.set(
            title=f"base majorant {1.5 * majorant:.2g}, then {0.5 * majorant:.2g} [1/m]",
            xlabel="t' [m]",
            ylim=(0, 2.6),
        )
    axes[0].set_ylabel("density [1/m]")
    axes[-1].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)
