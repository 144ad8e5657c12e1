"""How wide a pixel is where a camera path meets a surface: ray cones.

A path is a thin cone (Amanatides 1984, Ray tracing with cones), as wide as a pixel. It has a
`width`, and grows by its `spread` per distance. What mirrors and lenses do to it is left out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .camera_rays import axis_of


class RayCones:
    """Cones of camera paths through the pixels of a sensor: their width at the sensor, and their
    spread along its `axis`."""

    def __init__(self, sensor):
        middle = mi.Point2f(0.5)
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, middle, middle)
        self.axis = axis_of(sensor)
        spread = _mean_size(ray.d_x - ray.d, ray.d_y - ray.d)
        ahead = dr.maximum(dr.abs(dr.dot(ray.d, self.axis)), 1e-3)
        self.width = _mean_size(ray.o_x - ray.o, ray.o_y - ray.o)
        self.spread = spread / _falling_off(ahead)
        dr.make_opaque(self.tables())

    def tables(self):
        """What recorded functions read."""
        return [self.axis, self.width, self.spread]

    def begin(self):
        """A cone: its width, and its spread, which the first segment tells."""
        return [mi.Float(self.width), mi.Float(0)]

    def grown(self, cone, d, distance, first, active):
        """The cone so much further in direction `d`; `first`: along a path's first segment."""
        width, spread = cone
        cosine = dr.abs(dr.dot(d, self.axis))
        spread = dr.select(first, self.spread * _falling_off(cosine), spread)
        return [dr.select(active, width + spread * distance, width), spread]

    def arrived(self, cone, at, active):
        """The cone at what it has met (a `CameraArrival`)."""
        return self.grown(cone, at.ray.d, at.si.t, at.depth == 1, active)


def cones_of(sensor):
    """The `RayCones` of a sensor; None where it does not tell how near pixels differ."""
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
