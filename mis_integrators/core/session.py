"""A render as a sequence of iterations: what every session offers, and that of Mitsuba's own
integrators."""

from __future__ import annotations

import math
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from .render_lock import under_render_lock
from .sums import Sums
from .untrusted import Fields

# Camera paths that one pass of a Mitsuba integrator traces: bounds its memory, and the wait after a
# Ctrl-C.
PATHS_PER_PASS = 1 << 20
# Samples that a sampler makes of those that it is asked for, at most: some only know squares or
# powers of two.
ROUNDING = 4
# Passes of a render that estimates its error or is spread over workers, at least.
FEWEST_PASSES = 32

Setting = str | int | float


class Session(Protocol):
    """One render in progress: ``iterate`` adds an iteration, ``image`` is the mean of
    those done.

    A session may have a method ``plan_time(seconds: float) -> None``. It is called once, before the
    first iteration, when the render has a time limit instead of a number of samples. It may have
    ``remarks``, a list of lines that the user should read, complete once an iteration is done,
    ``fewest_iterations``, how many its image needs (else one), and ``seconds_of_next``, what
    its next iteration will take: infinite where it does not know, 0 where it is rendered already.
    ``kept`` has the numbers of iterations that ``start`` has rendered and that are not yet in the
    sums.
    """

    iterations_planned: int | None
    """Iterations that make up the planned samples per pixel; ``None`` if no number was planned."""

    @property
    def iterations(self) -> int:
        """Iterations done."""

    camera_paths: int
    """Camera paths per pixel of one iteration."""

    channels: list[str]
    """Names of the image's C channels: ``R``, ``G``, ``B``, perhaps ``A`` (or ``Y``), then the
    AOVs."""

    settings: dict[str, Setting]
    """What a reader of the image should know about how it was made, by name."""

    sums: Sums
    """All that has been rendered so far: a session of the same scene and settings with the same
    sums has the same image."""

    @property
    def learned(self) -> dict[str, Any]:
        """What ``start`` has found out and the seed alone would not tell again, in JSON's types."""

    def iterate(self, iteration: int | None = None) -> None:
        """Run one iteration and wait until it is done: that of the given number, or the first that
        is missing.

        Iterations depend on the seed and their number alone.
        """

    def image(self) -> np.ndarray:
        """Mean over the iterations done: float32 of shape (H, W, C), radiance in the scene's
        units."""

    def unfinite_pixels(self) -> int:
        """How many pixels had values that are not finite in some iteration. Those values are left
        out of the sums."""

    def sum_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes that the sums will have after an iteration, by name."""

    def keep_variance(self) -> None:
        """From the first iteration on, keep what ``estimate`` needs."""

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean colour and its estimated variance: float64 of the same shape (H, W, 3), or other
        colour channels.

        Needs two iterations, and ``keep_variance``.
        """

    def start(self) -> None:
        """Find out what must be known before the first iteration, unless it is known: pilots,
        caches."""

    def recall(self, learned: dict[str, Any]) -> None:
        """Take over what another session of the same render has ``learned``; before the first
        iteration. It may come from a file that anyone wrote: raises ``untrusted.Malformed`` if it
        is not what such a session can have learned."""


@under_render_lock
def make_session(
    integrator: mi.Integrator,
    scene: mi.Scene,
    sensor: mi.Sensor,
    seed: int,
    spp: int,
    fine: bool = False,
) -> Session:
    """A session that renders ``spp`` samples per pixel, or without a planned end if ``spp`` is 0.

    ``fine`` asks for many small iterations where their size is free.
    """
    if hasattr(integrator, "session"):
        return integrator.session(scene, sensor, seed=seed, spp=spp)
    return MitsubaSession(integrator, scene, sensor, seed=seed, spp=spp, fine=fine)


