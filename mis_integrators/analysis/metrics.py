"""Errors of images against two independent references, free of the references' own noise where the
measure allows it.

With references r1 and r2 of independent noise, the mean of (x - r1)(x - r2) is the squared error of
x alone: the noise of r1 and that of r2 are uncorrelated with each other and with x. It can come out
negative where the error is small. Absolute errors (MAPE) and FLIP are no such products: they see
the noise of the references' mean as well.

Relative errors divide by (r1 + r2)/2, squared, plus `RELATIVE_OFFSET`; where the references are
noisy, that mean is smoothed over 3 x 3 pixels, so that the noise in the divisor and that in the
products hardly correlate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

RELATIVE_OFFSET = 0.01
"""relMSE is the mean of (x - r)^2 / (r^2 + this)."""
TRIMMED_SHARE = 1e-3
"""Share of the pixels, the worst ones, that trimmed errors leave out."""
GROUPS = 15
"""Groups of pixels of the median of means."""
OUTSTANDING, NEAR = 10.0, 16
"""An artefact's squared error is above so many times the median of those in its neighbourhood, a
block of so many pixels squared, in the image that it is compared with."""
BLOCKS = 8
"""Blocks a side of an image whose means are compared, or whose spread is a standard error."""


@dataclass(frozen=True)
class References:
    """Two images of independent noise, (H, W, 3), radiance, and where they come from."""

    first: np.ndarray
    second: np.ndarray
    origin: str
    noisy: bool
    """Whether to smooth what relative errors divide by."""

    @property
    def mean(self) -> np.ndarray:
        """Mean of both: float64, (H, W, 3)."""
        return 0.5 * (self.first.astype(np.float64) + self.second)

    def level(self) -> np.ndarray:
        """The radiance that errors are relative to, (H, W, 3)."""
        return _smooth(self.mean) if self.noisy else self.mean

    def divisor(self) -> np.ndarray:
        """What squared errors are divided by to become relative, (H, W, 3)."""
        return self.level() ** 2 + RELATIVE_OFFSET


@dataclass(frozen=True)
class Errors:
    """Errors of an image. Squared ones are products of noisy differences and can be negative where
    small."""

    mse: float
    relmse: float
    mse_trimmed: float
    relmse_trimmed: float
    relmse_median: float
    """Median of means over `GROUPS` groups of pixels."""
    mape: float
    mean_ratio: float
    """Mean of the image over that of the references."""


def squared_errors(image: np.ndarray, references: References) -> np.ndarray:
    """Squared error of each pixel and channel, (H, W, 3), with expectation (x - r)^2 for the
    noise-free r."""
    image = image.astype(np.float64)
    return (image - references.first) * (image - references.second)


def relative_squared_errors(image: np.ndarray, references: References) -> np.ndarray:
    """`squared_errors` over the references' divisor, mean over channels: (H, W)."""
    return (squared_errors(image, references) / references.divisor()).mean(axis=-1)


def errors(image: np.ndarray, references: References) -> Errors:
    """Errors of an image of the references' shape."""
    squares = squared_errors(image, references).mean(axis=-1)
    relative = relative_squared_errors(image, references)
    return Errors(
        mse=float(squares.mean()),
        relmse=float(relative.mean()),
        mse_trimmed=trimmed_mean(squares),
        relmse_trimmed=trimmed_mean(relative),
        relmse_median=median_of_means(relative),
        mape=mape(image, references),
        mean_ratio=float(
            image.astype(np.float64).mean() / max(float(references.mean.mean()), 1e-30)
        ),
    )


def relative_differences(image: np.ndarray, references: References) -> np.ndarray:
    """(x - r) / (r + 0.1) of each pixel and channel, (H, W, 3), r the references' mean and 0.1 the
    root of `RELATIVE_OFFSET`; includes the noise of r."""
    return (image.astype(np.float64) - references.mean) / (
        np.abs(references.level()) + RELATIVE_OFFSET**0.5
    )


def mape(image: np.ndarray, references: References) -> float:
    """Mean magnitude of `relative_differences`."""
    return float(np.abs(relative_differences(image, references)).mean())


# --- Bias and variance ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Decomposition:
    """relMSE apart into squared bias and variance of one render, both relative to
    `References.divisor`; `total` is their sum."""

    bias2: float
    variance: float

    @property
    def total(self) -> float:
        return self.bias2 + self.variance

    @property
    def bias_share(self) -> float:
        """Share of the error that more samples do not remove; below 0 where noise hides a bias that
        is next to none."""
        return self.bias2 / self.total if self.total else 0.0


