"""The automatic merge radius: noise against blur, both measured in a short pilot.

A kernel of radius R has a bias that grows with R and a variance that falls with it. A few pilot
iterations gather at a ladder of radii at once, on a subset of the pixels. From them, for each
radius of the ladder,

- the variance of a pixel over iterations, V(R), and
- the squared difference of the expected images at neighbouring radii, Q(R), without bias: products
  of different iterations only.

Neighbours differ by a factor 2. The squared bias follows from Q by its growth R^q: where the bias
is curvature (q = 4) it is 16/9 Q; where it sits in strips of width R along edges, within which the
kernel's disk loses part of its area (q = 1), it is 4.33 Q (`squared_bias_over_difference`). The
error of n iterations is then the squared bias plus V(R) / n, and its minimum is the radius. All in
relative terms, pixel by pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LADDER_STEPS = 7
STEP = 2.0
LARGEST_SHARE = 0.08
"""Largest radius of the ladder in units of the spread of the points where photons are gathered."""
AT_EDGES, BY_CURVATURE = (1, 4.327), (4, 16 / 9)
"""Exponents q of the squared bias and what it is then in units of Q. At an edge a disk whose centre
is u R away loses the share g(u) = (acos u - u sqrt(1 - u^2)) / pi, and the ratio is the integral of
g(u)^2 over that of (g(u) - g(2u))^2."""
LEAST_BIAS, MOST_BIAS = 0.003, 1.0
"""Squared relative bias that disks of the ladder's largest radius can have, however little of it a
short pilot sees. (In Cornell boxes, a corridor, rooms lit through a door or a window it is 0.002 to
0.04.)"""
LEAST_CORRECTED = 1e-4
"""The same where the correction at edges adds what plain estimates lack (1e-4 to 1.6e-3 in Cornell
boxes)."""
UNKNOWN_ERROR = 2
"""A standard error known from n + 1 iterations counts for 1 + UNKNOWN_ERROR / n times what they
say, about as Student's 95 % intervals are wider than normal ones."""
FEW_MET = 64
"""Merge disks that met photons, fewer than which tell nothing of the noise of that radius."""
RARE_PIXELS = 0.001
"""Share of the pixels, the noisiest, without which noise is judged."""
LEAST_NOISE = 0.1
"""Share of the noise of a pilot's pixels that is left, however many camera paths they average: that
of their photons."""
SHARES_STRAY, SHARES_RETURN = 0.3, 0.5
"""The share of what the correction at edges adds that plain estimates do lack: how far it strays
from one radius of the ladder to the next smaller one, and which part of its distance from one,
where small disks have it, it makes up for on the way."""


def ladder(points, weights):
    """Radii to try (ascending, factor 2), from the gather points (3, n) with their path weights
    (n,)."""
    used = points[:, weights > 0]
    if used.shape[1] == 0:
        return None
    low, high = np.percentile(used, [2, 98], axis=1)
    spread = np.linalg.norm(high - low) / 3**0.5
    return max(spread, 1e-6) * LARGEST_SHARE * STEP ** -np.arange(LADDER_STEPS - 1, -1, -1.0)


def middle_index(radii):
    """The place of a middling radius of the ladder: little blur, little noise."""
    return len(radii) * 2 // 3


def relative_weights(mean):
    """Weights 1 / (mean^2 + 0.1 <mean>^2) of squared errors: relative error, without letting dark
    pixels rule. The overall mean <mean> leaves out the brightest tenth (visible lamps, the sky in
    windows)."""
    usual = np.mean(np.minimum(mean, np.quantile(mean, 0.9)))
    return 1 / (mean**2 + 0.1 * usual**2 + 1e-30)


def shrink_to_neighbours(samples, cells):
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


def noise_of_photons(radii, variance, floor, met=None):
    """V(R), no smaller than what larger radii say: the noise of photons falls with the area of the
    disk, above a `floor` that is not theirs. Small disks seldom meet the rare bright photons that
    large ones have seen.

    Where photons are alike, as those of a caustic, `met` says how many disks of each radius met
    any. Then only the next larger radius has a say: what larger disks spill from the caustic onto
    its dark surroundings is far noisier, relative to them, than anything that small disks do. But a
    radius with fewer than `FEW_MET` knows nothing of its noise, and has that of the next larger
    one.
    """
    photons = np.maximum(variance - floor, 0) * radii**2
    if met is None:
        return floor + np.maximum.accumulate(photons[::-1])[::-1] / radii**2
    seen = photons.copy()
    for r in range(len(radii) - 2, -1, -1):
        seen[r] = max(photons[r], photons[r + 1] if met[r] >= FEW_MET else seen[r + 1])
    return floor + seen / radii**2


