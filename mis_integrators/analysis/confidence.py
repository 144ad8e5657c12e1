"""Confidence intervals of figures that come from a few independent renders: means, ratios, slopes.
No SciPy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

LEVEL = 0.95
"""Probability with which an interval holds the true value, unless another is asked for."""


class Interval(NamedTuple):
    """An estimate, and the ends of its confidence interval: NaN where there are too few renders to
    tell."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return (
            f"{self.value:.3g}"
            if math.isnan(self.low)
            else f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"
        )


def mean_interval(values: Sequence[float], level: float = LEVEL) -> Interval:
    """Mean of independent values, with Student's interval."""
    values = np.asarray(values, dtype=np.float64)
    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, math.nan, math.nan)
    half = (
        t_quantile(1 - level, len(values) - 1) * float(values.std(ddof=1)) / math.sqrt(len(values))
    )
    return Interval(mean, mean - half, mean + half)


def log_ratio_error(values: Sequence[float], base: Sequence[float]) -> float:
    """Standard error of log(mean of `values` / mean of `base`) by the delta method; pairs
    (values[i], base[i]) may be correlated, as those of one run are. NaN for a single pair or where
    the ratio is not positive."""
    values, base = np.asarray(values, dtype=np.float64), np.asarray(base, dtype=np.float64)
    if len(values) < 2 or not values.mean() / base.mean() > 0:
        return math.nan
    residuals = values / values.mean() - base / base.mean()
    return float(residuals.std(ddof=1)) / math.sqrt(len(values))


def ratio_interval(
    values: Sequence[float], base: Sequence[float], level: float = LEVEL
) -> Interval:
    """Ratio of the means of paired values, with an interval that is symmetric on a logarithmic
    scale."""
    ratio = float(np.mean(values) / np.mean(base))
    error = log_ratio_error(values, base)
    if math.isnan(error):
        return Interval(ratio, math.nan, math.nan)
    factor = math.exp(min(t_quantile(1 - level, len(values) - 1) * error, 700.0))
    return Interval(ratio, ratio / factor, ratio * factor)


def log_slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Slope of the least-squares line through (log x, log y), over the points with y > 0; NaN if
    they are fewer than three."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    good = (x > 0) & (y > 0)
    if good.sum() < 3:
        return math.nan
    x, y = np.log(x[good]), np.log(y[good])
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def slope_interval(
    runs: Sequence[tuple[Sequence[float], Sequence[float]]], level: float = LEVEL
) -> Interval:
    """Mean of the slopes of several independent runs, each (x, y), with Student's interval.

    The points of one run share their samples, so a single fit's residuals say nothing about its
    slope's error: runs do.
    """
    slopes = [slope for slope in (log_slope(x, y) for x, y in runs) if not math.isnan(slope)]
    return mean_interval(slopes, level) if slopes else Interval(math.nan, math.nan, math.nan)


# --- Student's t ----------------------------------------------------------------------------------


def t_two_sided(t: float, freedom: float) -> float:
    """Probability that Student's t exceeds `t` in absolute value."""
    a, b, x = freedom / 2, 0.5, freedom / (freedom + t * t)
    front = (
        math.exp(
            a * math.log(x)
            + b * math.log1p(-x)
            - math.lgamma(a)
            - math.lgamma(b)
            + math.lgamma(a + b)
        )
        if x < 1
        else 0
    )
    if x >= 1:
        return 1.0
    if x < (a + 1) / (a + b + 2):
        return front * _beta_fraction(a, b, x) / a
    return 1 - front * _beta_fraction(b, a, 1 - x) / b


@cache
def t_quantile(tail: float, freedom: float) -> float:
    """The t > 0 with `t_two_sided(t) = tail`."""
    low, high = 0.0, 1e3
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if t_two_sided(middle, freedom) > tail else (low, middle)
    return high


def _beta_fraction(a: float, b: float, x: float) -> float:
    """Continued fraction of the incomplete beta function (Lentz)."""
    c, d = 1.0, 1 - (a + b) * x / (a + 1)
    d = 1 / (d or 1e-300)
    result = d
    for m in range(1, 500):
        for step in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d = 1 / ((1 + step * d) or 1e-300)
            c = (1 + step / c) or 1e-300
            result *= d * c
        if abs(d * c - 1) < 1e-12:
            break
    return result
