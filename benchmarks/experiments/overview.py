"""Everything on one page: pictures and errors after equal time, convergence, variance maps, many
views, stability; within a given time."""

from __future__ import annotations

import argparse
import time

from common.rows import Row, console, save, show
from common.scene_files import open_scene, scaled_size
from common.winners import winners
from experiments import compare, converge, resampling, stability, variance, view_counts
from experiments.sweeps import SWEEPS
from report import sections
from report.page import Page
from report.tables import as_markdown

COMPILING_SECONDS = 2.5
"""Rough guess of what kernels and set-up cost for a method and scene on an idle machine; only the
plan depends on it."""
SHORTEST = 1.5
"""Least rendering seconds of a method, whatever the plan."""
VARIANCE_SECONDS = 12.0
"""Rough guess for the variance maps of a scene."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``page``."""
    start = time.perf_counter()
    options.time = options.time or planned_time(options)
    expected = overhead(options) + rendering(options, options.time)
    console.print(
        f"{len(options.scenes)} scenes, {len(options.integrators)} methods, "
        f"{options.seeds} seeds, {options.time:.1f} s each: "
        f"about {expected / 60:.0f} minutes, references not counted",
        highlight=False,
    )
    console.print(
        f"(rendering {rendering(options, options.time) / 60:.0f}, "
        f"compiling, variance maps and sweeps {overhead(options) / 60:.0f})"
    )

    rows: list[Row] = []
    failures: dict[str, dict[str, str]] = {}
    page = Page("Speed against accuracy", options.out / "index.html")
    scenes: list[str] = []
    points: list[Row] = []
    slopes: list[Row] = []
    varied: list[Row] = []
    for path in options.scenes:
        measurement = compare.measure_scene(
            path, options, converge.marks(options.time, options.snapshots)
        )
        name = measurement.opened.name
        found = compare.compare(measurement)
        compare.show_comparison(found, measurement, options)
        curve = converge.converge(measurement)
        fitted = converge.fit_slopes(measurement, curve)
        rows, points, slopes, failures[name] = (
            rows + found,
            points + curve,
            slopes + fitted,
            measurement.failures,
        )
        small = open_scene(path, scaled_size(path, options.variance_scale))
        maps = argparse.Namespace(
            **{**vars(options), "integrators": options.varied, "one_weight": False}
        )
        varied += variance.compare(small, 1, maps)
        for kind, kept in (
            ("compare", rows),
            ("converge", points),
            ("slopes", slopes),
            ("variance", varied),
        ):
            save(options.out, kind, kept, vars(options))
        scenes.append(
            f'<h2 id="{name}">{name}</h2>'
            + sections.pictures(measurement, found, options.out)
            + sections.convergence(measurement, curve, fitted, options.out)
            + sections.variance(name, variance.picture_of(small, 1, options))
        )
        write(page, rows, failures, scenes, "", options)
    show("Variance of one iteration, best single strategy = 1", varied, variance.COLUMNS)
    sweeps = ""
    if options.sweeps:
        results, choices = stability.sweep_all(options)
        sweeps = sections.stability(results, choices, options.out, options.integrators)
    if options.view_scenes:
        sweeps = view_counts.section(options, options.out) + sweeps
    sweeps += resampling.section(options.resampled, options) if options.resampled else ""
    best = winners(rows)
    write(page, rows, failures, scenes, sections.choices(best) + sweeps, options)
    (options.out / "which_scene.md").write_text(as_markdown(best))
    console.print(f"page: {page.path} after {(time.perf_counter() - start) / 60:.1f} minutes")


def write(
    page: Page,
    rows: list[Row],
    failures: dict[str, dict[str, str]],
    scenes: list[str],
    sweeps: str,
    options: argparse.Namespace,
) -> None:
    """The page as far as it has come."""
    much = (
        f"at {options.spp} samples per pixel"
        if options.spp
        else f"after {options.time:.1f} s of rendering"
    )
    parts = [
        (part, name)
        for part, name in (
            ("views", "many views"),
            ("stability", "stability"),
            ("resampling", "resampling"),
        )
        if f'id="{part}"' in sweeps
    ]
    links = "".join(f'<a href="#{part}">{name}</a>' for part, name in parts)
    page.sections = [
        sections.summary(rows, failures, f"{much}, {options.seeds} seeds"),
        sections.denoised(rows),
        f"<nav>{links}</nav>",
        *scenes,
        sweeps,
    ]
    page.write()


def rendering(options: argparse.Namespace, seconds: float) -> float:
    """Seconds of the scenes' renders."""
    return len(options.scenes) * len(options.integrators) * options.seeds * seconds


def overhead(options: argparse.Namespace) -> float:
    """Seconds of everything else: compiling, variance maps, sweeps."""
    scenes = len(options.scenes) * (len(options.integrators) * COMPILING_SECONDS + VARIANCE_SECONDS)
    values = [
        (sweep, len(sweep.methods(options.integrators)) * len(sweep.scenes(options.coarse)))
        for sweep in SWEEPS
        if sweep.name in options.sweeps
    ]
    points = sum(count for _, count in values) * options.point_time
    compiling = (
        sum((0.3 if sweep.of_method else 1.0) * count for sweep, count in values)
        * 0.5
        * COMPILING_SECONDS
    )
    views = sum(
        options.view_seeds * options.view_time * max(count, view_counts.FEW) + COMPILING_SECONDS
        for count in options.view_counts
    )
    drawn = sum(
        len(sweep.chosen(options.coarse))
        for sweep in resampling.SWEEPS
        if sweep.name in options.parameters
    )
    resampled = (
        len(options.resampled)
        * drawn
        * len(resampling.METHODS)
        * (options.draw_seeds * options.draw_time + COMPILING_SECONDS)
    )
    return (
        scenes
        + points
        + compiling
        + resampled
        + len(options.view_scenes) * (1 + len(options.view_weights)) * views
    )


def planned_time(options: argparse.Namespace) -> float:
    """Rendering seconds of each method and seed that fit into the minutes asked for."""
    left = 60 * options.minutes - overhead(options)
    return max(SHORTEST, left / rendering(options, 1.0))
