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
    """A session whose iterations are drawn: pixels of mean one with independent noise, and noise
    that blocks of 16x16 share, of these deviations; and a bright square of which an iteration has
    one, in a place of its own, if it is `rare`."""

    def __init__(self, own=0.0, shared=0.0, rare=0.0, denoised=False, seconds=1.0):
        self.own, self.shared, self.rare, self.seconds = own, shared, rare, seconds
        self.integrator = SimpleNamespace(denoised=denoised)
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
        coarse = rng.normal(size=(SIZE // 16, SIZE // 16))
        grey += self.shared * np.kron(coarse, np.ones((16, 16)))
        x, y = rng.integers(0, SIZE - 4, 2)
        grey[y : y + 4, x : x + 4] += self.rare
        block = np.stack([grey, grey, grey, np.ones_like(grey)], axis=-1)
        self.kept[iteration] = mi.TensorXf(block.astype(np.float32))
        return self.seconds


@pytest.mark.parametrize(
    "planned, count", [(1, 0), (19, 0), (20, 2), (39, 2), (40, 4), (80, 8), (1e6, 8)]
)
def test_how_many_iterations_are_looked_at(rgb, planned, count):
    from mis_integrators.integrators.film_trial import iterations_ahead

    assert iterations_ahead(planned) == count


@pytest.mark.parametrize("denoised", [False, True])
def test_noise_is_what_was_drawn(rgb, denoised):
    """Of the mean of so many independent iterations. For a denoiser independent noise is a 25th,
    and shared noise counts nearly in full (windows of 5 pixels reach beyond its blocks)."""
    from mis_integrators.integrators.film_trial import brightness, first_images, noise_of_mean

    for own, shared in ((0.3, 0.0), (0.0, 0.3)):
        images = first_images(Drawn(own, shared, denoised=denoised), 8)
        found = noise_of_mean(images, brightness(images), 64)
        left = 0.09 / 64
        if denoised:
            left /= 25 if own else 1 / 0.83**2  # the square of what a window keeps, each way
        freedom = 4 * (16 if shared else (SIZE // 5) ** 2)
        tolerance = 6 * np.sqrt(2 / freedom)
        assert found["mse"] == pytest.approx(left, rel=tolerance)
        assert found["relmse"] == pytest.approx(left / 1.1, rel=tolerance)


def test_rare_light_counts(rgb):
    """A square of 16 pixels in an iteration, 200 times as bright as the rest, is less than the
    noisiest 0.1 % of the pixels in none of them, and makes all of the noise."""
    from mis_integrators.integrators.film_trial import brightness, first_images, noise_of_mean

    images = first_images(Drawn(rare=200.0), 8)
    found = noise_of_mean(images, brightness(images), 8)
    drawn = 200.0**2 * 16 / SIZE**2 / 8 / usual_radiance(brightness(images).ravel()) ** 2
    assert found["mse"] == pytest.approx(drawn, rel=0.2)


@pytest.mark.parametrize(
    "rare, of_path, chosen", [(0.0, 0.1, "bdpm"), (200.0, 0.1, "path"), (200.0, 30.0, "bdpm")]
)
def test_what_iterations_show_decides(rgb, rare, of_path, chosen):
    """A pilot has seen no rare light. `path` is rendered where it might win then, and nowhere
    else; it loses if it is as noisy."""
    from mis_integrators.integrators.choice import Contest, Trial, decide

    photons, path = Drawn(own=0.1, rare=rare), Drawn(own=of_path)
    photons.seconds_left = 100.0
    trials = [
        Trial("path", path, dict.fromkeys(("relmse", "mse"), (0.0, 0.04)), 1.0),
        Trial("bdpm", photons, dict.fromkeys(("relmse", "mse"), (0.0, 0.01)), 1.0),
    ]
    contest = Contest(path, photons, None, 100.0)
    after, budget = contest.look_at_first_images(trials, 100.0)
    assert decide(after, [], budget, 1.0).plugin == chosen
    assert len(photons.kept) == 8 and len(path.kept) == (8 if rare else 0)
    assert [trial.done for trial in after] == [len(path.kept), 8]


def test_no_time_to_look(rgb):
    from mis_integrators.integrators.choice import Contest, Trial

    session = Drawn()
    trials = [
        Trial(plugin, session, {"relmse": (0.0, 1.0), "mse": (0.0, 1.0)}, 1.0)
        for plugin in ("path", "bdpm")
    ]
    contest = Contest(session, session, 15, None)
    assert contest.look_at_first_images(trials, 15.0) == (trials, 15.0)
    assert not session.kept and not session.started


def test_iterations_rendered_ahead_are_the_same(rgb):
    """They are in the image, once, and take no time of it."""
    ahead, plain = (Unidirectional().session(tray("lambertian", "rectangle"), 0, 3, 0) for _ in "ab")
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
