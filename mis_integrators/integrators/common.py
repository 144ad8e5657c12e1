"""What the iterating integrators share: parameters, the session that runs iterations, and the film
at the end."""

from __future__ import annotations

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import Accumulator, direct_channels, shared_wavelengths, variance_channels
from ..core.random import mix, reversed_bits
from ..core.recording import lanes, settle
from ..core.render_lock import render_lock, under_render_lock
from ..core.sequences import SampleSequence
from ..core.traits import (
    SceneTraits,
    UnsupportedScene,
    check_bsdfs,
    check_film,
    check_media,
    check_scene,
    check_variant,
    has_media,
    unfinite_data,
)
from ..core.untrusted import Fields
from ..lights.lights import Lights
from ..paths.camera import film_sample_count
from ..paths.layers import CHANNELS, channel_names, render_layers, written
from ..paths.light_classes import CLASSES
from ..paths.setting import CameraPass, LightPass, Limits, World
from ..pilot.run import PILOT_INDEX
from .parameters import Parameters
from .purposes import SURFACES, WAVELENGTH

SAMPLERS = "sobol", "independent"
"""Values of the parameter `sampler`; the first is the default."""

RENDER = 1 << 40
"""In the place of an iteration's number: seeds that all iterations of a render share."""
MOST_PATHS = 2**32 - 1
"""Camera paths of an iteration at most: their numbers have 32 bits."""
MOST_LIGHT_PATHS = 2**28
"""Light sub-paths of an iteration at most: the words of their photons are numbered with 32 bits."""


