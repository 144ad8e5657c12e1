"""What `pcbpt` and `bdpt_ris` share: connections to light sub-paths drawn from pmfs of cache
points."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import (
    as_camera_weights,
    expected_weight,
    splat_light,
    splat_samples,
    with_colour,
)
from ..core.packing import from_numpy, rounded_up
from ..core.random import mix, next_2d, own_stream, vertex_streams
from ..core.recording import lanes, recorder
from ..core.spectra import channel_mean
from ..core.traits import SceneTraits
from ..lights.lights import Lights
from ..mis.published_resampling import PublishedWeights, published_tables, unknown_tables
from ..mis.resampling import (
    LENGTHS,
    ResampledWeights,
    guessed_weight,
    tabulate,
    uniform_tables,
)
from ..paths.camera import with_gaps
from ..paths.camera_vertices import STEP, LightEnd, hit_layout, sum_before, trace_camera_vertices
from ..paths.connect import join_sensor
from ..paths.layers import CHANNELS, SPLIT
from ..paths.light_classes import LightClasses, by_class, class_of
from ..paths.light_starts import sample_light_starts
from ..paths.media import SHADOW_SALT
from ..paths.sensor import Lens
from ..paths.setting import World
from ..paths.subpaths import (
    NO_PARENT,
    read_vertices,
    seen_normal,
    trace_light_subpaths,
    vertex_bsdf_of,
)
from ..paths.vertex import facing
from ..photons.vertex_map import state_of
from ..resampling.cache_pmfs import CachePmfs, cumulative_pmfs
from ..resampling.cache_points import CacheGrid
from ..resampling.cache_targets import TARGETS, CacheTargets, integrals, receiving_cosine
from ..resampling.light_vertices import END, LightVertices, list_light_vertices
from ..resampling.proposals import Proposals, arriving, cumulative_sums
from ..weights import resampling
from .common import IterativeIntegrator, IterativeSession
from .merging import automatic_radius, merged_light, merging_of, with_merged
from .schedule import read_radius, shrunk

CHUNK = 1 << 18
"""Camera paths, and as many light sub-paths, traced at once at most; larger films are traced in
parts (bounds memory), which share their proposals."""
CACHE_SHARE, FEWEST_CACHE_POINTS = 1 / 300, 256
"""Tuned: cache points: this share of a part's camera vertices, but at least so many. More of them
cost shadow rays."""
MOST_PAIRS = 1 << 24
"""Pairs of a cache point and a light vertex at most, four bytes each (and some more while they are
made); beyond that there are fewer cache points."""
LIGHT_TRACING, LEAST_LIGHT_TRACING, MOST_LIGHT_TRACING = 1.0, 1 / 8, 8.0
"""Light sub-paths that are joined to the sensor, for each camera path, unless a parameter says
otherwise, and the parameter's bounds."""
MORE_ROOM = 1.1
"""Room for vertices of sub-paths over what the first iteration has: a connection takes a lane for
each place of a camera vertex, used or not."""
KNOWN_PATHS, MOST_KNOWN_SETS = 200, 8
"""Tuned: light sub-paths of the first iteration from which Q and Q_s are estimated, in sets of M;
at most so many sets."""


WEIGHTS = "bounded", "published"
"""Values of the parameter `weights`: pmfs with blind and uniform shares, and weights with bounds;
those of the papers."""


