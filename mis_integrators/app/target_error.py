"""When a render is good enough: its relative error, estimated from the differences between its own
iterations.

With m_p the mean of pixel p over the iterations, v_p the estimated variance of that mean, and m the
mean brightness of the picture,

    E^2 = mean over pixels and channels of  v_p / (m_p^2 + (0.1 m)^2)

without the worst 0.1 % of the pixels; m is the mean without the brightest 0.1 %. So E is about the
noise of a pixel over its brightness; pixels much darker than the picture count less. The scale of
the scene's light cancels. What E does not see is what all iterations have in common: the blur of a
merge radius, and light so rare that no iteration has found it yet. The pixels left out are for
single bright dots, whose variance a few iterations do not tell.
"""

from __future__ import annotations

import math

import numpy as np

from ..core.session import Session

DARK = 0.1
"""Brightness, over the picture's mean, below which errors are no longer relative to the pixel's
own."""
LEFT_OUT = 1e-3
"""Share of the pixels, those of largest error, that are left out."""
FEWEST_ITERATIONS = 8
"""Variances of fewer iterations are too noisy to stop on."""
LARGEST_STEP = 1.25
"""Growth of the number of iterations after which the error is estimated again, at most."""


def relative_error(mean: np.ndarray, variance: np.ndarray) -> float:
    """The relative error E above of a picture with the given `mean` and variance of the mean, both
    of shape (H, W, C). Zero where all is black."""
    brightness = np.abs(mean)
    level = DARK * (_mean_without_largest(brightness) or float(brightness.mean()))
    if not level:
        return 0.0
    return math.sqrt(_mean_without_largest(variance / (np.square(mean) + level**2)))


def _mean_without_largest(values: np.ndarray) -> float:
    """Mean over the channels, then over the pixels without the share ``LEFT_OUT`` of the
    largest."""
    pixels = np.sort(values.mean(axis=-1), axis=None)
    return float(pixels[: max(1, round(pixels.size * (1 - LEFT_OUT)))].mean())


class TargetError:
    """Whether a session has reached a relative error. Estimated seldom: whenever it may be reached,
    if the error falls like that of independent iterations, or the render has grown by a quarter
    (that of low-discrepancy sequences falls faster)."""

    def __init__(self, target: float):
        self.target = target
        self.error = math.inf
        """The last estimate."""
        self.black = False
        """Whether nothing but black was there to estimate."""
        self._next = FEWEST_ITERATIONS

    def reached(self, session: Session) -> bool:
        """Whether the error is at most the target."""
        iterations = session.iterations
        if iterations < self._next:
            return False
        self.update(session)
        needed = iterations * min((self.error / self.target) ** 2, LARGEST_STEP)
        self._next = max(math.ceil(needed), iterations + 1)
        return self.error <= self.target

    def share_done(self) -> float:
        """How far the render is: its iterations over those that the target will need, as the last
        estimate has it."""
        return min(1.0, (self.target / self.error) ** 2) if self.error else 1.0

    def update(self, session: Session) -> None:
        """Estimate the error of what is there, if there are two iterations."""
        if session.iterations > 1:
            mean, variance = session.estimate()
            self.error, self.black = relative_error(mean, variance), not mean.any()
