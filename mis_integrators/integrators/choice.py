"""The choice of `bdpm_auto`: photons, or camera paths alone.

Both are judged on the same few thousand pixels, and in raw images by their first iterations where
these tell more (`film_trial`). Their errors after n iterations are the squared
bias (the blur of the photons' disks) plus the variance over n (`pilot.radius`); n follows from what
an iteration costs: its seconds in a render of a given time, else counted events (`costs`). There
are two measures of error, relative and absolute (`pilot.noise`), and what has the least product of
both renders: the other would lose more in one of them than it wins in the other.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.clock import now
from ..core.recording import lanes
from ..core.spectra import channel_mean
from ..core.stratified_variance import contrasts, variance_by_power
from ..core.traits import SceneTraits, UnsupportedScene
from ..paths.camera import film_sample_count, film_size
from ..paths.layers import written
from ..paths.path_length_statistics import mean_segments
from ..pilot.noise import MEASURES, shrink_to_neighbours, trimmed_mean
from ..pilot.setting import UNPLANNED_ITERATIONS, neighbourhoods
from . import costs
from .film_trial import first_images, iterations_ahead, noise_of_mean, weights_by
from .noise_left import noise_left
from .unidirectional import PathSession

CAMERA, PHOTONS = "path", "bdpm"
CANDIDATES = {CAMERA: {}, PHOTONS: {"bdd": 0}}
"""Plugins that may be chosen, and their parameters."""
FOR_DENOISERS = {PHOTONS: {"bdd": 1}}
"""Parameters in place of these where the image will be denoised: nearly all noise is then that of
camera paths, which a denoiser takes away."""
PATH_TRIALS = 16
"""Tuned: samples of `path` on each of the pilot's pixels, and twice as many in a render of a given
time; a power of two."""
TOGETHER = 512
"""Paths of a run that tells the time of all."""
OVERRATED = 2.0
"""Tuned: an iteration of photons may take so many times less than its pilot says (1.1 to 2.2 times
in ten scenes)."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Multiples of this share of a whole are spread evenly, however many there are of them."""
TRIAL_INDEX = 1 << 28
"""Iteration number of these samples: consecutive in the pixels' sequences."""
MOST_INSTANCES = 64
"""Instances of shape groups, more than which leave no choice. Each is a function of its own in each
kernel: compiling takes 0.04 s an instance and kernel, and photons need a dozen kernels."""
UNSEEN = 1e-3
"""Tuned: share of the light, brought by caustics, from which on camera paths that cannot see them
are out of the question."""


@dataclass
class Decision:
    """What renders, why it does, and what was expected of all that were tried."""

    plugin: str
    session: object
    reasons: list[str]
    errors: dict[str, float] = field(default_factory=dict)
    """Predicted, by measure and candidate: "relmse.path"."""
    trials: list[Trial] = field(default_factory=list)
    usual_cost: float = 0.0
    """`Trial.cost` of the photon mapper; the time planned for is counted in those."""


@dataclass
class Trial:
    """What the pilot, or its first iterations, tell of one candidate."""

    plugin: str
    session: object
    """None once another is chosen."""
    parts: dict[str, tuple[float, float]]
    """By measure: squared bias, and variance of one iteration."""
    cost: float
    """Of one iteration: its seconds, or a pixel's segments; 1 where nothing else is tried."""
    done: int = 0
    """Iterations that are rendered already."""

    def count(self, budget):
        """Iterations, with those that are done, when `budget` is left."""
        return self.done + budget / self.cost

    def errors(self, budget):
        """Mean squared errors, by measure, when `budget` is left."""
        return {
            measure: squared_bias + variance / self.count(budget)
            for measure, (squared_bias, variance) in self.parts.items()
        }

    def product(self, budget):
        """Of the errors."""
        return math.prod(self.errors(budget).values())


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


