"""Optimal weights for K photon merging strategies, by a recursion of scalars along one path.

Source: this project's own derivation from the noise functional of Ershov, Kopylov and Voloboy
(Keldysh Institute preprint 89, 2021, doi 10.20948/prepr-2021-89-e); the published MIS-2 and MIS-3
are its cases K = 2 and 3.

A joint path has the non-delta vertices z0, z1, ... counted from the camera. Strategy i merges
photons at z_i; direct light at z_j is the last strategy of family j + 1. Every quantity is a scalar
(luminance) per node (z0 ... z_i), any array shape that broadcasts:

    f_i    BSDF value at z_i between z_{i-1} and z_{i+1}, without cosine [1/sr]
    p_i    density of the camera path's next direction at z_i, per projected solid angle [1/sr]
    L0_i   luminance of z_i towards z_{i-1} under direct light; L_i the same under all light
           [W/(m^2 sr)]
    c      b/L at the deepest vertex, b the integral of f^2 over incident indirect radiance [1/sr]
    n      photons per unit of irradiance: merge area times light sub-paths over the light's flux
           [m^2/W]
    N_B    camera paths an iteration that share z0

The derivation's H_i, T_i, kappa_i and d_i enter only by the ratios r_i = H_i / T_i (H_i the cost
that the strategies before z_i would have, T_i the camera path's throughput), theta_i = H_i / (H_i +
kappa_i), and drive_i = d_i / H_i, so that nothing overflows. The path's own quantities go down (r),
the responses eta up, the drives down again, the weights up.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from . import Array

SMALLEST_DENOMINATOR = 1e-30
"""Stands for zero in a divisor: a direction that the camera path cannot take has r = 0."""

LARGEST_RATIO = 1e18
"""Stands for infinity in responses and drives: products of two are still single precision
numbers."""


def at_least(x: Array, low: Array) -> Array:
    """max(x, low) for numbers, NumPy and Dr.Jit arrays."""
    return (
        np.maximum(x, low)
        if isinstance(x, (int, float, np.ndarray, np.generic))
        else dr.maximum(x, low)
    )


def at_most(x: Array, high: Array) -> Array:
    """min(x, high) for numbers, NumPy and Dr.Jit arrays."""
    return (
        np.minimum(x, high)
        if isinstance(x, (int, float, np.ndarray, np.generic))
        else dr.minimum(x, high)
    )


# ---------------------------------------------------------------- down: ratios


def first_ratio(p0: Array, camera_paths: float = 1) -> Array:
    """r_1 = N_B p_0; N_B need not be an integer."""
    return camera_paths * p0


def kernel_share(r: Array, f: Array) -> Array:
    """theta_i = r_i / (r_i + f_i), in [0, 1]: how much of the remaining weight strategies before
    z_i could take cheaply."""
    return r / at_least(r + f, SMALLEST_DENOMINATOR)


def kernel_rest(r: Array, f: Array) -> Array:
    """1 - theta_i = f_i / (r_i + f_i), without cancellation where the BSDF nearly vanishes (f_i <<
    r_i)."""
    return f / at_least(r + f, SMALLEST_DENOMINATOR)


def next_ratio(theta: Array, p: Array) -> Array:
    """r_{i+1} = theta_i p_i."""
    return theta * p


# ---------------------------------------------------------------- up: responses


def deepest_response(n: Array, luminance: Array, c: Array, r: Array) -> Array:
    """gamma_{K-1} = n L / (r_{K-1} + b/L): expected photons over what merging at the deepest vertex
    costs."""
    return n * luminance / at_least(r + c, SMALLEST_DENOMINATOR)


def inner_response(
    n: Array,
    direct: Array,
    r: Array,
    photon_sum: Array,
    second_moment: Array,
    first_moment: Array,
    tau: Array,
) -> Array:
    """gamma_i for 0 < i < K - 1.

    gamma_i = n [L0_i / r_i + photon_sum] + second_moment + tau_i first_moment with photon_sum =
    integral of f_i L_{i+1} / (r_i + f_i) = integral of (1 - theta_i) L_{i+1}, first_moment = <(1 -
    theta_i) eta_{i+1}>, second_moment = <(1 - theta_i)^2 eta_{i+1}>, <.> the mean over the camera
    path's directions at z_i. Local weights leave the three out (zero).
    """
    return (
        n * direct / at_least(r, SMALLEST_DENOMINATOR)
        + n * photon_sum
        + second_moment
        + tau * first_moment
    )


def remainder(gamma: Array) -> Array:
    """e_i = 1 - eta_i = 1 / (1 + gamma_i), in (0, 1]."""
    return 1 / (1 + at_most(gamma, LARGEST_RATIO))


def response(gamma: Array) -> Array:
    """eta_i = gamma_i / (1 + gamma_i), in [0, 1], without cancellation where gamma_i is small."""
    gamma = at_most(gamma, LARGEST_RATIO)
    return gamma / (1 + gamma)


def carry(first_moment: Array, mean_remainder: Array) -> Array:
    """tau_i = <(1 - theta_i) eta_{i+1}> / <e_{i+1}>."""
    return first_moment / at_least(mean_remainder, SMALLEST_DENOMINATOR)


def root_offset(mean_f_eta: Array, mean_remainder: Array) -> Array:
    """n F / N_B = <f_0 eta_1> / <e_1>, the drift of the whole pixel [1/sr]."""
    return mean_f_eta / at_least(mean_remainder, SMALLEST_DENOMINATOR)


# ---------------------------------------------------------------- down: drives


def first_drive(offset: Array, f0: Array) -> Array:
    """drive_1 = d_1 / H_1 = 1 + (n F / N_B) / f_0, where f_0 > 0; grows without bound as f_0 falls:
    what is finite is its product with f_0."""
    return 1 + offset / at_least(f0, SMALLEST_DENOMINATOR)


def next_drive(drive: Array, e: Array, tau: Array, rest: Array) -> Array:
    """drive_{i+1} = (1 + tau_i / (1 - theta_i)) e_i drive_i, rest = 1 - theta_i = `kernel_rest`;
    unbounded as f_i falls, like the first."""
    u = e * drive
    return u + tau * u / at_least(rest, SMALLEST_DENOMINATOR)


def bounded_drive(drive: Array, r: Array) -> Array:
    """drive_i, at most `LARGEST_RATIO`, and 0 where r_i = 0: strategies at z_i and beyond that
    cannot make a path must not share in it.

    A function of the path alone, common to all deeper weights: they still sum to one."""
    return at_most(at_most(drive, LARGEST_RATIO), at_most(r, 1) / SMALLEST_DENOMINATOR)


# ---------------------------------------------------------------- up: weights


def direct_weight(drive: Array, e: Array) -> Array:
    """w_{l, l-1} = e_{l-1} drive_{l-1}: direct light at z_{l-1}, l < K. (At z0, the only strategy:
    one.)"""
    return e * drive


def deepest_weight(drive: Array, e: Array, r: Array, c: Array) -> Array:
    """w_{K, K-1} = e_{K-1} drive_{K-1} r_{K-1} / (r_{K-1} + b/L)."""
    return e * drive * (r / at_least(r + c, SMALLEST_DENOMINATOR))


def inner_weight(drive: Array, e: Array, theta: Array, deeper: Array) -> Array:
    """w_{l, i} = theta_i (e_i drive_i - s) for 0 < i < l - 1, s (`deeper`) the sum of the weights
    w_{l, k}, k > i. For i = 0: 1 - s."""
    return theta * (e * drive - deeper)
