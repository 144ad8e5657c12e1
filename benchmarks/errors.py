"""Errors of an image against two independent references, free of the references' own noise.

With references r1 and r2 of independent noise, the mean of (x - r1)(x - r2) is the squared error of x alone:
the noise of r1 and that of r2 are uncorrelated with each other and with x. Relative errors divide by
((r1 + r2) / 2)^2 + 0.01; where the references are noisy themselves, that mean is smoothed over 3 x 3 pixels,
so that the noise in the divisor and that in the products hardly correlate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

RELATIVE_OFFSET = 0.01
"""relMSE is the mean of (x - r)^2 / (r^2 + this)."""
TRIMMED_SHARE = 1e-3
"""Share of the pixels, the worst ones, that trimmed errors leave out."""


@dataclass(frozen=True)
class Errors:
    """Squared errors of an image. As products of noisy differences they can come out negative where small."""

    mse: float
    relmse: float
    mse_trimmed: float
    relmse_trimmed: float


@dataclass(frozen=True)
class References:
    """Two images of independent noise, (H, W, 3), and where they come from."""

    first: np.ndarray
    second: np.ndarray
    origin: str
    noisy: bool
    """Whether to smooth what relative errors divide by."""

    def divisor(self) -> np.ndarray:
        """What squared errors are divided by to become relative."""
        mean = 0.5 * (self.first.astype(np.float64) + self.second)
        return (_smooth(mean) if self.noisy else mean) ** 2 + RELATIVE_OFFSET


def errors(image: np.ndarray, references: References) -> Errors:
    """Errors of an image of the references' shape."""
    image = image.astype(np.float64)
    products = (image - references.first) * (image - references.second)
    squares = products.mean(axis=-1).ravel()
    relative = (products / references.divisor()).mean(axis=-1).ravel()
    return Errors(
        float(squares.mean()), float(relative.mean()), _trimmed_mean(squares), _trimmed_mean(relative)
    )


def summarise(images: Sequence[np.ndarray], references: References) -> tuple[Errors, float | None]:
    """Mean errors of renders under different seeds, and the share of their relMSE that is bias.

    The share is ``None`` for a single render.
    """
    several = [errors(image, references) for image in images]
    mean = Errors(*np.mean([list(vars(e).values()) for e in several], axis=0).tolist())
    if len(images) < 2:
        return mean, None
    noise = (np.var(images, axis=0, ddof=1) / references.divisor()).mean()
    return mean, float(1 - noise / mean.relmse)


def _smooth(image: np.ndarray) -> np.ndarray:
    """Mean over 3 x 3 pixels."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    return sum(padded[y : y + height, x : x + width] for y in range(3) for x in range(3)) / 9


def _trimmed_mean(values: np.ndarray) -> float:
    left_out = int(np.ceil(TRIMMED_SHARE * values.size))
    return float(np.sort(values)[: values.size - left_out].mean())
