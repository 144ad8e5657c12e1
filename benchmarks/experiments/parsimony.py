"""What leaving out saves: what a scene has no use for is put back, one part of a photon mapper at a
time.

Sessions of ``bdpm_opt3`` take turns, each with the merge radii that the first one has found. Their
images have the same mean: a part that is put back finds nothing to do. Processor time is measured,
not the clock's: other work on the machine disturbs it less.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from unittest import mock

from mis_integrators.core.traits import SceneTraits

from common.methods import Method
from common.rows import Row, save, show, tell
from common.scene_files import OpenScene, open_scene, scaled_size
from common.turns import processor_seconds

PLUGIN = "bdpm_opt3"
ITERATIONS, SKIPPED = 12, 3
"""Of each session, and how many of them are not counted: kernels are compiled."""


TRAITS = {"caustic photons": "has_delta", "emission met by chance": "has_light_surfaces"}
"""By the name of what was left out: what `SceneTraits` must say to put it back."""
PARAMETERS = {"weights": {"mix_diffuse": True}}
"""The same for parameters."""


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
        if part in TRAITS or part in PARAMETERS:
            sessions[part] = new_session(opened, part)
            start_like(sessions[part], plain)
    cost = processor_seconds(sessions, ITERATIONS, SKIPPED)
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


def new_session(opened: OpenScene, put_back: str = ""):
    """A session of the plugin, with a part put back."""
    integrator = Method(PLUGIN, PLUGIN, PARAMETERS.get(put_back, {})).integrator(opened)
    module = sys.modules["mis_integrators.integrators.common"]

    def traits(scene, sensor=None):
        found = SceneTraits(scene, sensor)
        if put_back in TRAITS:
            setattr(found, TRAITS[put_back], True)
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
        }
    )
    session.start()
