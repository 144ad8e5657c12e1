"""Camera paths that see emission and direct light only: as many through each pixel as its noise is
worth."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.clock import now
from ..core.film import splat_samples
from ..core.packing import from_numpy
from ..core.recording import lanes
from ..core.sequences import SampleSequence
from ..core.spectra import channel_mean
from ..paths.camera import border_size, film_sample_count, film_size
from ..paths.light_classes import by_class, class_of
from ..paths.setting import CameraPass
from ..photons.queries import Queries, trace_camera_paths
from ..pilot.cost import USUAL_PHOTONS
from ..pilot.direct_paths import (
    COST,
    EXPONENTS,
    MOST_PATHS,
    TRIALS,
    DirectNoise,
    coarser,
    direct_error,
    measure,
    paths_per_pixel,
)
from ..pilot.noise import MEASURES
from ..pilot.run import PILOT_INDEX
from ..pilot.setting import UNPLANNED_ITERATIONS
from .noise_left import noise_left
from .purposes import DIRECT

INDICES = 2**32
"""Of the paths that share a sequence: iterations that would need more have others."""
LARGEST_PART = 1 << 21
"""Paths traced at once at most (bounds memory)."""
CHEAPEST = 0.01
"""Of a path for direct light, over one that gathers: what a clock says is not believed below."""
LARGEST = 1e18
"""Number that `Beside` can hold."""
NOTHING_GATHERED = Queries(
    bdd=0, capacity=0, has_caustics=False, has_indirect=False, one_vertex=True
)


class Beside(NamedTuple):
    """What the noise of direct light is weighed against: arguments of `paths_per_pixel`."""

    photon_light: float
    photon_error: float
    iterations: float
    cost: float
    most_cost: float


class DirectLight:
    """The passes of a `BDPMSession` that see emission, and direct light at the first smooth vertex.

    `mean_paths`: of these paths, a pixel and iteration (None until that is known); `path_seconds`:
    what one of them takes, once their `noise` is measured; `cost`: what an iteration takes, over
    one without them.
    """

    def __init__(self, session):
        self.session = session
        self.path_seconds, self.cost = 0.0, 1.0
        self.mean_paths = self._paths = self._beside = None
        self._lists = None  # what `_listed` has made
        self._exponent = EXPONENTS[session.integrator.low_discrepancy]

    @property
    def learned(self):
        """What the paths have been chosen by, in JSON's types; empty where nothing was measured."""
        return {} if self._beside is None else self._beside._asdict()

    def recall(self, fields):
        """Takes over what another session of the same render has `learned` (a `Fields`)."""
        if fields.names():
            self._beside = Beside(**{name: fields.number(name, LARGEST) for name in Beside._fields})

    def find_paths(self):
        """Chooses the paths, unless they are chosen."""
        if self.mean_paths is None:
            self.choose_paths()

    def choose_paths(self):
        """Chooses the paths by what is known of those that gather. Where nothing is gathered there
        are none: they would be no cheaper than all others."""
        session, gathering = self.session, self.session.camera_paths
        pixels, given = film_sample_count(session.sensor), session.integrator.direct_paths
        if not session.kinds():
            paths = np.full(pixels, gathering)
        elif given:
            paths = np.full(pixels, given * gathering)
        else:
            usual = 0.0, 1 / USUAL_PHOTONS, UNPLANNED_ITERATIONS, COST, LARGEST
            beside = self._beside or Beside(*usual)
            wanted = paths_per_pixel(self.measured(), exponent=self._exponent, **beside._asdict())
            paths = np.maximum(np.rint(wanted).astype(int), gathering)
        self._paths, self._lists = paths, None
        self.mean_paths = float(np.mean(paths)) - gathering
        self.cost = 1 + self._cost_of_path() * self.mean_paths

    def beside(self, prediction, anew):
        """A `Prediction` made without knowing of these paths, with the noise that they leave; they
        are chosen by it, where they are to be chosen `anew`."""
        light, iterations = prediction.photon_light, prediction.iterations
        if anew:
            if not self.session.integrator.direct_paths:
                error = prediction.errors["relmse"]
                error = error.variance + error.squared_bias * iterations
                cost = self._cost_of_path()
                most = min(self.session.most_cost, LARGEST)
                self._beside = Beside(max(light, 0.0), float(error), float(iterations), cost, most)
            self.choose_paths()
        found, errors = self.measured(), {}
        for name, weigh in MEASURES.items():
            weights, error = weigh(found.mean + light), prediction.errors[name]
            left = direct_error(found, weights, self._paths, iterations, self._exponent)
            errors[name] = error._replace(variance=error.variance + left)
        return prediction._replace(errors=errors)

    def _cost_of_path(self):
        """Of a path, over that of one that gathers: by the clock in a render of a given time."""
        gathering = self.session.gathering_seconds
        if not math.isfinite(gathering):
            return COST
        self.measured()
        seconds = self.path_seconds * film_sample_count(self.session.sensor)
        return min(max(seconds / gathering, CHEAPEST), 1.0)

    @functools.cached_property
    def noise(self):
        """The `DirectNoise` of a path, measured when it is first asked for."""
        width, height = film_size(self.session.sensor)
        rows, columns, nearest = coarser(width, height)
        pixels = (rows[:, None] * width + columns).ravel()
        found = measure(self._trials(pixels), len(columns))
        return DirectNoise(*(values[nearest] for values in found))

    def measured(self):
        """The `noise`, what counts of it: by this the paths are chosen."""
        return self.noise.times(noise_left(self.session.integrator, self.session.sensor))

    def noise_of_iteration(self):
        """Variance of the direct light of an iteration in each pixel of the crop window, by the
        trials, grey: (height, width)."""
        self.find_paths()
        width, height = film_size(self.session.sensor)
        border = border_size(self.session.sensor.film())
        variance = (self.noise.own / self._paths).reshape(height, width)
        return variance[border : height - border, border : width - border]

    def _trials(self, pixels):
        """Direct light of `TRIALS` independent paths through each of these pixels, mean over the
        channels: (trials, pixels)."""
        counts, half = np.zeros(film_sample_count(self.session.sensor), int), TRIALS // 2
        counts[pixels] = half
        passes, parts, found = self.session.recorded(self._grey), self._split(counts), []
        for index in (PILOT_INDEX, PILOT_INDEX + 1):  # the second is recorded: it tells the time
            spectral, start = self.session._spectral(index), now()
            values = [np.array(passes(*self._arguments(part, index, spectral))) for part in parts]
            self.path_seconds = (now() - start) / (half * len(pixels))
            found.append(np.concatenate(values)[: half * len(pixels)].reshape(-1, half).T)
        return np.concatenate(found)

    @property
    def beyond(self):
        """All paths of a pixel over those that gather, one a pixel; None where there are no
        others."""
        return self._listed()[1]

    def add_to(self, block, iteration, spectral):
        """An iteration's block with that of these paths."""
        parts, beyond, render = self._listed()
        for part in parts:
            block = block + render(*self._arguments(part, iteration, spectral), beyond)
        return block

    def _listed(self):
        """The paths in parts, `beyond`, and the recorded pass that renders a part: made when they
        are first rendered."""
        if self._lists is None:
            gathering = self.session.camera_paths
            if not self.mean_paths:
                self._lists = [], None, None
            else:
                self._lists = (
                    self._split(self._paths - gathering),
                    from_numpy(mi.Float, self._paths / gathering),
                    self.session.recorded(self._block),
                )
        return self._lists

    def _split(self, counts):
        """The paths, by pixels, in parts of equal size: the pixel of each path and the part's place
        among all, and of each pixel its first path and its count. The last part is filled up with
        paths of no pixel."""
        ends = np.cumsum(counts)
        total, first = int(ends[-1]), ends - counts
        parts = -(-total // LARGEST_PART)
        size = -(-total // parts)
        tables = [from_numpy(mi.UInt32, x.astype(np.uint32)) for x in (first, counts)]
        found = []
        for start in range(0, parts * size, size):
            stop = min(start + size, total)
            low = int(np.searchsorted(ends, start, "right"))
            high = int(np.searchsorted(ends, stop - 1, "right")) + 1
            here = np.minimum(ends[low:high], stop) - np.maximum(first[low:high], start)
            pixel = np.repeat(np.arange(low, high, dtype=np.uint32), here)
            pixel = np.pad(pixel, (0, size - len(pixel)), constant_values=len(counts))
            found.append((from_numpy(mi.UInt32, pixel), dr.opaque(mi.UInt32, start), *tables))
        return found

    def _arguments(self, part, iteration, spectral):
        session = self.session
        most = MOST_PATHS * session.camera_paths
        block, done = divmod(iteration, max(INDICES // most, 1))
        sequence = SampleSequence(
            session._pass_seed(iteration, DIRECT, block),
            dr.opaque(mi.UInt32, 0),
            1,
            session._low_discrepancy(iteration),
        )
        done = dr.opaque(mi.UInt32, done)
        return session.scene, session.sensor, session._tables, sequence, done, part, spectral

    def _trace(self, sensor, sequence, done, part, spectral):
        """Radiance, alpha, position for splatting, and whether there is a path. Light that is not
        finite counts as none: the paths that gather meet its cause, too, and tell of it."""
        pixel, place, first, counts = part
        session = self.session
        there = pixel < film_sample_count(sensor)
        number = lanes(dr.width(pixel)) + place - dr.gather(mi.UInt32, first, pixel, there)
        of_pixel = dr.gather(mi.UInt32, counts, pixel, there)
        camera_pass = CameraPass(
            sensor,
            session.integrator,
            sequence,
            pixel,
            done * of_pixel + number,
            spectral["sample"],
        )
        radiance, alpha, position, _, _ = trace_camera_paths(
            session.world, session.limits, camera_pass, NOTHING_GATHERED
        )
        shown = dr.all(dr.isfinite(radiance))
        if session.limits.hide_emitters:
            shown &= alpha > 0
        radiance = dr.select(shown, radiance, 0)
        dr.eval(radiance, alpha, position)  # the same kernel for `noise` and for images
        return radiance, alpha, position, there

    def _grey(self, scene, sensor, tables, sequence, done, part, spectral):
        radiance, _, _, there = self._trace(sensor, sequence, done, part, spectral)
        return channel_mean(dr.select(there, radiance, 0))

    def _block(self, scene, sensor, tables, sequence, done, part, spectral, beyond):
        radiance, alpha, position, there = self._trace(sensor, sequence, done, part, spectral)
        weight = dr.rcp(dr.gather(mi.Float, beyond, part[0], there))
        kept = self.session.integrator.kept_classes
        classes = by_class(class_of(mi.UInt32(1), mi.Bool(False)), radiance)[:kept]  # all is direct
        return splat_samples(
            sensor.film(), position, radiance, alpha, spectral["matrix"], there, weight, classes
        )
