"""The terms of the noise law, from iterations whose terms are known."""

import types

import numpy as np
import pytest

from experiments import terms

SIZE = 64


class KnownSession:
    """Iterations 10 + camera(c) + light(l) + both(c, l), normal numbers of the given standard
    deviations for each pixel, under the numbers that `_sequence` hands out."""

    def __init__(self, camera, light, both):
        self.deviations = camera, light, both
        rfilter = types.SimpleNamespace(border_size=lambda: 0)
        film = types.SimpleNamespace(rfilter=lambda: rfilter)
        self.sensor = types.SimpleNamespace(film=lambda: film)

    def start(self):
        pass

    def _sequence(self, number, purpose, group_size):
        return number

    def _iteration(self, iteration):
        from mis_integrators.integrators.purposes import CAMERA, LIGHT

        c, w = (self._sequence(iteration, purpose, 1) for purpose in (CAMERA, LIGHT))
        value = 10.0
        for kind, (deviation, key) in enumerate(zip(self.deviations, ((c,), (w,), (c, w)))):
            value = value + deviation * np.random.default_rng((kind, *key)).normal(
                size=(SIZE, SIZE)
            )
        return np.stack([value, value, value, np.ones_like(value)], axis=-1)


@pytest.mark.parametrize("deviations", [(1.0, 0.5, 2.0), (0.0, 1.0, 0.5)])
def test_terms_are_found(rgb, deviations):
    """Within four standard errors: 4096 pixels times 16 rounds."""
    _, found = terms.measure(KnownSession(*deviations), 16, "known")
    camera, light, both = np.square(deviations) / (100 + 1)  # relative to the squared image
    assert found == pytest.approx([camera + light + both, camera, light], abs=4 * 0.06 / 256)
    cross, of_camera, of_photons = terms.shares(*found, n_b=4)
    assert cross + of_camera + of_photons == pytest.approx(1)
    total = camera + light + both
    assert of_camera == pytest.approx(camera / total, abs=0.05)
    assert of_photons == pytest.approx(0.75 * light / total, abs=0.05)
