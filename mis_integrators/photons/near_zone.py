"""The zone close to a sensor where volume photons are not joined with it.

A photon that is joined with a sensor (`sensor_light`) brings light by the inverse square of its
distance. In fog around the sensor the few closest ones would be bright dots. Photons in the zone
are gathered along beams instead, in wide disks: near pixels share them, but the zone has little of
the light, an eighth in even fog. Its disks do not shrink from iteration to iteration.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.spectra import channel_mean
from .volume import place_layout
from .volume_radii import weighted_median

DEPTH = 1 / 4
"""Tuned: how deep the zone is, over the median depth of the light of photons that the sensor
sees."""
RADIUS = 1 / 8
"""Tuned: radius of the disks across beams there, over the zone's depth. (Photons that lie densely
have less, as everywhere.)"""


class NearZone:
    """What is less deep than `depth` before a sensor, along its axis, and the `radius` of the disks
    there (numbers; zero until `measure` is called, and for sensors whose rays are parallel)."""

    def __init__(self, lens):
        sensor = lens.sensor
        self.lens = lens
        self.origin = mi.Point3f(sensor.world_transform() @ mi.Point3f(0))
        self.axis = mi.Vector3f(lens.axis)
        dr.make_opaque(self.origin, self.axis)
        self._set(0.0)

    def _set(self, depth):
        self.depth = dr.opaque(mi.Float, depth)
        self.radius = dr.opaque(mi.Float, RADIUS * depth)

    def tables(self):
        """What recorded functions read."""
        return [self.origin, self.axis, self.depth, self.radius]

    def measure(self, place, light):
        """Finds the depth by the `light` of volume photons at `place` that are joined with the
        sensor (a `SensorLight`), none of them in a zone."""
        if self.lens.parallel:
            return
        index = dr.arange(mi.UInt32, place_layout().capacity(place))
        depths = self.depth_of(place_layout().read(place, index)["p"])
        seen, value = np.array(light.active), channel_mean(light.value)
        self._set(DEPTH * weighted_median(np.array(depths)[seen], np.array(value)[seen]))

    def depth_of(self, p):
        """How deep points lie before the sensor."""
        return dr.dot(p - self.origin, self.axis)

    def holds(self, p):
        """Whether points lie in the zone."""
        return self.depth_of(p) < self.depth

    def reach(self, ray):
        """How far along a ray the disks are that reach into the zone."""
        left = self.depth + self.radius - self.depth_of(ray.o)
        return dr.maximum(left / dr.maximum(dr.dot(ray.d, self.axis), 1e-3), 0)
