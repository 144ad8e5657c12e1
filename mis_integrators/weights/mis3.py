"""Optimal weights of three merging strategies, the closed form: for comparison, renders use `recursion`.

Source: Ershov, Kopylov and Voloboy, Optimal weights for bidirectional ray tracing with photon maps while mixing 3 strategies, Keldysh
Institute preprint 89 (2021), doi 10.20948/prepr-2021-89-e ("MIS-3"), its misprints corrected: the matrix before (38) prints B11
twice, (35) and (36) are garbled. Ill-conditioned for many photons: 1 - n E1 (...) cancels, in single precision hopelessly so.

Photons of three and more segments have the weights w30, w31, w32 at y0, y1, y2; those of two segments w20 at y0, and direct light at y1
has w21. Arrays, NumPy or Dr.Jit (elementwise formulas), of the directions y0 -> z1 and z1 -> z2, per projected solid angle:

    f0, L0, E2   one value a z1: BSDF at y0 [1/sr], direct luminance of z1 [W/(m^2 sr)], throughput E2 = E1 mu_1 of the camera path
    f1, L, b     one value a (z1, z2): BSDF at z1, luminance of z2 (positive), integral of f^2 over its incident indirect radiance
    E1           albedo mu_0 of y0: throughput of the camera path behind it; its densities are p_i = f_i / mu_i
    n            photons per unit of irradiance: merge area times light sub-paths over the light's flux [m^2/W]
    q, c         kernel costs: q = N_B f0 at y0 (one value a z1), c = b/L + n L at y2 (one value a (z1, z2)) [1/sr]

Integrals over z1 or z2 are arguments: `weights` takes the caller's quadratures. One value a z1 meets one a (z1, z2) by broadcasting: the
caller gives it a last axis of length one.
"""

from __future__ import annotations


def first_cost(f0, camera_paths=1):
    """q = N_B f0 (MIS-3)."""
    return camera_paths * f0


def deepest_cost(b, L, n):
    """c = b/L + n L (MIS-3)."""
    return b / L + n * L


def local_direct(q, n, E1, L0):
    """W20 = n E1 L0 / D, W21 = q / D, D = q + n E1 L0 (MIS-3); also D."""
    D = q + n * E1 * L0
    return n * E1 * L0 / D, q / D, D


def matrix_A(q, E1, f1, E2, c):
    """A11 = E1 f1 + q, A12 = q, A22 = E2 c + q and their determinant, without cancellation (MIS-3)."""
    a, d = E1 * f1, E2 * c
    return a + q, q, d + q, a * d + q * (a + d)


def script_integrand(A, det, L, f1):
    """Integrand over z2 of the script A_mn(z1) = integral of (A_mn / det) L f1 dmu2 (MIS-3)."""
    return A / det * L * f1


def matrix_B(n, E1, W20, W21, A11, A12, A22):
    """The matrix before (38), of the script integrals A11, A12, A22 (MIS-3)."""
    return (1 + n * E1 * W21 * (A22 - A12), n * E1 * (A22 * W21 + A12 * W20),
            n * E1 * W21 * (A11 - A12), 1 - n * E1 * (A12 * W21 + A11 * W20))


def solve_h(B11, B12, B21, B22, A11, A12, A22):
    """h = B^-1 (A22 - A12, A11 - A12), script integrals (MIS-3)."""
    x, y, det = A22 - A12, A11 - A12, B11 * B22 - B12 * B21
    return (B22 * x - B12 * y) / det, (B11 * y - B21 * x) / det


def flux_integrands(W21, L0, f0, h):
    """Integrands over z1 of the four integrals in F (MIS-3), h = h1 + h2: W21 L0 f0, W21^2 h f0^2, W21 f0, W21^2 h f0."""
    return W21 * L0 * f0, W21 ** 2 * h * f0 ** 2, W21 * f0, W21 ** 2 * h * f0


def flux(direct, second, first, h_first, n, E1, camera_paths):
    """F = (direct + N_B second) / (first / E1 - n h_first), of the integrals of `flux_integrands` (MIS-3)."""
    return (direct + camera_paths * second) / (first / E1 - n * h_first)


def gathered(q, n, F, W21, h):
    """G_m = (q + n F) W21 h_m: what y_m gathers of the longest family, behind z1 (MIS-3)."""
    return (q + n * F) * W21 * h


def direct_weight(W20, n, E1, G1, G2, F, D):
    """w20 = W20 + n (E1 (G1 + G2) - F) / D (MIS-3); w21 = 1 - w20."""
    return W20 + n * (E1 * (G1 + G2) - F) / D


def longest_weights(A11, A12, A22, det, q, n, E1, W20, W21, F, G1, G2):
    """w31 and w32, (35) and (36) corrected (MIS-3); w30 = 1 - w31 - w32."""
    r = q * W21 + n * W21 * F - n * E1 * W21 * G1
    return (((A22 - A12) * r - n * E1 * G2 * (A22 * W21 + A12 * W20)) / det,
            ((A11 - A12) * r + n * E1 * G2 * (A11 * W20 + A12 * W21)) / det)


def local_longest(W21, q, E1, f1, E2, c):
    """w31 = W21 / (1 + k + E1 f1 / q) and w32 = k w31, k = E1 f1 / (E2 c): without the integrals (MIS-3)."""
    k = E1 * f1 / (E2 * c)
    w31 = W21 / (1 + k + E1 * f1 / q)
    return w31, k * w31


def weights(f0, f1, L0, L, b, E1, E2, n, integrate1, integrate2, camera_paths=1):
    """(w20, w21, w30, w31, w32) of NumPy arrays f0, L0, E2 (n1) and f1, L, b (n1, n2).

    `integrate1`, `integrate2`: sums over the last axis with the quadrature weights dmu1 (n1) and dmu2 (n1, n2).
    """
    q, c = first_cost(f0, camera_paths), deepest_cost(b, L, n)
    W20, W21, D = local_direct(q, n, E1, L0)
    A11, A12, A22, det = matrix_A(q[:, None], E1, f1, E2[:, None], c)
    script = [integrate2(script_integrand(A, det, L, f1)) for A in (A11, A12, A22)]
    h1, h2 = solve_h(*matrix_B(n, E1, W20, W21, *script), *script)
    F = flux(*[integrate1(x) for x in flux_integrands(W21, L0, f0, h1 + h2)], n, E1, camera_paths)
    G1, G2 = gathered(q, n, F, W21, h1), gathered(q, n, F, W21, h2)
    w20 = direct_weight(W20, n, E1, G1, G2, F, D)
    q, W20, W21, G1, G2 = (x[:, None] for x in (q, W20, W21, G1, G2))
    w31, w32 = longest_weights(A11, A12, A22, det, q, n, E1, W20, W21, F, G1, G2)
    return w20, 1 - w20, 1 - w31 - w32, w31, w32
