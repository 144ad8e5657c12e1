"""Participating media: what one does at a point, free flight to the next scattering, and what light
is left on the way between two points.

Free flight is delta tracking (Woodcock et al. 1965) against a medium's majorant, the largest one of
its channels: a tentative collision is null or real, with a mean probability over the channels, so
that one density serves all of them and throughput carries the ratios. In the mean each channel
counts by the throughput that it has (history-aware spectral tracking; Kutz et al. 2017, Spectral
and decomposition tracking for rendering heterogeneous volumes). So no collision makes the sum over
the channels larger, however many there are. With all channels alike, as in Mitsuba's `prbvolpath`,
the ratios of hundreds of collisions in wax or milk multiply to bright dots of one colour.

Index-matched boundaries (the BSDF `null`, and the share that others let pass straight on) end no
segment: paths and connections go through them.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.random import own_stream
from ..core.spectra import channel_mean
from . import flakes

FAINT = 0.05
"""Tuned: transmittance below which the estimate on the way to a light plays roulette."""


LONGEST = 1e18
"""Stands for the length of a way without end."""
FLIGHT = 1 << 16
"""Where paths draw their numbers for free flights (`PathNumbers.at`): beyond those of vertices."""
FLIGHT_SALT, SHADOW_SALT = 0x666C7900, 0x73686164


@dataclass
class Walls:
    """The surfaces between which a piece of a ray lies: the one at which the ray has come into the
    medium, and the one that it meets. Geometric normals, and distances along the ray from the
    piece's beginning to what is `behind` and `ahead` (infinite: there is none)."""

    normal_behind: mi.Normal3f
    behind: mi.Float
    normal_ahead: mi.Normal3f
    ahead: mi.Float


def walls_of(normal_behind, start, normal_ahead, distance):
    """The `Walls` of a piece that begins at distance `start` on its ray, which leaves a surface
    (a zero normal: none) and meets another one."""
    leaves = dr.squared_norm(normal_behind) > 0
    behind = dr.select(leaves, start, dr.inf)
    return Walls(normal_behind, behind, normal_ahead, distance - start)


def point_in(medium, p, time, wavelengths, wi=None):
    """A `MediumInteraction3f` at `p`, for the evaluation of coefficients and of the phase function:
    `wi` (world space) leads to where a path came from. (Coefficients depend on it in media of
    flakes: ``None`` stands for a direction that is the same everywhere, along no axis.)"""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.time, mei.wavelengths, mei.medium = p, time, wavelengths, medium
    mei.wi = dr.normalize(mi.Vector3f(1)) if wi is None else wi
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


def section(medium, ray, active):
    """Where the medium's constant majorant begins and ends on a ray, and the majorant: `(near, far,
    majorant)`, zero where there is none."""
    inside, near, far = medium.intersect_aabb(ray)
    majorant = dr.max(
        medium.get_majorant(point_in(medium, ray.o, ray.time, ray.wavelengths, -ray.d), active)
    )
    near, far = dr.maximum(near, 0), dr.minimum(far, ray.maxt)
    inside &= active & (far > near) & (majorant > 0)
    return dr.select(inside, near, 0), dr.select(inside, far, 0), dr.select(inside, majorant, 0)


def shares_of_channels(throughput):
    """Throughput over its sum, a spectrum; all alike where there is none."""
    throughput = dr.abs(throughput)
    total = dr.sum(throughput)
    alike = 1 / dr.size_v(type(throughput))
    return dr.select(total > 1e-30, throughput * dr.rcp(dr.maximum(total, 1e-30)), alike)


