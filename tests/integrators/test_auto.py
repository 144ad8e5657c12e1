"""The plugin `bdpm_auto`: `path` as iterations, the census that costs rest on, the choice, and the
image that follows.

Comparisons of renders as in `test_against_path`: false-alarm rate 1e-6 each, and an error of 1 % in
the image and of 3 or 8 % in a block is seen with a probability of 0.95.
"""

import json
import math
from types import SimpleNamespace

from mis_integrators.integrators import costs
from mis_integrators.paths.path_length_statistics import mean_segments
from mis_integrators.pilot.setting import PilotPixels

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    PathBatches,
    agree,
    assert_same,
    block_means,
    collect_until,
    in_one_thread,
)
from selection import extended
from test_against_path import MONO, RGB, SPECTRAL, caustic_scene
from test_bdpm import box_scene, glossy_box, last_words
from worlds import T, diffuse, film, look, path, sensor, tray


def auto(**parameters):
    return mi.load_dict({"type": "bdpm_auto", "max_depth": 4, **parameters})


def decided(scene, spp=8, **parameters):
    """A session of `bdpm_auto` after its first iteration."""
    session = auto(**parameters).session(scene, spp=spp)
    session.iterate()
    return session


def set_price_of_path(monkeypatch, price):
    """Lets a segment of `path` cost so much, and nothing else of it; in renders of a given time,
    that many times the seconds that it takes."""
    from mis_integrators.integrators import choice

    monkeypatch.setitem(
        costs.PRICES, "path", {"camera": price, "light": 0, "gathered": 0, "pixel": 0}
    )
    clocked = choice._clocked_samples

    def priced(path, pixels):
        values, seconds = clocked(path, pixels)
        return values, price * seconds

    monkeypatch.setattr(choice, "_clocked_samples", priced)


class Unidirectional:
    """Stands for an integrator whose sessions are `PathSession`s."""

    def __init__(self, **parameters):
        self.parameters = auto(**{"camera_paths": 1, **parameters})

    def session(self, scene, sensor, seed, spp):
        from mis_integrators.integrators.unidirectional import PathSession  # of the active variant

        return PathSession(self.parameters, scene, scene.sensors()[sensor], seed, None)


# --- What the choice rests on -------------------------------------------------


@pytest.mark.parametrize(
    "variant_name, kind, rfilter",
    [
        (RGB, "perspective", "gaussian"),
        *extended((MONO, "thinlens", "box")),
        pytest.param(SPECTRAL, "orthographic", "tent", marks=pytest.mark.full),
    ],
)
def test_path_as_iterations(variant_name, kind, rfilter):
    mi.set_variant(variant_name)
    agree(
        Unidirectional(camera_paths=8),
        path(),
        tray("smooth1", "rectangle", kind, rfilter=rfilter),
        block=0.08,
    )


class Renders:
    """Region means of renders by `PathSession`s of different seeds, which are independent; the
    iterations of one are not."""

    def __init__(self, scene, iterations, **parameters):
        self.scene, self.iterations, self.parameters = scene, iterations, parameters
        self.batches = []

    def add(self, count):
        for seed in range(len(self.batches), len(self.batches) + count):
            session = Unidirectional(**self.parameters).session(self.scene, 0, seed, 0)
            for _ in range(self.iterations):
                session.iterate()
            self.batches.append(block_means(session.image()[:, :, :3], 3))

    def estimate(self):
        return Estimate.of(self.batches)


@pytest.mark.long
@pytest.mark.parametrize("sampler", ["sobol", *extended("independent")])
def test_mean_of_whole_renders(rgb, sampler):
    """A few iterations together, with whatever their random numbers share, have the mean of `path`
    (false-alarm rate 1e-6; an error of 1 % of the whole image or of 8 % of a block is seen)."""
    scene = tray("smooth1", "rectangle")
    ours, theirs = Renders(scene, 4, camera_paths=8, sampler=sampler), PathBatches(path(), scene, 3)
    with dr.suspend_grad():
        assert_same(*collect_until(ours, theirs, block=0.08), block=0.08)


