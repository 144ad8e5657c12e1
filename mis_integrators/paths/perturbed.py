"""Light sub-paths at BSDFs that perturb normals inside themselves (bump and normal maps).

The adjoint factor of shading normals is out of sight there, so smooth scattering is evaluated from
the camera's side. Mitsuba keeps perturbed normals on the viewer's side: where one would face away,
it is turned by half a turn about the shading normal. So what light scatters to directions below
the perturbed horizon has another lobe than what it scatters above: light sub-paths draw from both,
and from the geometric hemisphere, as transmission inside a BSDF may reach what neither does.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.random import next_1d_and_2d, next_2d

TURNED, ASIDE = 0.25, 0.25
"""Structural: shares of the directions drawn from the turned lobe and from the hemisphere."""


def half_turn(direction):
    """A local direction, turned by half a turn about the shading normal."""
    return mi.Vector3f(-direction.x, -direction.y, direction.z)


def seen_from(si, wi):
    """The interaction with another local incident direction."""
    turned = mi.SurfaceInteraction3f(si)
    turned.wi = mi.Vector3f(wi)
    return turned


def smooth_density(bsdf, lit, wo, own, active):
    """Density per solid angle with which `sample_perturbed` scatters light from `lit.wi` smoothly
    into the local direction `wo`, where the BSDF itself does with density `own`."""
    importance = mi.BSDFContext(mi.TransportMode.Importance)
    turned = bsdf.pdf(importance, seen_from(lit, half_turn(lit.wi)), half_turn(wo), active)
    cosine = dr.mulsign(dr.dot(lit.n, lit.to_world(wo)), dr.dot(lit.n, lit.to_world(lit.wi)))
    aside = dr.maximum(cosine, 0) * dr.inv_pi
    return (1 - TURNED - ASIDE) * own + TURNED * turned + ASIDE * aside


def sample_perturbed(bsdf, si, rng, perturbed, active):
    """Samples where light sub-paths go on; on other lanes than `perturbed` as the BSDF itself.

    Returns `(bs, delta, weight)`: Mitsuba's BSDF sample, whether a delta function scattered, and
    the flux's factor, which on the lanes `perturbed` lacks only the ratio of geometric cosines.
    """
    smooth = active & perturbed & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    choice = rng.next_float32(active)
    turned, aside = smooth & (choice < TURNED), smooth & (choice >= 1 - ASIDE)
    importance = mi.BSDFContext(mi.TransportMode.Importance)
    bs, weight = bsdf.sample(
        importance,
        seen_from(si, dr.select(turned, half_turn(si.wi), si.wi)),
        *next_1d_and_2d(rng, active),
        active,
    )
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & ~aside
    facing = mi.Vector3f(dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi))))
    towards = mi.Frame3f(facing).to_world(mi.warp.square_to_cosine_hemisphere(next_2d(rng, active)))
    bs.wo = dr.select(
        aside, si.to_local(towards), dr.select(turned, half_turn(bs.wo), mi.Vector3f(bs.wo))
    )
    bs.eta = dr.select(aside, 1, bs.eta)
    scattered = smooth & ~delta
    response = bsdf.eval(mi.BSDFContext(), seen_from(si, bs.wo), si.wi, scattered)
    own = bsdf.pdf(importance, si, bs.wo, scattered)
    pdf = smooth_density(bsdf, si, bs.wo, own, scattered)
    # A delta event of a BSDF with a smooth part too comes from its own lobe alone.
    chosen = dr.select(smooth, dr.select(turned, 0, 1 / (1 - TURNED - ASIDE)), mi.Float(1))
    special = dr.select(
        delta,
        weight * (chosen * delta_adjoint(si.wi, bs.wo, bs.eta)),
        dr.select(pdf > 1e-9, response / pdf, 0),
    )
    return bs, delta, dr.select(perturbed, special, weight)


def delta_adjoint(wi, wo, eta):
    """Ratio of the cosines of `wi` and `wo` to the normal at which a delta function scattered,
    which a bump or normal map keeps to itself: it lies along wi + eta wo (reflection: eta = 1). One
    where nothing was deflected."""
    half = wi + wo * eta
    ratio = dr.abs(dr.dot(wi, half) / dr.dot(wo, half))
    return dr.select((dr.squared_norm(half) > 1e-6) & dr.isfinite(ratio), ratio, 1)
