"""What a pilot has measured, and the choice that follows from it: radii, corrections at edges, and
camera paths. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from .cost import CAMERA_SHARE, LEAST_CAMERA_SHARE, iteration_cost, measured_camera_share
from .noise import (
    direct_variance,
    relative_weights,
    shrink_to_neighbours,
    variance_between_camera_paths,
)
from .radius import ErrorByRadius, RadiusChoice, best_radius, error_by_radius, middle_index
from .setting import PilotPixels, PilotSetting, neighbourhoods

Radii = TypeVar("Radii", float, np.ndarray)

NUMBERS_OF_PATHS = (1, 2, 4, 8)
"""Tuned: camera paths a pixel and iteration that are considered."""
LONG = 16
"""Tuned: several camera paths are tried only in renders with time for more iterations than
this."""
WORTH_TRYING = 0.92
"""Tuned: two camera paths are tried where the best number is expected to make the error smaller by
this factor, if a camera path costs the least that it may."""
WORTH_CHANGING = 0.95
"""Tuned: another number than was tried must make it smaller by this factor."""
RADIUS_WITHOUT_VERTICES = 1e-3
"""The radius where no camera path meets a surface that gathers, in units of the scene's extent."""


class PilotSamples(NamedTuple):
    """The estimates of all iterations of a pilot: mean over the channels of radiance."""

    ladder: np.ndarray
    """(radii,), ascending."""
    photons: dict[str, float]
    """By kind: photons within the ladder's largest radius of a vertex, on average."""
    gathered: dict[tuple[str, bool], np.ndarray]
    """By kind and whether they are corrected at edges: what photons bring, (iterations, radii,
    camera paths, pixels)."""
    direct: np.ndarray
    """Light that does not come from photons, (iterations, camera paths, pixels)."""


class Prediction(NamedTuple):
    """What is predicted of a render with a choice; errors are relative, by `relative_weights` of
    `mean`."""

    squared_bias: float
    variance: float
    """Of one iteration, light that does not come from photons included."""
    direct: float
    """The part of it that such light has."""
    photon_light: float
    """What photons bring to a pixel, on average."""
    gathered: float
    """Photons within a vertex's merge disks."""
    iterations: float
    """Those that there is time for."""
    cost_of_paths: float
    """What an iteration costs with its camera paths, in units of one with one a pixel."""
    mean: np.ndarray
    """(pixels,)"""
    pixels: PilotPixels
    """Those of the pilot."""
    caustic_share: float
    """Share of the light that caustic photons bring."""
    pilot_iterations: int

    @property
    def error(self) -> float:
        """Relative mean squared error of the render: bias^2 + V / n."""
        return self.squared_bias + self.variance / max(self.iterations, 1)


@dataclass(frozen=True)
class Choice:
    """Radii and corrections at edges by kind of photons, camera paths a pixel and iteration, and
    what is predicted of them: None where no camera path meets a surface that gathers."""

    radii: dict[str, float]
    corrected: dict[str, bool]
    camera_paths: int
    prediction: Prediction | None


