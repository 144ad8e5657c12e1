"""Rays that leave a sensor."""

import drjit as dr
import mitsuba as mi


def axis_of(sensor):
    """The direction in which a sensor looks."""
    return dr.normalize(sensor.world_transform() @ mi.Vector3f(0, 0, 1))


def sample_camera_ray(sensor, time, wavelength_sample, position, aperture, active=True):
    """`sensor.sample_ray`: a ray and its weight. Irradiance meters know rays with differentials
    only."""
    if sensor.class_name() != "IrradianceMeter":
        return sensor.sample_ray(time, wavelength_sample, position, aperture, active)
    ray, weight = sensor.sample_ray_differential(
        time, wavelength_sample, position, aperture, active
    )
    return mi.Ray3f(ray), weight
