"""The media in which emitters stand.

Mitsuba's `volpath` needs no such thing: its paths come from the sensor. Scenes therefore seldom say
it, and light sub-paths must find out: the medium at a point is the one on the near side of whatever
boundary is met first, straight on or after reflections by what bounds no medium.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.random import next_2d, streams
from ..core.traits import UnsupportedScene

WALKS = 64
"""Random walks from an emitter, or from the sensor."""
LONGEST_WALK = 32
"""Segments of a walk at most. Those that have met no boundary by then tell nothing."""
LARGEST_DOUBT = 0.1
"""Share of an emitter's walks that may find another medium than most do, through gaps between
shapes."""
UNDECIDED, OUTSIDE = -1, -2
"""Stand for walks that tell nothing, and for those that have left the scene."""


def surrounding_media(scene, ray):
    """The registry numbers of the media where rays start (0: none), `OUTSIDE` or `UNDECIDED`
    (NumPy, one a ray)."""
    count = dr.width(ray)
    rng = streams(dr.arange(mi.UInt32, count), mi.UInt32(0x6D656469))
    found = dr.full(mi.Int32, UNDECIDED, count)
    walking = dr.full(mi.Bool, True, count)
    for _ in range(LONGEST_WALK):
        si = scene.ray_intersect(ray, walking)
        left = walking & ~si.is_valid()
        met = walking & si.is_valid()
        boundary = met & si.is_medium_transition()
        medium = mi.Int32(dr.reinterpret_array(mi.UInt32, si.target_medium(-ray.d)))
        found = dr.select(boundary, medium, dr.select(left, OUTSIDE, found))
        walking = met & ~boundary
        normal = dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, ray.d))
        ray = si.spawn_ray(
            mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(next_2d(rng)))
        )
        dr.eval(found, walking, ray, rng)
        if not dr.any(walking):
            break
    return np.array(found)


def number_of(medium):
    """The registry number of a medium, 0 for none."""
    if medium is None:
        return 0
    return int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(medium))[0])


def most_frequent(found):
    """Of what walks have found, that which most of those have that tell something, and their share
    of these."""
    told = found[found != UNDECIDED]
    if not len(told):
        return UNDECIDED, 1.0
    values, counts = np.unique(told, return_counts=True)
    return int(values[counts.argmax()]), counts.max() / len(told)


def media_beyond_boundaries(scene, sensor, plugin):
    """The registry numbers of the media around points whose walks end `OUTSIDE` and `UNDECIDED`
    (opaque walls all around), a dictionary: the sensor's, where it stands at such a point, too;
    else none. Raises `UnsupportedScene` where the sensor is inside of a boundary and names another
    medium than that has."""
    rng = streams(dr.arange(mi.UInt32, WALKS), mi.UInt32(0x73656E73))
    ray, _ = sensor.sample_ray_differential(0, 0.5, next_2d(rng), next_2d(rng))
    ray = mi.Ray3f(ray)
    dr.eval(ray)
    named, (met, _) = number_of(sensor.get_medium()), most_frequent(surrounding_media(scene, ray))
    if met >= 0 and met != named:
        raise UnsupportedScene(
            f"{plugin}: the sensor stands in {_words(met)}, says the boundary that its rays meet "
            f"first, but it names {_words(named)}; a sensor in a medium needs a reference to it"
        )
    return {place: named if met == place else 0 for place in (OUTSIDE, UNDECIDED)}


def _words(number):
    return "no medium" if number == 0 else "a medium"


def media_at_emitters(lights, beyond, plugin):
    """The registry number of the medium around each of the `lights.emitters`, a list. `beyond`: as
    of `media_beyond_boundaries`; what an emitter says of itself counts where walks tell nothing.
    Raises `UnsupportedScene` for emitters that stand in several media."""
    numbers = []
    for index, (emitter, kind) in enumerate(zip(lights.emitters, lights.kinds)):
        if kind in ("environment", "directional"):
            numbers.append(beyond[OUTSIDE])
            continue
        shape = emitter.get_shape()
        if shape is not None and shape.is_medium_transition():
            numbers.append(number_of(shape.exterior_medium()))
            continue
        rng = streams(
            dr.arange(mi.UInt32, WALKS), dr.opaque(mi.UInt32, index)
        )  # one kernel for all
        ray, _ = emitter.sample_ray(0, 0.5, next_2d(rng), next_2d(rng))
        ray = mi.Ray3f(ray)
        dr.eval(ray)
        found = surrounding_media(lights.scene, ray)
        met, share = most_frequent(np.where(found == OUTSIDE, beyond[OUTSIDE], found))
        if share < 1 - LARGEST_DOUBT:
            raise UnsupportedScene(
                f"{plugin}: emitter {emitter.class_name()} ({emitter.id()}) stands in several "
                "media; split it at their boundary"
            )
        if met == UNDECIDED and emitter.get_medium() is not None:
            met = number_of(emitter.get_medium())
        numbers.append(beyond.get(met, met))
    return numbers
