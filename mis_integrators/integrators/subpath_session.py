"""What sessions share that keep the vertices of light and camera sub-paths in buffers, and join
them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.film import expected_weight
from ..core.packing import with_reserve
from ..core.random import next_2d, vertex_streams
from ..core.recording import lanes, recorder
from ..paths.connect import join_sensor
from ..paths.light_classes import by_class, class_of
from ..paths.sensor import Lens
from ..paths.subpaths import STATES, read_vertices, trace_light_subpaths
from .common import IterativeSession


class SubpathSession(IterativeSession):
    """Sub-paths that are traced in parts of about `largest` camera paths, and joined.

    A subclass sets `light_chunk`, light sub-paths of a part, and `capacity`, the room of each
    buffer by name (`light` among them), and defines `weights(spectral)` and ``_freeze(grown)``,
    which calls `_record`. `guided`: as of `Lights.seen_by`.
    """

    PASSES = {}
    """Recorded passes: the method of each, and the buffers that it uses, which grow one by one."""

    def __init__(self, integrator, scene, sensor, seed, iterations, largest, guided=True):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self._find_world(guided)
        self.split_paths(largest)
        width, height = sensor.film().crop_size()
        self.pixel_paths = width * height * integrator.camera_paths
        self.lens = Lens(sensor).connects
        self.expected_weight = expected_weight(sensor.film(), integrator.camera_paths)
        self.recorded = recorder()

    def _record(self, grown):
        """Records the `PASSES` anew, or those that use the buffer that has `grown`; from the second
        iteration on, kernels run without their Python."""
        for name, (function, buffers) in self.PASSES.items():
            if grown is None or grown in buffers:
                setattr(self, name, self.recorded(getattr(self, function)))

    def _grown(self, name, count):
        """Whether the `count` (an array of width one) found more than there is room for in the
        buffer of that name; then there will be more room."""
        found = int(count[0])
        if found <= self.capacity[name]:
            return False
        self.capacity[name] = with_reserve(found)
        self._freeze(name)
        return True

    def _trace_light(self, scene, sensor, tables, sequence, first, spectral):
        light_pass = self.describe_light_pass(sensor, sequence, self.light_chunk, spectral, first)
        return trace_light_subpaths(
            self.world,
            self.limits,
            light_pass,
            self.weights(spectral),
            self.capacity["light"],
            self.integrator.splits_light,
        )

    def _joined_with_sensor(self, sensor, light, count, seed, spectral, states=STATES):
        """The `count` vertices of light sub-paths of a buffer, records with these `states` of the
        weights, and their `LensConnection`."""
        index = lanes(self.capacity["light"])
        active = index < dr.gather(mi.UInt32, count, 0)
        y = read_vertices(light, index, active, states=states)
        rng = vertex_streams(y["path"], y["number"], seed)
        aperture = next_2d(rng) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        return y, join_sensor(
            self.world,
            self.limits,
            self.integrator,
            Lens(sensor),
            y,
            aperture,
            spectral["wavelengths"],
            active,
            rng,
        )

    def _with_classes(self, value, y):
        """The spectrum that light vertices `y` bring to the sensor and, where light is split, those
        of each class."""
        if not self.integrator.splits_light:
            return [value]
        smooth = dr.select(y["depth"] == 1, mi.UInt32(1), mi.UInt32(2))
        return [value, *by_class(class_of(smooth, y["mark"]), value)]
