"""Runs a pilot: a few iterations on a subset of the pixels, gathered at a ladder of radii."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from .radius import ladder, ladder_from, largest_radius
from .result import PilotResult, PilotSamples, measure
from .setting import PilotPixels, PilotSetting

FEWEST_ITERATIONS, MOST_ITERATIONS = 3, 16
"""Tuned: iterations of a pilot: the fewest, and the most."""
PILOT_TIME_SHARE = 0.04
"""Tuned: share of the planned iterations, or seconds, that the pilot may have once it has the
fewest; the seconds of its first iteration, which may have to compile, do not count."""
PILOT_INDEX = 1 << 30
"""Iteration numbers of the pilot start here, so that its random numbers are its own."""
MOST_PHOTONS = 160
"""Tuned: photons a vertex within the largest radius that is tried."""
PROBED_SHARE = 8
"""Volume photons within the largest radius are counted within one so many times smaller: along a
path's way through media their number grows with its square, around a vertex with its cube."""
FEWEST_PHOTONS, WIDER = 1, 4
"""Tuned: photons a vertex within the largest radius, fewer than which tell nothing (the camera may
see one point only): then radii so many times larger are tried, up to those that suit the whole
scene."""
NEARLY_ALL = 0.9
"""Disks of a pixel's size, the share of them below the largest: few that are far away must not make
the grid of all too coarse."""


