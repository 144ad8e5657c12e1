"""Plugin `bdpt`: bidirectional path tracing."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi

from ..core.film import (
    as_camera_weights,
    splat_channels,
    splat_light,
    splat_samples,
    with_colour,
)
from ..core.packing import rounded_up
from ..core.random import vertex_streams
from ..core.recording import lanes
from ..mis.vertex_merging import ConnectionWeights
from ..paths.connect import by_path, join, kept_between, list_pairs, visible
from ..paths.layers import CHANNELS, SPLIT
from ..paths.light_classes import LightClasses, class_of
from ..paths.subpaths import Kept, read_vertices, trace_camera_subpaths
from .common import MOST_LIGHT_PATHS, IterativeIntegrator
from .purposes import APERTURE, CAMERA, LIGHT, SHADOWS
from .pyramid import Ledger, camera_images, sensor_images, technique_channels, with_rest
from .subpath_session import SubpathSession

CHUNK = 1 << 19
"""Camera paths, and as many light sub-paths, traced at once at most; larger films are traced in
parts (bounds memory)."""


class BDPT(IterativeIntegrator):
    r"""
    .. _integrator-bdpt:

    Bidirectional path tracing (:monosp:`bdpt`)
    -------------------------------------------

    .. pluginparameters::

     * - beta
       - |float|
       - Exponent of the heuristic, from 1 to 8: 1 is Veach's balance heuristic, 2 his power
         heuristic. (Default: 1)
     * - techniques
       - |int|
       - Adds an image of its own for each technique (s, t), s vertices from the light and t from
         the camera, of paths of up to that many segments: channels ``technique.s2.t1.R`` and so on
         (mono: ``.Y``), and ``technique.rest.*`` for all longer paths. From 0 (none) to 10.
         (Default: 0)
     * - technique_weights
       - |bool|
       - Those images show each technique's share, and their sum is the image; |false| shows each as
         if it were the only technique. (Default: |true|)
     * - camera_paths
       - |int|
       - Camera paths per pixel and iteration, each with a light sub-path of its own. (Default: 1)
     * - variance
       - |bool|
       - Adds the channels ``var.R``, ``var.G``, ``var.B`` (mono: ``var.Y``): the estimated variance
         of the pixel mean over the iterations, of which there must be two at least. (Default: no,
         i.e. |false|)
     * - aovs
       - |string|
       - Adds layers of what the camera sees, ``name:type`` with commas between them, as Mitsuba's
         ``aov``: of the types ``albedo``, ``sh_normal`` (through glass and in mirrors), ``depth``,
         ``position``, ``geo_normal``, ``uv``, ``shape_index``, ``prim_index`` (of the first
         surface); and ``direct``, ``indirect``, ``caustic``, which sum to the image. Channels are
         ``name.R``, ``name.X`` and so on, after all others. (Default: ``none``)
     * - max_depth
       - |int|
       - Longest path in segments, both halves together (-1: unlimited). A value of 1 shows only
         directly visible emitters, 2 adds direct light, and so on. (Default: -1)
     * - rr_depth
       - |int|
       - Depth from which Russian roulette may end a sub-path, in each half. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no, i.e. |false|)
     * - sampler
       - |string|
       - Random numbers of sub-paths: ``sobol``, scrambled Sobol' sequences, one a pixel over all
         iterations; or ``independent``. The scene's ``<sampler>`` is not used but for its sample
         count. (Default: ``sobol``)

    Each camera path is traced with a light sub-path. Light comes from emitters that the camera path
    meets, from next-event estimation, from joining each of its vertices with each of the light
    sub-path's, and from joining the latter's with the sensor, on perspective, thin-lens and
    orthographic sensors. All techniques that could have made a path share it by Veach's heuristic
    (1997, chapter 10).

    Unbiased, without any parameter to choose. In participating media all techniques work as on
    surfaces, and boundaries with the BSDF ``null`` do not count as segments, as in ``volpath``.
    The phase function ``sggx`` as part of another one, the BSDF ``hair``, polarised variants,
    gradients and the film ``specfilm`` are refused by name.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpt">
                <integer name="max_depth" value="10"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpt',
            'max_depth': 10
    """

    LAYERS = *CHANNELS, *SPLIT
    techniques, technique_weights = 0, True

    def read_parameters(self, parameters):
        self.read_heuristic(parameters)
        self.techniques = parameters.integer("techniques", 0, 0, "from 0 (none) to 10", high=10)
        self.technique_weights = parameters.boolean("technique_weights", True)

    def read_heuristic(self, parameters):
        """Reads the exponent."""
        self.beta = parameters.exponent("beta")

    def estimated_channels(self):
        return super().estimated_channels() + (
            technique_channels(self.techniques, self.technique_weights) if self.techniques else []
        )

    def settings(self):
        return {
            **super().settings(),
            "beta": float(self.beta),
            "techniques": self.techniques,
            "technique_weights": self.technique_weights,
        }

    def new_session(self, scene, sensor, seed, iterations):
        return BDPTSession(self, scene, sensor, seed, iterations)


class BDPTSession(SubpathSession):
    """Iterations of `bdpt`: light sub-paths, camera sub-paths, connections, the light that meets
    the sensor."""

    shortest = 2
    """Segments that a light sub-path adds at least to a camera path with which it is joined."""
    PASSES = {
        "_light_pass": ("_trace_light", ("light",)),
        "_camera_pass": ("_trace_camera", ("camera",)),
        "_pair_pass": ("_list_pairs", ("light", "camera", "pairs")),
        "_connection_pass": ("_connect", ("light", "camera", "pairs")),
        "_sensor_pass": ("_join_sensor", ("light",)),
    }

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations, CHUNK)
        self.light_chunk = self.light_count()
        self.light_path_count = self.chunks * self.light_chunk
        self.capacity = {
            "light": rounded_up(3 * self.light_chunk),
            "camera": rounded_up(3 * self.chunk),
            "pairs": rounded_up(4 * self.chunk),
        }
        if integrator.techniques:
            self.accumulator.technique_channels = len(
                technique_channels(integrator.techniques, integrator.technique_weights)
            )
        depth = integrator.max_depth
        self.bidirectional = not self.lights.dark and (depth < 0 or depth >= 2)
        self._freeze()

    def _freeze(self, grown=None):
        self._tables = [self.traits.lambertian, self.traits.perturbed, *self.lights.tables()]
        self._record(grown)

    def light_count(self):
        """Light sub-paths with each part of the camera paths."""
        return min(self.chunk, MOST_LIGHT_PATHS)

    def weights(self, spectral):
        """The weights of an iteration."""
        integrator = self.integrator
        ratio = self.light_path_count / self.pixel_paths
        return ConnectionWeights(self.lights, integrator.beta, ratio, media=self.traits.has_media)

    # ------------------------------------------------------------------ passes

    def _trace_camera(self, scene, sensor, tables, sequence, first, skip, spectral):
        ledger = self._ledger() if self.integrator.techniques else None
        classes = None
        if self.integrator.splits_light:
            classes = LightClasses(self.chunk, None, ("met", "next_event"))
        path = self.part_of_paths(first, skip)
        radiance, alpha, position, vertices, count = trace_camera_subpaths(
            self.world,
            self.limits,
            self.describe_camera_pass(sensor, sequence, path, spectral),
            self.weights(spectral),
            self.capacity["camera"],
            ledger,
            self.shortest,
            classes,
        )
        entries = {name: x for of in (ledger, classes) if of for name, x in of.entries.items()}
        return radiance, alpha, position, vertices, count, entries or None

    def _ledger(self, entries=None):
        return Ledger(
            self.chunk, self.integrator.techniques, self.integrator.technique_weights, entries
        )

    def _list_pairs(self, light, camera, camera_count):
        vertices, count, lengths = light
        return list_pairs(
            Kept(camera, camera_count, self.capacity["camera"]),
            by_path(Kept(vertices, count, self.capacity["light"]), lengths),
            self.integrator.max_depth,
            self.capacity["pairs"],
        )

    def _connect(self, scene, tables, radiance, camera, light, pairs, seed, spectral, entries):
        """Radiance of camera paths with that of connections added."""
        camera_place, light_place, count = pairs
        index = lanes(self.capacity["pairs"])
        active = index < dr.gather(mi.UInt32, count, 0)
        z = read_vertices(camera, dr.gather(mi.UInt32, camera_place, index, active), active)
        y = read_vertices(light, dr.gather(mi.UInt32, light_place, index, active), active)
        pair = join(self.traits, z, y, spectral["wavelengths"], active)
        seen = active & (dr.max(pair.value) > 0)
        if self.traits.has_media:
            rng = vertex_streams(z["path"], z["number"] * MOST_VERTICES + y["number"], seed)
            wavelengths = spectral["wavelengths"]
            pair.value *= kept_between(scene, self.traits, pair, z, wavelengths, rng, seen)
        else:
            seen = visible(scene, pair, z, seen)
        share = self.weights(spectral).connected(pair, z, y)
        total = mi.Spectrum(radiance)
        dr.scatter_reduce(dr.ReduceOp.Add, total, pair.value * share, z["path"], seen)
        if self.integrator.techniques:
            ledger = self._ledger(dict(entries))
            ledger.connected(z["path"], z["depth"], y["depth"], pair.value, share, seen)
        if self.integrator.splits_light:
            classes = LightClasses(self.chunk, entries, ("joined",))
            number = class_of(mi.UInt32(2), y["mark"])
            classes.add("joined", z["path"], number, pair.value * share, seen)
            entries = classes.entries
        return total, entries

    def _join_sensor(self, scene, sensor, tables, light, seed, spectral):
        """Block of the light that meets the sensor."""
        vertices, count, _ = light
        y, joined = self._joined_with_sensor(sensor, vertices, count, seed, spectral)
        value = joined.value * (self.pixel_paths / self.light_path_count)
        share, matrix = self.weights(spectral).seen_by_sensor(joined, y), spectral["sensor_matrix"]
        spectra, techniques = self._with_classes(value * share, y), []
        if self.integrator.techniques:
            value = value * share if self.integrator.technique_weights else value
            techniques = sensor_images(self.integrator.techniques, y["depth"], value, matrix)
        return splat_light(sensor.film(), joined.film, spectra, matrix, joined.active, techniques)

    def _splat(self, radiance, alpha, position, first, spectral, entries):
        """Block of the camera paths, and that of their techniques (or None)."""
        active, film, techniques = self.in_chunk(first), self.sensor.film(), None
        classes = ()
        if self.integrator.splits_light:
            classes = LightClasses(self.chunk, entries).radiance()
        if self.integrator.techniques:
            channels = camera_images(self._ledger(entries), spectral["matrix"])
            techniques = splat_channels(film, position, channels, active)
        return splat_samples(
            film, position, radiance, alpha, spectral["matrix"], active, classes=classes
        ), techniques

    # ------------------------------------------------------------------ iterations

    def _chunk(self, iteration, spectral, chunk, first):
        """Blocks of one part of the paths: of camera paths, of their techniques, of light that met
        the sensor (None where there is none)."""
        light = lit = None
        while self.bidirectional:
            light = self._light_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(iteration, LIGHT, 1),
                dr.opaque(mi.UInt32, chunk * self.light_chunk),
                spectral,
            )
            if not self._grown("light", light[1]):
                break
        while True:
            radiance, alpha, position, camera, count, entries = self._camera_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(iteration, CAMERA, self.camera_paths),
                first,
                dr.opaque(mi.UInt32, 0),
                spectral,
            )
            if not self.bidirectional or not self._grown("camera", count):
                break
        if self.bidirectional:
            while True:
                pairs = self._pair_pass(light, camera, count)
                if not self._grown("pairs", pairs[-1]):
                    break
            radiance, entries = self._connection_pass(
                self.scene,
                self._tables,
                radiance,
                camera,
                light[0],
                pairs,
                self._seed(iteration, SHADOWS, chunk),
                spectral,
                entries,
            )
            radiance, entries = self._merge(radiance, camera, count, light, spectral, entries)
            dr.eval(radiance, entries)  # else its sums may still wait when the film's are made
            if self.lens:
                lit = self._sensor_pass(
                    self.scene,
                    self.sensor,
                    self._tables,
                    light,
                    self._seed(iteration, APERTURE, chunk),
                    spectral,
                )
        return *self._splat(radiance, alpha, position, first, spectral, entries), lit

    def _merge(self, radiance, camera, count, light, spectral, entries):
        """Radiance of camera paths, and the entries of its classes, with that of merges added (none
        here)."""
        return radiance, entries

    def _run(self, iteration):
        spectral = self._spectral(iteration)
        block, techniques, light = self.sum_of_chunks(partial(self._chunk, iteration, spectral))
        if light is not None:
            light = as_camera_weights(light, block, self.expected_weight)
            colours = 3 + self.accumulator.class_channels
            block = with_colour(block, light[:, :, :colours])
            techniques = None if techniques is None else techniques + light[:, :, colours:]
        if techniques is not None:
            techniques = (
                with_rest(techniques, block) if self.integrator.technique_weights else techniques
            )
        self.accumulator.add(block, iteration, techniques)


MOST_VERTICES = 1 << 12
"""Tells apart the random numbers of a camera vertex's connections with so many light vertices."""