def collision(medium, p, majorant, time, wavelengths, active, wi=None, throughput=None):
    """At a tentative collision: `(null, real, probability)`, the spectra that a null collision and
    a scattering multiply throughput with, and the probability of the former: a mean over the
    channels, in which each counts by its `throughput` (``None``: all alike)."""
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(
        point_in(medium, p, time, wavelengths, wi), active
    )
    counts = shares_of_channels(mi.Spectrum(1) if throughput is None else throughput)
    share = sigma_t * dr.rcp(dr.maximum(majorant, 1e-30))
    total = dr.sum(counts * sigma_t)
    probability = dr.clip(1 - dr.sum(counts * share), 0, 1)
    null = dr.select(probability > 0, (1 - share) * dr.rcp(dr.maximum(probability, 1e-30)), 0)
    return null, dr.select(total > 0, sigma_s * dr.rcp(dr.maximum(total, 1e-30)), 0), probability


def beyond_boundary(traits, hit, ray, medium, met, unseen=None):
    """Where the lanes `met` of a `ray` meet a surface that only lets light pass: which do, the
    share of light that passes (a spectrum), and the medium and the ray's origin beyond; those of
    before on all other lanes. On the lanes `unseen` (``None``: nowhere) emitters' shapes let all
    light pass, as if they were not there."""
    surface = hit.compute_surface_interaction(ray, traits.boundary_flags, met)
    bsdf = surface.bsdf()
    scattering = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Smooth)  # Null among them
    passes = (bsdf.flags() & scattering) == int(mi.BSDFFlags.Null)
    lamp = hit.shape.is_emitter()
    crosses = met & ~lamp & passes
    share = bsdf.eval_null_transmission(surface, crosses)
    beyond = dr.select(
        crosses & surface.is_medium_transition(), surface.target_medium(ray.d), medium
    )
    if unseen is not None:
        crosses |= met & lamp & unseen
        share = dr.select(lamp, 1, share)
    return crosses, share, beyond, dr.select(crosses, surface.spawn_ray(ray.d).o, ray.o)


def way_left(ray, step, origin, end):
    """The length that is left of a `ray` to its `end` (a point, maybe infinitely far), a `step`
    further, from the `origin` of a new ray. That lies a little in front of the surface that was
    met, so that the rest is shorter than by the step: else a short ray would reach beyond its end.
    """
    left = ray.maxt - step
    from_origin = dr.dot(end - origin, ray.d)
    return dr.select(from_origin < left, from_origin, left)


@dr.syntax
def transmittance(scene, traits, ray, medium, rng, active, through_emitters=False):
    """Share of light that gets along `ray` (to its `maxt`) through media and null boundaries (with
    `through_emitters` through emitters' shapes, too, as if they were not there): exact in
    homogeneous media, in others estimated without bias by ratio tracking (Novak et al. 2014), with
    roulette once it is faint. Returns it and the advanced `rng`."""
    rng = mi.PCG32(rng)
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    active = mi.Bool(active)
    value = dr.select(active, mi.Spectrum(1), mi.Spectrum(0))
    surface = dr.zeros(mi.SurfaceInteraction3f)
    fresh = mi.Bool(True)  # the next surface is not known yet
    end = ray(ray.maxt)
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
                medium, ray(t), majorant, ray.time, ray.wavelengths, collided, -ray.d
            )
            value[collided] = value * null * probability
            faint = collided & (dr.max(value) < FAINT)
            survives = rng.next_float32(faint) < 0.5
            value[faint] = dr.select(survives, 2 * value, 0)
            inside &= ~grid
        _, _, sigma_t = medium.get_scattering_coefficients(
            point_in(medium, ray.o, ray.time, ray.wavelengths, -ray.d), inside
        )
        value[inside] = value * dr.exp(-sigma_t * (far - near))

        met = active & ~collided & surface.is_valid() & (surface.t <= ray.maxt)
        stands = mi.Bool(met)
        if dr.hint(through_emitters, mode="scalar"):
            stands &= ~surface.shape.is_emitter()
        value[stands] = value * surface.bsdf().eval_null_transmission(surface, stands)
        medium[stands & surface.is_medium_transition()] = surface.target_medium(ray.d)
        step = dr.select(collided, t, surface.t)
        onward = surface.spawn_ray(ray.d)
        ray.maxt = dr.select(met, way_left(ray, step, onward.o, end), ray.maxt - step)
        ray.o = dr.select(collided, ray.o + ray.d * step, onward.o)
        surface.t = surface.t - step
        fresh |= met
        active &= (collided | met) & (dr.max(value) > 0) & (ray.maxt > 0)
    return value, rng


