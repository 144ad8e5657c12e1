"""A render as a sequence of iterations: what every session offers, and that of Mitsuba's own integrators."""

from __future__ import annotations

import math
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

# Camera paths that one pass of a Mitsuba integrator traces: bounds its memory, and the wait after a Ctrl-C.
PATHS_PER_PASS = 1 << 20


class Session(Protocol):
    """One render in progress: ``iterate`` adds an independent iteration, ``image`` is the mean of those done.

    A session may have a method ``plan_time(seconds: float) -> None``. It is called once, before the first
    iteration, when the render has a time limit instead of a number of samples.
    """

    iterations_planned: int | None
    """Iterations that make up the planned samples per pixel; ``None`` if no number was planned."""

    iterations: int
    """Iterations done."""

    samples_per_iteration: int
    """Camera paths per pixel of one iteration."""

    channels: list[str]
    """Names of the image's C channels: ``R``, ``G``, ``B``, perhaps ``A`` (or ``Y``), then the AOVs."""

    settings: dict[str, str | int | float]
    """What a reader of the image should know about how it was made, by name."""

    def iterate(self) -> None:
        """Run one iteration and wait until it is done."""

    def image(self) -> np.ndarray:
        """Mean over the iterations done: float32 of shape (H, W, C), radiance in the scene's units."""


def make_session(
    integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int
) -> Session:
    """A session that renders ``spp`` samples per pixel, or without a planned end if ``spp`` is 0."""
    if hasattr(integrator, "session"):
        return integrator.session(scene, sensor, seed=seed, spp=spp)
    return MitsubaSession(integrator, scene, sensor, seed=seed, spp=spp)


class MitsubaSession:
    """A ``Session`` of one of Mitsuba's own integrators: the mean of independent passes' developed images.

    All passes have the same number of samples, so the total is ``spp`` rounded up to a multiple of it.
    """

    def __init__(self, integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int):
        self._integrator, self._scene, self._sensor, self._seed = integrator, scene, sensor, seed
        width, height = sensor.film().crop_size()
        largest = max(1, PATHS_PER_PASS // (width * height))
        passes = math.ceil(spp / largest)
        # The sampler has the last word: some of them only know squares or powers of two.
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(math.ceil(spp / passes) if spp else largest)
        self.samples_per_iteration = int(sampler.sample_count())
        self.iterations_planned = math.ceil(spp / self.samples_per_iteration) if spp else None
        self.iterations = 0
        self.settings: dict[str, str | int | float] = {}
        sensor.film().prepare(integrator.aov_names())
        self.channels = [field.name for field in sensor.film().bitmap().struct_()]
        self._sum = np.zeros((height, width, len(self.channels)))

    def iterate(self) -> None:
        seed = int(np.random.SeedSequence((self._seed, self.iterations)).generate_state(1)[0])
        with dr.suspend_grad():
            self._integrator.render(
                self._scene, self._sensor, seed=seed, spp=self.samples_per_iteration, develop=False
            )
        # The film has all channels; the tensor that render() could return lacks some under `aov`.
        self._sum += np.array(self._sensor.film().bitmap()).reshape(self._sum.shape)
        # Else the sampler's unused final state waits, and the next recorded pass would trace these paths again to evaluate it.
        self._sensor.sampler().seed(0, 1)
        self.iterations += 1

    def image(self) -> np.ndarray:
        return (self._sum / self.iterations).astype(np.float32)
