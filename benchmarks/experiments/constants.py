"""What halving and doubling each tuned constant does to the error at equal time, on scenes that it
was not tuned on."""

from __future__ import annotations

import argparse
import ast
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mis_integrators.analysis.metrics import References, errors
from mis_integrators.app import loading
from mis_integrators.core.session import Session

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
    "integrators.published_optimal": "bdpm_opt3",
    "mis.resampling": "bdpt_ris:light_paths=50",
    "resampling": "bdpt_ris",
    "integrators.resampled": "bdpt_ris",
    "integrators.resampled_passes": "bdpt_ris",
    "integrators.choice": "bdpm_auto",
    "integrators.media_choice": "bdpm_auto",
    "integrators.merging": "vcm",
}
"""What judges a constant, or those of a module or of a folder; others are judged by `USUAL`."""
USUAL = "bdpm:bdd=0"
BY_CLOCK = (
    "integrators.choice",
    "integrators.media_choice",
    "integrators.piloted",
    "pilot.run.PILOT_TIME_SHARE",
)
"""Constants, or those of modules, that only renders of a given time read."""
OF_SEVERAL_VIEWS = "volume."
"""Modules that none of these scenes needs."""
SEEN_BY_ENVIRONMENTS = (
    "lights.environment_guide",
    "lights.environment_sampler",
    "lights.portals",
)
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


PAGE = Path(__file__).resolve().parents[2] / "docs" / "notes" / "constants.md"
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
        for key, method, tried in experiments:
            if not _concerns(key, opened):
                continue
            judge = Judge(method, opened, references, options.time, key.startswith(BY_CLOCK))
            try:
                ratios = judge.ratios(tried, options.seeds)
            except loading.SCENE_ERRORS as error:
                console.log(f"{opened.name}, {method.label}: {loading.one_line(error)}")
                continue
            for name, ratio in ratios.items():
                found.setdefault(key, {}).setdefault(name, {})[opened.name] = ratio
                console.log(f"{opened.name}: {key} {name}: {ratio}")
            options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")


def wanted(
    options: argparse.Namespace,
) -> list[tuple[str, Method, dict[str, dict[str, object]]]]:
    """``(key, method, changed values by name of the variant)`` of each experiment."""
    if options.change:
        values = dict(_assignment(text) for text in options.change)
        method = options.method or method_of(next(iter(values)))
        return [(" ".join(options.change), method, {"changed": values})]
    return [
        (
            constant.key,
            options.method or method_of(constant.key),
            {name: {constant.key: value} for name, value in variants(constant).items()},
        )
        for constant in tuned_constants()
        if not constant.key.startswith(OF_SEVERAL_VIEWS)
        if not options.only or any(part in constant.key for part in options.only)
        if variants(constant)
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


@dataclass(frozen=True)
class Judge:
    """Compares renders with constants changed to renders without."""

    method: Method
    opened: OpenScene
    references: References
    seconds: float
    """Of a render with the usual values, about."""
    by_clock: bool
    """Whether all renders last so long; else all take as many samples as fit then, and what they
    take counts. Then both have the same random numbers, and what changes nothing shows as that."""

    def ratios(
        self, variants: Mapping[str, Mapping[str, object]], seeds: int
    ) -> dict[str, list[float]]:
        """By variant, relative squared error times time with its values over that without,
        geometric mean over the seeds: without the worst 0.1 % of the pixels, and with them. What
        kernels take to compile is not counted."""
        samples = None if self.by_clock else self._samples()
        logs: dict[str, list[np.ndarray]] = {name: [] for name in variants}
        for seed in range(seeds):
            usual = self._error_times_time(samples, seed, {})
            for name, values in variants.items():
                new = self._error_times_time(samples, seed, values)
                logs[name].append(np.log(new / usual))
        return {name: np.exp(np.mean(of_seeds, axis=0)).tolist() for name, of_seeds in logs.items()}

    def _samples(self) -> int:
        place = self.opened.name, self.method.label, self.seconds
        if place not in _SAMPLES:
            session = self._render(None, 0, {}).session
            _SAMPLES[place] = session.iterations * session.camera_paths
        return _SAMPLES[place]

    def _error_times_time(
        self, samples: int | None, seed: int, values: Mapping[str, object]
    ) -> np.ndarray:
        render = self._render(samples, seed, values)
        found = errors(render.snapshots[-1].image, self.references)
        return np.maximum([found.relmse_trimmed, found.relmse], 1e-12) * render.rendering

    def _render(self, samples: int | None, seed: int, values: Mapping[str, object]) -> Contender:
        """A render of so many samples a pixel, else by the clock; again if much of its time went
        into compiling."""
        with changed(values), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for _ in range(3):
                render = Contender.begin(self.method.label, partial(self._session, samples), seed)
                while render.wants(self.seconds, samples):
                    render.iterate()
                if render.compiling < 0.05 * render.rendering:
                    break
            render.take_snapshot()
        return render

    def _session(self, samples: int | None, seed: int) -> Session:
        if samples is None:
            return SessionMaker(self.method, self.opened, self.seconds, warm_up=False).make(seed)
        integrator = self.method.integrator(self.opened)
        return integrator.session(self.opened.scene, self.opened.sensor, seed=seed, spp=samples)


_SAMPLES: dict[tuple, int] = {}
"""Samples a pixel that a scene and a method have time for in so many seconds."""