# --- Free flight ------------------------------------------------------------------------------


@dr.syntax
def fly(scene, traits, ray, medium, draws, throughput, active, unseen=None, keep=None, left=None):
    """Moves rays through media and boundaries with the plain BSDF `null` (`unseen`: as of
    `beyond_boundary`) to where they scatter or meet another surface.

    `draws`: a `VertexNumbers` of this flight. Returns `(hit, ray, medium, scatters, weight)`: the
    surface (of those that scatter: none, at the distance of the collision), the ray that leads
    there, the medium at its end, whether it scatters there, and what the `throughput` is multiplied
    with: albedo and null collisions.

    `keep`, if given, is called as that of `pass_straight` for each piece of the way from one
    tentative collision to the next, with the weight so far in place of the share of light, which is
    constant along the piece: flights that get as far as a point have that share as their mean
    weight there. `left`: as there.
    """
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    flying = mi.Bool(active)
    flight, chance = draws.next_floats(2)
    rng = own_stream(draws, FLIGHT_SALT)
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    weight = mi.Spectrum(1)
    scatters = mi.Bool(False)
    passed = mi.Float(0)
    normal = None if keep is None else mi.Normal3f(0, 0, 1)
    entered = None if keep is None else mi.Normal3f(0 if left is None else left)
    fresh = mi.Bool(True)  # the next surface is not known yet
    while dr.hint(flying, label="free flight"):
        look = flying & fresh
        hit[look] = scene.ray_intersect_preliminary(ray, coherent=False, active=look)
        if dr.hint(keep is not None, mode="scalar"):
            look &= hit.is_valid()
            normal[look] = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, look).n
        fresh = mi.Bool(False)

        # ---- Media
        inside = flying & (medium != None)  # noqa: E711 (array comparison)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, hit.t)
        near, far, majorant = section(medium, stretch, inside)
        t = dr.maximum(near, passed) - dr.log(1 - flight) * dr.rcp(dr.maximum(majorant, 1e-30))
        collided = inside & (majorant > 0) & (t < far)
        if dr.hint(keep is not None, mode="scalar"):
            start = dr.maximum(near, passed)
            length = dr.minimum(dr.minimum(t, far), LONGEST) - start
            begin = mi.Ray3f(ray)
            begin.o = ray(start)
            piece = inside & (majorant > 0) & (length > 0)
            keep(begin, medium, length, weight, walls_of(entered, start, normal, hit.t), piece)
        null, real, probability = collision(
            medium,
            ray(t),
            majorant,
            ray.time,
            ray.wavelengths,
            collided,
            -ray.d,
            throughput * weight,
        )
        passes = mi.Bool(False)
        if dr.hint(traits.has_null_media, mode="scalar"):
            passes = collided & (chance < probability)
        here = collided & ~passes
        scatters |= here
        weight *= dr.select(passes, null, dr.select(here, real, 1))
        passed[collided] = t

        # ---- Boundaries
        met = flying & ~collided & hit.is_valid()
        crosses, share, medium, ray.o = beyond_boundary(traits, hit, ray, medium, met, unseen)
        weight[crosses] = weight * share
        passed[crosses] = 0
        if dr.hint(keep is not None, mode="scalar"):
            entered[crosses] = normal
        fresh |= crosses
        flying &= passes | crosses
        flight, chance = rng.next_float32(flying), rng.next_float32(flying)
    hit.t = dr.select(scatters, passed, hit.t)
    hit.shape = dr.select(scatters, dr.zeros(mi.ShapePtr), hit.shape)
    return hit, ray, medium, scatters, weight


# --- Straight on ------------------------------------------------------------------------------


