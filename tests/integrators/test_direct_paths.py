"""Camera paths that see direct light alone: means stay, and the noise of direct light falls."""

from mis_integrators.core.film import direct_channels
from mis_integrators.integrators.direct_light import CHEAPEST

import mitsuba as mi
import numpy as np
import pytest
from comparing import SessionBatches, assert_same, collect_until, in_one_thread
from selection import extended
from worlds import SIZE, tray

RADIUS = 0.3
POWER = {"whole": 0.02, "block": 0.05}
"""Relative errors that tests would see, of the whole image and of a quarter."""


def integrator(plugin="bdpm", **parameters):
    return mi.load_dict({"type": plugin, "initial_radius": RADIUS, "max_depth": 4, **parameters})


@pytest.mark.parametrize(
    "material, count, parameters",
    [
        ("lambertian", 5, {"bdd": 0, "camera_paths": 2}),
        *extended(
            ("rough", 0, {"plugin": "bdpm_opt2"}),
            ("lambertian", 5, {"bdd": 0}),
            ("lambertian", 0, {"bdd": 1}),
            ("rough", 0, {"bdd": 0, "camera_paths": 2}),
            ("rough", 0, {"bdd": 0, "film": "gaussian"}),
            ("rough", 5, {"bdd": 1}),
        ),
    ],
)
def test_same_means(rgb, material, count, parameters):
    """With one path, and with five or as many as each pixel needs: `assert_same` with its
    false-alarm rate."""
    parameters = dict(parameters)
    scene = tray(material, "rectangle", rfilter=parameters.pop("film", "box"))
    sides = [
        SessionBatches(integrator(direct_paths=number, **parameters), scene, 2, seed)
        for seed, number in enumerate((1, count))
    ]
    assert_same(*collect_until(*sides, **POWER), **POWER)


@pytest.mark.extended
def test_light_behind_mirrors_and_holes(rgb):
    """Paths that pass delta surfaces first see direct light at their first smooth vertex, too."""
    scene = tray("delta", "rectangle")
    sides = [
        SessionBatches(integrator(direct_paths=count, bdd=1), scene, 2, seed)
        for seed, count in enumerate((1, 4))
    ]
    assert_same(*collect_until(*sides, **POWER), **POWER)


@in_one_thread
def test_noise_of_direct_light_falls(rgb):
    """Where nearly all noise is that of direct light, four independent paths have a quarter of the
    variance of one: ratio of two variances of 4000 values each, within 0.2 to 0.3 (false alarms
    below 1e-6)."""
    scene = tray("lambertian", "rectangle")
    variance = []
    for count in (1, 4):
        session = integrator(
            direct_paths=count,
            bdd=0,
            max_depth=3,
            initial_radius=1.0,
            sampler="independent",
            variance=True,
        ).session(scene, 0, 1, 0)
        for _ in range(64):
            session.iterate()
        variance.append(session.estimate()[1].mean())
    assert 0.2 < variance[1] / variance[0] < 0.3


def test_parts_make_the_same_image(rgb, monkeypatch):
    """Paths in several parts, the last one not full, are the paths of one part."""
    from mis_integrators.integrators import bdpm, direct_light

    scene = tray("lambertian", "rectangle")
    images = []
    for chunk in (1 << 21, 700):
        monkeypatch.setattr(bdpm, "CAMERA_CHUNK", chunk)
        monkeypatch.setattr(direct_light, "LARGEST_PART", chunk)
        session = integrator().session(scene, 0, 1, 0)
        session.iterate()
        assert session.direct_light.mean_paths > 0.1
        images.append(session.image())
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-5)


def test_only_where_photons_are_gathered(rgb):
    scene = tray("lambertian", "rectangle")
    paths = []
    for parameters in ({"max_depth": 2}, {"bdd": 0, "max_depth": 3}):
        session = integrator(direct_paths=4, **parameters).session(scene)
        session.start()
        paths.append(session.direct_light.mean_paths)
    assert paths == [0, 3]


def test_sessions_of_a_render_send_the_same_paths(rgb):
    """What another session has learned is all that it takes, the seed apart. The same but for the
    last digit: photons that threads have stored in another order are added in another order."""
    scene = tray("rough", "rectangle")
    one, other = (integrator(initial_radius=0).session(scene, 0, 7, 16) for _ in range(2))
    one.start()
    other.recall(one.learned)
    other.start()
    assert one.direct_light.mean_paths > 0
    np.testing.assert_array_equal(one.direct_light._paths, other.direct_light._paths)
    for session in (one, other):
        session.iterate(3)
    np.testing.assert_allclose(one.image(), other.image(), rtol=1e-5)


def test_none_where_there_is_no_time(rgb, monkeypatch):
    """Iterations take no longer for these paths than there is time left, or than the last one may,
    and what one is expected to take counts them."""
    scene, means = tray("lambertian", "rectangle"), []
    plugin = {"type": "bdpm", "bdd": 0, "max_depth": 4, "sampler": "independent"}
    for seconds, overtime in ((1e-6, 1.0), (1e-6, None), (20.0, None)):
        if overtime:
            monkeypatch.setattr("mis_integrators.integrators.piloted.OVERTIME", overtime)
        else:
            monkeypatch.undo()
        session = mi.load_dict(plugin).session(scene, 0, 1, 0)
        session.plan_time(seconds)
        session.predict()
        light = session.direct_light
        means.append(light.mean_paths)
        cost = light.path_seconds * SIZE**2 / session.gathering_seconds
        assert light.cost == pytest.approx(1 + min(max(cost, CHEAPEST), 1) * light.mean_paths)
        expected = session.gathering_seconds * light.cost
        assert session.expected_seconds == pytest.approx(expected)
    assert means[0] == 0 and means[1] > 0.05 and means[2] > 0.05


@pytest.mark.long
def test_noise_of_an_iteration(rgb):
    """The variance of direct light that an image of one iteration tells: that of forty renders,
    within 0.3 in the mean over all pixels (the ratio's deviation is 0.054: false alarms below
    1e-6)."""
    scene = tray("rough", "rectangle")
    images = []
    for seed in range(40):
        session = integrator(bdd=1, direct_paths=2, denoised=True, sampler="independent").session(
            scene, 0, seed
        )
        session.iterate()
        images.append(session.image())
    *direct, variance = (session.channels.index(name) for name in direct_channels())
    images = np.array(images)
    truth = images[..., direct].mean(axis=-1).var(axis=0, ddof=1)
    assert np.mean(images[-1, ..., variance]) == pytest.approx(truth.mean(), rel=0.3)
    assert truth.mean() < 0.5 * np.mean(images[..., direct] ** 2)


def test_purposes_differ():
    """Those of the sessions of photon maps, and of those that connect sub-paths."""
    from mis_integrators.integrators import purposes

    shared = purposes.LIGHT, purposes.CAMERA, purposes.WAVELENGTH
    for own in (
        ("FROZEN", "DIRECT", "CAUSTIC_RADII", "SENSOR"),
        ("APERTURE", "SHADOWS"),
        ("APERTURE", "START", "DRAW"),
    ):
        numbers = [*shared, *(getattr(purposes, name) for name in own)]
        assert len(set(numbers)) == len(numbers)


def test_range(rgb):
    with pytest.raises(Exception, match='parameter "direct_paths" = -1'):
        integrator(direct_paths=-1)
