"""The choice of `bdpm_auto` in participating media: photons, or camera paths alone.

Camera paths are those of `volpath_multiview` with one view. Photons are tried where light sub-paths
leave enough of them and no medium is a grid, and where camera paths cannot see all of the light.
(From a far lamp few sub-paths meet a small cloud, and a pilot cannot tell how much so few photons
blur.) Both are judged on the same pixels, as on surfaces (`choice`).
"""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.spectra import channel_mean
from ..core.traits import UnsupportedScene
from ..paths.layers import written
from ..pilot.setting import UNPLANNED_ITERATIONS
from ..volume.views import views_of
from .choice import (
    PATH_TRIALS,
    TRIAL_INDEX,
    Decision,
    Trial,
    camera_paths_are_blind,
    decide,
    handed_on,
    no_photons,
    own_parameters,
    parts_of_samples,
    trial_of_photons,
    why_blind,
)
from .noise_left import noise_left

CAMERA, PHOTONS = "volpath_multiview", "bdpm"
CANDIDATES = {CAMERA: {}, PHOTONS: {"bdd": 0}}
"""Plugins that may be chosen, and their parameters (see `choice.FOR_DENOISERS`)."""
ENOUGH = 0.05
"""Tuned: photons that a light sub-path leaves, on average, from which on a pilot is worth its time
and knows their blur."""
RARE = 0.02
"""Tuned: share of the light, brought by caustics that camera paths meet by chance, from which on
they are out of the question: so seldom that a pilot does not see how noisy they are."""
PATHS_AN_ITERATION = 4.0
"""Tuned: camera paths that cost as much as an iteration of photons, for each that it has itself.
1.5 to 4.5 were measured, and 1.8 to 4.5 for a denoiser. The most counts: where both are close,
camera paths are the safer."""


def choose(integrator, scene, sensor, seed, iterations, seconds):
    """The `Decision` for a render of so many iterations, or of so many seconds (either may be
    `None`)."""
    render = integrator, scene, sensor, seed, iterations
    if integrator.splits_light:
        reason = f"{PHOTONS}: {CAMERA} does not split the light"
        return Decision(PHOTONS, new_session(PHOTONS, *render), [reason])
    camera = new_session(CAMERA, *render)
    photons, reason = _photons(render)
    if photons is not None:
        photons.plan_time(seconds)

        @functools.cache
        def samples():
            return _samples(camera, photons.prediction.pixels)

        def judged():
            return _judged(camera, samples, photons, iterations, seconds)

        photons.predict(lambda: photons.prediction is not None and judged().plugin == CAMERA)
        if photons.prediction is not None:
            return judged()
        reason = "no camera path meets anything that scatters smoothly"
    return Decision(CAMERA, camera, [f"{CAMERA}: {reason}"])


def new_session(plugin, integrator, scene, sensor, seed, iterations):
    """A session of a candidate, with the parameters of `integrator` that both share."""
    parameters = {
        "type": plugin,
        **handed_on(integrator),
        "aovs": written(integrator.layers),
        **own_parameters(CANDIDATES, plugin, integrator),
    }
    if iterations or plugin == PHOTONS:
        parameters["camera_paths"] = integrator.initial_camera_paths
    made = mi.load_dict(parameters)
    made.denoised = integrator.denoised  # no parameter of camera paths, which keep channels empty
    samples = (iterations or 0) * integrator.initial_camera_paths
    return made.session(scene, sensor, seed, samples)


def _photons(render):
    """A session of photons, if they are worth a pilot; else `None`, and why not, in one line."""
    integrator, _, sensor, *_ = render
    if len(views_of(sensor)) > 1:
        return None, "several views share their paths"
    try:
        session = new_session(PHOTONS, *render)
    except UnsupportedScene as refusal:
        return None, str(refusal)
    if not session.kinds():
        return None, no_photons(integrator, session)
    if not camera_paths_are_blind(session):
        if session.traits.has_grids:
            return None, "in media of grids a pilot of photons takes too long"
        found = session.photons_of_a_path()
        if found < ENOUGH:
            return None, f"light sub-paths leave {found:.2g} photons each, too few to try them"
    return session, None


def _judged(camera, samples, photons, iterations, seconds):
    """The `Decision` once a pilot has run; `samples`: what asks for the `_samples`."""
    prediction, cost = photons.prediction, PATHS_AN_ITERATION * photons.camera_paths
    budget = cost * (prediction.iterations if seconds else iterations or UNPLANNED_ITERATIONS)
    trials, reasons = [trial_of_photons(PHOTONS, photons, cost)], []
    reason = why_blind(CAMERA, photons, prediction)
    if reason is None and photons.has_caustics and prediction.caustic_share > RARE:
        share = f"{prediction.caustic_share:.1%} of the light"
        reason = f"not {CAMERA}: it would meet the caustics, {share}, by chance only"
    if reason:
        reasons.append(reason)
    else:
        trials.insert(0, _trial_of_camera_paths(camera, samples(), prediction, budget))
    return decide(trials, reasons, budget, cost)


def _samples(session, pixels):
    """`PATH_TRIALS` samples of each of the pilot's pixels: (samples, pixels)."""
    numbers = dr.arange(mi.UInt32, pixels.count) * (pixels.stride * session.camera_paths)
    values = np.empty((PATH_TRIALS, pixels.count))
    for number in range(PATH_TRIALS):
        values[number] = channel_mean(session.radiance(TRIAL_INDEX, numbers, number))
    return values


def _trial_of_camera_paths(session, values, prediction, budget):
    """Camera paths, by the `values` of samples, each of which costs one."""
    share = noise_left(session.integrator, session.sensor)
    parts = parts_of_samples(session, values, prediction, budget, share)
    return Trial(CAMERA, session, parts, 1.0)
