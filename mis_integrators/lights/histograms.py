"""Histograms over the unit square: where their cells are, draws from them, and smoothing."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def square_cell(u, v, n: int):
    """Number of the cell of an n x n grid over the unit square in which (u, v) lies; places outside
    belong to its border."""
    column, line = (dr.clip(mi.Int32(dr.floor(x * n)), 0, n - 1) for x in (u, v))
    return mi.UInt32(line * n + column)


def in_square_cell(cell, offset, n: int):
    """The place (u, v) in the unit square that lies in cell `cell` of an n x n grid, at `offset` (a
    pair of numbers in [0, 1))."""
    return (mi.Float(cell % n) + offset.x) * (1 / n), (mi.Float(cell // n) + offset.y) * (1 / n)


def split(u, share: float):
    """Which of uniform numbers `u` are below `share`; and for either side a uniform number that is
    left of them."""
    below = u < share
    return below, dr.select(below, u / share, (u - share) / (1 - share))


def draw_cell(cdf, first, count: int, u, active=True):
    """A cell, from uniform numbers `u` and the cumulative sums of `count` cells, which stand at
    places `first` and on of `cdf`; and a uniform number that is left of `u`, in [0, 1)."""
    cell = dr.binary_search(
        0, count - 1, lambda i: dr.gather(mi.Float, cdf, first + i, active) <= u
    )
    upper = dr.gather(mi.Float, cdf, first + cell, active)
    lower = dr.gather(mi.Float, cdf, first + cell - 1, active & (cell > 0))
    return cell, dr.clip((u - lower) / dr.maximum(upper - lower, 1e-20), 0, 0.9999999)


def smoothed(grids, shares):
    """Square histograms (rows, n, n) mixed with coarser versions of themselves, so that a cell that
    the pilot happened to miss beside cells that it met is not left to the plain density (whose few
    samples would carry huge flux). `shares`: of full, half, quarter, ... resolution."""
    levels = [shares[0] * grids]
    coarse = grids
    for level, share in enumerate(shares[1:], start=1):
        rows, n, _ = coarse.shape
        coarse = coarse.reshape(rows, n // 2, 2, n // 2, 2).sum(axis=(2, 4))
        around = _sums_of_three(_sums_of_three(coarse, 1), 2) / 9
        levels.append(share * 0.5 ** (2 * level + 1) * (coarse + around))
    result = levels.pop()
    while levels:
        result = np.repeat(np.repeat(result, 2, axis=1), 2, axis=2)
        result += levels.pop()
    return result


def _sums_of_three(grids, axis: int):
    """Sums of each cell with both of its neighbours along an axis; there is nothing beyond the
    ends."""
    grids = np.swapaxes(grids, axis, -1)
    sums = grids.copy()
    sums[..., 1:] += grids[..., :-1]
    sums[..., :-1] += grids[..., 1:]
    return np.swapaxes(sums, axis, -1)
