"""Whether two methods that share the time make a better image than the better one alone: a bound,
from images combined region by region with weights by their true errors."""

from __future__ import annotations

import argparse

from mis_integrators.analysis.metrics import References, errors, squared_errors

import numpy as np

from common.measuring import Measured, Measurement
from common.rows import Row, save, show
from experiments.compare import measure_scene

BLOCK = 16
"""Edge of the regions, in pixels."""
COLUMNS = (
    "method",
    "relMSE / best",
    "MSE / best",
    "share",
    "relMSE with the best / best",
    "MSE with the best / best",
)


def run(options: argparse.Namespace) -> None:
    """The sub-command ``combine``."""
    rows: list[Row] = []
    for path in options.scenes:
        times = [part * options.time for share in options.shares for part in (share, 1 - share)]
        measurement = measure_scene(path, options, sorted(set(times)))
        found = combine(measurement, options.time, options.shares)
        if not found:
            raise SystemExit(f"{measurement.opened.name}: fewer than two methods render it")
        title = f"{measurement.opened.name}: {options.time:g} s, best alone: {found[0]['best']}"
        show(title, found, COLUMNS)
        rows += found
        save(options.out, "combine", rows, vars(options))


def combine(measurement: Measurement, seconds: float, shares: list[float]) -> list[Row]:
    """One row a share of the time and method that is not the best one: what the method leaves of
    the error of the best alone, by itself and with that share of the time, the best one having the
    rest. Of the first seed."""
    references = measurement.references
    whole = {
        measured.method.label: _errors(measured.images[0], references)
        for measured in measurement.methods
    }
    best = min(measurement.methods, key=lambda measured: np.prod(whole[measured.method.label]))
    least = whole[best.method.label]
    rows: list[Row] = []
    for share in shares:
        for other in measurement.methods:
            if other is best:
                continue
            images = [_image(best, seconds * (1 - share)), _image(other, seconds * share)]
            both = _errors(mixed(images, references), references)
            alone = whole[other.method.label]
            rows.append(
                {
                    "scene": measurement.opened.name,
                    "best": best.method.label,
                    "method": other.method.label,
                    "share": share,
                    "relMSE / best": alone[0] / least[0],
                    "MSE / best": alone[1] / least[1],
                    "relMSE with the best / best": both[0] / least[0],
                    "MSE with the best / best": both[1] / least[1],
                }
            )
    return rows


def mixed(images: list[np.ndarray], references: References) -> np.ndarray:
    """The images (H, W, 3) weighted in each region by one over their true squared error there: the
    least error that weights of regions can have, where the images' errors are uncorrelated."""
    weights = [
        1 / np.maximum(_of_regions(squared_errors(image, references).mean(axis=2)), 1e-12)
        for image in images
    ]
    total = sum(weights)
    return sum(
        (weight / total)[..., None] * image.astype(np.float64)
        for weight, image in zip(weights, images)
    )


def _of_regions(values: np.ndarray) -> np.ndarray:
    """Means over regions of an image (H, W), at each of their pixels."""
    height, width = values.shape
    down, across = np.arange(height) // BLOCK, np.arange(width) // BLOCK
    region = down[:, None] * (across[-1] + 1) + across
    means = np.bincount(region.ravel(), values.ravel()) / np.bincount(region.ravel())
    return means[region]


def _image(measured: Measured, seconds: float) -> np.ndarray:
    """The first seed's picture after so many seconds, or the last one before."""
    snapshots = measured.runs[0].snapshots
    return min(snapshots, key=lambda snapshot: abs(snapshot.seconds - seconds)).image


def _errors(image: np.ndarray, references: References) -> tuple[float, float]:
    """relMSE without the worst 0.1 % of the pixels, and MSE."""
    found = errors(image, references)
    return max(found.relmse_trimmed, 1e-12), max(found.mse, 1e-12)
