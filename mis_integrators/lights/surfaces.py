"""The surfaces of area lights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy


class LightSurfaces:
    """Where area lights shine: their areas, and points on them. `shapes`: those of all emitters, in
    their order; None for emitters without."""

    def __init__(self, shapes):
        self._shapes = [shape for shape in shapes if shape is not None]
        self._tables = []
        if self._shapes:
            number = np.cumsum([shape is not None for shape in shapes]) - 1
            self._number = from_numpy(mi.UInt32, np.maximum(number, 0))
            self._area = from_numpy(
                mi.Float,
                [
                    float(np.array(shape.surface_area()).ravel()[0]) if shape is not None else 1.0
                    for shape in shapes
                ],
            )
            self._tables += [self._number, self._area]
        spheres = [shape is not None and shape.class_name() == "Sphere" for shape in shapes]
        self._has_spheres = any(spheres)
        if self._has_spheres:
            centers = [
                np.array(shape.bbox().center()).ravel() if sphere else np.zeros(3)
                for shape, sphere in zip(shapes, spheres)
            ]
            signs = [
                (-1.0 if shape.has_flipped_normals() else 1.0) if sphere else 0.0
                for shape, sphere in zip(shapes, spheres)
            ]
            self._sphere_center = from_numpy(mi.Float, np.ravel(centers))
            self._sphere_sign = mi.Float(signs)
            self._tables += [self._sphere_center, self._sphere_sign]

    def tables(self):
        """The evaluated arrays that are read here."""
        return self._tables

    def area(self, index, active):
        """Area of the surface of emitter `index`."""
        return dr.gather(mi.Float, self._area, index, active)

    def sample(self, index, time, sample, active):
        """A uniformly distributed point on the surface of emitter `index`. Mitsuba's sampling of a
        rotated sphere forgets to rotate the normal.

        A virtual call would ask every shape of the process, and instances, curves and others have
        no points to give."""

        def sampler(shape):
            return lambda time, sample, active: shape.sample_position(time, sample, active)

        if len(self._shapes) == 1:
            ps = sampler(self._shapes[0])(mi.Float(time), sample, active)
        else:
            number = dr.gather(mi.UInt32, self._number, index, active)
            samplers = [sampler(shape) for shape in self._shapes]
            ps = dr.switch(number, samplers, mi.Float(time), sample, active)
        if self._has_spheres:
            sign = dr.gather(mi.Float, self._sphere_sign, index, active)
            center = dr.gather(mi.Point3f, self._sphere_center, index, active)
            ps.n = dr.select(sign != 0, mi.Normal3f(dr.normalize(ps.p - center) * sign), ps.n)
        return ps
