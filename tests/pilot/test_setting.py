"""The pixels that a pilot takes."""

import math

from mis_integrators.pilot.setting import PILOT_PATHS, PilotSetting, pilot_pixels

import hypothesis
from hypothesis import strategies as st


@hypothesis.given(st.integers(1, 3000), st.integers(1, 3000), st.integers(1, 100))
def test_pixels_lie_all_over_the_film(width, height, camera_paths):
    """In all rows and columns that they can reach, and about as many paths as a pilot has."""
    setting = PilotSetting(
        width, width * height, 1.0, ("indirect",), True, False, camera_paths, None, None, None
    )
    pixels = pilot_pixels(setting)
    last = (pixels.count - 1) * pixels.stride
    assert last < width * height <= last + pixels.stride
    assert pixels.stride == 1 or math.gcd(pixels.stride, width) == 1
    assert pixels.paths <= 2 * PILOT_PATHS + pixels.camera_paths
