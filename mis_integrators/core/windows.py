"""Means and maxima over windows of an image."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


def window_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean over a square window of `width` pixels, an odd number, around each pixel, cut at the
    image's border: float64 of the shape (..., H, W) of `values`."""
    return _along(_along(np.asarray(values, np.float64), width, -1), width, -2)


def window_max(values: np.ndarray, width: int) -> np.ndarray:
    """Largest value within the same windows."""
    for axis in (-1, -2):
        at_borders = [(0, 0)] * values.ndim
        at_borders[axis] = (width // 2, width // 2)
        padded = np.pad(values, at_borders, mode="edge")
        values = sliding_window_view(padded, width, axis=axis).max(axis=-1)
    return values


def _along(values: np.ndarray, width: int, axis: int) -> np.ndarray:
    """The same along one axis."""
    values = np.moveaxis(values, axis, -1)
    size, reach = values.shape[-1], width // 2
    sums = np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(values, axis=-1)], axis=-1)
    place = np.arange(size)
    low, high = np.maximum(place - reach, 0), np.minimum(place + reach + 1, size)
    return np.moveaxis((sums[..., high] - sums[..., low]) / (high - low), -1, axis)
