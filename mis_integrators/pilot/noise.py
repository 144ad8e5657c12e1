"""The noise of estimates: V(R), the relative variance of a pixel over iterations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .denoiser import own_variance_left, variance_left

FEW_DISKS = 64
"""Tuned: merge disks that found photons, fewer than which tell nothing of the noise of that
radius."""
RARE_PIXELS = 0.001
"""Tuned: share of the pixels, the noisiest, without which noise is judged."""


def usual_radiance(mean: np.ndarray) -> float:
    """Mean over pixels, the brightest tenth cut down to the least of them (visible lamps, the sky
    in windows)."""
    return float(np.mean(np.minimum(mean, np.quantile(mean, 0.9))))


def relative_weights(mean: np.ndarray, usual: float | None = None) -> np.ndarray:
    """Weights 1 / (mean^2 + 0.1 usual^2) of squared errors: relative error, without letting dark
    pixels rule. `usual`: the `usual_radiance`, if it is not that of `mean`."""
    usual = usual_radiance(mean) if usual is None else usual
    return 1 / (mean**2 + 0.1 * usual**2 + 1e-30)


def absolute_weights(mean: np.ndarray, usual: float | None = None) -> np.ndarray:
    """Weights 1 / usual^2 of squared errors, the same for all pixels."""
    usual = usual_radiance(mean) if usual is None else usual
    return np.full(mean.shape, 1 / (usual**2 + 1e-30))


MEASURES = {"relmse": relative_weights, "mse": absolute_weights}
"""Measures of error: weights of the pixels' squared errors, from the pixels' radiance."""


def shrink_to_neighbours(samples: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Means (pixels,) of `samples` (iterations, pixels), each drawn towards the mean of its
    neighbours by as much as noise is of their differences.

    A pixel's own noisy mean must not say what its noise is relative to: where it came out bright by
    chance, its noise would count little. `cells`: (pixels,) the numbers of the pixels'
    neighbourhoods, from 0.
    """
    iterations = len(samples)
    means = samples.mean(axis=0)
    if iterations < 2:
        return means
    number = np.maximum(np.bincount(cells), 1)
    noise = np.bincount(cells, samples.var(axis=0, ddof=1) / iterations) / number
    cell = np.bincount(cells, means) / number
    spread = np.bincount(cells, (means - cell[cells]) ** 2) / np.maximum(number - 1, 1)
    real = np.maximum(spread - noise, 0) / np.maximum(spread, 1e-30)
    return cell[cells] + real[cells] * (means - cell[cells])


class Noise(NamedTuple):
    """V(R), the relative variance of an iteration, in two parts."""

    photons: np.ndarray
    """What photons make of it, one a radius."""
    floor: float
    """What camera paths make of it at every radius, however many photons there are."""

    def at(self, light_share: float = 1.0) -> np.ndarray:
        """V(R) with that share of the light sub-paths."""
        return self.floor + self.photons / light_share


def noise_by_radius(
    radii: np.ndarray,
    samples: np.ndarray,
    weights: np.ndarray,
    photons_only: bool = True,
    alike: bool = False,
    light_paths: float = 1.0,
    filter_share: float = 1.0,
) -> Noise:
    """The `Noise` of estimates.

    Parameters
    ----------
    samples : (iterations, radii, groups, pixels)
        Estimates of independent iterations; see `denoiser.variance_left`.
    weights : (pixels,)
        See `relative_weights`.
    photons_only
        Whether all noise is that of photons: the vertices that gather are those which the camera
        sees.
    alike
        Whether photons are alike, as those of a caustic; see `bounded_by_larger_disks`.
    light_paths
        How many times as many light sub-paths as in these iterations V is for: noise of photons
        falls with their number.
    filter_share
        See `setting.PilotSetting`.
    """
    variance = _means(weights * variance_left(samples))
    disks = np.count_nonzero(samples.mean(axis=2), axis=(0, 2)) if alike else None
    if photons_only:
        return Noise(bounded_by_larger_disks(radii, variance, 0.0, disks) / light_paths, 0.0)
    own = _means(weights * own_variance_left(samples))
    floor = own.min()
    photons = bounded_by_larger_disks(radii, own, floor, disks) - floor
    photons += shared_noise(radii, variance - own, own)
    return Noise(photons / light_paths, filter_share * floor)


def shared_noise(radii: np.ndarray, shared: np.ndarray, own: np.ndarray) -> np.ndarray:
    """F(R), the noise that near pixels share, by the law a + b / R^2 with no negative part.

    What a pilot measures of it, `shared`, is the difference of two variances: its error is in
    proportion to the noise of camera paths, `own`, and often larger than F itself. Taken as it is,
    the error at large radii would count at small ones by the ratio of areas. So all radii tell of
    the law, each by as much as it knows. The noise of photons that the camera sees falls with the
    area of their disks (b); seen one vertex further, a pixel's paths meet so many disks that their
    size matters little (a).
    """
    error = np.maximum(own, 1e-30)
    terms = np.stack([np.ones(len(radii)), (radii[-1] / radii) ** 2], axis=-1)
    fits = []
    for used in ([0, 1], [0], [1]):
        part, *_ = np.linalg.lstsq(terms[:, used] / error[:, None], shared / error, rcond=None)
        if np.all(part >= 0):
            fitted = terms[:, used] @ part
            fits.append((np.sum(((shared - fitted) / error) ** 2), fitted))
    return min(fits, key=lambda fit: fit[0])[1] if fits else np.zeros(len(radii))


def _means(values: np.ndarray) -> np.ndarray:
    """The `trimmed_mean` of each row."""
    return np.array([trimmed_mean(row) for row in values])


def bounded_by_larger_disks(
    radii: np.ndarray,
    variance: np.ndarray,
    floor: float,
    disks: Sequence[int] | np.ndarray | None = None,
) -> np.ndarray:
    """V(R), no smaller than what larger radii say: the noise of photons falls with the area of the
    disk, above a `floor` that is not theirs. Small disks seldom find the rare bright photons that
    large ones have seen.

    Where photons are alike, `disks` says how many disks of each radius found any. Then only the
    next larger radius has a say: what larger disks spill from a caustic onto its dark surroundings
    is far noisier, relative to them, than anything that small disks do. But a radius with fewer
    than `FEW_DISKS` tells nothing, and has the noise of the next larger one.
    """
    photons = np.maximum(variance - floor, 0) * radii**2
    if disks is None:
        return floor + np.maximum.accumulate(photons[::-1])[::-1] / radii**2
    seen = photons.copy()
    for r in range(len(radii) - 2, -1, -1):
        seen[r] = max(photons[r], photons[r + 1] if disks[r] >= FEW_DISKS else seen[r + 1])
    return floor + seen / radii**2


def direct_variance(direct: np.ndarray, weights: np.ndarray) -> float:
    """Variance, in an iteration, of light that near pixels do not share, as that of camera paths
    alone; infinite where one iteration tells nothing of it. `direct`: (iterations, groups,
    pixels)."""
    if len(direct) < 2:
        return trimmed_mean(weights * np.full(direct.shape[-1], np.inf))
    return trimmed_mean(weights * own_variance_left(direct))


def trimmed_mean(values: np.ndarray) -> float:
    """Mean over pixels without the share `RARE_PIXELS` of the largest: one pixel at the edge of a
    lamp can outweigh all others."""
    kept = np.sort(values)[: max(len(values) - round(len(values) * RARE_PIXELS), 1)]
    return float(np.mean(kept))