@dr.syntax
def pass_straight(scene, traits, ray, medium, draws, keep, active, unseen=None, left=None):
    """Moves rays straight through media, and through boundaries with the plain BSDF `null`
    (`unseen`: as of `beyond_boundary`), to the surface that they meet: nothing scatters them on the
    way.

    `draws`: a `VertexNumbers`; `left`: geometric normals of the surfaces that the rays leave, zero
    for those that leave none (``None``: none does). Returns `(hit, ray, medium, kept)`, as `fly`
    does, but for `kept`: the share of light that gets along; exact in homogeneous media, in others
    estimated by ratio tracking (Novak et al. 2014), whose tentative collisions cut the way into
    pieces. Where the share is faint, the way is cut, too, and goes on by roulette.

    `keep(start, medium, length, kept, walls, mask)` is called for each piece in a medium: `start`
    is a ray from its beginning, `kept` the share there; `walls`: its `Walls`. Along a piece, the
    share falls with the extinction of homogeneous media, and is constant in others.
    """
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    going = mi.Bool(active)
    rng = own_stream(draws, FLIGHT_SALT)
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    kept = mi.Spectrum(1)
    passed = mi.Float(0)
    normal = mi.Normal3f(0, 0, 1)
    entered = mi.Normal3f(0 if left is None else left)
    fresh = mi.Bool(True)  # the next surface is not known yet
    while dr.hint(going, label="straight on"):
        look = going & fresh
        hit[look] = scene.ray_intersect_preliminary(ray, coherent=False, active=look)
        look &= hit.is_valid()
        normal[look] = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, look).n
        fresh = mi.Bool(False)

        # ---- Media: one piece
        inside = going & (medium != None)  # noqa: E711 (array comparison)
        stretch = mi.Ray3f(ray)
        stretch.maxt = dr.minimum(ray.maxt, hit.t)
        near, far, majorant = section(medium, stretch, inside)
        start = dr.maximum(near, passed)
        far = dr.minimum(far, LONGEST)
        inside &= (majorant > 0) & (start < far)
        _, _, sigma_t = medium.get_scattering_coefficients(
            point_in(medium, ray.o, ray.time, ray.wavelengths, -ray.d), inside
        )
        least = dr.rcp(dr.maximum(dr.min(sigma_t), 1e-30))
        t = start + dr.log(dr.max(kept) * (1 / FAINT)) * least  # where it is faint
        grid = mi.Bool(False)
        if dr.hint(traits.has_grids, mode="scalar"):
            grid = inside & ~medium.is_homogeneous()
            t[grid] = start - dr.log(1 - rng.next_float32(grid)) * dr.rcp(
                dr.maximum(majorant, 1e-30)
            )
        cut = inside & (t < far)
        t = dr.minimum(t, far)
        begin = mi.Ray3f(ray)
        begin.o = ray(start)
        keep(begin, medium, t - start, kept, walls_of(entered, start, normal, hit.t), inside)
        kept[inside & ~grid] = kept * dr.exp(-sigma_t * (t - start))
        if dr.hint(traits.has_grids, mode="scalar"):
            collided = grid & cut
            null, _, probability = collision(
                medium, ray(t), majorant, ray.time, ray.wavelengths, collided, -ray.d
            )
            kept[collided] = kept * null * probability
        passed[cut] = t

        # ---- Boundaries
        met = going & ~cut & hit.is_valid()
        crosses, share, medium, ray.o = beyond_boundary(traits, hit, ray, medium, met, unseen)
        kept[crosses] = kept * share
        passed[crosses] = 0
        entered[crosses] = normal
        fresh |= crosses

        # ---- Roulette
        strength = dr.max(kept)
        faint = going & (strength <= 1.001 * FAINT)
        chance = strength * (0.5 / FAINT)
        survives = rng.next_float32(faint) < chance
        kept[faint] = dr.select(survives, kept * dr.rcp(dr.maximum(chance, 1e-30)), 0)
        going &= (cut | crosses) & (~faint | survives)
    return hit, ray, medium, kept


