"""Variance of the mean of iterations that are not independent: those of paths whose random numbers
are consecutive parts of Owen-scrambled sequences.

Let V(m) be the variance of the mean of m = 2^i iterations that are an *aligned block*, numbers
a m to (a + 1) m - 1. It is the same for all a, and falls faster than 1/m, how much faster hangs on
the integrand. The *contrast* of a block of 2 m iterations is (A - B)^2 / 4, where A and B are the
means of its halves. With (A + B) / 2 the block's mean, var A = var B = V(m), and so cov(A, B) =
2 V(2 m) - V(m),

    E (A - B)^2 / 4 = (2 V(m) - 2 cov(A, B)) / 4 = V(m) - V(2 m),

however A and B hang together. A render of n iterations shows contrasts up to 2 m = n, summed over
pixels that are alike. The rest, V(n), is what the contrasts at several scales extrapolate to.

Owen 1997, "Scrambled net variance for integrals of smooth functions": V(m) ~ 1/m^3 up to logarithms
for smooth integrands, 1/m^2 in one dimension with a jump, 1/m^1.5 at edges across two dimensions
(He and Wang 2015), and 1/m where the dimensions are too many, or where noise is independent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np

TILE, GROUP = 16, 16
"""Tuned: width of the tiles in which pixels are grouped, and pixels a group, about."""
MOST_POWER = 2.0
"""Power with which the variance falls where edges across one dimension make it. What few samples
show beyond is noise, or does not last."""
STEEP_SHARE = 0.5
"""Tuned: how much of the power above one is left, on average, from the longest contrast to a few
hundred iterations. (In fourteen scenes 32 samples told the variance of 512 to 0.7 to 1.5 times, and
a sum of laws as of `extrapolated` to 0.9 to 7 times.)"""
LASTING = 16
"""Longest blocks beyond which no power but one is known to last."""
FITS = 4
"""Times that the extrapolation is fitted, each with weights by the one before."""


def variance_law(power: float, below: int, beyond: Collection[int] = ()) -> float:
    """The variance of the mean over any set S of iterations, 0 to `below` - 1 and those `beyond`
    them, where that of an aligned block of m = 2^i is m^-power, power >= 1.

    Owen's scrambling splits an integrand by binary digits (Owen 1997, section 3; here as in one
    dimension). Part k, of
    variance s_k, has mean zero over aligned blocks of 2^k and larger. Within such a block each
    point of one half has a point in the other half with the opposite value, which of them is
    random; else points are uncorrelated. So the sum over a and b iterations in the halves has the
    variance s_k (a + b - 2 a b / 2^(k - 1)), different blocks are uncorrelated, and

        |S|^2 V(S) = sum over k, over blocks of 2^k, of s_k (a + b - 2 a b / 2^(k - 1)).

    For blocks of 2^i that is V = sum over k > i of s_k / 2^i; hence here sum over k > i of s_k =
    2^(i (1 - power))."""
    count = below + len(beyond)
    end = max(beyond, default=below - 1) + 1
    total, rest = 0.0, 1.0
    for k in range(1, end.bit_length() + 1):
        above = 2.0 ** (k * (1 - power))
        total += (rest - above) * _uncancelled(2 ** (k - 1), below, beyond)
        rest = above
    return (total + rest * count) / count**2


def _uncancelled(half: int, below: int, beyond: Collection[int]) -> float:
    """The sum over blocks of a + b - 2 a b / `half`, with a and b the iterations in each block's
    halves."""
    counts = Counter(iteration // half for iteration in beyond)
    full, more = divmod(below, half)
    counts[full] += more
    if full % 2:  # all blocks before this one are whole, and cancel
        counts[full - 1] = half
    pairs = sum(counts[k] * counts.get(k + 1, 0) for k in counts if k % 2 == 0)
    return sum(counts.values()) - 2 * pairs / half


def contrasts(
    means: np.ndarray, complete: np.ndarray, length: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The lengths m of halves (scales,), their mean contrasts (scales, ...), and of how many pairs
    (scales,), by rising scale.

    `means`: those of consecutive segments of so many iterations (segments, ...), a power of two of
    them, the first of which is aligned; only those that are `complete` (segments,) are looked
    at."""
    lengths, found, counts = [], [], []
    while len(means) > 1:
        complete = complete[0::2] & complete[1::2]
        if not complete.any():
            break
        one, other = means[0::2], means[1::2]
        lengths.append(length)
        found.append(np.square(one - other)[complete].mean(axis=0) / 4)
        counts.append(int(complete.sum()))
        means, length = (one + other) / 2, 2 * length
    return np.array(lengths, float), np.array(found), np.array(counts, float)


def extrapolated(
    lengths: np.ndarray,
    contrast: np.ndarray,
    counts: np.ndarray,
    below: int,
    beyond: Collection[int] = (),
) -> np.ndarray:
    """The variance of the mean over a set of iterations (as of `variance_law`), shape (groups,),
    from the `contrasts` of blocks, (scales, groups).

    It is a V_1 + b V_2, with V_p the law of power p, or where that has a < 0 (the variance falls
    faster than 1/m^2), a V_2 + b V_3. a and b are fitted to contrasts, which are a (m^-p -
    (2 m)^-p) + b (m^-q - (2 m)^-q). a and b may be negative: where they may not, the noise of one
    is a bias of the sum. But the sum is not less than the least that one power alone makes of the
    last contrast. With contrasts at one scale only, power 1 is assumed."""
    block = 2 * lengths[-1]
    scales = (lengths / block)[:, None]

    def basis(power: float) -> np.ndarray:
        return scales**-power - (2 * scales) ** -power

    laws = {p: variance_law(p, below, beyond) * block**p for p in (1.0, 2.0, 3.0)}
    weight = np.sqrt(counts)[:, None]
    size = (weight * contrast / basis(1.0)).sum(axis=0) / weight.sum()
    if len(lengths) == 1:
        return size * laws[1.0]
    d = contrast / np.where(size > 0, size, 1)
    a, b = _fitted(basis(1.0), basis(2.0), d, weight)
    b_steep, c = _fitted(basis(2.0), basis(3.0), d, weight)
    variance = np.where(a < 0, b_steep * laws[2.0] + c * laws[3.0], a * laws[1.0] + b * laws[2.0])
    least = d[-1] * min(law / basis(p)[-1] for p, law in laws.items())
    return size * np.maximum(variance, least)


