"""What halving and doubling each tuned constant does to the error at equal time, on scenes that it
was not tuned on."""

from __future__ import annotations

import argparse
import ast
import json
import time
from collections.abc import Mapping
from pathlib import Path

from mis_integrators.analysis.metrics import References, errors
from mis_integrators.app import loading

import drjit as dr
import numpy as np

from common.methods import Method, SessionMaker, parse_method
from common.references import find_references
from common.rows import console
from common.scene_files import OpenScene, open_scene
from common.tuned import Constant, changed, tuned_constants
from common.turns import Contender
from report import constants as report

METHODS = {
    "mis.optimal": "bdpm_opt3",
    "mis.optimal.TRUSTED_PHOTONS": "bdpm_opt3:weights=full",
    "mis.neighbour_radiance": "bdpm_opt3:weights=full",
    "photons.irradiance_cache": "bdpm_opt3",
    "integrators.bdpm_opt": "bdpm_opt3",
    "mis.resampling": "bdpt_ris:light_paths=50",
    "resampling": "bdpt_ris",
    "integrators.resampled": "bdpt_ris",
    "integrators.choice": "bdpm_auto",
    "integrators.vcm": "vcm",
}
"""What judges a constant, or those of a module or of a folder; others are judged by `USUAL`."""
USUAL = "bdpm:bdd=0"
OF_SEVERAL_VIEWS = "volume."
"""Modules that none of these scenes needs."""
SEEN_BY_ENVIRONMENTS = ("lights.environment_guide", "lights.portals")
"""Modules of no use where no light comes from infinitely far away."""


def method_of(key: str) -> Method:
    """The method that judges the constant of this key."""
    module = key.rpartition(".")[0]
    places = key, module, module.partition(".")[0]
    return parse_method(next((METHODS[place] for place in places if place in METHODS), USUAL))


def variants(constant: Constant) -> dict[str, object]:
    """What is tried instead of its value, by the heading of the table's column."""
    tried = {"halved": constant.halved(), "doubled": constant.doubled()}
    return {name: value for name, value in tried.items() if value is not None}


PAGE = Path(__file__).resolve().parents[2] / "docs" / "constants.md"
FIGURES = PAGE.with_suffix(".json")
NOTES = "## What went"
"""What the page's last part begins with, which is written by hand."""


def page() -> str:
    """The text of the page of constants, from the code and the figures kept beside the page."""
    notes = NOTES + PAGE.read_text().partition(NOTES)[2]
    return report.page(tuned_constants(), json.loads(FIGURES.read_text()), notes)


def run(options: argparse.Namespace) -> None:
    """The sub-command ``constants``: adds what it finds to a file, after each constant."""
    if options.page:
        PAGE.write_text(page())
        return
    if not options.scenes:
        raise SystemExit("constants: name scenes that they were not tuned on: --scenes FILE.xml")
    if options.change and options.file == FIGURES:
        raise SystemExit("constants: --change needs a --file of its own: the table has no such row")
    if options.processor_time:
        time.perf_counter = time.process_time
    experiments = wanted(options)
    found = json.loads(options.file.read_text()) if options.file.exists() else {}
    for path in options.scenes:
        opened = open_at_width(path, options.width)
        references = find_references(opened, options, console.log)
        renders: dict[tuple, tuple[float, float]] = {}
        for key, name, method, values in experiments:
            if not _concerns(key, opened):
                continue
            ratios = []
            for seed in range(options.seeds):
                plain = (method.label, seed)
                try:
                    if plain not in renders:
                        renders[plain] = judge(opened, method, references, options.time, seed, {})
                    new = judge(opened, method, references, options.time, seed, values)
                except loading.SCENE_ERRORS as error:
                    console.log(f"{opened.name}, {method.label}: {loading.one_line(error)}")
                    break
                ratios.append([new[i] / renders[plain][i] for i in range(2)])
            if ratios:
                place = found.setdefault(key, {}).setdefault(name, {})
                place[opened.name] = [float(x) for x in np.exp(np.mean(np.log(ratios), axis=0))]
                console.log(f"{opened.name}: {key} {name}: {place[opened.name]}")
            options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")


def wanted(options: argparse.Namespace) -> list[tuple[str, str, Method, dict[str, object]]]:
    """``(key, name of the variant, method, changed values)`` of each experiment."""
    if options.change:
        values = dict(_assignment(text) for text in options.change)
        method = options.method or method_of(next(iter(values)))
        return [(" ".join(options.change), "changed", method, values)]
    return [
        (constant.key, name, options.method or method_of(constant.key), {constant.key: value})
        for constant in tuned_constants()
        if not constant.key.startswith(OF_SEVERAL_VIEWS)
        if not options.only or any(part in constant.key for part in options.only)
        for name, value in variants(constant).items()
    ]


def _assignment(text: str) -> tuple[str, object]:
    key, _, value = text.partition("=")
    return key, ast.literal_eval(value)


def _concerns(key: str, opened: OpenScene) -> bool:
    if not key.startswith(SEEN_BY_ENVIRONMENTS):
        return True
    return any(emitter.is_environment() for emitter in opened.scene.emitters())


def open_at_width(path: Path, width: int) -> OpenScene:
    """The scene with a film of that width and of its own shape."""
    own = open_scene(path).size
    return open_scene(path, (width, max(round(width * own[1] / own[0]), 1)))


def judge(
    opened: OpenScene,
    method: Method,
    references: References,
    seconds: float,
    seed: int,
    values: Mapping[str, object],
) -> tuple[float, float]:
    """Relative squared error of a render of so many seconds with the constants changed: trimmed,
    and not. What kernels take to compile is not counted."""
    with changed(values), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        maker = SessionMaker(method, opened, seconds, warm_up=False)
        for _ in range(2):  # the first compiles; the second does what time for that kept it from
            throw_away = maker.make(seed=2**31)
            throw_away.iterate()
            throw_away.iterate()
        contender = Contender.begin(method.label, maker.make, seed)
        while contender.wants(seconds):
            contender.iterate()
        contender.take_snapshot()
    # The last iteration seldom ends when the time is over: noise falls with the time.
    late = contender.rendering / seconds
    found = errors(contender.snapshots[-1].image, references)
    return max(found.relmse_trimmed, 1e-12) * late, max(found.relmse, 1e-12) * late