def expected_products(a, b, weights):
    """Weighted mean over pixels of E[a] E[b], without bias: products of different iterations only.
    `a`, `b`: (iterations, ..., pixels)."""
    m = a.shape[0]
    return np.mean(weights * (a.sum(axis=0) * b.sum(axis=0) - (a * b).sum(axis=0)), axis=-1) / (
        m * (m - 1)
    )


def with_error(a, b, weights):
    """`expected_products` and its standard error, by leaving out one iteration at a time:
    neighbouring pixels share photons."""
    value, m = expected_products(a, b, weights), a.shape[0]
    if m < 3:
        return value, np.abs(value)
    left_out = np.stack(
        [expected_products(np.delete(a, i, 0), np.delete(b, i, 0), weights) for i in range(m)]
    )
    return value, np.sqrt((m - 1) / m * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))


def noise_and_difference(radii, samples, weights, at_first_vertex=True, alike=False):
    """V and Q of the module's docstring, one a radius, with Q's standard error.

    `samples`: (iterations, radii, pixels) gathered values of independent iterations; `weights`:
    (pixels,); `at_first_vertex`: whether all noise is the photons', because the vertices that
    gather are those which the camera sees; `alike`: see `noise_of_photons`.
    """
    variance = np.array([trimmed_mean(values) for values in weights * samples.var(axis=0, ddof=1)])
    met = np.count_nonzero(samples, axis=(0, 2)) if alike else None
    variance = noise_of_photons(radii, variance, 0.0 if at_first_vertex else variance.min(), met)
    steps = np.diff(samples, axis=1)  # (iterations, radii - 1, pixels)
    difference, error = with_error(steps, steps, weights)
    return variance, np.concatenate([[0.0], difference]), np.concatenate([[0.0], error])


def light_lost_at_edges(plain, corrected, weights):
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
    lost, error = with_error(plain[:, :-1] - plain[:, 1:], added[:, 1:], weights)
    expected = np.maximum(expected_products(np.diff(added, axis=1), added[:, 1:], weights), 1e-12)
    error *= 1 + UNKNOWN_ERROR / (len(plain) - 1)
    share, variance = shares_by_step(lost / expected, (error / expected) ** 2)
    step = np.concatenate([[max(squared[0], 1e-12)], expected])
    total = np.cumsum(step)
    return squared, np.cumsum(step * share) / total, np.sqrt(np.cumsum(step**2 * variance)) / total


def shares_by_step(measured, variance):
    """The shares of the ladder's steps from noisy ones, each seen in the light of those of the
    larger steps, and their variances; one value more than is `measured`, for the smallest radius
    itself."""
    shares, variances = [], []
    expected, stray = 1.0, SHARES_STRAY**2
    for value, noise in zip(measured[::-1], variance[::-1]):
        trust = stray / (stray + noise)
        share, left = expected + trust * (value - expected), (1 - trust) * stray
        shares.append(share)
        variances.append(left)
        expected, stray = (
            share + SHARES_RETURN * (1 - share),
            (1 - SHARES_RETURN) ** 2 * left + SHARES_STRAY**2,
        )
    return np.array([expected, *shares[::-1]]), np.array([stray, *variances[::-1]])


def squared_bias_over_difference(exponent):
    """The squared bias at R over the squared difference Q between R and R / 2, where they grow as
    R^exponent: exact for edges and for curvature, geometric between."""
    (low, at_edges), (high, by_curvature) = AT_EDGES, BY_CURVATURE
    return at_edges * (by_curvature / at_edges) ** ((exponent - low) / (high - low))


def expected_squared_bias(radii, difference, error, iterations, wanted, least=LEAST_BIAS):
    """Squared bias at the radii `wanted`, from noisy Q at the ladder: the mean over power laws Q =
    a R^q, each weighted by how well it explains the values (flat in q between 1, edges, and 4,
    curvature, and in the logarithm of the squared bias at the largest radius, `least` or more).

    The `error` of Q is itself estimated from a few `iterations`, and often too small by far:
    misfits follow Student's distribution.
    """
    slopes = np.linspace(AT_EDGES[0], BY_CURVATURE[0], 31)[:, None, None]
    ratio = squared_bias_over_difference(slopes)
    heights = np.geomspace(least, MOST_BIAS, 100)[
        None, :, None
    ]  # squared bias at the largest radius
    law = heights / ratio * (radii[1:] / radii[-1]) ** slopes
    spread = np.hypot(error[1:], 0.15 * law) + 1e-12
    freedom = max(iterations - 1, 1)
    misfit = np.sum(
        (freedom + 1) * np.log1p(((difference[1:] - law) / spread) ** 2 / freedom)
        + 2 * np.log(spread),
        axis=-1,
    )
    weight = np.exp(-0.5 * (misfit - misfit.min()))
    weight /= weight.sum()
    bias = heights * (wanted / radii[-1]) ** slopes
    return np.einsum("qh,qhr->r", weight, bias)


