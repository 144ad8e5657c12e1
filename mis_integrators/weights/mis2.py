"""Optimal weights of two merging strategies, the closed form as it is printed: `bdpm_opt`
renders with it where its weights are `published`, else with `recursion`.

Source: Ershov and Voloboy, Calculation of MIS weights for bidirectional path tracing with photon
maps in presence of direct illumination, Mathematica Montisnigri 48 (2020), doi
10.20948/mathmontis-2020-48-8 ("MIS-2").

Photons merge at y_M with the weight w0 or at y_{M+1} with the weight w1, functions of the direction
y_M -> y_{M+1}. Direct light always has the weight one. Arrays of one shape, one element a
direction, NumPy or Dr.Jit:

    f, p   BSDF value (no cosine) and camera path's density of the direction at y_M,
           per projected solid angle [1/sr]
    L      luminance of y_{M+1} towards y_M, indirect light included [W/(m^2 sr)]; positive
    b      integral of f^2 over the indirect radiance incident at y_{M+1} [W/(m^2 sr^2)]
    n      photons per unit of irradiance: merge area times light sub-paths over the light's
           flux [m^2/W]

Integrals over the directions, projected solid angle, are arguments: `weights` takes the caller's
quadrature.
"""

from __future__ import annotations

from collections.abc import Callable

from . import Array


def shared_density(p: Array, camera_paths: int = 1, M: int = 0) -> Array:
    """g = p_M, or N_B p_0 for M = 0, whose vertex all N_B camera paths share [1/sr] (MIS-2)."""
    return p if M > 0 else camera_paths * p


def denominator(g: Array, n: Array, b: Array, L: Array) -> Array:
    """alpha = g/n + b/(n L) + L (MIS-2)."""
    return g / n + b / (n * L) + L


def local_weight(g: Array, n: Array, alpha: Array) -> Array:
    """W1 = g / (n alpha): w1 without the integrals (MIS-2)."""
    return g / (n * alpha)


def light_integrand(W1: Array, f: Array, L: Array) -> Array:
    """Integrand of A2 = integral of W1 f L dmu (MIS-2)."""
    return W1 * f * L


def loss_integrand(p: Array, L: Array, alpha: Array) -> Array:
    """Integrand of n B2 = integral of p L / alpha dmu, below one (MIS-2)."""
    return p * (L / alpha)


def deeper_weight(W1: Array, p: Array, f: Array, alpha: Array, A2: Array, nB2: Array) -> Array:
    """w1 = W1 + (p/f) A2 / (alpha (1 - n B2)) (MIS-2); w0 = 1 - w1."""
    return W1 + p / f * A2 / (alpha * (1 - nB2))


def weights(
    f: Array,
    p: Array,
    L: Array,
    b: Array,
    n: Array,
    integrate: Callable[[Array], Array],
    camera_paths: int = 1,
    M: int = 0,
) -> tuple[Array, Array]:
    """(w0, w1); `integrate`: the sum of an array with the directions' quadrature weights dmu."""
    g = shared_density(p, camera_paths, M)
    alpha = denominator(g, n, b, L)
    W1 = local_weight(g, n, alpha)
    w1 = deeper_weight(
        W1,
        p,
        f,
        alpha,
        integrate(light_integrand(W1, f, L)),
        integrate(loss_integrand(p, L, alpha)),
    )
    return 1 - w1, w1