class ResampledIntegrator(IterativeIntegrator):
    """Parameters of both plugins; `aware` tells them apart."""

    CAMERA_PATHS = 4, 1, "at least 1"
    LAYERS = *CHANNELS, *SPLIT
    aware = True

    @property
    def published(self):
        """Whether pmfs and weights are those of the papers."""
        return self.weights == WEIGHTS[1]

    def read_parameters(self, parameters):
        self.resampled_light_paths = parameters.integer(
            "light_paths", 200, 1, "from 1 to 100000", high=100000
        )
        self.resamples = parameters.integer("resamples", 1, 1, "from 1 to 1024", high=1024)
        self.cache_neighbors = parameters.integer("cache_neighbors", 3, 1, "from 1 to 16", high=16)
        self.target = parameters.choice("target", TARGETS[0], TARGETS)
        self.weights = parameters.choice("weights", WEIGHTS[0], WEIGHTS)
        given = parameters.number(
            "light_tracing",
            LIGHT_TRACING,
            lambda n: n == 0 or LEAST_LIGHT_TRACING <= n <= MOST_LIGHT_TRACING,
            f"0 or from {LEAST_LIGHT_TRACING:g} to {MOST_LIGHT_TRACING:g}",
        )
        self.light_tracing = given or LIGHT_TRACING
        self.merging = parameters.boolean("merging", False)
        if self.merging and self.published:
            parameters.refuse("merging", 'the papers\' weights know none; use "weights" = bounded')
        self.guided_lights = parameters.boolean("guided_lights", True)
        self.initial_radius, self.alpha = read_radius(parameters)
        if not self.merging:
            for name in ("initial_radius", "alpha"):
                parameters.refuse(name, 'nothing is merged; set "merging" = true')

    def settings(self):
        return {
            **super().settings(),
            "light_paths": self.resampled_light_paths,
            "resamples": self.resamples,
            "cache_neighbors": self.cache_neighbors,
            "target": self.target,
            "weights": self.weights,
            "light_tracing": self.light_tracing,
            "merging": self.merging,
            "guided_lights": self.guided_lights,
            "initial_radius": self.initial_radius,
            "alpha": self.alpha,
        }

    MEDIA = True

    def refused_in_media(self):
        published = [('"weights" = published', '"bounded"')] if self.published else []
        return published + super().refused_in_media()

    def new_session(self, scene, sensor, seed, iterations):
        return ResampledSession(self, scene, sensor, seed, iterations)


def ends_room(lengths, M):
    """Room for the vertices of M light sub-paths, where some have had `lengths` (NumPy array):
    rarely too little, and not much more than they need, for every place is a lane at each cache
    point."""
    return rounded_up(int(np.ceil(M * lengths.mean() + 4 * np.sqrt(M) * lengths.std())) + 1)


