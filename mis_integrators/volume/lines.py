"""Lines of sight from pivots to views: the media sections that they cross, and the null
interactions shifted onto them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..paths.flakes import projected_area
from ..paths.media import collision, point_in, section, way_left
from .pivots import (
    IN_MEDIUM,
    ON_SURFACE,
    added_stream,
    next_gap,
    null_stream,
    passing,
    pivot_surface,
)
from .shifts import Sections, at_optical_depth, total_optical_depth

LARGEST_RATIO = 1e15
"""Bound of density ratios: sums of their squares stay finite."""
BLOCKED, SHIFT_INVALID = 0.0, -1.0
"""What stands in a connection's `ratio` where a view does not see the pivot, and where it sees it
but the shift fails."""
DIM = 4.0
"""Tuned: optical depth beyond that of the clearest view from which on a view shares next to nothing
(e^-4 of its paths)."""
MOST_NULLS = 256.0
"""Expected number of null interactions up to which views are made to agree: bounds the work."""


@dr.syntax
def _walk(scene, traits, ray, medium, slots: int, hide_emitters: bool, active):
    """Walks `ray` to its `maxt`. Returns `(clear, starts, ends, majorants, media, found, tint,
    log_passed, nulls, depth)`: whether nothing opaque stands in between, the sections as lists of
    `slots` arrays in order from the ray's origin, how many there were (more than `slots`: the lists
    lack some), null transmission over passing probability, the logarithm of the latter, and,
    roughly, the expected number of null interactions and the optical depth."""
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    active = mi.Bool(active)
    clear = mi.Bool(active)
    starts = [mi.Float(0) for _ in range(slots)]
    ends = [mi.Float(0) for _ in range(slots)]
    majorants = [mi.Float(0) for _ in range(slots)]
    media = [dr.zeros(mi.MediumPtr, 1) for _ in range(slots)]
    found = mi.UInt32(0)
    nulls = mi.Float(0)
    depth = mi.Float(0)
    travelled = mi.Float(0)
    tint = mi.Spectrum(1)
    log_passed = mi.Float(0)
    end = ray(ray.maxt)
    while dr.hint(active, label="lines of sight"):
        surface = scene.ray_intersect(ray, traits.boundary_flags, False, active)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, surface.t)
        inside = active & (medium != None)  # noqa: E711 (array comparison)
        near, far, majorant = section(medium, stretch, inside)
        crossed = inside & (majorant > 0)
        for slot in dr.hint(range(slots), mode="scalar"):
            here = crossed & (found == slot)
            starts[slot] = dr.select(here, travelled + near, starts[slot])
            ends[slot] = dr.select(here, travelled + far, ends[slot])
            majorants[slot] = dr.select(here, majorant, majorants[slot])
            media[slot] = dr.select(here, medium, media[slot])
        found[crossed] += 1
        if dr.hint(traits.has_null_media, mode="scalar"):
            tentative = dr.select(crossed, majorant * (far - near), 0)
            scattering = tentative * traits.density_share(medium, crossed)
            nulls += tentative - scattering
            depth += scattering

        met = active & surface.is_valid() & (surface.t <= ray.maxt)
        through, probability = passing(surface.bsdf(ray), surface, met)
        hidden = mi.Bool(False)
        if dr.hint(hide_emitters, mode="scalar"):
            hidden = met & (surface.shape.emitter() != None)  # noqa: E711
            through, probability = (
                dr.select(hidden, mi.Spectrum(1), through),
                dr.select(hidden, 1, probability),
            )
        crosses = met & (probability > 0)
        tint[crosses] = tint * through * dr.rcp(dr.maximum(probability, 1e-30))
        log_passed[crosses] = log_passed + dr.log(dr.maximum(probability, 1e-30))
        clear &= ~met | crosses
        medium[crosses & ~hidden & surface.is_medium_transition()] = surface.target_medium(ray.d)
        travelled[crosses] += surface.t
        onward = surface.spawn_ray(ray.d)
        ray.maxt = way_left(ray, surface.t, onward.o, end)
        ray.o = onward.o
        active = crosses & (ray.maxt > 0)
    return clear, starts, ends, majorants, media, found, tint, log_passed, nulls, depth


def arrival(pivot, surface, d, density, traits, active):
    """Density of a view's paths that come along `-d` to stop at the pivot, up to what all views
    share: per area of the surface, and with the probability that the surface stops them; in media
    of flakes times their projected area. Returns `(density, 1 / probability)`."""
    on_surface = active & (pivot["kind"] == ON_SURFACE)
    density = dr.select(on_surface, density * dr.abs(dr.dot(surface.n, d)), density)
    if traits.has_flakes:
        within = active & (pivot["kind"] == IN_MEDIUM)
        medium = dr.select(within, pivot["medium"], dr.zeros(mi.MediumPtr))
        here = point_in(medium, pivot["p"], pivot["time"], pivot["wavelengths"])
        density = dr.select(within, density * projected_area(here, d, within), density)
    stopping = mi.Float(1)
    if traits.has_null_vertices:
        seen = mi.SurfaceInteraction3f(surface)
        seen.wi = surface.to_local(d)
        _, probability = passing(surface.bsdf(), seen, on_surface)
        stopping = dr.select(on_surface, 1 - probability, 1)
    return density * stopping, dr.rcp(dr.maximum(stopping, 1e-30))


def sight(scene, views, traits, pivot, view, slots, hide_emitters, active):
    """A view's line of sight to pivots: what it takes to say how likely the view makes a path that
    goes there.

    Returns `(line, found)`; `found` is the number of sections met, of which `line` keeps `slots`.
    `line` holds:

    - `tmin`, `tmax`, `majorant`, `media`: lists, the sections as seen from the view, distances from
      its near plane, nearest first; a line without any has one of unit depth and no medium, so that
      added null interactions (see `common_nulls`) have a place;
    - `d`: direction from the pivot to the view; `distance`: to its near plane; `position`: on the
      view's film;
    - `density`: of the view's paths there, per area across them or of the surface (zero: the view
      does not see the pivot);
    - `log_survival`: logarithm of the probability that nothing stops a path on the way, null
      interactions apart;
    - `nulls`, `depth`: roughly the expected number of null interactions, and the optical depth;
    - `tint`: null transmission over the probabilities, a spectrum.
    """
    on_surface = active & (pivot["kind"] == ON_SURFACE)
    surface = pivot_surface(pivot, on_surface)
    d, distance, density, position = views.connect(view, pivot["p"], pivot["aperture"], active)
    active = active & (density > 0)
    spawned = surface.spawn_ray(d)
    ray = mi.Ray3f(
        dr.select(on_surface, spawned.o, pivot["p"]), d, pivot["time"], pivot["wavelengths"]
    )
    ray.maxt = distance
    medium = mi.MediumPtr(pivot["medium"])
    medium[on_surface & surface.is_medium_transition()] = surface.target_medium(d)
    clear, starts, ends, majorants, media, found, tint, log_passed, nulls, depth = _walk(
        scene, traits, ray, medium, slots, hide_emitters, active
    )
    density, stopping = arrival(pivot, surface, d, density, traits, active)
    tmin, tmax = (
        [dr.maximum(distance - end, 0) for end in ends[::-1]],
        [distance - start for start in starts[::-1]],
    )
    majorants, media = majorants[::-1], media[::-1]
    tau = total_optical_depth(Sections(tmin, tmax, majorants))
    empty = tau <= 0
    tmin[0], tmax[0], majorants[0] = (
        dr.select(empty, value, array)
        for value, array in ((0, tmin[0]), (1, tmax[0]), (1, majorants[0]))
    )
    media[0] = dr.select(empty, dr.zeros(mi.MediumPtr), media[0])
    return {
        "tmin": tmin,
        "tmax": tmax,
        "majorant": majorants,
        "media": media,
        "d": d,
        "distance": distance,
        "position": position,
        "density": dr.select(active & clear, density, 0),
        "log_survival": log_passed - tau,
        "nulls": nulls,
        "depth": depth,
        "tint": dr.select(active, tint * stopping, 0),
    }, found


def sections_of(line):
    return Sections(line["tmin"], line["tmax"], line["majorant"])


@dr.syntax
def common_nulls(own, lines, own_view, views: int, active):
    """How many null interactions all views that see a pivot are made to expect on their first
    segments. `lines` are the views' sights of the pivots, path p seen by view k at k * paths + p,
    and `own` those of the paths' own views.

    How many null interactions a path has says nothing about light, yet tells which view made it:
    where majorants are far above the density, a view that looks through 20 majorant optical depths
    does not believe in a path with two interactions, nor the other way round, and nothing is
    shared. Null interactions thus are added to each path as if majorants were higher, independently
    of all else: their process, the one of the path's own and the sum of both are Poisson processes,
    so densities stay known.

    What is common is the largest number among the views, but for those that see far less of the
    pivot than the clearest one. It depends on the pivot alone, and not on whose path it is.
    """
    paths = dr.width(own_view)
    path = dr.arange(mi.UInt32, paths)
    seen = active & (own["density"] > 0)
    clearest = dr.select(seen, own["depth"], mi.Float(dr.largest(mi.Float)))
    k = mi.UInt32(0)
    while dr.hint(k < views, label="clearest view"):
        sees = (
            seen
            & (k != own_view)
            & (dr.gather(mi.Float, lines["density"], k * paths + path, seen) > 0)
        )
        depth = dr.gather(mi.Float, lines["depth"], k * paths + path, sees)
        clearest = dr.select(sees, dr.minimum(clearest, depth), clearest)
        k += 1
    common = dr.select(seen & (own["depth"] <= clearest + DIM), own["nulls"], 0)
    k = mi.UInt32(0)
    while dr.hint(k < views, label="null interactions"):
        sees = (
            seen
            & (k != own_view)
            & (dr.gather(mi.Float, lines["density"], k * paths + path, seen) > 0)
        )
        sees &= dr.gather(mi.Float, lines["depth"], k * paths + path, sees) <= clearest + DIM
        nulls = dr.gather(mi.Float, lines["nulls"], k * paths + path, sees)
        common = dr.select(sees, dr.maximum(common, nulls), common)
        k += 1
    return dr.minimum(common, MOST_NULLS)


def added_nulls(line, common):
    """Expected number of null interactions that are added on a line: `(number, rate)`, the rate per
    majorant optical depth."""
    number = dr.maximum(common - line["nulls"], 0)
    return number, number * dr.rcp(dr.maximum(total_optical_depth(sections_of(line)), 1e-30))


@dr.syntax
def follow_nulls(shift, pivot, own, line, common, number, seed, slots: int, active):
    """Shifts the null interactions of paths, added ones included, from their `own` line to another
    `line`, or leaves them where they are if `shift` is ``None``.

    Returns `(log_density, tint, lost, empty)`: the logarithm of their density there, of a process
    whose own shifted densities it is to be compared with, times survival; what they carry over it;
    whether the shift has no place for one; whether there is nothing that they could be.
    """
    base, target = sections_of(own), sections_of(line)
    extra, extra_rate = added_nulls(own, common)
    number_added, rate = added_nulls(line, common)
    log_density = line["log_survival"] - number_added
    tint = mi.Spectrum(line["tint"])
    lost = mi.Bool(False)
    empty = mi.Bool(False)
    gaps = null_stream(number, seed)
    additions = added_stream(number, seed)
    tau = mi.Float(0)
    added = mi.Float(0)
    left = mi.UInt32(pivot["nulls"])
    shifting = mi.Bool(active)
    while dr.hint(shifting, label="shifts"):
        sampled = shifting & (left > 0)
        adds = shifting & ~sampled
        gap = dr.select(
            left == pivot["nulls"], pivot["gap"], next_gap(gaps, sampled & (left < pivot["nulls"]))
        )
        tau += dr.select(sampled, gap, 0)
        added += dr.select(adds, next_gap(additions, adds), 0)
        shifting &= sampled | (added < extra)
        place = dr.select(sampled, tau, added * dr.rcp(dr.maximum(extra_rate, 1e-30)))
        t = at_optical_depth(base, place)[0]
        log_rate = mi.Float(0)
        valid = mi.Bool(True)
        if dr.hint(shift is not None, mode="scalar"):
            shifted = shift(base, target, t)
            t, log_rate, valid = (
                mi.Float(shifted.t),
                mi.Float(shifted.log_rate),
                mi.Bool(shifted.valid),
            )
        medium = dr.zeros(mi.MediumPtr, 1)
        majorant = mi.Float(0)
        for slot in dr.hint(range(slots), mode="scalar"):
            here = (t >= target.tmin[slot]) & (t <= target.tmax[slot]) & (target.majorant[slot] > 0)
            medium = dr.select(here, line["media"][slot], medium)
            majorant = dr.select(here, target.majorant[slot], majorant)
        lost |= shifting & ~valid
        evaluated = shifting & valid
        in_medium = evaluated & (medium != None)  # noqa: E711 (array comparison)
        p = pivot["p"] + line["d"] * (line["distance"] - t)
        null, _, probability = collision(
            medium, p, majorant, pivot["time"], pivot["wavelengths"], in_medium, line["d"]
        )
        probability = dr.select(in_medium, probability, 0)
        total = probability + rate
        empty |= evaluated & (total <= 0)
        log_density[evaluated] = log_density + log_rate + dr.log(dr.maximum(total, 1e-30))
        tint[evaluated] = tint * (null * probability + rate) * dr.rcp(dr.maximum(total, 1e-30))
        left[sampled] -= 1
        shifting &= valid & (total > 0)
    return log_density, tint, lost, empty


def connect(traits, shift, pivot, own, line, common, number, seed, slots, active):
    """Shifts paths onto another view. `pivot` and `own` (its own view's line, with `log_density`)
    belong to path `number`, `line` is the other view's line.

    Returns a dictionary:

    - `ratio`: p_k(x_k) |dx_k / dx_i| / p_i(x_i), how much likelier the other view makes the shifted
      path than the path's own view makes the path itself, numbers of samples included; see
      `BLOCKED` and `SHIFT_INVALID`;
    - `tint`: spectrum, what the shifted first segment carries over its probability (as `tint` of a
      pivot);
    - `d`: direction from the pivot to the view; `position`: on the view's film.
    """
    active = active & (line["density"] > 0) & (own["density"] > 0)
    log_density, tint, lost, empty = (
        line["log_survival"],
        line["tint"],
        mi.Bool(False),
        mi.Bool(False),
    )
    if traits.has_null_media:
        log_density, tint, lost, empty = follow_nulls(
            shift, pivot, own, line, common, number, seed, slots, active
        )
    log_ratio = log_density - own["log_density"]
    ratio = dr.minimum(
        line["density"]
        * dr.rcp(dr.maximum(own["density"], 1e-30))
        * dr.exp(dr.minimum(log_ratio, 60)),
        LARGEST_RATIO,
    )
    ratio = dr.select(active & ~empty, dr.select(lost, SHIFT_INVALID, ratio), BLOCKED)
    return {
        "ratio": ratio,
        "tint": dr.select(active, tint, 0),
        "d": line["d"],
        "position": line["position"],
    }
