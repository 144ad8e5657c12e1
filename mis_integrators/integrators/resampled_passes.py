"""What an iteration of `pcbpt` and `bdpt_ris` computes, pass by pass: light sub-paths, targets and
pmfs of the cache points, camera sub-paths, connections, emission met, light that meets the
sensor."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import (
    splat_light,
)
from ..core.packing import rounded_up
from ..core.random import own_stream, vertex_streams
from ..core.recording import lanes
from ..core.spectra import channel_mean
from ..mis.published_resampling import PublishedWeights, unknown_tables
from ..mis.resampling import ResampledWeights, guessed_weight, uniform_tables
from ..mis.step_sums import LightEnd, sum_before
from ..paths.camera_vertices import STEP, hit_layout, trace_camera_vertices
from ..paths.light_classes import LightClasses, class_of
from ..paths.light_starts import sample_light_starts
from ..paths.media import SHADOW_SALT
from ..paths.subpaths import (
    NO_PARENT,
    read_vertices,
    seen_normal,
    vertex_bsdf_of,
)
from ..paths.vertex import facing
from ..photons.vertex_map import state_of
from ..resampling.cache_pmfs import CachePmfs, cumulative_pmfs
from ..resampling.cache_points import CacheGrid
from ..resampling.cache_targets import TARGETS, CacheTargets, receiving_cosine
from ..resampling.light_vertices import END, LightVertices, list_light_vertices
from ..resampling.proposals import Proposals, arriving, cumulative_sums
from ..weights import resampling
from .merging import automatic_radius, merged_light, merging_of, with_merged
from .schedule import shrunk
from .subpath_session import SubpathSession

CHUNK = 1 << 18
"""Camera paths, and as many light sub-paths, traced at once at most; larger films are traced in
parts (bounds memory), which share their proposals."""
KNOWN_PATHS, MOST_KNOWN_SETS = 200, 8
"""Tuned: light sub-paths of the first iteration from which Q and Q_s are estimated, in sets of M;
at most so many sets."""


class ResampledPasses(SubpathSession):
    """The passes of a session of both plugins, and what they share."""

    PASSES = {
        "_light_pass": ("_trace_light", ("light",)),
        "_camera_pass": ("_trace_camera", ("camera", "hits")),
        "_pilot_pass": ("_pilot_targets", ("light", "ends")),
        "_target_pass": ("_own_targets", ("light", "ends")),
        "_connection_pass": ("_connect", ("light", "camera", "ends")),
        "_hit_pass": ("_meet", ("camera", "hits")),
        "_merge_pass": ("_merge_vertices", ("light", "camera")),
        "_sensor_pass": ("_join_sensor", ("light",)),
    }

    def __init__(self, integrator, scene, sensor, seed, iterations):
        guided = integrator.guided_lights
        super().__init__(integrator, scene, sensor, seed, iterations, CHUNK, guided)
        self.capacity = {
            "camera": rounded_up(4 * self.chunk),
            "hits": rounded_up(self.chunk),
            "ends": rounded_up(6 * integrator.resampled_light_paths),
        }
        self._share_light()
        depth = integrator.max_depth
        self.lit = not self.lights.dark and (depth < 0 or depth >= 2)
        bounds = self.traits.bounds
        self.reach = 4 * float(
            np.linalg.norm(np.array(bounds.max).ravel() - np.array(bounds.min).ravel())
        )
        self.grid = self._grid(mi.Point3f(0), mi.Normal3f(0, 0, 1))
        self.records, self.shares = uniform_tables(self.grid)
        self.cache = self.known = self.first_light = None
        self.published_tables, self.next_tables = unknown_tables(1), {}
        self.radius = integrator.initial_radius or automatic_radius(self.traits)
        self._freeze()

    def _grid(self, points, normals):
        return CacheGrid(
            points, normals, self.integrator.cache_neighbors, bool(self.traits.has_media)
        )

    def _share_light(self):
        """How many light sub-paths are traced: enough in any case for what is drawn from and for
        Q."""
        shares = self.lens or self.integrator.merging
        wanted = float(shares) * self.integrator.light_tracing * self.chunk
        self.light_rounds = max(round(wanted / CHUNK), 1)
        self.light_chunk = max(
            round(wanted / self.light_rounds), self.integrator.resampled_light_paths, KNOWN_PATHS
        )
        M = self.integrator.resampled_light_paths
        self.known_sets = max(min(-(-KNOWN_PATHS // M), MOST_KNOWN_SETS, self.light_chunk // M), 1)
        self.capacity["light"] = rounded_up(4 * self.light_chunk)
        self.ratio = dr.opaque(
            mi.Float, self.light_chunk * self.light_rounds * self.chunks / self.pixel_paths
        )

    def _freeze(self, grown=None):
        self._fill_tables()
        self._record(grown)

    def _fill_tables(self):
        self._tables = [
            self.traits.lambertian,
            self.traits.perturbed,
            self.records,
            self.shares,
            self.ratio,
            self.published_tables,
            self.cache or {},
            *self.grid.tables(),
            *self.lights.tables(),
        ]

    def _cache_targets(self, wavelengths):
        return CacheTargets(
            self.scene,
            self.traits,
            self.lights,
            self.cache,
            self.grid,
            self.integrator.target,
            mi.Float(self.sensor.shutter_open()),
            wavelengths,
            self.reach,
        )

    @property
    def settings(self):
        radius = {"radius": self.radius} if self.integrator.merging else {}
        return {**super().settings, **radius}

    def _spectral(self, iteration):
        spectral = super()._spectral(iteration)
        if self.integrator.merging:
            radius = shrunk(self.radius, self.integrator.alpha, iteration)
            spectral["radius"] = dr.opaque(mi.Float, radius)
        return spectral

    @property
    def merged_paths(self):
        """Light sub-paths with which each camera path is merged."""
        return self.light_chunk * self.light_rounds

    def weights(self, spectral):
        """The weights of an iteration; those of the papers as soon as there are cache points."""
        integrator = self.integrator
        if integrator.published and integrator.aware and self.cache is not None:
            return PublishedWeights(
                self.lights,
                self._cache_targets(spectral["wavelengths"]),
                *self.published_tables,
                integrator.resampled_light_paths,
                integrator.resamples,
                self.ratio,
            )
        return ResampledWeights(
            self.lights,
            self.grid,
            self.records,
            self.shares,
            integrator.resampled_light_paths,
            integrator.resamples,
            integrator.aware and not integrator.published,
            self.ratio,
            self.traits,
            self._merging(spectral),
        )

    def _merging(self, spectral):
        """The `Merging` of an iteration; None where nothing is merged."""
        if not self.integrator.merging:
            return None
        return merging_of(self.traits, spectral["radius"], self.merged_paths)

    # ------------------------------------------------------------------ passes

    def _trace_camera(self, scene, sensor, tables, sequence, first, skip, spectral):
        path = self.part_of_paths(first, skip)
        return trace_camera_vertices(
            self.world,
            self.limits,
            self.describe_camera_pass(sensor, sequence, path, spectral),
            self.weights(spectral),
            self.ratio,
            self.capacity["camera"],
            self.capacity["hits"],
        )

    def _starts(self, sensor, sequence, spectral):
        return sample_light_starts(
            self.lights,
            sequence,
            self.integrator.resampled_light_paths,
            spectral["wavelengths"],
            mi.Float(sensor.shutter_open()),
        )

    def _ends(self, starts, light, places, found, weights):
        M = self.integrator.resampled_light_paths
        kept = dr.minimum(found, dr.opaque(mi.UInt32, self.capacity["ends"]))
        return LightVertices(
            self.traits,
            self.lights,
            starts,
            M,
            light,
            places,
            kept + M,
            self.reach,
            weights.eta_at,
        )

    def _targets(self, scene, sensor, tables, sequence, subpaths, first, cache, spectral, target):
        """q*/p of every light vertex of M sub-paths (from the number `first` on) at every cache
        point if nothing stood between, row by row; whether nothing does (`_seen`); what makes their
        `LightVertices`; how many vertices they have; `guessed_weight`. `subpaths`: as of
        `trace_light_subpaths`."""
        light, count, lengths = subpaths
        room, M = self.capacity["ends"], self.integrator.resampled_light_paths
        places, found = list_light_vertices(
            light, count, lengths, first, M, self.capacity["light"], room
        )
        starts, weights = self._starts(sensor, sequence, spectral), self.weights(spectral)
        ends = self._ends(starts, light, places, found, weights)
        index = lanes(dr.width(cache["depth"]) * (M + room))
        width = dr.opaque(mi.UInt32, M + room)
        point, end = index // width, index % width
        active = end < dr.gather(mi.UInt32, ends.count, 0)
        z = {name: dr.gather(type(values), values, point, active) for name, values in cache.items()}
        sent = ends.send(
            z["p"], end, mi.Float(sensor.shutter_open()), spectral["wavelengths"], active
        )
        if self.integrator.max_depth > 0 and not self.integrator.published:
            active &= z["depth"] + sent.vertices <= self.integrator.max_depth
        if self.integrator.published:
            r = sent.mean * self._cache_targets(spectral["wavelengths"]).received(z, sent.d, active)
        elif target == TARGETS[0]:
            r = channel_mean(sent.light) * receiving_cosine(self.traits, z, sent.d)
        else:
            r = channel_mean(
                sent.light
                * vertex_bsdf_of(self.traits, z, spectral["wavelengths"], active).f_and_pdfs(
                    z["towards"], sent.d, active
                )[0]
            )
        active &= (r > 0) & dr.isfinite(r)
        rng = vertex_streams(point, end, sequence.own_seed())
        seen = self._seen(scene, ends, z, sent, spectral, rng, active)
        if self.traits.has_media:
            seen = channel_mean(seen)
        return (
            dr.select(active, r, 0),
            seen,
            starts,
            places,
            found,
            dr.select(end < dr.gather(mi.UInt32, ends.count, 0), sent.vertices, 0),
            guessed_weight(self.traits, z, sent, weights.eta_at(z)),
        )

    def _seen(self, scene, ends, z, sent, spectral, rng, active):
        """Whether camera vertices `z` (records) see the `ends` that sent `sent`; in scenes with
        media the share of light (spectrum) that gets there."""
        if self.traits.has_media:
            return ends.transmitted(scene, z, sent, spectral["wavelengths"], rng, active)
        return ends.unblocked(scene, z["p"], z["n"], sent, active)

    def _own_targets(self, scene, sensor, tables, sequence, subpaths, cache, spectral):
        """What pmfs are made of: q*/p of the first M sub-paths for the target at hand, times the
        guessed weight (but for the papers' pmfs); then as of `_targets`."""
        target = self.integrator.target
        r, *others, vertices, guess = self._targets(
            scene,
            sensor,
            tables,
            sequence,
            subpaths,
            mi.UInt32(0),
            cache,
            spectral,
            target,
        )
        if self.integrator.published:
            return r, *others, vertices
        return dr.select(r > 0, r * guess, 0), *others, vertices

    def _pilot_targets(self, scene, sensor, tables, sequence, subpaths, first, cache, spectral):
        return self._targets(
            scene,
            sensor,
            tables,
            sequence,
            subpaths,
            first,
            cache,
            spectral,
            "f_y_rho_g_v",
        )

    def _pmfs(self, r, seen, found):
        """The cache points' pmfs as of `cumulative_sums`, or the papers' as of `cumulative_pmfs`
        and what they are made of."""
        M, room = self.integrator.resampled_light_paths, self.capacity["ends"]
        if self.integrator.published:
            r = arriving(r, seen)
            pmfs = *cumulative_pmfs(r, M + room), r
            dr.eval(pmfs)
            return pmfs
        pmfs = cumulative_sums(r, seen, dr.minimum(found, room) + M, M + room)
        dr.eval(pmfs)  # a recording cannot make it
        return pmfs

    def _connect(
        self,
        scene,
        sensor,
        tables,
        radiance,
        camera,
        count,
        proposals,
        sequence,
        first,
        spectral,
    ):
        """Radiance of camera paths with that of connections of their `count` vertices to drawn
        light sub-paths added, and the entries of its classes (None where light is not split).
        `proposals`: as of `_proposals`."""
        light, starts, places, found, pmfs = proposals
        integrator, weights = self.integrator, self.weights(spectral)
        ends = self._ends(starts, light, places, found, weights)
        kind = CachePmfs if integrator.published else Proposals
        pmf = kind(
            self.grid,
            *pmfs,
            ends.count,
            integrator.resampled_light_paths + self.capacity["ends"],
        )
        index = lanes(self.capacity["camera"] * integrator.resamples)
        slot = index // integrator.resamples
        active = slot < dr.gather(mi.UInt32, count, 0)
        z = read_vertices(camera, slot, active, states=(*STEP, *weights.kernels))
        number = (first + z["path"]) * integrator.resamples + index % integrator.resamples
        rng = sequence.of_paths(number).at(z["number"])
        row = self._row_of(z)
        which = None
        if integrator.published:
            which, drawn, active = pmf.draw(row, rng, active)
        else:
            drawn = pmf.draw(row, rng, active)
        active &= drawn < dr.gather(mi.UInt32, ends.count, 0)

        sent = ends.send(
            z["p"], drawn, mi.Float(sensor.shutter_open()), spectral["wavelengths"], active
        )
        segments = z["depth"] + sent.vertices
        if integrator.max_depth > 0:
            active &= segments <= integrator.max_depth
        vertex_bsdf = vertex_bsdf_of(self.traits, z, spectral["wavelengths"], active)
        value, forward, back = vertex_bsdf.f_and_pdfs(z["towards"], sent.d, active)
        carried = z["throughput"] * value * sent.light
        active &= (dr.max(carried) > 0) & dr.all(dr.isfinite(carried))
        seen = self._seen(scene, ends, z, sent, spectral, own_stream(rng, SHADOW_SALT), active)
        if self.traits.has_media:
            carried *= seen
            active &= dr.max(seen) > 0
        else:
            active = seen
        own, per = self._of_draw(weights, pmf, z, sent, row, which, drawn, active)
        scattering = vertex_bsdf, value, forward, back
        share = self._share(weights, own, camera, z, sent, scattering, segments, active)
        estimate = carried * (
            share * per * (1 / (integrator.resampled_light_paths * integrator.resamples))
        )
        total = radiance + dr.zeros(mi.Spectrum, self.chunk)  # radiance may be a single zero
        dr.scatter_reduce(dr.ReduceOp.Add, total, estimate, z["path"], active)
        if not self.integrator.splits_light:
            return total, None
        classes = LightClasses(self.chunk, None, ("joined",))
        alone = (sent.vertices == 1) & (z["parent"] == NO_PARENT)
        number = class_of(dr.select(alone, mi.UInt32(1), mi.UInt32(2)), sent.mark)
        classes.add("joined", z["path"], number, estimate, active)
        return total, classes.entries

    def _row_of(self, z):
        """Row of a camera vertex, whose cache points it draws from."""
        return self.grid.row(z["p"], z["n"] if self.integrator.published else seen_normal(z))

    def _of_draw(self, weights, pmf, z, sent, row, which, drawn, active):
        """`(own, per)`: the gain of the techniques at a camera vertex that has drawn a light
        vertex, and what their common weight is to be multiplied with.

        That is one over the probability of the draw, whichever cache point made it. Published
        weights take each cache point for a technique of its own: there it is the technique's share
        of the gain, over the probability that this cache point is taken and makes the draw."""
        if not self.integrator.published:
            probability = pmf.probability(row, drawn, active)
            return self._own_gain(weights, z, sent, active), dr.rcp(dr.maximum(probability, 1e-20))
        chance = resampling.cache_point_probability(self.grid.neighbors)
        probabilities = pmf.probabilities(row, drawn, active)
        if not self.integrator.aware:
            return mi.Float(1), dr.rcp(dr.maximum(chance * sum(probabilities), 1e-20))
        gains = weights.gains(pmf.ratios(row, drawn, active), row, sent.vertices, active)
        own = sum(gains)
        mine, probability = gains[-1], probabilities[-1]
        for number in range(self.grid.neighbors):
            mine = dr.select(which == number, gains[number], mine)
            probability = dr.select(which == number, probabilities[number], probability)
        taken = dr.maximum(chance * probability, 1e-20) * dr.maximum(own, 1e-20)
        return own, mine * dr.rcp(taken)

    def _own_gain(self, weights, z, sent, active):
        """Gain of the technique that joins a light vertex, which sends `sent`, to a camera
        vertex."""
        cosine = facing(self.traits, z["n"], sent.d)
        return weights.gain(
            sent.mean * weights.softened(cosine, dr.square(sent.distance)),
            weights.row(z["p"], z["n"], sent.d),
            sent.vertices,
            active,
        )

    def _share(self, weights, own, camera, z, sent, scattering, segments, active):
        """Weight w_t of a connection with the gain `own` among all techniques of its joint path.
        `scattering`: the `VertexBSDF` at the camera vertex `z`, and what its `f_and_pdfs` says."""
        vertex_bsdf, value, forward, back = scattering
        cosine = facing(self.traits, z["n"], sent.d)
        end = LightEnd(
            sent.pdf_area * cosine,
            sent.mean * dr.rcp(dr.maximum(sent.pdf_area, 1e-20)),
            vertex_bsdf.scattered_mean(value, sent.d, active),
            back,
            segments,
            weights.kernels_of_vertex(z["row"], z["p"], vertex_bsdf, sent.d, active),
            weights.eta_at(z),
        )
        nearer = sum_before(camera, z, z["parent"], end, weights, active)
        return own * dr.rcp(dr.maximum(own + forward * cosine * sent.mis_sum + nearer, 1e-20))

    def _meet(self, tables, radiance, camera, hits, hit_count, spectral, entries):
        """Radiance of camera paths with that of emission that they meet beyond the first vertex
        added, and the entries of its classes."""
        weights = self.weights(spectral)
        index = lanes(self.capacity["hits"])
        active = index < dr.gather(mi.UInt32, hit_count, 0)
        hit = hit_layout(weights).read(hits, index, active)
        kernels = [hit[name] for name in weights.light_kernels]
        end = LightEnd(
            hit["start"], hit["light_mean"], mi.Float(1), hit["across"], hit["depth"], kernels
        )
        nearer = sum_before(camera, hit, hit["parent"], end, weights, active)
        total = radiance + dr.zeros(mi.Spectrum, self.chunk)  # radiance may be a single zero
        value = hit["value"] * dr.rcp(1 + nearer)
        dr.scatter_reduce(dr.ReduceOp.Add, total, value, hit["path"], active)
        if not self.integrator.splits_light:
            return total, None
        classes = LightClasses(self.chunk, entries, ("met",))
        classes.add("met", hit["path"], self._class_of_hit(hit, camera, active), value, active)
        return total, classes.entries

    def _merge_vertices(self, scene, tables, radiance, camera, count, light, spectral, entries):
        """Radiance of camera paths with that of merges with the light sub-paths `light` added, and
        the entries of its classes."""
        weights = self.weights(spectral)
        index = lanes(self.capacity["camera"])
        active = index < dr.gather(mi.UInt32, count, 0)
        z = read_vertices(camera, index, active, states=STEP)
        if self.integrator.splits_light:
            z["mark"] = z["parent"] == NO_PARENT
        parts = merged_light(
            self.traits,
            light,
            self.capacity["light"],
            END,
            z,
            active,
            partial(self._merge_weigher, weights, camera, z),
            spectral["radius"],
            self.merged_paths,
            self.integrator.max_depth,
            spectral,
        )
        return with_merged(radiance, entries, parts, z, active, self.chunk)

    @staticmethod
    def _merge_weigher(weights, camera, z, photon_map):
        """What weighs the photons of a map at the vertices `z` (records of the buffer `camera`):
        `weigh` of `gather_photons`."""

        def weigh(index, landing, scattering, active):
            return weights.merged(
                camera,
                z,
                state_of(photon_map, index, active, END),
                channel_mean(scattering.f),
                scattering.p,
                scattering.back(),
                z["depth"] + landing.depth,
                active,
            )

        return weigh

    @staticmethod
    def _class_of_hit(hit, camera, active):
        """The class of emission that is met: by the parents, which have scattered smoothly, and by
        the density of the last direction, none after a delta function."""
        scattered = hit["parent"] != NO_PARENT
        before = dr.gather(mi.UInt32, camera["parent"], hit["parent"], active & scattered)
        later = dr.select(before == NO_PARENT, mi.UInt32(1), mi.UInt32(2))
        return class_of(dr.select(scattered, later, 0), hit["d_vcm"] == 0)

    def _join_sensor(self, scene, sensor, tables, light, count, seed, spectral):
        """Block of the light sub-paths that are joined with the sensor: three channels, and three
        for each class."""
        y, joined = self._joined_with_sensor(sensor, light, count, seed, spectral, END)
        value = joined.value * (self.weights(spectral).seen_by_sensor(joined, y) / self.ratio)
        spectra, matrix = self._with_classes(value, y), spectral["sensor_matrix"]
        return splat_light(sensor.film(), joined.film, spectra, matrix, joined.active)