def variance_by_power(lengths: np.ndarray, contrast: np.ndarray, count: float) -> float:
    """The variance of the mean of `count` iterations, from the `contrasts` of blocks (scales,),
    means over so many pixels that they have next to no noise.

    Up to the longest block V is the sum of contrasts and what is left beyond. There it falls with a
    power of the length, up to `LASTING` blocks: the last two contrasts show one, which sinks
    towards one, and `STEEP_SHARE` tells how far. Both tell where it begins."""
    block, power, last = 2 * lengths[-1], 1.0, contrast[-1]
    if len(contrast) > 1 and last <= 0:
        last = contrast[-2] / 2  # few pixels may show none by chance
    elif len(contrast) > 1 and contrast[-2] > 0:
        shown = np.log2(contrast[-2] / contrast[-1])
        power += STEEP_SHARE * np.clip(shown - 1, 0, MOST_POWER - 1)
        last = np.sqrt(contrast[-1] * contrast[-2] * 2**-power)
    left = last / (2**power - 1)
    if count >= block:
        blocks = count / block
        return float(left * min(blocks, LASTING) ** -power / max(blocks / LASTING, 1))
    variance = left + np.append(np.cumsum(contrast[::-1])[::-1], 0)
    known = np.log(np.maximum(variance, 1e-30))
    return float(np.exp(np.interp(np.log(count), np.log(np.append(lengths, block)), known)))


def _fitted(
    p: np.ndarray, q: np.ndarray, d: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """a and b of a p + b q, each (groups,), fitted to d (scales, groups) by least squares.

    The errors of contrasts are about proportional to what is expected: the weights are by the
    squares of that, as the last fit has it (there without negative a, b), and by `weight`, the
    square roots of how many contrasts there are: few are noisy, but many are far from where it
    matters."""
    expected = p * ((weight * d / p).sum(axis=0) / weight.sum())
    for _ in range(FITS):
        w = weight / np.square(np.maximum(expected, 1e-6 * p))
        pp, qq, pq = ((w * product).sum(axis=0) for product in (p * p, q * q, p * q))
        pd, qd = (w * p * d).sum(axis=0), (w * q * d).sum(axis=0)
        determinant = pp * qq - pq * pq
        a, b = (pd * qq - qd * pq) / determinant, (qd * pp - pd * pq) / determinant
        without_a, without_b = np.where(b < 0, pd / pp, a), np.where(a < 0, qd / qq, b)
        expected = np.where(a < 0, 0, without_a) * p + np.where(b < 0, 0, without_b) * q
    return a, b


def groups_of_alike(values: np.ndarray) -> np.ndarray:
    """A group number for each pixel of (H, W) values: within tiles of about `TILE` pixels squared,
    pixels sorted by value, `GROUP` or somewhat more at a time. So the few pixels at an edge of a
    lamp do not speak for the wall behind it."""
    height, width = values.shape
    down, across = (np.arange(n) * max(1, round(n / TILE)) // n for n in (height, width))
    tile = (down[:, None] * (across[-1] + 1) + across).ravel()
    order = np.lexsort((values.ravel(), tile))
    size = np.bincount(tile)
    rank = np.empty_like(tile)
    rank[order] = np.arange(tile.size) - (np.cumsum(size) - size)[tile[order]]
    groups = np.maximum(1, size // GROUP)
    first = np.cumsum(groups) - groups
    return (first[tile] + rank * groups[tile] // size[tile]).reshape(height, width)


def variance_ratio(
    means: np.ndarray,
    complete: np.ndarray,
    length: int,
    naive: np.ndarray,
    below: int,
    beyond: Sequence[int] = (),
) -> np.ndarray:
    """By what to multiply the `naive` variance of each pixel's mean (H, W), which takes iterations
    for independent: the ratio of extrapolated to naive variance in its group, (H, W), not negative.
    One where there is nothing to tell.

    `means` (segments, H, W): mean over each segment of `length` iterations of the pixel's deviation
    from its mean; `complete` (segments,) says which have all of theirs. The iterations are as of
    `variance_law`."""
    lengths, contrast, counts = contrasts(means, complete, length)
    if not len(lengths):
        return np.ones_like(naive)
    group = groups_of_alike(naive)

    def pooled(values: np.ndarray) -> np.ndarray:
        return np.bincount(group.ravel(), values.ravel())

    variance = extrapolated(
        lengths, np.array([pooled(values) for values in contrast]), counts, below, beyond
    )
    total = pooled(naive)
    known = (variance > 0) & (total > 0)
    most = (below + len(beyond)) * total  # that of a single iteration
    ratio = np.where(known, np.minimum(variance, most) / np.where(known, total, 1), 1.0)
    return ratio[group]
