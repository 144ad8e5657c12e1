"""Equal-time (or equal-sample) comparison of integrators, as ratios to `path` in the same run."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from mis_integrators.analysis.confidence import log_ratio_error, mean_interval, ratio_interval
from mis_integrators.analysis.metrics import (
    Errors,
    artefact_share,
    decompose,
    efficiency,
    errors,
    flip,
)
from mis_integrators.app import denoising

import numpy as np

from common.measuring import Measured, Measurement, measure
from common.methods import PATH_TRACERS
from common.references import find_references
from common.rows import Row, console, save, show, tell
from common.scene_files import open_scene, scaled_size
from report import regressions, sections
from report.page import Page

COLUMNS = (
    "method",
    "iterations",
    "seconds",
    "first",
    "relMSE",
    "relMSE ratio",
    "trimmed ratio",
    "MSE ratio",
    "relMSE / best path",
    "MSE / best path",
    "FLIP",
    "artefacts",
    "bias share",
    "cost ratio",
    "settings",
)


DENOISED_COLUMNS = (
    "method",
    "iterations",
    "seconds",
    "denoised relMSE",
    "denoised MSE",
    "denoised FLIP",
    "denoised artefacts",
    "relMSE, all at once",
    "denoised relMSE / best path",
    "denoised MSE / best path",
    "denoised FLIP / best path",
    "settings",
)

TO_BETTER_PATH = {
    name: f"{name} / best path"
    for name in ("relMSE", "MSE", "denoised relMSE", "denoised MSE", "denoised FLIP")
}
"""Columns of ratios to the least error of `path`, or `volpath`, under any of its samplers, by the
error's."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``compare``."""
    rows: list[Row] = []
    failures: dict[str, dict[str, str]] = {}
    pictures: list[str] = []
    page = Page("Comparison", options.out / "compare.html")
    for path in options.scenes:
        measurement = measure_scene(path, options, [])
        found = compare(measurement)
        show_comparison(found, measurement, options)
        rows += found
        save(options.out, "compare", rows, vars(options))
        name = measurement.opened.name
        failures[name] = measurement.failures
        pictures.append(
            f'<h2 id="{name}">{name}</h2>' + sections.pictures(measurement, found, options.out)
        )
        page.sections = [
            sections.summary(rows, failures, f"({measurement.asked} each, {options.seeds} seeds)"),
            sections.denoised(rows),
            *pictures,
        ]
        page.write()
    console.print(f"page: {page.path}")
    if options.record:
        regressions.record(rows, vars(options))
    if options.baseline:
        regressions.report(rows, options.baseline)


def measure_scene(path: Path, options: argparse.Namespace, marks: list[float]) -> Measurement:
    """The renders that the options ask for."""
    if options.denoise:
        denoising.require()
    opened = open_scene(path, scaled_size(path, options.scale), options.denoise)
    references = find_references(opened, options, tell)
    return measure(
        opened,
        options.integrators,
        references,
        options.time,
        options.spp,
        options.seeds,
        marks,
        tell,
    )


def show_comparison(rows: list[Row], measurement: Measurement, options: argparse.Namespace) -> None:
    """Print the table of one scene, with intervals."""
    much = f"{options.spp} samples per pixel" if options.spp else f"{options.time:g} s each"
    shown = [
        {**row, **{name: _with_interval(row, name) for name in ("relMSE ratio", "cost ratio")}}
        for row in rows
    ]
    base = measurement.base.method.label
    title = f"{measurement.opened.name}: {much}, {options.seeds} seeds, ratios to {base}"
    # Artefacts are counted beside `path`, where it is among the methods.
    show(title, shown, [name for name in COLUMNS if name in shown[0]])
    if options.denoise:
        denoised = [name for name in DENOISED_COLUMNS if name in rows[0]]
        show(f"{title}, all denoised", rows, denoised)
    for label, reason in measurement.failures.items():
        console.print(f"{label} cannot render {measurement.opened.name}: {reason}")


def compare(measurement: Measurement) -> list[Row]:
    """One row a method: mean errors over the seeds, and ratios to the base with their confidence
    intervals."""
    every = {
        measured.method.label: _figures(measured, measurement) for measured in measurement.methods
    }
    base = every[measurement.base.method.label]
    denoised = [_denoised(measured, measurement) for measured in measurement.methods]
    rows = [
        _row(measured, every[measured.method.label], base, measurement)
        | _denoised_errors(measured, pictures, measurement)
        for measured, pictures in zip(measurement.methods, denoised)
    ]
    of_path = [measured.method.plugin in PATH_TRACERS for measured in measurement.methods]
    paths = [row for row, is_path in zip(rows, of_path) if is_path]
    for name, column, images in (
        ("relMSE", "artefacts", [measured.images for measured in measurement.methods]),
        ("denoised relMSE", "denoised artefacts", denoised),
    ):
        beside = [
            (row[name], shown[0])
            for row, shown, is_path in zip(rows, images, of_path)
            if is_path and shown
        ]
        if beside:
            _, other = min(beside, key=lambda pair: pair[0])
            for row, shown in zip(rows, images):
                row[column] = artefact_share(shown[0], other, measurement.references)
    for name, column in TO_BETTER_PATH.items():
        better = min((row[name] for row in paths if name in row), default=float("nan"))
        for row in rows:
            if name in row:
                row[column] = over(row[name], better)
    return rows


def over(error: float, other: float) -> float:
    """The ratio of two errors: not a number where the other is below the noise of the
    references."""
    return error / other if other else float("nan")


