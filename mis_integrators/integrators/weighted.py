"""What the plugins share that merge photons at several camera vertices under weights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.recording import lanes
from ..photons.beams import Beams, beam_layout, gather_along
from ..photons.points import (
    Points,
    gather_in_balls,
    mean_count_in_balls,
    point_layout,
    read_points,
)
from ..photons.queries import STATE, query_layout, read_queries, weight_layout
from .bdpm import BDPM, BDPMSession


class WeightedBDPM(BDPM):
    """Base of the integrators that merge at the smooth camera vertices `first_vertex` to
    `first_vertex + strategies - 1`."""

    first_vertex = 0
    pass_narrow = False  # weights leave the light of narrow lobes to later vertices by themselves

    def settings(self):
        settings = super().settings()
        del settings["bdd"], settings["pass_narrow"]
        return {**settings, "strategies": self.strategies}


class UnderWeights(BDPMSession):
    """Iterations under weights, which know photons alone: all of those that there are, with one
    radius."""

    chooses_light_paths = narrows_volume = suits_denoisers = meets_lights = False
    follows_curvature = leaves_out_hidden = False


class WeightedSession(UnderWeights):
    """Iterations of a `WeightedBDPM`. A subclass makes the weights."""

    weighted_pilot = False
    """Whether the pilot of the automatic radius renders under the weights, made for
    `usual_radii()`; else it merges at the first vertex."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        self._weighted = False
        super().__init__(integrator, scene, sensor, seed, iterations)

    @property
    def last_vertex(self):
        return self.integrator.first_vertex + (
            self.integrator.strategies - 1 if self._weighted else 0
        )

    @property
    def left_out(self):
        return [*super().left_out, *([] if self._weighted else ["weights"])]

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

        def weigh(index, landing, scattering, active):
            return weights.merge_weight(
                level,
                state,
                scattering.f,
                scattering.p,
                light_state.read(
                    level,
                    photon_map.mis_words,
                    photon_map.place_of_mis_words(index, active),
                    active,
                ),
            )

        return weigh

    def point_weigher(self, weights, level, points, record, photon_map):
        """What weighs volume photons at the vertices in media of one strategy (`weigh` of
        `gather_in_balls`): caustic ones as the vertex's direct light, those that come straight from
        a light as a part of that. `record` as of `_read_points`, `points` made of it."""
        light_state, state = weights.light_state(), [record[name] for name in STATE]
        cost = weights.ball_cost(points.extinction)
        found = weights.ball_paths * points.extinction

        def weigh(index, landing, scattering, active):
            weight, share = state[0], record["share"]
            if light_state is None:
                return dr.select(landing.caustic, share, weight)
            words, place = photon_map.mis_words, photon_map.place_of_mis_words(index, active)
            if level < self.integrator.strategies - 1:
                weight = weights.merge_weight(
                    level,
                    state,
                    scattering.f * cost,
                    scattering.p * cost,
                    light_state.read(level, words, place, active),
                )
            straight = landing.depth == 1
            ratio = light_state.straight_from_light(words, place, active)
            direct = share * weights.share_of_photons(found, ratio)
            return dr.select(landing.caustic, share, dr.select(straight, direct, weight))

        return weigh

    def beam_weigher(self, weights, beams, state, photon_map):
        """What weighs volume photons along beams (`weigh` of `gather_along`), whose paths arrive
        with that `state` of the weights."""
        raise TypeError(f"{type(self).__name__} does not define beam_weigher")

    def _run_pilot(self, settled=None):
        """The weights are made before the pilot or after it, see `weighted_pilot`."""
        if self.weighted_pilot:
            self._begin_weighting()
        pilot = super()._run_pilot(settled)
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
            radii = self.radii_at(iteration) if self.radii else self.usual_radii()
            spectral["merge_settings"] = self.merge_settings(radii)
            dr.make_opaque(spectral["merge_settings"])
        return spectral

    def _light_state(self, spectral):
        if not (self._weighted and (self.has_indirect or self.has_volume)):
            return None
        return self.weights(spectral["merge_settings"]).light_state()

    def _merge_state(self, spectral):
        return self.weights(spectral["merge_settings"]) if self._weighted else None

    def _gather(self, photon_map, vertices, kind, radii, spectral, grey=False):
        if not self._weighted:
            return super()._gather(photon_map, vertices, kind, radii, spectral, grey)
        if kind == "volume" and self.points:
            points = vertices["points"]
            return self._gather_weighted_in_balls(photon_map, points, radii, spectral, grey)
        if kind == "volume":
            return self._gather_weighted_along(photon_map, vertices, radii, spectral, grey)
        if kind == "caustic":
            record = read_queries(vertices)
            return self._merge_weighted(photon_map, record, kind, None, radii, spectral, grey)

        def gather(level, first, section):
            record = read_queries(vertices, first, section)
            return self._merge_weighted(photon_map, record, kind, level, radii, spectral, grey)

        return self._by_section(query_layout().capacity(vertices["words"]), gather)

    def _records(self, vertices, kind):
        if kind == "volume" and self.points:
            return read_points(vertices["points"]["words"])
        return super()._records(vertices, kind)

    def mean_count(self, photon_map, vertices, kind, radius, paths, spectral):
        """As of `BDPMSession`; of volume photons gathered at vertices those of a vertex."""
        if kind == "volume" and self.points:
            record = self._records(vertices, kind)
            points = Points.of(self.traits, record, spectral["wavelengths"])
            return mean_count_in_balls(photon_map, points, radius)
        return super().mean_count(photon_map, vertices, kind, radius, paths, spectral)

    def _read_points(self, points, first, count):
        """Records of `count` vertices in media from place `first` of a buffer on, with the state of
        the weights there."""
        record = read_points(points["words"], first, count)
        index = lanes(count) + first
        record |= weight_layout().read(points["weights"], index)
        if "first" in points:
            record["first"] = dr.gather(mi.Bool, points["first"], index)
        return record

    def _gather_weighted_in_balls(self, photon_map, points, radii, spectral, grey):
        """`gather_in_balls` at the vertices of all strategies, weighted: caustic photons as their
        vertex's direct light."""
        weights = self.weights(spectral["merge_settings"])

        def gather(level, first, section):
            record = self._read_points(points, first, section)
            there = Points.of(self.traits, record, spectral["wavelengths"])
            return gather_in_balls(
                photon_map,
                there,
                radii,
                self._light_paths,
                self.integrator.max_depth,
                self.point_weigher(weights, level, there, record, photon_map),
                grey,
                self.integrator.splits_light,
                weights.weighs_points_of_lights,
            )

        return self._by_section(point_layout().capacity(points["words"]), gather)

    def _by_section(self, width, gather):
        """What `gather(level, first, section)` returns for each strategy's section of vertices, the
        `section` places from `first` on, as lists of arrays of all sections."""
        integrator = self.integrator
        section = width // (integrator.first_vertex + integrator.strategies)
        totals = None
        for level in range(integrator.strategies):
            first = (level + integrator.first_vertex) * section
            merged = gather(level, first, section)
            totals = totals or [dr.zeros(type(values), width) for values in merged]
            for total, values in zip(totals, merged):
                dr.scatter(total, values, dr.arange(mi.UInt32, section) + first)
        dr.eval(totals)
        return totals

    def _gather_weighted_along(self, photon_map, vertices, radii, spectral, grey):
        """`gather_along` of all beams, weighted."""
        beams = Beams.read(vertices["beams"], spectral["wavelengths"], self.traits)
        record = weight_layout().read(
            vertices["beam_weights"], lanes(beam_layout().capacity(vertices["beams"]))
        )
        weights = self.weights(spectral["merge_settings"])
        state = [record[name] for name in STATE]
        return gather_along(
            photon_map,
            beams,
            radii,
            self._light_paths,
            self.integrator.max_depth,
            grey,
            self.integrator.splits_light,
            self.beam_weigher(weights, beams, state, photon_map),
        )

    def _merge_weighted(self, photon_map, record, kind, level, radii, spectral, grey):
        """`_merge` at the vertices of one strategy, weighted."""
        weights = self.weights(spectral["merge_settings"])
        weigh, scale = self.weigher(weights, kind, level, record, photon_map), 1
        if weigh is None:
            weight = record["share" if kind == "caustic" else STATE[0]]
            scale = dr.select(dr.max(record["throughput"]) > 0, weight, 0)
        return self._merge(photon_map, record, kind, radii, spectral, grey, weigh, scale)
