"""Plugin `bdpm`: bidirectional ray tracing with photon maps, one strategy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.camera_pass import film_sample_count, trace_camera_paths
from ..transport.film import splat_samples
from ..transport.gather import gather_photons
from ..transport.guide import EnvironmentGuide, infinite_emitters
from ..transport.light_pass import trace_light_paths
from ..transport.lights import Lights
from ..transport.photon_map import build_photon_map, smallest_cell
from ..transport.random import mix
from ..transport.recording import frozen
from ..transport.traits import SceneTraits
from .common import IterativeIntegrator, IterativeSession

CAMERA_CHUNK = 1 << 21
"""Camera paths traced at once at most; larger films are traced in parts (bounds memory)."""


class BDPM(IterativeIntegrator):
    def read_parameters(self, parameters):
        self.photon_count = parameters.integer("photon_count", 0, 0, "at least 0 (0: as many as pixels)", high=2 ** 31)
        self.initial_radius = parameters.number("initial_radius", 0.0, lambda r: 0 <= r < float("inf"),
                                                "finite and at least 0 (0: automatic)")
        self.alpha = parameters.number("alpha", 1.0, lambda a: 0 < a <= 1, "in (0, 1]")
        self.bdd = parameters.integer("bdd", 1, 0, "at least 0")

    def settings(self):
        return {**super().settings(), "photon_count": self.photon_count, "initial_radius": self.initial_radius,
                "alpha": self.alpha, "bdd": self.bdd}

    def new_session(self, scene, sensor, seed, iterations):
        return BDPMSession(self, scene, sensor, seed, iterations)


class BDPMSession(IterativeSession):
    """Iterations of `bdpm`: light pass, photon maps, camera pass, gather."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.traits = SceneTraits(scene)
        guide = EnvironmentGuide(scene, sensor) if infinite_emitters(scene) else None
        self.lights = Lights(scene, integrator.plugin, guide)
        pixels = film_sample_count(sensor)
        self.light_paths = integrator.photon_count or pixels
        self.path_count = pixels * integrator.camera_paths
        self.chunks = -(-self.path_count // CAMERA_CHUNK)
        self.chunk = -(-self.path_count // self.chunks)
        depth = integrator.max_depth
        caustic_sources = self.traits.has_delta or self.lights.needs_photons_for_direct_light()
        self.has_caustics = not self.lights.dark and caustic_sources and (depth < 0 or depth >= 3)
        self.has_indirect = not self.lights.dark and (depth < 0 or depth >= integrator.bdd + 3)
        self.one_vertex = not self.traits.has_mixed and (integrator.bdd == 0 or not self.has_caustics)
        self.photon_capacity = 4 * self.light_paths
        self.vertex_capacity = self.chunk * (1 if self.one_vertex else 2) if self.has_photons else 0
        self.radius = integrator.initial_radius or float(dr.norm(scene.bbox().extents())) * 0.005
        self._freeze()

    @property
    def has_photons(self):
        return self.has_caustics or self.has_indirect

    def _freeze(self):
        """Records the passes once; later iterations launch their kernels without running Python again."""
        self._trace_light = frozen(self._light_pass)
        self._trace_camera = frozen(self._camera_pass)
        self._tables = [self.traits.lambertian, *self.lights.tables()]

    def radius_at(self, iteration):
        """Merge radius of an iteration: R_i^2 = R_0^2 (i + 1)^(alpha - 1), a schedule of the index alone."""
        return self.radius * (iteration + 1) ** (0.5 * (self.integrator.alpha - 1))

    def _light_pass(self, scene, sensor, tables, seed, wavelength_sample):
        wavelengths = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample)[0]
        return trace_light_paths(scene, self.lights, seed, self.light_paths, self.photon_capacity, wavelengths,
                                 sensor.shutter_open(), sensor.shutter_open_time(), self.integrator.max_depth,
                                 self.integrator.rr_depth)

    def _camera_pass(self, scene, sensor, tables, photons, seed, first, wavelength_sample, radius):
        integrator = self.integrator
        radiance, alpha, position, vertices, count = trace_camera_paths(
            scene, sensor, integrator, self.lights, self.traits, seed, first, self.chunk, integrator.camera_paths,
            wavelength_sample, integrator.bdd, integrator.max_depth, integrator.rr_depth, integrator.hide_emitters,
            self.vertex_capacity, self.has_caustics, self.has_indirect, self.one_vertex)
        if self.has_photons:
            dr.eval(radiance, alpha, position, vertices, count)
            cell = dr.maximum(radius, smallest_cell(scene.bbox(), self.photon_capacity))
            origin = mi.Point3f(scene.bbox().min)
            for kind in self.kinds():
                photon_map = build_photon_map(*photons, origin, cell, self.photon_capacity, kind)
                gathered = gather_photons(scene, self.traits, photon_map, vertices, radius, self.light_paths, integrator.max_depth,
                                          only_last=kind == "indirect")
                if self.one_vertex:
                    radiance += gathered
                else:
                    total = dr.zeros(mi.Spectrum, self.chunk)
                    dr.scatter_reduce(dr.ReduceOp.Add, total, gathered, vertices["path"],
                                      dr.max(vertices["throughput"]) > 0, dr.ReduceMode.Direct)
                    radiance += total
        active = dr.arange(mi.UInt32, self.chunk) + first < self.path_count
        wavelengths = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample)[0]
        return splat_samples(sensor.film(), position, radiance, alpha, wavelengths, active), count

    def kinds(self):
        """Photon maps that the scene needs."""
        return [kind for kind, needed in (("caustic", self.has_caustics), ("indirect", self.has_indirect)) if needed]

    def _iteration(self, iteration):
        radius = dr.opaque(mi.Float, self.radius_at(iteration))
        wavelength_sample = dr.opaque(mi.Float, mix(self.seed, iteration, 2) / 2 ** 32)
        photons = None
        while self.has_photons:
            photons = self._trace_light(self.scene, self.sensor, self._tables, self._seed(iteration, 0), wavelength_sample)
            dr.eval(photons)
            found = int(photons[2][0])
            if found <= self.photon_capacity:
                break
            self.photon_capacity = found + found // 4
            self._freeze()
        total = None
        for chunk in range(self.chunks):
            while True:
                first = dr.opaque(mi.UInt32, chunk * self.chunk)
                block, count = self._trace_camera(self.scene, self.sensor, self._tables, photons, self._seed(iteration, 1), first,
                                                  wavelength_sample, radius)
                if self.one_vertex or int(count[0]) <= self.vertex_capacity:
                    break
                self.vertex_capacity = int(count[0]) + int(count[0]) // 4
                self._freeze()
            total = block if total is None else total + block
        return total
