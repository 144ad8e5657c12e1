"""Error against time: snapshots of one run at increasing times, slopes on logarithmic axes, and the
front of speed and accuracy."""

from __future__ import annotations

import argparse

from mis_integrators.analysis.confidence import mean_interval, slope_interval
from mis_integrators.analysis.fronts import pareto_front
from mis_integrators.analysis.metrics import decompose, errors

import numpy as np

from common.measuring import Measured, Measurement
from common.rows import Row, console, save, show
from experiments.compare import measure_scene
from report import sections
from report.page import Page

COLUMNS = (
    "method",
    "slope",
    "slope low",
    "slope high",
    "slope trimmed",
    "relMSE at the end",
    "on the front",
)


def run(options: argparse.Namespace) -> None:
    """The sub-command ``converge``."""
    points: list[Row] = []
    slopes: list[Row] = []
    page = Page("Error against time", options.out / "converge.html")
    for path in options.scenes:
        measurement = measure_scene(path, options, marks(options.time, options.snapshots))
        found = converge(measurement)
        fitted = fit_slopes(measurement, found)
        name = measurement.opened.name
        title = f"{name}: relMSE is proportional to samples, i.e. time without set-up, to the power"
        show(f"{title} of the slope", fitted, COLUMNS)
        points, slopes = points + found, slopes + fitted
        save(options.out, "converge", points, vars(options))
        save(options.out, "slopes", slopes, vars(options))
        page.add(sections.convergence(measurement, found, fitted, page.folder))
    page.write()
    console.print(f"page: {page.path}")


def marks(seconds: float, count: int) -> list[float]:
    """Times of the snapshots before the last: each half the next."""
    return [seconds / 2**power for power in range(count - 1, 0, -1)]


def converge(measurement: Measurement) -> list[Row]:
    """One row a method and snapshot: mean error over the seeds with its interval, bias and variance
    apart."""
    rows: list[Row] = []
    for measured in measurement.methods:
        for number in range(measured.common_snapshots):
            rows.append(_row(measured, number, measurement))
    front = pareto_front([row["seconds"] for row in rows], [row["relMSE trimmed"] for row in rows])
    for row, on_front in zip(rows, front):
        row["on the front"] = on_front
    return rows


def _row(measured: Measured, number: int, measurement: Measurement) -> Row:
    snapshots = measured.at(number)
    judged = [errors(snapshot.image, measurement.references) for snapshot in snapshots]
    relative = mean_interval([error.relmse for error in judged])
    parts = decompose([snapshot.image for snapshot in snapshots], measurement.references)
    return {
        "scene": measurement.opened.name,
        "method": measured.method.label,
        "seconds": float(np.mean([snapshot.seconds for snapshot in snapshots])),
        "samples_per_pixel": float(np.mean([snapshot.samples_per_pixel for snapshot in snapshots])),
        "relMSE": relative.value,
        "relMSE low": relative.low,
        "relMSE high": relative.high,
        "relMSE trimmed": float(np.mean([error.relmse_trimmed for error in judged])),
        "bias2": parts and parts.bias2,
        "variance": parts and parts.variance,
    }


def fit_slopes(measurement: Measurement, rows: list[Row]) -> list[Row]:
    """One row a method: the exponent of the rendering in its error, one fit a seed, with the
    interval of their mean.

    The fit is against samples per pixel, that is time without what goes before the first iteration:
    a pilot would otherwise pass for convergence.
    """
    fitted: list[Row] = []
    for measured in measurement.methods:
        mine = [row for row in rows if row["method"] == measured.method.label]
        slope, trimmed = (
            slope_interval([_curve(run.snapshots, name, measurement) for run in measured.runs])
            for name in ("relmse", "relmse_trimmed")
        )
        fitted.append(
            {
                "scene": measurement.opened.name,
                "method": measured.method.label,
                "slope": slope.value,
                "slope low": slope.low,
                "slope high": slope.high,
                "slope trimmed": trimmed.value,
                "slope trimmed low": trimmed.low,
                "slope trimmed high": trimmed.high,
                "relMSE at the end": mine[-1]["relMSE"],
                "on the front": any(row["on the front"] for row in mine),
            }
        )
    return fitted


def _curve(snapshots, name: str, measurement: Measurement) -> tuple[list[float], list[float]]:
    return (
        [snapshot.samples_per_pixel for snapshot in snapshots],
        [getattr(errors(snapshot.image, measurement.references), name) for snapshot in snapshots],
    )
