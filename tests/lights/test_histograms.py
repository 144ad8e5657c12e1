"""Histograms that are mixed with coarser versions of themselves."""

import numpy as np
import pytest

SHARES = (0.55, 0.25, 0.1, 0.1)


def smoothed_cell_by_cell(grid, shares):
    """Each cell of one grid: the share of its own value, and of each coarser level half of its
    block's mean and half of the mean over the 3 x 3 blocks around, those outside being empty."""
    n, found = len(grid), shares[0] * grid
    for level, share in enumerate(shares[1:], start=1):
        size = 2**level
        blocks = np.zeros((n // size + 2, n // size + 2))
        for y, x in np.ndindex(n, n):
            blocks[y // size + 1, x // size + 1] += grid[y, x] / size**2
        for y, x in np.ndindex(n, n):
            row, column = y // size, x // size
            around = blocks[row : row + 3, column : column + 3].sum() / 9
            found[y, x] += share * 0.5 * (blocks[row + 1, column + 1] + around)
    return found


@pytest.mark.parametrize("shares", [SHARES, SHARES[:2], SHARES[:1]])
def test_smoothed(rgb, shares):
    from mis_integrators.lights.histograms import smoothed  # of the active variant

    random = np.random.default_rng(3)
    grids = random.random((3, 16, 16)) * (random.random((3, 16, 16)) < 0.1)
    kept = grids.copy()
    found = smoothed(grids, shares)
    np.testing.assert_array_equal(grids, kept)
    expected = [smoothed_cell_by_cell(grid, shares) for grid in grids]
    np.testing.assert_allclose(found, expected, atol=1e-14)
