"""References: made where they are missing; where `path` does not converge, other methods are then
asked whether they agree."""

from __future__ import annotations

import argparse
import math

from mis_integrators.analysis.metrics import BLOCKS, References, block_means

import numpy as np

from common.measuring import measure
from common.methods import Method, registered
from common.references import are_there, find_references, recipe
from common.rows import Row, console, save, show, tell
from common.scene_files import OpenScene, open_scene, scaled_size
from experiments import stability

ALLOWED, STANDARD_ERRORS = 0.03, 4.0
"""Methods disagree where their block means differ by more than this share of the mean in the median
block, and by so many standard errors."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``references``."""
    rows: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        old = are_there(opened, options)
        references = find_references(opened, options, tell)
        for method in options.integrators or (
            [] if old and not options.again else registered(recipe(opened)["opinions"])
        ):
            rows.append(opinion(opened, method, references, options.time))
        console.print(f"{opened.name}: references by {references.origin}")
    stability.prepare(options)
    if rows:
        show("Second opinions", rows)
        save(options.out, "references", rows, vars(options))


def opinion(opened: OpenScene, method: Method, references: References, seconds: float) -> Row:
    """How far two renders by another method are from the references, in the median block of the
    image and on the whole.

    The standard error of a block's difference comes from the differences of the two renders and of
    the two references there.
    """
    found = measure(opened, [method], references, seconds, None, 2, [], tell).methods[0]
    first, second, one, two = (
        block_means(image.astype(np.float64).mean(axis=-1))
        for image in (*found.images, references.first, references.second)
    )
    level = 0.5 * (one + two) + 1e-3 * references.mean.mean()
    difference = (0.5 * (first + second) - 0.5 * (one + two)) / level
    error = np.sqrt((first - second) ** 2 + (one - two) ** 2) / (2 * level)
    typical, typical_error = (
        float(np.median(difference)),
        1.2533 * float(np.sqrt(np.mean(np.minimum(error, 1.0) ** 2))) / BLOCKS,
    )
    agrees = abs(typical) <= max(ALLOWED, STANDARD_ERRORS * typical_error)
    mean = float(np.mean([first.mean(), second.mean()]) / level.mean() - 1)
    return {
        "scene": opened.name,
        "references": references.origin,
        "opinion": method.label,
        "median difference": typical,
        "standard error": typical_error,
        "difference of means": mean,
        "error of means": float(
            math.hypot(first.mean() - second.mean(), one.mean() - two.mean()) / (2 * level.mean())
        ),
        "agrees": agrees,
    }
