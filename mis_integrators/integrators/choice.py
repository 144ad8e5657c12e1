"""The choice of `bdpm_auto`: which integrator will have the least error in the time that there is,
predicted from a pilot.

Every candidate is tried on the same few thousand pixels. Its error after n iterations is its
squared bias (the blur of the photons' disks) plus its variance over n, both relative and pixel by
pixel (`pilot.radius`); n follows from what an iteration costs (`costs`). Candidates that cannot
see some of the light are not tried.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from ..core.recording import lanes
from ..core.spectra import channel_mean
from ..core.stratified_variance import contrasts, extrapolated
from ..paths.layers import written
from ..paths.path_length_statistics import mean_segments
from ..pilot.denoiser import LEFT
from ..pilot.noise import relative_weights, trimmed_mean
from ..pilot.run import FEWEST_ITERATIONS
from ..pilot.setting import UNPLANNED_ITERATIONS
from . import costs
from .bdpm import Survey
from .unidirectional import PathSession

PHOTON_MAPPERS = FIRST, OPT2, LATER, OPT3 = (
    ("bdpm", {"bdd": 0}),
    ("bdpm_opt2", {}),
    ("bdpm", {"bdd": 1}),
    ("bdpm_opt3", {}),
)
"""The first is tried in any case."""
CANDIDATES = ("path", {}), *PHOTON_MAPPERS
TRIAL_TIME_SHARE = 0.05
"""Tuned: share of the planned time that the pilot may have; `path` and the first photon mapper are
tried however long that takes."""
WORTH_SHARE = 0.3
"""Tuned: the share of the time that is left that the trial of optimal weights may take, where they
are of use: they often win, by more than their trial takes."""
LIKE_THE_FIRST = 1.5
"""Tuned: what trying another photon mapper takes, in the seconds that the first one took, which has
rendered its first iterations (optimal weights have to learn first)."""
PATH_TRIALS = 16
"""Tuned: samples of `path` on each of the pilot's pixels; a power of two."""
TRIAL_INDEX = 1 << 28
"""Iteration number of these samples: consecutive in the pixels' sequences."""
UNSEEN = 1e-3
"""Tuned: share of the light, brought by caustics, from which on a `path` that cannot see them is
out of the question."""
RARE = 0.02
"""Tuned: the same for a `path` that meets them by chance only: so seldom that a pilot does not see
how noisy they are."""


@dataclass
class Decision:
    """What renders, why it does, and what was expected of all that were tried."""

    plugin: str
    parameters: dict
    session: object
    reasons: list[str]
    errors: dict[str, float] = field(default_factory=dict)
    """Relative mean squared errors predicted, by candidate."""
    trials: list[Trial] = field(default_factory=list)
    usual_cost: float = 0.0
    """Of an iteration of the first photon mapper, a pixel; the time planned for is counted in
    those."""


@dataclass
class Trial:
    """What the pilot tells of one candidate."""

    plugin: str
    parameters: dict
    session: object
    """None once another is chosen."""
    squared_bias: float
    variance: float
    cost: float
    """Of one iteration, a pixel."""

    @property
    def name(self):
        return name_of(self.plugin, self.parameters)

    def error(self, budget):
        """Relative mean squared error when the cost a pixel is `budget`."""
        return self.squared_bias + self.variance * self.cost / budget


def handed_on(integrator):
    """The parameters that every integrator of this package shares, that of media among them."""
    return {
        name: getattr(integrator, name)
        for name in (
            "max_depth",
            "rr_depth",
            "hide_emitters",
            "camera_paths",
            "variance",
            "sampler",
        )
    }


def name_of(plugin, parameters):
    """A candidate's name: its plugin, and how it differs from the plugin's defaults."""
    return " ".join([plugin, *(f"{name}={value}" for name, value in parameters.items())])


