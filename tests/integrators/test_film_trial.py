"""The noise that the first iterations of a render tell, and what `bdpm_auto` makes of it.

Draws are by fixed seeds. Bounds on relative errors of variances are six standard errors of
normal noise, sqrt(2 / degrees of freedom) each, at least: a false-alarm rate of 1e-8 a test.
"""

from types import SimpleNamespace

from mis_integrators.pilot.noise import usual_radiance

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_auto import Unidirectional, auto, set_price_of_path
from worlds import tray

SIZE = 64
MEASURES = "relmse", "mse"


class Drawn:
    """A session whose iterations are drawn: pixels of mean one with `own`, the deviation of
    independent noise; and in each iteration a pixel of its own that is brighter by `rare`. Weights
    are 8, as those of 8 paths are, and blocks have alpha."""

    def __init__(self, own=0.0, rare=0.0, seconds=1.0):
        self.own, self.rare, self.seconds = own, rare, seconds
        box = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        film = mi.load_dict(box)
        self.sensor = SimpleNamespace(film=lambda: film)
        self.integrator = SimpleNamespace(low_discrepancy=True)
        self.kept, self.started, self.seconds_left = {}, False, 100.0

    def start(self):
        self.started = True

    def render_ahead(self, iteration):
        rng = np.random.default_rng((iteration, round(self.rare)))
        grey = 1 + self.own * rng.normal(size=(SIZE, SIZE))
        grey[tuple(rng.integers(0, SIZE, 2))] += self.rare
        alpha, weight = np.zeros_like(grey), np.ones_like(grey)
        block = 8 * np.stack([grey, grey, grey, alpha, weight], axis=-1)
        self.kept[iteration] = mi.TensorXf(block.astype(np.float32))
        self.seconds_left -= self.seconds
        return self.seconds


def told(session, iterations, count):
    """What so many first images of a session tell of the noise after `count` iterations."""
    from mis_integrators.integrators.film_trial import first_images, noise_of_mean, weights_by

    images = first_images(session, iterations)
    return noise_of_mean(images, weights_by(images), count), images


@pytest.mark.parametrize(
    "planned, pixels, count",
    [
        (1, 1 << 16, 0),
        (19, 1 << 16, 0),
        (20, 1 << 16, 2),
        (39, 1 << 16, 2),
        (40, 1 << 16, 4),
        (80, 1 << 16, 8),
        (1e6, 1 << 16, 8),
        (39, 1 << 15, 2),
        (39, 30000, 0),
        (40, 30000, 4),
        (1e6, 4096, 0),
        (1e6, 1280 * 720, 4),
        (1e6, 1 << 23, 2),
    ],
)
def test_how_many_iterations_are_looked_at(rgb, planned, pixels, count):
    """A tenth of the render, as many pixels as a pilot of 4096 sees in all of its iterations, and
    not more than memory is for."""
    from mis_integrators.integrators.film_trial import iterations_ahead

    assert iterations_ahead(planned, pixels, 4096) == count


@pytest.mark.parametrize("low_discrepancy", [True, False])
def test_noise_is_what_was_drawn(rgb, low_discrepancy):
    """Of the mean of so many independent iterations."""
    session = Drawn(0.3)
    session.integrator.low_discrepancy = low_discrepancy
    found, _ = told(session, 8, 64)
    tolerance = 6 * np.sqrt(2 / (4 * SIZE**2))
    assert found["mse"] == pytest.approx(0.09 / 64, rel=tolerance)
    assert found["relmse"] == pytest.approx(0.09 / 64 / 1.1, rel=tolerance)


def test_rare_light_counts(rgb):
    """One pixel in an iteration, among the noisiest 0.1 %, makes all of the noise. It is hardly
    brighter than those around it."""
    found, images = told(Drawn(rare=800.0), 8, 8)
    drawn = 800.0**2 / SIZE**2 / 8 / usual_radiance(images.mean) ** 2
    assert found["mse"] == pytest.approx(drawn, rel=0.2)
    assert found["relmse"] > drawn / 3


