"""The pilot of `bdpm`: a few iterations on a subset of the pixels, from which the merge radii follow."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.camera_pass import film_sample_count
from ..transport.gather import mean_photon_count
from ..transport.radius import LARGEST_SHARE, best_radius, ladder, middling, relative_weights, usual_mean
from ..transport.spectra import channel_mean

PILOT_PIXELS = 4096
FEWEST_ITERATIONS, FEWEST_TIMED_ITERATIONS, MOST_ITERATIONS = 4, 3, 16
PILOT_SHARE = 0.04
"""Share of the planned iterations, or seconds, that the pilot may have once it has the fewest."""
PILOT_INDEX = 1 << 30
"""Iteration numbers of the pilot start here, so that its random numbers are its own."""
UNPLANNED_ITERATIONS = 64
MOST_PHOTONS = 160
"""Photons a vertex within the largest radius that is tried."""
FEWEST_PHOTONS, WIDER = 1, 4
"""Photons a vertex within the largest radius, fewer than which tell nothing (the camera may see one point only): then radii so many times larger are
tried, up to those that suit the whole scene."""
GATHER_COST = 0.013
"""Cost of one gathered photon a vertex, in units of an iteration's light and camera passes (0.006 to 0.018 on the bundled scenes)."""
PROBE_COST = 0.15
"""Cost of the coverage probes, in the same units (0.03 to 0.25)."""
LIKE_A_PILOT = 1.5
"""What an iteration takes, in seconds of one of the pilot, until it is known."""
TOO_SLOW = 1.5
"""An iteration that takes so many times the guess is not believed to be typical."""
USUAL_PHOTONS = 10
"""Photons a gather at which an iteration counts as one planned iteration: larger gathers must pay for themselves."""


def choose_radii(session):
    """Sets `session.radii` and `session.corrected` for each kind of photon map that the session needs; returns what is expected of them (a
    `Forecast`), or `None` where there are no photons to gather."""
    session.radii = {}
    if not session.kinds():
        return None
    pilot = Pilot(session)
    count = session.iterations_planned or UNPLANNED_ITERATIONS
    started = time.perf_counter()
    for done in range(MOST_ITERATIONS):
        start = time.perf_counter()
        pilot.iterate(done)
        now = time.perf_counter()
        if session.seconds is not None:
            over = now - started > PILOT_SHARE * session.seconds and done + 1 >= FEWEST_TIMED_ITERATIONS
        else:
            over = done + 1 >= max(PILOT_SHARE * count, FEWEST_ITERATIONS)
        if over or pilot.ladder is None:
            break
    if session.seconds is None:
        return pilot.forecast(pilot.decide(count), count)
    guess = LIKE_A_PILOT * (now - start)
    left = max(session.seconds - (now - session.begun), guess)
    pilot.decide(left / guess)
    seconds, spent = rehearse(session, guess, left)
    count = max(left / seconds * pilot.cost_of_choice(), 1)
    before = dict(session.radii), dict(session.corrected)
    choices = pilot.decide(count, min(spent / left, 1))
    if (session.radii, session.corrected) != before:
        session.rehearsed.clear()
    if session.corrected != before[1]:
        session._freeze()
    return pilot.forecast(choices, count)


def rehearse(session, guess, left):
    """Renders the session's first iteration, and the second where the first took longer than it should have (it may have had to be compiled) but
    not most of the seconds that are `left`; returns the seconds of an iteration, and those of all. The session keeps the iterations."""
    spent = 0.0
    for number in range(2):
        start = time.perf_counter()
        block = session._iteration(number)
        dr.eval(block)
        dr.sync_thread()
        seconds = time.perf_counter() - start
        session.rehearsed[number] = block
        spent += seconds
        if seconds < TOO_SLOW * guess or spent > left / 2:
            break
    return seconds, spent


