"""Equal-time comparison of integrators, as ratios to the first one in the same run."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mis_integrators.analysis.metrics import decompose, mean_errors
from mis_integrators.session import Session
from methods import SessionMaker
from references import colours, find_references
from reports import Row, save, show, tell
from scene_files import open_scene, scaled_size
from turns import Contender, take_turns

COLUMNS = ("method", "iterations", "seconds", "first", "MSE", "relMSE", "MSE ratio", "relMSE ratio",
           "trimmed ratio", "bias share", "settings")


def run(options: argparse.Namespace) -> None:
    """The sub-command ``compare``."""
    rows: list[Row] = []
    for path in options.scenes:
        found = compare_scene(path, options)
        show(f"{found[0]['scene']}: equal time, {options.time:g} s each", found, COLUMNS)
        rows += found
        save(options.out, "compare", rows, vars(options))


def compare_scene(path: Path, options: argparse.Namespace) -> list[Row]:
    """One row a method: mean errors over the seeds and their ratios to the first method's.

    ``first`` are the seconds until the first iteration was done, with what went before it (a pilot).
    """
    opened = open_scene(path, scaled_size(path, options.scale))
    references = find_references(opened, options, tell)
    makers = [SessionMaker(method, opened, options.time) for method in options.integrators]
    runs: list[list[Contender]] = []
    images: list[list[np.ndarray]] = []
    for seed in range(options.seeds):
        contenders = [Contender.begin(maker.method.label, maker.make, seed) for maker in makers]
        take_turns(contenders, options.time, tell)
        images.append([colours(contender.session) for contender in contenders])
        runs.append(contenders)

    rows: list[Row] = []
    base = None
    for number, method in enumerate(options.integrators):
        mine = [contenders[number] for contenders in runs]
        renders = [seed_images[number] for seed_images in images]
        mean, bias = summarise(renders, references)
        base = base or mean
        settings = mine[-1].session.settings
        rows.append({
            "scene": opened.name,
            "size": "{}x{}".format(*opened.size),
            "method": method.label,
            "seeds": len(mine),
            "iterations": round(np.mean([c.session.iterations for c in mine])),
            "samples_per_pixel": round(np.mean([samples_per_pixel(c.session) for c in mine])),
            "seconds": float(np.mean([c.rendering for c in mine])),
            "first": float(np.mean([c.first for c in mine])),
            "compiling": float(np.mean([c.compiling for c in mine])),
            "warm_up": makers[number].warm_up_seconds,
            "MSE": mean.mse,
            "relMSE": mean.relmse,
            "MSE trimmed": mean.mse_trimmed,
            "relMSE trimmed": mean.relmse_trimmed,
            "MSE ratio": mean.mse / base.mse,
            "relMSE ratio": mean.relmse / base.relmse,
            "trimmed ratio": mean.relmse_trimmed / base.relmse_trimmed,
            "bias share": bias,
            "settings": chosen(settings),
            "references": references.origin,
        })
    return rows


def samples_per_pixel(session: Session) -> int:
    """Camera paths per pixel so far."""
    return session.iterations * session.samples_per_iteration


def chosen(settings: dict) -> str:
    """What a session chose by itself: radii, edge corrections."""
    return " ".join(
        f"{name}={value:.3g}" if isinstance(value, float) else f"{name}={value}"
        for name, value in settings.items()
        if "." in name
    )
