"""What a pilot has measured, and the choice that follows from it. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from .cost import iteration_cost
from .noise import MEASURES, direct_variance, shrink_to_neighbours
from .radius import ErrorByRadius, best_radius, error_by_radius, middle_index
from .setting import PilotPixels, PilotSetting, neighbourhoods

Radii = TypeVar("Radii", float, np.ndarray)

RADIUS_WITHOUT_VERTICES = 1e-3
"""The radius where no camera path meets a surface that gathers, in units of the scene's extent."""


class PilotSamples(NamedTuple):
    """The estimates of all iterations of a pilot: mean over the channels of radiance."""

    ladder: dict[str, np.ndarray]
    """By kind: (radii,), ascending. Kinds that no camera path gathers are missing here, and
    below."""
    photons: dict[str, float]
    """By kind: photons within the ladder's largest radius of a vertex, on average."""
    gathered: dict[str, np.ndarray]
    """By kind: what photons bring, (iterations, radii, groups of camera paths, pixels)."""
    direct: np.ndarray
    """Light that neither photons bring nor other paths see, (iterations, groups, pixels)."""
    seen: np.ndarray
    """Light that other paths see, (pixels,)."""
    joined: np.ndarray | None = None
    """Light of photons that are joined with the sensor, (iterations, groups, pixels); None where
    none are."""
    chance: np.ndarray | None = None
    """Second moment of one camera path that meets the light of caustic photons by chance,
    (iterations, groups, pixels); None where nobody asks."""


class PredictedError(NamedTuple):
    """Of a render with a choice, in one of `noise.MEASURES`."""

    squared_bias: float
    variance: float
    """Of one iteration; that of other paths, which see direct light, is not in what a pilot
    measures."""

    def after(self, iterations: float) -> float:
        """Mean squared error of so many iterations: bias^2 + V / n."""
        return self.squared_bias + self.variance / max(iterations, 1)


class Prediction(NamedTuple):
    """What is predicted of a render with a choice."""

    errors: dict[str, PredictedError]
    """By measure."""
    photon_light: float
    """What photons bring to a pixel, on average."""
    gathered: float
    """Photons within a vertex's merge disks."""
    iterations: float
    """Those that there is time for."""
    mean: np.ndarray
    """(pixels,)"""
    pixels: PilotPixels
    """Those of the pilot."""
    caustic_share: float
    """Share of the light that caustic photons bring."""
    chance: dict[str, float]
    """By measure: the error of one camera path by the light of caustic photons, which it meets by
    chance; empty where nobody asks."""


@dataclass(frozen=True)
class Choice:
    """Radii by kind of photons, and what is predicted of them: None where no camera path meets a
    surface that gathers."""

    radii: dict[str, float]
    prediction: Prediction | None
    light_share: float = 1.0
    """Of the light sub-paths, those that an iteration has."""