def choose(integrator, scene, sensor, seed, iterations, seconds):
    """The `Decision` for a render of so many iterations, or of so many seconds (either may be
    `None`)."""
    began = time.perf_counter()
    path = PathSession(integrator, scene, sensor, seed, iterations)
    plugin, parameters = FIRST
    first = new_session(plugin, parameters, integrator, scene, sensor, seed, iterations)
    split = integrator.splits_light
    if not first.kinds():
        chosen = (plugin, parameters, first) if split else ("path", {}, path)
        reason = _no_photons(integrator, first)
        return Decision(*chosen, [f"{name_of(*chosen[:2])}: {reason}"])
    first.plan_time(seconds, began)
    first.start()
    prediction = first.prediction
    if prediction is None:
        chosen = (plugin, parameters, first) if split else ("path", {}, path)
        reason = "no camera path meets a surface that scatters smoothly"
        return Decision(*chosen, [f"{name_of(*chosen[:2])}: {reason}"])
    first_seconds = time.perf_counter() - began

    pixels = prediction.pixels
    segments = mean_segments(
        scene,
        sensor,
        seed,
        pixels.stride,
        pixels.count,
        integrator.max_depth,
        integrator.rr_depth,
    )
    trials, reasons = [_trial(plugin, parameters, first, segments)], []
    spent, usual = _pilot_cost(first, segments), trials[0].cost
    budget = (prediction.iterations if seconds else iterations or UNPLANNED_ITERATIONS) * usual
    blind = "not path: it does not split the light" if split else None
    blind = blind or _why_not_path(first, prediction)
    if blind:
        reasons.append(blind)
    else:
        trials.insert(0, _try_path(path, segments, pixels, prediction.mean, budget))
    likely = True  # that the first of the candidates with optimal weights is the best
    survey = Survey(first.traits, first.lights, prediction.mean, first.direct_light.noise)
    for plugin, parameters in later_candidates(first.traits):
        weighted = plugin.startswith("bdpm_opt")
        if seconds is None:
            time_of_trials = budget, spent, FEWEST_ITERATIONS * usual * 0.5
        else:
            time_of_trials = seconds, time.perf_counter() - began, LIKE_THE_FIRST * first_seconds
        reason = _why_useless(plugin, first.traits, trials, budget) or _why_too_dear(
            weighted and likely, *time_of_trials
        )
        if reason:
            reasons.append(f"not {name_of(plugin, parameters)}: {reason}")
            continue
        likely &= not weighted
        planned = max(int(budget / usual), 1)
        session = new_session(plugin, parameters, integrator, scene, sensor, seed, planned, survey)
        session.plan_time(seconds, began)
        session.rehearse()
        if session.prediction is not None:
            trials.append(_trial(plugin, parameters, session, segments))
            spent += _pilot_cost(session, segments)
    return _decision(trials, reasons, budget, usual, iterations)


def _decision(trials, reasons, budget, usual, iterations):
    """The `Decision` for the trial with the least error predicted for this budget."""
    best = min(trials, key=lambda trial: trial.error(budget))
    why = (
        f"{best.name}: least predicted error in this time; bias {best.squared_bias:.2g}, noise "
        f"{best.variance * best.cost / budget:.2g} (squared, relative)"
    )
    best.session.iterations_planned = iterations
    for trial in trials:
        if trial is not best:
            trial.session = None  # its photons' and kernels' memory is free to go
    predicted = {trial.name: float(trial.error(budget)) for trial in trials}
    errors = {name: error for name, error in predicted.items() if math.isfinite(error)}
    return Decision(
        best.plugin, best.parameters, best.session, [why, *reasons], errors, trials, usual
    )


def _why_useless(plugin, traits, trials, budget):
    """Why this candidate cannot be the best, given the `trials` so far; `None` if it can."""
    if plugin.startswith("bdpm_opt") and not traits.has_rough:
        return "all smooth surfaces are diffuse, where one strategy does as well"
    if (
        plugin == "bdpm_opt3"
        and not traits.has_mixed
        and trials[-1].name.endswith("bdd=1")
        and _worse(trials, budget)
    ):
        return "merging at the second vertex does not pay, let alone at the third"
    return None


def _why_too_dear(likely, whole, gone, takes):
    """Why there is no time for a trial that `takes` so much, where so much of the `whole` is
    `gone`; `None` if there is. A candidate that is `likely` to be the best may take more."""
    if gone + takes <= TRIAL_TIME_SHARE * whole or (
        likely and takes < WORTH_SHARE * (whole - gone)
    ):
        return None
    share = WORTH_SHARE if likely else TRIAL_TIME_SHARE
    return f"trying it would take more than {share:.0%} of the time"