class IterativeIntegrator(mi.AdjointIntegrator):
    """Base of integrators that render by iterations and average them.

    A subclass reads its own parameters in `read_parameters` and makes the object that runs
    iterations in `new_session`.
    """

    CAMERA_PATHS = 1, 1, "at least 1"
    """Default, least value and range in words of the parameter `camera_paths`; 0 stands for as many
    as the session finds worth while."""
    LAYERS = tuple(CHANNELS)
    """Types of layers that the parameter `aovs` may ask for."""
    denoised = False
    """Whether the image will be denoised: a parameter of some subclasses."""

    def __init__(self, props):
        parameters = Parameters(props)
        self.plugin = parameters.plugin
        self.max_depth = parameters.integer("max_depth", -1, -1, "-1 (unlimited) or at least 0")
        self.rr_depth = parameters.integer("rr_depth", 5, 1, "at least 1")
        self.hide_emitters = parameters.boolean("hide_emitters", False)
        self.camera_paths = parameters.integer("camera_paths", *self.CAMERA_PATHS)
        self.variance = parameters.boolean("variance", False)
        self.sampler = parameters.choice("sampler", SAMPLERS[0], SAMPLERS)
        self.warned_of_sampler = False
        self.layers = self.read_layers(parameters)
        self.read_parameters(parameters)
        parameters.check_channels(self.layers, self.estimated_channels())
        parameters.finish()
        super().__init__(props)

    def read_parameters(self, parameters):
        """Reads the subclass's own parameters (there need not be any)."""

    def read_layers(self, parameters):
        """The layers (`paths.layers.Layer`) that the parameter `aovs` asks for."""
        return parameters.layers("aovs", self.LAYERS)

    @property
    def splits_light(self):
        """Whether layers ask for classes of light (`paths.light_classes`)."""
        return any(layer.type in CLASSES for layer in self.layers)

    @property
    def kept_classes(self):
        """How many of the classes iterations are summed for: direct light, the first, is denoised
        apart."""
        return len(CLASSES) if self.splits_light else int(self.denoised)

    def new_session(self, scene, sensor, seed, iterations):
        """The object that runs iterations; see `mis_integrators.core.session.Session`. Every
        subclass has its own."""
        raise TypeError(f"{type(self).__name__} does not define new_session")

    def check(self, scene, sensor):
        """Raises `UnsupportedScene` for a scene that this integrator cannot render."""
        check_scene(scene, sensor, self.plugin)
        check_bsdfs(scene, self.plugin)
        if has_media(scene, sensor):
            check_media(scene, [sensor], self.plugin)
            for parameter, instead in self.refused_in_media():
                raise UnsupportedScene(
                    f"{self.plugin}: parameter {parameter} is not supported in scenes with "
                    f"participating media; use {instead}"
                )

    def refused_in_media(self):
        """Parameters whose values are not supported there, as a message has them, each with what to
        use instead."""
        return []

    def estimated_channels(self):
        """Names of the channels beside the image's that iterations are summed for."""
        variance = variance_channels() if self.variance else []
        return [*variance, *direct_channels()] if self.denoised else variance

    def aov_names(self):
        return [*self.estimated_channels(), *channel_names(self.layers)]

    def to_string(self):
        lines = ",\n".join(f"  {name} = {value}" for name, value in self.settings().items())
        return f"{type(self).__name__}[\n{lines}\n]"

    @property
    def low_discrepancy(self):
        """Whether iterations share sequences."""
        return self.sampler != "independent"

    @property
    def initial_camera_paths(self):
        """The parameter `camera_paths`; where it is automatic, one: until more turn out to be worth
        while."""
        return self.camera_paths or 1

    def settings(self):
        """Parameter names and values."""
        return {
            "max_depth": self.max_depth,
            "rr_depth": self.rr_depth,
            "hide_emitters": self.hide_emitters,
            "camera_paths": self.camera_paths,
            "variance": self.variance,
            "aovs": written(self.layers),
            "sampler": self.sampler,
        }

    @under_render_lock
    def session(self, scene, sensor=0, seed=0, spp=0):
        """Prepares a rendering of `scene` with `spp` camera paths a pixel, or without a planned end
        if `spp` is 0."""
        sensor = self._sensor(scene, sensor)
        check_film(sensor, self.plugin)
        self.check(scene, sensor)
        self.check_path_number([sensor])
        return self.new_session(
            scene,
            sensor,
            scalar_seed(seed),
            self.planned_iterations(spp, self.initial_camera_paths),
        )

    def check_path_number(self, sensors):
        """Raises `ValueError` where an iteration would have more camera paths than can be
        numbered."""
        pixels = sum(film_sample_count(sensor) for sensor in sensors)
        if self.initial_camera_paths * pixels > MOST_PATHS:
            raise ValueError(
                f'{self.plugin}: parameter "camera_paths" = {self.camera_paths} makes more than '
                f"{MOST_PATHS} paths an iteration on "
                f"{pixels} pixels; ask for more samples per pixel (spp), and so more iterations, "
                "instead, or crop the film"
            )

    def planned_iterations(self, spp, camera_paths):
        """Iterations of `camera_paths` that make `spp` camera paths a pixel; None (no planned end)
        if `spp` is 0."""
        if not spp:
            return None
        iterations = -(-spp // camera_paths)
        if self.variance and iterations < 2:
            raise ValueError(
                f'{self.plugin}: parameter "variance" needs at least two iterations; ask for spp > '
                f"{camera_paths}"
            )
        return iterations

    def samples_wanted(self, spp, sensors):
        """`spp`, or where that is 0 the most samples per pixel that the samplers of these sensors
        ask for. Raises `ValueError` for none, or fewer."""
        wanted = spp or max((sensor.sampler().sample_count() for sensor in sensors), default=1)
        if wanted < 1:
            raise ValueError(
                f"{self.plugin}: {wanted} samples per pixel are not possible; give spp, or the "
                'sampler a "sample_count", of at least 1'
            )
        return wanted

    def say_rounded(self, session, spp):
        """Warns where a session of `spp` samples per pixel makes more of them."""
        iterations, camera_paths = session.iterations_planned, session.camera_paths
        if iterations * camera_paths != spp:
            mi.Log(
                mi.LogLevel.Warn,
                f"{self.plugin}: {spp} samples per pixel rounded up to {iterations} iterations of "
                f"camera_paths = {camera_paths}",
            )

    def about_samplers(self, sensors):
        """Lines that say which kinds of samplers of these sensors are not used. (`independent`,
        Mitsuba's default, asks for nothing.)"""
        kinds = {sensor.sampler().class_name() for sensor in sensors} - {"IndependentSampler"}
        return [
            f"{self.plugin}: of the sensor's {kind}, nothing but the sample count is used; random "
            f'numbers are those of the parameter "sampler" = {self.sampler}'
            for kind in sorted(kinds)
        ]

    def say_sampler(self, sensors):
        """Warns, once, where samplers of these sensors are not used."""
        lines = self.about_samplers(sensors)
        if lines and not self.warned_of_sampler:
            self.warned_of_sampler = True
            mi.Log(mi.LogLevel.Warn, "; ".join(lines))

    def say_unfinite(self, session):
        """Warns where values of a session that are not finite were left out, and names the data of
        the scene that may be to blame."""
        if pixels := session.unfinite_pixels():
            causes = "; ".join(unfinite_data(session.scene))
            mi.Log(
                mi.LogLevel.Warn,
                f"{self.plugin}: {pixels} pixels had values that are not finite, which are left out"
                + (f": {causes}" if causes else ""),
            )

    def _sensor(self, scene, sensor):
        check_variant(scene, self.plugin)
        if isinstance(sensor, int):
            sensors = scene.sensors()
            if not 0 <= sensor < len(sensors):
                raise UnsupportedScene(
                    f"{self.plugin}: the scene has {len(sensors)} sensors; sensor {sensor} does "
                    "not exist"
                )
            return sensors[sensor]
        return sensor

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        with dr.suspend_grad():
            sensor = self._sensor(scene, sensor)
            spp = self.samples_wanted(spp, [sensor])
            session = self.session(scene, sensor, seed, spp)
            self.say_rounded(session, spp)
            self.say_sampler([sensor])
            for _ in range(session.iterations_planned):
                session.iterate()
            with render_lock():
                self.say_unfinite(session)
                session.fill_film()
                del session
                if not develop:
                    return mi.TensorXf()
                image = sensor.film().develop()
                if evaluate:
                    dr.eval(image)
                return image

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        raise RuntimeError(f"{self.plugin}: gradients are not supported; use Mitsuba's prb")

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        raise RuntimeError(f"{self.plugin}: gradients are not supported; use Mitsuba's prb")


class IterativeSession:
    """Runs iterations and accumulates them; a subclass implements `_iteration(index) -> block
    tensor`. (Before its last channel the block has three for each of `light_classes.CLASSES` that
    is kept.)

    `seed` is an integer; iteration `i` draws all its random numbers from (seed, i), so any subset
    of the iterations can be rendered anywhere. They are independent, or parts of sequences
    (`sampler`).
    """

    def __init__(self, integrator, scene, sensor, seed, iterations):
        self.integrator, self.scene, self.sensor, self.seed = integrator, scene, sensor, seed
        self.limits = Limits(integrator.max_depth, integrator.rr_depth, integrator.hide_emitters)
        self.iterations_planned = iterations
        self.camera_paths = integrator.initial_camera_paths
        self.accumulator = Accumulator(
            sensor.film(),
            integrator.variance,
            stratified=integrator.low_discrepancy,
            class_channels=3 * integrator.kept_classes,
            denoised=integrator.denoised,
        )
        self.variant = mi.variant()
        settle(scene)

    def _find_world(self, guided=True):
        """What the scene is made of, and its lights (`guided`: as of `Lights.seen_by`)."""
        plugin = self.integrator.plugin
        self.traits = SceneTraits(self.scene, self.sensor)
        self.lights = Lights.seen_by(self.scene, self.sensor, plugin, guided)
        if self.traits.has_media:
            self.lights.find_media(self.sensor, plugin)
        self.world = World(self.scene, self.lights, self.traits)

    @property
    def sums(self):
        """What has been rendered so far (`mis_integrators.core.sums.Sums`)."""
        return self.accumulator.sums

    @property
    def iterations(self):
        """Iterations done."""
        return self.accumulator.iterations

    @property
    def fewest_iterations(self):
        """How many iterations an image needs."""
        return 2 if self.integrator.variance else 1

    def keep_variance(self):
        """From the first iteration on, keeps what `estimate` needs."""
        self.accumulator.with_variance = True

    @under_render_lock
    def estimate(self):
        """Mean colour so far and its estimated variance: float64, (height, width, 3) each. Needs
        two iterations at least, and `keep_variance`."""
        return self.accumulator.estimate()

    @under_render_lock
    def unfinite_pixels(self):
        """How many pixels had values that are not finite in some iteration; those values are left
        out."""
        return self.accumulator.unfinite_pixels()

    def sum_shapes(self):
        """The shapes that the sums will have after an iteration, by name."""
        return self.accumulator.shapes()

    def start(self):
        """Finds out what must be known before the first iteration, unless it is known: pilots,
        caches. `iterate` calls it."""

    @property
    def learned(self):
        """What `start` has found out and the seed alone would not tell again, in JSON's types: the
        radii that a pilot has chosen."""
        return {}

    def recall(self, learned):
        """Takes over what another session of the same render has `learned`; before the first
        iteration. Raises `Malformed` if it cannot be that."""
        Fields(learned, "learned").finish()

    def most_camera_paths(self):
        """Camera paths a pixel that an iteration can have."""
        return max(1, MOST_PATHS // film_sample_count(self.sensor))

    def resize(self, camera_paths):
        """Makes iterations of another number of camera paths a pixel; about as many samples as
        before are planned."""
        if self.iterations_planned:
            self.iterations_planned = math.ceil(
                self.iterations_planned * self.camera_paths / camera_paths
            )
        self.camera_paths = camera_paths

    @property
    def remarks(self):
        """What the user should know, line by line."""
        return self.integrator.about_samplers([self.sensor])

    @property
    def left_out(self):
        """What is not traced, stored or gathered because the scene has no use for it: names."""
        return []

    @property
    def settings(self):
        """Names and values that reproduce the image, together with the scene; and what was
        `left_out`, if anything was."""
        left_out = ", ".join(self.left_out)
        return {
            "integrator": self.integrator.plugin,
            **self.integrator.settings(),
            "camera_paths": self.camera_paths,
            "seed": self.seed,
            **({"left_out": left_out} if left_out else {}),
        }

    @under_render_lock
    def iterate(self, iteration=None):
        """Runs one iteration to its end: that of the given number, or the first that is missing."""
        if mi.variant() != self.variant:
            raise RuntimeError(
                f"{self.integrator.plugin}: this render was begun under the variant "
                f"{self.variant}, but the active one is now "
                f'{mi.variant()}; call mi.set_variant("{self.variant}") before it goes on'
            )
        with dr.suspend_grad():
            self.start()
            with self.sums.all_or_nothing():
                self._run(self.sums.done.first_missing if iteration is None else iteration)
                dr.eval(self.sums.tensors)
                dr.sync_thread()

    def split_paths(self, largest):
        """Splits the `path_count` camera paths of an iteration into `chunks` parts of `chunk`
        paths, all those of a pixel in the same part and about `largest` at most: that bounds
        memory."""
        self.path_count = film_sample_count(self.sensor) * self.camera_paths
        self.chunks = -(-self.path_count // largest)
        self.chunk = -(-self.path_count // (self.chunks * self.camera_paths)) * self.camera_paths

    @staticmethod
    def describe_light_pass(sensor, sequence, count, spectral, first=0):
        """`count` light sub-paths, from number `first` on, under the wavelengths of an
        iteration."""
        shutter = sensor.shutter_open(), sensor.shutter_open_time()
        return LightPass(sequence, count, spectral["wavelengths"], *shutter, first)

    def part_of_paths(self, first, skip=0):
        """The numbers of a part's camera paths, all those of a pixel together: from `first` on,
        with gaps of `skip` after each pixel's. The last part may have some that are beyond the
        film's."""
        path = lanes(self.chunk)
        return path + first + path // self.camera_paths * skip

    def describe_camera_pass(self, sensor, sequence, path, spectral):
        """The camera paths of these numbers (as of `part_of_paths`)."""
        places = self.pixels_and_indices(path)
        return CameraPass(sensor, self.integrator, sequence, *places, spectral["sample"])

    def pixels_and_indices(self, path):
        """The pixels of the camera paths of these numbers, and which paths of these they are."""
        pixel = path // self.camera_paths
        return pixel, path - pixel * self.camera_paths

    def sum_of_chunks(self, render):
        """What `render(chunk, first)` returns, a tuple of tensors or `None`s, summed over all
        parts; `first`: the number of the part's first path."""
        total = None
        for chunk in range(self.chunks):
            blocks = render(chunk, dr.opaque(mi.UInt32, chunk * self.chunk))
            total = (
                blocks
                if total is None
                else tuple(None if a is None else a + b for a, b in zip(total, blocks))
            )
        return total

    def all_over_the_film(self, chunk=0):
        """Numbers `first` and `skip` (see `part_of_paths`) of a part's camera paths that see all of
        the film: for pilots, or for all parts."""
        paths = self.camera_paths
        return dr.opaque(mi.UInt32, chunk * paths), dr.opaque(mi.UInt32, paths * (self.chunks - 1))

    def in_chunk(self, first, skip=0):
        """Which of the `part_of_paths` there are."""
        return self.part_of_paths(first, skip) < self.path_count

    def _run(self, iteration):
        """Adds an iteration to the sums."""
        self.accumulator.add(self._iteration(iteration), iteration)

    wavelength = WAVELENGTH
    """Purpose of the random seed of an iteration's wavelengths."""

    def _spectral(self, iteration):
        """The wavelengths that all sub-paths of an iteration share, the sample that makes them, and
        their conversion to colour."""
        if self._low_discrepancy(iteration):
            number = reversed_bits(iteration) ^ mix(self.seed, RENDER, self.wavelength)
        else:
            number = mix(self.seed, iteration, self.wavelength)
        return shared_wavelengths(self.sensor, number)

    def _low_discrepancy(self, iteration):
        return self.integrator.low_discrepancy and iteration < PILOT_INDEX

    def _seed(self, iteration, *purpose):
        return dr.opaque(mi.UInt32, mix(self.seed, iteration, *purpose))

    def _pass_seed(self, iteration, purpose, part=0):
        """The seed of a pass: shared by all iterations under low-discrepancy numbers (but for each
        `part` of 2^32 indices), else of this iteration alone."""
        if self._low_discrepancy(iteration):
            return self._seed(RENDER, purpose, part)
        return self._seed(iteration, purpose)

    def _sequence(self, iteration, purpose, group_size):
        """The random numbers of a pass whose groups have `group_size` paths an iteration each: all
        paths of a group, over the iterations, share a low-discrepancy sequence. Pilots draw
        independent numbers: their laws are about these."""
        part, first = divmod(iteration * group_size, 2**32)
        return SampleSequence(
            self._pass_seed(iteration, purpose, part),
            dr.opaque(mi.UInt32, first),
            group_size,
            self._low_discrepancy(iteration),
        )

    def fill_film(self):
        """Hands what has been rendered so far to the sensor's film, ready to develop."""
        layers = [
            CLASSES.index(layer.type) if layer.type in CLASSES else self._layers[layer.name]
            for layer in self.integrator.layers
        ]
        film = self._emptied(self.sensor.film())
        self.accumulator.put(film, self.integrator.variance, layers)

    @functools.cached_property
    def _layers(self):
        """The layers of surfaces by name, made when the image is first looked at."""
        layers = [layer for layer in self.integrator.layers if layer.type not in CLASSES]
        with dr.suspend_grad():
            seed = mix(self.seed, RENDER, SURFACES)
            rendered = render_layers(self.scene, self.sensor, layers, seed)
        return {layer.name: tensor for layer, tensor in zip(layers, rendered)}

    def _emptied(self, film):
        """The film, empty, with all channels."""
        film.clear()
        film.prepare(self.integrator.aov_names())
        return film

    @under_render_lock
    def image(self):
        """The image so far: float32, (height, width, channels)."""
        if self.integrator.variance and self.iterations < 2:
            raise ValueError(
                f'{self.integrator.plugin}: parameter "variance" needs at least two iterations'
            )
        self.fill_film()
        return np.array(self.sensor.film().develop(), dtype=np.float32)

    @property
    @under_render_lock
    def channels(self):
        """Channel names of `image()`."""
        return [field.name for field in self._emptied(self.sensor.film()).bitmap().struct_()]


def scalar_seed(seed):
    """A seed as an integer, from one or from an array of width one."""
    return int(seed) if isinstance(seed, int) else int(np.array(seed).ravel()[0])
