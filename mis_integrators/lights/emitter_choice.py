"""A choice among emitters by their power."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.random import next_2d, streams
from ..core.spectra import channel_mean

POWER_SAMPLES = 4096
"""Tuned: rays by which the power of a textured emitter is estimated."""
LEAST_POWER = 1e-6
"""Of a textured emitter of which no sample has met light, as a share of the others' power: its
texture may have small bright spots all the same. (By `UNIFORM_SHARE` it is chosen more often.)"""
UNIFORM_SHARE = 0.1
"""Tuned: share of the choices among emitters that ignores power, so that a dim but near emitter is
not starved."""


class EmitterSelection:
    """A discrete choice among emitters; free of random numbers and tables where there is one
    emitter only."""

    def __init__(self, weights):
        weights = np.asarray(weights, dtype=np.float64)
        self.count = len(weights)
        total = weights.sum()
        self.pmf = weights / total if total > 0 else np.zeros_like(weights)
        if self.count > 1:
            self._pmf = from_numpy(mi.Float, self.pmf)
            self._cdf = from_numpy(mi.Float, np.cumsum(self.pmf)[:-1])

    def sample(self, u):
        """Index of the chosen emitter and its probability, from uniform numbers `u`."""
        if self.count == 1:
            return mi.UInt32(0), mi.Float(1)
        index = dr.binary_search(
            0, self.count - 1, lambda i: dr.gather(mi.Float, self._cdf, i) <= u
        )
        return index, dr.gather(mi.Float, self._pmf, index)

    def probability(self, index):
        """Probability of `index`."""
        return mi.Float(1) if self.count == 1 else dr.gather(mi.Float, self._pmf, index)


def mean_power(emitter):
    """Estimated emitted power (channel mean, deterministic), from Mitsuba's own light rays."""
    rng = streams(dr.arange(mi.UInt32, POWER_SAMPLES), mi.UInt32(0x70776572))
    _, weight = emitter.sample_ray(0, rng.next_float32(), next_2d(rng), next_2d(rng))
    value = dr.mean(channel_mean(weight))[0]
    return float(value) if np.isfinite(value) and value > 0 else 0.0


def _may_be_missed(emitter, kind):
    """Whether Mitsuba's light rays may not meet small bright spots of the emitter's texture: they
    start anywhere, or (on rotated spheres, cylinders) not where the texture has told them to."""
    return kind in ("area", "directionalarea", "spot") and bool(
        emitter.flags() & mi.EmitterFlags.SpatiallyVarying
    )


def powers(emitters, kinds, order, guide):
    """Estimated powers of emitters of these kinds, by which they are chosen: those that are zero by
    chance, perhaps, raised to a little. `order`: their places in the scene's list; `guide`: an
    `EnvironmentGuide`, which knows how much of infinite emitters is of use, or None."""
    power = np.array([mean_power(emitter) for emitter in emitters])
    if guide is not None:
        power = guide.useful_power(power[np.argsort(order)])[order]
    doubtful = [_may_be_missed(emitter, kind) for emitter, kind in zip(emitters, kinds)]
    return _with_doubtful(power, doubtful)


def _with_doubtful(power, may_be_missed):
    """Estimated powers, those that are zero by chance, perhaps, raised to a little."""
    least = LEAST_POWER * power.sum() or LEAST_POWER
    return np.where((power == 0) & np.array(may_be_missed, dtype=bool), least, power)
