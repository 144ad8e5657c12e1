"""First segments of camera paths, up to the pivot: the vertex where a path scatters first and where
other views can join it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.random import streams
from ..core.spectra import channel_mean
from ..paths.media import collision, section

NOWHERE, IN_MEDIUM, ON_SURFACE = range(3)
"""Where a path's pivot is."""
SHARED, OWN = 0, 1
"""Whether other views may join at the pivot, or the path goes on by a delta function and is its own
view's alone."""
CAMERA, FIRST_SEGMENT, PIVOT, LATER = range(4)
"""Where a path's numbers are drawn (`PathNumbers.at`); what is met after the pivot is counted from
`LATER`."""

NULL_SALT, ADDED_SALT = 0x6E756C6C, 0x61646465


def null_stream(number, seed):
    """The random numbers that place a path's null interactions: optical depths from one tentative
    collision to the next on the first segment. They can be drawn again wherever the interactions
    are needed, so none is stored, except for the `gap` before the first one."""
    return streams(number, seed ^ NULL_SALT)


def added_stream(number, seed):
    """The random numbers that place null interactions which are added to a path (see
    `lines.common_nulls`)."""
    return streams(number, seed ^ ADDED_SALT)


def next_gap(rng, active=True):
    """Optical depth to the next tentative collision."""
    return -dr.log(1 - rng.next_float32(active))


def passing(bsdf, surface, active):
    """Null transmission of a surface (a spectrum, zero for what does not transmit) and the
    probability with which paths pass."""
    null = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
    value = dr.select(null, bsdf.eval_null_transmission(surface, null), 0)
    return value, dr.clip(channel_mean(value), 0, 1)


