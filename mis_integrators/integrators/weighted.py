"""What the plugins share that merge photons at several camera vertices under weights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.camera_pass import STATE, trace_camera_paths
from ..transport.coverage import covered_share
from ..transport.film import splat_samples
from ..transport.gather import gather_photons, vertex_section
from ..transport.light_pass import trace_light_paths
from .bdpm import BDPM, BDPMSession


class WeightedBDPM(BDPM):
    """Base of the integrators that merge at the smooth camera vertices `first_vertex` to `first_vertex + strategies - 1`."""

    first_vertex = 0

    def settings(self):
        settings = super().settings()
        del settings["bdd"]
        return {**settings, "strategies": self.strategies}


class WeightedSession(BDPMSession):
    """Iterations of a `WeightedBDPM`. A subclass makes the weights.

    The radius is chosen as for merging at the first vertex alone, where its blur is seen most.
    """

    def __init__(self, integrator, scene, sensor, seed, iterations):
        self._weighted = False                     # the pilot of the radius merges at the first vertex, without weights
        super().__init__(integrator, scene, sensor, seed, iterations)

    def prepare(self, spectral):
        """Makes what the weights need, once, when the radius is known."""

    def weights(self, n):
        """The weights (hooks as in `trace_camera_paths` and `trace_light_paths`); `n` is what `photons_per_irradiance` returns."""
        raise TypeError(f"{type(self).__name__} does not define weights")

    def photons_per_irradiance(self, radius):
        """Expected photons in the merge disk per unit of irradiance: a spectrum of width one."""
        raise TypeError(f"{type(self).__name__} does not define photons_per_irradiance")

    def _start(self):
        super()._start()
        if not self._weighted:
            self.prepare(super()._spectral(0))
            self._weighted, self.one_vertex = True, False
            self.vertex_capacity = self._vertex_room(self.chunk)
            self._freeze()

    def _vertex_room(self, paths):
        return super()._vertex_room(paths) if not self._weighted else paths * (2 if self.traits.has_mixed else 1)

    def _spectral(self, iteration):
        spectral = super()._spectral(iteration)
        if self._weighted and self.radii:
            radii = self.radii_at(iteration)
            spectral["n"] = self.photons_per_irradiance(radii.get("indirect", radii.get("caustic")))
            dr.make_opaque(spectral["n"])
        return spectral

    def _trace_light(self, scene, sensor, tables, seed, spectral):
        if not self._weighted:
            return super()._trace_light(scene, sensor, tables, seed, spectral)
        notebook = self.weights(spectral["n"]).notebook() if self.has_indirect else None
        return trace_light_paths(scene, self.lights, self.traits, seed, self.light_paths, self.photon_capacity, spectral["wavelengths"],
                                 sensor.shutter_open(), sensor.shutter_open_time(), self.integrator.max_depth, self.integrator.rr_depth,
                                 notebook=notebook)

    def _render_chunk(self, scene, sensor, tables, photons, seed, first, spectral, radii):
        integrator = self.integrator
        weights = self.weights(spectral.get("n"))
        last = integrator.first_vertex + integrator.strategies - 1
        radiance, alpha, position, vertices, count = trace_camera_paths(
            scene, sensor, integrator, self.lights, self.traits, seed, first, 1, self.chunk, integrator.camera_paths, spectral["sample"],
            last, integrator.max_depth, integrator.rr_depth, integrator.hide_emitters, self.vertex_capacity if radii else 0,
            self.has_caustics, self.has_indirect, False, weights)
        if radii:
            dr.eval(radiance, alpha, position, vertices, count)
        if "caustic" in radii:
            radiance += self._merge_weighted_by_vertex(photons, vertices, "caustic", radii["caustic"], spectral)
        if "indirect" in radii:
            photon_map = self._map(photons, "indirect", radii["indirect"])
            for level in range(integrator.strategies):
                radiance += self._merge_at(level, scene, photon_map, vertices, weights, radii["indirect"], seed, spectral)
        if integrator.hide_emitters:
            radiance = dr.select(alpha > 0, radiance, 0)
        active = dr.arange(mi.UInt32, self.chunk) + first < self.path_count
        return splat_samples(sensor.film(), position, radiance, alpha, spectral["matrix"], active), count

    def _merge_weighted_by_vertex(self, photons, vertices, kind, radius, spectral):
        """Photons whose weight is that of the direct light at the vertex."""
        vertices = _shared(vertices)
        (gathered,) = self._gather(photons, vertices, kind, [radius], spectral)
        return self._per_path(gathered, vertices, self.chunk)

    def _merge_at(self, level, scene, photon_map, vertices, weights, radius, seed, spectral):
        """Indirect photons at the vertices of one strategy."""
        integrator = self.integrator
        vertices = vertex_section(vertices, (level + integrator.first_vertex) * self.vertex_capacity, self.vertex_capacity)
        weigh = None
        if level == integrator.strategies - 1:
            vertices = _shared(vertices)             # at the last strategy the weight is the same for all
        else:
            notebook, state = weights.notebook(), [vertices[name] for name in STATE]

            def weigh(index, f, p, active):
                return weights.merging(level, state, f, p, notebook.read(level, photon_map.notes, index, active))
        (gathered,) = gather_photons(self.traits, photon_map, vertices, [radius], spectral["wavelengths"], self.light_paths,
                                     integrator.max_depth, only_last=True, weigh=weigh)
        if level == 0 and self.corrected["indirect"]:
            used = dr.max(vertices["throughput"]) > 0
            gathered *= dr.rcp(covered_share(scene, vertices, radius, seed, used))
        return self._per_path(gathered, vertices, self.chunk)


def _shared(vertices):
    """The vertices with their weight of direct light multiplied into their throughput."""
    used = dr.max(vertices["throughput"]) > 0
    return {**vertices, "throughput": dr.select(used, vertices["throughput"], 0), "scale": dr.select(used, vertices["share"], 0)}