def begin_flights(traits, medium):
    """What a path carries through media: the medium, the number of its next flight, and whether it
    scatters in the medium where it has arrived. Nothing in scenes without media."""
    if not traits.has_media:
        return []
    medium = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
    return [medium, mi.UInt32(0), mi.Bool(False)]


def next_hit(scene, traits, ray, flight, numbers, throughput, active, unseen=None):
    """`fly`, for paths that carry `flight`: `(hit, ray, flight, throughput)`."""
    medium, number, _ = flight
    hit, ray, medium, scatters, weight = fly(
        scene, traits, ray, medium, numbers.at(FLIGHT + number), throughput, active, unseen
    )
    return hit, ray, [medium, number + 1, scatters], throughput * weight


def next_hit_straight_on(scene, traits, ray, flight, numbers, keep, active, unseen, left):
    """As `next_hit`, for paths that nothing in media scatters (`pass_straight`, with `keep`); in
    place of the throughput, the share of light that gets along."""
    medium, number, scatters = flight
    hit, ray, medium, kept = pass_straight(
        scene, traits, ray, medium, numbers.at(FLIGHT + number), keep, active, unseen, left
    )
    return hit, ray, [medium, number + 1, scatters], kept


def next_hit_either(
    scene,
    traits,
    ray,
    flight,
    numbers,
    throughput,
    keep_flown,
    keep_straight,
    flies,
    active,
    unseen,
    left,
):
    """As `next_hit` on the lanes `flies`, as `next_hit_straight_on` on the others, each with a
    `keep` of its own; in place of the throughput, its factor."""
    medium, number, _ = flight
    draws = numbers.at(FLIGHT + number)
    flown = fly(
        scene, traits, ray, medium, draws, throughput, active & flies, unseen, keep_flown, left
    )
    straight = pass_straight(
        scene, traits, ray, medium, draws, keep_straight, active & ~flies, unseen, left
    )
    hit, ray, medium = (dr.select(flies, a, b) for a, b in zip(flown[:3], straight[:3]))
    _, _, _, scatters, weight = flown
    return hit, ray, [medium, number + 1, scatters], dr.select(flies, weight, straight[3])


def interaction_at(hit, ray, scatters, active):
    """The surface interaction of a hit, or one without shape and normal where a path `scatters` in
    a medium; its frame is that of the ray."""
    si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active & ~scatters)
    within = dr.zeros(mi.SurfaceInteraction3f)
    within.t, within.p, within.time, within.wavelengths = (
        hit.t,
        ray(hit.t),
        ray.time,
        ray.wavelengths,
    )
    # A frame passes on what its normal lacks of a unit vector, three times at each scattering.
    towards = dr.normalize(-ray.d)
    within.sh_frame, within.wi = mi.Frame3f(towards), mi.Vector3f(0, 0, 1)
    return dr.select(active & scatters, within, si)


def sample_direction(traits, mei, choice, point, active):
    """`(wo, weight, pdf)`: a sample of the phase function at `mei` (a `MediumInteraction3f`; its
    medium is none on inactive lanes), in world space."""
    phase, context = mei.medium.phase_function(), mi.PhaseFunctionContext(None)
    wo, weight, pdf = phase.sample(context, mei, choice, point, active)
    if not traits.has_flakes:
        return wo, weight, pdf
    of_flakes = active & mi.has_flag(phase.flags(), mi.PhaseFunctionFlags.Microflake)
    reflected, density = flakes.sample(mei, point, of_flakes)
    return dr.select(of_flakes, reflected, wo), weight, dr.select(of_flakes, density, pdf)


def sample_phase(traits, medium, si, choice, point, bs, weight, active):
    """`(bs, weight)` of a BSDF's sample, on the lanes `active` those of the medium's phase function
    at `si`."""
    here = dr.select(active, medium, dr.zeros(mi.MediumPtr))
    mei = point_in(here, si.p, si.time, si.wavelengths, si.to_world(si.wi))
    wo, phase_weight, pdf = sample_direction(traits, mei, choice, point, active)
    bs.wo = dr.select(active, si.to_local(wo), bs.wo)
    bs.pdf = dr.select(active, pdf, bs.pdf)
    bs.eta = dr.select(active, 1, bs.eta)
    bs.sampled_type = dr.select(active, mi.UInt32(0), bs.sampled_type)
    return bs, dr.select(active, dr.select(pdf > 0, mi.Spectrum(phase_weight), 0), weight)


