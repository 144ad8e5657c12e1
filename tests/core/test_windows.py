"""Means over windows."""

from mis_integrators.core.windows import mean_without_largest, window_mean

import numpy as np
import pytest


@pytest.mark.parametrize("shape", [(1, 1), (3, 2), (9, 12), (2, 7, 8)])
@pytest.mark.parametrize("width", [1, 3, 5])
def test_every_window_by_itself(shape, width):
    values, reach = np.random.default_rng(3).normal(size=shape), width // 2
    height, across = shape[-2:]
    means, others = window_mean(values, width), mean_without_largest(values, width)
    for y in range(height):
        for x in range(across):
            window = values[
                ..., max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1
            ]
            np.testing.assert_allclose(means[..., y, x], window.mean(axis=(-2, -1)), atol=1e-12)
            number = window.shape[-2] * window.shape[-1]
            left = window.sum(axis=(-2, -1)) - window.max(axis=(-2, -1))
            np.testing.assert_allclose(others[..., y, x], left / max(number - 1, 1), atol=1e-12)