def test_lamps_do_not_say_what_is_usual(rgb):
    """As in pilots: else noise would count less than their bias does. Windows around small lamps
    are a fifth of this film."""
    from mis_integrators.integrators.film_trial import FirstImages, weights_by

    mean = np.ones((SIZE, SIZE))
    mean[8::32, 8::32] = 1000.0
    weights = weights_by(FirstImages(mean, np.zeros((2, SIZE, SIZE)), True))
    assert np.allclose(weights["mse"], 1)
    assert weights["relmse"].max() == pytest.approx(1 / 1.1)


def test_noise_is_that_of_the_image(rgb):
    """With a reconstruction filter the weights of an iteration differ from pixel to pixel, and the
    image divides their sum. The noise that four independent iterations tell is what the images of
    24 renders have; 23 degrees of freedom in each of a thousand pixels, of which four and more
    share their noise: 10 % are five standard errors."""
    scene = tray("lambertian", "rectangle", rfilter="gaussian")
    images, noise = [], []
    for seed in range(24):
        session = Unidirectional(sampler="independent").session(scene, 0, seed, 0)
        noise.append(told(session, 4, 4)[0]["mse"])
        for _ in range(4):
            session.iterate()
        images.append(session.image()[..., :3].mean(axis=-1))
    usual = usual_radiance(np.mean(images, axis=0))
    measured = np.var(images, axis=0, ddof=1).mean() / usual**2
    assert np.mean(noise) == pytest.approx(measured, rel=0.1)


def test_values_that_are_not_finite_are_left_out(rgb):
    session = Drawn()
    session.render_ahead(0), session.render_ahead(1)
    block = np.array(session.kept[0])
    block[3, 5, 1] = np.inf
    block[4, 6, -1] = np.nan
    session.kept[0] = mi.TensorXf(block)
    found, images = told(session, 2, 2)
    assert np.allclose(images.mean, 1) and np.allclose(images.deviations, 0)
    assert found == {measure: pytest.approx(0, abs=1e-12) for measure in MEASURES}


