"""Statistical comparison of renders at a stated false-alarm rate, and with a stated power.

A render is a sequence of independent *batches* (iterations of a session, or renders under different
seeds). From each batch come the means over the whole image and over its blocks; from those, means
and standard errors. Two renders are compared by Welch's t test for each block and each channel, and
for the whole image, against a threshold that is corrected for the number of tests (Sidak).

False alarms: `FALSE_ALARM` = 1e-6 a comparison. The suite makes fewer than 1000 comparisons, so a
correct program turns it red with a probability below 1e-3; as all seeds are fixed, it does so
always or never.

Power: `assert_same` refuses to judge with too few samples. It demands that an error of 1 % of the
energy of the whole image, or of 3 % in a block of it, would be seen with a probability of 0.95
(`smallest_visible`); `collect_until` renders until that holds. `test_comparing.py` shows it by
injecting such errors.

(This module is not called `statistics`: pytest puts the folder of the tests first on the import
path.)
"""

from __future__ import annotations

import functools
import math
import os
from dataclasses import dataclass
from statistics import NormalDist

from mis_integrators.analysis.confidence import t_quantile
from mis_integrators.core.clock import watched_kernels

import drjit as dr
import mitsuba as mi
import numpy as np

FALSE_ALARM = 1e-6
POWER = 0.95
WHOLE, BLOCK = 0.01, 0.03
"""Relative errors that a comparison must see, over the whole image and in a block."""


# --- Distributions (no SciPy) -------------------------------------------------


def chi2_tail(x: float, freedom: int) -> float:
    """Probability that a chi-square variable exceeds `x` (upward recurrence of the incomplete gamma
    function)."""
    half, y = freedom / 2, x / 2
    order, tail = (1.0, math.exp(-y)) if freedom % 2 == 0 else (0.5, math.erfc(math.sqrt(y)))
    while order < half - 0.25:
        tail += math.exp(order * math.log(y) - y - math.lgamma(order + 1)) if y > 0 else 0.0
        order += 1
    return tail


def assert_frequencies(observed, expected, false_alarm=FALSE_ALARM):
    """Chi-square test of counts against expected counts; cells that expect fewer than 10 are
    pooled."""
    observed, expected = np.ravel(observed).astype(float), np.ravel(expected).astype(float)
    small = expected < 10
    if small.any():
        observed = np.append(observed[~small], observed[small].sum())
        expected = np.append(expected[~small], expected[small].sum())
    if expected[-1] < 10:
        observed, expected = (np.append(v[:-2], v[-2:].sum()) for v in (observed, expected))
    assert len(expected) > 2, "too few cells"
    chi2 = float(np.sum((observed - expected) ** 2 / expected))
    p = chi2_tail(chi2, len(expected) - 1)
    assert p > false_alarm, (
        f"chi-square {chi2:.1f} on {len(expected) - 1} degrees of freedom (p = {p:.1e})"
    )


def sidak(false_alarm: float, tests: int) -> float:
    """False-alarm rate of each of `tests` tests that together have `false_alarm`."""
    return -math.expm1(math.log1p(-false_alarm) / tests)


# --- Batches ------------------------------------------------------------------


