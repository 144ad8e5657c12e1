"""The focus of the guide of far lights: the box that holds the lit places."""

from mis_integrators.lights.environment_guide import FOCUS_MARGIN, FOCUS_TAIL, _weighted_box

import numpy as np
import pytest


def box_of(far, share):
    """Low and high end, along each axis, of places between 0 and 1, and one at `far` that has this
    `share` of the weight."""
    places = np.append(np.linspace(0, 1, 9999), far)
    weights = np.append(np.full(9999, (1 - share) / 9999), share)
    return _weighted_box(np.tile(places, (3, 1)), weights, FOCUS_TAIL)


@pytest.mark.parametrize("far", [1 + 0.9 * FOCUS_MARGIN, -0.9 * FOCUS_MARGIN])
def test_a_room_is_in_focus_to_its_end(far):
    """However little light is there: else its photons are as heavy as hundreds of others."""
    low, high = box_of(far, 1e-5)
    np.testing.assert_allclose(low, min(far, 0), atol=1e-12)
    np.testing.assert_allclose(high, max(far, 1), atol=1e-12)


def test_a_plain_is_not_in_focus_to_the_horizon():
    low, high = box_of(1000.0, 1e-5)
    np.testing.assert_allclose(low, 0, atol=1e-12)
    np.testing.assert_allclose(high, 1 - FOCUS_TAIL, atol=1e-3)
    assert np.all(box_of(1000.0, 2 * FOCUS_TAIL)[1] == 1000)
