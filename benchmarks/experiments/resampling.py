"""Does resampling pay: light sub-paths M, draws N, cache points N_c and the target distribution,
beside `bdpt`, at equal time. With `--published` the papers' own weights, and their experiments."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from mis_integrators.analysis.confidence import ratio_interval
from mis_integrators.analysis.metrics import References, errors
from mis_integrators.app import loading

import numpy as np

from common.methods import Method, SessionMaker, parse_method
from common.references import colours, find_references
from common.rows import Row, console, save, show, tell
from common.scene_files import OpenScene, open_scene, scaled_size
from common.turns import Contender, take_turns
from experiments import published
from experiments.sweeps import Sweep
from report import sections
from report.page import Page

SWEEPS = (
    Sweep("light_paths", "light_paths", (50, 100, 200, 400, 800), True, "light sub-paths, M"),
    Sweep("resamples", "resamples", (1, 2, 4, 8, 16), True, "draws of a camera vertex, N"),
    Sweep("cache_neighbors", "cache_neighbors", (1, 3, 5), True, "cache points mixed, N_c"),
)
BASE = "bdpt"
METHODS = (BASE, "pcbpt", "bdpt_ris", "bdpt_ris:target=f_y_f_yz")
"""What is compared: ratios are to the first, which has none of the parameters."""
MEASURES = {
    "MAPE ratio": "MAPE, equal time",
    "noise ratio": "noise of an iteration",
    "cost ratio": "cost of an iteration",
}
"""What is drawn: column of the table, and title of the chart."""
COLUMNS = ("sweep", "value", "method", "iterations", *MEASURES, "relMSE ratio")


def run(options: argparse.Namespace) -> None:
    """The sub-command ``resampling``."""
    page = Page("Resampled connections", options.out / "resampling.html")
    methods = published.METHODS if options.published else METHODS
    if options.published:
        for path in options.scenes:
            opened = open_scene(path, scaled_size(path, options.resampling_scale))
            published.run_scene(opened, find_references(opened, options, tell), options)
    if options.parameters:
        page.add(section(options.scenes, options, methods))
    page.write()
    console.print(f"page: {page.path}")


def section(
    scenes: list[Path], options: argparse.Namespace, methods: Sequence[str] = METHODS
) -> str:
    """The charts of all scenes; the table, CSV and JSON on the way."""
    rows: list[Row] = []
    for path in scenes:
        opened = open_scene(path, scaled_size(path, options.resampling_scale))
        found = sweep_scene(opened, find_references(opened, options, tell), options, methods)
        show(f"{opened.name}: ratios to {methods[0]}, {options.draw_time:g} s each", found, COLUMNS)
        rows += found
        save(options.out, "resampling", rows, vars(options))
    parameters = {sweep.name: sweep.what for sweep in SWEEPS}
    return sections.resampling(rows, methods, MEASURES, parameters, options.out)


def sweep_scene(
    opened: OpenScene,
    references: References,
    options: argparse.Namespace,
    methods: Sequence[str] = METHODS,
) -> list[Row]:
    """One row a sweep, value and method."""
    rows: list[Row] = []
    for sweep in SWEEPS:
        if sweep.name in options.parameters:
            for value in sweep.chosen(options.coarse):
                rows += measure_value(opened, references, sweep, value, options, methods)
    return rows


def measure_value(
    opened: OpenScene,
    references: References,
    sweep: Sweep,
    value: int,
    options: argparse.Namespace,
    labels: Sequence[str] = METHODS,
) -> list[Row]:
    """Rows of one value: every method renders `draw_time` seconds a seed, side by side; first
    iterations, with the pilots of pmfs, are free."""
    methods = [with_value(parse_method(label), sweep.parameter, value) for label in labels]
    makers = {}
    for method in methods:
        tell(f"{opened.name}: {sweep.name} = {value:g}: compiling {method.label}")
        try:
            makers[method.label] = SessionMaker(method, opened, options.draw_time)
        except loading.SCENE_ERRORS as error:
            console.print(f"{opened.name}: {method.label} left out: {loading.one_line(error)}")
    figures: dict[str, list[dict[str, float]]] = {label: [] for label in makers}
    for seed in range(options.draw_seeds):
        contenders = [Contender.begin(label, maker.make, seed) for label, maker in makers.items()]
        for contender in contenders:
            contender.session.iterate()
            contender.setting_up = 0.0
        take_turns(
            contenders,
            options.draw_time,
            lambda text: tell(f"{opened.name}: {sweep.name} = {value:g}: {text}"),
        )
        for contender in contenders:
            figures[contender.label].append(judge(contender, references))
    if labels[0] not in figures:
        return []
    return [
        row(opened, sweep, value, label, mine, figures[labels[0]])
        for label, mine in figures.items()
    ]


def with_value(method: Method, parameter: str, value: int) -> Method:
    """The method with a parameter set, under its own name; `bdpt`, which has none of them, as it
    is."""
    return (
        method
        if method.plugin == BASE
        else Method(method.label, method.plugin, {**method.parameters, parameter: int(value)})
    )


def judge(contender: Contender, references: References) -> dict[str, float]:
    """Errors and cost of one render; `noise`: what relMSE without the worst pixels would be after
    one iteration."""
    found, iterations = errors(colours(contender.session), references), contender.session.iterations
    return {
        "MAPE": found.mape,
        "relMSE": found.relmse_trimmed,
        "noise": found.relmse_trimmed * iterations,
        "iterations": iterations,
        "cost": float(np.median(contender.seconds)),
    }


def row(
    opened: OpenScene,
    sweep: Sweep,
    value: float,
    label: str,
    mine: list[dict[str, float]],
    base: list[dict[str, float]],
) -> Row:
    """Ratios to the base, with 95 % intervals over the seeds."""
    found: dict[str, str | int | float | None] = {
        "scene": opened.name,
        "sweep": sweep.name,
        "value": value,
        "method": label,
        "iterations": round(np.mean([one["iterations"] for one in mine])),
    }
    for name in ("MAPE", "relMSE", "noise", "cost"):
        ratio = ratio_interval([one[name] for one in mine], [one[name] for one in base])
        found |= {
            f"{name} ratio": ratio.value,
            f"{name} ratio low": ratio.low,
            f"{name} ratio high": ratio.high,
        }
    return found
