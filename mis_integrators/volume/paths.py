"""Volumetric path tracing from a vertex on: radiance that arrives along a ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.power_heuristic import mis_power
from ..core.random import next_1d_and_2d
from ..paths.media import collision, point_in, sample_direction, section, transmittance
from ..paths.roulette import russian_roulette


@dr.syntax
def direct_light(scene, lights, traits, it, medium, transition, surface, draws, rng, active):
    """Next-event estimation at interaction `it`, in `medium` or where `transition` between the
    media of `surface`, with the random numbers `draws` and, on the way, those of `rng`: `(ds,
    light, pdf, rng)`, the light's radiance over its density, attenuated on the way, and the
    advanced generator."""
    rng = mi.PCG32(rng)
    ds, light, pdf = lights.propose_direct(it, draws, active)
    lit = active & (dr.max(light) > 0)
    medium = mi.MediumPtr(medium)
    medium[lit & transition] = surface.target_medium(ds.d)
    kept, rng = transmittance(
        scene, traits, lights.shadow_ray(it, ds, traits.has_infinite_lights), medium, rng, lit
    )
    return ds, dr.select(lit, light * kept, 0), pdf, rng


@dr.syntax
def incident_radiance(
    scene,
    lights,
    traits,
    ray,
    medium,
    origin,
    scatter_pdf,
    specular,
    throughput,
    strength,
    depth,
    numbers,
    first_event,
    rng,
    max_depth: int,
    rr_depth: int,
    active,
):
    """Throughput times the radiance that arrives at `ray.o` along `ray`, by null-scattering path
    tracing with next-event estimation.

    `origin` is the interaction that the ray leaves, `scatter_pdf` the density of its direction
    (unless `specular`), `depth` the number of scattering vertices so far with that one, `strength`
    a factor by which roulette takes the throughput for larger than it is.

    What is met, a scattering or a surface, is an event; the first has the number `first_event`.
    An event, and the flight towards it up to the first tentative collision, draw the path's
    `numbers` (`PathNumbers`), all other collisions those of `rng`.
    """
    ray = mi.Ray3f(ray)
    rng = mi.PCG32(rng)
    medium = mi.MediumPtr(medium)
    origin = mi.Interaction3f(origin)
    scatter_pdf = mi.Float(scatter_pdf)
    specular = mi.Bool(specular)
    throughput = mi.Spectrum(throughput)
    depth = mi.UInt32(depth)
    event = mi.UInt32(first_event)
    active = mi.Bool(active)
    radiance = mi.Spectrum(0)
    eta = mi.Float(1)
    surface = dr.zeros(mi.SurfaceInteraction3f)
    fresh = mi.Bool(True)  # the next surface is not known yet
    context = mi.BSDFContext()
    phase_context = mi.PhaseFunctionContext(None)

    while dr.hint(active, label="volumetric paths"):
        look = active & fresh
        surface[look] = scene.ray_intersect(ray, mi.RayFlags.All, False, look)
        fresh = mi.Bool(False)
        draws = numbers.at(event)

        # ---- Free flight
        inside = active & (medium != None)  # noqa: E711 (array comparison)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, surface.t)
        near, far, majorant = section(medium, stretch, inside)
        later = inside & ~look
        flight = dr.select(look, draws.next_float32(), rng.next_float32(later))
        t = near - dr.log(1 - flight) * dr.rcp(dr.maximum(majorant, 1e-30))
        collided = inside & (majorant > 0) & (t < far)
        p = ray(t)
        null, real, probability = collision(
            medium, p, majorant, ray.time, ray.wavelengths, collided, -ray.d, throughput
        )
        chance = dr.select(look, draws.next_float32(), rng.next_float32(collided & ~look))
        passes = collided & (chance < probability)
        scatters = collided & ~passes
        throughput = dr.select(
            passes, throughput * null, dr.select(scatters, throughput * real, throughput)
        )
        met = active & ~collided

        # ---- Emission
        ds = mi.DirectionSample3f(scene, surface, origin)
        shines = met & (ds.emitter != None)  # noqa: E711
        light_pdf = lights.pdf_direct(origin, ds, shines & ~specular)
        share = dr.select(specular, 1, mis_power(scatter_pdf, light_pdf))
        radiance[shines] += throughput * share * ds.emitter.eval(surface, shines)
        met &= surface.is_valid()

        # ---- Direct light
        bsdf = surface.bsdf(ray)
        within = dr.select(scatters, medium, dr.zeros(mi.MediumPtr))
        mei = point_in(within, p, ray.time, ray.wavelengths, -ray.d)
        phase = within.phase_function()
        lit = scatters | (met & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
        if dr.hint(max_depth > 0, mode="scalar"):
            lit &= depth + 1 < max_depth
            scatters &= depth + 1 < max_depth
        here = dr.select(met, mi.Interaction3f(surface), mi.Interaction3f(mei))
        reference = dr.zeros(mi.Interaction3f)
        reference[active] = here
        if dr.hint(not lights.dark, mode="scalar"):
            ds, light, pdf = lights.propose_direct(reference, draws, lit)
            on_surface, in_medium = lit & met, lit & ~met
            response, response_pdf = bsdf.eval_pdf(
                context, surface, surface.to_local(ds.d), on_surface
            )
            scattered, scattered_pdf = phase.eval_pdf(phase_context, mei, ds.d, in_medium)
            response = dr.select(met, response, scattered)
            response_pdf = dr.select(met, response_pdf, scattered_pdf)
            gain = (
                throughput * light * response * dr.select(ds.delta, 1, mis_power(pdf, response_pdf))
            )
            lit &= dr.max(gain) > 0
            beyond = mi.MediumPtr(medium)
            beyond[on_surface & surface.is_medium_transition()] = surface.target_medium(ds.d)
            shadow = lights.shadow_ray(reference, ds, traits.has_infinite_lights)
            kept, rng = transmittance(scene, traits, shadow, beyond, rng, lit)
            radiance[lit] += gain * kept

        # ---- Scattering in a medium
        choice, point = next_1d_and_2d(draws)
        wo, phase_weight, phase_pdf = sample_direction(traits, mei, choice, point, scatters)
        scatters &= phase_pdf > 0

        # ---- Scattering at a surface
        bs, weight = bsdf.sample(context, surface, choice, point, met)
        met &= dr.max(weight) > 0
        crosses = met & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        bounces = met & ~crosses
        delta = bounces & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)

        # ---- Go on
        vertex = scatters | bounces
        throughput = dr.select(
            met, throughput * weight, dr.select(scatters, throughput * phase_weight, throughput)
        )
        eta[met] = eta * bs.eta
        direction = dr.select(met, surface.to_world(bs.wo), dr.select(scatters, wo, ray.d))
        onward = surface.spawn_ray(direction)
        ray.o = dr.select(met, onward.o, dr.select(collided, p, ray.o))
        ray.d = direction
        ray.maxt = dr.select(vertex | crosses, dr.largest(mi.Float), ray.maxt)
        surface.t[passes] = surface.t - t
        fresh |= vertex | crosses
        origin[vertex] = reference
        scatter_pdf[vertex] = dr.select(scatters, phase_pdf, bs.pdf)
        specular[vertex] = delta
        depth[vertex] += 1
        event[vertex | crosses] += 1
        medium[met & surface.is_medium_transition()] = surface.target_medium(ray.d)
        active &= passes | vertex | crosses
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth < max_depth
        begun = vertex & (depth >= rr_depth)
        throughput, active = russian_roulette(
            draws, throughput, dr.max(throughput) * strength, eta, begun, active
        )
    return radiance