def _figures(measured: Measured, measurement: Measurement) -> dict[str, list[float]]:
    """Errors and costs of each seed's render, by name."""
    judged = [errors(image, measurement.references) for image in measured.images]
    figures = {
        field.name: [getattr(error, field.name) for error in judged] for field in fields(Errors)
    }
    figures["cost"] = [run.last.seconds / run.last.samples_per_pixel for run in measured.runs]
    perceived = measured.perceived(measurement.references)
    figures["flip"] = [perceived[0]] if perceived else []
    return figures


def _denoised(measured: Measured, measurement: Measurement) -> list[np.ndarray]:
    """The denoised images, one a seed; none where they are not denoised."""
    if not measurement.opened.denoise:
        return []
    opened, pictures = measurement.opened, []
    for run in measured.runs:
        denoised, _ = denoising.denoised_picture(
            run.last.whole,
            run.last.channels,
            opened.scene,
            opened.scene.sensors()[0],
            opened.hides_emitters,
        )
        pictures.append(denoised[..., :3])
    return pictures


def _denoised_errors(
    measured: Measured, pictures: list[np.ndarray], measurement: Measurement
) -> Row:
    """Errors of the denoised images, mean over the seeds, and of the first one denoised without its
    direct light apart."""
    if not pictures:
        return {}
    opened = measurement.opened
    at_once = denoising.denoise(
        measured.images[0], opened.scene, hide_emitters=opened.hides_emitters
    )
    judged = [errors(picture, measurement.references) for picture in pictures]
    perceived = flip(pictures[0], measurement.references)
    return {
        "denoised MSE": float(np.mean([error.mse for error in judged])),
        "denoised relMSE": float(np.mean([error.relmse for error in judged])),
        "denoised relMSE trimmed": float(np.mean([error.relmse_trimmed for error in judged])),
        "relMSE, all at once": errors(at_once, measurement.references).relmse,
        "denoised FLIP": perceived[0] if perceived else float("nan"),
    }


def _row(measured: Measured, mine: dict, base: dict, measurement: Measurement) -> Row:
    opened, lasts = measurement.opened, [run.last for run in measured.runs]
    parts = decompose(measured.images, measurement.references)
    relative, cost = mean_interval(mine["relmse"]), ratio_interval(mine["cost"], base["cost"])
    error_ratio = ratio_interval(mine["relmse"], base["relmse"])
    trimmed = ratio_interval(mine["relmse_trimmed"], base["relmse_trimmed"])
    absolute = ratio_interval(mine["mape"], base["mape"])
    seconds = float(np.mean([last.seconds for last in lasts]))
    return {
        "scene": opened.name,
        "size": "{}x{}".format(*opened.size),
        "method": measured.method.label,
        "asked": measurement.asked,
        "seeds": len(lasts),
        "iterations": round(np.mean([last.iterations for last in lasts])),
        "samples_per_pixel": round(np.mean([last.samples_per_pixel for last in lasts])),
        "seconds": seconds,
        "first": float(np.mean([run.first for run in measured.runs])),
        "compiling": float(np.mean([run.compiling for run in measured.runs])),
        "warm_up": measured.warm_up,
        "MSE": float(np.mean(mine["mse"])),
        "relMSE": relative.value,
        "relMSE low": relative.low,
        "relMSE high": relative.high,
        "MSE trimmed": float(np.mean(mine["mse_trimmed"])),
        "relMSE trimmed": float(np.mean(mine["relmse_trimmed"])),
        "relMSE median of means": float(np.mean(mine["relmse_median"])),
        "MAPE": float(np.mean(mine["mape"])),
        "MAPE ratio": absolute.value,
        "MAPE ratio low": absolute.low,
        "MAPE ratio high": absolute.high,
        "MAPE by seed": " ".join(f"{value:.6g}" for value in mine["mape"]),
        "FLIP": float(np.mean(mine["flip"])) if mine["flip"] else None,
        "mean ratio": float(np.mean(mine["mean_ratio"])),
        "bias2": parts and parts.bias2,
        "variance": parts and parts.variance,
        "bias share": parts and parts.bias_share,
        "efficiency": parts and efficiency(parts.variance, seconds),
        "MSE ratio": float(np.mean(mine["mse"]) / np.mean(base["mse"])),
        "relMSE ratio": error_ratio.value,
        "relMSE ratio low": error_ratio.low,
        "relMSE ratio high": error_ratio.high,
        "relMSE ratio error": log_ratio_error(mine["relmse"], base["relmse"]),
        "trimmed ratio": trimmed.value,
        "trimmed ratio low": trimmed.low,
        "trimmed ratio high": trimmed.high,
        "trimmed ratio error": log_ratio_error(mine["relmse_trimmed"], base["relmse_trimmed"]),
        "trimmed by seed": " ".join(f"{value:.6g}" for value in mine["relmse_trimmed"]),
        "cost ratio": cost.value,
        "cost ratio low": cost.low,
        "cost ratio high": cost.high,
        "cost ratio error": log_ratio_error(mine["cost"], base["cost"]),
        "settings": chosen(measured.runs[-1].settings),
        "references": measurement.references.origin,
    }


def chosen(settings: dict) -> str:
    """What a session chose by itself: radii."""
    return " ".join(
        f"{name}={value:.3g}" if isinstance(value, float) else f"{name}={value}"
        for name, value in settings.items()
        if "." in name or name == "choice"
    )


def _with_interval(row: Row, name: str) -> str:
    if np.isnan(row[f"{name} low"]):
        return f"{row[name]:.3g}"
    return f"{row[name]:.3g} ({row[f'{name} low']:.3g} to {row[f'{name} high']:.3g})"
