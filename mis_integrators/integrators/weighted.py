"""What the plugins share that merge photons at several camera vertices under weights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..photons.gather import gather_photons, vertex_section
from ..photons.queries import STATE, trace_camera_paths
from ..photons.trace import trace_light_paths
from .bdpm import BDPM, BDPMSession


class WeightedBDPM(BDPM):
    """Base of the integrators that merge at the smooth camera vertices `first_vertex` to
    `first_vertex + strategies - 1`."""

    first_vertex = 0

    def settings(self):
        settings = super().settings()
        del settings["bdd"]
        return {**settings, "strategies": self.strategies}


class WeightedSession(BDPMSession):
    """Iterations of a `WeightedBDPM`. A subclass makes the weights."""

    weighted_pilot = False
    """Whether the pilot of the automatic radius renders under the weights, made for
    `usual_radius()`; else it merges at the first vertex."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        self._weighted = False
        super().__init__(integrator, scene, sensor, seed, iterations)

    @property
    def last_vertex(self):
        return self.integrator.first_vertex + (
            self.integrator.strategies - 1 if self._weighted else 0
        )

    def mixes(self):
        """Whether the scene has paths that several strategies make."""
        return True

    def prepare(self, spectral):
        """Makes what the weights need, once: before the pilot of the radius if that is weighted,
        else after it."""

    def weights(self, merge_settings):
        """The weights (hooks as in `trace_camera_paths` and `trace_light_paths`); `merge_settings`
        is what the method of that name returns."""
        raise TypeError(f"{type(self).__name__} does not define weights")

    def merge_settings(self, radii):
        """What the weights must know of the merge disks: arrays of width one, by name."""
        raise TypeError(f"{type(self).__name__} does not define merge_settings")

    def weigher(self, weights, kind, level, vertices, photon_map):
        """What weighs the photons of a map, of one kind, at the vertices of one strategy (`weigh`
        of `gather_photons`); None where a vertex weighs all of them alike: caustic ones as its
        direct light, others by the first word of its state. Caustic photons are merged at all
        vertices at once (`level` is None)."""
        if kind == "caustic" or level == self.integrator.strategies - 1:
            return None
        light_state, state = weights.light_state(), [vertices[name] for name in STATE]

        def weigh(index, f, p, back, active):
            return weights.merge_weight(
                level,
                state,
                f,
                p,
                light_state.read(
                    level,
                    photon_map.mis_words,
                    photon_map.place_of_mis_words(index, active),
                    active,
                ),
            )

        return weigh

    def _run_pilot(self):
        """The weights are made before the pilot or after it, see `weighted_pilot`."""
        if self.weighted_pilot:
            self._begin_weighting()
        pilot = super()._run_pilot()
        self._begin_weighting()
        return pilot

    def _begin_weighting(self):
        """Weights all passes from now on, where the scene has paths that several strategies
        make."""
        if not self._weighted and self.kinds() and self.mixes():
            self.prepare(super()._spectral(0))
            self._weighted, self.one_vertex = True, False
            self.vertex_capacity = self._vertex_room(self.chunk)
            self._freeze()

    def _vertex_room(self, paths):
        return (
            super()._vertex_room(paths)
            if not self._weighted
            else paths * (2 if self.traits.has_mixed else 1)
        )

    def _spectral(self, iteration):
        spectral = super()._spectral(iteration)
        if self._weighted:
            radii = self.radii_at(iteration) if self.radii else {"indirect": self.usual_radius()}
            spectral["merge_settings"] = self.merge_settings(radii)
            dr.make_opaque(spectral["merge_settings"])
        return spectral

    def _trace_light(self, scene, sensor, tables, seed, spectral):
        if not self._weighted:
            return super()._trace_light(scene, sensor, tables, seed, spectral)
        light_state = (
            self.weights(spectral["merge_settings"]).light_state() if self.has_indirect else None
        )
        return trace_light_paths(
            scene,
            self.lights,
            self.traits,
            seed,
            self.light_path_count,
            self.photon_capacity,
            spectral["wavelengths"],
            sensor.shutter_open(),
            sensor.shutter_open_time(),
            self.integrator.max_depth,
            self.integrator.rr_depth,
            light_state=light_state,
        )

    def _trace_camera(
        self, scene, sensor, seed, first, stride, paths, camera_paths, capacity, spectral
    ):
        if not self._weighted:
            return super()._trace_camera(
                scene, sensor, seed, first, stride, paths, camera_paths, capacity, spectral
            )
        integrator = self.integrator
        return trace_camera_paths(
            scene,
            sensor,
            integrator,
            self.lights,
            self.traits,
            seed,
            first,
            stride,
            paths,
            camera_paths,
            spectral["sample"],
            integrator.first_vertex + integrator.strategies - 1,
            integrator.max_depth,
            integrator.rr_depth,
            integrator.hide_emitters,
            capacity,
            self.has_caustics,
            self.has_indirect,
            False,
            self.weights(spectral["merge_settings"]),
        )

    def _gather(self, photon_map, vertices, kind, radii, spectral, grey=False):
        if not self._weighted:
            return super()._gather(photon_map, vertices, kind, radii, spectral, grey)
        weights = self.weights(spectral["merge_settings"])
        if kind == "caustic":
            return self._merge(kind, None, photon_map, vertices, weights, radii, spectral, grey)
        integrator = self.integrator
        width = dr.width(vertices["path"])
        section = width // (integrator.first_vertex + integrator.strategies)
        totals = [dr.zeros(mi.Float if grey else mi.Spectrum, width) for _ in radii]
        for level in range(integrator.strategies):
            first = (level + integrator.first_vertex) * section
            merged = self._merge(
                kind,
                level,
                photon_map,
                vertex_section(vertices, first, section),
                weights,
                radii,
                spectral,
                grey,
            )
            for total, values in zip(totals, merged):
                dr.scatter(total, values, dr.arange(mi.UInt32, section) + first)
        dr.eval(totals)
        return totals

    def _merge(self, kind, level, photon_map, vertices, weights, radii, spectral, grey):
        """Weighted radiance that photons of one kind bring to the vertices of one strategy."""
        weigh = self.weigher(weights, kind, level, vertices, photon_map)
        if weigh is None:
            vertices = _scaled(vertices, "share" if kind == "caustic" else STATE[0])
        return gather_photons(
            self.traits,
            photon_map,
            vertices,
            radii,
            spectral["wavelengths"],
            self.light_path_count,
            self.integrator.max_depth,
            only_last=kind == "indirect",
            grey=grey,
            weigh=weigh,
        )


def _scaled(vertices, weight):
    """The vertices with one of their weights as a scale of what they gather."""
    used = dr.max(vertices["throughput"]) > 0
    return {
        **vertices,
        "throughput": dr.select(used, vertices["throughput"], 0),
        "scale": dr.select(used, vertices[weight], 0),
    }
