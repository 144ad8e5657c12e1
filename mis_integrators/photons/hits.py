"""Lights that camera paths meet by chance behind delta surfaces: each is kept with the last smooth
vertex before, to which photons bring the same light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..core.spectra import channel_mean

SMALLEST_PDF = 1e-30


def meets_one_light(scene):
    """Whether a camera path meets one light at most behind the delta surfaces after a smooth
    vertex: none of these shines itself."""
    return not any(
        shape.is_emitter() and shape.bsdf().flags() & mi.BSDFFlags.Delta for shape in scene.shapes()
    )


def density_ratio(density, cosine, pdf):
    """D cos / p [1/m^2] at a vertex: density per solid angle and area with which a light sub-path
    arrives there, D cos, over that of a camera path's direction, p."""
    return density * cosine * dr.rcp(dr.maximum(pdf, SMALLEST_PDF))


def chance_layout():
    """What a camera vertex keeps of the light that its path has met: radiance, `light`, throughput
    included; its `ratio` as of `density_ratio`; and the `flux` of photons that come from there (for
    one light sub-path, channel mean)."""
    return Layout({"light": mi.Spectrum, "ratio": mi.Float, "flux": mi.Float})


def new_hits(capacity):
    """Room for the hits of so many vertices: none."""
    return dr.zeros(mi.UInt32, chance_layout().words * capacity)


def write_hit(hits, slot, lights, si, ray, light, sent, cosine, pdf, active):
    """Keeps `light` that a `ray` has met at `si` at the places `slot`; `sent`: the radiance of
    photons that come from there, which know nothing of the path's roulette, nor of what media take
    away. The path left its last smooth vertex at `cosine` to the normal, with density `pdf` per
    solid angle."""
    ref = dr.zeros(mi.Interaction3f)
    ref.p, ref.time, ref.wavelengths = ray.o, ray.time, ray.wavelengths
    ds = mi.DirectionSample3f(lights.scene, si, ref)
    density = lights.start_density(ref, ds, active)
    hit = {
        "light": light,
        "ratio": density_ratio(density, cosine, pdf),
        "flux": dr.select(density > 0, channel_mean(sent) * dr.rcp(density), 0),
    }
    chance_layout().write(hits, hit, slot, active)
