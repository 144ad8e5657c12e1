"""Resampled light sub-paths: their pmf, the variance of the estimate, and weights that know of the
resampling.

Sources: Nabata, Iwasaki and Dobashi, Resampling-aware weighting functions for bidirectional path
tracing using multiple light sub-paths, ACM Transactions on Graphics 39 (2020), doi 10.1145/3338994;
the resampling itself: Popov, Ramamoorthi, Durand and Drettakis, Probabilistic connections for
bidirectional path tracing, Computer Graphics Forum 34 (2015), doi 10.1111/cgf.12680.

M light sub-paths Y_{s,i} of every length s = 1 ... S are traced, and an eye sub-path Z connects to
N of all S M of them, drawn with probabilities proportional to q*(Y Z) / p(Y). Arrays of any shape
that broadcasts, NumPy or Dr.Jit, one element a light sub-path:

    p    density of the light sub-path, product area measure
    q*   target density, not normalised, in the same measure
    r    q*/p
    Q    integral of q* over light sub-paths of all lengths, estimated by (1/M) sum of r over all
         proposals; Q_s: over those of length s
    q    q*/Q, and q_s = q*/Q_s
    g    w f, what the estimate sums up

Densities of whole paths overflow; what the renderer needs are the ratio q/p = r/Q = M P_r and the
share Q_s/Q, which do not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from . import Array
from .recursion import LARGEST_RATIO, SMALLEST_DENOMINATOR, at_least, at_most

# ---------------------------------------------------------------- the draw


def proposal_weight(q_star: Array, p: Array) -> Array:
    """r = q*/p, zero for what cannot be proposed (p = 0)."""
    return at_most(q_star / at_least(p, SMALLEST_DENOMINATOR), LARGEST_RATIO) * (p > 0)


def safe_share(total: Array, uniform: Array) -> Array:
    """Share of the uniform pmf in the mixture: `uniform`, but all of it where nothing is worth
    drawing (`total` = 0)."""
    return uniform + (1 - uniform) * (total <= SMALLEST_DENOMINATOR)


def pmf(r: Array, total: Array, count: Array, uniform: Array = 0.0) -> Array:
    """P_r = r / sum_s sum_i r, mixed with a share `uniform` of the uniform pmf over all `count`
    proposals; only that if the sum is zero.

    Without a uniform share a proposal that the cached pmf gives nothing, though it contributes,
    would be lost."""
    share = safe_share(total, uniform)
    return (1 - share) * (r / at_least(total, SMALLEST_DENOMINATOR)) + share / count


def density_ratio(probability: Array, M: int) -> Array:
    """q/p = r/Q = M P_r, of a proposal drawn with `probability`."""
    return M * probability


def estimate(g: Array, p: Array, probability: Array, M: int) -> Array:
    """What one of the N drawn proposals says: g / (M p P_r); I is the mean over the draws (and over
    p(Z))."""
    return g / at_least(M * p * probability, SMALLEST_DENOMINATOR)


# ---------------------------------------------------------------- the weights


def bracket(share: Array, M: int) -> Array:
    """1 - Q_s / (M Q), of share = Q_s/Q: the chance to draw another sub-path than the one at hand.
    Never negative, whatever rounding or estimates of Q and Q_s make of it."""
    return at_least(1 - share / M, 0)


def gain(ratio: Array, share: Array, M: int, N: int = 1) -> Array:
    """p_t / p = 1 / (1/M + (1 - Q_s/(M Q)) / (N q/p)): how many times better than one connection to
    a light sub-path of its own.

    `ratio` = q/p and `share` = Q_s/Q. From zero (never drawn) to M (always drawn). M = 1 and a
    uniform pmf over S lengths give 1/S."""
    x = at_most(ratio, LARGEST_RATIO) * (N / M)
    return M * (x / at_least(x + bracket(share, M), SMALLEST_DENOMINATOR))


def cache_point_probability(neighbors: int) -> float:
    """P_c = 1/(N_c + 1): the N_c nearest cache points and the virtual one, whose pmf is uniform,
    are chosen alike (section 5.2)."""
    return 1 / (neighbors + 1)


def uniform_density_ratio(ends: Array) -> Array:
    """q/p of the virtual cache point: M P_r = 1/ends, where a light sub-path has `ends` vertices on
    average."""
    return 1 / at_least(ends, SMALLEST_DENOMINATOR)


def resampled_density(p: Array, q: Array, share: Array, M: int, N: int = 1) -> Array:
    """p_t = (1/(M p) + (1 - Q_s/(M Q)) / (N q))^-1 for t in Lambda_RIS (the paper prints N = 1)."""
    return p * gain(proposal_weight(q, p), share, M, N)


def technique_weights(densities: Sequence[Array], counts: Sequence[Array]) -> list[Array]:
    """w_t = n_t p_t / sum_i n_i p_i, a list. n_t = 1 for t in Lambda_RIS, N_t samples for t in
    Lambda_IS; zero for a path without techniques."""
    parts = [n * density for n, density in zip(counts, densities)]
    total = at_least(sum(parts), SMALLEST_DENOMINATOR)
    return [part / total for part in parts]


# ---------------------------------------------------------------- the noise


def sample_variance(g: Array, p: Array, integrate: Callable[[Array], Array]) -> Array:
    """V[g/p] = integral of g^2/p - (integral of g)^2: one sample of density p. `integrate`: the
    caller's sum over the sub-paths."""
    return integrate(g * g / p) - integrate(g) ** 2


