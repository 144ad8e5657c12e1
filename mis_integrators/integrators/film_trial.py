"""The noise of a render, by its own first iterations.

A pilot looks at a few thousand pixels, and leaves out the noisiest of them. Where rare bright paths
make most of the noise, it meets too few of them. The first iterations of the render meet more, and
those of the candidate that is chosen belong to the image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..core.film import grey_and_weight
from ..core.stratified_variance import contrasts, variance_by_power
from ..core.windows import window_mean
from ..pilot.noise import MEASURES, usual_radiance
from ..pilot.run import MOST_ITERATIONS

SHARE = 0.1
"""Tuned: share of a render that the first iterations of a candidate may take."""
FEWEST, MOST = 2, 8
"""Iterations that are looked at: a power of two of them."""
MOST_PIXELS = 1 << 22
"""Pixels of these iterations at most, unless they are the fewest (bounds memory)."""
NEAR = 15
"""Tuned: width in pixels of the windows whose mean tells how bright a pixel is."""


class FirstImages(NamedTuple):
    """Iterations of a render, grey."""

    mean: np.ndarray
    """(H, W): the image that they make."""
    deviations: np.ndarray
    """(iterations, H, W): of each from the mean. A mean over some of them is that of their
    image."""
    low_discrepancy: bool
    """Whether iterations share sequences."""


def iterations_ahead(planned, pixels, pilot_pixels):
    """How many iterations of those `planned` are looked at, on a film of so many `pixels`: a power
    of two; or 0 where so many tell less than a pilot of `pilot_pixels`."""
    most = min(MOST, max(MOST_PIXELS // pixels, FEWEST), int(SHARE * planned))
    count = 1 << most.bit_length() >> 1
    told = count >= FEWEST and count * pixels >= MOST_ITERATIONS * pilot_pixels
    return count if told else 0


def first_images(session, count):
    """The `FirstImages`, so many, of a session that has not rendered yet and keeps them."""
    missing = [iteration for iteration in range(count) if iteration not in session.kept]
    if missing:
        session.iteration_seconds = np.median([session.render_ahead(number) for number in missing])
    blocks = [session.kept[number] for number in range(count)]
    grey, weight = grey_and_weight(session.sensor.film(), blocks)
    usual_weight = weight.mean(axis=0)
    usual_weight[usual_weight == 0] = 1
    mean = grey.mean(axis=0) / usual_weight
    deviations = (grey - mean * weight) / usual_weight
    return FirstImages(mean, deviations, session.integrator.low_discrepancy)


def weights_by(*seen):
    """Weights (H, W) of the pixels' squared errors, by measure, from the `FirstImages` of some
    sessions. A pixel is as bright as a window of `NEAR` around it: what is bright by chance must
    not say so itself."""
    mean = np.mean([images.mean for images in seen], axis=0)
    near, usual = window_mean(mean, NEAR), usual_radiance(mean)
    return {measure: weigh(near, usual) for measure, weigh in MEASURES.items()}


def noise_of_mean(images, weights, count):
    """The variance of the mean of `count` iterations, by measure, from `FirstImages` and the
    pixels' `weights_by` them. All pixels count: what is rare is what is looked for."""
    if not images.low_discrepancy:
        variance = images.deviations.var(axis=0, ddof=1) / count
        return {measure: np.mean(weight * variance) for measure, weight in weights.items()}
    lengths, found, _ = contrasts(images.deviations, np.ones(len(images.deviations), bool), 1)
    return {
        measure: variance_by_power(lengths, np.mean(weight * found, axis=(1, 2)), count)
        for measure, weight in weights.items()
    }