def choose(integrator, scene, sensor, seed, iterations, seconds):
    """The `Decision` for a render of so many iterations, or of so many seconds (either may be
    `None`)."""
    render = integrator, scene, sensor, seed, iterations
    path = new_session(CAMERA, *render)
    if not integrator.splits_light and (reason := too_many_instances(scene)):
        return Decision(CAMERA, path, [f"{CAMERA}: {reason}"])
    try:
        photons = new_session(PHOTONS, *render)
    except UnsupportedScene as refusal:
        if integrator.splits_light:
            raise
        return Decision(CAMERA, path, [f"{CAMERA}: {refusal}"])
    alone = (PHOTONS, photons) if integrator.splits_light else (CAMERA, path)
    if not photons.kinds():
        return Decision(*alone, [f"{alone[0]}: {no_photons(integrator, photons)}"])
    photons.plan_time(seconds)
    if photons.has_caustics and not integrator.splits_light and not camera_paths_are_blind(photons):
        photons.judge_chance()
    contest = Contest(path, photons, iterations, seconds)
    photons.predict(None if integrator.splits_light else contest.is_settled)
    prediction = photons.prediction
    if prediction is None:
        reason = "no camera path meets a surface that scatters smoothly"
        return Decision(*alone, [f"{alone[0]}: {reason}"])
    if excluded := why_not_path(photons):
        planned = contest.planned
        return decide([trial_of_photons(PHOTONS, photons, 1.0)], [excluded], planned, 1.0)
    weighed = contest.weigh()
    trials, budget, usual = weighed
    if not (contest.settled or path_wins(*weighed)):
        if seconds:
            photons.start()  # its first iterations tell the time, and are kept
            trials, budget, usual = contest.weigh(timed=True)
        if not (integrator.denoised or mi.is_spectral):  # wavelengths are noise of their own
            trials, budget = contest.look_at_first_images(trials, budget)
    return decide(trials, [], budget, usual)


class Contest:
    """`path` against the photon mapper, in a render of so many iterations of the latter, or of so
    many seconds: by as much as is known when it is asked."""

    def __init__(self, path, photons, iterations, seconds):
        self.path, self.photons, self.seconds = path, photons, seconds
        self.iterations = iterations or UNPLANNED_ITERATIONS
        self.settled = False

    def is_settled(self):
        """Whether `path_wins`; it does then, whatever the clock says later."""
        if self.photons.prediction is not None and why_not_path(self.photons) is None:
            self.settled = path_wins(*self.weigh())
        return self.settled

    @property
    def planned(self):
        """Iterations of the photon mapper."""
        return self.photons.prediction.iterations if self.seconds else self.iterations

    @functools.cached_property
    def _samples(self):
        """Of `path`, and the seconds of one where those are planned."""
        pixels = self.photons.prediction.pixels
        if self.seconds:
            return _clocked_samples(self.path, pixels)
        return _samples(self.path, pixels, 0), None

    @functools.cached_property
    def _segments(self):
        """Mean segments of a camera path, by their numbers."""
        path, pixels = self.path, self.photons.prediction.pixels
        return mean_segments(
            path.scene,
            path.sensor,
            path.seed,
            pixels.stride,
            pixels.count,
            path.integrator.max_depth,
            path.integrator.rr_depth,
        )

    def weigh(self, timed=False):
        """The `Trial`s of both, the budget, and what an iteration of photons costs: where their
        first ones are `timed`, as much as these."""
        photons, (values, cost) = self.photons, self._samples
        if timed:
            usual, budget = photons.iteration_seconds, photons.seconds_left
        elif self.seconds:
            usual = photons.expected_seconds
            budget = self.planned * usual
        else:
            usual, cost = _counted_costs(self.path, photons, self._segments)
            budget = self.planned * usual
        alone = _trial_of_path(self.path, values, photons.prediction, budget, cost)
        mapper = replace(trial_of_photons(PHOTONS, photons, usual), done=len(photons.kept))
        return [alone, mapper], budget, usual

    def look_at_first_images(self, trials, budget):
        """The `Trial`s of both and what is left of the budget, once the first iterations of photons
        have told how noisy they are; and where `path` would win then, so have its own. Where
        they cannot tell more than the pilot, the trials are left as they are."""
        alone, photons = trials
        pixels = film_sample_count(self.path.sensor), self.photons.prediction.pixels.count
        counts = {trial.plugin: iterations_ahead(trial.count(budget), *pixels) for trial in trials}
        images = {}

        def look(trial):
            nonlocal budget
            trial.session.start()
            images[trial.plugin] = first_images(trial.session, counts[trial.plugin])
            spent = (counts[trial.plugin] - trial.done) * trial.cost
            budget = self.photons.seconds_left if self.seconds else budget - spent

        def seen(trial, weights):
            """The `Trial` by its images."""
            cost = trial.session.iteration_seconds if self.seconds else trial.cost
            trial = replace(trial, done=counts[trial.plugin], cost=cost)
            count = trial.count(budget)
            noise = noise_of_mean(images[trial.plugin], weights, count)
            parts = {name: (bias, count * noise[name]) for name, (bias, _) in trial.parts.items()}
            return replace(trial, parts=parts)

        if all(counts.values()):
            look(photons)
            photons = seen(photons, weights_by(*images.values()))
            if alone.product(budget) < photons.product(budget):
                look(alone)
                weights = weights_by(*images.values())
                alone, photons = (seen(trial, weights) for trial in (alone, photons))
        return [alone, photons], budget


