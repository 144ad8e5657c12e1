"""What a film's reconstruction filter leaves of noise that is independent from pixel to pixel."""

import math

import mis_integrators  # noqa: F401 (registers the plugins)
from mis_integrators.core.film import filter_share

import mitsuba as mi
import pytest


@pytest.mark.parametrize(
    "filter, across",
    [
        ({"type": "box"}, 1),
        ({"type": "tent"}, 2 / 3),
        ({"type": "tent", "radius": 3.0}, 2 / 9),
        ({"type": "gaussian"}, 1 / math.sqrt(math.pi)),
        ({"type": "gaussian", "stddev": 2.0}, 0.25 / math.sqrt(math.pi)),
    ],
)
def test_integral_of_the_square(rgb, filter, across):
    """Against closed forms; a Gaussian's tail, which is cut off, is 1e-3 of it."""
    assert filter_share(mi.load_dict(filter)) == pytest.approx(across**2, rel=3e-3)


@pytest.mark.parametrize("kind", ["mitchell", "catmullrom", "lanczos"])
def test_no_filter_adds_noise(rgb, kind):
    assert 0.3 < filter_share(mi.load_dict({"type": kind})) <= 1
