"""How wide a pixel is where a camera path meets a surface: ray cones.

A path is a thin cone (Amanatides 1984, Ray tracing with cones), as wide as a pixel. It has a width,
and grows by its spread per distance. Mirrors and boundaries of glass that are bent change the
spread, along each of their two curvatures. So there are three cones: one as if nothing was bent,
and one along each.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .bent_surfaces import curvatures
from .camera_rays import axis_of

NARROWEST = 0.5
"""Tuned: share of its width without lenses that a pixel has at least where disks are as wide as it
is. Narrower ones, near the focus of a lens, would hardly meet a photon."""


class RayCones:
    """Cones of camera paths through the pixels of a sensor: their width at the sensor, and their
    spread along its `axis`."""

    def __init__(self, sensor):
        middle = mi.Point2f(0.5)
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, middle, middle)
        self.axis = axis_of(sensor)
        known = mi.Float(ray.has_differentials)  # else they are zero, and these differences wide
        spread = known * _mean_size(ray.d_x - ray.d, ray.d_y - ray.d)
        ahead = dr.maximum(dr.abs(dr.dot(ray.d, self.axis)), 1e-3)
        self.width = known * _mean_size(ray.o_x - ray.o, ray.o_y - ray.o)
        self.spread = spread / _falling_off(ahead)
        dr.make_opaque(self.tables())

    def tables(self):
        """What recorded functions read."""
        return [self.axis, self.width, self.spread]

    def begin(self):
        """Three cones: widths, and spreads, which the first segment tells."""
        return [mi.Float(value) for _ in range(3) for value in (self.width, 0)]

    def grown(self, cone, d, distance, first, active):
        """The cones so much further in direction `d`; `first`: along a path's first segment."""
        own = self.spread * _falling_off(dr.abs(dr.dot(d, self.axis)))
        after = []
        for width, spread in zip(cone[::2], cone[1::2]):
            spread = dr.select(first, own, spread)
            after += [dr.select(active, width + spread * distance, width), spread]
        return after

    def bent(self, cone, si, towards, bs, active):
        """The cones behind a mirror or a boundary of glass, seen from `towards`, where a path goes
        on by the sample `bs`. To first order in their width, at normal incidence: on a curvature k
        the normals of a width w spread by k w. A mirror adds twice that to the spread s; behind a
        boundary of relative index e it is (s + k w) / e - k w."""
        mirrors, inverse = si.wi.z * bs.wo.z > 0, dr.rcp(bs.eta)
        after = list(cone[:2])
        for curvature, width, spread in zip(curvatures(si, towards), cone[2::2], cone[3::2]):
            turned = curvature * width
            refracted = (spread + turned) * inverse - turned
            found = dr.select(mirrors, spread + 2 * turned, refracted)
            after += [width, dr.select(active, found, spread)]
        return after

    def pixel_width(self, cone):
        """How wide a pixel is: where lenses magnify, by what they do, else as without them. 0 where
        it is below the `NARROWEST`."""
        plain, across, along = cone[::2]
        width = dr.minimum(dr.sqrt(dr.abs(across * along)), plain)
        return dr.select(width < NARROWEST * plain, 0, width)

    def arrived(self, cone, at, active):
        """The cones at what they have met (a `CameraArrival`)."""
        return self.grown(cone, at.ray.d, at.si.t, at.depth == 1, active)


def cones_of(sensor):
    """The `RayCones` of a sensor; None where it does not tell how near pixels differ."""
    if sensor.class_name() == "BatchSensor":  # its rays are those of many
        return None
    cones = RayCones(sensor)
    return cones if (cones.width + cones.spread)[0] > 0 else None


def _mean_size(across, down):
    """The geometric mean of two lengths; 0 where it is no number."""
    size = dr.sqrt(dr.norm(across) * dr.norm(down))
    return mi.Float(dr.select(dr.isfinite(size), size, 0))


def _falling_off(cosine):
    """The spread of a ray with this cosine to the axis, over that along it: the solid angle of a
    pixel falls with its third power."""
    return cosine * dr.sqrt(cosine)
