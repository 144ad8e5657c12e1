"""How many camera paths each pixel sends for direct light, where photons are gathered by few.

A path that sees emission and direct light only is cheap beside one that gathers photons, and the
noise that it removes is very uneven: that of pixels at the edge of a lamp can outweigh all others
in a picture's squared error. Let v_p be the variance of a pixel's direct light with one path, N_p
the number of paths, n the iterations. Its noise in one iteration is taken to be

    v_p n^(1 - a) N_p^-a,

with a = 1 for independent paths, and 3/2 for sequences: that of a discontinuity in two dimensions
under stratified numbers (Mitchell 1996). With the noise that photons leave, e, weighted by w_p once
to relative errors and once to absolute ones, the N_p minimise

    ln(e_rel + <w_p noise_p>) + ln(e_abs + <noise_p>) + 2 ln(cost),

so that both errors, times the time of an iteration, count alike; <.> is the mean over pixels. Where
the derivative vanishes, N_p^(1 + a) is proportional to v_p; the errors follow from all N_p, so a
few steps of a fixed point find them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .noise import relative_weights, trimmed_mean

TRIALS = 4
"""Tuned: independent paths through each pixel that tell how noisy its direct light is."""
AROUND = 9
"""Pixels a side of the wider squares that tell of noise, too."""
SHARE_AROUND = 0.05
"""Tuned: how much they count, beside the 3 x 3 pixels. Where bright paths are rare, as by flames
that glass reflects, a pixel's trials and its neighbours' often meet none."""
MOST_TRIED = 1 << 18
"""Pixels with trials, at most or about: larger films have them in every second, or third, ... row
and column."""
COST = 0.15
"""Tuned: cost of a path for direct light, over that of one that gathers, photons included, where no
clock tells it (0.07 to 0.5 in twelve scenes)."""
MOST_PATHS = 256
"""Of a pixel and iteration at most."""
EXPONENTS = {True: 1.5, False: 1.0}
"""By whether numbers are those of sequences: a above."""
STEPS = 6


def coarser(width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows and columns of a film whose pixels have trials, and for each pixel of the film, row
    by row, the place of one that is near among these."""
    step = math.ceil(math.sqrt(width * height / MOST_TRIED))
    rows, columns = np.arange(0, height, step), np.arange(0, width, step)
    nearest = (np.arange(height) // step)[:, None] * len(columns) + np.arange(width) // step
    return rows, columns, nearest.ravel()


def smoothed(values: np.ndarray, width: int, side: int = 3) -> np.ndarray:
    """Means over squares of `side` pixels a side, an odd number, around each: (pixels,), row by
    row. The film goes on beyond its edges as it is there."""
    image = np.pad(values.reshape(-1, width), side // 2, mode="edge")
    height = len(image) - side + 1
    rows = np.sum([image[shift : shift + height] for shift in range(side)], axis=0)
    found = np.sum([rows[:, shift : shift + width] for shift in range(side)], axis=0)
    return (found / side**2).ravel()


class DirectNoise(NamedTuple):
    """What trials tell of direct light, mean over the channels; (pixels,) each."""

    mean: np.ndarray
    noise: np.ndarray
    """Variance of a path, with the differences to the neighbours: few samples miss an edge that
    runs close to a pixel's border, but it shows there. Geometric mean of two halves of the trials:
    a rare bright path, which could have come anywhere, is in one of them only."""
    own: np.ndarray
    """Variance of a path, without them."""

    def times(self, share: float) -> DirectNoise:
        """The same with such a share of the noise."""
        return self._replace(noise=self.noise * share, own=self.own * share)


def measure(samples: np.ndarray, width: int) -> DirectNoise:
    """The `DirectNoise` of independent paths through each pixel, from those of the 3 x 3 pixels
    around, and to a small part from those in wider squares.

    Parameters
    ----------
    samples : (paths, pixels)
        Light of each path; pixels row by row. Values that are not finite count as none.
    width
        Pixels in a row.
    """
    samples = np.where(np.isfinite(samples), samples, 0).astype(np.float64)
    of_pixel, squares = samples.mean(axis=0), (samples**2).mean(axis=0)
    own = (squares - of_pixel**2) * (len(samples) / (len(samples) - 1))
    halves = [_noise_around(half, width) for half in np.array_split(samples, 2)]
    noise = np.sqrt(halves[0] * halves[1])
    return DirectNoise(smoothed(of_pixel, width), noise, np.maximum(own, 0))


def _noise_around(samples: np.ndarray, width: int) -> np.ndarray:
    """Variance of all samples of the 3 x 3 pixels around each, and a share of its mean over wider
    squares: (pixels,)."""
    mean = smoothed(samples.mean(axis=0), width)
    near = np.maximum(smoothed((samples**2).mean(axis=0), width) - mean**2, 0)
    return (1 - SHARE_AROUND) * near + SHARE_AROUND * smoothed(near, width, AROUND)


def paths_per_pixel(
    found: DirectNoise,
    photon_light: float,
    photon_error: float,
    iterations: float,
    exponent: float,
    cost: float | None = None,
    most_cost: float = math.inf,
) -> np.ndarray:
    """Paths that each pixel should send for direct light, at least one: (pixels,), real numbers.

    Parameters
    ----------
    found
        Of one path.
    photon_light
        Radiance that photons bring to a pixel, on average.
    photon_error
        Relative mean squared error of one iteration that direct light has no part in.
    iterations, exponent
        n and a.
    cost
        Of a path for direct light, over that of one that gathers, photons included; ``None``: the
        usual one.
    most_cost
        What an iteration may cost, in units of one without more paths for direct light.
    """
    cost = COST if cost is None else cost
    relative = relative_weights(found.mean + photon_light)
    noise = found.noise * max(iterations, 1) ** (1 - exponent)
    absolute_error = photon_error / max(float(np.median(relative)), 1e-30)
    paths = np.ones(len(noise))
    for _ in range(STEPS):
        left = noise * paths**-exponent
        importance = relative / max(photon_error + np.mean(relative * left), 1e-30)
        importance += 1 / max(absolute_error + np.mean(left), 1e-30)
        wanted = exponent * importance * noise * cost_of_all(cost, paths) / (2 * cost)
        paths = np.clip(wanted ** (1 / (1 + exponent)), 1, MOST_PATHS)
    there_is_time_for = (most_cost - 1) / max(cost_of_all(cost, paths) - 1, 1e-30)
    return 1 + (paths - 1) * min(there_is_time_for, 1)


def cost_of_all(cost: float, paths: np.ndarray) -> float:
    """Of an iteration with so many `paths` a pixel, in units of one without more than one; `cost`:
    as of `paths_per_pixel`."""
    return 1 + cost * float(np.mean(paths - 1))


def direct_error(
    found: DirectNoise,
    weights: np.ndarray,
    paths: np.ndarray | float,
    iterations: float,
    exponent: float,
) -> float:
    """Noise of direct light in one iteration with so many `paths` a pixel, by the pixels'
    `weights` (`noise.MEASURES`); other arguments as of `paths_per_pixel`."""
    noise = found.own * max(iterations, 1) ** (1 - exponent)
    return trimmed_mean(weights * noise * paths**-exponent)
