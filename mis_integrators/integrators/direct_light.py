"""Camera paths that see emission and direct light only: as many through each pixel as its noise is
worth."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import splat_samples
from ..core.packing import from_numpy
from ..core.sequences import SampleSequence
from ..core.spectra import channel_mean
from ..paths.camera import film_sample_count, film_size
from ..paths.setting import ListedPass
from ..photons.queries import Queries, trace_camera_paths
from ..pilot.cost import USUAL_PHOTONS
from ..pilot.direct_paths import EXPONENTS, TRIALS, direct_error, measure, paths_per_pixel
from ..pilot.run import PILOT_INDEX
from ..pilot.setting import UNPLANNED_ITERATIONS
from .common import RENDER

PURPOSE = 4
"""Of the random seed, see `bdpm`."""
ITERATION_BITS = 22
"""Iterations 2^22 a to 2^22 (a + 1) - 1 share a sequence: with 2^10 paths a pixel at most, their
indices have 32 bits."""
LARGEST_PART = 1 << 21
"""Paths traced at once at most (bounds memory)."""
LARGEST = 1e18
"""Number that `Beside` can hold."""
NOTHING_GATHERED = Queries(0, 0, False, False, True)


class Beside(NamedTuple):
    """What the noise of direct light is weighed against: arguments of `paths_per_pixel`."""

    photon_light: float
    photon_error: float
    iterations: float


class DirectLight:
    """The passes of a `BDPMSession` that see emission, and direct light at the first smooth vertex.

    `mean_paths`: of these paths, a pixel and iteration (None until that is known); `beyond` (one a
    pixel; None where there are no such paths): all paths over those that gather.
    """

    def __init__(self, session):
        self.session = session
        self.mean_paths = self.beyond = None
        self._beside, self._noise, self._parts = None, None, []
        self._render = None  # the recorded pass
        self._exponent = EXPONENTS[session.integrator.low_discrepancy]

    @property
    def learned(self):
        """What the paths have been chosen by, in JSON's types; empty where nothing was measured."""
        return {} if self._beside is None else self._beside._asdict()

    def recall(self, fields):
        """Takes over what another session of the same render has `learned` (a `Fields`)."""
        if fields.names():
            self._beside = Beside(**{name: fields.number(name, LARGEST) for name in Beside._fields})

    def spread(self, prediction=None):
        """Chooses the paths, given a `Prediction` of what those do that gather. Where nothing is
        gathered there are none: they would be no cheaper than all others."""
        session = self.session
        pixels, given = film_sample_count(session.sensor), session.integrator.direct_paths
        if given or not session.kinds():
            extra = max(given - 1, 0) if session.kinds() else 0
            self._send(np.full(pixels, extra * session.camera_paths))
            return
        if self._noise is None:
            self._noise = measure(self._trials(TRIALS), film_size(session.sensor)[0])
        if prediction is not None:
            others = self._without_direct_light(prediction)
            error = others + prediction.squared_bias * prediction.iterations
            self._beside = Beside(
                prediction.photon_light, float(error), float(prediction.iterations)
            )
        beside = self._beside or Beside(0.0, 1 / USUAL_PHOTONS, UNPLANNED_ITERATIONS)
        paths = paths_per_pixel(self._noise, *beside, self._exponent)
        self._send(np.maximum(np.rint(paths).astype(int) - session.camera_paths, 0))

    def known_by(self, prediction):
        """A `Prediction` made without knowing of these paths, with the noise that they leave."""
        if self._noise is None:
            return prediction
        left = direct_error(
            self._noise,
            prediction.photon_light,
            self._paths,
            prediction.iterations,
            self._exponent,
        )
        return prediction._replace(variance=self._without_direct_light(prediction) + left)

    def _without_direct_light(self, prediction):
        """The variance of a `Prediction` without that of direct light at first smooth vertices, in
        one iteration."""
        of_one = direct_error(self._noise, prediction.photon_light, 1.0, 1, 1.0)
        of_all = of_one / self.session.camera_paths
        return prediction.variance - min(prediction.direct, of_all)

    def _trials(self, trials):
        """Direct light of so many independent paths through each pixel, mean over the channels:
        (trials, pixels)."""
        pixels = film_sample_count(self.session.sensor)
        passes = self.session.recorded(self._grey)
        spectral = self.session._spectral(PILOT_INDEX)
        values = [
            np.array(passes(*self._arguments(part, PILOT_INDEX, spectral)))
            for part in self._split(np.full(pixels, trials))
        ]
        return np.concatenate(values)[: trials * pixels].reshape(pixels, trials).T

    def _send(self, counts):
        """From now on, `counts` (pixels,) of these paths go through each pixel and iteration."""
        gathering = self.session.camera_paths
        self._paths = counts + gathering
        self.mean_paths, self._parts, self.beyond = float(np.mean(counts)), [], None
        if np.any(counts):
            self._parts = self._split(counts)
            self._render = self.session.recorded(self._block)
            self.beyond = from_numpy(mi.Float, self._paths / gathering)

    def add_to(self, block, iteration, spectral):
        """An iteration's block with that of these paths."""
        for part in self._parts:
            block = block + self._render(*self._arguments(part, iteration, spectral), self.beyond)
        return block

    def _split(self, counts):
        """The paths in parts of equal size: pixel of each, its number there, and the pixel's count.
        The last part is filled up with paths of no pixel."""
        total = int(counts.sum())
        pixel = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
        first = np.cumsum(counts) - counts
        number = np.arange(total) - first[pixel]
        parts = -(-total // LARGEST_PART)
        size = -(-total // parts)
        missing = parts * size - total
        pixel = np.pad(pixel, (0, missing), constant_values=len(counts))
        number, of_pixel = (np.pad(x, (0, missing)) for x in (number, counts[pixel[:total]]))
        return [
            tuple(
                from_numpy(mi.UInt32, x[k * size : (k + 1) * size].astype(np.uint32))
                for x in (pixel, number, of_pixel)
            )
            for k in range(parts)
        ]

    def _arguments(self, part, iteration, spectral):
        session, block = self.session, iteration >> ITERATION_BITS
        low_discrepancy = session._low_discrepancy(iteration)
        shared = RENDER, PURPOSE, block
        seed = session._seed(*shared if low_discrepancy else (iteration, PURPOSE))
        sequence = SampleSequence(seed, dr.opaque(mi.UInt32, 0), 1, low_discrepancy)
        done = dr.opaque(mi.UInt32, iteration - (block << ITERATION_BITS))
        return session.scene, session.sensor, session._tables, sequence, done, part, spectral

    def _trace(self, sensor, sequence, done, part, spectral):
        """Radiance, alpha, position for splatting, and whether there is a path. Light that is not
        finite counts as none: the paths that gather meet its cause, too, and tell of it."""
        pixel, number, of_pixel = part
        session = self.session
        camera_pass = ListedPass(
            sensor,
            session.integrator,
            sequence,
            pixel,
            done * of_pixel + number,
            dr.width(pixel),
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
        return radiance, alpha, position, pixel < film_sample_count(sensor)

    def _grey(self, scene, sensor, tables, sequence, done, part, spectral):
        radiance, _, _, there = self._trace(sensor, sequence, done, part, spectral)
        return channel_mean(dr.select(there, radiance, 0))

    def _block(self, scene, sensor, tables, sequence, done, part, spectral, beyond):
        radiance, alpha, position, there = self._trace(sensor, sequence, done, part, spectral)
        weight = dr.rcp(dr.gather(mi.Float, beyond, part[0], there))
        return splat_samples(
            sensor.film(), position, radiance, alpha, spectral["matrix"], there, weight
        )
