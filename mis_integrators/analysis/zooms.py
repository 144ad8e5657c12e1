"""Parts of a picture that are worth a closer look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def telling_windows(maps: Sequence[np.ndarray], size: int, count: int = 2) -> list[tuple[int, int]]:
    """Upper left corners (y, x) of `count` windows of `size` x `size` pixels, without overlap, in
    which methods differ most: by the distance of the quartiles of the logarithms of their mean
    errors (one method that fails altogether decides nothing), times the root of the median error
    there, so that differences between trifles count little.

    `maps`: an error map, (H, W), of each method.
    """
    height, width = maps[0].shape
    size = min(size, height, width)
    corners = [
        (y, x)
        for y in range(0, height - size + 1, max(size // 4, 1))
        for x in range(0, width - size + 1, max(size // 4, 1))
    ]
    means = np.array([[m[y : y + size, x : x + size].mean() for m in maps] for y, x in corners])
    means = np.maximum(means, 1e-6)
    spread = np.subtract(*np.quantile(np.log(means), [0.75, 0.25], axis=1))
    scores = spread * np.sqrt(np.median(means, axis=1))
    chosen: list[tuple[int, int]] = []
    for index in np.argsort(-scores, kind="stable"):
        y, x = corners[index]
        if all(abs(y - v) >= size or abs(x - u) >= size for v, u in chosen):
            chosen.append((y, x))
        if len(chosen) == count:
            break
    return chosen
