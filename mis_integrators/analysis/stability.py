"""Where a method breaks when a parameter of a scene or of the method is swept, and which one to
choose where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .metrics import (
    BLOCKS,
    TRIMMED_SHARE,
    References,
    block_means,
    relative_differences,
    relative_squared_errors,
    trimmed_mean,
)

ERROR_FACTOR = 3.0
"""A method breaks where its error is more than so many times its own median over the sweep."""
MEAN_DEVIATION = 0.05
"""... or where the image's mean is off by more than this share, significantly."""
STANDARD_ERRORS = 4.0
"""How many of its standard errors a mean must be off to count as off."""


@dataclass(frozen=True)
class Point:
    """A method's error at one value of the parameter."""

    value: float
    error: float
    """relMSE without the worst pixels."""
    deviation: float
    """Mean of the relative differences between image and references."""
    deviation_error: float
    """Standard error of `deviation`."""

    @property
    def mean_is_off(self) -> bool:
        return not abs(self.deviation) <= max(
            MEAN_DEVIATION, STANDARD_ERRORS * self.deviation_error
        )


def judge(value: float, image: np.ndarray, references: References) -> Point:
    """The point of one image, (H, W, 3), relMSE and deviations without the worst pixels of either
    sign.

    The deviation is the mean of (x - r) / (r + 0.1), so that a lamp in the picture does not
    outweigh all else. Its standard error is that over blocks of the image; as these also differ in
    their bias, rather too large than too small. An image that is not finite is off.
    """
    if not np.isfinite(image).all():
        return Point(value, float("inf"), float("inf"), 0.0)
    relative = relative_differences(image, references).mean(axis=-1)
    low, high = np.quantile(relative, [TRIMMED_SHARE, 1 - TRIMMED_SHARE])
    blocks = block_means(np.clip(relative, low, high))
    return Point(
        value,
        trimmed_mean(relative_squared_errors(image, references)),
        float(blocks.mean()),
        float(blocks.std(ddof=1)) / BLOCKS,
    )


def breaks(points: Sequence[Point]) -> list[bool]:
    """Where a method breaks: its error exceeds `ERROR_FACTOR` times the median of its errors over
    the sweep, or its mean is off."""
    median = float(np.median([point.error for point in points]))
    return [not point.error <= ERROR_FACTOR * median or point.mean_is_off for point in points]


@dataclass(frozen=True)
class ParameterChoice:
    """What to use over a range of a parameter, and what to avoid there."""

    low: float
    high: float
    best: str
    close: tuple[str, ...]
    """Methods within `CLOSE` times the best one's error in the whole range."""
    broken: tuple[str, ...]
    """Methods that break somewhere in the range."""


CLOSE = 1.25
"""Ratio of errors up to which methods count as about as good."""


def choose(sweeps: dict[str, Sequence[Point]]) -> list[ParameterChoice]:
    """Ranges of neighbouring values with the same best method: least error among those whose mean
    is not off, but a range goes on while its method's error stays within `CLOSE` times the least.
    `sweeps`: the points of each method, all at the same values."""
    sweeps = {method: list(points) for method, points in sweeps.items() if points}
    broken = {method: breaks(points) for method, points in sweeps.items()}
    values = [point.value for point in next(iter(sweeps.values()))]
    best: list[str] = []
    for index in range(len(values)):
        sound = {
            m: points[index].error for m, points in sweeps.items() if not points[index].mean_is_off
        }
        least = min(sound, key=lambda method: sound[method]) if sound else "none"
        stays = best and best[-1] in sound and sound[best[-1]] <= CLOSE * sound[least]
        best.append(best[-1] if stays else least)
    choices, start = [], 0
    for index in range(1, len(values) + 1):
        if index == len(values) or best[index] != best[start]:
            span = range(start, index)
            close = tuple(
                m
                for m, points in sweeps.items()
                if m != best[start]
                and best[start] != "none"
                and all(
                    not points[i].mean_is_off
                    and points[i].error <= CLOSE * sweeps[best[start]][i].error
                    for i in span
                )
            )
            choices.append(
                ParameterChoice(
                    values[start],
                    values[index - 1],
                    best[start],
                    close,
                    tuple(m for m in sweeps if any(broken[m][i] for i in span)),
                )
            )
            start = index
    return choices
