"""Sensors seen from the scene: the point of the film that sees a surface point, and how densely
camera rays come there.

Mitsuba's `sample_direction` knows perspective sensors, with and without a lens, but not
orthographic ones, whose rays are all parallel.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .camera import behind_emitters
from .camera_rays import axis_of

CONNECTED = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")

SAME_POINT = 1e-4
"""Relative difference of distances up to which a ray has met the point towards which it was
sent."""
ROUNDED = 1e-6
"""Relative to the largest coordinate: how far rounding may move a point."""


class Lens:
    """What joins surface points to a sensor. Attribute `connects`: whether that is possible; other
    sensors are only met by camera rays."""

    def __init__(self, sensor):
        self.sensor = sensor
        name = sensor.class_name()
        self.connects = name in CONNECTED
        self.parallel = name == "OrthographicCamera"
        if not self.connects:
            return
        corners = [
            sensor.sample_ray(0, 0.5, mi.Point2f(u, v), mi.Point2f(0.5))[0]
            for u, v in ((0, 0), (1, 0), (0, 1))
        ]
        if self.parallel:
            self.origin, self.across, self.down = (
                corners[0].o,
                corners[1].o - corners[0].o,
                corners[2].o - corners[0].o,
            )
            self.axis, self.reach = corners[0].d, corners[0].maxt
        else:
            self.axis = axis_of(sensor)
            first, *others = [ray.d / dr.dot(ray.d, self.axis) for ray in corners]
            self.area = dr.norm(dr.cross(*[other - first for other in others]))
            self.near = dr.opaque(mi.Float, sensor.near_clip())
            self.far = dr.opaque(mi.Float, sensor.far_clip())

    def connect(self, p, time, aperture, active):
        """Joins points `p` to the point of the lens that `aperture` (uniform in [0, 1]^2, as for
        `sample_ray`) chooses.

        Returns `(d, distance, film, density, valid)`: the direction to the sensor and the distance
        to the near clipping plane along it; the position on the film in pixels, crop offset
        included; and the density [1/m^2], per area across `d` at `p`, of camera rays through that
        point of the lens that are spread evenly over the crop window. `valid` is false outside the
        window and the clipping planes.
        """
        film = self.sensor.film()
        offset, size = mi.ScalarVector2f(film.crop_offset()), mi.ScalarVector2f(film.crop_size())
        if self.parallel:
            to_p = p - self.origin
            distance = dr.dot(to_p, self.axis)
            area = dr.abs(dr.dot(self.axis, dr.cross(self.across, self.down)))
            u = dr.dot(dr.cross(to_p, self.down), self.axis) / dr.dot(
                dr.cross(self.across, self.down), self.axis
            )
            v = dr.dot(dr.cross(self.across, to_p), self.axis) / dr.dot(
                dr.cross(self.across, self.down), self.axis
            )
            valid = (
                active
                & (distance > 0)
                & (distance < self.reach)
                & (u >= 0)
                & (u < 1)
                & (v >= 0)
                & (v < 1)
            )
            return -self.axis, distance, mi.Point2f(u, v) * size + offset, dr.rcp(area), valid
        reference = dr.zeros(mi.Interaction3f, dr.width(p))
        reference.p, reference.time = p, time
        # Its weight knows neither the principal point nor the clipping planes (Mitsuba 3.9.1).
        ds, _ = self.sensor.sample_direction(reference, aperture, active)
        cosine = -dr.dot(ds.d, self.axis)
        depth = ds.dist * cosine
        valid = active & (depth > self.near) & (depth < self.far)
        valid &= dr.all((ds.uv >= 0) & (ds.uv < size))
        density = dr.rcp(self.area * dr.square(ds.dist) * cosine * dr.square(cosine))
        near = self.near * dr.rcp(dr.maximum(cosine, 1e-6))
        return ds.d, ds.dist - near, ds.uv + offset, dr.select(valid, density, 0), valid

    def density(self, p, time, aperture, active):
        """The density that `connect` returns; zero where it is not valid."""
        _, _, _, density, valid = self.connect(p, time, aperture, active)
        return dr.select(valid, density, 0)


def unblocked(scene, p, n, d, distance, active):
    """Whether nothing stands between points `p` (with geometric normals `n`) and those `distance`
    away in direction `d`."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.p, si.n = p, mi.Normal3f(n)
    ray = si.spawn_ray_to(p + d * distance)
    return active & ~scene.ray_test(ray, active)


def close_to(p, distance):
    """How far from points `p`, which are `distance` away from others, a ray may meet them."""
    return SAME_POINT * distance + ROUNDED * dr.max(dr.abs(p))


def on_emitter(scene, p, d, distance, active):
    """Whether points `p` lie on emitters' shapes. `d`: any direction that leaves the surface there,
    and `distance` how far it is to the next that matters."""
    near = close_to(p, distance)
    hit = scene.ray_intersect_preliminary(mi.Ray3f(p + d * near, -d), coherent=False, active=active)
    return active & hit.is_valid() & (hit.t < 2 * near) & hit.shape.is_emitter()


def unblocked_by_visible(scene, integrator, p, d, distance, active):
    """The same towards a sensor that does not see emitters' shapes (`hide_emitters`): whether a
    look from there through all of them ends at the point. It does not where the point lies on such
    a shape itself."""
    ray = mi.Ray3f(p + d * distance, -d)
    hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    hit, ray = behind_emitters(scene, integrator, hit, ray, active)
    expected = dr.norm(p - ray.o)
    return active & hit.is_valid() & (dr.abs(hit.t - expected) < close_to(p, distance))
