"""Light sub-paths and the photons they leave."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.packing import Store, float_bits, pack_direction, pack_surface
from ..core.random import next_2d, streams
from ..core.traits import lookup
from .roulette import russian_roulette


def photon_words():
    """32-bit words of a photon's second record: its flux (one a channel or wavelength) and its
    packed direction, padded to a power of two so that it moves in one packet."""
    channels = dr.size_v(mi.Spectrum)
    return {1: 2, 3: 4, 4: 8}[channels]


PATHS_PER_LANE = 8
"""Light sub-paths that a SIMD lane of a CPU traces one after the other: a lane whose path has ended
starts the next at once, instead of waiting for the longest path beside it. (A GPU needs the paths
side by side.)"""


def lane_count(n_paths):
    """Lanes that trace so many light sub-paths."""
    return (
        -(-n_paths // PATHS_PER_LANE) if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else n_paths
    )


def delta_adjoint(wi, wo, eta):
    """Ratio of the cosines of `wi` and `wo` to the normal at which a delta function scattered,
    which a bump or normal map keeps to itself: it lies along wi + eta wo (reflection: eta = 1). One
    where nothing was deflected."""
    half = wi + wo * eta
    ratio = dr.abs(dr.dot(wi, half) / dr.dot(wo, half))
    return dr.select((dr.squared_norm(half) > 1e-6) & dr.isfinite(ratio), ratio, 1)


def sample_perturbed(bsdf, si, bs, delta, weight, rng, active, perturbed):
    """Replaces a light sub-path's BSDF sample where bump or normal maps perturb normals inside
    BSDFs (lanes `perturbed`).

    The adjoint factor of shading normals is then out of sight, so smooth scattering is evaluated
    from the camera's side, where light may even leave below the perturbed horizon: half of the
    directions come from the geometric hemisphere instead. Returns `(bs, delta, weight)`, on those
    lanes with the weight that lacks only the ratio of the geometric cosines.
    """
    smooth = active & perturbed & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    aside = smooth & (rng.next_float32(active) < 0.5)
    facing = mi.Vector3f(dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi))))
    towards = mi.Frame3f(facing).to_world(mi.warp.square_to_cosine_hemisphere(next_2d(rng, active)))
    bs.wo = dr.select(aside, si.to_local(towards), bs.wo)
    bs.eta = dr.select(aside, 1, bs.eta)
    delta = delta & ~aside
    view = mi.SurfaceInteraction3f(si)
    view.wi = mi.Vector3f(bs.wo)
    scattered = smooth & ~delta
    response = bsdf.eval(mi.BSDFContext(), view, si.wi, scattered)
    own_pdf = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Importance), si, bs.wo, scattered)
    pdf = 0.5 * (own_pdf + dr.maximum(dr.dot(facing, si.to_world(bs.wo)), 0) * dr.inv_pi)
    once = dr.select(smooth, 2, mi.Float(1))  # a delta event of a BSDF with a smooth part too
    special = dr.select(
        delta,
        weight * (once * delta_adjoint(si.wi, bs.wo, bs.eta)),
        dr.select(pdf > 1e-9, response / pdf, 0),
    )
    return bs, delta, dr.select(perturbed, special, weight)


def scatter_light(traits, si, bsdf, rng, active):
    """Samples where a light sub-path goes on from a surface.

    Returns `(bs, delta, weight, wo, active)`: Mitsuba's BSDF sample, whether a delta function
    scattered, the flux's factor, the direction in world space, and the paths that go on: those end
    for which shading and geometric normal disagree about the side. The factor includes the adjoint
    one of shading normals (Veach 1997, section 5.3).
    """
    bs, weight = bsdf.sample(
        mi.BSDFContext(mi.TransportMode.Importance),
        si,
        rng.next_float32(active),
        next_2d(rng, active),
        active,
    )
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    if traits.has_perturbed:
        perturbed = lookup(traits.perturbed, bsdf, mi.Bool, active)
        bs, delta, weight = sample_perturbed(bsdf, si, bs, delta, weight, rng, active, perturbed)
    wo = si.to_world(bs.wo)
    wi_shading, wo_shading = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo)
    wi_geometric, wo_geometric = dr.dot(si.n, si.to_world(si.wi)), dr.dot(si.n, wo)
    active = active & (wi_geometric * wi_shading > 0) & (wo_geometric * wo_shading > 0)
    adjoint = dr.abs(wi_shading * wo_geometric / (wo_shading * wi_geometric))
    if traits.has_perturbed:
        adjoint = dr.select(perturbed, dr.abs(wo_geometric / wi_geometric), adjoint)
    return bs, delta, weight * adjoint, wo, active


@dr.syntax
def trace_light_paths(
    scene,
    lights,
    traits,
    seed,
    n_paths: int,
    capacity: int,
    wavelengths,
    shutter_open: float,
    shutter_time: float,
    max_depth: int,
    rr_depth: int,
    keep_direct: bool = False,
    light_state=None,
):
    """Traces `n_paths` light sub-paths and stores photons on surfaces that scatter smoothly.

    Stored are photons of two or more segments that have scattered smoothly at least once
    ("indirect"), and photons that have met only delta surfaces on the way from the emitter
    ("caustic"); a photon's first smooth vertex straight from the emitter is next-event estimation's
    business and is stored with `keep_direct` only (of kind "caustic"). `max_depth` counts the
    segments of a whole path (0 or less: unlimited); a photon's own depth is its number of segments
    from the emitter.

    Returns `(surface, power, count)`: uint32 arrays with four words a photon (position's bits;
    normal, depth and kind packed) and `photon_words()` words a photon (bits of the flux that one
    sub-path carries, packed direction to where it came from), in no particular order, and the
    number of photons, of width one. If it exceeds `capacity` the surplus is missing: repeat the
    pass with more room. Shading normals: Veach 1997, section 5.3 (adjoint factor); where maps
    perturb normals inside BSDFs, these are evaluated from the camera's side instead.

    With a `light_state` (a `mis.state.LightState`) the result has a fourth array: the words that it
    stores with each photon.
    """
    lanes = lane_count(n_paths)
    lane = dr.arange(mi.UInt32, lanes)
    rng = streams(lane, seed)
    words = photon_words()
    store = Store(
        surface=dr.empty(mi.UInt32, 4 * capacity),
        power=dr.empty(mi.UInt32, words * capacity),
        count=dr.zeros(mi.UInt32, 1),
    )
    state = []
    if dr.hint(light_state is not None, mode="scalar"):
        state = light_state.init()
        store.mis_words = dr.empty(mi.UInt32, len(light_state.words(state)) * capacity)
    path = mi.UInt32(lane)  # the lane's next path; then this one plus the number of lanes
    ray = dr.zeros(mi.Ray3f, lanes)
    flux = dr.zeros(mi.Spectrum, lanes)
    strength = dr.zeros(mi.Float, lanes)  # for roulette: one over the flux at the start
    had_delta = dr.full(
        mi.Bool, False, lanes
    )  # met a delta surface (or is out of next-event estimation's reach)
    scattered = dr.full(mi.Bool, False, lanes)  # met a smooth surface
    depth = dr.zeros(mi.UInt32, lanes)
    eta = dr.ones(mi.Float, lanes)
    active = dr.full(mi.Bool, False, lanes)

    while dr.hint(active | (path < n_paths), label="light sub-paths"):
        # ---- Start the lane's next path where one has ended
        begin = ~active & (path < n_paths)
        source = dr.zeros(mi.DirectionSample3f)
        if begin:
            time = mi.Float(shutter_open)
            if dr.hint(shutter_time > 0, mode="scalar"):
                time += rng.next_float32() * shutter_time
            ray, flux, had_delta, source = lights.sample_emission(rng, time, wavelengths)
            strength = dr.rcp(dr.maximum(dr.max(flux), 1e-38))
            scattered = mi.Bool(False)
            depth = mi.UInt32(0)
            eta = mi.Float(1)
            active = dr.max(flux) > 0
            path += lanes
            if dr.hint(light_state is not None, mode="scalar"):
                state = light_state.init()

        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, reorder=False, active=active)
        active &= si.is_valid()
        depth += 1
        bsdf = si.bsdf(ray)
        if dr.hint(light_state is not None, mode="scalar"):
            state = light_state.first_vertex(state, si, source, active & begin & ~had_delta)

        # ---- Store a photon
        keep = (
            active
            & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            & (scattered | had_delta | keep_direct)
        )
        slot = dr.scatter_inc(store.count, mi.UInt32(0), keep)
        keep &= slot < capacity
        dr.scatter(
            store.surface,
            mi.Vector4u(
                float_bits(si.p.x),
                float_bits(si.p.y),
                float_bits(si.p.z),
                pack_surface(si.n, depth, ~scattered),
            ),
            slot,
            keep,
        )
        from_where = pack_direction(-ray.d)
        if dr.hint(words == 2, mode="scalar"):
            dr.scatter(store.power, mi.Vector2u(float_bits(flux[0]), from_where), slot, keep)
        elif dr.hint(words == 4, mode="scalar"):
            dr.scatter(
                store.power,
                mi.Vector4u(
                    float_bits(flux[0]), float_bits(flux[1]), float_bits(flux[2]), from_where
                ),
                slot,
                keep,
            )
        else:
            dr.scatter(
                store.power,
                mi.Vector4u(
                    float_bits(flux[0]),
                    float_bits(flux[1]),
                    float_bits(flux[2]),
                    float_bits(flux[3]),
                ),
                2 * slot,
                keep,
            )
            dr.scatter(store.power, mi.Vector4u(from_where, 0, 0, 0), 2 * slot + 1, keep)
        if dr.hint(light_state is not None, mode="scalar"):
            words_of_state = light_state.words(state)
            parts = len(words_of_state) // 4
            for part in dr.hint(range(max(parts, 1)), mode="scalar"):
                if dr.hint(parts == 0, mode="scalar"):
                    dr.scatter(store.mis_words, mi.Vector2u(words_of_state), slot, keep)
                else:
                    dr.scatter(
                        store.mis_words,
                        mi.Vector4u(words_of_state[4 * part : 4 * part + 4]),
                        parts * slot + part,
                        keep,
                    )

        # ---- Go on: the next photon needs one more segment, and the camera one after it
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth + 2 <= max_depth
        bs, delta, weight, wo, active = scatter_light(traits, si, bsdf, rng, active)
        if dr.hint(light_state is not None, mode="scalar"):
            state = light_state.scatter(state, si, bsdf, bs.wo, active & ~delta)
        flux *= weight
        had_delta |= delta
        scattered |= ~delta
        eta *= bs.eta
        ray = si.spawn_ray(wo)

        flux, active = russian_roulette(
            rng, flux, dr.max(flux) * strength, eta, depth >= rr_depth, active
        )

    if dr.hint(light_state is not None, mode="scalar"):
        return store.surface, store.power, store.count, store.mis_words
    return store.surface, store.power, store.count