def path_wins(trials, budget, usual):
    """Whether `path` renders even if an iteration of photons is `OVERRATED`; arguments as
    `Contest.weigh` returns them."""
    alone, photons = trials
    photons = replace(photons, cost=usual / OVERRATED)
    return alone.product(budget) <= photons.product(budget)


def decide(trials, reasons, budget, usual):
    """The `Decision` for the trial with the least error predicted for this budget."""
    best = min(trials, key=lambda trial: trial.product(budget))
    squared_bias, variance = best.parts["relmse"]
    why = (
        f"{best.plugin}: least predicted error in this time; bias {squared_bias:.2g}, noise "
        f"{variance / best.count(budget):.2g} (squared, relative)"
    )
    for trial in trials:
        if trial is not best:
            getattr(trial.session, "kept", {}).clear()
            trial.session = None  # its photons' and kernels' memory is free to go
    errors = {
        f"{measure}.{trial.plugin}": float(error)
        for trial in trials
        for measure, error in trial.errors(budget).items()
        if math.isfinite(error)
    }
    return Decision(best.plugin, best.session, [why, *reasons], errors, trials, usual)


def new_session(plugin, integrator, scene, sensor, seed, iterations):
    """A session of a candidate, with the parameters of `integrator` that all share."""
    if plugin == CAMERA:
        return PathSession(integrator, scene, sensor, seed, iterations)
    shared = {
        **handed_on(integrator),
        "camera_paths": integrator.initial_camera_paths,
        "denoised": integrator.denoised,
        "aovs": written(integrator.layers),
    }
    own = own_parameters(CANDIDATES, plugin, integrator)
    made = mi.load_dict({"type": plugin, **shared, **own})
    made.check(scene, sensor)
    return made.new_session(scene, sensor, seed, iterations)


def own_parameters(candidates, plugin, integrator):
    """The parameters of one of the `candidates` that others do not share."""
    own = candidates[plugin]
    return FOR_DENOISERS.get(plugin, own) if integrator.denoised else own


def too_many_instances(scene):
    """Why a scene's instances leave no choice, in one line; `None` if they do."""
    count = sum(shape.class_name() == "Instance" for shape in scene.shapes())
    if count <= MOST_INSTANCES:
        return None
    traits = SceneTraits(scene)
    if traits.has_unmet_lights and (traits.has_delta or traits.has_unsampled_lights):
        return None  # as `camera_paths_are_blind`, of paths of any length
    return f"with {count} instances each kernel of {PHOTONS} takes long to compile"


def no_photons(integrator, session):
    """Why a session has no photons, in one line."""
    if session.lights.dark:
        return "the scene has no light"
    return f"light of at most {integrator.max_depth} segments needs no photons"


def camera_paths_are_blind(session):
    """Whether there may be caustics that camera paths alone cannot make."""
    return session.has_caustics and session.traits.has_unmet_lights


def why_blind(plugin, session, prediction):
    """Why a `plugin` of camera paths alone is not tried that cannot see all of the light, in one
    line; `None` if it sees nearly all."""
    if camera_paths_are_blind(session) and prediction.caustic_share > UNSEEN:
        share = f"{prediction.caustic_share:.1%} of the light"
        return f"not {plugin}: it cannot see the caustics, {share}"
    return None


def why_not_path(photons):
    """Why `path` is not tried against these photons, in one line; `None` if it is."""
    if photons.integrator.splits_light:
        return f"not {CAMERA}: it does not split the light"
    return why_blind(CAMERA, photons, photons.prediction)


def trial_of_photons(plugin, session, cost):
    """The `Trial` of a session whose pilot has run."""
    errors = session.prediction.errors
    parts = {name: (error.squared_bias, error.variance) for name, error in errors.items()}
    return Trial(plugin, session, parts, cost)


def _counted_costs(path, photons, segments):
    """Costs of an iteration of photons and of a sample of `path`, in segments of the latter
    (`mean_segments`)."""
    gathered, paths = photons.prediction.gathered, photons.camera_paths
    counted = costs.events(photons, segments, photons.last_vertex, gathered, paths)
    usual = costs.cost(PHOTONS, counted) + costs.of_direct_paths(photons, segments)
    alone = costs.cost(CAMERA, costs.events(path, segments, None, 0.0))
    return usual, alone + costs.of_light_apart(path, segments)


