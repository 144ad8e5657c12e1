"""Sums over runs of consecutive iterations: a bounded number of them, however long the render.

Segment k holds the iterations k 2^j to (k + 1) 2^j - 1. The level j is the least at which all
iterations fit into `SEGMENTS` of them, so it follows from the largest iteration number alone; when
it grows, neighbours are added in pairs. So the segments of some iterations are the same in whatever
order, and wherever, these were summed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np

SEGMENTS = 8
"""Segments at most, a power of two. They tell contrasts at three scales. Of 16 segments, which tell
four, the variances were no better (bdpm, five bundled scenes, 16 and 64 iterations)."""
LOG = SEGMENTS.bit_length() - 1
"""Binary logarithm of their number."""
NAMES = [f"segment{k}" for k in range(SEGMENTS)]
"""Names of the sums."""


def level(end: int) -> int:
    """Binary logarithm of the iterations a segment, where all iterations are below `end`."""
    return max(0, (max(end, 1) - 1).bit_length() - LOG)


def zeros_like(value: Any) -> Any:
    """Zeros in the shape of an array or a tensor (which take no memory until they are added to)."""
    return (
        np.zeros_like(value)
        if isinstance(value, np.ndarray)
        else dr.zeros(type(value), value.shape)
    )


def coarser(sums: Mapping[str, Any], levels: int) -> dict[str, Any]:
    """Named sums, with the segments among them (if there are any) so many `levels` higher."""
    sums = dict(sums)
    if NAMES[0] not in sums:
        return sums
    for _ in range(min(levels, LOG)):  # then all is in the first segment, and stays there
        old = [sums[name] for name in NAMES]
        new = [one + other for one, other in zip(old[0::2], old[1::2])]
        sums |= zip(NAMES, new + [zeros_like(value) for value in new])
    return sums


def complete(below: int, beyond: Any, end: int) -> tuple[int, np.ndarray]:
    """Iterations a segment, and which segments have all of theirs (shape (`SEGMENTS`,)), of the
    iterations 0 to `below` - 1 and those `beyond` them, all less than `end`."""
    length = 2 ** level(end)
    count = np.clip(below - length * np.arange(SEGMENTS), 0, length)
    for iteration in beyond:
        count[iteration // length] += 1
    return length, count == length