class PilotIteration(Protocol):
    """One iteration of a pilot: photons, and the vertices of the camera paths of the pilot's
    pixels."""

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the vertices lie, (3, n), and the weights of their paths, (n,): zero where there is
        none."""

    def pixel_widths(self) -> np.ndarray:
        """How wide a pixel is at the vertices that the camera sees. Not called without photons of
        the kind `seen_caustic`."""

    def mean_photon_count(self, kind: str, radius: float) -> float:
        """Photons of a kind within `radius` of a vertex, on average; volume photons along beams: of
        a path's way through media."""

    def gather(
        self, radii: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """What photons bring for the radii of each kind, corrected at edges where the setting says
        so: mean over the channels, (radii, groups of camera paths, pixels). And the
        second moment of one camera path that meets the light of caustic photons by chance, (groups,
        pixels); None where nobody asks."""

    def direct(self) -> np.ndarray:
        """Light that neither photons bring nor other paths see: mean over the channels, (groups,
        pixels)."""

    def joined(self) -> np.ndarray:
        """Light of photons that are joined with the sensor: mean over the channels, (groups,
        pixels). Not called where none are."""


class PilotPasses(Protocol):
    """What a pilot needs of a renderer."""

    def trace(self, number: int) -> PilotIteration:
        """Traces the light and camera sub-paths of iteration `number`, which has random numbers of
        its own."""

    def seen(self) -> np.ndarray:
        """Light that other paths see, which have numbers of their own: mean over the channels,
        (pixels,)."""


def run_pilot(
    setting: PilotSetting,
    pixels: PilotPixels,
    passes: PilotPasses,
    now: Callable[[], float] = time.perf_counter,
    settled: Callable[[PilotResult], bool] | None = None,
) -> PilotResult:
    """Runs as many iterations as the render's plan allows, and returns what they have measured.

    Parameters
    ----------
    setting
        The render that the pilot is for.
    pixels
        Those that it takes: `setting.pilot_pixels`.
    passes
        They trace those pixels, and gather all kinds of the setting.
    now
        The clock [s] of the render, by which the pilot's time is limited.
    settled
        Asked after the fewest iterations: whether what these have measured will do.
    """
    radii: dict[str, np.ndarray] = {}
    photons: dict[str, float] = {}
    gathered: list[dict[str, np.ndarray]] = []
    direct: list[np.ndarray] = []
    chance: list[np.ndarray] = []
    joined: list[np.ndarray] = []

    def result() -> PilotResult:
        samples = None
        if radii or np.any(joined):
            samples = PilotSamples(
                radii,
                photons,
                {kind: np.array([step[kind] for step in gathered]) for kind in gathered[0]},
                np.array(direct),
                passes.seen(),
                np.array(joined) if joined else None,
                np.array(chance) if chance else None,
            )
        return measure(setting, pixels, samples, seconds)

    spent = 0.0
    for done in range(1, MOST_ITERATIONS + 1):
        start = now()
        iteration = passes.trace(PILOT_INDEX + done - 1)
        if done == 1:
            radii, photons = choose_ladder(setting, iteration)
        if radii or setting.joins_sensor:
            estimates, moment = iteration.gather(radii)
            gathered.append(estimates)
            direct.append(iteration.direct())
            if moment is not None:
                chance.append(moment)
        if setting.joins_sensor:
            joined.append(iteration.joined())
        del iteration  # its photons' memory is free for those of the next
        seconds = now() - start
        spent += seconds if done > 1 else 0.0
        if not direct or has_enough(setting, done, spent):
            break
        if settled is not None and done == FEWEST_ITERATIONS and settled(found := result()):
            return found
    return result()


def has_enough(setting: PilotSetting, done: int, seconds: float) -> bool:
    """Whether so many iterations, which took so many seconds, are all that the pilot may have."""
    if done < FEWEST_ITERATIONS:
        return False
    if setting.seconds is not None:
        return seconds > PILOT_TIME_SHARE * setting.seconds
    return done >= PILOT_TIME_SHARE * setting.planned_iterations


def choose_ladder(
    setting: PilotSetting, iteration: PilotIteration
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """By kind the radii to try, and the photons within the largest of a vertex, on average. No
    radii for kinds that no camera path gathers.

    Photons on surfaces share their radii; volume photons have their own. Where photons have disks
    of a pixel's size, a single one is the largest of nearly all of these, but no larger than any
    radius that suits the scene: a film may have one pixel.
    """
    on_surfaces = [kind for kind in setting.kinds if kind not in ("volume", "seen_caustic")]
    radii, photons = ladder_on_surfaces(setting, on_surfaces, iteration)
    if "seen_caustic" in setting.kinds and len(widths := iteration.pixel_widths()):
        radius = min(float(np.quantile(widths, NEARLY_ALL)), largest_radius(setting.extent))
        radii["seen_caustic"] = np.array([radius])
        photons["seen_caustic"] = iteration.mean_photon_count("seen_caustic", radius)
    if "volume" in setting.kinds:
        largest = largest_radius(setting.extent)
        probe = largest / PROBED_SHARE
        power = setting.dimensions("volume")
        count = iteration.mean_photon_count("volume", probe) * PROBED_SHARE**power
        if count > 0:
            largest *= min((MOST_PHOTONS / count) ** (1 / power), 1)
            radii["volume"] = ladder_from(largest)
            photons["volume"] = min(count, MOST_PHOTONS)
    return radii, photons


def ladder_on_surfaces(
    setting: PilotSetting, kinds: list[str], iteration: PilotIteration
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """`choose_ladder` for the kinds of photons on surfaces."""
    radii = ladder(*iteration.points())
    if radii is None or not kinds:
        return {}, {}

    def count(radii: np.ndarray) -> dict[str, float]:
        return {kind: iteration.mean_photon_count(kind, float(radii[-1])) for kind in kinds}

    photons = count(radii)
    largest = largest_radius(setting.extent)
    while (most := max(photons.values())) < FEWEST_PHOTONS and radii[-1] < largest:
        radii = radii * min(WIDER, largest / radii[-1])
        photons = count(radii)
    if most > MOST_PHOTONS:
        radii = radii * (MOST_PHOTONS / most) ** 0.5
        photons = {kind: n * MOST_PHOTONS / most for kind, n in photons.items()}
    return dict.fromkeys(kinds, radii), photons
