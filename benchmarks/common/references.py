"""Pairs of independent reference images: beside the scene, or made once by long runs and kept for
later."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import mis_integrators
from mis_integrators.analysis.metrics import References
from mis_integrators.app.output import write_exr
from mis_integrators.core.traits import SceneTraits

import mitsuba as mi
import numpy as np
import OpenEXR

from common.methods import Method, SessionMaker, parse_method
from common.scene_files import OpenScene, fingerprint

COLOURS = ("R", "G", "B")

RECIPE = json.loads(Path(__file__).with_name("references.json").read_text())
"""Scenes that path cannot render in reasonable time: what makes their references, and which other
methods must agree with them."""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options that ``find_references`` reads."""
    add_folder(command)
    command.add_argument(
        "--reference-time",
        type=float,
        default=30,
        metavar="SECONDS",
        help="rendering seconds of each of the two references (default: 30)",
    )
    command.add_argument(
        "--reference-method",
        type=parse_method,
        metavar="PLUGIN[:...]",
        help="what renders them (default: path, or for light that it cannot "
        "find vcm or bdpm with a radius below the pixels' size, in media bdpt)",
    )


def add_folder(command: argparse.ArgumentParser) -> None:
    """The option that names where references are kept."""
    command.add_argument(
        "--references",
        type=Path,
        default=Path("out/references"),
        metavar="DIR",
        help="where references are kept that do not lie beside the scene (default: out/references)",
    )


def recipe(opened: OpenScene) -> dict:
    """How the references of a scene are made, ``method``, and the methods that must agree,
    ``opinions``: a `complete` one and none, unless `references.json` knows better."""
    return RECIPE.get(opened.name) or {"method": complete(opened.scene), "opinions": []}


def complete(scene: mi.Scene) -> str:
    """The method that renders all light of a scene: path, where there are media volpath. Under the
    better sampler: at the edges of bright lamps references by independent numbers would be noisier
    than what they judge. Where mirrors or glass are lit by lamps that no ray can meet, camera paths
    lack the caustics, and from some lamps direct light; then vcm with a small radius does, in media
    bdpt."""
    traits = SceneTraits(scene)
    if traits.has_unsampled_lights or (traits.has_delta and traits.has_unmet_lights):
        return "bdpt" if traits.has_media else f"vcm:initial_radius={traits.extent / 1000:.2g}"
    return f"{'volpath' if traits.has_media else 'path'}:sampler=multijitter"


def find_references(
    opened: OpenScene, options: argparse.Namespace, tell: Callable[[str], None]
) -> References:
    """References beside the scene (``NAME.exr`` and ``NAME_2.exr``, if of the film's size), else
    those kept from an earlier run, else new ones, which are then kept. ``options``: see
    ``add_options``."""
    beside = _beside(opened)
    if beside:
        return References(*beside, origin="beside the scene", noisy=False)
    method = _method(opened, options)
    kept, record, made_with = _wanted(opened, options)
    if not _usable(record, made_with):
        options.references.mkdir(parents=True, exist_ok=True)
        iterations = _make(opened, method, options.reference_time, kept, tell)
        made_with |= {"iterations": iterations, "version": mis_integrators.__version__}
        record.write_text(json.dumps(made_with, indent=1) + "\n")
    return References(*(read_colours(path) for path in kept), origin=method.label, noisy=True)


def are_there(opened: OpenScene, options: argparse.Namespace) -> bool:
    """Whether `find_references` has nothing to render."""
    _, record, made_with = _wanted(opened, options)
    return _beside(opened) is not None or _usable(record, made_with)


def _beside(opened: OpenScene) -> list[np.ndarray] | None:
    """The references beside the scene; ``None`` if there are none of the film's size."""
    if not opened.path or opened.filtered:
        return None
    paths = _paths(opened.path.parent, opened.path.stem)
    if not all(path.exists() for path in paths):
        return None
    images = [read_colours(path) for path in paths]
    return images if all(image.shape[1::-1] == opened.size for image in images) else None


def _method(opened: OpenScene, options: argparse.Namespace) -> Method:
    return options.reference_method or parse_method(recipe(opened)["method"])


def _wanted(opened: OpenScene, options: argparse.Namespace) -> tuple[list[Path], Path, dict]:
    """Where the kept references of a scene lie, their record, and what must stand in it."""
    width, height = opened.size
    boxed = "_box" if opened.filtered else ""
    kept = _paths(options.references, f"{opened.name}_{width}x{height}{boxed}")
    return (
        kept,
        kept[0].with_suffix(".json"),
        {
            "scene": opened.name,
            "fingerprint": fingerprint(opened),
            "size": [width, height],
            "method": _method(opened, options).label,
            "inherited": opened.inherited,
            "seconds_at_least": options.reference_time,
        },
    )


def read_colours(path: Path) -> np.ndarray:
    """The colour channels of an EXR file as (H, W, 3)."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        return np.stack([channels[name].pixels for name in COLOURS], axis=-1).astype(np.float32)


def colours(session) -> np.ndarray:
    """The colour channels of a session's image so far as (H, W, 3)."""
    image = session.image()
    return image[..., [session.channels.index(name) for name in COLOURS]]


def _paths(directory: Path, name: str) -> list[Path]:
    return [directory / f"{name}.exr", directory / f"{name}_2.exr"]


def _usable(record: Path, made_with: dict) -> bool:
    """Whether kept references were made in this way, or in a longer run."""
    if not record.exists():
        return False
    kept = json.loads(record.read_text())
    long_enough = kept["seconds_at_least"] >= made_with["seconds_at_least"]
    same = {**kept, **made_with, "seconds_at_least": kept["seconds_at_least"]} == kept
    return long_enough and same


def _make(
    opened: OpenScene,
    method: Method,
    seconds: float,
    paths: list[Path],
    tell: Callable[[str], None],
) -> list[int]:
    """Render the references; returns the iterations of each."""
    maker = SessionMaker(method, opened, seconds)
    counts = []
    for number, path in enumerate(paths):
        session = maker.make(seed=1_000_003 + number)
        start = time.perf_counter()
        while session.iterations == 0 or time.perf_counter() - start < seconds:
            session.iterate()
            spent = time.perf_counter() - start
            tell(f"reference {number + 1} of {opened.name}: {spent:.0f} of {seconds:g} s")
        write_exr(path, colours(session), COLOURS, {"method": method.label})
        counts.append(session.iterations)
    return counts
