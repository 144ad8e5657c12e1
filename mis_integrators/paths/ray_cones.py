"""How wide a pixel is where a camera path meets a surface: ray cones.

A path is a thin cone (Amanatides 1984, Ray tracing with cones), as wide as a pixel. It has a
`width`, and grows by its `spread` per distance. What mirrors and lenses do to it is left out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

AHEAD = 0.5
"""Film position, in units of the crop window, at which a sensor is asked for its ray
differential."""


class RayCones:
    """Cones of camera paths through the pixels of a sensor."""

    def __init__(self, sensor):
        middle = mi.Point2f(AHEAD)
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, middle, middle)
        self.axis = dr.normalize(sensor.world_transform() @ mi.Vector3f(0, 0, 1))
        self.width = dr.opaque(mi.Float, _mean_size(ray.o_x - ray.o, ray.o_y - ray.o))
        at_middle = _mean_size(ray.d_x - ray.d, ray.d_y - ray.d)
        ahead = float(dr.abs(dr.dot(ray.d, self.axis))[0])
        self.spread = dr.opaque(mi.Float, at_middle / max(ahead, 1e-3) ** 1.5)
        self.exist = float((self.width + self.spread)[0]) > 0
        dr.make_opaque(self.axis)

    def tables(self):
        """What recorded functions read."""
        return [self.axis, self.width, self.spread]

    def begin(self):
        """A cone: its width, and its spread, which the first segment tells."""
        return [mi.Float(self.width), mi.Float(0)]

    def arrived(self, cone, at, active):
        """The cone at what it has met (a `CameraArrival`).

        The solid angle of a pixel falls with the third power of the cosine between the ray and the
        axis."""
        width, spread = cone
        cosine = dr.abs(dr.dot(at.ray.d, self.axis))
        spread = dr.select(at.depth == 1, self.spread * cosine * dr.sqrt(cosine), spread)
        return [dr.select(active, width + spread * at.si.t, width), spread]


def cones_of(sensor):
    """The `RayCones` of a sensor; None where it does not tell how near pixels differ."""
    cones = RayCones(sensor)
    return cones if cones.exist else None


def _mean_size(across, down):
    """The geometric mean of two lengths, a number; 0 where it is none."""
    size = float(dr.sqrt(dr.norm(across) * dr.norm(down))[0])
    return size if 0 < size < float("inf") else 0.0
