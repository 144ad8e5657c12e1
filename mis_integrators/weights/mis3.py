"""Optimal weights of three merging strategies, the closed form as it is printed: `bdpm_opt`
renders with it where its weights are `published`, else with `recursion`.

Source: Ershov, Kopylov and Voloboy, Optimal weights for bidirectional ray tracing with photon maps
while mixing 3 strategies, Keldysh Institute preprint 89 (2021), doi 10.20948/prepr-2021-89-e
("MIS-3"), its misprints corrected: the matrix before (38) prints B11 twice, (35) and (36) are
garbled. Ill-conditioned for many photons: 1 - n E1 (...) cancels, in single precision hopelessly
so.

Photons of three and more segments have the weights w30, w31, w32 at y0, y1, y2; those of two
segments w20 at y0, and direct light at y1 has w21. Arrays, NumPy or Dr.Jit (elementwise formulas),
of the directions y0 -> z1 and z1 -> z2, per projected solid angle:

    f0, L0, E2   one value a z1: BSDF at y0 [1/sr], direct luminance of z1 [W/(m^2 sr)],
                 throughput E2 = E1 mu_1 of the camera path
    f1, L, b     one value a (z1, z2): BSDF at z1, luminance of z2 (positive), integral of f^2
                 over its incident indirect radiance
    E1           albedo mu_0 of y0: throughput of the camera path behind it; its densities are
                 p_i = f_i / mu_i
    n            photons per unit of irradiance: merge area times light sub-paths over the
                 light's flux [m^2/W]
    q, c         kernel costs: q = N_B f0 at y0 (one value a z1), c = b/L + n L at y2
                 (one value a (z1, z2)) [1/sr]

Integrals over z1 or z2 are arguments: `weights` takes the caller's quadratures. One value a z1
meets one a (z1, z2) by broadcasting: the caller gives it a last axis of length one.
"""

from __future__ import annotations

from collections.abc import Callable

from . import Array


def first_cost(f0: Array, camera_paths: int = 1) -> Array:
    """q = N_B f0 (MIS-3)."""
    return camera_paths * f0


def deepest_cost(b: Array, L: Array, n: Array) -> Array:
    """c = b/L + n L (MIS-3)."""
    return b / L + n * L


def local_direct(q: Array, n: Array, E1: Array, L0: Array) -> tuple[Array, Array, Array]:
    """W20 = n E1 L0 / D, W21 = q / D, D = q + n E1 L0 (MIS-3); also D."""
    D = q + n * E1 * L0
    return n * E1 * L0 / D, q / D, D


def matrix_A(
    q: Array, E1: Array, f1: Array, E2: Array, c: Array
) -> tuple[Array, Array, Array, Array]:
    """A11 = E1 f1 + q, A12 = q, A22 = E2 c + q and their determinant, without cancellation
    (MIS-3)."""
    a, d = E1 * f1, E2 * c
    return a + q, q, d + q, a * d + q * (a + d)


def script_integrand(A: Array, det: Array, L: Array, f1: Array) -> Array:
    """Integrand over z2 of the script A_mn(z1) = integral of (A_mn / det) L f1 dmu2 (MIS-3)."""
    return A / det * L * f1


def matrix_B(
    n: Array, E1: Array, W20: Array, W21: Array, A11: Array, A12: Array, A22: Array
) -> tuple[Array, Array, Array, Array]:
    """The matrix before (38), of the script integrals A11, A12, A22 (MIS-3)."""
    return (
        1 + n * E1 * W21 * (A22 - A12),
        n * E1 * (A22 * W21 + A12 * W20),
        n * E1 * W21 * (A11 - A12),
        1 - n * E1 * (A12 * W21 + A11 * W20),
    )


def solve_h(
    B11: Array, B12: Array, B21: Array, B22: Array, A11: Array, A12: Array, A22: Array
) -> tuple[Array, Array]:
    """h = B^-1 (A22 - A12, A11 - A12), script integrals (MIS-3)."""
    x, y, det = A22 - A12, A11 - A12, B11 * B22 - B12 * B21
    return (B22 * x - B12 * y) / det, (B11 * y - B21 * x) / det


