"""Sweeps in which methods fail: error against one parameter of a small scene or of the methods,
where each breaks, which to choose."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from mis_integrators.analysis.metrics import References
from mis_integrators.analysis.stability import breaks, choose, judge
from mis_integrators.app import loading

import mitsuba as mi

from common.methods import Method, SessionMaker, parse_method
from common.references import colours, find_references
from common.rows import Row, console, save, show, tell
from common.scene_files import OpenScene
from common.swept import Points, Swept
from common.turns import Contender, take_turns
from experiments.sweeps import SWEEPS, Sweep
from report import sections
from report.page import Page
from report.tables import as_markdown


def run(options: argparse.Namespace) -> None:
    """The sub-command ``stability``."""
    page = Page("Stability", options.out / "stability.html")
    results, choices = sweep_all(options)
    page.add(sections.stability(results, choices, page.folder, options.integrators))
    page.write()
    console.print(f"page: {page.path}")


def sweep_all(options: argparse.Namespace) -> tuple[list[Swept], list[Row]]:
    """All sweeps that the options name, and which method to choose where; tables, CSV and JSON on
    the way."""
    rows: list[Row] = []
    choices: list[Row] = []
    results = []
    for sweep in SWEEPS:
        if sweep.name in options.sweeps:
            points = measure_sweep(sweep, sweep.methods(options.integrators), options)
            results.append(Swept(sweep.name, sweep.what, points))
            rows += point_rows(sweep, points)
            choices += choice_rows(sweep, points)
            save(options.out, "stability", rows, vars(options))
            save(options.out, "choices", choices, vars(options))
    show("Which method where", choices)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "which_method.md").write_text(as_markdown(choices))
    return results, choices


def measure_sweep(sweep: Sweep, methods: Sequence[Method], options: argparse.Namespace) -> Points:
    """Errors of all methods that the sweep concerns, `point_time` seconds of rendering each after a
    first iteration that is free (pilots, recording: this is about what a method can do, not about
    how soon it starts)."""
    seconds = options.point_time
    values = sweep.scenes(options.coarse)
    points: Points = {}
    opened = None
    for value, change in values:
        if opened is None or change:
            opened = sweep.scene(options.size, **change)
            references = sweep_references(sweep, opened, options)
        contenders = []
        for method in methods:
            tried = _with_value(method, sweep, value)
            if tried is None:
                continue
            tell(f"{sweep.name} = {value:g}: compiling {method.label}")
            try:
                contender = Contender.begin(
                    method.label, SessionMaker(tried, opened, seconds, warm_up=False).make, seed=7
                )
                contender.session.iterate()
            except loading.SCENE_ERRORS as error:
                console.print(
                    f"{sweep.name} = {value:g}: {method.label} left out: {loading.one_line(error)}"
                )
                continue
            contender.setting_up = 0.0
            contenders.append(contender)
        at = f"{sweep.name} = {value:g}"
        take_turns(contenders, seconds, lambda text, at=at: tell(f"{at}: {text}"))
        for contender in contenders:
            points.setdefault(contender.label, []).append(
                judge(value, colours(contender.session), references)
            )
    return {label: found for label, found in points.items() if len(found) == len(values)}


def _with_value(method: Method, sweep: Sweep, value: float) -> Method | None:
    """The method at a value of the sweep; ``None`` if the sweep is about a parameter that its
    plugin does not know."""
    if not sweep.of_method:
        return method
    changed = Method(method.label, method.plugin, {**method.parameters, sweep.parameter: value})
    return changed if knows(method.plugin, sweep.parameter, value) else None


def knows(plugin: str, parameter: str, value: float) -> bool:
    """Whether a plugin has a parameter."""
    try:
        mi.load_dict({"type": plugin, parameter: value})
    except loading.SCENE_ERRORS:
        return False
    return True


def sweep_references(sweep: Sweep, opened: OpenScene, options: argparse.Namespace) -> References:
    """Two halves by the sweep's reference method, kept like those of scenes."""
    how = argparse.Namespace(
        references=options.references,
        reference_time=options.room_reference_time,
        reference_method=parse_method(sweep.reference),
    )
    return find_references(opened, how, tell)


def prepare(options: argparse.Namespace) -> None:
    """Make the references of all sweeps that the options name, where they are missing."""
    for sweep in SWEEPS:
        if sweep.name in options.sweeps:
            for _, change in sweep.scenes(options.coarse):
                sweep_references(sweep, sweep.scene(options.size, **change), options)


def point_rows(sweep: Sweep, points: Points) -> list[Row]:
    """One row a method and value."""
    return [
        {
            "sweep": sweep.name,
            "value": point.value,
            "method": label,
            "relMSE trimmed": point.error,
            "mean deviation": point.deviation,
            "deviation error": point.deviation_error,
            "mean is off": point.mean_is_off,
            "breaks": broken,
        }
        for label, mine in points.items()
        for point, broken in zip(mine, breaks(mine))
    ]


def choice_rows(sweep: Sweep, points: Points) -> list[Row]:
    """One row a range of values with the same best method."""
    return (
        [
            {
                "parameter": sweep.what,
                "from": choice.low,
                "to": choice.high,
                "best": choice.best,
                "about as good": ", ".join(choice.close) or "-",
                "breaks": ", ".join(choice.broken) or "-",
            }
            for choice in choose(points)
        ]
        if points
        else []
    )