@pytest.mark.long
@in_one_thread
def test_sequences_lower_the_variance_of_path(rgb):
    """The variance of 32 paths a pixel, over 24 seeds, is much less than that of independent
    numbers: a fifth, by the median over pixels. Were they equal, a pixel's ratio would follow
    F(23, 23), below 0.7 with probability 0.2; of 500 independent pixels half would be so with a
    probability below 1e-40."""
    scene = tray("lambertian", "rectangle", rfilter="box")

    def variance(sampler):
        images = []
        for seed in range(24):
            session = Unidirectional(camera_paths=8, sampler=sampler).session(scene, 0, seed, 0)
            for _ in range(4):
                session.iterate()
            images.append(session.image()[:, :, :3].mean(axis=-1))
        return np.var(images, axis=0, ddof=1)

    sobol, independent = variance("sobol"), variance("independent")
    lit = (sobol > 0) & (independent > 0)
    assert lit.sum() > 500 and np.median(sobol[lit] / independent[lit]) < 0.7


@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian"])
def test_noise_of_path_is_what_its_renders_have(rgb, rfilter):
    """What 32 samples predict of the noise of 256 is 0.6 (tent) to 1.2 times (box) that of eight
    renders, which is known to 3 %: seeds are fixed, and others change the ratio by 10 %. With wide
    filters it is too low where, as here, stratification takes most of the noise."""
    from mis_integrators.integrators import choice
    from mis_integrators.pilot.noise import MEASURES, trimmed_mean

    samples, size = 256, 32
    scene = box_scene(size, rfilter)
    images = []
    for seed in range(8):
        session = Unidirectional(camera_paths=samples).session(scene, 0, seed, None)
        session.iterate()
        images.append(np.array(session.image())[..., :3].mean(axis=2).ravel())
    variance, mean = np.var(images, axis=0, ddof=1), np.mean(images, axis=0)
    session = Unidirectional(camera_paths=1).session(scene, 0, 0, None)
    pixels = PilotPixels(1, size * size, 1)
    values = np.concatenate([choice._samples(session, pixels, first) for first in (0, 16)])
    prediction = SimpleNamespace(mean=mean, pixels=pixels, chance={})
    trial = choice._trial_of_path(session, values, prediction, samples, 1.0)
    for measure, predicted in trial.errors(samples).items():
        true = trimmed_mean(MEASURES[measure](mean) * variance)
        assert 0.45 < predicted / true < 1.6, measure


@pytest.mark.parametrize("sampler", ["sobol", "independent"])
def test_samples_that_are_not_finite(sampler):
    """`path` has some on bent surfaces. They count as none: the errors predicted are those of zeros
    in their place, for camera paths on surfaces and in media."""
    from mis_integrators.integrators import choice

    session = SimpleNamespace(
        integrator=SimpleNamespace(low_discrepancy=sampler == "sobol"),
        sensor=box_scene().sensors()[0],
    )
    pixels = PilotPixels(1, 256, 1)
    values = np.random.default_rng(0).exponential(size=(32, 256))
    without, broken = values.copy(), values.copy()
    without[[3, 17], [200, 5]] = 0
    broken[[3, 17], [200, 5]] = np.nan, np.inf
    prediction = SimpleNamespace(mean=np.ones(256), pixels=pixels)

    def parts(values):
        return choice.parts_of_samples(session, values, prediction, 64, 1.0)

    assert parts(broken) == parts(without) != parts(values)


@pytest.mark.parametrize("sampler", ["sobol", *extended("independent")])
def test_path_in_parts(rgb, monkeypatch, sampler):
    """Large films are traced in parts, and iterations in any order: it makes no difference. (What
    atomic additions on the film round differs.)"""
    scene = tray("smooth1", "rectangle")
    whole = Unidirectional(camera_paths=2, sampler=sampler).session(scene, 0, 1, 0)
    monkeypatch.setattr("mis_integrators.integrators.unidirectional.CHUNK", 1000)
    parts = Unidirectional(camera_paths=2, sampler=sampler).session(scene, 0, 1, 0)
    assert parts.chunks > 2 and whole.chunks == 1
    for iteration in range(3):
        whole.iterate(iteration)
        parts.iterate(2 - iteration)
    assert np.allclose(whole.image(), parts.image(), rtol=1e-4, atol=1e-5)


def test_pilot_of_path_draws_independent_numbers(rgb):
    """The laws of pilots are about independent paths: the trial of `path` draws the same, whatever
    the `sampler`."""
    from mis_integrators.pilot.run import PILOT_INDEX

    def radiance(sampler, variation):
        session = Unidirectional(sampler=sampler).session(scene, 0, 1, 0)
        spectral = session._spectral(PILOT_INDEX)
        pixels = dr.arange(mi.UInt32, 500)
        index = dr.full(mi.UInt32, variation, 500)
        return np.array(session.trace(PILOT_INDEX, pixels, index, spectral)[0])

    scene = tray("lambertian", "rectangle")
    for variation in (0, 1):
        assert np.array_equal(radiance("sobol", variation), radiance("independent", variation))
    assert not np.array_equal(radiance("sobol", 0), radiance("sobol", 1))


