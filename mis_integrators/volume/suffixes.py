"""The rest of a path from its pivot on, sampled once for all views that see the pivot."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.power_heuristic import mis_power
from ..core.random import next_1d_and_2d, streams
from ..paths.media import point_in, sample_direction
from .paths import direct_light, incident_radiance
from .pivots import IN_MEDIUM, LATER, NOWHERE, ON_SURFACE, OWN, PIVOT, pivot_surface

SUFFIX_SALT = 0x73756666


def scattering(pivot, surface, d, wo, active):
    """BSDF with cosine, or phase function, and the density of its sampling, for light from `wo` to
    a view in direction `d`."""
    on_surface = active & (pivot["kind"] == ON_SURFACE)
    in_medium = active & (pivot["kind"] == IN_MEDIUM)
    seen = mi.SurfaceInteraction3f(surface)
    seen.wi = surface.to_local(d)
    value, pdf = surface.bsdf().eval_pdf(mi.BSDFContext(), seen, surface.to_local(wo), on_surface)
    mei = point_in(pivot["medium"], pivot["p"], pivot["time"], pivot["wavelengths"], d)
    phase = dr.select(in_medium, pivot["medium"], dr.zeros(mi.MediumPtr)).phase_function()
    phase_value, phase_pdf = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, wo, in_medium)
    return dr.select(on_surface, value, phase_value), dr.select(on_surface, pdf, phase_pdf)


def sample_scattering(pivot, surface, d, traits, draws, active):
    """A direction for the path to go on, by the smooth scattering towards `d`, or on a path's `OWN`
    branch by the delta functions there.

    Returns `(wo, weight, taken)`; `weight` (value over density) is that of the delta functions, and
    `taken` is false where the sample fell on the other kind. Smooth samples are drawn with all
    components enabled: only then do Mitsuba's densities fit (3.9.1: `mask` and `blendbsdf` do not
    heed the component mask in both).
    """
    on_surface = active & (pivot["kind"] == ON_SURFACE)
    in_medium = active & (pivot["kind"] == IN_MEDIUM)
    own = on_surface & (pivot["branch"] == OWN)
    seen = mi.SurfaceInteraction3f(surface)
    seen.wi = surface.to_local(d)
    choice, point = next_1d_and_2d(draws)
    bs, weight = surface.bsdf().sample(mi.BSDFContext(), seen, choice, point, on_surface)
    if traits.has_delta and not traits.has_masks:
        context = mi.BSDFContext()
        context.type_mask = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission
        bs_own, weight_own = surface.bsdf().sample(context, seen, choice, point, own)
        bs, weight = dr.select(own, bs_own, bs), dr.select(own, weight_own, weight)
    null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    medium = dr.select(in_medium, pivot["medium"], dr.zeros(mi.MediumPtr))
    mei = point_in(medium, pivot["p"], pivot["time"], pivot["wavelengths"], d)
    wo, _, phase_pdf = sample_direction(traits, mei, choice, point, in_medium)
    taken = (in_medium & (phase_pdf > 0)) | (
        on_surface & ~null & (delta == own) & (dr.max(weight) > 0)
    )
    return dr.select(on_surface, surface.to_world(bs.wo), wo), weight, taken


@dr.syntax
def continue_paths(
    scene,
    lights,
    traits,
    summand,
    pivot,
    connections,
    number,
    seed,
    numbers,
    views: int,
    max_depth: int,
    rr_depth: int,
    active,
):
    """Traces suffixes from pivots, with the paths' `numbers` (`PathNumbers`) where a draw has a
    fixed place in the path, else with those of a stream (`number`, `seed`). `connections` holds,
    for each view k and path p at k * paths + p, what `lines.connect` gave (None for a single view).

    A direction is drawn from the mixture of all views' scattering at the pivot, each by its share
    of the densities, r_k / sum r: the best single sample under the balance heuristic, and never a
    worse one than each view would draw for itself. A second direction goes to a light.

    Returns `(suffix, value)`: `light_d`, `light` and `next_d`, `next`, two directions with what
    arrives from there over its density, to be multiplied with a view's scattering and its `tint`;
    `total`, the sum of `summand(r)` over views, and `alone`, whether there is only one; and what
    the path brings to its own view, before any weight.
    """
    active = active & (pivot["kind"] != NOWHERE)
    if dr.hint(max_depth > 0, mode="scalar"):
        active &= max_depth > 1
    rng = streams(number, seed ^ SUFFIX_SALT)
    draws = numbers.at(PIVOT)
    paths = dr.width(number)
    path = dr.arange(mi.UInt32, paths)
    shared = active & (pivot["branch"] != OWN)
    surface = pivot_surface(pivot, active & (pivot["kind"] == ON_SURFACE))

    # ---- Which views see the pivot, and whose scattering is sampled
    densities = mi.Float(1)
    total = summand(mi.Float(1))
    chosen = mi.Vector3f(pivot["wi"])
    alone = mi.Bool(True)
    if dr.hint(views > 1, mode="scalar"):
        k = mi.UInt32(0)
        while dr.hint(k < views, label="views of a pivot"):
            ratio = dr.gather(mi.Float, connections["ratio"], k * paths + path, shared)
            d = dr.gather(mi.Vector3f, connections["d"], k * paths + path, shared)
            counts = shared & (ratio > 0) & (k != pivot["view"])
            densities[counts] += ratio
            total[counts] += summand(ratio)
            alone &= ~counts
            chosen[counts & (rng.next_float32(counts) * densities < ratio)] = d
            k += 1

    # ---- Two directions, and their densities in the mixture
    medium = mi.MediumPtr(pivot["medium"])
    mei = point_in(medium, pivot["p"], pivot["time"], pivot["wavelengths"], pivot["wi"])
    it = dr.select(pivot["kind"] == ON_SURFACE, mi.Interaction3f(surface), mi.Interaction3f(mei))
    next_d, delta_weight, taken = sample_scattering(pivot, surface, chosen, traits, draws, active)
    light_d = mi.Vector3f(0, 0, 1)
    light = mi.Spectrum(0)
    light_pdf = mi.Float(0)
    on_delta_light = mi.Bool(False)
    transition = (pivot["kind"] == ON_SURFACE) & surface.is_medium_transition()
    if dr.hint(not lights.dark, mode="scalar"):
        beyond = mi.MediumPtr(medium)
        ds, value, pdf, rng = direct_light(
            scene, lights, traits, it, beyond, transition, surface, draws, rng, shared
        )
        light_d, light, light_pdf, on_delta_light = (
            mi.Vector3f(ds.d),
            mi.Spectrum(value),
            mi.Float(pdf),
            mi.Bool(ds.delta),
        )
    own_next, next_pdf = scattering(pivot, surface, pivot["wi"], next_d, shared & taken)
    own_light, light_scatter_pdf = scattering(pivot, surface, pivot["wi"], light_d, shared)
    all_next = mi.Spectrum(own_next)  # to all views, each by its share
    if dr.hint(views > 1, mode="scalar"):
        share = dr.rcp(densities)
        next_pdf *= share
        all_next *= share
        light_scatter_pdf *= share
        k = mi.UInt32(0)
        while dr.hint(k < views, label="mixture"):
            ratio = dr.gather(mi.Float, connections["ratio"], k * paths + path, shared)
            d = dr.gather(mi.Vector3f, connections["d"], k * paths + path, shared)
            counts = shared & ~alone & (ratio > 0) & (k != pivot["view"])
            value_next, pdf_next = scattering(pivot, surface, d, next_d, counts & taken)
            _, pdf_light = scattering(pivot, surface, d, light_d, counts)
            next_pdf[counts] += pdf_next * ratio * share
            all_next[counts] += value_next * (ratio * share)
            light_scatter_pdf[counts] += pdf_light * ratio * share
            k += 1

    # ---- What arrives from there
    light *= dr.select(on_delta_light, 1, mis_power(light_pdf, light_scatter_pdf)) * pivot["weight"]
    specular = ~shared
    goes_on = active & taken & (specular | (next_pdf > 0))
    per_density = dr.select(specular, 1, dr.rcp(dr.maximum(next_pdf, 1e-30)))
    carried = dr.select(specular, delta_weight, mi.Spectrum(1))
    spawned = surface.spawn_ray(next_d)
    ray = mi.Ray3f(
        dr.select(pivot["kind"] == ON_SURFACE, spawned.o, pivot["p"]),
        next_d,
        pivot["time"],
        pivot["wavelengths"],
    )
    medium[goes_on & transition] = surface.target_medium(next_d)
    # What the path brings to all views: by what its own would get alone, roulette would kill what
    # others sampled.
    strength = dr.select(specular, 1, dr.max(all_next) * per_density)
    strength = dr.select(strength > 0, strength, 1)
    arriving = incident_radiance(
        scene,
        lights,
        traits,
        ray,
        medium,
        it,
        next_pdf,
        specular,
        pivot["weight"] * carried,
        strength,
        mi.UInt32(1),
        numbers,
        LATER,
        rng,
        max_depth,
        rr_depth,
        goes_on,
    )
    arriving = dr.select(goes_on, arriving * per_density, 0)
    value = dr.select(specular, arriving, own_light * light + own_next * arriving) * pivot["tint"]
    suffix = {
        "light_d": light_d,
        "light": dr.select(shared, light, 0),
        "next_d": next_d,
        "next": dr.select(shared, arriving, 0),
        "total": total,
        "alone": alone,
    }
    return suffix, dr.select(active, value, 0)


def scattered_to(suffix, pivot, surface, d, active):
    """What a suffix brings to a view in direction `d` of the pivot, before the first segment's
    tint."""
    by_light, _ = scattering(pivot, surface, d, suffix["light_d"], active)
    by_next, _ = scattering(pivot, surface, d, suffix["next_d"], active)
    return by_light * suffix["light"] + by_next * suffix["next"]
