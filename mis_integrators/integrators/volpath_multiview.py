"""Plugin `volpath_multiview`: volumetric path tracing of several views that use each other's
paths."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import colour_channels, colour_matrix, direct_channels
from ..core.random import mix
from ..core.recording import recorder
from ..core.render_lock import render_lock, under_render_lock
from ..core.traits import UnsupportedScene, check_film, check_variant
from ..lights.environment_guide import EnvironmentGuide, infinite_emitters
from ..lights.lights import Lights
from ..volume.films import OWN, SHARED, ViewAccumulator, own_values, splat, write_film
from ..volume.lines import common_nulls, connect, follow_nulls, sight
from ..volume.pivots import NOWHERE, ON_SURFACE, of_paths, pivot_surface, trace_first_segments
from ..volume.pivots import OWN as OWN_BRANCH
from ..volume.shifts import SHIFTS
from ..volume.suffixes import continue_paths, scattered_to
from ..volume.traits import VolumeTraits, check_volume_scene
from ..volume.views import Views
from ..weights.multiview import HEURISTICS, gain, summand
from .common import IterativeIntegrator, IterativeSession, scalar_seed

PAIRS = 1 << 21
"""Connections of paths to views that are made at once at most; more are made in parts (bounds
memory)."""
FEWEST = 1 << 12
"""Camera paths that a part has at least."""
LAUNCH = 1 << 16
"""Camera paths that are worth a launch: of fewer, the longest keep the others waiting."""
PATHS, WAVELENGTH, EVEN, ODD = range(4)
"""Purposes of an iteration's random seeds."""