def _clocked_samples(path, pixels):
    """Samples of the pilot's pixels, as of `_samples`, and the seconds that one sample of each of
    the film's takes."""
    halves = [_samples(path, pixels, first) for first in (0, PATH_TRIALS)]
    return np.concatenate(halves), _seconds_of_sample(path, PATH_TRIALS * pixels.count)


def _seconds_of_sample(path, count):
    """Seconds that one sample of each of the film's pixels takes, by so many paths of an iteration.
    They are some runs of near ones, as in a render: apart, paths take up to twice as long. Runs
    that follow each other are far apart: threads would else get unlike parts of the film, and wait
    for each other."""
    total = film_sample_count(path.sensor) * path.camera_paths
    lane = lanes(count)
    runs = -(-count // TOGETHER)
    step = round(GOLDEN * runs)
    while math.gcd(step, runs) > 1:
        step += 1
    place = lane // TOGETHER * step % runs
    number = (place * (total // runs) + lane % TOGETHER) % total
    spectral = path._spectral(TRIAL_INDEX)
    pixel, index = path.pixels_and_indices(number)
    dr.eval(pixel, index)
    start = now()
    path.trace(TRIAL_INDEX, pixel, index, spectral)
    dr.sync_thread()
    return (now() - start) / count * film_sample_count(path.sensor)


def _samples(path, pixels, first):
    """`PATH_TRIALS` samples of each of the pilot's pixels, from number `first` on: radiance, mean
    over the channels, (samples, pixels)."""
    passes = (
        PATH_TRIALS if mi.is_spectral else 1
    )  # wavelengths are shared by all that is traced at once
    at_once = PATH_TRIALS // passes
    pixel, trial = pixels.places(lanes(at_once * pixels.count))
    values = []
    for number in range(first, first + passes):
        spectral = path._spectral(TRIAL_INDEX + number)
        index = trial + dr.opaque(mi.UInt32, number)  # one kernel for all
        radiance, *_ = path.trace(TRIAL_INDEX, pixel, index, spectral)
        value = channel_mean(radiance) + dr.zeros(mi.Float, dr.width(pixel))
        values.append(np.array(value).reshape(at_once, pixels.count))
    return np.concatenate(values)


def _trial_of_path(path, values, prediction, budget, cost):
    """`path`, by the `values` of samples that `cost` so much, for a render of this `budget`. How
    noisy caustics are that it meets by chance, photons tell: its few samples may have met none."""
    share = noise_left(path.integrator, path.sensor) / path.camera_paths
    parts = parts_of_samples(path, values, prediction, budget / cost, share)
    for measure, chance in prediction.chance.items():
        squared_bias, variance = parts[measure]
        parts[measure] = squared_bias, max(variance, share * chance)
    return Trial(CAMERA, path, parts, cost * path.camera_paths)


def parts_of_samples(session, values, prediction, samples, share):
    """Those of a `Trial` of camera paths alone, by the `values` (trials, pixels) of a few samples
    of the pilot's pixels, where a render has so many `samples` a pixel; `share`: what counts of
    their noise. A pixel is as bright as they and the photons of the `prediction` say: where these
    alone came out dark by chance, the noise of others would count too much. (That of photons, which
    is then small, hardly does.) Values that are not finite count as none: renders leave them
    out."""
    values = np.where(np.isfinite(values), values, 0)
    cells = neighbourhoods(film_size(session.sensor)[0], prediction.pixels)
    mean = (shrink_to_neighbours(values, cells) + prediction.mean) / 2
    samples = max(round(samples), 1)
    return {
        measure: (0.0, share * _variance_of_one(session, values, weigh(mean), samples))
        for measure, weigh in MEASURES.items()
    }


def _variance_of_one(session, values, weights, samples):
    """Of one of so many samples a pixel, by the `values` (trials, pixels) of a few."""
    if session.integrator.low_discrepancy:  # `Trial.errors` divides by the samples
        return samples * _variance_of_samples(values, weights, samples)
    return trimmed_mean(weights * np.var(values, axis=0, ddof=1))


def _variance_of_samples(values, weights, samples):
    """Variance of the mean of so many samples a pixel: what `values` (trials, pixels) of
    samples that are consecutive in the pixels' sequences extrapolate to."""
    lengths, found, _ = contrasts(values, np.ones(len(values), bool), 1)
    return variance_by_power(
        lengths, np.array([trimmed_mean(weights * contrast) for contrast in found]), samples
    )