def block_means(image: np.ndarray, blocks: int) -> np.ndarray:
    """(blocks^2 + 1, channels): means of the whole image, then of `blocks` x `blocks` blocks, row
    by row."""
    height, width, channels = image.shape
    assert height % blocks == 0 and width % blocks == 0
    tiles = (
        image.astype(np.float64)
        .reshape(blocks, height // blocks, blocks, width // blocks, channels)
        .mean(axis=(1, 3))
    )
    return np.concatenate([tiles.mean(axis=(0, 1))[None], tiles.reshape(-1, channels)])


@dataclass
class Estimate:
    """Means, squared standard errors and degrees of freedom of the regions of an image
    (`block_means`)."""

    mean: np.ndarray
    error2: np.ndarray
    freedom: float

    @staticmethod
    def of(batches) -> Estimate:
        batches = np.asarray(batches)
        n = len(batches)
        assert n >= 8, "too few batches for a standard error"
        assert np.isfinite(batches).all(), "not finite"
        return Estimate(batches.mean(axis=0), batches.var(axis=0, ddof=1) / n, n - 1)

    @staticmethod
    def exact(value) -> Estimate:
        """A closed-form answer: no error."""
        value = np.asarray(value, dtype=float)
        return Estimate(value, np.zeros_like(value), math.inf)

    def __mul__(self, factor):
        """The estimate times a number, or times one number a region (to inject an error)."""
        factor = np.asarray(factor, dtype=float)
        factor = factor[:, None] if factor.ndim == 1 else factor
        return Estimate(self.mean * factor, self.error2 * factor**2, self.freedom)


def _spread(a: Estimate, b: Estimate):
    """Standard error of the difference and Welch's degrees of freedom, per region and channel."""
    error2 = a.error2 + b.error2
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = sum(e.error2**2 / e.freedom for e in (a, b))
        freedom = np.where(terms > 0, error2**2 / terms, 1e9)
    return np.sqrt(error2), np.clip(freedom, 1, 1e9)


def _thresholds(freedom, tail):
    """Critical values of t; degrees of freedom are rounded down, to two digits."""
    step = 10 ** np.maximum(np.floor(np.log10(freedom)) - 1, 0)
    freedom, place = np.unique(np.floor(freedom / step) * step, return_inverse=True)
    return np.array([t_quantile(tail, f) for f in freedom.tolist()])[place.reshape(step.shape)]


def smallest_visible(a: Estimate, b: Estimate, false_alarm=FALSE_ALARM) -> np.ndarray:
    """Relative error in each region that a comparison sees with probability `POWER` (grey: mean of
    the channels)."""
    a, b = _with_grey(a), _with_grey(b)
    error, freedom = _spread(a, b)
    t = _thresholds(freedom, sidak(false_alarm, error.size))
    return ((t + NormalDist().inv_cdf(POWER)) * error / np.maximum(np.abs(b.mean), 1e-30))[:, -1]


def _with_grey(e: Estimate) -> Estimate:
    """Appends the channels' mean as a channel (errors added as if fully correlated: never too
    small)."""
    if e.mean.shape[1] == 1:
        return e
    grey = np.mean(np.sqrt(e.error2), axis=1, keepdims=True) ** 2
    return Estimate(
        np.hstack([e.mean, e.mean.mean(axis=1, keepdims=True)]),
        np.hstack([e.error2, grey]),
        e.freedom,
    )


def differences(a: Estimate, b: Estimate, false_alarm=FALSE_ALARM, slack=1e-5) -> list[str]:
    """What differs significantly, and by more than `slack` relatively, between two estimates, in
    words."""
    a, b = _with_grey(a), _with_grey(b)
    error, freedom = _spread(a, b)
    limit = (
        _thresholds(freedom, sidak(false_alarm, error.size)) * error + slack * np.abs(b.mean) + 1e-9
    )
    found = []
    for region, channel in np.argwhere(~(np.abs(a.mean - b.mean) <= limit)):
        place = "whole image" if region == 0 else f"block {region - 1}"
        ratio = (
            a.mean[region, channel] / b.mean[region, channel]
            if b.mean[region, channel]
            else math.inf
        )
        sigmas = abs(a.mean[region, channel] - b.mean[region, channel]) / max(
            error[region, channel], 1e-30
        )
        found.append(
            f"{place}, channel {channel}: "
            f"{a.mean[region, channel]:.5g} against {b.mean[region, channel]:.5g} "
            f"(ratio {ratio:.4f}, {sigmas:.1f} standard errors)"
        )
    return found


def assert_powerful(a: Estimate, b: Estimate, whole=WHOLE, block=BLOCK):
    """Fails if the comparison would miss an error of `whole` in the image or of `block` in a
    block."""
    visible = smallest_visible(a, b)
    assert visible[0] <= whole, f"test too weak: sees {visible[0]:.2%} of the whole image"
    assert (visible[1:] <= block).all(), f"test too weak: sees {visible[1:].max():.2%} of a block"


def assert_same(a: Estimate, b: Estimate, whole=WHOLE, block=BLOCK, slack=1e-5):
    """Fails if the two differ, or if the test could not have seen an error of `whole` or `block`
    (see the module's text)."""
    found = differences(a, b, slack=slack)
    assert not found, "\n".join(found[:12])
    assert_powerful(a, b, whole, block)


# --- Renders ------------------------------------------------------------------


def in_one_thread(function):
    """The function, for which Dr.Jit has one thread in each of the processes of pytest-xdist. There
    is one a core: more threads would wait for one another, a third of the processor time of many
    small renders. (Not for tests to which the order of threads could make a difference.)"""

    @functools.wraps(function)
    def run(*args, **kwargs):
        if "PYTEST_XDIST_WORKER" not in os.environ:
            return function(*args, **kwargs)
        usual = dr.thread_count()
        dr.sync_thread()
        dr.set_thread_count(1)
        try:
            return function(*args, **kwargs)
        finally:
            dr.sync_thread()
            dr.set_thread_count(usual)

    return run


def render_batches(
    integrator, scene, count: int, blocks: int, spp: int = 16, first_seed: int = 0, sensor=0
):
    """Region means of `count` independent renders."""
    return [
        block_means(
            _colour(
                np.array(
                    mi.render(
                        scene, integrator=integrator, sensor=sensor, seed=first_seed + i, spp=spp
                    )
                )
            ),
            blocks,
        )
        for i in range(count)
    ]


def _colour(image):
    return (
        image[:, :, None] if image.ndim == 2 else image[:, :, :3] if image.shape[2] > 3 else image
    )


def pictures(session, count):
    """Yields what each of the next `count` iterations of a session renders by itself, (H, W,
    channels); the session shows the mean of all."""
    before = session.iterations * session.image().astype(np.float64) if session.iterations else 0.0
    for _ in range(count):
        session.iterate()
        total = session.iterations * session.image().astype(np.float64)
        yield total - before
        before = total


def grey_pictures(session, count):
    """`pictures`, mean over the colours: (count, H, W)."""
    return np.array([picture[..., :3].mean(axis=2) for picture in pictures(session, count)])


def _launched(run):
    """The history's entries of the kernels that `run()` launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), watched_kernels() as kernels:
        run()
    return [kernel for kernel in kernels if kernel["type"] == dr.KernelType.JIT]


def kernels_of(run, operations=0):
    """Hashes of the kernels, of more than so many operations, that `run()` launches."""
    return {kernel["hash"] for kernel in _launched(run) if kernel["operation_count"] > operations}


def kernel_sources(run):
    """The code, in LLVM's language, of the kernels that `run()` launches."""
    return [kernel["ir"].getvalue() for kernel in _launched(run)]


class SessionBatches:
    """Region means of the iterations of a session. With the sampler `independent` they are
    independent (`test_bdpm.py` checks it); with `sobol` the standard error of their mean is smaller
    than `Estimate` says, so that differences are found later and false alarms are rarer."""

    def __init__(self, integrator, scene, blocks: int, seed: int = 1, sensor=0):
        self.session = integrator.session(scene, sensor, seed=seed, spp=0)
        self.blocks, self.batches = blocks, []

    def add(self, count: int):
        self.batches += [
            block_means(_colour(picture), self.blocks) for picture in pictures(self.session, count)
        ]

    def estimate(self) -> Estimate:
        return Estimate.of(self.batches)


class PathBatches:
    """Region means of independent renders by one of Mitsuba's own integrators."""

    def __init__(
        self, integrator, scene, blocks: int, spp: int = 64, first_seed: int = 1000, sensor=0
    ):
        self.integrator, self.scene, self.blocks, self.spp, self.sensor = (
            integrator,
            scene,
            blocks,
            spp,
            sensor,
        )
        self.first_seed, self.batches = first_seed, []

    def add(self, count: int):
        seed = self.first_seed + len(self.batches)
        self.batches += render_batches(
            self.integrator, self.scene, count, self.blocks, self.spp, seed, self.sensor
        )

    def estimate(self) -> Estimate:
        return Estimate.of(self.batches)


@in_one_thread
def collect_until(a, b, whole=WHOLE, block=BLOCK, start=16, most=1024):
    """Adds batches to whichever of the two is noisier until the comparison has the power that
    `assert_same` demands.

    The rule looks at standard errors only, never at the difference, so the false-alarm rate stays
    what it is.
    """
    for side in (a, b):
        if not isinstance(side, Estimate):
            side.add(start)
    while True:
        estimates = [side if isinstance(side, Estimate) else side.estimate() for side in (a, b)]
        visible = smallest_visible(*estimates)
        need = max(visible[0] / whole, visible[1:].max(initial=0) / block)
        if need <= 0.97:
            return estimates
        worst = (
            0
            if visible[0] / whole >= visible[1:].max(initial=0) / block
            else 1 + int(visible[1:].argmax())
        )
        shares = [e.error2[worst].mean() for e in estimates]
        grown = False
        for side, share in zip((a, b), shares):
            if (
                not isinstance(side, Estimate)
                and share > 0.3 * sum(shares)
                and len(side.batches) < most
            ):
                count = len(side.batches)
                side.add(
                    int(min(max(count * (min(need, 2.0) ** 2 - 1), count / 4, 4), most - count))
                )
                grown = True
        if not grown:
            return estimates


def agree(integrator, oracle, scene, blocks=3, whole=WHOLE, block=BLOCK, spp=64, seed=1, most=1024):
    """Renders a scene by a `bdpm` integrator and by an oracle until the test is powerful, and
    asserts that they agree."""
    a, b = SessionBatches(integrator, scene, blocks, seed), PathBatches(oracle, scene, blocks, spp)
    with dr.suspend_grad():
        estimates = collect_until(a, b, whole, block, most=most)
        assert estimates[1].mean[0].max() > 0, "the oracle's image is black: nothing is compared"
        assert_same(*estimates, whole, block)


def extrapolate(radii, estimates) -> Estimate:
    """Estimate at radius 0: weighted least squares of mean = a + b R^2 (the bias of a disk kernel
    is even in R)."""
    radii2 = np.asarray(radii, dtype=float) ** 2
    mean = np.stack([e.mean for e in estimates])
    weight = 1 / np.maximum(np.stack([e.error2 for e in estimates]), 1e-30)
    x = radii2.reshape((-1,) + (1,) * (mean.ndim - 1))
    s, sx, sxx = weight.sum(0), (weight * x).sum(0), (weight * x * x).sum(0)
    det = s * sxx - sx**2
    value = (sxx * (weight * mean).sum(0) - sx * (weight * x * mean).sum(0)) / det
    return Estimate(value, sxx / det, min(e.freedom for e in estimates))


def stratified_directions(n, seed=3):
    """n x n directions all around, one in each of as many parts of equal size."""
    rng = np.random.default_rng(seed)
    u = (np.stack(np.meshgrid(range(n), range(n))).reshape(2, -1) + rng.random((2, n * n))) / n
    return mi.warp.square_to_uniform_sphere(mi.Point2f(u.astype(np.float32)))


def mean_and_error(values):
    """The mean of independent values, and its standard error."""
    return values.mean(), values.std() / np.sqrt(len(values))
