"""Mitsuba's `path` as iterations like those of this package: same films, same variance channels,
same seeds."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.film import splat_samples
from ..core.recording import recorder
from ..core.untrusted import Fields
from ..paths.camera import film_sample_count, start_camera_paths
from ..paths.setting import CameraPass
from .ahead import SessionAhead

BUSY = 1 << 19
"""Camera paths that keep the processor busy: twice as many at once are 3 % faster, 65536 a quarter
slower."""
CHUNK = 1 << 21
"""Camera paths traced at once at most (bounds memory)."""
DIRECT_SEGMENTS = 2
"""Segments of the paths whose light is denoised apart: lamps that are seen and direct light, with
the edges that a denoiser blurs."""
PATHS = 0
"""Purpose of an iteration's random seeds, besides `PathSession.wavelength`."""


class PathSampler(mi.Sampler):
    """Hands the numbers of paths to Mitsuba's own integrators. Every draw stands for a vertex of
    its own, counted from 1 on: Dr.Jit's loops carry the count along."""

    def __init__(self, numbers):
        super().__init__(mi.Properties())
        self.numbers = numbers
        self.draw = mi.UInt32(1)

    def _next(self, dimensions):
        found = self.numbers.at(self.draw).next_floats(dimensions)
        self.draw += 1
        return found

    def next_1d(self, active=True):
        return self._next(1)[0]

    def next_2d(self, active=True):
        return mi.Point2f(*self._next(2))


class PathSession(SessionAhead):
    """Iterations of `path`: `camera_paths` samples a pixel each, or, if that is 0 and no number of
    iterations is planned, as many as keep the processor busy."""

    wavelength = 1

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.path_integrator = self._path(integrator.max_depth)
        self._trace = recorder()(self._trace_paths)
        self.segments_apart = 0  # of the longest paths whose light is kept apart
        if integrator.denoised:
            longest = DIRECT_SEGMENTS if integrator.max_depth < 0 else integrator.max_depth
            self.segments_apart = min(longest, DIRECT_SEGMENTS)
            self.direct_integrator = self._path(self.segments_apart)
        if not integrator.camera_paths and iterations is None:
            self.camera_paths = max(1, BUSY // film_sample_count(sensor))
        self.split_paths(CHUNK)

    def _path(self, max_depth):
        """Mitsuba's `path` for paths up to `max_depth` segments."""
        return mi.load_dict(
            {
                "type": "path",
                "max_depth": max_depth,
                "rr_depth": self.integrator.rr_depth,
                "hide_emitters": self.integrator.hide_emitters,
            }
        )

    @property
    def left_out(self):
        return ["photons"]

    @property
    def settings(self):
        return {**super().settings, "integrator": "path"}

    @property
    def learned(self):
        return {"camera_paths": self.camera_paths}

    def recall(self, learned):
        fields = Fields(learned, "learned")
        self.resize(fields.integer("camera_paths", 1, self.most_camera_paths()))
        fields.finish()
        self.split_paths(CHUNK)

    def trace(self, iteration, pixel, index, spectral):
        """Camera paths of an iteration, of number `index` in their `pixel` (uint32 arrays): their
        radiance and alpha, positions on the film, which of them there are, and the part of the
        radiance that is direct (a list: empty where none is kept). All is evaluated, and so are the
        arguments: trials and renders share the kernel."""
        dr.make_opaque(pixel, index)
        sequence = self._sequence(iteration, PATHS, self.camera_paths)
        return self._trace(self.scene, self.sensor, sequence, pixel, index, spectral)

    def _trace_paths(self, scene, sensor, sequence, pixel, index, spectral):
        camera_pass = CameraPass(sensor, None, sequence, pixel, index, spectral["sample"])
        _, active, numbers, ray, weight, position, _ = start_camera_paths(camera_pass)
        differential = mi.RayDifferential3f(ray)
        radiance, valid, _ = self.path_integrator.sample(
            scene, PathSampler(numbers), differential, None, active
        )
        direct = []
        if self.integrator.denoised:
            # The same numbers make the same vertices and shadow rays: nothing is counted twice.
            part, *_ = self.direct_integrator.sample(
                scene, PathSampler(numbers), differential, None, active
            )
            direct.append(dr.select(active, weight * part, 0))
        found = (
            dr.select(active, weight * radiance, 0),
            dr.select(valid, mi.Float(1), 0),
            position,
            active,
            direct,
        )
        dr.eval(found)
        return found

    def _iteration(self, iteration):
        spectral = self._spectral(iteration)

        def render(chunk, first):
            places = self.pixels_and_indices(self.part_of_paths(first))
            radiance, alpha, position, active, classes = self.trace(iteration, *places, spectral)
            return (
                splat_samples(
                    self.sensor.film(),
                    position,
                    radiance,
                    alpha,
                    spectral["matrix"],
                    active,
                    classes=classes,
                ),
            )

        (block,) = self.sum_of_chunks(render)
        return block
