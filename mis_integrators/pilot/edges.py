"""The correction at edges: how much of what it adds to plain estimates these do lack."""

from __future__ import annotations

import numpy as np

from .bias import expected_products, jackknife

STUDENT_WIDENING = 2
"""Tuned: a standard error estimated from n + 1 iterations counts for 1 + STUDENT_WIDENING / n times
what it says, about as Student's 95 % intervals are wider than normal ones."""
STEP_DEVIATION, RETURN_TO_ONE = 0.3, 0.5
"""Tuned: the share that plain estimates lack, from one step of the ladder to the next smaller one:
its standard deviation, and which part of its distance from one, where small disks have it, it makes
up for."""


def light_lost_at_edges(
    plain: np.ndarray, corrected: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the correction at edges adds, squared; the share of it that plain estimates do lack, and
    that share's standard deviation. One a radius.

    As a disk grows, what the correction adds grows by a pattern over the pixels. Plain estimates
    lose light by the same pattern if the edges are real (share one), and keep it where the
    correction takes clutter for edges (share zero). The share that each step of the ladder loses is
    measured along that pattern, which has little noise, long before Q shows it; a disk lacks what
    all steps up to it have lost. Where noise hides the share of a small step, it is expected to be
    between one and that of the next larger step. `plain`, `corrected`: (iterations, radii, pixels)
    of the same photons.
    """
    added = corrected - plain
    squared = np.maximum(expected_products(added, added, weights), 0)
    lost, error = jackknife(plain[:, :-1] - plain[:, 1:], added[:, 1:], weights)
    expected = np.maximum(expected_products(np.diff(added, axis=1), added[:, 1:], weights), 1e-12)
    error *= 1 + STUDENT_WIDENING / (len(plain) - 1)
    share, variance = shares_by_step(lost / expected, (error / expected) ** 2)
    step = np.concatenate([[max(squared[0], 1e-12)], expected])
    total = np.cumsum(step)
    return squared, np.cumsum(step * share) / total, np.sqrt(np.cumsum(step**2 * variance)) / total


def shares_by_step(measured: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The shares of the ladder's steps and their variances, from noisy ones by a Kalman filter that
    runs from the largest step to the smallest. One value more than is `measured`, for the smallest
    radius itself."""
    shares, variances = [], []
    expected, prior = 1.0, STEP_DEVIATION**2
    for value, noise in zip(measured[::-1], variance[::-1]):
        gain = prior / (prior + noise)
        share, left = expected + gain * (value - expected), (1 - gain) * prior
        shares.append(share)
        variances.append(left)
        expected = share + RETURN_TO_ONE * (1 - share)
        prior = (1 - RETURN_TO_ONE) ** 2 * left + STEP_DEVIATION**2
    return np.array([expected, *shares[::-1]]), np.array([prior, *variances[::-1]])