def test_census(rgb):
    """In a closed diffuse box each path has as many segments as `max_depth` allows, and its
    vertices scatter smoothly; a mirror's do not."""
    box = {
        "type": "scene",
        "walls": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": diffuse(0.9)}},
        "sensor": {
            "type": "perspective",
            "fov": 70,
            "to_world": look((0, -0.9, 0), (0.1, 0, 0), (0, 0, 1)),
            "film": film(16),
        },
    }
    scene = mi.load_dict(box)
    assert mean_segments(scene, scene.sensors()[0], 1, 1, 256, 3, 50).tolist() == [1, 1, 1, 0, 0]
    assert mean_segments(scene, scene.sensors()[0], 1, 1, 256, 7, 50).tolist() == [1, 1, 1, 1, 3]
    # Roulette begins when two vertices have left 0.9^2 of a path's throughput, and lets as many
    # paths go on, with a throughput of one; later 0.9 of them. (5 standard errors of 16 x 256.)
    survivors = np.mean(
        [mean_segments(scene, scene.sensors()[0], seed, 1, 256, 4, 2)[2:4] for seed in range(16)], 0
    )
    assert np.all(np.abs(survivors - [0.81, 0.729]) < 5 * 0.007)
    mirrors = mi.load_dict(
        {
            **box,
            "walls": {
                "type": "cube",
                "bsdf": {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}},
            },
        }
    )
    assert mean_segments(mirrors, mirrors.sensors()[0], 1, 1, 256, 3, 50).tolist() == [
        3,
        0,
        0,
        0,
        0,
    ]


def test_prices(rgb):
    """Whatever counts costs has a price for every event, and more of anything is dearer."""
    from mis_integrators.integrators.choice import CANDIDATES

    assert set(costs.PRICES) == set(CANDIDATES)
    for plugin in costs.PRICES:
        few, many = (
            costs.cost(plugin, (1.0, 1.0, 1.0, 1.0)),
            costs.cost(plugin, (2.0, 2.0, 2.0, 1.0)),
        )
        assert 0 < few < many
    assert costs.cost("path", (3.5, 9.0, 9.0, 9.0)) == 3.5
    few, many = (costs.cost("bdpm", (1, 1, photons, 1)) for photons in (0, 100))
    assert few < many < 10 * few


def test_more_camera_paths_cost_more(rgb):
    """Each of a pixel's camera paths has its segments and its photons; light sub-paths and what an
    iteration takes besides are counted once."""
    pixels, light_paths, photons = 10, 30, 3
    for camera_paths in (1, 4):
        session = SimpleNamespace(
            chosen_light_paths=light_paths,
            photons_a_path=photons,
            camera_paths=camera_paths,
            path_count=pixels * camera_paths,
        )
        found = costs.events(session, [1.0, 0.5, 0.25], 1, 20.0, camera_paths)
        of_light = light_paths / pixels * (1 + photons)
        assert found == (1.5 * camera_paths, of_light, 20.0 * camera_paths, 1.0)


# --- The choice ---------------------------------------------------------------


def test_what_needs_no_photons(rgb):
    scene = tray("smooth1", "rectangle")
    settings = decided(scene, max_depth=2).settings
    assert settings["choice"] == "path" and "no photons" in settings["choice.because.1"]


def test_no_light(rgb):
    dark = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "bsdf": diffuse(0.5)},
            "lamp": {"type": "point", "intensity": 0.0, "position": [0, 0, 1]},
            "sensor": {
                "type": "perspective",
                "to_world": look((0, 0, 3), (0, 0, 0), (0, 1, 0)),
                "film": film(16),
            },
        }
    )
    session = decided(dark)
    assert (
        session.settings["choice"] == "path" and "no light" in session.settings["choice.because.1"]
    )
    assert session.image().max() == 0