@dataclass(frozen=True)
class PilotResult:
    """What a pilot has measured (made by `measure`), and the choices that follow from it. The
    dictionaries are empty where no camera path meets a surface that gathers. Measures are
    `noise.MEASURES`."""

    setting: PilotSetting
    pixels: PilotPixels
    seconds: float
    """Of the pilot's last iteration."""
    photons: dict[str, float]
    """As in `PilotSamples`, but of an iteration of the render with all its light sub-paths."""
    errors: dict[str, dict[str, ErrorByRadius]]
    """By measure, and by kind of photons."""
    direct: dict[str, float]
    """By measure: variance, in an iteration, of the light that `PilotSamples.direct` is."""
    joined: dict[str, float]
    """By measure: that of `PilotSamples.joined`, with all light sub-paths."""
    mean: np.ndarray
    """(pixels,): radiance."""
    photon_light: float
    """What photons bring to a pixel, on average."""
    caustic_share: float
    chance: dict[str, float]
    """As of `Prediction`."""

    def choose(self, count: float, kept: Choice | None = None, reluctance: float = 0.0) -> Choice:
        """The choice with the least product of the predicted errors, see `_measures`.

        Parameters
        ----------
        count
            Iterations of usual cost that there is time for.
        kept
            A choice that is kept, kind by kind, unless the errors fall by more than the share
            `reluctance`; and so is its share of the light sub-paths.

        Where there is a time limit, only whole iterations count, so that one fits if any share of
        the light sub-paths lets it.
        """
        best, least = None, math.inf
        for share in self.setting.light_shares:
            used = kept if kept is not None and kept.light_share == share else None
            choice = self._choose(share, count, used, reluctance)
            error = self._error(choice)
            if used is not None:
                less = (1 - reluctance) ** len(self._measures)
                error = error * less if reluctance < 1 else 0.0
            if error < least or least == math.inf:  # as long as none fits, the shortest
                best, least = choice, error
        assert best is not None
        return best

    def _error(self, choice: Choice) -> float:
        """The product of a choice's predicted errors; infinite where no iteration fits."""
        if choice.prediction is None:
            return 0.0
        count = choice.prediction.iterations
        if self.setting.seconds is not None:
            count = math.floor(count)
        errors = choice.prediction.errors
        if count <= 0:
            return math.inf
        return math.prod(errors[measure].after(count) for measure in self._measures)

    def _choose(self, share: float, count: float, kept: Choice | None, reluctance: float) -> Choice:
        """The same with this `share` of the light sub-paths."""
        radius = RADIUS_WITHOUT_VERTICES * self.setting.extent
        if not self.errors:
            kinds = self.setting.kinds
            return Choice(dict.fromkeys(kinds, radius), None)
        chosen = {
            kind: self._best_radius(kind, share, count, kept, reluctance) for kind in self._met
        }
        radii = {kind: chosen.get(kind, radius) for kind in self.setting.kinds}
        choice = Choice(radii, None, share)
        return replace(choice, prediction=self._predict(choice, count))

    @property
    def _measures(self) -> list[str]:
        """The measures of error that decide: both, or relative errors alone where gathers are at
        deeper vertices. These are spread over the scene, and blur close to a lamp averages out;
        absolute errors are then rare noise, of which a pilot knows too little."""
        return list(MEASURES) if self.setting.at_first_vertex else ["relmse"]

    @property
    def _met(self) -> list[str]:
        """The kinds of photons that camera paths gather."""
        return list(self.errors["relmse"])

    def _best_radius(
        self, kind: str, share: float, count: float, kept: Choice | None, reluctance: float
    ) -> float:
        """The radius for one kind of photons, with a `share` of the light sub-paths."""

        def iterations(radius: np.ndarray) -> np.ndarray:
            return np.maximum(count / self._cost(kind, radius, share), 1)

        used = None if kept is None else kept.radii[kind]
        errors = [self.errors[measure][kind] for measure in self._measures]
        return best_radius(errors, iterations, used, reluctance, share)

    def _predict(self, choice: Choice, count: float) -> Prediction:
        """The `Prediction` for a choice."""
        errors, share = {}, choice.light_share
        for measure, by_kind in self.errors.items():
            found = [by_kind[kind].at(choice.radii[kind], share) for kind in by_kind]
            errors[measure] = PredictedError(
                sum(squared_bias for squared_bias, _ in found),
                self.direct[measure]
                + self.joined[measure] / share
                + sum(variance for _, variance in found),
            )
        return Prediction(
            errors,
            self.photon_light,
            sum(self.gathered(kind, choice.radii[kind], share) for kind in self._met),
            count / self.cost(choice),
            self.mean,
            self.pixels,
            self.caustic_share,
            self.chance,
        )

    def gathered(self, kind: str, radius: Radii, share: float) -> Radii:
        """Photons of a kind within `radius` of a vertex, on average, of that `share` of the light
        sub-paths."""
        share_of_radius = radius / self.errors["relmse"][kind].ladder[-1]
        return share * self.photons[kind] * share_of_radius ** self.setting.dimensions(kind)

    def _cost(self, kind: str, radius: Radii, share: float) -> Radii:
        """Cost of an iteration by one kind of photons, see `cost`."""
        gathered, corrects = self.gathered(kind, radius, share), self.setting.corrects(kind)
        return iteration_cost(gathered, corrects, self.setting.camera_paths, share)

    def cost(self, choice: Choice) -> float:
        """Cost of an iteration with the radii of a choice, see `cost`."""
        return max(
            (
                self._cost(kind, radius, choice.light_share)
                for kind, radius in choice.radii.items()
                if kind in self._met
            ),
            default=iteration_cost(0.0, False, self.setting.camera_paths, choice.light_share),
        )


def measure(
    setting: PilotSetting,
    pixels: PilotPixels,
    samples: PilotSamples | None,
    seconds: float,
) -> PilotResult:
    """The `PilotResult` of all samples of a pilot; of `None`, where no camera path meets a surface
    that gathers."""
    if samples is None:
        nothing = np.zeros(pixels.count)
        return PilotResult(setting, pixels, seconds, {}, {}, {}, {}, nothing, 0.0, 0.0, {})
    middle = {
        kind: samples.gathered[kind][:, middle_index(ladder)].mean(axis=1)
        for kind, ladder in samples.ladder.items()
    }  # (iterations, pixels)
    of_photons = sum(middle.values())
    if samples.joined is not None:
        of_photons = of_photons + samples.joined.mean(axis=1)
    image = samples.direct.mean(axis=1) + of_photons
    mean = samples.seen + shrink_to_neighbours(image, neighbourhoods(setting.width, pixels))
    weights = {measure: weigh(mean) for measure, weigh in MEASURES.items()}
    errors: dict[str, dict[str, ErrorByRadius]] = {measure: {} for measure in MEASURES}
    for kind, ladder in samples.ladder.items():
        for measure in MEASURES:
            errors[measure][kind] = error_by_radius(
                ladder,
                samples.gathered[kind],
                weights[measure],
                (setting.at_first_vertex and not setting.passes_lobes) or kind == "seen_caustic",
                kind == "caustic",
                setting.light_paths,
                setting.filter_share,
                setting.least_bias(kind),
            )
    caustics = sum(np.mean(middle[kind]) for kind in ("seen_caustic", "caustic") if kind in middle)
    return PilotResult(
        setting,
        pixels,
        seconds,
        {kind: count * setting.light_paths for kind, count in samples.photons.items()},
        errors,
        {
            measure: setting.filter_share * direct_variance(samples.direct, weights[measure])
            for measure in MEASURES
        },
        {
            measure: direct_variance(samples.joined, weights[measure]) / setting.light_paths
            if samples.joined is not None
            else 0.0
            for measure in MEASURES
        },
        mean,
        float(np.mean(of_photons)),
        float(caustics / max(np.mean(mean), 1e-30)),
        {
            measure: float(np.mean(weights[measure] * samples.chance.mean(axis=(0, 1))))
            for measure in MEASURES
        }
        if samples.chance is not None
        else {},
    )
