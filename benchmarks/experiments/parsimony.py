"""What leaving out saves: what a scene has no use for is put back, one part of a photon mapper at a
time.

Sessions of ``bdpm_opt3`` take turns, each with the merge radii that the first one has found. Their
images have the same mean: a part that is put back finds nothing to do. Processor time is measured,
not the clock's: other work on the machine disturbs it less.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from unittest import mock

from mis_integrators.core.traits import SceneTraits

import drjit as dr

from common.methods import Method
from common.rows import Row, save, show, tell
from common.scene_files import OpenScene, open_scene, scaled_size

PLUGIN = "bdpm_opt3"
ITERATIONS, SKIPPED = 12, 3
"""Of each session, and how many of them are not counted: kernels are compiled."""


def with_specular_surfaces(traits, scene, sensor) -> None:
    """There may be caustics: a second photon map, which stays empty."""
    traits.has_delta = True


def with_emission(traits, scene, sensor) -> None:
    """Camera paths may meet lamps: what they sample is traced on beyond the last vertex."""
    traits.has_light_surfaces = True


PUT_BACK: dict[str, Callable | dict[str, object]] = {
    "caustic photons": with_specular_surfaces,
    "emission met by chance": with_emission,
    "weights": {"mix_diffuse": True},
}
"""By the name of what was left out: what puts it back, into `SceneTraits` or as parameters."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``parsimony``."""
    rows: list[Row] = []
    for path in options.scenes:
        rows += measure(path, options.scale)
        save(options.out, "parsimony", rows, vars(options))
    show(
        "what leaving out saves",
        rows,
        ("scene", "left out", "iteration with it / without", "all left out"),
    )


def measure(path: Path, scale: float) -> list[Row]:
    """A row for each part that was left out, and can be put back; at least one row."""
    tell(path.stem)
    opened = open_scene(path, scaled_size(path, scale))
    plain = new_session(opened)
    plain.start()
    sessions = {"": plain}
    for part in plain.left_out:
        if part in PUT_BACK:
            sessions[part] = new_session(opened, PUT_BACK[part])
            start_like(sessions[part], plain)
    seconds: dict[str, list[float]] = {part: [] for part in sessions}
    for number in range(ITERATIONS):
        for part, session in sessions.items():
            start = time.process_time()
            dr.eval(session._iteration(number))
            dr.sync_thread()
            seconds[part].append(time.process_time() - start)
    cost = {part: median(values[SKIPPED:]) for part, values in seconds.items()}
    others = [part for part in sessions if part] or [""]
    return [
        {
            "scene": opened.name,
            "left out": part or None,
            "iteration with it / without": cost[part] / cost[""],
            "all left out": ", ".join(plain.left_out),
        }
        for part in others
    ]


def new_session(opened: OpenScene, put_back: Callable | dict[str, object] | None = None):
    """A session of the plugin, with a part put back."""
    parameters = put_back if isinstance(put_back, dict) else {}
    integrator = Method(PLUGIN, PLUGIN, parameters).integrator(opened)
    module = sys.modules["mis_integrators.integrators.bdpm"]

    def traits(scene, sensor=None):
        found = SceneTraits(scene, sensor)
        if callable(put_back):
            put_back(found, scene, sensor)
        return found

    with mock.patch.object(module, "SceneTraits", traits):
        return integrator.session(opened.scene, opened.sensor, seed=0, spp=64)


def start_like(session, other) -> None:
    """Starts a session with the merge radii and the paths for direct light of another."""
    usual = next(iter(other.radii.values()))
    kinds = session.kinds()
    session.recall(
        {
            **other.learned,
            "radii": {kind: float(other.radii.get(kind, usual)) for kind in kinds},
            "corrected": {kind: bool(other.corrected.get(kind, False)) for kind in kinds},
        }
    )
    session.start()