class ResampledSession(IterativeSession):
    """Iterations of both plugins: light sub-paths, pmfs of the cache points, camera sub-paths,
    connections, emission met, light that meets the sensor."""

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
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.traits = SceneTraits(scene, sensor)
        self.lights = Lights.seen_by(scene, sensor, integrator.plugin, integrator.guided_lights)
        if self.traits.has_media:
            self.lights.find_media(sensor, integrator.plugin)
        self.world = World(scene, self.lights, self.traits)
        self.split_paths(CHUNK)
        width, height = sensor.film().crop_size()
        self.pixel_paths = width * height * integrator.camera_paths
        self.capacity = {
            "camera": rounded_up(4 * self.chunk),
            "hits": rounded_up(self.chunk),
            "ends": rounded_up(6 * integrator.resampled_light_paths),
        }
        self.lens = Lens(sensor).connects
        self._share_light()
        depth = integrator.max_depth
        self.lit = not self.lights.dark and (depth < 0 or depth >= 2)
        bounds = self.traits.bounds
        self.reach = 4 * float(
            np.linalg.norm(np.array(bounds.max).ravel() - np.array(bounds.min).ravel())
        )
        self.expected_weight = expected_weight(sensor.film(), integrator.camera_paths)
        self.recorded = recorder()
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

    def _trace_camera(self, scene, sensor, tables, sequence, first, skip, spectral):
        first = with_gaps(first, skip, self.chunk, self.camera_paths)
        return trace_camera_vertices(
            self.world,
            self.limits,
            self.describe_camera_pass(sensor, sequence, first, spectral),
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
        """As `_meet_sensor`."""
        index = lanes(self.capacity["light"])
        active = index < dr.gather(mi.UInt32, count, 0)
        y = read_vertices(light, index, active, states=END)
        rng = vertex_streams(y["path"], y["number"], seed)
        aperture = next_2d(rng) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        joined = join_sensor(
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
        value = joined.value * (self.weights(spectral).seen_by_sensor(joined, y) / self.ratio)
        spectra = [value]
        if self.integrator.splits_light:
            smooth = dr.select(y["depth"] == 1, mi.UInt32(1), mi.UInt32(2))
            spectra += by_class(class_of(smooth, y["mark"]), value)
        matrix = spectral["sensor_matrix"]
        return splat_light(sensor.film(), joined.film, spectra, matrix, joined.active)

    # ------------------------------------------------------------------ before the first iteration

    def _prepare(self):
        """Begins the first iteration: traces its light, and draws the cache points from its first
        part. All sessions of a render see the same here."""
        spectral = self._spectral(0)
        traced, M = self._camera(0, 0, spectral), self.integrator.resampled_light_paths
        vertices = min(int(traced[4][0]), self.capacity["camera"])
        if self.integrator.merging and not self.integrator.initial_radius:
            self.radius = automatic_radius(self.traits, traced[3], vertices, STEP)
            spectral = self._spectral(0)
        light = self._light(0, 0, spectral)
        wanted = min(max(FEWEST_CACHE_POINTS, int(vertices * CACHE_SHARE)), max(vertices, 1))
        self.capacity |= {
            "ends": ends_room(np.array(light[2]), M),
            "light": rounded_up(int(MORE_ROOM * int(light[1][0])) + 1),
            "camera": rounded_up(int(MORE_ROOM * vertices) + 1),
        }
        self.cache = self._cache_points(
            traced[3], vertices, max(min(wanted, MOST_PAIRS // (M + self.capacity["ends"])), 1)
        )
        published = self.integrator.published
        self.grid = self._grid(
            self.cache["p"], self.cache["n"] if published else seen_normal(self.cache)
        )
        self.records, self.shares = uniform_tables(self.grid)
        self.published_tables = unknown_tables(dr.width(self.cache["depth"]))
        self._freeze()
        # Published weights are other ones than those that this light was traced with.
        self.first_light = None if published else light

    def _take_weights(self, iteration):
        """Sets the weights of an iteration. They must not depend on its own light sub-paths: the
        first one's goes by densities alone, those of all others by what the first one's sub-paths
        tell of Q and Q_s."""
        if not self.integrator.aware:
            return
        if self.integrator.published:
            if iteration not in self.next_tables:
                self._learn(iteration)
            self.published_tables = self.next_tables.pop(iteration)
            self._fill_tables()
            return
        if iteration > 0 and self.known is None:
            self.known = tabulate(self.grid, *self._integrals(self.first_light, self._spectral(0)))
        self.records, self.shares = self.known if iteration > 0 else uniform_tables(self.grid)
        self._fill_tables()

    def _learn(self, iteration):
        """Makes the published weights' tables for an iteration from the light sub-paths of the one
        before, as they are wherever that was rendered; for the first one from some of its own."""
        before = iteration - 1 if iteration > 0 else PILOT
        spectral = self._spectral(max(iteration - 1, 0))
        r, seen, _, _, _, vertices = self._own_ends(
            before, spectral, self._light(before, 0, spectral)
        )
        self._keep_tables(iteration, r, seen, vertices)

    def _keep_tables(self, iteration, r, seen, vertices):
        """Keeps the tables that targets of M light sub-paths (`_own_targets`) make for an
        iteration."""
        M = self.integrator.resampled_light_paths
        width = M + self.capacity["ends"]
        found = integrals(arriving(r, seen), vertices, LENGTHS, width, M)
        self.next_tables = {iteration: published_tables(*found)}

    def _cache_points(self, camera, vertices, count):
        """`count` of the camera's vertices, at random (a single one in nothingness if there is
        none)."""
        active = mi.Bool(vertices > 0)
        order = read_vertices(
            camera, dr.arange(mi.UInt32, max(vertices, 1)), active, ("path", "number"), STEP
        )
        order = np.lexsort(
            (np.array(order["number"]), np.array(order["path"]))
        )  # places in the buffer are accidental
        chosen = np.random.default_rng(mix(self.seed, PILOT, CAMERA)).choice(
            order, count, replace=False
        )
        cache = read_vertices(camera, from_numpy(mi.UInt32, chosen), active, states=STEP)
        cache = {
            name: cache[name]
            for name in ("p", "n", "ns", "towards", "value", "density", "depth", "d_vcm")
            + ("hit", "above", "below")
            if name in cache
        }
        cache["through"] = dr.full(mi.Bool, False, count)
        if "hit" in cache:
            flags = dr.select(active, cache["hit"].shape, dr.zeros(mi.ShapePtr)).bsdf().flags()
            cache["through"] |= (
                flags & (mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DiffuseTransmission)
            ) != 0
        dr.eval(cache)
        return cache

    def _integrals(self, light, spectral):
        """`Q_s`, `Q_blind` and `ends_s` as `tabulate` takes them."""
        M, points, cache = (
            self.integrator.resampled_light_paths,
            dr.width(self.cache["depth"]),
            self.cache,
        )
        sets = max(min(-(-KNOWN_PATHS // M), MOST_KNOWN_SETS, self.light_chunk // M), 1)
        Q_s, Q_blind, ends_s = np.zeros((points, LENGTHS)), np.zeros(points), np.zeros(LENGTHS)
        for k in range(sets):
            r, seen, _, _, found, vertices, _ = self._ends_fit(
                lambda k=k: self._pilot_pass(
                    self.scene,
                    self.sensor,
                    self._tables,
                    self._sequence(PILOT + k, START, M),
                    light,
                    dr.opaque(mi.UInt32, k * M),
                    cache,
                    spectral,
                )
            )
            used = M + int(found[0])
            r, seen = (
                np.array(x).reshape(points, M + self.capacity["ends"])[:, :used] for x in (r, seen)
            )
            length = np.minimum(np.array(vertices)[:used], LENGTHS) - 1
            Q_s += (r * seen) @ np.eye(LENGTHS)[length]
            Q_blind += r.sum(axis=1)
            ends_s += np.bincount(length, minlength=LENGTHS)
        return Q_s / (sets * M), Q_blind / (sets * M), ends_s / (sets * M)

    # ------------------------------------------------------------------ iterations

    def _light(self, iteration, chunk, spectral):
        """What `trace_light_subpaths` returns."""
        while True:
            light = self._light_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(iteration, LIGHT, self.integrator.resampled_light_paths),
                dr.opaque(mi.UInt32, chunk * self.light_chunk),
                spectral,
            )
            if not self._grown("light", light[1]):
                return light

    def _camera(self, iteration, chunk, spectral):
        """What `trace_camera_vertices` returns."""
        while True:
            traced = self._camera_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(iteration, CAMERA, self.camera_paths),
                *self.all_over_the_film(chunk),
                spectral,
            )
            if not self.lit or not (
                self._grown("camera", traced[4]) or self._grown("hits", traced[6])
            ):
                return traced

    def _ends_fit(self, compute):
        """Result of `compute()`, repeated with more room for ends if there were more (its fifth
        entry counts them)."""
        while True:
            result = compute()
            dr.eval(result)
            if not self._grown("ends", result[4]):
                return result

    def _proposals(self, iteration, spectral, light):
        """What all camera paths of an iteration draw from: the vertices and starts of M of the
        sub-paths `light`, and the pmfs."""
        r, seen, *ends, vertices = self._own_ends(iteration, spectral, light)
        if self.integrator.published and self.integrator.aware:
            self._keep_tables(iteration + 1, r, seen, vertices)
        return light[0], *ends, self._pmfs(r, seen, ends[-1])

    def _own_ends(self, iteration, spectral, light):
        """What `_own_targets` returns, of an iteration's M light sub-paths."""
        return self._ends_fit(
            lambda: self._target_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(iteration, START, self.integrator.resampled_light_paths),
                light,
                self.cache,
                spectral,
            )
        )

    def _radiance(self, iteration, chunk, traced, proposals, spectral):
        """Radiance of camera paths (`trace_camera_vertices`) with everything that they meet and are
        connected to, and by class what was added (None where light is not split)."""
        radiance, _, _, camera, count, hits, hit_count = traced
        radiance, entries = self._connection_pass(
            self.scene,
            self.sensor,
            self._tables,
            radiance,
            camera,
            count,
            proposals,
            self._sequence(iteration, DRAW, self.integrator.resamples),
            dr.opaque(mi.UInt32, chunk * self.chunk),
            spectral,
        )
        radiance, entries = self._hit_pass(
            self._tables, radiance, camera, hits, hit_count, spectral, entries
        )
        dr.eval(radiance, entries)  # else its sums may still wait when the film's are made
        return radiance, entries

    def _meet_sensor(self, light, seed, spectral):
        """Block of the light sub-paths (`trace_light_subpaths`) that meet the sensor: three
        channels, and three for each class."""
        vertices, found, _ = light
        return self._sensor_pass(
            self.scene, self.sensor, self._tables, vertices, found, seed, spectral
        )

    def _chunk(self, iteration, chunk, spectral, light, proposals):
        """Blocks of one part of an iteration: of its camera paths, and of the light that met the
        sensor (or None). `light`: the first part's light sub-paths."""
        traced = self._camera(iteration, chunk, spectral)
        radiance, alpha, position, *_ = traced
        block = entries = None
        seen = radiance  # emission that the camera's rays meet at once
        if self.lit:
            radiance, entries = self._radiance(iteration, chunk, traced, proposals, spectral)
            for part in (
                range(chunk * self.light_rounds, (chunk + 1) * self.light_rounds)
                if self.lens or self.integrator.merging
                else ()
            ):
                subpaths = self._light(iteration, part, spectral) if part else light
                if self.integrator.merging:
                    radiance, entries = self._merge_pass(
                        self.scene,
                        self._tables,
                        radiance,
                        traced[3],
                        traced[4],
                        subpaths,
                        spectral,
                        entries,
                    )
                    dr.eval(radiance, entries)
                if self.lens:
                    seed = self._seed(iteration, APERTURE, part)
                    met = self._meet_sensor(subpaths, seed, spectral)
                    block = met if block is None else block + met
        if self.integrator.hide_emitters:
            radiance = dr.select(
                alpha > 0, radiance, 0
            )  # as `path` does: what is behind nothing but null surfaces is hidden
        classes = ()
        if self.integrator.splits_light:
            classes = LightClasses(self.chunk, entries).radiance()
            classes[0] += seen
            if self.integrator.hide_emitters:
                classes = [dr.select(alpha > 0, light, 0) for light in classes]
        return splat_samples(
            self.sensor.film(),
            position,
            radiance,
            alpha,
            spectral["matrix"],
            self.in_chunk(*self.all_over_the_film(chunk)),
            classes=classes,
        ), block

    def start(self):
        if self.cache is None and self.lit:
            self._prepare()

    def _iteration(self, iteration):
        spectral = self._spectral(iteration)
        light = proposals = None
        if self.lit:
            self._take_weights(iteration)
            light = self.first_light if iteration == 0 else None
            light = light or self._light(iteration, 0, spectral)
            if not self.integrator.aware or self.known is not None:
                self.first_light = None  # nobody will ask for it again
            proposals = self._proposals(iteration, spectral, light)
        block, met = self.sum_of_chunks(
            lambda chunk, _: self._chunk(iteration, chunk, spectral, light, proposals)
        )
        return (
            block
            if met is None
            else with_colour(block, as_camera_weights(met, block, self.expected_weight))
        )


LIGHT, CAMERA, APERTURE, START, DRAW = 0, 1, 3, 4, 5
"""Purposes of an iteration's random seeds, besides `IterativeSession.WAVELENGTH`."""
PILOT = 1 << 31
"""The number of the iteration that never is: what only the weights and the cache are made of draws
from its seeds."""