class MitsubaSession:
    """A ``Session`` of one of Mitsuba's own integrators: the mean of independent passes' developed
    images.

    All passes have the same number of samples, so the total is ``spp`` rounded up to a multiple of
    it. If ``fine``, there are ``FEWEST_PASSES`` passes at least (samples allowing), and without a
    planned end they have 16 samples at most. If ``at_once``, there is one pass.
    """

    def __init__(
        self,
        integrator: mi.Integrator,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: int,
        spp: int,
        fine: bool = False,
        at_once: bool = False,
    ):
        self._integrator, self._scene, self._sensor, self._seed, self._spp = (
            integrator,
            scene,
            sensor,
            seed,
            spp,
        )
        width, height = sensor.film().crop_size()
        largest = self._largest = max(1, PATHS_PER_PASS // (width * height))
        if at_once:
            largest = self._largest = max(spp, 1)
        if fine:
            largest = min(largest, max(1, spp // FEWEST_PASSES) if spp else 16)
        passes = math.ceil(spp / largest)
        self._set_samples(math.ceil(spp / passes) if spp else largest)
        self.settings: dict[str, Setting] = {}
        sensor.film().prepare(integrator.aov_names())
        self.channels = [field.name for field in sensor.film().bitmap().struct_()]
        self._shape = height, width, len(self.channels)
        self._colours = _colour_channels(self.channels)
        self._keeps_variance = False
        self.sums = Sums()

    def _set_samples(self, samples: int) -> None:
        # The sampler has the last word: some of them only know squares or powers of two.
        sampler = self._sensor.sampler().clone()
        sampler.set_sample_count(samples)
        self.camera_paths = int(sampler.sample_count())
        self.iterations_planned = math.ceil(self._spp / self.camera_paths) if self._spp else None

    @property
    def iterations(self) -> int:
        return len(self.sums.done)

    @property
    def learned(self) -> dict[str, Any]:
        return {"samples_per_iteration": self.camera_paths}

    def recall(self, learned: dict[str, Any]) -> None:
        fields = Fields(learned, "learned")
        self._set_samples(fields.integer("samples_per_iteration", 1, ROUNDING * self._largest))
        fields.finish()

    def start(self) -> None:
        pass

    @under_render_lock
    def iterate(self, iteration: int | None = None) -> None:
        iteration = self.sums.done.first_missing if iteration is None else iteration
        seed = int(np.random.SeedSequence((self._seed, iteration)).generate_state(1)[0])
        with dr.suspend_grad():
            self._integrator.render(
                self._scene, self._sensor, seed=seed, spp=self.camera_paths, develop=False
            )
        # The film has all channels; the tensor that render() could return lacks some under `aov`.
        image = np.array(self._sensor.film().bitmap(), np.float64).reshape(self._shape)
        # Else the sampler's unused final state waits, and the next recorded pass would trace these
        # paths again to evaluate it.
        self._sensor.sampler().seed(0, 1)
        finite = np.isfinite(image).all(axis=2, keepdims=True)
        image = np.where(finite, image, 0.0)
        with self.sums.all_or_nothing():
            self.sums.add("total", image)
            self.sums.add("left_out", ~finite)
            if self._keeps_variance:
                self.sums.add("square", np.square(image[..., self._colours]))
            self.sums.done.add(iteration)

    def _counts(self) -> np.ndarray:
        """How many iterations each pixel is the mean of, shape (H, W, 1)."""
        return self.iterations - self.sums["left_out"]

    def unfinite_pixels(self) -> int:
        return int(np.count_nonzero(self.sums["left_out"]))

    def sum_shapes(self) -> dict[str, tuple[int, ...]]:
        height, width, _ = self._shape
        square = {"square": (height, width, len(self._colours))} if self._keeps_variance else {}
        return {"total": self._shape, "left_out": (height, width, 1), **square}

    def image(self) -> np.ndarray:
        return (self.sums["total"] / np.maximum(self._counts(), 1)).astype(np.float32)

    def keep_variance(self) -> None:
        self._keeps_variance = True

    def estimate(self) -> tuple[np.ndarray, np.ndarray]:
        n = self._counts()
        mean = self.sums["total"][..., self._colours] / np.maximum(n, 1)
        return mean, np.maximum(
            self.sums["square"] / np.maximum(n, 1) - np.square(mean), 0
        ) / np.maximum(n - 1, 1)


def _colour_channels(channels: list[str]) -> list[int]:
    """Indices of the channels that make a picture; of all, if the film has bands of its own."""
    for names in (("R", "G", "B"), ("X", "Y", "Z"), ("Y",)):
        if set(names) <= set(channels):
            return [channels.index(name) for name in names]
    return list(range(len(channels)))