class VolpathMultiview(IterativeIntegrator):
    r"""
    .. _integrator-volpath_multiview:

    Volumetric path tracing of several views (:monosp:`volpath_multiview`)
    ----------------------------------------------------------------------

    .. pluginparameters::

     * - shift
       - |string|
       - How null interactions are moved from one view's line of sight to another's:
         ``majorant_optical_depth``, ``raw_depth`` or ``primary_sample`` stretch the depth, the same
         names with ``_copy`` keep it. (Default: ``majorant_optical_depth``)
     * - weights
       - |string|
       - ``mis`` (balance heuristic), ``power`` (power heuristic, exponent ``beta``), ``mwis``
         (``mis`` divided by the sum of the weights that arrived at each pixel: consistent, biased
         at few samples), or ``none`` (the same weight for every view that can make the path:
         unbiased and noisy, for comparison). (Default: ``mis``)
     * - beta
       - |float|
       - Exponent of ``weights`` = ``power``, from 1 to 8; with other weights anything but the
         default is an error. (Default: 2)
     * - add_nulls
       - |bool|
       - Add null interactions to first segments until all views that see a pivot expect equally
         many: without them, views hardly agree where majorants are far above the density. Of no
         effect on copying shifts. (Default: yes, i.e. |true|)
     * - camera_paths
       - |int|
       - Camera paths per pixel and iteration; 0 stands for as many as keep the processor busy, in
         eight iterations at least. (Default: 0)
     * - variance
       - |bool|
       - Adds the channels ``var.R``, ``var.G``, ``var.B`` (mono: ``var.Y``): the estimated variance
         of the pixel mean over the iterations, of which there must be two at least. (Default: no,
         i.e. |false|)
     * - aovs
       - |string|
       - As of :monosp:`bdpm`, but for the types that split the light; of one view only. (Default:
         ``none``)
     * - max_depth
       - |int|
       - Longest path in segments (-1: unlimited). A value of 1 shows only directly visible
         emitters, 2 adds single scattering, and so on; passing straight through a surface or medium
         counts for nothing, as in ``volpath``. (Default: -1)
     * - rr_depth
       - |int|
       - Depth from which Russian roulette may end a path. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no, i.e. |false|)
     * - sampler
       - |string|
       - Random numbers of sub-paths: ``sobol``, scrambled Sobol' sequences, two a pixel, one over
         all even and one over all odd iterations; or ``independent``. The scene's ``<sampler>`` is
         not used but for its sample count. (Default: ``sobol``)

    The views are the children of a ``batch`` sensor, side by side on its film, or one sensor, or
    any list of sensors through ``mis_integrators.render_views``. Each view's camera paths are
    traced to the first vertex that scatters, in a medium or on a surface. Every other view that
    sees it joins there: the null interactions of the first segment are shifted onto its own line of
    sight, and all views share the rest of the path.

    With the weights ``mis`` the result is unbiased. Perspective, thin lens and orthographic sensors
    are supported; polarised variants, gradients and the film ``specfilm`` are refused by name.

    .. tabs::
        .. code-tab:: xml

            <integrator type="volpath_multiview">
                <string name="shift" value="majorant_optical_depth"/>
                <integer name="max_depth" value="64"/>
            </integrator>

        .. code-tab:: python

            'type': 'volpath_multiview',
            'shift': 'majorant_optical_depth',
            'max_depth': 64
    """

    CAMERA_PATHS = 0, 0, "at least 0 (0: automatic)"

    def read_parameters(self, parameters):
        self.shift = parameters.choice("shift", "majorant_optical_depth", tuple(SHIFTS))
        self.weights = parameters.choice("weights", "mis", HEURISTICS)
        self.beta = parameters.number("beta", 2.0, lambda x: 1 <= x <= 8, "from 1 to 8")
        if self.weights != "power" and self.beta != 2:
            parameters.refuse("beta", 'only weights = "power" have an exponent')
        self.add_nulls = parameters.boolean("add_nulls", True)

    def settings(self):
        return {
            **super().settings(),
            "shift": self.shift,
            "weights": self.weights,
            "beta": self.beta,
            "add_nulls": self.add_nulls,
        }

    @under_render_lock
    def session(self, scene, sensor=0, seed=0, spp=0):
        sensor = self._sensor(scene, sensor)
        return self._session(scene, [sensor], seed, spp)

    @under_render_lock
    def views_session(self, scene, seed=0, spp=0):
        """Prepares a rendering of all views of a scene; see `render_views`."""
        check_variant(scene, self.plugin)
        if not scene.sensors():
            raise UnsupportedScene(f"{self.plugin}: the scene has no sensor")
        return self._session(scene, scene.sensors(), seed, spp)

    def _session(self, scene, sensors, seed, spp):
        check_volume_scene(scene, sensors, self.plugin)
        for sensor in sensors:
            check_film(sensor, self.plugin)
            Views.check_sensor(sensor, self.plugin)
        Views.check_layers(sensors, self.layers, self.plugin)
        self.check_path_number(sensors)
        camera_paths = self.camera_paths or self._automatic(sensors, spp)
        iterations = self.planned_iterations(spp, camera_paths)
        return MultiViewSession(self, scene, sensors, scalar_seed(seed), iterations, camera_paths)

    @staticmethod
    def _automatic(sensors, spp):
        """Camera paths a pixel and iteration that make a launch of about `LAUNCH` paths; a divisor
        of `spp`, and at most an eighth of it."""
        pixels = sum(int(w) * int(h) for w, h in (sensor.film().crop_size() for sensor in sensors))
        most = max(1, min(LAUNCH // max(pixels, 1), spp // 8 if spp else 16))
        return max(n for n in range(1, most + 1) if spp % n == 0)


class MultiViewSession(IterativeSession):
    """Iterations of `volpath_multiview`: first segments, connections, suffixes, splats.

    `sensors` are sensors of the scene, alone or batches; films and images of the session itself are
    the first one's.
    """

    def __init__(self, integrator, scene, sensors, seed, iterations, camera_paths):
        super().__init__(integrator, scene, sensors[0], seed, iterations)
        self.camera_paths = camera_paths
        self.views = Views(sensors, camera_paths, integrator.plugin)
        self.traits = VolumeTraits(scene, sensors)
        guide = EnvironmentGuide(scene, None) if infinite_emitters(scene) else None
        self.lights = Lights(scene, integrator.plugin, guide, by_power=False)
        self.restart(seed)
        self.slots = 1
        self.paths = min(self.views.paths, max(PAIRS // self.views.count, FEWEST))
        self.recorded = recorder()
        self._freeze()

    def restart(self, seed):
        """Forgets what has been rendered, and goes on with another seed."""
        self.seed = seed
        self.accumulator = ViewAccumulator(
            self.views, self.integrator.variance, self.integrator.weights == "mwis"
        )
        self._counts = {name: mi.UInt64(0) for name in ("tried", "reached", "lost")}

    @property
    def settings(self):
        return {**super().settings, "views": self.views.count}

    @property
    def remarks(self):
        return self.integrator.about_samplers(self.views.groups)

    def _freeze(self):
        """Records the passes anew."""
        self._tables = [
            self.views.table,
            self.traits.shares,
            *([] if self.lights.dark else self.lights.tables()),
        ]
        (
            self._first_pass,
            self._sight_pass,
            self._agreement_pass,
            self._connection_pass,
            self._suffix_pass,
            self._splat_pass,
            self._trial_pass,
        ) = map(
            self.recorded,
            (
                self._trace_first,
                self._look,
                self._agree,
                self._connect,
                self._continue,
                self._splat,
                self._try,
            ),
        )

    # ------------------------------------------------------------------ passes

    def _trace_first(self, scene, tables, number, seed, sequence, spectral):
        integrator = self.integrator
        active = (number < self.views.paths) & (integrator.max_depth != 0)
        pivot, radiance = trace_first_segments(
            scene,
            self.views,
            self.traits,
            number,
            seed,
            sequence.of_paths(number),
            spectral["wavelengths"],
            spectral["weight"],
            integrator.hide_emitters,
            active,
        )
        line, found = {}, mi.UInt32(0)
        if self.views.count > 1:
            shared = (
                active
                & pivot["in_window"]
                & (pivot["kind"] != NOWHERE)
                & (pivot["branch"] != OWN_BRANCH)
            )
            line, found = sight(
                scene,
                self.views,
                self.traits,
                pivot,
                pivot["view"],
                self.slots,
                integrator.hide_emitters,
                shared,
            )
            line["log_density"] = mi.Float(line["log_survival"])
        return pivot, radiance, line, found

    def _pairs(self):
        """View and path of each connection."""
        q = dr.arange(mi.UInt32, self.paths * self.views.count)
        return q // self.paths, q % self.paths

    def _look(self, scene, tables, pivots, lines, numbers):
        """Every other view's line of sight to each pivot."""
        view, path = self._pairs()
        pivot = of_paths(pivots, path)
        active = (dr.gather(mi.UInt32, numbers, path) < self.views.paths) & (
            dr.gather(mi.Float, lines["density"], path) > 0
        )
        active &= view != pivot["view"]
        return sight(
            scene,
            self.views,
            self.traits,
            pivot,
            view,
            self.slots,
            self.integrator.hide_emitters,
            active,
        )

    def _agree(self, scene, tables, pivots, lines, sights, numbers, seed):
        """What views are made to agree about, and the paths' own densities and tints under it."""
        active = (numbers < self.views.paths) & (lines["density"] > 0)
        common = dr.zeros(mi.Float, self.paths)
        if self.integrator.add_nulls and not self.integrator.shift.endswith("copy"):
            common = common_nulls(lines, sights, pivots["view"], self.views.count, active)
        log_density, tint, _, _ = follow_nulls(
            None, pivots, lines, lines, common, numbers, seed, self.slots, active
        )
        return common, log_density, dr.select(active, tint, pivots["tint"])

    def _connect(self, scene, tables, pivots, lines, sights, common, numbers, seed):
        _, path = self._pairs()
        number = dr.gather(mi.UInt32, numbers, path)
        return connect(
            self.traits,
            SHIFTS[self.integrator.shift],
            of_paths(pivots, path),
            of_paths(lines, path),
            sights,
            dr.gather(mi.Float, common, path),
            number,
            seed,
            self.slots,
            number < self.views.paths,
        )

    def _continue(self, scene, tables, pivot, connections, number, seed, sequence):
        integrator = self.integrator
        return continue_paths(
            scene,
            self.lights,
            self.traits,
            partial(summand, integrator.weights, exponent=integrator.beta),
            pivot,
            connections,
            number,
            seed,
            sequence.of_paths(number),
            self.views.count,
            integrator.max_depth,
            integrator.rr_depth,
            number < self.views.paths,
        )

    def _splat(
        self, scene, tables, pivots, radiance, connections, suffixes, value, numbers, spectral
    ):
        views, matrix = self.views, spectral["matrix"]
        active = numbers < views.paths
        own = own_values(
            radiance,
            pivots["visible"],
            value,
            gain(mi.Float(1), suffixes["total"]),
            suffixes["alone"],
            matrix,
        )
        image = splat(views, [(pivots["view"], pivots["position"], own)], SHARED + OWN, [active])
        if views.count == 1:
            return image[:, :, :SHARED], image[:, :, SHARED:]
        view, path = self._pairs()
        pivot, suffix = of_paths(pivots, path), of_paths(suffixes, path)
        # The path's own view was served above.
        reached = (connections["ratio"] > 0) & ~suffix["alone"]
        surface = pivot_surface(pivot, reached & (pivot["kind"] == ON_SURFACE))
        brought = (
            scattered_to(suffix, pivot, surface, connections["d"], reached) * connections["tint"]
        )
        weight = gain(connections["ratio"], suffix["total"])
        colour = colour_channels(brought * weight, matrix)
        shared = splat(
            views, [(view, connections["position"], [*colour, weight])], SHARED, [reached]
        )
        return image[:, :, :SHARED] + shared, image[:, :, SHARED:]

    # ------------------------------------------------------------------ iterations

    def _spectral(self, iteration):
        """The wavelengths that all paths of an iteration share, and their conversion to colour."""
        sample = dr.opaque(mi.Float, mix(self.seed, iteration, WAVELENGTH) / 2**32)
        wavelengths, weight = self.views.sensors[0].sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), sample
        )
        spectral = {
            "wavelengths": wavelengths,
            "weight": weight,
            "matrix": colour_matrix(wavelengths),
        }
        dr.make_opaque(spectral)
        return spectral

    def _run(self, iteration):
        spectral = self._spectral(iteration)
        seed, sequence = self._numbers(iteration)
        layers = [
            self._part(first, seed, sequence, spectral)
            for first in range(0, self.views.paths, self.paths)
        ]
        self.accumulator.add(*(sum(layer[1:], layer[0]) for layer in zip(*layers)), iteration)

    def radiance(self, iteration, numbers, variation=0):
        """What the camera paths of these `numbers` bring in an iteration, where there is one view.
        The variations of a pixel's first path are parts of one sequence."""
        spectral = self._spectral(iteration + variation)
        seed, sequence = self._numbers(iteration)
        if variation:
            seed = self._seed(iteration + variation, PATHS)
            sequence.first += variation
        return self._trial_pass(self.scene, self._tables, numbers, seed, sequence, spectral)

    def _try(self, scene, tables, numbers, seed, sequence, spectral):
        """As `radiance`. The passes of a part of an iteration are recorded apart: a recording does
        not know how wide arrays are that hang on no `numbers`."""
        pivots, radiance, _, _ = self._trace_first(scene, tables, numbers, seed, sequence, spectral)
        dr.eval(pivots, radiance)
        _, value = self._continue(scene, tables, pivots, None, numbers, seed, sequence)
        return radiance + value

    def _numbers(self, iteration):
        """The seed and the sequence of an iteration. Even and odd ones are independent: what each
        learns serves the others (`films`)."""
        half, parity = divmod(iteration, 2)
        sequence = self._sequence(half, (EVEN, ODD)[parity], self.camera_paths)
        return self._seed(iteration, PATHS), sequence

    def estimate(self):
        """As of other sessions, with all pixels of all views in one row: (1, pixels, 3)."""
        return self.accumulator.estimate()

    def _part(self, first, seed, sequence, spectral):
        """One part of an iteration: its layers."""
        numbers = dr.arange(mi.UInt32, self.paths) + dr.opaque(mi.UInt32, first)
        dr.eval(numbers)
        while True:
            pivots, radiance, lines, found = self._first_pass(
                self.scene, self._tables, numbers, seed, sequence, spectral
            )
            connections, more = None, mi.UInt32(0)
            if self.views.count > 1:
                dr.eval(pivots, radiance, lines, found)
                sights, more = self._sight_pass(self.scene, self._tables, pivots, lines, numbers)
                dr.eval(sights, more)
                common = dr.zeros(mi.Float, self.paths)
                if self.traits.has_null_media:
                    agreed = self._agreement_pass(
                        self.scene, self._tables, pivots, lines, sights, numbers, seed
                    )
                    common, lines["log_density"], pivots["tint"] = agreed
                dr.eval(common, lines, pivots)
                connections = self._connection_pass(
                    self.scene, self._tables, pivots, lines, sights, common, numbers, seed
                )
                dr.eval(connections)
            suffixes, value = self._suffix_pass(
                self.scene, self._tables, pivots, connections, numbers, seed, sequence
            )
            dr.eval(suffixes, value)
            layers = self._splat_pass(
                self.scene,
                self._tables,
                pivots,
                radiance,
                connections,
                suffixes,
                value,
                numbers,
                spectral,
            )
            dr.eval(layers)
            needed = int(dr.maximum(dr.max(found), dr.max(more))[0])
            if needed <= self.slots:
                break
            self.slots = needed
            self._freeze()
        if connections is not None:
            for name, kind in (
                ("reached", connections["ratio"] > 0),
                ("lost", connections["ratio"] < 0),
            ):
                self._counts[name] += mi.UInt64(dr.sum(dr.select(kind, mi.UInt32(1), mi.UInt32(0))))
            self._counts["tried"] += self.paths * (self.views.count - 1)
            dr.schedule(self._counts)
        return layers

    @property
    def statistics(self):
        """Connections `tried` so far, how many `reached` their view, and how many a shift has
        `lost`."""
        return {name: int(count[0]) for name, count in self._counts.items()}

    # ------------------------------------------------------------------ results

    @property
    def pixels(self):
        """Pixels of all views together."""
        return sum(width * height for width, height in self.views.sizes)

    def view_images(self):
        """The images so far, one a view: float32, (height, width, channels)."""
        images = [np.array(tensor, dtype=np.float32) for tensor in self.view_tensors()]
        return [image if image.ndim == 3 else image[:, :, None] for image in images]

    @under_render_lock
    def view_tensors(self):
        """The images so far, one tensor a view, as films develop them."""
        images, first = [], 0
        pictures = self.accumulator.pictures(self.integrator.variance)
        for sensor, members in zip(self.views.groups, self.views.members):
            image = self._fill(sensor.film(), pictures[first : first + members]).develop()
            width = self.views.sizes[first][0]
            images += [image[:, i * width : (i + 1) * width] for i in range(members)]
            first += members
        dr.eval(images)
        return images

    def _fill(self, film, pictures):
        """Writes pictures side by side into a film; where there is one view, its layers, too."""
        picture = pictures[0] if len(pictures) == 1 else dr.concat(pictures, axis=1)
        border, (height, width) = film.rfilter().border_size(), picture.shape[:2]
        if self.integrator.denoised:  # as `bdpm_auto` may ask: no light is known to be direct
            nothing = dr.zeros(type(picture), (height, width, len(direct_channels())))
            picture = dr.concat([picture, nothing], axis=2)
        for layer in self.integrator.layers:
            inside = slice(border, border + height), slice(border, border + width)
            picture = dr.concat([picture, self._layers[layer.name][inside]], axis=2)
        write_film(self._emptied(film), picture)
        return film

    def fill_film(self):
        """Hands what has been rendered so far to the sensor's film, side by side for a `batch`."""
        self._fill(
            self.sensor.film(),
            self.accumulator.pictures(self.integrator.variance)[: self.views.members[0]],
        )


def render_views(scene, integrator=None, spp=0, seed=0):
    """Renders all views of `scene` together: the children of its `batch` sensors, and its other
    sensors, in their order.

    `integrator` is a `volpath_multiview` (default: the scene's own if it is one, else one with its
    default parameters), `spp` the samples per pixel (0: the most that a sensor's sampler asks for).
    Returns a list of tensors (height, width, channels), one a view, as each view's film develops
    it; films may differ in size. Raises `UnsupportedScene` for what cannot be rendered, and
    `ValueError` for a negative `spp`.
    """
    if integrator is None:
        own = scene.integrator()
        integrator = (
            own if hasattr(own, "views_session") else mi.load_dict({"type": "volpath_multiview"})
        )
    if not hasattr(integrator, "views_session"):
        raise UnsupportedScene(
            "render_views: the integrator must be a volpath_multiview, not "
            f"{integrator.class_name()}"
        )
    with dr.suspend_grad():
        spp = integrator.samples_wanted(spp, scene.sensors())
        session = integrator.views_session(scene, seed, spp)
        integrator.say_rounded(session, spp)
        integrator.say_sampler(session.views.groups)
        for _ in range(session.iterations_planned):
            session.iterate()
        with render_lock():
            integrator.say_unfinite(session)
            images = session.view_tensors()
            del session
            return images