def trimmed_mean(values, rare=RARE_PIXELS, fewest=0):
    """Mean over pixels without the largest `rare` (a share) of them, `fewest` at least: one pixel
    at the edge of a lamp can outweigh all others."""
    kept = np.sort(values)[: max(len(values) - max(round(len(values) * rare), fewest), 1)]
    return float(np.mean(kept))


class RadiusChoice(NamedTuple):
    """A radius, whether to correct estimates at edges, and what to expect then, in relative
    terms."""

    radius: float
    correct: bool
    squared_bias: float
    variance: float
    """Of one iteration."""


class Expected(NamedTuple):
    """What a pilot expects of photons of a kind, in relative terms; by whether estimates are
    corrected at edges."""

    ladder: np.ndarray
    fine: np.ndarray
    """Radii to choose from."""
    squared_bias: dict[bool, np.ndarray]
    """At the fine radii. Empty where no photon was met."""
    variance: dict[bool, np.ndarray]
    """Of an iteration like the pilot's, at the ladder."""


def expect(radii, plain, corrected, mean, at_first_vertex=True, alike=False):
    """The `Expected` squared biases and variances.

    `radii`: the ladder; `plain`, `at_first_vertex`, `alike`: see `noise_and_difference`;
    `corrected`: the same samples corrected at edges, or `None`; `mean`: (pixels,) mean radiance.
    """
    fine = np.exp(np.linspace(np.log(radii[0]), np.log(radii[-1]), 16 * len(radii)))
    if not np.any(plain):
        return Expected(radii, fine, {}, {})
    weights = relative_weights(mean)
    ways, edges, best, least = {False: plain}, {False: 0.0}, plain, LEAST_BIAS
    if corrected is not None:
        added, lacking, pmf_mismatch = light_lost_at_edges(plain, corrected, weights)
        wrong = {False: lacking**2 + pmf_mismatch**2, True: (1 - lacking) ** 2 + pmf_mismatch**2}
        ways, edges = (
            {False: plain, True: corrected},
            {way: between(fine, radii, added * wrong[way]) for way in wrong},
        )
        best = plain + lacking[:, None] * (corrected - plain)
        least *= (LEAST_CORRECTED / LEAST_BIAS) ** min(max(lacking[-1], 0.0), 1.0)
    _, difference, error = noise_and_difference(radii, best, weights, at_first_vertex)
    blur = expected_squared_bias(radii, difference, error, len(plain), fine, least)
    return Expected(
        radii,
        fine,
        {way: blur + edges[way] for way in ways},
        {
            way: noise_and_difference(radii, samples, weights, at_first_vertex, alike)[0]
            for way, samples in ways.items()
        },
    )


def best_radius(expected, iterations, used=None, reluctance=0.0, more_noise=None):
    """The `RadiusChoice` that minimises the predicted relative error; `used`, a radius and whether
    it corrects, if the least error is not below its by more than this share, `reluctance`.

    `expected`: an `Expected`; `iterations(R, corrected)`: how many iterations there will be, so
    that larger gathers and the correction are charged for; `more_noise`: by whether it corrects,
    how much more variance than that of the pilot an iteration has, one a radius (less, if
    negative), because it averages another number of camera paths. Where no photon was met, nothing
    speaks for any radius, and it is a middling one.
    """
    radii, fine = expected.ladder, expected.fine
    choices = []
    for way, bias in expected.squared_bias.items():
        variance = expected.variance[way]
        if more_noise:
            variance = np.maximum(variance + more_noise[way], LEAST_NOISE * variance)
        variance = between(fine, radii, variance)
        predicted = bias + variance / iterations(fine, way)
        at = int(np.argmin(predicted))
        choices.append(
            (
                float(predicted[at]),
                RadiusChoice(float(fine[at]), way, float(bias[at]), float(variance[at])),
            )
        )
        if used is not None and used[1] == way:
            at = int(np.argmin(np.abs(np.log(fine / used[0]))))
            choices.append(
                (
                    float(predicted[at]) * (1 - reluctance),
                    RadiusChoice(used[0], way, float(bias[at]), float(variance[at])),
                )
            )
    return (
        min(choices)[1]
        if choices
        else RadiusChoice(float(radii[middle_index(radii)]), False, 0.0, 0.0)
    )


def between(wanted, radii, values):
    """Values at the radii `wanted`, from those at `radii` by power laws."""
    return np.exp(np.interp(np.log(wanted), np.log(radii), np.log(np.maximum(values, 1e-30))))
