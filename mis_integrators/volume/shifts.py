"""Shifts of interactions along one segment to another: where on the target segment an interaction
of the base segment goes.

Source: Fraboni, Webanck, Bonneel, Iehl, Volumetric Multi-View Rendering (Computer Graphics Forum
2022), supplemental document: shifts by raw depth, by majorant optical depth and by primary sample,
each as a copy (earlier work) or as a stretch (theirs).

A segment crosses sections [tmin_k, tmax_k] of constant majorant mu_k, in order and without overlap,
with nothing between them. Symbols: distance t [m], length in media l(t) [m], majorant optical depth
tau(t), primary sample u(t) = 1 - exp(-tau(t)); a prime marks the target.

A shift S moves t to t' and has the derivative |S'| = dt'/dt = (dtau'/dtau) mu_k / mu'_k'. Delta
tracking places interactions as a Poisson process of unit rate in tau, so it is dtau'/dtau that
weights need; it is returned as a logarithm, for it spans more than single precision.

Everything works on NumPy arrays and on Dr.Jit arrays of any float type, element by element. The
inverse of a shift is the same shift with base and target exchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

Array = Any
"""A NumPy or Dr.Jit array of floats or booleans, or a number."""
LOWEST = -1e30
"""Stands for the logarithm of zero."""


@dataclass
class Sections:
    """S sections of a segment, each a list of S arrays of one width: where they start and end [m],
    and their majorants [1/m].

    Sections without majorant or of no length count as empty space.
    """

    tmin: list = field(default_factory=list)
    tmax: list = field(default_factory=list)
    majorant: list = field(default_factory=list)

    def __iter__(self) -> Iterator[tuple[Array, Array, Array]]:
        return iter(zip(self.tmin, self.tmax, self.majorant))


@dataclass
class Shifted:
    """A shifted interaction: distance `t` on the target, its majorant optical depth `tau` there,
    `log_rate` = ln dtau'/dtau, `jacobian` = dt'/dt (capped where it exceeds exp(80)), and whether
    there is such an interaction at all (elsewhere the numbers are finite and mean nothing)."""

    t: Any
    tau: Any
    log_rate: Any
    jacobian: Any
    valid: Any


# --- Elementary functions on either kind of array -------------------------------------------------


def _is_numpy(x: Array) -> bool:
    return isinstance(x, (int, float, bool, np.ndarray, np.generic))


def _where(condition: Array, a: Array, b: Array) -> Array:
    return np.where(condition, a, b) if _is_numpy(condition) else dr.select(condition, a, b)


def _least(a: Array, b: Array) -> Array:
    return np.minimum(a, b) if _is_numpy(a) and _is_numpy(b) else dr.minimum(a, b)


def _most(a: Array, b: Array) -> Array:
    return np.maximum(a, b) if _is_numpy(a) and _is_numpy(b) else dr.maximum(a, b)


def _exp(x: Array) -> Array:
    """exp(x), of which exp(80) is the largest value: single precision ends soon after."""
    x = _most(_least(x, 80.0), -600.0)
    return np.exp(x) if _is_numpy(x) else dr.exp(x)


def _log(x: Array) -> Array:
    """ln x, `LOWEST` for x <= 0."""
    positive = x > 0
    x = _where(positive, x, 1.0)
    return _where(positive, np.log(x) if _is_numpy(x) else dr.log(x), LOWEST)


def one_minus_exp(x: Array) -> Array:
    """1 - exp(-x) for x >= 0, without cancellation for small x."""
    if _is_numpy(x):
        return -np.expm1(-x)
    series = 1 - x / 9
    for n in range(8, 1, -1):
        series = 1 - x / n * series
    return dr.select(x < 0.5, x * series, 1 - dr.exp(-x))


def minus_log_one_minus(u: Array) -> Array:
    """-ln(1 - u) for 0 <= u <= 1/2, without cancellation for small u."""
    if _is_numpy(u):
        return -np.log1p(-u)
    z = u / (2 - u)
    z2 = z * z
    series = 1.0 / 15
    for n in range(13, 0, -2):
        series = 1.0 / n + z2 * series
    return 2 * z * series


def _log_sum(a: Array, b: Array) -> Array:
    """ln(exp(a) + exp(b))."""
    larger, gap = _most(a, b), _most(_least(a, b) - _most(a, b), -100.0)
    return larger + (np.log1p(np.exp(gap)) if _is_numpy(gap) else dr.log(1 + dr.exp(gap)))


# --- A segment's scales ---------------------------------------------------------------------------


def _inside(t: Array, tmin: Array, tmax: Array) -> Array:
    """Length of [tmin, tmax] that lies before t."""
    return _most(_least(t, tmax) - tmin, 0.0)


def length(sections: Sections, t: Array) -> Array:
    """Length in media before t: l(t)."""
    return sum((_where(mu > 0, _inside(t, tmin, tmax), 0.0) for tmin, tmax, mu in sections), 0 * t)


def optical_depth(sections: Sections, t: Array) -> Array:
    """Majorant optical depth before t: tau(t) = sum of mu_k max(0, min(t, tmax_k) - tmin_k)."""
    return sum((mu * _inside(t, tmin, tmax) for tmin, tmax, mu in sections), 0 * t)


def total_length(sections: Sections) -> Array:
    """l_max."""
    return sum(_where(mu > 0, _most(tmax - tmin, 0.0), 0.0) for tmin, tmax, mu in sections)


def total_optical_depth(sections: Sections) -> Array:
    """tau_max."""
    return sum(mu * _most(tmax - tmin, 0.0) for tmin, tmax, mu in sections)


def majorant_at(sections: Sections, t: Array) -> Array:
    """Majorant at t, zero outside the sections."""
    value = 0 * t
    for tmin, tmax, mu in sections:
        value = _where((t >= tmin) & (t <= tmax) & (tmax > tmin) & (mu > 0), mu, value)
    return value


def _invert(sections: Sections, x: Array, density: Callable[[Array], Array]) -> tuple[Array, Array]:
    """t and majorant where the cumulated `density` of the sections reaches x > 0; x beyond the
    total gives the last section's end."""
    t, majorant, before = 0 * x, 0 * x, 0 * x
    for tmin, tmax, mu in sections:
        rho = density(mu)
        here = (mu > 0) & (tmax > tmin) & ((x > before) | (majorant == 0))
        at = tmin + _most(x - before, 0.0) / _where(mu > 0, rho, 1.0)
        t, majorant = _where(here, _most(_least(at, tmax), tmin), t), _where(here, mu, majorant)
        before = before + _where(mu > 0, rho * _most(tmax - tmin, 0.0), 0.0)
    return t, majorant