def flux_integrands(
    W21: Array, L0: Array, f0: Array, h: Array
) -> tuple[Array, Array, Array, Array]:
    """Integrands over z1 of the four integrals in F (MIS-3), h = h1 + h2: W21 L0 f0, W21^2 h f0^2,
    W21 f0, W21^2 h f0."""
    return W21 * L0 * f0, W21**2 * h * f0**2, W21 * f0, W21**2 * h * f0


def flux(
    direct: Array,
    second: Array,
    first: Array,
    h_first: Array,
    n: Array,
    E1: Array,
    camera_paths: int,
) -> Array:
    """F = (direct + N_B second) / (first / E1 - n h_first), of the integrals of `flux_integrands`
    (MIS-3)."""
    return (direct + camera_paths * second) / (first / E1 - n * h_first)


def gathered(q: Array, n: Array, F: Array, W21: Array, h: Array) -> Array:
    """G_m = (q + n F) W21 h_m: what y_m gathers of the longest family, behind z1 (MIS-3)."""
    return (q + n * F) * W21 * h


def direct_weight(
    W20: Array, n: Array, E1: Array, G1: Array, G2: Array, F: Array, D: Array
) -> Array:
    """w20 = W20 + n (E1 (G1 + G2) - F) / D (MIS-3); w21 = 1 - w20."""
    return W20 + n * (E1 * (G1 + G2) - F) / D


def longest_weights(
    A11: Array,
    A12: Array,
    A22: Array,
    det: Array,
    q: Array,
    n: Array,
    E1: Array,
    W20: Array,
    W21: Array,
    F: Array,
    G1: Array,
    G2: Array,
) -> tuple[Array, Array]:
    """w31 and w32, (35) and (36) corrected (MIS-3); w30 = 1 - w31 - w32."""
    r = q * W21 + n * W21 * F - n * E1 * W21 * G1
    return (
        ((A22 - A12) * r - n * E1 * G2 * (A22 * W21 + A12 * W20)) / det,
        ((A11 - A12) * r + n * E1 * G2 * (A11 * W20 + A12 * W21)) / det,
    )


def local_longest(
    W21: Array, q: Array, E1: Array, f1: Array, E2: Array, c: Array
) -> tuple[Array, Array]:
    """w31 = W21 / (1 + k + E1 f1 / q) and w32 = k w31, k = E1 f1 / (E2 c): without the integrals
    (MIS-3)."""
    k = E1 * f1 / (E2 * c)
    w31 = W21 / (1 + k + E1 * f1 / q)
    return w31, k * w31


def weights(
    f0: Array,
    f1: Array,
    L0: Array,
    L: Array,
    b: Array,
    E1: Array,
    E2: Array,
    n: Array,
    integrate1: Callable[[Array], Array],
    integrate2: Callable[[Array], Array],
    camera_paths: int = 1,
) -> tuple[Array, Array, Array, Array, Array]:
    """(w20, w21, w30, w31, w32) of NumPy arrays f0, L0, E2 (n1) and f1, L, b (n1, n2).

    `integrate1`, `integrate2`: sums over the last axis with the quadrature weights dmu1 (n1) and
    dmu2 (n1, n2).
    """
    q, c = first_cost(f0, camera_paths), deepest_cost(b, L, n)
    W20, W21, D = local_direct(q, n, E1, L0)
    A11, A12, A22, det = matrix_A(q[:, None], E1, f1, E2[:, None], c)
    script = [integrate2(script_integrand(A, det, L, f1)) for A in (A11, A12, A22)]
    h1, h2 = solve_h(*matrix_B(n, E1, W20, W21, *script), *script)
    direct, second, first, h_first = (integrate1(x) for x in flux_integrands(W21, L0, f0, h1 + h2))
    F = flux(direct, second, first, h_first, n, E1, camera_paths)
    G1, G2 = gathered(q, n, F, W21, h1), gathered(q, n, F, W21, h2)
    w20 = direct_weight(W20, n, E1, G1, G2, F, D)
    q, W20, W21, G1, G2 = (x[:, None] for x in (q, W20, W21, G1, G2))
    w31, w32 = longest_weights(A11, A12, A22, det, q, n, E1, W20, W21, F, G1, G2)
    return w20, 1 - w20, 1 - w31 - w32, w31, w32