def decompose(images: Sequence[np.ndarray], references: References) -> Decomposition | None:
    """Squared bias and variance from renders under different seeds, each without bias; ``None`` for
    a single render.

    The variance is that of the renders among themselves. Squared bias is the mean of (x_s - r1)(x_t
    - r2) over pairs of different renders: noise of neither renders nor references is left in it.
    """
    count = len(images)
    if count < 2:
        return None
    stack = np.stack(images).astype(np.float64)
    first, second = stack - references.first, stack - references.second
    crossed = (first.sum(axis=0) * second.sum(axis=0) - (first * second).sum(axis=0)) / (
        count * (count - 1)
    )
    divisor = references.divisor()
    return Decomposition(
        float((crossed / divisor).mean()), float((stack.var(axis=0, ddof=1) / divisor).mean())
    )


def efficiency(variance: float, seconds: float) -> float:
    """1 / (variance x time), in 1/s: the same after any time for a method without memory; ``inf``
    without variance."""
    return 1 / (variance * seconds) if variance * seconds > 0 else float("inf")


# --- Robust means ---------------------------------------------------------------------------------


def trimmed_mean(values: np.ndarray, share: float = TRIMMED_SHARE) -> float:
    """Mean without the given share of values, those of largest magnitude.

    By magnitude, because products with noisy references are large with either sign: leaving out
    positive ones alone would bias the rest.
    """
    values = np.ravel(values)
    kept = len(values) - int(np.ceil(share * len(values)))
    return float(values[np.argpartition(np.abs(values), kept)[:kept]].mean())


def median_of_means(values: np.ndarray, groups: int = GROUPS) -> float:
    """Median of the means of `groups` random groups of the values (always the same groups): a few
    outliers spoil a few groups only. Below the mean where values are skewed."""
    values = np.asarray(values, dtype=np.float64).ravel()
    order = np.random.default_rng(0).permutation(len(values))
    return float(
        np.median(
            [group.mean() for group in np.array_split(values[order], min(groups, len(values)))]
        )
    )


# --- Artefacts ------------------------------------------------------------------------------------


def artefact_share(image: np.ndarray, other: np.ndarray, references: References) -> float:
    """Share of an image's pixels that an eye would take for artefacts beside an `other` image,
    (H, W, 3) each: their squared error is above `OUTSTANDING` times the median of the other's in
    the block of `NEAR` pixels squared that they are in. Errors are of grey against the references'
    mean, so they include its noise; the other image's own share is what to compare with."""
    level = references.mean.mean(axis=-1)
    mine, others = (np.square(x.astype(np.float64).mean(axis=-1) - level) for x in (image, other))
    found = 0
    for y in range(0, level.shape[0], NEAR):
        for x in range(0, level.shape[1], NEAR):
            block = slice(y, y + NEAR), slice(x, x + NEAR)
            found += np.count_nonzero(mine[block] > OUTSTANDING * np.median(others[block]))
    return found / level.size


# --- FLIP -----------------------------------------------------------------------------------------


def flip(image: np.ndarray, references: References) -> tuple[float, np.ndarray] | None:
    """NVIDIA's HDR-FLIP against the references' mean: its mean and its map, (H, W), in [0, 1];
    ``None`` without the package ``flip-evaluator``. What an eye would see when flipping between
    both, over a range of exposures that the reference needs."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    reference = np.maximum(references.mean, 0).astype(np.float32)
    test = np.nan_to_num(np.maximum(image, 0), posinf=1e6).astype(np.float32)
    error_map, mean, _ = flip_evaluator.evaluate(reference, test, "HDR", applyMagma=False)
    return float(mean), np.asarray(error_map)[..., 0] if np.ndim(error_map) == 3 else np.asarray(
        error_map
    )


def block_means(values: np.ndarray) -> np.ndarray:
    """Means over the blocks of an image (H, W) that is cut into `BLOCKS` times `BLOCKS`; left over
    rows and columns are left out."""
    height, width = (n // BLOCKS * BLOCKS for n in values.shape)
    return (
        values[:height, :width]
        .reshape(BLOCKS, height // BLOCKS, BLOCKS, width // BLOCKS)
        .mean(axis=(1, 3))
    )


def _smooth(image: np.ndarray) -> np.ndarray:
    """Mean over 3 x 3 pixels."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    return np.mean(
        [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0
    )