@pytest.mark.parametrize("parameters", [{}, {"denoised": True}])
def test_what_photons_cannot_render(rgb, parameters):
    scene = box_scene(8, extra={"type": "sphere", "bsdf": {"type": "hair"}})
    session = decided(scene, **parameters)
    settings = session.settings
    assert settings["choice"] == "path" and 'BSDF "hair"' in settings["choice.because.1"]
    assert session.image().max() > 0
    with pytest.raises(Exception) as error:
        decided(scene, aovs="caustic:caustic")
    assert last_words(error.value).startswith('bdpm: BSDF "hair" is not supported')


@pytest.mark.parametrize(
    "emitter, lamp", [("point", True), *extended(("point", False), ("directional", False))]
)
def test_path_is_not_chosen_where_it_is_blind(rgb, emitter, lamp):
    """However cheap `path` were: caustics of lights without extent it cannot see, and be there a
    `lamp` that it can meet."""
    area = {
        "type": "rectangle",
        "to_world": look((1.5, 1.5, 3.4), (1.5, 1.5, 0)) @ mi.ScalarTransform4f().scale(0.5),
        "emitter": {"type": "area", "radiance": 60.0},
    }
    scene = caustic_scene(emitter, **({"lamp": area} if lamp else {}))
    settings = decided(scene).settings
    assert settings["choice"] != "path"
    assert any(
        "cannot see" in reason
        for name, reason in settings.items()
        if name.startswith("choice.because")
    )
    assert "choice.relmse.path" not in settings


def test_the_cheaper_wins(rgb, monkeypatch):
    """The same scene, the same pilot: what is chosen follows the costs."""

    def at(price):
        set_price_of_path(monkeypatch, price)
        return decided(tray("lambertian", "rectangle")).settings

    cheap, dear = at(1e-4), at(1e4)
    assert cheap["choice"] == "path" and dear["choice"] != "path"
    assert cheap["choice.relmse.path"] < cheap["choice.relmse.bdpm"]
    assert dear["choice.relmse.path"] > dear["choice.relmse.bdpm"]


@pytest.mark.parametrize("seconds, samples", [(1000.0, 8), *extended((None, 1))])
def test_a_path_of_given_time_keeps_the_processor_busy(rgb, monkeypatch, seconds, samples):
    """A launch of one sample a pixel is too small on small films; what is predicted of `path` is
    the same, however many it takes together. (That of independent numbers: the noise of sequences
    hangs on how many samples there is time for.)"""
    set_price_of_path(monkeypatch, 1e-4)
    scene = tray("lambertian", "rectangle")
    monkeypatch.setattr(
        "mis_integrators.integrators.unidirectional.BUSY",
        8 * int(np.prod(scene.sensors()[0].film().size())),
    )
    session = auto(sampler="independent").session(scene, spp=0 if seconds else 8)
    if seconds:
        session.plan_time(seconds)
    session.iterate()
    trial = next(trial for trial in session.decision.trials if trial.plugin == "path")
    assert session.decision.plugin == "path" and session.camera_paths == samples
    if not seconds:
        segments = trial.cost / samples / 1e-4
        assert 1 < segments < 4
    one = auto(sampler="independent", camera_paths=1).session(scene, spp=8)
    one.iterate()
    single = next(trial for trial in one.decision.trials if trial.plugin == "path")
    for measure, (_, variance) in trial.parts.items():
        assert variance * samples == pytest.approx(single.parts[measure][1], rel=0.3)


def test_a_photon_mapper_that_loses_renders_nothing(rgb, monkeypatch):
    """What an iteration of photons takes is measured only where photons have been chosen: else
    that time is the image's."""
    from mis_integrators.integrators.bdpm import BDPMSession

    set_price_of_path(monkeypatch, 1e-4)
    rendered = []
    monkeypatch.setattr(BDPMSession, "_iteration", lambda *given: rendered.append(given))
    session = auto().session(tray("lambertian", "rectangle"))
    session.plan_time(1.0)
    session.iterate()
    assert session.decision.plugin == "path" and not rendered


