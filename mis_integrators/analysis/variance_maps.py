"""Maps of the variance of one iteration, compared between methods."""

from __future__ import annotations

import numpy as np

from .metrics import trimmed_mean

DARKEST = 0.1
"""Relative variances divide by the squared radiance plus the square of this share of the image's
usual radiance."""


def relative_variance(variance: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Variance over squared radiance, pixel by pixel.

    `variance`: (H, W, C), of one iteration; `mean`: (H, W, C), the image. Returns (H, W): means
    over channels before the division, so that dark channels do not rule. The brightest twentieth of
    the pixels (visible lamps) does not count as usual radiance.
    """
    grey = mean.mean(axis=-1)
    usual = np.minimum(grey, np.quantile(grey, 0.95)).mean()
    return variance.mean(axis=-1) / (grey**2 + (DARKEST * usual) ** 2 + 1e-30)


def share_worse(values: np.ndarray, best: np.ndarray, size: int = 8) -> float:
    """Share of the `size` x `size` blocks of an image (H, W) in which the mean of `values` exceeds
    that of `best`; blocks, because a pixel's estimated variance is noisy itself."""
    return float((_blocks(values, size) > _blocks(best, size)).mean())


def best_single(maps: list[np.ndarray]) -> np.ndarray:
    """The map, of several, whose trimmed mean is least."""
    return min(maps, key=trimmed_mean)


def _blocks(values: np.ndarray, size: int) -> np.ndarray:
    height, width = (n // size * size for n in values.shape)
    return (
        values[:height, :width].reshape(height // size, size, width // size, size).mean(axis=(1, 3))
    )
