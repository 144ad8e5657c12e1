"""Means and maxima over windows of an image."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


def window_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean over a square window of `width` pixels, an odd number, around each pixel, cut at the
    image's border: float64 of the shape (..., H, W) of `values`."""
    return _along(_along(np.asarray(values, np.float64), width, -1), width, -2)


def mean_without_largest(values: np.ndarray, width: int) -> np.ndarray:
    """The same means without the largest value of each window (0 where there is no other)."""
    values, number = np.asarray(values, np.float64), np.ones(())
    for axis in (-2, -1):
        low, high = _windows(values.shape[axis], width)
        number = np.multiply.outer(number, high - low)
    others = window_mean(values, width) * number - window_max(values, width)
    return others / np.maximum(number - 1, 1)


def window_max(values: np.ndarray, width: int) -> np.ndarray:
    """The largest value of each of these windows."""
    for axis in (-2, -1):
        at_borders = [(0, 0)] * values.ndim
        at_borders[axis] = (width // 2, width // 2)
        padded = np.pad(values, at_borders, mode="edge")
        values = sliding_window_view(padded, width, axis=axis).max(axis=-1)
    return values


def _windows(size: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """First places of windows along an axis, and those after the last."""
    place, reach = np.arange(size), width // 2
    return np.maximum(place - reach, 0), np.minimum(place + reach + 1, size)


def _along(values: np.ndarray, width: int, axis: int) -> np.ndarray:
    """The same along one axis."""
    values = np.moveaxis(values, axis, -1)
    sums = np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(values, axis=-1)], axis=-1)
    low, high = _windows(values.shape[-1], width)
    return np.moveaxis((sums[..., high] - sums[..., low]) / (high - low), -1, axis)