def medium_behind(si, medium, wo, active):
    """The medium of paths that go on from `si` in direction `wo`."""
    return dr.select(active & si.is_medium_transition(), si.target_medium(wo), medium)


# --- Vertices ---------------------------------------------------------------------------------


def phase_f_and_pdf(medium, p, wavelengths, to_camera, to_light, active):
    """The phase function [1/sr] of camera paths at points in media, and the density with which they
    go on to the light's side."""
    medium = dr.select(active, medium, dr.zeros(mi.MediumPtr))
    phase, context = medium.phase_function(), mi.PhaseFunctionContext(None)
    mei = point_in(medium, p, mi.Float(0), wavelengths, to_camera)
    return phase.eval_pdf(context, mei, to_light, active)


def adjoint_factor(traits, medium, p, wavelengths, to_camera, to_light, active):
    """The phase function of a light sub-path over that of a camera path through the same point, and
    so are their densities: 1 but in media of flakes."""
    if not traits.has_flakes:
        return 1
    medium = dr.select(active, medium, dr.zeros(mi.MediumPtr))
    here = point_in(medium, p, mi.Float(0), wavelengths)
    return flakes.adjoint_factor(here, to_camera, to_light, active)


def phase_of_photons(traits, *where):
    """`(value, pdf, adjoint)`: those of `phase_f_and_pdf`, and the `adjoint_factor` by which value
    and density of light sub-paths are larger; `where`: as of both."""
    return *phase_f_and_pdf(*where), adjoint_factor(traits, *where)


def scattered_share(medium, p, wavelengths, active, towards=None):
    """`(sigma_s, albedo, extinction)` at points: scattering coefficient [1/m] (a spectrum), that
    over the extinction (a spectrum: what a scattering multiplies throughput with where all channels
    have the same, see `collision`), and the extinction, the channels' mean [1/m]; in media of
    flakes for light that goes `towards` a direction. Weights know of these: they need a function of
    the path's vertices alone, and give no direction."""
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(
        point_in(medium, p, mi.Float(0), wavelengths, towards), active
    )
    total = channel_mean(sigma_t)
    albedo = dr.select(total > 0, sigma_s * dr.rcp(dr.maximum(total, 1e-30)), 0)
    return sigma_s, albedo, total


def albedo_mean(sides, active):
    """Albedo at vertices in media (`vertex.Sides`): mean scattering over mean extinction."""
    medium = dr.select(active, sides.above, dr.zeros(mi.MediumPtr))
    _, albedo, _ = scattered_share(medium, sides.p, sides.wavelengths, active)
    return channel_mean(albedo)


def direct_light(scene, traits, lights, ref, sides, draws, active):
    """`Lights.sample_direct` through media and boundaries."""
    ds, light, pdf = lights.propose_direct(ref, draws, active)
    lit = active & (dr.max(light) > 0)
    shadow = lights.shadow_ray(ref, ds, lights.guide is not None)
    kept, _ = transmittance(
        scene, traits, shadow, sides.medium(ref.n, ds.d), own_stream(draws, SHADOW_SALT), lit
    )
    return ds, dr.select(lit, light * kept, 0), pdf


def transmitted(
    scene, traits, p, n, sides, d, distance, wavelengths, rng, active, through_emitters=False
):
    """Share of light that gets from vertices `p` (with geometric normals `n`) to the points
    `distance` away in direction `d`; `through_emitters`: as of `transmittance`."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.p, si.n, si.wavelengths = p, mi.Normal3f(n), wavelengths
    ray = si.spawn_ray_to(p + d * distance)
    kept, _ = transmittance(scene, traits, ray, sides.medium(n, d), rng, active, through_emitters)
    return kept
