"""What a denoiser leaves of an iteration's noise.

A denoiser averages over near pixels. The camera paths of those are independent, and of the noise
that they make only a small share is left, `LEFT`. But all pixels of an iteration gather the same
photons: their noise is alike in near pixels, and stays, as the blur of their disks does.

The law of total variance tells the two apart. Let B be the variance of a camera path's estimate
with its photons given, mean over photons, and F that of its mean over camera paths. A path has the
variance F + B; two paths of near pixels that gather the same photons have the covariance F. With
half their sum s and half their difference d,

    Var[s] = F + B / 2,    Var[d] = B / 2

(over iterations: that the pixels' means differ does not matter), and what counts after the denoiser
is F + LEFT B = Var[s] - (1 - 2 LEFT) Var[d].
"""

from __future__ import annotations

import numpy as np

LEFT = 1 / 25
"""Tuned: share that Open Image Denoise leaves of the squared error of noise which is independent
from pixel to pixel (1/7 to 1/34, the less, the noisier the image)."""
GROUPS = 2
"""Groups of camera paths, through near pixels, of a pilot that tells shared noise from other."""


def variance_left(samples: np.ndarray) -> np.ndarray:
    """The variance that counts: (..., pixels).

    Parameters
    ----------
    samples : (iterations, ..., groups, pixels)
        Estimates of independent iterations, those of the groups by the same photons. One group: its
        variance, as no denoiser is thought of; `GROUPS`: F + LEFT B.
    """
    found = samples.mean(axis=-2).var(axis=0, ddof=1)
    if samples.shape[-2] == GROUPS:
        found -= (1 - 2 * LEFT) * _half_of_own(samples)
    return found


def own_variance_left(samples: np.ndarray) -> np.ndarray:
    """LEFT B, the part of `variance_left` that camera paths make; of one group all of it, which
    nothing tells apart."""
    if samples.shape[-2] != GROUPS:
        return variance_left(samples)
    return 2 * LEFT * _half_of_own(samples)


def _half_of_own(samples: np.ndarray) -> np.ndarray:
    """B / 2."""
    return ((samples[..., 0, :] - samples[..., 1, :]) / 2).var(axis=0, ddof=1)