@pytest.mark.parametrize(
    "light, chosen",
    [
        ({"type": "constant", "radiance": 1.0}, "path"),
        (
            {
                "type": "sphere",
                "center": [1, -1, 3],
                "radius": 0.02,
                "emitter": {"type": "area", "radiance": 5000.0},
            },
            "bdpm",
        ),
    ],
)
def test_paths_find_the_caustics_of_a_sky(rgb, light, chosen):
    """A ball of glass on an open table. Caustics are a twentieth of the light; under a sky camera
    paths meet it at once, a small lamp hardly ever. What is chosen has at most a third of the
    predicted product of errors."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": light,
            "table": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.5)},
            "ball": {
                "type": "sphere",
                "center": [0, 0, 0.5],
                "radius": 0.5,
                "bsdf": {"type": "dielectric"},
            },
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "film": film(64),
                "to_world": look((0, -4, 2), (0, 0, 0.3), (0, 0, 1)),
            },
        }
    )
    session = auto(max_depth=8).session(scene)
    session.plan_time(4.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        session.start()
    decision = session.decision
    errors = {
        plugin: decision.errors[f"relmse.{plugin}"] * decision.errors[f"mse.{plugin}"]
        for plugin in ("path", "bdpm")
    }
    other = "bdpm" if chosen == "path" else "path"
    assert decision.plugin == chosen and errors[chosen] < errors[other] / 3


def prices_over_seconds():
    """What an iteration of photons and one of `path` are taken to cost in a render of a given time,
    over the seconds that they take (the least of three)."""
    from mis_integrators.core.clock import now
    from mis_integrators.integrators import choice

    scene = tray("lambertian", "rectangle")

    def seconds_of(session):
        taken = []
        for _ in range(3):
            start = now()
            session.iterate()
            dr.sync_thread()
            taken.append(now() - start)
        return min(taken)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        render = auto(), scene, scene.sensors()[0], 0, None
        path, photons = (choice.new_session(plugin, *render) for plugin in ("path", "bdpm"))
        photons.plan_time(5.0)
        photons.predict()
        (path, _), _, usual = choice.Contest(path, photons, None, 5.0).weigh()
        photons = mi.load_dict({"type": "bdpm", "bdd": 0, "max_depth": 4}).session(scene, spp=0)
        paths = Unidirectional(camera_paths=0).session(scene, 0, 0, None)
        return usual / seconds_of(photons), path.cost / seconds_of(paths)


@pytest.mark.long
def test_prices_are_what_candidates_take(rgb):
    """By the clock of the pilot an iteration takes 0.5 to 2 times what it does, on so small a film
    3 times, and a sample of `path` 1 to 1.8 times. Beside other work all of that varies: the median
    of five is taken, of which the first may compile."""
    of_photons, of_path = np.median([prices_over_seconds() for _ in range(5)], axis=0)
    assert 0.25 < of_photons < 12
    assert 0.2 < of_path < 6


def test_a_photon_mapper_that_wins_is_timed(rgb, monkeypatch):
    """What it has rendered for that is the image's, too, unless another choice has followed. Then
    it knows what an iteration takes, and how many there will be."""
    set_price_of_path(monkeypatch, 1e4)
    session = auto().session(tray("lambertian", "rectangle"))
    assert session.seconds_of_next == math.inf
    session.plan_time(5.0)
    session.start()
    photons = session.decision.session
    ready = len(photons.kept)
    assert session.decision.plugin == "bdpm" and ready <= 2
    assert (session.seconds_of_next == 0) == (ready > 0)
    for _ in range(ready):
        session.iterate()
    each = session.seconds_of_next
    assert 0 < each < 5.0
    assert 0 < photons.prediction.iterations * each < 5.0


@pytest.mark.parametrize("price, iterations", [(1e-4, 3), (1e4, 16)])
def test_the_pilot_ends_once_path_has_won(rgb, monkeypatch, price, iterations):
    """Its fewest iterations then, and else as many as the plan allows."""
    from mis_integrators.integrators.pilot_passes import SubsetPasses

    set_price_of_path(monkeypatch, price)
    traced, trace = [], SubsetPasses.trace
    monkeypatch.setattr(SubsetPasses, "trace", lambda *given: traced.append(given) or trace(*given))
    session = auto().session(tray("lambertian", "rectangle"), spp=400)
    session.start()
    assert (session.decision.plugin == "path") == (price < 1)
    assert len(traced) == iterations


def test_a_photon_mapper_learns_once(rgb, monkeypatch):
    """One pilot a render, whatever is chosen."""
    from mis_integrators.integrators import piloted

    pilots = []
    run_pilot = piloted.run_pilot
    monkeypatch.setattr(
        piloted, "run_pilot", lambda *given: pilots.append(given) or run_pilot(*given)
    )
    decided(glossy_box())
    assert len(pilots) == 1


@pytest.mark.long
@pytest.mark.parametrize("sampler", ["sobol", *extended("independent")])
def test_prediction_is_checked(rgb, sampler):
    """The error that is predicted for `path` is what twelve renders have: within a factor of two,
    the pilot's pixels being few."""
    scene = tray("lambertian", "rectangle")
    session = auto(sampler=sampler).session(scene, spp=64)
    session.iterate()
    predicted = session.settings["choice.relmse.path"]
    trial = next(t for t in session.decision.trials if t.plugin == "path")
    # as many as cost the same as 64 iterations of the photon mapper
    samples = round(64 * session.decision.usual_cost / trial.cost)
    images = []
    for seed in range(12):
        one = Unidirectional(sampler=sampler, camera_paths=samples).session(scene, 0, seed, 0)
        one.iterate()
        images.append(one.image().mean(axis=-1))
    mean = np.mean(images, axis=0)
    weights = 1 / (mean**2 + 0.1 * np.mean(np.minimum(mean, np.quantile(mean, 0.95))) ** 2)
    relative = np.sort((weights * np.var(images, axis=0, ddof=1)).ravel())
    measured = relative[: int(0.999 * relative.size)].mean()
    assert 0.5 < predicted / measured < 2


