"""Joining kept vertices of light and camera sub-paths: who is joined with whom, and what a joined pair carries.

A pair is two places in the buffers of `subpaths`. Pairs are written out first and evaluated flat: every lane has one.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .junctions import SMALLEST_COSINE
from .lenses import unblocked, unblocked_by_visible
from .packing import Store
from .subpaths import junction_of, read_vertices


@dataclass
class Connection:
    """Two sub-paths joined by a straight segment, one a lane.

    `value`: radiance that the camera path's pixel gets (spectrum, throughput and flux included, of one light sub-path; visibility not);
    `d`, `distance`: from the camera's vertex to the light's; `density_at_light`, `density_at_camera` [1/m^2]: with which the camera's end makes the
    light's end and the other way round; `back_at_light`, `back_at_camera`: densities per projected solid angle with which the other side goes on
    there to the vertex before.
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
    at_camera = junction_of(traits, camera, wavelengths, active)
    at_light = junction_of(traits, light, wavelengths, active)
    value, p_camera, back_at_camera = at_camera.between(camera["towards"], d, active)
    value_light, back_at_light, p_light = at_light.between(-d, light["towards"], active)
    leaving = dr.abs(dr.dot(light["n"], d))
    landing = dr.maximum(dr.abs(dr.dot(light["n"], light["towards"])), SMALLEST_COSINE)
    geometry = leaving * dr.abs(dr.dot(camera["n"], d)) * dr.rcp(squared)
    carried = camera["throughput"] * value * value_light * light["throughput"] * (leaving * dr.rcp(landing * squared))
    return Connection(dr.select(active, carried, 0), d, distance, p_camera * geometry, p_light * geometry, back_at_light, back_at_camera)


def by_path(vertices, count, lengths, capacity: int):
    """`(start, order)`: the kept vertices of sub-path i, in the order of their `number`, are at the places `order[start[i]]`, `order[start[i] + 1]`, ..."""
    start = dr.prefix_sum(lengths)
    dr.eval(start)
    index = dr.arange(mi.UInt32, capacity)
    active = index < dr.gather(mi.UInt32, count, 0)
    order = dr.zeros(mi.UInt32, capacity)
    place = dr.gather(mi.UInt32, start, dr.gather(mi.UInt32, vertices["path"], index, active), active)
    dr.scatter(order, index, place + dr.gather(mi.UInt32, vertices["number"], index, active), active)
    return start, order


@dr.syntax
def list_pairs(camera, camera_count, camera_capacity: int, light, start, order, lengths, max_depth: int, capacity: int):
    """Every camera vertex with every vertex of the light sub-path of its own number, as far as `max_depth` lets them.

    Left out are pairs of Lambertian vertices that turn their backs on each other. Returns `(camera places, light places, count)`.
    """
    store = Store(camera=dr.empty(mi.UInt32, capacity), light=dr.empty(mi.UInt32, capacity), count=dr.zeros(mi.UInt32, 1))
    index = dr.arange(mi.UInt32, camera_capacity)
    active = index < dr.gather(mi.UInt32, camera_count, 0)
    path = dr.gather(mi.UInt32, camera["path"], index, active)
    depth = dr.gather(mi.UInt32, camera["depth"], index, active)
    p, n = dr.gather(mi.Point3f, camera["p"], index, active), dr.gather(mi.Vector3f, camera["ns"], index, active)
    n = dr.mulsign(n, dr.dot(n, dr.gather(mi.Vector3f, camera["towards"], index, active)))
    simple = dr.gather(mi.Float, camera["density"], index, active) >= 0
    place = dr.gather(mi.UInt32, start, path, active)
    left = dr.gather(mi.UInt32, lengths, path, active)

    while dr.hint(left > 0, label="pairs"):
        vertex = dr.gather(mi.UInt32, order, place)
        keep = mi.Bool(True)
        if dr.hint(max_depth > 0, mode='scalar'):
            keep &= dr.gather(mi.UInt32, light["depth"], vertex) + depth + 1 <= max_depth
        offset = dr.gather(mi.Point3f, light["p"], vertex, keep) - p
        keep &= ~simple | (dr.dot(offset, n) > 0)
        normal = dr.gather(mi.Vector3f, light["ns"], vertex, keep)
        normal = dr.mulsign(normal, dr.dot(normal, dr.gather(mi.Vector3f, light["towards"], vertex, keep)))
        keep &= (dr.gather(mi.Float, light["density"], vertex, keep) < 0) | (dr.dot(offset, normal) < 0)
        slot = dr.scatter_inc(store.count, mi.UInt32(0), keep)
        keep &= slot < capacity
        dr.scatter(store.camera, index, slot, keep)
        dr.scatter(store.light, vertex, slot, keep)
        place += 1
        left -= 1
    return store.camera, store.light, store.count


def visible(scene, connection, camera, active):
    """Whether nothing stands between the two ends."""
    return unblocked(scene, camera["p"], camera["n"], connection.d, connection.distance, active)


@dataclass
class LensConnection:
    """Light vertices joined to the sensor.

    `value`: flux times importance (spectrum): its sum over light sub-paths, over their number, is the mean radiance of the pixels times their
    share of the crop window; `film`: position in pixels; `density` [1/m^2]: area density there of camera rays through the crop window;
    `back`: density per projected solid angle with which a camera path would go on; `active`: visible from the sensor, inside the film.
    """

    value: mi.Spectrum
    film: mi.Point2f
    density: mi.Float
    back: mi.Float
    active: mi.Bool


def join_sensor(scene, integrator, traits, lens, light, aperture, time, wavelengths, hide_emitters, active):
    """The `LensConnection` of light vertices (records as of `read_vertices`)."""
    d, distance, film, density, active = lens.connect(light["p"], time, aperture, active)
    junction = junction_of(traits, light, wavelengths, active)
    value, back, _ = junction.between(d, light["towards"], active)
    leaving = dr.abs(dr.dot(light["n"], d))
    landing = dr.maximum(dr.abs(dr.dot(light["n"], light["towards"])), SMALLEST_COSINE)
    active = active & (dr.max(value) > 0)
    if hide_emitters:
        active &= unblocked_by_visible(scene, integrator, light["p"], d, distance, active)
    else:
        active &= unblocked(scene, light["p"], light["n"], d, distance, active)
    density = density * leaving
    return LensConnection(light["throughput"] * value * (density * dr.rcp(landing)), film, density, back, active)
