"""Lines of sight from pivots to views: the media sections that they cross, and the null interactions shifted onto them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .media import collision, section
from .pivots import NOWHERE, ON_SURFACE, next_gap, null_stream, passing, pivot_surface
from .shifts import Sections, at_optical_depth, total_optical_depth

LARGEST = 1e15
"""Bound of density ratios: sums of their squares stay finite."""
BLOCKED, SHIFT_INVALID = 0.0, -1.0
"""What stands in a connection's `ratio` where a view does not see the pivot, and where it sees it but the shift fails."""


@dr.syntax
def _walk(scene, traits, ray, medium, slots: int, hide_emitters: bool, active):
    """Walks `ray` to its `maxt`. Returns `(clear, starts, ends, majorants, media, found, tint, log_passed)`: whether nothing opaque stands in
    between, the sections as lists of `slots` arrays in order from the ray's origin, how many there were (more than `slots`: the lists lack some),
    null transmission over passing probability, and the logarithm of the latter."""
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    active = mi.Bool(active)
    clear = mi.Bool(active)
    starts = [mi.Float(0) for _ in range(slots)]
    ends = [mi.Float(0) for _ in range(slots)]
    majorants = [mi.Float(0) for _ in range(slots)]
    media = [dr.zeros(mi.MediumPtr, 1) for _ in range(slots)]
    found = mi.UInt32(0)
    travelled = mi.Float(0)
    tint = mi.Spectrum(1)
    log_passed = mi.Float(0)
    while dr.hint(active, label="lines of sight"):
        surface = scene.ray_intersect(ray, traits.boundary_flags, False, active)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, surface.t)
        inside = active & (medium != None)  # noqa: E711 (array comparison)
        near, far, majorant = section(medium, stretch, inside)
        crossed = inside & (majorant > 0)
        for slot in dr.hint(range(slots), mode='scalar'):
            here = crossed & (found == slot)
            starts[slot] = dr.select(here, travelled + near, starts[slot])
            ends[slot] = dr.select(here, travelled + far, ends[slot])
            majorants[slot] = dr.select(here, majorant, majorants[slot])
            media[slot] = dr.select(here, medium, media[slot])
        found[crossed] += 1

        met = active & surface.is_valid() & (surface.t <= ray.maxt)
        through, probability = passing(surface.bsdf(ray), surface, met)
        hidden = mi.Bool(False)
        if dr.hint(hide_emitters, mode='scalar'):
            hidden = met & (surface.shape.emitter() != None)  # noqa: E711
            through, probability = dr.select(hidden, mi.Spectrum(1), through), dr.select(hidden, 1, probability)
        crosses = met & (probability > 0)
        tint[crosses] = tint * through * dr.rcp(dr.maximum(probability, 1e-30))
        log_passed[crosses] = log_passed + dr.log(dr.maximum(probability, 1e-30))
        clear &= ~met | crosses
        medium[crosses & ~hidden & surface.is_medium_transition()] = surface.target_medium(ray.d)
        travelled[crosses] += surface.t
        onward = surface.spawn_ray(ray.d)
        ray.o = onward.o
        ray.maxt = ray.maxt - surface.t
        active = crosses & (ray.maxt > 0)
    return clear, starts, ends, majorants, media, found, tint, log_passed


def line_of_sight(scene, traits, pivot, surface, d, distance, slots, hide_emitters, active):
    """From the pivot along `d` over `distance`, which is where the view's near plane is. Returns `(clear, sections, media, found, tint,
    log_passed)` as `_walk` does, but the sections as seen from the view: distances from its near plane, nearest first."""
    on_surface = active & (pivot["kind"] == ON_SURFACE)
    spawned = surface.spawn_ray(d)
    ray = mi.Ray3f(dr.select(on_surface, spawned.o, pivot["p"]), d, pivot["time"], pivot["wavelengths"])
    ray.maxt = distance
    medium = mi.MediumPtr(pivot["medium"])
    medium[on_surface & surface.is_medium_transition()] = surface.target_medium(d)
    clear, starts, ends, majorants, media, found, tint, log_passed = _walk(scene, traits, ray, medium, slots, hide_emitters, active)
    sections = Sections([dr.maximum(distance - end, 0) for end in ends[::-1]], [distance - start for start in starts[::-1]], majorants[::-1])
    return clear, sections, media[::-1], found, tint, log_passed


def arrival(pivot, surface, d, density, traits, active):
    """Density of a view's paths that come along `-d` to stop at the pivot, up to what all views share: per area of the surface, and with the
    probability that the surface stops them. Returns `(density, 1 / probability)`."""
    on_surface = active & (pivot["kind"] == ON_SURFACE)
    density = dr.select(on_surface, density * dr.abs(dr.dot(surface.n, d)), density)
    stopping = mi.Float(1)
    if traits.has_null_vertices:
        seen = mi.SurfaceInteraction3f(surface)
        seen.wi = surface.to_local(d)
        _, probability = passing(surface.bsdf(), seen, on_surface)
        stopping = dr.select(on_surface, 1 - probability, 1)
    return density * stopping, dr.rcp(dr.maximum(stopping, 1e-30))


