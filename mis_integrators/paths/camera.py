"""The tracer of camera sub-paths: one loop, for gathering, for joining, and for vertices alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from ..core.random import next_1d_and_2d, next_2d
from .camera_rays import sample_camera_ray
from .media import begin_flights, interaction_at, medium_behind, sample_phase
from .roulette import russian_roulette
from .setting import CameraPass, Limits, World

Array = State = Any


def film_samples(sensor, pixel, rng):
    """Film positions in pixels, which are numbered row by row (crop offset included).

    Returns `(position in [0, 1]^2 of the crop window, position for splatting)`; with a film that
    samples its border the grid covers the border too, as in Mitsuba's own integrators.
    """
    film = sensor.film()
    width, _ = film_size(sensor)
    corner = (
        mi.Vector2i(mi.Int32(pixel % width), mi.Int32(pixel // width))
        - border_size(film)
        + mi.Vector2i(film.crop_offset())
    )
    position = mi.Vector2f(corner) + mi.Vector2f(next_2d(rng))
    scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
    unit = (position - mi.ScalarVector2f(film.crop_offset())) * scale
    splat = mi.Vector2f(corner) if film.rfilter().is_box_filter() else position
    return mi.Point2f(unit), mi.Point2f(splat)


def pixel_at(sensor, splat):
    """Number of the pixel, as of `film_samples`, at a position for splatting."""
    film = sensor.film()
    corner = mi.ScalarVector2f(film.crop_offset()) - border_size(film)
    place = mi.Point2u(dr.floor(splat - corner))
    return place.x + place.y * film_size(sensor)[0]


def film_size(sensor):
    """Width and height, in pixels, of what camera paths are sent through: the crop window, with its
    border where the film samples it."""
    film = sensor.film()
    return tuple(int(size) + 2 * border_size(film) for size in film.crop_size())


def border_size(film):
    """Pixels beyond each edge of the crop window that camera paths are sent through, too."""
    return film.rfilter().border_size() if film.sample_border() else 0


def film_sample_count(sensor):
    """Pixels that camera paths are sent through."""
    width, height = film_size(sensor)
    return width * height


def within_crop(film, splat):
    """Whether positions for splatting lie in the crop window, and not in a border that the film
    samples besides."""
    if not film.sample_border():
        return mi.Bool(True)
    offset, size = mi.ScalarVector2f(film.crop_offset()), mi.ScalarVector2f(film.crop_size())
    return dr.all((splat >= offset) & (splat < offset + size))


def start_camera_paths(camera_pass: CameraPass):
    """Camera rays of a pass.

    Returns `(path, active, numbers, ray, weight, splat, aperture)`: the index of each, whether
    there is a path of that number, its random numbers (`PathNumbers`), the ray and its weight, the
    position for splatting, and the sample that chose the point of the lens.
    """
    sensor = camera_pass.sensor
    pixel, numbers = camera_pass.pixel, camera_pass.numbers
    path = dr.arange(mi.UInt32, dr.width(pixel))
    active = pixel < film_sample_count(sensor)
    rng = numbers.at(0)
    unit, splat = film_samples(sensor, pixel, rng)
    aperture = next_2d(rng) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += rng.next_float32() * sensor.shutter_open_time()
    ray, weight = sample_camera_ray(
        sensor, time, camera_pass.wavelength_sample, unit, aperture, active
    )
    return path, active, numbers, mi.Ray3f(ray), weight, splat, aperture


def whole_or_nothing(visible):
    """The coverage of paths: one where they are `visible`, as of `CameraArrival`."""
    return dr.select(visible, mi.Float(1), mi.Float(0))


def behind_emitters(scene, integrator, hit, ray, active):
    """Camera rays that meet an emitter's shape, and their hits, moved on to what is behind it
    (`hide_emitters`)."""
    on_light = active & hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 (array comparison)
    behind = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, on_light).spawn_ray(ray.d)
    hit[on_light] = integrator.skip_area_emitters(scene, behind, True, on_light)
    ray.o[on_light] = behind.o
    return hit, ray


@dataclass
class CameraArrival:
    """Camera sub-paths that have met something, one a lane.

    `si`, `hit`, `ray`: the interaction (perhaps invalid), what it is computed from, and the ray
    that led there; `towards`: unit vector to where the sub-path came from; `throughput` that
    arrives; `path`: its number; `depth`: segments so far; `visible`: it has met more than null
    surfaces; `bsdf`: of the surface. In scenes with media, `medium`: the one that it comes through,
    and `scatters`: it scatters there, at no surface (`interaction_at`).
    """

    si: mi.SurfaceInteraction3f
    hit: mi.PreliminaryIntersection3f
    ray: mi.Ray3f
    towards: mi.Vector3f
    throughput: mi.Spectrum
    path: mi.UInt32
    depth: mi.UInt32
    visible: mi.Bool
    bsdf: mi.BSDFPtr
    medium: Any = None
    scatters: Any = None


class CameraVisitor(Protocol):
    """What is done where camera sub-paths meet surfaces and lights. Its state, arrays in
    lists or dictionaries, travels with them. Radiance is a spectrum, zero on all other lanes,
    throughput included."""

    def begin(self, n_paths: int, splat: Array, aperture: Array) -> State:
        """The state before the first surface. `splat`: positions on the film; `aperture`: samples
        that chose the points of the lens."""

    def travel(
        self,
        state: State,
        ray: Array,
        flight: list[Any],
        numbers: Any,
        throughput: Array,
        path: Array,
        depth: Array,
        active: Array,
        unseen: Array | None,
    ) -> tuple[State, Array, Array, list[Any], Array]:
        """In scenes with media: moves sub-paths after `depth` segments to where they scatter or
        meet a surface next: `(state, hit, ray, flight, throughput)`, as `media.next_hit`. `unseen`:
        as of `media.beyond_boundary`."""

    def emission(self, state: State, at: CameraArrival, active: Array) -> Array:
        """Radiance of a light that is met. Not called in scenes without lights that can be met."""

    def unfinished(self, state: State, at: CameraArrival) -> Array:
        """Which sub-paths may scatter at what they have met."""

    def arrive(
        self, state: State, at: CameraArrival, rng: Any, active: Array
    ) -> tuple[State, Array]:
        """The state at a surface, and radiance of direct light there."""

    def leave(
        self,
        state: State,
        at: CameraArrival,
        rng: Any,
        bs: Any,
        weight: Array,
        delta: Array,
        active: Array,
    ) -> tuple[State, Array, Array]:
        """After scattering, by a delta function or not: the state, the throughput's factor (at
        first `weight`), and which sub-paths go on."""

    def cross(self, before: State, after: State, crosses: Array) -> State:
        """In scenes with media: the state, where sub-paths have passed straight through a surface,
        from those before they arrived and after they left."""

    def alpha(self, state: State, visible: Array) -> Array:
        """Coverage of the paths in the end; `visible`: as of `CameraArrival`."""


def traveller(visitor, numbers, path, hide_emitters):
    """`CameraVisitor.travel` of the sub-paths `path` with these `numbers`: a function of those that
    are `visible` in place of `unseen`. (A mask kept for two calls would go through the loop.)"""

    def travel(state, ray, flight, throughput, depth, active, visible):
        unseen = ~visible if hide_emitters else None
        return visitor.travel(state, ray, flight, numbers, throughput, path, depth, active, unseen)

    return travel


@dr.syntax
def trace_camera(
    world: World,
    limits: Limits,
    camera_pass: CameraPass,
    visitor: CameraVisitor,
):
    """Traces the camera paths of a pass and shows what they meet to the `visitor`.

    Returns `(radiance, alpha, splat position)` of each path.
    """
    # What the loop reads must be plain variables: Dr.Jit would take a dataclass for its state.
    scene, traits = world.scene, world.traits
    max_depth, rr_depth = limits.max_depth, limits.rr_depth
    hide_emitters = limits.hide_emitters
    path, active, numbers, ray, sensor_weight, splat, aperture = start_camera_paths(camera_pass)
    throughput = mi.Spectrum(sensor_weight)
    radiance = mi.Spectrum(0)
    depth = mi.UInt32(0)
    eta = mi.Float(1)
    context = mi.BSDFContext()
    state = visitor.begin(dr.width(path), splat, aperture)
    visible = mi.Bool((scene.environment() is not None) and not hide_emitters)
    if dr.hint(max_depth == 0, mode="scalar"):
        active &= False

    flight = begin_flights(traits, camera_pass.sensor.get_medium())
    travel = traveller(visitor, numbers, path, hide_emitters)
    if dr.hint(traits.has_media, mode="scalar"):
        state, hit, ray, flight, throughput = travel(
            state, ray, flight, throughput, depth, active, visible
        )
    else:
        hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if dr.hint(hide_emitters, mode="scalar"):
            hit, ray = behind_emitters(scene, camera_pass.integrator, hit, ray, active)

    while dr.hint(active, label="camera sub-paths"):
        depth += 1
        if dr.hint(traits.has_media, mode="scalar"):
            medium, event, scatters = flight
            si = interaction_at(hit, ray, scatters, active)
            rng = numbers.at(event)
        else:
            medium = scatters = None
            si = hit.compute_surface_interaction(ray, mi.RayFlags.All, active=active)
            rng = numbers.at(depth)
        before = state
        at = CameraArrival(
            si, hit, ray, -ray.d, throughput, path, depth, visible, si.bsdf(ray), medium, scatters
        )

        # ---- Emission met by the path
        if dr.hint(traits.has_light_surfaces, mode="scalar"):
            radiance += visitor.emission(state, at, active)

        # ---- Arrive
        active &= si.is_valid() & visitor.unfinished(state, at)
        met = mi.Bool(active)  # a surface, perhaps the last one
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth < max_depth
        state, direct = visitor.arrive(state, at, rng, active)
        radiance += direct

        # ---- Go on
        choice, point = next_1d_and_2d(rng, met)
        if dr.hint(traits.has_media, mode="scalar"):
            bs, weight = at.bsdf.sample(context, si, choice, point, met & ~scatters)
            bs, weight = sample_phase(traits, medium, si, choice, point, bs, weight, met & scatters)
        else:
            bs, weight = at.bsdf.sample(context, si, choice, point, met)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        visible |= met & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        state, weight, active = visitor.leave(state, at, rng, bs, weight, delta, active)
        throughput *= weight
        eta *= bs.eta
        ray = si.spawn_ray(si.to_world(bs.wo))
        begun = depth >= rr_depth
        if dr.hint(traits.has_media, mode="scalar"):
            crosses = met & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            state = visitor.cross(before, state, crosses)
            depth -= dr.select(crosses, mi.UInt32(1), mi.UInt32(0))
            active |= crosses
            begun &= ~crosses
            flight = [medium_behind(si, medium, ray.d, met), event, scatters]
        throughput, active = russian_roulette(
            rng, throughput, dr.max(throughput), eta, begun, active
        )
        if dr.hint(traits.has_media, mode="scalar"):
            state, hit, ray, flight, throughput = travel(
                state, ray, flight, throughput, depth, active, visible
            )
        else:
            hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    return radiance, visitor.alpha(state, visible), splat
