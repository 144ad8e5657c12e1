"""What a medium does at a point and on the way to a light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean

FAINT = 0.05
"""Tuned: transmittance below which the estimate on the way to a light plays roulette."""


def point_in(medium, p, time, wavelengths):
    """A `MediumInteraction3f` at `p`, for the evaluation of coefficients."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.time, mei.wavelengths, mei.medium = p, time, wavelengths, medium
    mei.wi, mei.sh_frame = mi.Vector3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    return mei


def section(medium, ray, active):
    """Where the medium's constant majorant begins and ends on a ray, and the majorant: `(near, far,
    majorant)`, zero where there is none."""
    inside, near, far = medium.intersect_aabb(ray)
    majorant = dr.max(
        medium.get_majorant(point_in(medium, ray.o, ray.time, ray.wavelengths), active)
    )
    near, far = dr.maximum(near, 0), dr.minimum(far, ray.maxt)
    inside &= active & (far > near) & (majorant > 0)
    return dr.select(inside, near, 0), dr.select(inside, far, 0), dr.select(inside, majorant, 0)


def collision(medium, p, majorant, time, wavelengths, active):
    """At a tentative collision: `(null, real, probability)`, the spectra that a null collision and
    a scattering multiply throughput with, and the probability of the former. With the probability's
    mean over the spectrum, one density serves all channels (prbvolpath does the same)."""
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(
        point_in(medium, p, time, wavelengths), active
    )
    share = sigma_t * dr.rcp(dr.maximum(majorant, 1e-30))
    probability = dr.clip(1 - channel_mean(share), 0, 1)
    null = dr.select(probability > 0, (1 - share) * dr.rcp(dr.maximum(probability, 1e-30)), 0)
    total = channel_mean(sigma_t)
    return null, dr.select(total > 0, sigma_s * dr.rcp(dr.maximum(total, 1e-30)), 0), probability


@dr.syntax
def transmittance(scene, traits, ray, medium, rng, active):
    """Share of light that gets along `ray` (to its `maxt`) through media and null boundaries: exact
    in homogeneous media, in others estimated without bias by ratio tracking (Novak et al. 2014),
    with roulette once it is faint. Returns it and the advanced `rng`."""
    rng = mi.PCG32(rng)
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    active = mi.Bool(active)
    value = dr.select(active, mi.Spectrum(1), mi.Spectrum(0))
    surface = dr.zeros(mi.SurfaceInteraction3f)
    fresh = mi.Bool(True)  # the next surface is not known yet
    while dr.hint(active, label="transmittance"):
        look = active & fresh
        surface[look] = scene.ray_intersect(ray, traits.boundary_flags, False, look)
        fresh = mi.Bool(False)
        inside = active & (medium != None)  # noqa: E711 (array comparison)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, surface.t)
        near, far, majorant = section(medium, stretch, inside)
        collided = mi.Bool(False)
        t = mi.Float(far)
        if dr.hint(traits.has_grids, mode="scalar"):
            grid = inside & (majorant > 0) & ~medium.is_homogeneous()
            t[grid] = near - dr.log(1 - rng.next_float32(grid)) * dr.rcp(
                dr.maximum(majorant, 1e-30)
            )
            collided = grid & (t < far)
            null, _, probability = collision(
                medium, ray(t), majorant, ray.time, ray.wavelengths, collided
            )
            value[collided] = value * null * probability
            faint = collided & (dr.max(value) < FAINT)
            survives = rng.next_float32(faint) < 0.5
            value[faint] = dr.select(survives, 2 * value, 0)
            inside &= ~grid
        _, _, sigma_t = medium.get_scattering_coefficients(
            point_in(medium, ray.o, ray.time, ray.wavelengths), inside
        )
        value[inside] = value * dr.exp(-sigma_t * (far - near))

        met = active & ~collided & surface.is_valid() & (surface.t <= ray.maxt)
        value[met] = value * surface.bsdf().eval_null_transmission(surface, met)
        medium[met & surface.is_medium_transition()] = surface.target_medium(ray.d)
        step = dr.select(collided, t, surface.t)
        onward = surface.spawn_ray(ray.d)
        ray.maxt = ray.maxt - step
        ray.o = dr.select(collided, ray.o + ray.d * step, onward.o)
        surface.t = surface.t - step
        fresh |= met
        active &= (collided | met) & (dr.max(value) > 0) & (ray.maxt > 0)
    return value, rng
