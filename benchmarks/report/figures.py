"""Pictures that sub-commands leave as PNG: variance maps, charts of weights, shifted densities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mis_integrators.analysis import charts
from mis_integrators.volume.shifts import SHIFTS, Sections, majorant_at, optical_depth

import numpy as np

STRETCHES = "majorant_optical_depth", "raw_depth", "primary_sample"
TARGET = Sections([0.0], [3.0], [2.0])
"""The target segment of the paper's Figure 3, on [0, 3]."""
BASE_MAJORANTS = 0.2, 0.7, 2.0
"""Mean majorants of the base segments [1/m]."""


def base_segment(majorant: float) -> Sections:
    """A base segment, on [0, 9], whose majorant falls to a third in its middle."""
    return Sections([0.0, 4.5], [4.5, 9.0], [majorant * 1.5, majorant * 0.5])


def own_densities(sections: Sections, end: float, t: np.ndarray) -> list[np.ndarray]:
    """Densities at t of the first tentative interaction on a segment of length `end`, and of its
    being null and real, for an extinction that varies below the majorant."""
    tentative = majorant_at(sections, t) * np.exp(-optical_depth(sections, t))
    real = 0.5 + 0.4 * np.sin(7.5 * t / end)  # extinction over majorant
    return [tentative, tentative * (1 - real), tentative * real]


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
        axis.plot(
            [row["seconds"] for row in mine], [row["MAPE"] for row in mine], "o-", label=method
        )
    charts.logarithmic(axis, "rendering time [s]", "MAPE")
    axis.set_title(rows[0]["scene"])
    axis.legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_densities(path: Path) -> None:
    """Figure 3 of the paper, and the supplement's: a base segment on [0, 9] whose extinction
    varies, and a target on [0, 3]. Row by row: densities on the base (tentative, null, real); those
    on the target, and those that the shifts bring there; S(t); |S'(t)|."""
    import matplotlib.pyplot as plt

    rows = ("densities on the base [1/m]", "densities on the target [1/m]", "S(t) [m]", "|S'(t)|")
    figure, axes = plt.subplots(len(rows), 3, figsize=(12, 12), sharey="row")
    for axis, name in zip(axes[:, 0], rows):
        axis.set_ylabel(name)
    for column, majorant in zip(axes.T, BASE_MAJORANTS):
        base = base_segment(majorant)
        on_base, on_target, place, derivative = column
        on_base.set_title(f"base majorant {1.5 * majorant:.2g}, then {0.5 * majorant:.2g} [1/m]")
        _draw_own_densities(on_base, base, 9.0)
        _draw_own_densities(on_target, TARGET, 3.0)
        t = np.linspace(1e-4, 9 - 1e-4, 4000)
        t = t[np.abs(t - 4.5) > 2e-3]  # at the jump of the majorant
        free_flight = own_densities(base, 9.0, t)[0]
        for name in STRETCHES:
            shifted, label = SHIFTS[name](base, TARGET, t), name.replace("_", " ")
            # Density at t' of the first interaction that the base places: p(t) / |S'|.
            on_target.plot(shifted.t, free_flight / shifted.jacobian, label=label)
            place.plot(t, shifted.t, label=label)
            derivative.plot(t, shifted.jacobian, label=label)
        on_base.set(xlabel="t [m]", ylim=(0, 2.6))
        on_target.set(xlabel="t' [m]", ylim=(0, 2.6))
        place.set(xlabel="t [m]", ylim=(0, 3.1))
        derivative.set(xlabel="t [m]", yscale="log", ylim=(1e-3, 30))
    axes[1, -1].legend(fontsize=7)
    axes[2, -1].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_own_densities(axis, sections: Sections, end: float) -> None:
    """The curves of `own_densities`."""
    t = np.linspace(1e-4, end - 1e-4, 1200)
    names = "tentative", "null", "real"
    for name, style, density in zip(names, ("k", "k--", "k:"), own_densities(sections, end, t)):
        axis.plot(t, density, style, label=name)
