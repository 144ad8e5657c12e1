"""The noise of a render, by its own first iterations.

A pilot looks at a few thousand pixels, and leaves out the noisiest of them. Where rare bright paths
make most of the noise, it meets too few of them. The first iterations of the render meet more,
where the film is larger, and cost nothing: they belong to the image.
"""

from __future__ import annotations

import numpy as np

from ..core.film import grey_image
from ..core.stratified_variance import contrasts, variance_by_power
from ..core.windows import window_mean
from ..pilot.noise import MEASURES
from ..pilot.run import MOST_ITERATIONS

SHARE = 0.1
"""Tuned: share of a render that its first iterations may take until they are looked at."""
FEWEST, MOST = 2, 8
"""Iterations that are looked at: a power of two of them."""

NEAR = 15
"""Tuned: width in pixels of the windows whose mean tells how bright a pixel is. A photon's disk is
wider than 5, with which relative errors came out at a third to a half in scenes of rare photons;
with 15 they are 0.5 to 1.1 times those by a reference, in six scenes."""


def iterations_ahead(planned, pilot_share):
    """How many iterations of those `planned` are looked at: a power of two; or 0 where so many tell
    less than a pilot with `pilot_share` of the pixels."""
    affordable = int(min(SHARE * planned, MOST))
    count = 1 << affordable.bit_length() >> 1
    return count if count >= max(FEWEST, MOST_ITERATIONS * pilot_share) else 0


def first_images(session, count):
    """The first `count` iterations of a session that has not rendered yet, which keeps them: grey,
    (count, H, W)."""
    for iteration in range(count):
        if iteration not in session.kept:
            session.iteration_seconds = session.render_ahead(iteration)
    film = session.sensor.film()
    return np.array([grey_image(session.kept[number], film) for number in range(count)])


def brightness(*images):
    """Of each pixel (H, W), by the `first_images` of some sessions: what its errors are relative
    to. A mean over `NEAR`: what is bright by chance must not say so itself."""
    return np.mean([window_mean(several.mean(axis=0), NEAR) for several in images], axis=0)


def noise_of_mean(images, bright, count):
    """The variance of the mean of `count` iterations, by measure, from the `first_images` of a
    session and the pixels' `brightness`. All pixels count: what is rare is all that is looked
    for."""
    lengths, found, _ = contrasts(images, np.ones(len(images), bool), 1)
    return {
        measure: variance_by_power(
            lengths,
            np.array([np.mean(weigh(bright.ravel()) * contrast.ravel()) for contrast in found]),
            max(count, 1),
        )
        for measure, weigh in MEASURES.items()
    }