@dr.syntax
def trace_first_segments(
    scene,
    views,
    traits,
    number,
    seed,
    numbers,
    wavelengths,
    sensor_weight,
    hide_emitters: bool,
    active,
):
    """Traces camera paths to their pivots. What has a fixed place in a path draws its `numbers`
    (`PathNumbers`), all else those of a stream (`number`, `seed`).

    Media scatter by delta tracking against their majorants, null surfaces let paths pass with the
    mean of their transmission, and what stops is a pivot. Returns `(pivot, radiance)`, a
    dictionary and the emission seen on the way:

    - `kind`, `branch`: see the constants; `p`, `medium` (before the pivot), `wi` (to the camera),
      `time`, `wavelengths`;
    - `hit`, `ray_o`, `ray_d`: what rebuilds the surface interaction;
    - `view`, `position`, `aperture`, `in_window`: of the camera ray (see `Views.sample`);
    - `weight`, `tint`: spectra whose product is what the path carries when it scatters, measured
      value over density; the former belongs to the pivot and is every view's, the latter to the
      path's own first segment;
    - `nulls`: how many null interactions it passed; `gap`: optical depth to the first tentative
      collision;
    - `visible`: what the alpha channel shows.
    """
    view, ray, position, aperture, in_window = views.sample(
        number, wavelengths, numbers.at(CAMERA), active
    )
    ray = mi.Ray3f(ray)
    medium = views.medium(view, active)
    rng = streams(number, seed)
    gaps = null_stream(number, seed)
    first = numbers.at(FIRST_SEGMENT)
    first_gap = next_gap(first)
    first_chance = first.next_float32()
    branch_chance = first.next_float32()
    gap = mi.Float(first_gap)
    tint = mi.Spectrum(1)
    weight = mi.Spectrum(1)
    nulls = mi.UInt32(0)
    kind = mi.UInt32(NOWHERE)
    branch = mi.UInt32(SHARED)
    radiance = mi.Spectrum(0)
    visible = mi.Bool((scene.environment() is not None) and not hide_emitters)
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    surface = dr.zeros(mi.SurfaceInteraction3f)
    nowhere = dr.zeros(mi.Interaction3f)
    fresh = mi.Bool(True)
    p = mi.Point3f(0)
    tracing = mi.Bool(active)
    while dr.hint(tracing, label="first segments"):
        look = tracing & fresh
        hit[look] = scene.ray_intersect_preliminary(ray, coherent=True, active=look)
        surface[look] = hit.compute_surface_interaction(ray, mi.RayFlags.All, look)
        fresh = mi.Bool(False)

        # ---- Media
        inside = tracing & (medium != None)  # noqa: E711 (array comparison)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, surface.t)
        near, far, majorant = section(medium, stretch, inside)
        t = near + gap * dr.rcp(dr.maximum(majorant, 1e-30))
        collided = inside & (majorant > 0) & (t < far)
        null, real, probability = collision(
            medium, ray(t), majorant, ray.time, ray.wavelengths, collided, -ray.d
        )
        chance = dr.select(nulls == 0, first_chance, rng.next_float32(collided))
        passes = collided & (chance < probability)
        scatters = collided & ~passes
        gap = dr.select(inside & ~collided, dr.maximum(gap - majorant * (far - near), 0), gap)
        gap[passes] = next_gap(gaps, passes)
        tint[passes] = tint * null
        nulls[passes] += 1
        weight[scatters] = real
        kind[scatters] = IN_MEDIUM
        p[scatters] = ray(t)

        # ---- Surfaces
        met = tracing & ~collided
        emitter = surface.emitter(scene)
        hidden = met & surface.is_valid() & (emitter != None)  # noqa: E711
        if dr.hint(hide_emitters, mode="scalar"):
            met &= surface.is_valid()
        else:
            ds = mi.DirectionSample3f(scene, surface, nowhere)
            shines = met & (ds.emitter != None)  # noqa: E711
            radiance[shines] += tint * ds.emitter.eval(surface, shines)
            met &= surface.is_valid()
            hidden = mi.Bool(False)
        bsdf = surface.bsdf(ray)
        through, passing_probability = passing(bsdf, surface, met)
        through, passing_probability = (
            dr.select(hidden, mi.Spectrum(1), through),
            dr.select(hidden, 1, passing_probability),
        )
        crosses = met & (rng.next_float32(met) < passing_probability)
        tint[crosses] = tint * through * dr.rcp(dr.maximum(passing_probability, 1e-30))
        stops = met & ~crosses
        smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        delta = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection) | mi.has_flag(
            bsdf.flags(), mi.BSDFFlags.DeltaTransmission
        )
        tint[stops] = tint * dr.rcp(dr.maximum(1 - passing_probability, 1e-30))
        if dr.hint(traits.has_mixed, mode="scalar"):
            mixed = stops & smooth & delta
            weight[mixed] = 2 * weight
            branch[mixed] = dr.select(branch_chance < 0.5, mi.UInt32(SHARED), mi.UInt32(OWN))
        branch[stops & ~smooth] = OWN
        kind[stops] = ON_SURFACE
        p[stops] = surface.p
        visible |= scatters | stops

        # ---- Go on
        onward = surface.spawn_ray(ray.d)
        going = mi.Ray3f(ray)
        going.o = dr.select(crosses, onward.o, dr.select(passes, ray(t), ray.o))
        going.maxt = ray.maxt - dr.select(crosses, surface.t, dr.select(passes, t, 0))
        medium[crosses & ~hidden & surface.is_medium_transition()] = surface.target_medium(ray.d)
        tracing &= passes | crosses
        surface.t[passes] = surface.t - t
        hit.t[passes] = hit.t - t
        fresh |= crosses
        ray[tracing] = going

    reached = active & (kind != NOWHERE)
    pivot = {
        "kind": dr.select(active, kind, NOWHERE),
        "branch": branch,
        "p": p,
        "medium": dr.select(reached, medium, dr.zeros(mi.MediumPtr)),
        "wi": -ray.d,
        "time": ray.time,
        "wavelengths": ray.wavelengths,
        "hit": hit,
        "ray_o": ray.o,
        "ray_d": ray.d,
        "view": view,
        "position": position,
        "aperture": aperture,
        "in_window": in_window,
        "tint": tint,
        "weight": weight * sensor_weight,
        "nulls": nulls,
        "gap": first_gap,
        "visible": dr.select(active & visible, mi.Float(1), mi.Float(0)),
    }
    return pivot, dr.select(active, radiance * sensor_weight, 0)


def pivot_surface(pivot, active):
    """The surface interaction at pivots on surfaces, seen from the path's own view."""
    ray = mi.Ray3f(pivot["ray_o"], pivot["ray_d"], pivot["time"], pivot["wavelengths"])
    hit = dr.select(active, pivot["hit"], dr.zeros(mi.PreliminaryIntersection3f))
    return hit.compute_surface_interaction(ray, mi.RayFlags.All, active)


def of_paths(record, index):
    """The entries `index` of every array of a dictionary (and of lists in it)."""
    return {
        name: [dr.gather(type(v), v, index) for v in value]
        if isinstance(value, list)
        else dr.gather(type(value), value, index)
        for name, value in record.items()
    }