def at_length(sections: Sections, length: Array) -> tuple[Array, Array]:
    """Where the length in media reaches a value: t and the majorant there."""
    return _invert(sections, length, lambda mu: 1.0 + 0 * mu)


def at_optical_depth(sections: Sections, tau: Array) -> tuple[Array, Array]:
    """Where the majorant optical depth reaches tau: t and the majorant there."""
    return _invert(sections, tau, lambda mu: mu)


def _result(
    base: Sections,
    t: Array,
    target_t: Array,
    target_majorant: Array,
    tau: Array,
    log_rate: Array,
    valid: Array,
) -> Array:
    majorant = majorant_at(base, t)
    valid = valid & (majorant > 0) & (target_majorant > 0)
    jacobian = _exp(log_rate) * _where(
        valid, majorant / _where(target_majorant > 0, target_majorant, 1.0), 0.0
    )
    return Shifted(target_t, tau, log_rate, jacobian, valid)


def _ratio(a: Array, b: Array) -> Array:
    return a / _where(b > 0, b, 1.0)


# --- Stretches: both ends stay where they are -----------------------------------------------------


def raw_depth(base: Sections, target: Sections, t: Array) -> Shifted:
    """l'(t') = C l(t), C = l'max / lmax; dt'/dt = C. Keeps the base segment's distribution."""
    C = _ratio(total_length(target), total_length(base))
    at, majorant = at_length(target, C * length(base, t))
    return _result(
        base,
        t,
        at,
        majorant,
        optical_depth(target, at),
        _log(C * _ratio(majorant, majorant_at(base, t))),
        (total_length(base) > 0) & (total_length(target) > 0),
    )


