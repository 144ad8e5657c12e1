"""Veach's heuristics for bidirectional path tracing, and for vertex connection and merging, from
two running numbers a sub-path.

Sources: Veach, Robust Monte Carlo methods for light transport simulation, PhD thesis (1997),
chapter 10 and equations (9.8), (9.13); Georgiev, Implementing vertex connection and merging,
technical report, Saarland University (2012), whose recursive quantities (equations 31 to 36) these
are, in another unit and with the exponent taken out.

A joint path x_0 ... x_k runs from a light to the sensor. Technique s connects x_{s-1}, the end of a
light sub-path, with x_s. Between neighbours

    p_{s+1} / p_s = p>(x_s) / p<(x_s)

all cancels but the area densities of x_s from the light's side, p>, and from the sensor's, p<; each
is a density P per projected solid angle times the geometric term G = |cos cos| / d^2 of the segment
just made. Seen from the end of a sub-path, all techniques that join nearer to its start are summed
up in one number

    S_i = p<(x_i) A_i,    A_i = d_vcm_i + P'(x_i) d_vc_i  [+ eta]

where p<(x_i) [1/m^2] is the density with which the other side makes x_i, P' [1/sr] that with which
it goes on from there, and

    d_vcm_i = 1 / p>(x_i), or zero where x_{i-1} cannot be joined to x_i [m^2]
    d_vc_i  = A_{i-1} / P(x_{i-1}) [m^2 sr]; beyond a delta surface, whose two densities cancel,
              d_vc_{i-1}

are what a sub-path carries along (dVCM and dVC there). `eta` [m^2] is the merging technique's pi
R^2 N at x_i itself (zero without merging). The sub-paths' first vertices have densities of their
own (`light_start`, `camera_start`). With the exponent beta, sums are beta-norms, so that no number
is ever squared while it has a unit.

All arrays broadcast; NumPy and Dr.Jit alike.
"""

from __future__ import annotations

from . import Array
from .heuristics import bounded_power
from .recursion import at_least, at_most

SMALLEST_DENSITY = 1e-20
"""Stands for densities that vanish."""
LARGEST_RATIO = 1e15
"""Bound on what a sub-path carries along."""


def norm(a: Array, b: Array, beta: float) -> Array:
    """(a^beta + b^beta)^(1/beta) of non-negative numbers."""
    if beta == 1:
        return a + b
    larger = at_least(at_least(a, b), SMALLEST_DENSITY)
    a, b = a / larger, b / larger
    if beta == 2:
        return larger * (a * a + b * b) ** 0.5
    return larger * (a**beta + b**beta) ** (1 / beta)


def reciprocal(density: Array) -> Array:
    """1 / density, bounded where the density vanishes."""
    return at_most(1 / at_least(density, SMALLEST_DENSITY), LARGEST_RATIO)


def nearer(d_vcm: Array, d_vc: Array, p_back: Array, beta: float, eta: Array = 0.0) -> Array:
    """A_i = d_vcm_i + P' d_vc_i + eta (the brackets of equations 40 and 41): all techniques nearer
    to the sub-path's start than the one that joins x_i with the other side, over p<(x_i). `p_back`:
    P', the other side's density at x_i for the direction to x_{i-1}."""
    inner = norm(d_vcm, at_most(p_back * d_vc, LARGEST_RATIO), beta)
    return inner if isinstance(eta, float) and eta == 0 else norm(inner, eta, beta)


def d_vcm_of(p_forward: Array, geometry: Array) -> Array:
    """d_vcm_i = 1 / (P(x_{i-1}) G) (equation 34): x_i was sampled from x_{i-1} with density
    `p_forward`, over a segment with G = `geometry`. To be replaced by zero where x_{i-1} scattered
    by a delta function."""
    return reciprocal(p_forward * geometry)


def d_vc_of(a: Array, p_forward: Array) -> Array:
    """d_vc_{i+1} = A_i / P(x_i) (equation 35), where `a` is A_i and x_i scattered with density
    `p_forward`; beyond a delta surface d_vc stays what it was (equation 35 with both densities
    cancelled)."""
    return at_most(a * reciprocal(p_forward), LARGEST_RATIO)


def light_start(emission: Array, direct: Array) -> tuple[Array, Array]:
    """(d_vcm_1, d_vc_1) of the vertex that a light sub-path meets first (equations 31 and 32).

    `emission` [1/m^2]: area density at the vertex with which light sub-paths start, over that of
    next-event estimation for the light's point (which is technique s = 1). `direct` [1/sr]: the
    latter density, per projected solid angle at the vertex; what it divides is technique s = 0.
    Where the light cannot be met d_vc_1 is to be replaced by zero, where next-event estimation does
    not work both are."""
    d_vcm = reciprocal(emission)
    return d_vcm, at_most(d_vcm * reciprocal(direct), LARGEST_RATIO)


def camera_start(density: Array, ratio: Array) -> Array:
    """d_vcm_1 of the vertex that a camera sub-path meets first (equation 31); d_vc_1 is zero, for
    no technique hits the lens.

    `density` [1/m^2]: area density there of camera rays through the whole film; `ratio`: light
    sub-paths over camera paths, both of all the film. To be replaced by zero where the vertex
    cannot be joined to the sensor."""
    return at_most(ratio * reciprocal(density), LARGEST_RATIO)


def connection(
    p_to_light_end: Array, a_light: Array, p_to_camera_end: Array, a_camera: Array, beta: float
) -> Array:
    """Weight of joining two sub-paths' ends (equations 37, 40 and 41), from both ends' A and the
    area densities with which each is made from the other end. For next-event estimation (44, 45)
    `p_to_light_end` is that of BSDF sampling over its own, `a_light` one; for joining to the sensor
    (46, 47) a_camera is zero and `p_to_light_end` the area density of camera paths there over
    `ratio` of `camera_start`."""
    return 1 / (
        1
        + bounded_power(p_to_light_end * a_light, beta)
        + bounded_power(p_to_camera_end * a_camera, beta)
    )


def hit_emitter(
    direct_over_sampled: Array, emission_density: Array, d_vc: Array, beta: float
) -> Array:
    """Weight of emission that a camera path meets (equations 42 and 43), technique s = 0.

    `direct_over_sampled`: density of next-event estimation for this point over the density with
    which the path was sampled there, zero where it cannot work from the vertex before;
    `emission_density`: density of next-event estimation per solid angle there times `emission` of
    `light_start` over the cosine at the vertex before; `d_vc`: of the emitter's point."""
    return 1 / (
        1
        + bounded_power(
            norm(
                at_most(direct_over_sampled, LARGEST_RATIO),
                at_most(emission_density * d_vc, LARGEST_RATIO),
                beta,
            ),
            beta,
        )
    )


def merge_weight(a_light: Array, a_camera: Array, eta: Array, beta: float) -> Array:
    """Weight of merging two sub-paths that end in one disk (equations 38 and 39): their A without
    `eta`, over it."""
    return 1 / (1 + bounded_power(a_light / eta, beta) + bounded_power(a_camera / eta, beta))