def own_line(scene, views, traits, pivot, slots, hide_emitters, active):
    """What a path's own view needs to be compared with others: `(line, found)`, the sections of its first segment in `line`, its `density` and
    `log_probability`, in the domain where null interactions have unit density (see `shifts`)."""
    active = active & (pivot["kind"] != NOWHERE)
    surface = pivot_surface(pivot, active & (pivot["kind"] == ON_SURFACE))
    d, distance, density, _ = views.connect(pivot["view"], pivot["p"], pivot["aperture"], active)
    sees = active & (density > 0)
    clear, sections, _, found, _, _ = line_of_sight(scene, traits, pivot, surface, d, distance, slots, hide_emitters, sees)
    density, _ = arrival(pivot, surface, d, density, traits, active)
    line = {"tmin": sections.tmin, "tmax": sections.tmax, "majorant": sections.majorant,
            "density": dr.select(sees & clear, density, 0), "log_probability": pivot["log_passed"] - total_optical_depth(sections)}
    return line, found


@dr.syntax
def connect(scene, views, traits, shift, pivot, line, view, number, seed, slots: int, hide_emitters: bool, active):
    """Shifts paths onto another view. `pivot` and `line` belong to path `number`, `view` is the other view's index.

    Returns `(connection, found)`:

    - `ratio`: p_k(x_k) |dx_k / dx_i| / p_i(x_i), how much likelier the other view makes the shifted path than the path's own view makes the path
      itself, numbers of samples included; see `BLOCKED` and `SHIFT_INVALID`;
    - `tint`: spectrum, what the shifted first segment carries over its probability (as `tint` of a pivot);
    - `d`: direction from the pivot to the view; `position`: on the view's film.
    """
    surface = pivot_surface(pivot, active & (pivot["kind"] == ON_SURFACE))
    d, distance, density, position = views.connect(view, pivot["p"], pivot["aperture"], active)
    active = active & (density > 0) & (line["density"] > 0)
    clear, target, media, found, tint, log_passed = line_of_sight(scene, traits, pivot, surface, d, distance, slots, hide_emitters, active)
    active &= clear
    density, own = arrival(pivot, surface, d, density, traits, active)
    base = Sections(line["tmin"], line["tmax"], line["majorant"])

    # ---- Null interactions
    log_ratio = log_passed - total_optical_depth(target) - line["log_probability"]
    gaps = null_stream(number, seed)
    tau = mi.Float(0)
    left = mi.UInt32(pivot["nulls"])
    lost = mi.Bool(False)                            # the shift has no place for an interaction
    empty = mi.Bool(False)                           # no medium, or no null interaction where the shift puts it
    has_media = total_optical_depth(target) > 0
    shifting = active & (left > 0)
    if dr.hint(traits.has_null_media, mode='scalar'):
        while dr.hint(shifting, label="shifts"):
            tau += next_gap(gaps, shifting)
            t = at_optical_depth(base, tau)[0]
            shifted = shift(base, target, t)
            medium = dr.zeros(mi.MediumPtr, 1)
            majorant = mi.Float(0)
            for slot in dr.hint(range(slots), mode='scalar'):
                here = (shifted.t >= target.tmin[slot]) & (shifted.t <= target.tmax[slot]) & (target.majorant[slot] > 0)
                medium = dr.select(here, media[slot], medium)
                majorant = dr.select(here, target.majorant[slot], majorant)
            failed = shifting & ~shifted.valid
            lost |= failed & has_media
            empty |= failed & ~has_media
            evaluated = shifting & shifted.valid
            place = pivot["p"] + d * (distance - shifted.t)
            null, _, probability = collision(medium, place, majorant, pivot["time"], pivot["wavelengths"], evaluated)
            empty |= evaluated & (probability <= 0)
            log_ratio[evaluated] = log_ratio + shifted.log_rate + dr.log(dr.maximum(probability, 1e-30))
            tint[evaluated] = tint * null
            left -= 1
            shifting &= shifted.valid & (probability > 0) & (left > 0)
    ratio = dr.minimum(density * dr.rcp(dr.maximum(line["density"], 1e-30)) * dr.exp(dr.minimum(log_ratio, 60)), LARGEST)
    ratio = dr.select(active & ~empty, dr.select(lost, SHIFT_INVALID, ratio), BLOCKED)
    return {"ratio": ratio, "tint": dr.select(active, tint * own, 0), "d": d, "position": position}, found