def majorant_optical_depth(base: Sections, target: Sections, t: Array) -> Shifted:
    """tau'(t') = C tau(t), C = tau'max / taumax; dt'/dt = C mu_k / mu'_k'. Piecewise constant
    derivative: the default."""
    C = _ratio(total_optical_depth(target), total_optical_depth(base))
    tau = C * optical_depth(base, t)
    at, majorant = at_optical_depth(target, tau)
    return _result(
        base,
        t,
        at,
        majorant,
        tau,
        _log(C) + 0 * tau,
        (total_optical_depth(base) > 0) & (total_optical_depth(target) > 0),
    )


def primary_sample(base: Sections, target: Sections, t: Array) -> Shifted:
    """u'(t') = C u(t), C = u'max / umax; dt'/dt = (mu_k / mu'_k') C exp(-tau) / exp(-tau'). Follows
    the target's majorant density.

    With exp(-tau') = [exp(-tau)(1 - exp(tau - taumax)) + exp(-tau'max)(1 - exp(-tau))] / (1 -
    exp(-taumax)), whose terms are positive and are summed as logarithms, thick media neither
    overflow nor cancel; while u' is small, tau' = -ln(1 - u') is the better form.
    """
    end, target_end = total_optical_depth(base), total_optical_depth(target)
    tau = _least(optical_depth(base, t), end)
    log_C = _log(one_minus_exp(target_end)) - _log(one_minus_exp(end))
    log_transmittance = _log_sum(
        _log(one_minus_exp(end - tau)) - tau, _log(one_minus_exp(tau)) - target_end
    ) - _log(one_minus_exp(end))
    u = _exp(_least(log_C, 80.0)) * one_minus_exp(tau)
    target_tau = _where(u < 0.5, minus_log_one_minus(_least(u, 0.5)), -log_transmittance)
    target_tau = _most(_least(target_tau, target_end), 0.0)
    at, majorant = at_optical_depth(target, target_tau)
    return _result(
        base, t, at, majorant, target_tau, log_C + target_tau - tau, (end > 0) & (target_end > 0)
    )


# --- Copies: earlier work, for comparison ---------------------------------------------------------


def raw_depth_copy(base: Sections, target: Sections, t: Array) -> Shifted:
    """t' = t; dt'/dt = 1. Lost where the target has no medium at t."""
    majorant = majorant_at(target, t)
    return _result(
        base,
        t,
        t,
        majorant,
        optical_depth(target, t),
        _log(_ratio(majorant, majorant_at(base, t))),
        majorant > 0,
    )


def majorant_optical_depth_copy(base: Sections, target: Sections, t: Array) -> Shifted:
    """tau' = tau; dt'/dt = mu_k / mu'_k'. Lost where the target is thinner than tau."""
    tau = optical_depth(base, t)
    at, majorant = at_optical_depth(target, tau)
    return _result(base, t, at, majorant, tau, 0 * tau, tau <= total_optical_depth(target))


def primary_sample_copy(base: Sections, target: Sections, t: Array) -> Shifted:
    """u' = u, and so tau' = tau, for u is a function of tau that all segments share."""
    return majorant_optical_depth_copy(base, target, t)


SHIFTS = {
    shift.__name__: shift
    for shift in (
        majorant_optical_depth,
        raw_depth,
        primary_sample,
        majorant_optical_depth_copy,
        raw_depth_copy,
        primary_sample_copy,
    )
}
"""By name, as the parameter `shift` of `volpath_multiview` has them."""