def later_candidates(traits):
    """Photon mappers, those first that are most often the best. Within and behind rough glass
    camera paths meet it twice before photons are of use: three strategies."""
    return (OPT3, OPT2, LATER) if traits.has_rough_glass else (OPT2, LATER, OPT3)


def new_session(plugin, parameters, integrator, scene, sensor, seed, iterations, survey=None):
    """A session of a candidate, with the parameters of `integrator` that all share; `survey` as in
    `BDPM`."""
    if plugin == "path":
        return PathSession(integrator, scene, sensor, seed, iterations)
    shared = {
        **handed_on(integrator),
        "camera_paths": integrator.initial_camera_paths,
        "denoised": integrator.denoised,
        "aovs": written(integrator.layers),
    }
    made = mi.load_dict({"type": plugin, **shared, **parameters})
    made.survey = survey
    return made.new_session(scene, sensor, seed, iterations)


def _no_photons(integrator, session):
    if session.lights.dark:
        return "the scene has no light"
    return f"light of at most {integrator.max_depth} segments needs no photons"


def _why_not_path(session, prediction):
    """Why `path` is not tried, in one line; `None` if it is."""
    if not session.has_caustics:
        return None
    if not session.traits.has_light_surfaces or session.lights.needs_photons_for_direct_light():
        if prediction.caustic_share > UNSEEN:
            return (
                f"not path: it cannot see the caustics, {prediction.caustic_share:.1%} of the light"
            )
    elif prediction.caustic_share > RARE:
        return (
            f"not path: it would meet the caustics, {prediction.caustic_share:.1%} of the "
            "light, by chance only"
        )
    return None


def _trial(plugin, parameters, session, segments):
    prediction = session.prediction
    counted = costs.events(session, segments, session.last_vertex, prediction.gathered)
    return Trial(
        plugin,
        parameters,
        session,
        prediction.squared_bias,
        prediction.variance,
        costs.cost(plugin, counted) + costs.of_direct_paths(session, segments),
    )


def _pilot_cost(session, segments):
    """What a session's pilot took, a pixel: its light passes are whole, its camera paths few."""
    _, light, _, _ = costs.events(session, segments, session.last_vertex, 0.0)
    plugin = session.integrator.plugin
    return session.prediction.pilot_iterations * costs.cost(plugin, (0.0, light, 0.0, 1.0))


def _try_path(path, segments, pixels, mean, budget):
    """`path` on the pilot's pixels, for a render of this `budget`."""
    passes = (
        PATH_TRIALS if mi.is_spectral else 1
    )  # wavelengths are shared by all that is traced at once
    at_once = PATH_TRIALS // passes
    count, stride = pixels.count, pixels.stride * path.camera_paths
    trial = lanes(at_once * count) // count
    values = []
    first = trial * (-count * stride % 2**32)  # back to the first pixel
    for number in range(passes):
        spectral = path._spectral(TRIAL_INDEX + number)
        radiance, *_ = path.trace(
            TRIAL_INDEX, first, stride, at_once * count, spectral, trial + number
        )
        values += list(
            np.broadcast_to(np.array(channel_mean(radiance)), at_once * count).reshape(
                at_once, count
            )
        )
    cost = costs.cost("path", costs.events(path, segments, None, 0.0))
    samples = max(round(budget / cost), 1)
    values, weights = np.array(values), relative_weights(mean)
    if path.integrator.low_discrepancy:  # `Trial.error` divides by the samples
        variance = samples * _variance_of_samples(values, weights, samples)
    else:
        variance = trimmed_mean(weights * np.var(values, axis=0, ddof=1))
    variance *= LEFT if path.integrator.denoised else 1
    return Trial("path", {}, path, 0.0, variance / path.camera_paths, cost * path.camera_paths)


def _variance_of_samples(values, weights, samples):
    """Relative variance of the mean of so many samples a pixel: what `values` (trials, pixels) of
    samples that are consecutive in the pixels' sequences extrapolate to."""
    lengths, found, counts = contrasts(values, np.ones(len(values), bool), 1)
    pooled = [[trimmed_mean(weights * contrast)] for contrast in found]
    return float(extrapolated(lengths, np.array(pooled), counts, samples)[0])


def _worse(trials, budget):
    """Whether the last trial is worse than the best by more than a pilot may err."""
    return trials[-1].error(budget) > 2 * min(trial.error(budget) for trial in trials)
