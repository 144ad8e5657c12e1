"""What `pcbpt` and `bdpt_ris` share: connections to light sub-paths drawn from pmfs of cache
points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import as_camera_weights, splat_samples, with_colour
from ..core.packing import from_numpy, rounded_up
from ..core.random import mix
from ..mis.published_resampling import published_tables, unknown_tables
from ..mis.resampling import LENGTHS, tabulate, uniform_tables
from ..paths.camera_vertices import STEP
from ..paths.layers import CHANNELS, SPLIT
from ..paths.light_classes import LightClasses
from ..paths.subpaths import read_vertices, seen_normal
from ..resampling.cache_targets import TARGETS, integrals
from ..resampling.proposals import arriving
from .common import IterativeIntegrator
from .merging import automatic_radius
from .purposes import APERTURE, CAMERA, DRAW, LIGHT, START
from .resampled_passes import ResampledPasses
from .schedule import read_radius

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
        # More than one pays only where weights know of the draws.
        usual = 2 if self.aware else 1
        self.resamples = parameters.integer("resamples", usual, 1, "from 1 to 1024", high=1024)
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

    def refused_in_media(self):
        return [('"weights" = published', '"bounded"')] if self.published else []

    def new_session(self, scene, sensor, seed, iterations):
        return ResampledSession(self, scene, sensor, seed, iterations)


def ends_room(lengths, M):
    """Room for the vertices of M light sub-paths, where some have had `lengths` (NumPy array):
    rarely too little, and not much more than they need, for every place is a lane at each cache
    point."""
    return rounded_up(int(np.ceil(M * lengths.mean() + 4 * np.sqrt(M) * lengths.std())) + 1)


class ResampledSession(ResampledPasses):
    """Iterations of both plugins, and what is learned before the first one: cache points, and the
    weights' tables."""

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
        sets = self.known_sets
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
        """As `_join_sensor`, of what `trace_light_subpaths` returns."""
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


PILOT = 1 << 31
"""The number of the iteration that never is: what only the weights and the cache are made of draws
from its seeds."""
