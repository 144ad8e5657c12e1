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

import numpy as np

from .noise import relative_weights, trimmed_mean

TRIALS = 4
"""Tuned: independent paths through each pixel that tell how noisy its direct light is."""
COST = 0.1
"""Tuned: cost of a path for direct light, over that of one that gathers (photons included)."""
MOST_PATHS = 256
"""Of a pixel and iteration at most."""
EXPONENTS = {True: 1.5, False: 1.0}
"""By whether numbers are those of sequences: a above."""
STEPS = 16


def smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Means over squares of 3 x 3 pixels, smaller at the film's edges: (pixels,), row by row."""
    image = values.reshape(-1, width)
    for axis in range(2):
        padded = np.pad(image, [(1, 1) if axis == k else (0, 0) for k in range(2)], mode="edge")
        size = image.shape[axis]
        image = np.mean([np.take(padded, range(k, k + size), axis) for k in range(3)], axis=0)
    return image.ravel()


def mean_and_noise(samples: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of each pixel and variance of a path through it, (pixels,) each, from all samples of the
    3 x 3 pixels around: few samples miss an edge that runs close to the pixel's border, but it
    shows as a difference to the neighbour."""
    samples = samples.astype(np.float64)
    mean = smoothed(samples.mean(axis=0), width)
    return mean, np.maximum(smoothed((samples**2).mean(axis=0), width) - mean**2, 0)


def paths_per_pixel(
    samples: np.ndarray,
    width: int,
    photon_light: float,
    photon_error: float,
    iterations: float,
    exponent: float,
) -> np.ndarray:
    """Paths that each pixel should send for direct light, at least one: (pixels,), real numbers.

    Parameters
    ----------
    samples : (paths, pixels)
        Direct light of independent paths, mean over the channels; pixels row by row.
    width
        Pixels in a row.
    photon_light
        Radiance that photons bring to a pixel, on average.
    photon_error
        Relative mean squared error of one iteration that direct light has no part in.
    iterations, exponent
        n and a.
    """
    mean, noise = mean_and_noise(samples, width)
    relative = relative_weights(mean + photon_light)
    noise *= max(iterations, 1) ** (1 - exponent)
    absolute_error = photon_error / max(float(np.median(relative)), 1e-30)
    paths = np.ones(len(noise))
    for _ in range(STEPS):
        left = noise * paths**-exponent
        importance = relative / max(photon_error + np.mean(relative * left), 1e-30)
        importance += 1 / max(absolute_error + np.mean(left), 1e-30)
        cost = 1 + COST * np.mean(paths - 1)
        wanted = exponent * importance * noise * cost / (2 * COST)
        paths = np.clip(wanted ** (1 / (1 + exponent)), 1, MOST_PATHS)
    return paths


def direct_error(
    samples: np.ndarray,
    width: int,
    photon_light: float,
    paths: np.ndarray,
    iterations: float,
    exponent: float,
) -> float:
    """Relative noise of direct light in one iteration with so many `paths` a pixel; arguments as of
    `paths_per_pixel`."""
    mean, _ = mean_and_noise(samples, width)
    noise = samples.var(axis=0, ddof=1) * max(iterations, 1) ** (1 - exponent)
    return trimmed_mean(relative_weights(mean + photon_light) * noise * paths**-exponent)