def contest_of(path, photons, seconds):
    """A `Contest`, and the trials by a pilot that has seen no rare light. Iterations of `path` cost
    half."""
    from mis_integrators.integrators.choice import Contest, Trial

    photons.prediction = SimpleNamespace(pixels=SimpleNamespace(count=SIZE**2 // 16))
    path.seconds = 0.5
    trials = [
        Trial("path", path, dict.fromkeys(MEASURES, (0.0, 0.02)), 0.5),
        Trial("bdpm", photons, dict.fromkeys(MEASURES, (0.0, 0.01)), 1.0),
    ]
    return Contest(path, photons, None if seconds else 100, seconds), trials


@pytest.mark.parametrize("seconds", [100.0, None])
@pytest.mark.parametrize(
    "rare, of_path, chosen", [(0.0, 0.1, "bdpm"), (800.0, 0.1, "path"), (800.0, 30.0, "bdpm")]
)
def test_what_iterations_show_decides(rgb, rare, of_path, chosen, seconds):
    """`path` is rendered where it might win then, and nowhere else; it loses if it is as noisy.
    What both take is no longer there for the rest."""
    from mis_integrators.integrators.choice import decide

    photons, path = Drawn(own=0.1, rare=rare), Drawn(own=of_path)
    contest, trials = contest_of(path, photons, seconds)
    if seconds:
        path.render_ahead = lambda number: (
            setattr(photons, "seconds_left", photons.seconds_left - 0.5)
            or Drawn.render_ahead(path, number)
        )
    after, budget = contest.look_at_first_images(trials, 100.0)
    of_path = 8 if rare else 0
    assert len(photons.kept) == 8 and len(path.kept) == of_path
    assert [trial.done for trial in after] == [of_path, 8]
    assert budget == 100 - 8 - 0.5 * of_path
    assert decide(after, [], budget, 1.0).plugin == chosen
    assert len(photons.kept) == (8 if chosen == "bdpm" else 0)  # a loser's memory is free


def test_iterations_that_told_the_time_are_looked_at(rgb):
    """And are not rendered again, nor paid for."""
    photons, path = Drawn(own=0.1), Drawn()
    contest, (alone, mapper) = contest_of(path, photons, None)
    photons.render_ahead(0)
    mapper.done = 1
    rendered = []
    photons.render_ahead = lambda number: (
        rendered.append(number) or Drawn.render_ahead(photons, number)
    )
    _, budget = contest.look_at_first_images([alone, mapper], 100.0)
    assert rendered == list(range(1, 8)) and budget == 93


def test_what_is_rendered_counts(rgb):
    """Eight iterations of a hundred that there was time for are done, and 92 are left."""
    from mis_integrators.integrators.choice import Trial

    trial = Trial("bdpm", None, {"relmse": (0.1, 5.0)}, cost=2.0, done=8)
    assert trial.count(184.0) == 100 and trial.errors(184.0) == {"relmse": pytest.approx(0.15)}


def test_no_time_to_look(rgb):
    contest, trials = contest_of(Drawn(), Drawn(), None)
    assert contest.look_at_first_images(trials, 15.0) == (trials, 15.0)
    assert not any(trial.session.kept or trial.session.started for trial in trials)


@pytest.mark.parametrize("parameters", [{"denoised": True}, {"aovs": "a:indirect"}])
def test_where_nothing_is_looked_at(rgb, monkeypatch, parameters):
    """Renders for a denoiser, and where there is no choice."""
    from mis_integrators.integrators.choice import Contest

    monkeypatch.setattr(Contest, "look_at_first_images", None)
    auto(**parameters).session(tray("lambertian", "rectangle"), spp=400).start()


def test_iterations_rendered_ahead_are_the_same(rgb, monkeypatch):
    """They are in the image, once, and are not rendered again."""
    scene, numbers = tray("lambertian", "rectangle"), []
    ahead, plain = (Unidirectional().session(scene, 0, 3, 0) for _ in range(2))
    iteration = ahead._iteration
    ahead._iteration = lambda number: numbers.append(number) or iteration(number)
    for number in (0, 1):
        assert ahead.render_ahead(number) > 0
    assert ahead.iterations == 0 and ahead.seconds_of_next == 0
    for session in (ahead, plain):
        for _ in range(3):
            session.iterate()
    assert numbers == [0, 1, 2] and not ahead.kept and ahead.seconds_of_next > 0
    np.testing.assert_allclose(ahead.image(), plain.image(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("chosen, factor", [("path", 1e6), ("bdpm", 1.0)])
@pytest.mark.parametrize("seconds", [None, 20.0])
def test_what_is_chosen_keeps_its_images(rgb, monkeypatch, chosen, factor, seconds):
    """Photons that turn out noisy give way. The image is that of the session chosen, from its first
    iteration on."""
    from mis_integrators.integrators import choice

    weigh, of_photons = choice.noise_of_mean, (1, 3)
    calls = []

    def noisy(images, weights, count):
        calls.append(len(images.deviations))
        noise = weigh(images, weights, count)
        times = factor if len(calls) in of_photons else 1.0
        return {name: times * variance for name, variance in noise.items()}

    monkeypatch.setattr(choice, "noise_of_mean", noisy)
    monkeypatch.setattr(choice, "iterations_ahead", lambda *given: 4)  # on so small a film, too
    close = 100.0 if seconds else 2.0  # so that a pilot prefers photons
    set_price_of_path(monkeypatch, close if chosen == "path" else 1e4)
    scene = tray("lambertian", "rectangle")
    session, alone = (auto().session(scene, spp=0 if seconds else 400) for _ in range(2))
    if seconds:
        session.plan_time(seconds)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        session.start()
    assert len(calls) == (3 if chosen == "path" else 1)
    assert session.decision.plugin == chosen and sorted(session.kept) == [0, 1, 2, 3]
    alone.recall(session.learned)
    assert not alone.kept
    for one in (session, alone):
        for _ in range(5):
            one.iterate()
    assert not session.kept
    np.testing.assert_allclose(session.image(), alone.image(), rtol=1e-3, atol=1e-5)