def estimate_variance(
    g: Sequence[Array],
    p: Sequence[Array],
    q_star: Sequence[Array],
    M: int,
    N: int,
    integrate: Callable[[Array], Array] = sum,
) -> Array:
    """V[I | Z] = (1/M) sum_s V[g/p] - (1/(M N)) sum_s V[g/q_s] + (1/N) V[g/q], exact if the
    proposals are independent.

    `g`, `p`, `q_star`: lists with an array of sub-paths for each length; q_star > 0 wherever g is
    not zero. Q and Q_s are the exact integrals here. p(Z) = 1; else the variance is to be divided
    by its square.
    """
    Q_s = [integrate(x) for x in q_star]
    Q = sum(Q_s)
    proposals = sum(sample_variance(a, b, integrate) for a, b in zip(g, p))
    within = sum(sample_variance(a, c / norm, integrate) for a, c, norm in zip(g, q_star, Q_s))
    over_all = (
        sum(integrate(a * a / (c / Q)) for a, c in zip(g, q_star))
        - sum(integrate(a) for a in g) ** 2
    )
    return proposals / M - within / (M * N) + over_all / N


def second_moment(
    g: Sequence[Array],
    p: Sequence[Array],
    q_star: Sequence[Array],
    M: int,
    N: int,
    integrate: Callable[[Array], Array] = sum,
) -> Array:
    """sum_s integral of g^2 / p_t: the part of the variance that is quadratic in each value of g;
    what the weights minimise, summed over t."""
    Q_s = [integrate(x) for x in q_star]
    Q = sum(Q_s)
    return sum(
        integrate(a * a / resampled_density(b, c / Q, norm / Q, M, N))
        for a, b, c, norm in zip(g, p, q_star, Q_s)
    )


def variance_over_camera_paths(
    conditional: Array, expected: Array, p_camera: Array, integrate: Callable[[Array], Array] = sum
) -> Array:
    """V[I] = E_Z[V[I | Z]] + V_Z[E[I | Z]] (equations 29 to 32): integral of V[I | Z]/p(Z), and the
    variance of one camera sub-path's E[I | Z] = (integral of g)/p(Z).

    `conditional`: `estimate_variance`, for p(Z) = 1, of each camera sub-path; `expected`: the sum
    over s of the integral of g there; `p_camera`: its density.
    """
    return integrate(conditional / p_camera) + sample_variance(expected, p_camera, integrate)
