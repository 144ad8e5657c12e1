"""The pilot of `bdpm`: a few iterations on a subset of the pixels, from which the merge radii and
the number of camera paths follow."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.recording import lanes
from ..core.spectra import channel_mean
from ..paths.camera import film_sample_count, film_size
from ..paths.setting import CameraPass
from ..photons.gather import mean_photon_count
from ..photons.queries import read_queries
from .radius import (
    LARGEST_SHARE,
    Expected,
    best_radius,
    expect,
    ladder,
    middle_index,
    relative_weights,
    shrink_to_neighbours,
    trimmed_mean,
)

PILOT_PATHS = 4096
FEWEST_ITERATIONS, FEWEST_TIMED_ITERATIONS, MOST_ITERATIONS = 4, 3, 16
NEIGHBOURS = 16
"""Pilot pixels that are expected to look alike."""
PILOT_TIME_SHARE = 0.04
"""Share of the planned iterations, or seconds, that the pilot may have once it has the fewest."""
PILOT_INDEX = 1 << 30
"""Iteration numbers of the pilot start here, so that its random numbers are its own."""
UNPLANNED_ITERATIONS = 64
MOST_PHOTONS = 160
"""Photons a vertex within the largest radius that is tried."""
FEWEST_PHOTONS, WIDER = 1, 4
"""Photons a vertex within the largest radius, fewer than which tell nothing (the camera may see one
point only): then radii so many times larger are tried, up to those that suit the whole scene."""
GATHER_COST = 0.013
"""Cost of one gathered photon a vertex, in units of an iteration's light and camera passes (0.006
to 0.018 on the bundled scenes)."""
PROBE_COST = 0.15
"""Cost of the coverage probes, in the same units (0.03 to 0.25)."""
LIKE_A_PILOT = 1.5
"""What an iteration takes, in seconds of one of the pilot, until it is known."""
TOO_SLOW = 1.5
"""An iteration that takes so many times the guess is not believed to be typical."""
CAMERA_SHARE = 0.35
"""Share of the same units that each camera path of a pixel takes, until it is known (0.1 to 0.5 on
the bundled scenes)."""
LEAST_CAMERA_SHARE, MOST_CAMERA_SHARE = 0.1, 0.8
NUMBERS_OF_PATHS = (1, 2, 4, 8)
"""Camera paths a pixel and iteration that are considered."""
WORTH_TRYING = 0.92
"""Two camera paths are tried where the best number is expected to make the error smaller by this
factor, if a camera path costs the least that it may."""
LONG = 16
"""... in renders of so many iterations at least."""
WORTH_CHANGING = 0.95
"""Another number than was tried must make it smaller by this factor."""
USUAL_PHOTONS = 10
"""Photons a gather at which an iteration counts as one planned iteration: larger gathers must pay
for themselves."""


def choose_radii(session):
    """Sets `session.radii` and `session.corrected` for each kind of photon map that the session
    needs; returns what is expected of them (a `Forecast`), or `None` where there are no photons to
    gather."""
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
            over = (
                now - started > PILOT_TIME_SHARE * session.seconds
                and done + 1 >= FEWEST_TIMED_ITERATIONS
            )
        else:
            over = done + 1 >= max(PILOT_TIME_SHARE * count, FEWEST_ITERATIONS)
        if over or pilot.ladder is None:
            break
    if session.seconds is None:
        return pilot.forecast(pilot.decide(count), count)
    guess = LIKE_A_PILOT * (now - start)
    left = max(session.seconds - (now - session.begun), guess)
    pilot.decide(left / guess)
    seconds, spent = rehearse(session, guess, left)
    count = max(left / seconds * pilot.cost_of_choice(), 1)
    if may_choose_camera_paths(session) and left / seconds > LONG:
        spent += choose_camera_paths(pilot, seconds, count, left)
    before = dict(session.radii), dict(session.corrected)
    choices = pilot.decide(count, min(spent / left, 1))
    if (session.radii, session.corrected) != before:
        session.rehearsed.clear()
    if session.corrected != before[1]:
        session._freeze()
    return pilot.forecast(choices, count)


def may_choose_camera_paths(session):
    """Whether the number of camera paths a pixel is the pilot's to choose: what one costs is known
    in renders of a given time only."""
    return session.seconds is not None and not session.integrator.camera_paths


def choose_camera_paths(pilot, seconds, count, left):
    """Sets how many camera paths each pixel has in an iteration, where one takes so many `seconds`
    and there is time for `count` of them; returns the seconds that this took. What camera paths
    cost is measured where they may pay; the session keeps the iterations if they have the right
    number."""
    session = pilot.session
    if pilot.ladder is None:
        return 0.0
    pilot.camera_share = LEAST_CAMERA_SHARE
    hoped = {number: pilot.error(number, count) for number in NUMBERS_OF_PATHS}
    if min(hoped.values()) > WORTH_TRYING * hoped[1]:
        return 0.0
    session.send(2)
    of_two, spent = rehearse(session, 2 * seconds, left)
    pilot.learn_cost(of_two / seconds)
    errors = {
        number: pilot.error(number, count) * (1 if number == 2 else 1 / WORTH_CHANGING)
        for number in NUMBERS_OF_PATHS
    }
    pilot.camera_paths = min(errors, key=errors.get)
    if pilot.camera_paths != 2:
        session.send(pilot.camera_paths)
    return spent


def rehearse(session, guess, left):
    """Renders the session's first iteration, and the second where the first took longer than it
    should have (it may have had to be compiled) but not most of the seconds that are `left`;
    returns the seconds of an iteration, and those of all. The session keeps the iterations."""
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
    """What a pilot expects of a session's iterations; errors are relative, by `relative_weights` of
    `mean`."""

    squared_bias: float
    variance: float
    """Of one iteration, direct light included."""
    gathered: float
    """Photons within a vertex's merge disks."""
    count: float
    """Iterations that were planned for."""
    mean: np.ndarray
    """(pixels,)"""
    caustic_share: float
    """Share of the light that caustic photons bring."""
    iterations: int
    """Of the pilot."""
    cost_of_paths: float
    """What an iteration costs with its camera paths, in units of one with one a pixel."""