# --- The image ----------------------------------------------------------------


@pytest.mark.parametrize("variant_name, spp", [(RGB, 32), *extended((RGB, 6), (MONO, 6))])
def test_image_is_that_of_the_integrator_chosen(variant_name, spp):
    mi.set_variant(variant_name)
    scene = glossy_box()
    session = auto(variance=True).session(scene, seed=3, spp=spp)
    while session.iterations < session.iterations_planned:
        session.iterate()
    settings = session.settings
    assert settings["choice"] == "bdpm"
    alone = mi.load_dict({"type": "bdpm", "bdd": 0, "max_depth": 4, "variance": True}).session(
        scene, seed=3, spp=spp
    )
    while alone.iterations < spp:
        alone.iterate()
    assert settings["radius.indirect"] == alone.settings["radius.indirect"]
    assert np.allclose(session.image(), alone.image(), rtol=1e-3, atol=1e-5)
    assert session.channels == alone.channels


def test_what_was_decided_can_be_recalled(rgb):
    """Another session of the same render (after a kill, on another machine) goes on with the same
    integrator, without a pilot."""
    scene = glossy_box()
    first, second = (auto().session(scene, seed=3, spp=6) for _ in range(2))
    first.iterate()
    assert second.learned == {}
    second.recall(json.loads(json.dumps(first.learned)))
    assert second.settings == first.settings and second.decision.trials == []
    second.iterate()
    assert np.allclose(first.image(), second.image(), rtol=1e-3, atol=1e-5)


@pytest.mark.extended
def test_means(rgb):
    agree(auto(camera_paths=8), path(), tray("lambertian", "rectangle"))


def test_errors(rgb):
    with pytest.raises(Exception) as error:
        auto(photon_count=5)
    assert 'unknown parameter "photon_count"' in last_words(error.value)


@pytest.mark.parametrize(
    "lit, glass, count",
    [
        ("sky", False, 65),
        ("sky", True, 65),
        ("sun", False, 65),
        ("sun", True, 0),
        ("beam", False, 0),
    ],
)
def test_many_instances_leave_no_choice(rgb, lit, glass, count):
    """Each is a function of its own in every kernel; only where `path` cannot see caustics is it
    compared all the same."""
    from mis_integrators.integrators.choice import MOST_INSTANCES, too_many_instances

    light = {
        "sky": {"type": "constant"},
        "sun": {"type": "directional", "direction": [0, 0, -1]},
        "beam": {"type": "rectangle", "emitter": {"type": "directionalarea"}},
    }[lit]
    ball = {"type": "sphere", "bsdf": {"type": "dielectric"} if glass else diffuse(0.5)}
    scene = mi.load_dict(
        {"type": "scene", "group": {"type": "shapegroup", "ball": ball}}
        | {"light": light, "sensor": sensor(size=8)}
        | {
            f"instance{k}": {
                "type": "instance",
                "group": {"type": "ref", "id": "group"},
                "to_world": T().translate([k, 0, 0]),
            }
            for k in range(MOST_INSTANCES + 1)
        }
    )
    reason = too_many_instances(scene)
    assert (f"with {count} instances" in reason) if count else reason is None
    if count:
        session = mi.load_dict({"type": "bdpm_auto"}).session(scene, seed=1, spp=1)
        session.start()
        assert session.decision.plugin == "path" and reason in session.decision.reasons[0]
