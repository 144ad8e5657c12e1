"""The noise that the first iterations of a render tell, and what `bdpm_auto` makes of it.

Draws are by fixed seeds. Bounds on relative errors of variances are six standard errors of
normal noise, sqrt(2 / degrees of freedom) each, at least: a false-alarm rate of 1e-8 a test.
"""

from types import SimpleNamespace

from mis_integrators.pilot.noise import usual_radiance

import mitsuba as mi
import numpy as np
import pytest
from test_auto import Unidirectional, auto, set_price_of_path
from worlds import tray

SIZE = 64


class Drawn:
    """A session whose iterations are drawn: pixels of mean one with `own`, the deviation of
    independent noise; and in each iteration a pixel of its own that is brighter by `rare`."""

    def __init__(self, own=0.0, rare=0.0, seconds=1.0):
        self.own, self.rare, self.seconds = own, rare, seconds
        film = mi.load_dict(
            {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        )
        self.sensor = SimpleNamespace(film=lambda: film)
        self.kept, self.started = {}, False

    def start(self):
        self.started = True

    def render_ahead(self, iteration):
        rng = np.random.default_rng((iteration, round(self.rare)))
        grey = 1 + self.own * rng.normal(size=(SIZE, SIZE))
        grey[tuple(rng.integers(0, SIZE, 2))] += self.rare
        block = np.stack([grey, grey, grey, np.ones_like(grey)], axis=-1)
        self.kept[iteration] = mi.TensorXf(block.astype(np.float32))
        return self.seconds


@pytest.mark.parametrize(
    "planned, pilot_share, count",
    [
        (1, 0.01, 0),
        (19, 0.01, 0),
        (20, 0.01, 2),
        (39, 1 / 8, 2),
        (39, 1 / 7, 0),
        (40, 1 / 7, 4),
        (80, 1 / 2, 8),
        (1e6, 0.01, 8),
        (1e6, 1.0, 0),
    ],
)
def test_how_many_iterations_are_looked_at(rgb, planned, pilot_share, count):
    """A tenth of the render, and as many pixels as a pilot sees in all of its iterations."""
    from mis_integrators.integrators.film_trial import iterations_ahead

    assert iterations_ahead(planned, pilot_share) == count


def test_noise_is_what_was_drawn(rgb):
    """Of the mean of so many independent iterations."""
    from mis_integrators.integrators.film_trial import brightness, first_images, noise_of_mean

    images = first_images(Drawn(0.3), 8)
    found = noise_of_mean(images, brightness(images), 64)
    tolerance = 6 * np.sqrt(2 / (4 * SIZE**2))
    assert found["mse"] == pytest.approx(0.09 / 64, rel=tolerance)
    assert found["relmse"] == pytest.approx(0.09 / 64 / 1.1, rel=tolerance)


def test_rare_light_counts(rgb):
    """One pixel in an iteration, among the noisiest 0.1 %, makes all of the noise."""
    from mis_integrators.integrators.film_trial import brightness, first_images, noise_of_mean

    images = first_images(Drawn(rare=800.0), 8)
    found = noise_of_mean(images, brightness(images), 8)
    drawn = 800.0**2 / SIZE**2 / 8 / usual_radiance(brightness(images).ravel()) ** 2
    assert found["mse"] == pytest.approx(drawn, rel=0.2)
    assert found["relmse"] > drawn / 3  # the pixel is hardly brighter than those around it


@pytest.mark.parametrize(
    "rare, of_path, chosen", [(0.0, 0.1, "bdpm"), (800.0, 0.1, "path"), (800.0, 30.0, "bdpm")]
)
def test_what_iterations_show_decides(rgb, rare, of_path, chosen):
    """A pilot has seen no rare light. `path` is rendered where it might win then, and nowhere
    else; it loses if it is as noisy."""
    from mis_integrators.integrators.choice import Contest, Trial, decide

    photons, path = Drawn(own=0.1, rare=rare), Drawn(own=of_path)
    photons.seconds_left = 100.0
    photons.prediction = SimpleNamespace(pixels=SimpleNamespace(count=SIZE**2 // 16))
    trials = [
        Trial("path", path, dict.fromkeys(("relmse", "mse"), (0.0, 0.04)), 1.0),
        Trial("bdpm", photons, dict.fromkeys(("relmse", "mse"), (0.0, 0.01)), 1.0),
    ]
    contest = Contest(path, photons, None, 100.0)
    after, budget = contest.look_at_first_images(trials, 100.0)
    assert decide(after, [], budget, 1.0).plugin == chosen
    assert len(photons.kept) == 8 and len(path.kept) == (8 if rare else 0)
    assert [trial.done for trial in after] == [len(path.kept), 8]


def test_what_is_rendered_counts(rgb):
    """Eight iterations of a hundred that there was time for are done, and 92 are left."""
    from mis_integrators.integrators.choice import Trial

    trial = Trial("bdpm", None, {"relmse": (0.1, 5.0)}, cost=2.0, done=8)
    assert trial.count(184.0) == 100 and trial.errors(184.0) == {"relmse": pytest.approx(0.15)}


def test_no_time_to_look(rgb):
    from mis_integrators.integrators.choice import Contest, Trial

    session = Drawn()
    session.prediction = SimpleNamespace(pixels=SimpleNamespace(count=1))
    trials = [
        Trial(plugin, session, {"relmse": (0.0, 1.0), "mse": (0.0, 1.0)}, 1.0)
        for plugin in ("path", "bdpm")
    ]
    contest = Contest(session, session, 15, None)
    assert contest.look_at_first_images(trials, 15.0) == (trials, 15.0)
    assert not session.kept and not session.started


def test_iterations_rendered_ahead_are_the_same(rgb):
    """They are in the image, once, and take no time of it."""
    ahead, plain = (
        Unidirectional().session(tray("lambertian", "rectangle"), 0, 3, 0) for _ in "ab"
    )
    for iteration in (0, 1):
        assert ahead.render_ahead(iteration) > 0
    assert ahead.iterations == 0 and ahead.seconds_of_next == 0
    for session in (ahead, plain):
        for _ in range(3):
            session.iterate()
    assert not ahead.kept and ahead.seconds_of_next > 0
    np.testing.assert_allclose(ahead.image(), plain.image(), rtol=1e-5, atol=1e-7)


def test_path_that_is_chosen_by_its_images_keeps_them(rgb, monkeypatch):
    """Photons that turn out noisy give way; the image is that of `path` from its first iteration
    on."""
    from mis_integrators.integrators import choice

    weigh = choice.noise_of_mean
    calls = []

    def noisy_photons(images, bright, count):
        calls.append(len(images))
        noise = weigh(images, bright, count)
        return {name: 1e6 * v for name, v in noise.items()} if len(calls) in (1, 3) else noise

    monkeypatch.setattr(choice, "noise_of_mean", noisy_photons)
    monkeypatch.setattr(choice, "iterations_ahead", lambda *given: 4)  # on so small a film, too
    set_price_of_path(monkeypatch, 2.0)
    scene = tray("lambertian", "rectangle")
    session = auto().session(scene, spp=400)
    session.start()
    assert len(calls) == 3 and session.decision.plugin == "path"
    assert len(session.decision.session.kept) >= 2
    alone = Unidirectional(camera_paths=session.camera_paths).session(scene, 0, 0, 0)
    for one in (session, alone):
        for _ in range(4):
            one.iterate()
    np.testing.assert_allclose(session.image(), alone.image(), rtol=1e-4, atol=1e-6)