@dataclass(frozen=True)
class PilotResult:
    """What a pilot has measured (made by `measure`), and the choices that follow from it. The
    dictionaries are empty where no camera path meets a surface that gathers."""

    setting: PilotSetting
    pixels: PilotPixels
    iterations: int
    """Of the pilot."""
    seconds: float
    """Of its last iteration."""
    photons: dict[str, float]
    """As in `PilotSamples`."""
    errors: dict[str, ErrorByRadius]
    """By kind of photons."""
    between_paths: dict[str, dict[bool, np.ndarray]]
    """By kind of photons and whether they are corrected at edges: relative variance between camera
    paths that share photons, one a radius."""
    direct: float
    """Relative variance of the light of a camera path that does not come from photons."""
    mean: np.ndarray
    """(pixels,): the radiance that errors are relative to."""
    photon_light: float
    """What photons bring to a pixel, on average."""
    caustic_share: float

    def choose(
        self,
        count: float,
        camera_paths: int | None = None,
        camera_share: float = CAMERA_SHARE,
        kept: Choice | None = None,
        reluctance: float = 0.0,
    ) -> Choice:
        """The choice with the least predicted error.

        Parameters
        ----------
        count
            Iterations of usual cost that there is time for.
        camera_paths
            Of a pixel and iteration (None: as in the setting).
        camera_share
            Cost of a camera path, see `cost.iteration_cost`.
        kept
            A choice that is kept, kind by kind, unless the error falls by more than the share
            `reluctance`.
        """
        camera_paths = camera_paths or self.setting.camera_paths
        if not self.errors:
            radius = RADIUS_WITHOUT_VERTICES * self.setting.extent
            kinds = self.setting.kinds
            return Choice(
                dict.fromkeys(kinds, radius), dict.fromkeys(kinds, False), camera_paths, None
            )
        chosen = {
            kind: self._best_radius(kind, count, camera_paths, camera_share, kept, reluctance)
            for kind in self.errors
        }
        choice = Choice(
            {kind: found.radius for kind, found in chosen.items()},
            {kind: found.corrected for kind, found in chosen.items()},
            camera_paths,
            None,
        )
        prediction = self._predict(choice, list(chosen.values()), count, camera_share)
        return replace(choice, prediction=prediction)

    def _best_radius(
        self,
        kind: str,
        count: float,
        camera_paths: int,
        camera_share: float,
        kept: Choice | None,
        reluctance: float,
    ) -> RadiusChoice:
        """The `RadiusChoice` for one kind of photons."""

        def iterations(radius: np.ndarray, corrected: bool) -> np.ndarray:
            gathered = self.gathered(kind, radius)
            return np.maximum(
                count / iteration_cost(gathered, corrected, camera_paths, camera_share), 1
            )

        more_noise = {
            corrected: noise * (1 / camera_paths - 1 / self.pixels.camera_paths)
            for corrected, noise in self.between_paths[kind].items()
        }
        used = None if kept is None else (kept.radii[kind], kept.corrected[kind])
        return best_radius(self.errors[kind], iterations, used, reluctance, more_noise)

    def _predict(
        self, choice: Choice, chosen: list[RadiusChoice], count: float, camera_share: float
    ) -> Prediction:
        """The `Prediction` for a choice, made of those for its kinds of photons."""
        cost, cost_of_one = (
            self.cost(choice, number, camera_share) for number in (choice.camera_paths, 1)
        )
        direct = self.direct / choice.camera_paths
        return Prediction(
            sum(found.squared_bias for found in chosen),
            direct + sum(found.variance for found in chosen),
            direct,
            self.photon_light,
            sum(self.gathered(kind, radius) for kind, radius in choice.radii.items()),
            count / cost,
            cost / cost_of_one,
            self.mean,
            self.pixels,
            self.caustic_share,
            self.iterations,
        )

    def gathered(self, kind: str, radius: Radii) -> Radii:
        """Photons of a kind within `radius` of a vertex, on average."""
        return self.photons[kind] * (radius / self.errors[kind].ladder[-1]) ** 2

    def cost(self, choice: Choice, camera_paths: int, camera_share: float = CAMERA_SHARE) -> float:
        """Cost of an iteration with the radii and corrections of a choice, see `cost`."""
        return max(
            (
                iteration_cost(
                    self.gathered(kind, radius), choice.corrected[kind], camera_paths, camera_share
                )
                for kind, radius in choice.radii.items()
                if kind in self.errors
            ),
            default=1.0,
        )

    def two_camera_paths_may_pay(self, count: float, iterations: float) -> bool:
        """Whether it is worth while to measure what a second camera path a pixel costs, where there
        is time for `count` iterations of usual cost, and for so many like the first."""
        if not self.errors or not self.setting.chooses_camera_paths or iterations <= LONG:
            return False
        hoped = self._errors_by_camera_paths(count, LEAST_CAMERA_SHARE)
        return min(hoped.values()) <= WORTH_TRYING * hoped[1]

    def camera_share(self, choice: Choice, ratio: float) -> float:
        """Cost of a camera path, where an iteration of two a pixel takes `ratio` times as long as
        one of one with the same choice."""
        assumed = LEAST_CAMERA_SHARE
        of_one, of_two = (self.cost(choice, number, assumed) for number in (1, 2))
        return measured_camera_share(of_one, of_two, ratio, assumed)

    def best_camera_paths(self, count: float, camera_share: float) -> int:
        """The number of camera paths a pixel and iteration with the least predicted error; two,
        which have been tried, unless another number's is clearly below theirs."""
        errors = self._errors_by_camera_paths(count, camera_share)
        return min(
            errors, key=lambda number: errors[number] / (1 if number == 2 else WORTH_CHANGING)
        )

    def _errors_by_camera_paths(self, count: float, camera_share: float) -> dict[int, float]:
        predictions = {
            number: self.choose(count, number, camera_share).prediction
            for number in NUMBERS_OF_PATHS
        }
        return {number: found.error for number, found in predictions.items() if found is not None}


def measure(
    setting: PilotSetting,
    pixels: PilotPixels,
    samples: PilotSamples | None,
    iterations: int,
    seconds: float,
) -> PilotResult:
    """The `PilotResult` of all samples of a pilot; of `None`, where no camera path meets a surface
    that gathers."""
    if samples is None:
        nothing = np.zeros(pixels.count)
        return PilotResult(setting, pixels, iterations, seconds, {}, {}, {}, 0.0, nothing, 0.0, 0.0)
    middle = {
        kind: samples.gathered[kind, False][:, middle_index(samples.ladder)]
        for kind in setting.kinds
    }  # (iterations, camera paths, pixels)
    mean = setting.mean
    if mean is None:
        image = samples.direct.mean(axis=1) + sum(part.mean(axis=1) for part in middle.values())
        mean = shrink_to_neighbours(image, neighbourhoods(setting.width, pixels))
    weights = relative_weights(mean)
    errors = {}
    for kind in setting.kinds:
        by_correction = {
            corrected: samples.gathered[kind, corrected].mean(axis=2)
            for corrected in setting.corrections(kind)
        }
        errors[kind] = error_by_radius(
            samples.ladder,
            by_correction[False],
            by_correction.get(True),
            mean,
            setting.at_first_vertex,
            kind == "caustic",
        )
    between_paths = {
        kind: {
            corrected: variance_between_camera_paths(samples.gathered[kind, corrected], weights)
            for corrected in setting.corrections(kind)
        }
        for kind in setting.kinds
    }
    caustics = np.mean(middle["caustic"]) if "caustic" in middle else 0.0
    return PilotResult(
        setting,
        pixels,
        iterations,
        seconds,
        samples.photons,
        errors,
        between_paths,
        direct_variance(samples.direct, weights),
        mean,
        float(sum(np.mean(part) for part in middle.values())),
        float(caustics / max(np.mean(mean), 1e-30)),
    )