@dataclass(frozen=True)
class Forecast:
    """What a pilot expects of a session's iterations; errors are relative, by `relative_weights` of `mean`."""

    squared_bias: float
    variance: float
    """Of one iteration, direct light included."""
    gathered: float
    """Photons within a vertex's merge disks."""
    count: float
    """Iterations of usual cost that were planned for."""
    mean: np.ndarray
    """(pixels,)"""
    caustic_share: float
    """Share of the light that caustic photons bring."""
    iterations: int
    """Of the pilot."""


def pilot_pixels(session):
    """`(stride, count)`: the pilot's pixels are numbers 0, stride, 2 stride, ... of the film's."""
    pixels = film_sample_count(session.sensor)
    count = min(pixels, PILOT_PIXELS)
    stride = pixels // count
    width = int(session.sensor.film().crop_size()[0])
    while stride > 1 and math.gcd(stride, width) > 1:          # else the pixels would stand in columns
        stride -= 1
    return stride, count


class Pilot:
    """Pilot iterations of a session.

    `ladder`: radii (ascending); `samples[kind, corrected]`: gathered values (iterations, radii, pixels), channel mean;
    `photons[kind]`: mean number of photons within the largest radius.
    """

    def __init__(self, session):
        self.session = session
        stride, self.paths = pilot_pixels(session)
        self.stride = stride * session.integrator.camera_paths
        self.ladder = None
        # Caustics have edges of their own; only the smooth indirect light gains from knowing the surfaces' edges, and only where the camera
        # sees the vertices: deeper ones are spread over the scene, and their blur averages out.
        self.at_first_vertex = session.integrator.bdd == 0
        self.ways = {kind: [False, True] if kind == "indirect" and self.at_first_vertex else [False] for kind in session.kinds()}
        self.samples = {(kind, way): [] for kind, ways in self.ways.items() for way in ways}
        self.direct, self.photons = [], {}
        self._record_camera(session._vertex_room(self.paths) * (1 if session.one_vertex else 4))
        self._record_gather()
        self._covered = session.recorded(session._covered)

    def _record_camera(self, capacity):
        session, self.capacity = self.session, capacity
        self._camera = session.recorded(lambda scene, sensor, tables, seed, spectral: session._trace_camera(
            scene, sensor, seed, mi.UInt32(0), self.stride, self.paths, capacity, spectral))

    def _record_gather(self):
        session = self.session
        self.photon_capacity = session.photon_capacity
        self._gather = session.recorded(lambda scene, tables, photons, vertices, radii, spectral: {
            kind: session._gather(session._map(photons, kind, radii[-1]), vertices, kind, radii, spectral, grey=True) for kind in self.ways})

    def _trace(self, seed, spectral):
        """Radiance and vertices of the pilot's camera paths. Where the vertices overflow their buffer, it grows and the pass runs again."""
        session = self.session
        while True:
            radiance, _, _, vertices, count = self._camera(session.scene, session.sensor, session._tables, seed, spectral)
            found = 0 if session.one_vertex else int(dr.max(count)[0])
            if found <= self.capacity:
                return radiance, vertices
            self._record_camera(found + found // 8)

    def iterate(self, number):
        """Runs pilot iteration `number`."""
        session = self.session
        number += PILOT_INDEX
        spectral = session._spectral(number)
        photons = session._photons(number, spectral)
        if self.photon_capacity != session.photon_capacity:
            self._record_gather()
        seed = session._seed(number, 1)
        radiance, vertices = self._trace(seed, spectral)
        if self.ladder is None and not self._prepare(photons, vertices):
            return
        radii = [dr.opaque(mi.Float, float(radius)) for radius in self.ladder]
        gathered = self._gather(session.scene, session._tables, photons, vertices, radii, spectral)
        self.direct.append(self._numpy(channel_mean(radiance)))
        for (kind, way), store in self.samples.items():
            values = gathered[kind]
            if way:
                values = [v * dr.rcp(self._covered(session.scene, session._tables, vertices, r, seed)) for v, r in zip(values, radii)]
            store.append([self._numpy(session._per_path(value, vertices, self.paths)) for value in values])

    def _numpy(self, value):
        return np.broadcast_to(np.array(value), self.paths)

    def _prepare(self, photons, vertices):
        """Sets the ladder and counts photons; false if no camera path meets a surface that gathers."""
        points = vertices["ray_o"] + vertices["ray_d"] * vertices["hit"].t
        self.ladder = ladder(np.array(points), np.array(dr.max(vertices["throughput"])))
        if self.ladder is None:
            return False
        self._count(photons, vertices)
        largest = LARGEST_SHARE * float(dr.norm(self.session.traits.bounds.extents())) / 3 ** 0.5
        while (crowd := max(self.photons.values())) < FEWEST_PHOTONS and self.ladder[-1] < largest:
            self.ladder = self.ladder * min(WIDER, largest / self.ladder[-1])
            self._count(photons, vertices)
        if crowd > MOST_PHOTONS:
            self.ladder = self.ladder * (MOST_PHOTONS / crowd) ** 0.5
            self._count(photons, vertices)
        return True

    def _count(self, photons, vertices):
        radius = dr.opaque(mi.Float, float(self.ladder[-1]))
        for kind in self.ways:
            photon_map = self.session._map(photons, kind, radius)
            self.photons[kind] = mean_photon_count(photon_map, vertices, radius)

    def _cost(self, kind, corrected, radius):
        photons = self.gathered(kind, radius)
        return (1 + GATHER_COST * photons + PROBE_COST * corrected) / (1 + GATHER_COST * USUAL_PHOTONS)

    def forecast(self, choices, count):
        """The `Forecast` for these choices; `None` if no camera path meets a surface that gathers."""
        if self.ladder is None:
            return None
        mean = self.mean()
        direct = usual_mean(relative_weights(mean) * np.var(self.direct, axis=0, ddof=1)) if len(self.direct) > 1 else np.inf
        session = self.session
        caustics = np.mean(self.middling("caustic")) if "caustic" in self.ways else 0.0
        return Forecast(sum(choice.squared_bias for choice in choices.values()), direct + sum(choice.variance for choice in choices.values()),
                        sum(self.gathered(kind, session.radii[kind]) for kind in choices), count, mean,
                        float(caustics / max(np.mean(mean), 1e-30)), len(self.direct))

    def gathered(self, kind, radius):
        """Photons of a kind within `radius` of a vertex, on average."""
        return self.photons[kind] * (radius / self.ladder[-1]) ** 2

    def cost_of_choice(self):
        """Relative cost of an iteration with the session's radii."""
        return max((self._cost(kind, self.session.corrected[kind], radius) for kind, radius in self.session.radii.items()
                    if kind in self.photons), default=1.0)

    def decide(self, count, reluctance=None):
        """Sets the session's radii and corrections for `count` iterations of usual cost; returns the choice for each kind of photons. With a
        `reluctance` those that are set already are kept unless the predicted error falls by more than this share."""
        session = self.session
        if self.ladder is None:
            session.radii = {kind: 1e-3 * float(dr.norm(session.traits.bounds.extents())) for kind in self.ways}
            return {}
        samples, mean = {key: np.array(values) for key, values in self.samples.items()}, self.mean()
        choices = {kind: best_radius(
            self.ladder, samples[kind, False], samples.get((kind, True)), mean,
            lambda radius, corrected, kind=kind: np.maximum(count / self._cost(kind, corrected, radius), 1), self.at_first_vertex,
            kind == "caustic", None if reluctance is None else (session.radii[kind], session.corrected[kind]), reluctance or 0.0)
            for kind in self.ways}
        session.radii = {kind: choice.radius for kind, choice in choices.items()}
        session.corrected.update({kind: choice.correct for kind, choice in choices.items()})
        return choices

    def mean(self):
        """The pilot's pixels, gathered at a middling radius: (pixels,), or those that the session is to be judged by."""
        if self.session.judged_by is not None:
            return self.session.judged_by
        return np.mean(self.direct, axis=0) + sum(np.mean(self.middling(kind), axis=0) for kind in self.ways)

    def middling(self, kind):
        """What photons of a kind bring at a middling radius: (iterations, pixels)."""
        return [step[middling(self.ladder)] for step in self.samples[kind, False]]
