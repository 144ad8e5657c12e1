"""Variance of an image times its iterations, at equal radius: numbers against the best single
strategy, and maps side by side."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable
from pathlib import Path

from mis_integrators.analysis.metrics import trimmed_mean
from mis_integrators.analysis.variance_maps import best_single, relative_variance, share_worse
from mis_integrators.app import loading

import numpy as np

from common.methods import Method
from common.rows import Row, console, save, show, tell
from common.scene_files import OpenScene, merge_radius, open_scene, scaled_size
from experiments import terms
from experiments.one_weight import one_weight
from report import sections
from report.figures import draw_variance_maps
from report.page import Page

COLUMNS = (
    "scene",
    "N_B",
    "radius",
    "method",
    "relative variance",
    "ratio to best single",
    "untrimmed ratio",
    "time ratio",
    "equal-time ratio",
    "blocks worse",
)


def run(options: argparse.Namespace) -> None:
    """The sub-command ``variance``."""
    if options.terms:
        run_terms(options)
        return
    rows: list[Row] = []
    page = Page("Variance of one iteration", options.out / "variance.html")
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        for camera_paths in options.camera_paths:
            found = compare(opened, camera_paths, options)
            show(f"{opened.name}: one iteration, N_B = {camera_paths}", found, COLUMNS)
            rows += found
            save(options.out, "variance", rows, vars(options))
            page.add(sections.variance(opened.name, picture_of(opened, camera_paths, options)))
    for camera_paths in options.camera_paths:
        summarise([row for row in rows if row["N_B"] == camera_paths], camera_paths)
    page.write()
    console.print(f"page: {page.path}")


def run_terms(options: argparse.Namespace) -> None:
    """With ``--terms``: the variance split into the terms of the noise law."""
    rows: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        for camera_paths in options.camera_paths:
            found = terms.compare(opened, camera_paths, options)
            show(f"{opened.name}: terms of the noise law", found, terms.COLUMNS)
            rows += found
            save(options.out, "terms", rows, vars(options))


def picture_of(opened: OpenScene, camera_paths: int, options: argparse.Namespace) -> Path:
    """Where the maps of a scene are drawn."""
    return options.out / f"variance_{opened.name}_{camera_paths}.png"


def variants(options: argparse.Namespace) -> list[tuple[Method, Callable]]:
    """The methods, each with what is to be changed while it renders: nothing; with ``--one-weight``
    those of two strategies once more, under one last weight."""
    found: list[tuple[Method, Callable]] = []
    for method in options.integrators:
        found.append((method, contextlib.nullcontext))
        published = method.parameters.get("weights") == "published"
        if options.one_weight and method.plugin == "bdpm_opt2" and not published:
            label = f"{method.label} (one weight)"
            found.append((Method(label, method.plugin, method.parameters), one_weight))
    return found


def compare(opened: OpenScene, camera_paths: int, options: argparse.Namespace) -> list[Row]:
    """A row a method; pictures and maps go to a PNG. Ratios are to the best of the pure strategies
    (`bdpm`), or of all if there is none. Methods take turns, so that what else the machine does
    delays all of them; the time of an iteration is the median.

    Methods whose plugin has no merge radius or no channel of variances, and those that cannot
    render the scene, are left out.
    """
    radius = merge_radius(opened, options)
    common = {"initial_radius": radius, "camera_paths": camera_paths, "variance": True}
    methods, changes, sessions = [], [], []
    for method, changed in variants(options):
        with changed():
            try:
                integrator = Method(
                    method.label, method.plugin, {**common, **method.parameters}
                ).integrator(opened)
                session = integrator.session(opened.scene, opened.sensor, seed=1)
                session.iterate()
            except loading.SCENE_ERRORS as error:
                console.print(f"{opened.name}: {method.label} left out: {loading.one_line(error)}")
                continue
            session.iterate()
        methods.append(method)
        changes.append(changed)
        sessions.append(session)
    if not methods:
        raise SystemExit(f"{opened.name}: no method's variance can be measured")
    times = np.zeros((options.iterations, len(methods)))
    for number in range(options.iterations):
        for column, (changed, session) in enumerate(zip(changes, sessions)):
            with changed():
                start = time.perf_counter()
                session.iterate()
                times[number, column] = time.perf_counter() - start
            tell(f"{opened.name}: {methods[column].label} {number + 1}")
    seconds = np.median(times, axis=0)
    rendered = [session.image() for session in sessions]
    images = [image[..., :3] for image in rendered]
    variances = [image[..., -3:] * session.iterations for image, session in zip(rendered, sessions)]
    mean = np.mean(images, axis=0)
    maps = [relative_variance(variance, mean) for variance in variances]
    singles = [number for number, method in enumerate(methods) if method.plugin == "bdpm"] or list(
        range(len(methods))
    )
    best = best_single([maps[number] for number in singles])
    number_of_best = next(number for number in singles if maps[number] is best)
    rows: list[Row] = []
    for method, mine, spent in zip(methods, maps, seconds):
        ratio = trimmed_mean(mine) / trimmed_mean(best)
        rows.append(
            {
                "scene": opened.name,
                "N_B": camera_paths,
                "radius": radius,
                "method": method.label,
                "relative variance": trimmed_mean(mine),
                "ratio to best single": ratio,
                "untrimmed ratio": float(mine.mean() / best.mean()),
                "time ratio": spent / seconds[number_of_best],
                "equal-time ratio": ratio * spent / seconds[number_of_best],
                "blocks worse": share_worse(mine, best),
            }
        )
    draw_variance_maps(
        picture_of(opened, camera_paths, options),
        [method.label for method in methods],
        images,
        maps,
        [row["ratio to best single"] for row in rows],
    )
    return rows


def summarise(rows: list[Row], camera_paths: int) -> None:
    """Geometric means over the scenes."""
    table = []
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        table.append(
            {
                "method": method,
                **{
                    name: float(np.exp(np.mean([np.log(row[name]) for row in mine])))
                    for name in ("ratio to best single", "equal-time ratio")
                },
                "worst scene": max(row["ratio to best single"] for row in mine),
            }
        )
    show(f"Geometric means over the scenes, N_B = {camera_paths}", table)
