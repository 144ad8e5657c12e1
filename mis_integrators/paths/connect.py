"""Joining kept vertices of light and camera sub-paths: who is joined with whom, and what a joined
pair carries.

A pair is two places in the buffers of `subpaths`. Pairs are written out first and evaluated flat:
every lane has one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..core.packing import Store
from .media import transmitted
from .sensor import on_emitter, unblocked, unblocked_by_visible
from .setting import Limits, World
from .subpaths import Kept, read_vertices, sides_of, vertex_bsdf_of
from .vertex import SMALLEST_COSINE, facing

Array = Any


@dataclass
class Connection:
    """Two sub-paths joined by a straight segment, one a lane.

    `value`: radiance that the camera path's pixel gets (spectrum, throughput and flux included, of
    one light sub-path; visibility not); `d`, `distance`: from the camera's vertex to the light's;
    `density_at_light`, `density_at_camera` [1/m^2]: with which the camera's end makes the light's
    end and the other way round; `back_at_light`, `back_at_camera`: densities per projected solid
    angle with which the other side goes on there to the vertex before.
    """

    value: mi.Spectrum
    d: mi.Vector3f
    distance: mi.Float
    density_at_light: mi.Float
    density_at_camera: mi.Float
    back_at_light: mi.Float
    back_at_camera: mi.Float


def join(traits, camera, light, wavelengths, active):
    """The `Connection` of camera and light vertices (records as of `read_vertices`)."""
    offset = light["p"] - camera["p"]
    squared = dr.maximum(dr.squared_norm(offset), 1e-20)
    distance = dr.sqrt(squared)
    d = offset * dr.rcp(distance)
    at_camera = vertex_bsdf_of(traits, camera, wavelengths, active)
    at_light = vertex_bsdf_of(traits, light, wavelengths, active)
    value, p_camera, back_at_camera = at_camera.f_and_pdfs(camera["towards"], d, active)
    value_light, back_at_light, p_light = at_light.f_and_pdfs(-d, light["towards"], active)
    value_light *= at_light.adjoint(-d, light["towards"], active)
    leaving = facing(traits, light["n"], d)
    landing = dr.maximum(facing(traits, light["n"], light["towards"]), SMALLEST_COSINE)
    geometry = leaving * facing(traits, camera["n"], d) * dr.rcp(squared)
    carried = (
        camera["throughput"]
        * value
        * value_light
        * light["throughput"]
        * (leaving * dr.rcp(landing * squared))
    )
    return Connection(
        dr.select(active, carried, 0),
        d,
        distance,
        p_camera * geometry,
        p_light * geometry,
        back_at_light,
        back_at_camera,
    )


@dataclass(frozen=True)
class ByPath:
    """Kept `vertices` in the order of their paths: those of path i, `lengths[i]` of them, are at
    the places `order[start[i]]`, `order[start[i] + 1]`, ..., in the order of their `number`."""

    vertices: dict[str, Array]
    start: mi.UInt32
    order: mi.UInt32
    lengths: mi.UInt32


def by_path(light: Kept, lengths):
    """`ByPath` of kept vertices of sub-paths that have so many each."""
    start = dr.prefix_sum(lengths)
    dr.eval(start)
    index = dr.arange(mi.UInt32, light.capacity)
    active = index < dr.gather(mi.UInt32, light.count, 0)
    order = dr.zeros(mi.UInt32, light.capacity)
    vertex = read_vertices(light.vertices, index, active, ("path", "number"))
    dr.scatter(
        order, index, dr.gather(mi.UInt32, start, vertex["path"], active) + vertex["number"], active
    )
    dr.eval(start, order)
    return ByPath(light.vertices, start, order, lengths)


@dr.syntax
def list_pairs(camera: Kept, light: ByPath, max_depth: int, capacity: int):
    """Every camera vertex with every vertex of the light sub-path of its own number (modulo
    theirs), as far as `max_depth` lets them: `(camera places, light places, count)`."""
    store = Store(
        camera=dr.empty(mi.UInt32, capacity),
        light=dr.empty(mi.UInt32, capacity),
        room=dr.opaque(mi.UInt32, capacity),
        count=dr.zeros(mi.UInt32, 1),
    )
    # What the loop reads must be plain variables: Dr.Jit would take a dataclass for its state.
    vertices, start, order, lengths = light.vertices, light.start, light.order, light.lengths
    index = dr.arange(mi.UInt32, camera.capacity)
    active = index < dr.gather(mi.UInt32, camera.count, 0)
    z = read_vertices(camera.vertices, index, active, ("path", "depth"))
    partner = z["path"] % dr.width(lengths)
    place = dr.gather(mi.UInt32, start, partner, active)
    left = dr.gather(mi.UInt32, lengths, partner, active)

    while dr.hint(left > 0, label="pairs"):
        vertex = dr.gather(mi.UInt32, order, place)
        keep = mi.Bool(True)
        if dr.hint(max_depth > 0, mode="scalar"):
            y = read_vertices(vertices, vertex, True, ("depth",))
            keep &= y["depth"] + z["depth"] + 1 <= max_depth
        slot = dr.scatter_inc(store.count, mi.UInt32(0), keep)
        keep &= slot < store.room
        dr.scatter(store.camera, index, slot, keep)
        dr.scatter(store.light, vertex, slot, keep)
        place += 1
        left -= 1
    return store.camera, store.light, store.count


def visible(scene, connection, camera, active):
    """Whether nothing stands between the two ends."""
    return unblocked(scene, camera["p"], camera["n"], connection.d, connection.distance, active)


def kept_between(scene, traits, connection, camera, wavelengths, rng, active):
    """Share of light (spectrum) that media and boundaries leave between the two ends."""
    sides = sides_of(camera, wavelengths)
    d, distance = connection.d, connection.distance
    return transmitted(
        scene, traits, camera["p"], camera["n"], sides, d, distance, wavelengths, rng, active
    )


@dataclass
class LensConnection:
    """Light vertices joined to the sensor.

    `value`: flux times importance (spectrum): its sum over light sub-paths, over their number, is
    the mean radiance of the pixels times their share of the crop window; `film`: position in
    pixels; `density` [1/m^2]: area density there of camera rays through the crop window; `back`:
    density per projected solid angle with which a camera path would go on; `active`: visible from
    the sensor, inside the film.
    """

    value: mi.Spectrum
    film: mi.Point2f
    density: mi.Float
    back: mi.Float
    active: mi.Bool


def join_sensor(
    world: World, limits: Limits, integrator, lens, light, aperture, wavelengths, active, rng=None
):
    """The `LensConnection` of light vertices (records as of `read_vertices`). `integrator`: as of
    `CameraPass`; `rng`: a generator, in scenes with media."""
    scene, traits, time = world.scene, world.traits, mi.Float(lens.sensor.shutter_open())
    d, distance, film, density, active = lens.connect(light["p"], time, aperture, active)
    vertex_bsdf = vertex_bsdf_of(world.traits, light, wavelengths, active)
    value, back, _ = vertex_bsdf.f_and_pdfs(d, light["towards"], active)
    value *= vertex_bsdf.adjoint(d, light["towards"], active)
    leaving = facing(traits, light["n"], d)
    landing = dr.maximum(facing(traits, light["n"], light["towards"]), SMALLEST_COSINE)
    active = active & (dr.max(value) > 0)
    if traits.has_media:
        sides, hide = sides_of(light, wavelengths), limits.hide_emitters
        if hide:
            active &= ~on_emitter(scene, light["p"], d, distance, active)
        way = light["p"], light["n"], sides, d, distance, wavelengths
        value *= transmitted(scene, traits, *way, rng, active, hide)
        active &= dr.max(value) > 0
    elif limits.hide_emitters:
        active &= unblocked_by_visible(scene, integrator, light["p"], d, distance, active)
    else:
        active &= unblocked(scene, light["p"], light["n"], d, distance, active)
    density = density * leaving
    return LensConnection(
        light["throughput"] * value * (density * dr.rcp(landing)), film, density, back, active
    )