def pilot_pixels(session):
    """`(stride, count, copies)`: the pilot's pixels are numbers 0, stride, 2 stride, ... of the
    film's, and so many camera paths go through each."""
    pixels = film_sample_count(session.sensor)
    pilot_camera_paths = 2 if may_choose_camera_paths(session) or session.camera_paths > 1 else 1
    count = min(pixels, PILOT_PATHS // pilot_camera_paths)
    stride = pixels // count
    width, _ = film_size(session.sensor)
    while stride > 1 and math.gcd(stride, width) > 1:  # else the pixels would stand in columns
        stride -= 1
    return stride, count, pilot_camera_paths


def neighbourhoods(session, stride, count):
    """Numbers of the square cells of the film, from 0, in which the pilot's pixels lie,
    `NEIGHBOURS` in each: (count,)."""
    width = film_size(session.sensor)[0]
    side = math.sqrt(NEIGHBOURS * stride)
    row, column = np.divmod(np.arange(count) * stride, width)
    cells = (row // side) * math.ceil(width / side) + column // side
    return np.unique(cells, return_inverse=True)[1]


class PilotNoise(NamedTuple):
    """What a pilot knows of biases and variances, relative by `relative_weights`."""

    expected: dict[str, Expected]
    """By kind of photons."""
    of_a_path: dict[str, dict[bool, np.ndarray]]
    """By kind of photons and whether they are corrected at edges: variance between camera paths
    that share photons, one a radius."""
    direct: float
    """Variance of the light of a camera path that does not come from photons."""


class Pilot:
    """Pilot iterations of a session.

    `ladder`: radii (ascending); `samples[kind, corrected]`: gathered values, one array (radii,
    copies, pixels) an iteration, channel mean; `direct`: the light that does not come from photons,
    (copies, pixels) an iteration; `photons[kind]`: mean number of photons within the largest
    radius.

    `pilot_camera_paths`: camera paths of a pixel, which share the photons of their iteration. Where
    an iteration may have several camera paths a pixel there are two, whose difference tells the
    noise of camera paths from that of photons.
    """

    def __init__(self, session):
        self.session = session
        stride, self.pixels, self.pilot_camera_paths = pilot_pixels(session)
        self.camera_paths, self.camera_share = session.camera_paths, CAMERA_SHARE
        self.stride, self.paths = (
            stride * self.pilot_camera_paths,
            self.pixels * self.pilot_camera_paths,
        )
        self.cells = neighbourhoods(session, stride, self.pixels)
        self.ladder = None
        # Caustics have edges of their own; only the smooth indirect light gains from knowing the
        # surfaces' edges, and only where the camera sees the vertices: deeper ones are spread over
        # the scene, and their blur averages out.
        self.at_first_vertex = session.integrator.bdd == 0
        self.ways = {
            kind: [False, True] if kind == "indirect" and self.at_first_vertex else [False]
            for kind in session.kinds()
        }
        self.samples = {(kind, way): [] for kind, ways in self.ways.items() for way in ways}
        self.direct, self.photons = [], {}
        self._record_camera(session._vertex_room(self.paths) * (1 if session.one_vertex else 4))
        self._record_gather()
        self._covered = session.recorded(session._covered)

    def _record_camera(self, capacity):
        session, self.capacity = self.session, capacity
        back = (
            1 - self.pixels * self.stride
        ) % 2**32  # from a copy's path after the last pixel to the next copy's of the first one
        self._camera = session.recorded(
            lambda scene, sensor, tables, seed, spectral: session._trace_camera(
                CameraPass(
                    sensor,
                    session.integrator,
                    seed,
                    lanes(self.paths) // self.pixels * back,
                    self.paths,
                    self.pilot_camera_paths,
                    spectral["sample"],
                    self.stride,
                ),
                capacity,
                spectral,
            )
        )

    def _record_gather(self):
        session = self.session
        self.photon_capacity = session.photon_capacity
        self._gather = session.recorded(
            lambda scene, tables, photons, vertices, radii, spectral: {
                kind: session._gather(
                    session._map(photons, kind, radii[-1]),
                    vertices,
                    kind,
                    radii,
                    spectral,
                    grey=True,
                )
                for kind in self.ways
            }
        )

    def _trace(self, seed, spectral):
        """Radiance and vertices of the pilot's camera paths. Where the vertices overflow their
        buffer, it grows and the pass runs again."""
        session = self.session
        while True:
            radiance, _, _, vertices, count = self._camera(
                session.scene, session.sensor, session._tables, seed, spectral
            )
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
                values = [
                    v * dr.rcp(self._covered(session.scene, session._tables, vertices, r, seed))
                    for v, r in zip(values, radii)
                ]
            store.append(
                [self._numpy(session._per_path(value, vertices, self.paths)) for value in values]
            )

    def _numpy(self, value):
        return np.broadcast_to(np.array(value), self.paths).reshape(
            self.pilot_camera_paths, self.pixels
        )

    def _prepare(self, photons, vertices):
        """Sets the ladder and counts photons; false if no camera path meets a surface that
        gathers."""
        seen = read_queries(vertices)
        points = seen["ray_o"] + seen["ray_d"] * seen["hit"].t
        self.ladder = ladder(np.array(points), np.array(dr.max(seen["throughput"])))
        if self.ladder is None:
            return False
        self._count(photons, vertices)
        largest = LARGEST_SHARE * float(dr.norm(self.session.traits.bounds.extents())) / 3**0.5
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
            self.photons[kind] = mean_photon_count(photon_map, read_queries(vertices), radius)

    def _cost(self, kind, corrected, radius, camera_paths):
        gather = GATHER_COST * self.gathered(kind, radius) + PROBE_COST * corrected
        return (1 + gather + (camera_paths - 1) * (self.camera_share + gather)) / (
            1 + GATHER_COST * USUAL_PHOTONS
        )

    def forecast(self, choices, count):
        """The `Forecast` for these choices and `count` iterations of usual cost; `None` if no
        camera path meets a surface that gathers."""
        if self.ladder is None:
            return None
        mean = self.mean()
        session = self.session
        caustics = np.mean(self.middle_index("caustic")) if "caustic" in self.ways else 0.0
        return Forecast(
            sum(choice.squared_bias for choice in choices.values()),
            self._variance(choices, self.camera_paths),
            sum(self.gathered(kind, session.radii[kind]) for kind in choices),
            count / self.cost_of_choice(),
            mean,
            float(caustics / max(np.mean(mean), 1e-30)),
            len(self.direct),
            self.cost_of_choice() / self.cost_of_choice(1),
        )

    def _variance(self, choices, camera_paths):
        """Relative variance of an iteration with these choices, direct light included."""
        return self.noise.direct / camera_paths + sum(
            choice.variance for choice in choices.values()
        )

    def gathered(self, kind, radius):
        """Photons of a kind within `radius` of a vertex, on average."""
        return self.photons[kind] * (radius / self.ladder[-1]) ** 2

    def cost_of_choice(self, camera_paths=None):
        """Relative cost of an iteration with the session's radii."""
        return max(
            (
                self._cost(
                    kind, self.session.corrected[kind], radius, camera_paths or self.camera_paths
                )
                for kind, radius in self.session.radii.items()
                if kind in self.photons
            ),
            default=1.0,
        )

    def learn_cost(self, of_two):
        """Takes over what an iteration of two camera paths costs, in units of one of one."""
        slope = (
            (of_two - 1) * self.cost_of_choice(1)
            + self.camera_share
            - (self.cost_of_choice(2) - self.cost_of_choice(1))
        )
        self.camera_share = min(max(slope, LEAST_CAMERA_SHARE), MOST_CAMERA_SHARE)

    def error(self, camera_paths, count):
        """Predicted relative error of a render that could have `count` iterations of usual cost, if
        each has so many camera paths a pixel."""
        choices = self._best_radii(camera_paths, count)
        cost = max(
            self._cost(kind, choice.correct, choice.radius, camera_paths)
            for kind, choice in choices.items()
        )
        return sum(choice.squared_bias for choice in choices.values()) + self._variance(
            choices, camera_paths
        ) / max(count / cost, 1)

    def decide(self, count, reluctance=None):
        """Sets the session's radii and corrections for `count` iterations of usual cost; returns
        the choice for each kind of photons. With a `reluctance` those that are set already are kept
        unless the predicted error falls by more than this share."""
        session = self.session
        if self.ladder is None:
            session.radii = {
                kind: 1e-3 * float(dr.norm(session.traits.bounds.extents())) for kind in self.ways
            }
            return {}
        choices = self._best_radii(self.camera_paths, count, reluctance)
        session.radii = {kind: choice.radius for kind, choice in choices.items()}
        session.corrected.update({kind: choice.correct for kind, choice in choices.items()})
        return choices

    def _best_radii(self, camera_paths, count, reluctance=None):
        """The `RadiusChoice` for each kind of photons, in iterations of so many camera paths a
        pixel."""
        session, choices = self.session, {}
        for kind, expected in self.noise.expected.items():
            more_noise = {
                way: noise * (1 / camera_paths - 1 / self.pilot_camera_paths)
                for way, noise in self.noise.of_a_path[kind].items()
            }
            choices[kind] = best_radius(
                expected,
                lambda radius, corrected, kind=kind: np.maximum(
                    count / self._cost(kind, corrected, radius, camera_paths), 1
                ),
                None if reluctance is None else (session.radii[kind], session.corrected[kind]),
                reluctance or 0.0,
                more_noise,
            )
        return choices

    @cached_property
    def noise(self):
        """The `PilotNoise` of all iterations so far; they are over when this is asked for."""
        mean = self.mean()
        weights, expected, of_a_path = relative_weights(mean), {}, {}
        for kind, ways in self.ways.items():
            samples = {
                way: np.array(self.samples[kind, way]) for way in ways
            }  # (iterations, radii, copies, pixels)
            means = {way: values.mean(axis=2) for way, values in samples.items()}
            expected[kind] = expect(
                self.ladder,
                means[False],
                means.get(True),
                mean,
                self.at_first_vertex,
                kind == "caustic",
            )
            of_a_path[kind] = {
                way: self._between_copies(weights, values) for way, values in samples.items()
            }
        of_direct = (
            np.var(self.direct, axis=0, ddof=1).mean(axis=0)
            if len(self.direct) > 1
            else np.full(self.pixels, np.inf)
        )
        return PilotNoise(expected, of_a_path, trimmed_mean(weights * of_direct))

    def _between_copies(self, weights, samples):
        """Relative variance between the camera paths of a pixel, one a radius."""
        if self.pilot_camera_paths == 1:
            return np.zeros(len(self.ladder))
        return np.array(
            [
                trimmed_mean(pixels)
                for pixels in weights * np.var(samples, axis=2, ddof=1).mean(axis=0)
            ]
        )

    def mean(self):
        """The pilot's pixels, gathered at a middling radius: (pixels,), or those that the session
        is to be judged by."""
        if self.session.judged_by is not None:
            return self.session.judged_by
        image = np.mean(self.direct, axis=1) + sum(
            np.mean(self.middle_index(kind), axis=1) for kind in self.ways
        )  # (iterations, pixels)
        return shrink_to_neighbours(image, self.cells)

    def middle_index(self, kind):
        """What photons of a kind bring at a middling radius: (iterations, copies, pixels)."""
        return [step[middle_index(self.ladder)] for step in self.samples[kind, False]]
