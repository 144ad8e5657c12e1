"""The plugins `pcbpt` and `bdpt_ris` in participating media: images against `volpath`, a closed
form, one weight function whichever technique makes a path, and what is refused.

Comparisons of renders: false-alarm rate 1e-6 each; an error of 2 % of the whole image and of 6 % of
a quarter is seen with a probability of 0.95, where a test says nothing else (`comparing`).
"""

from mis_integrators.paths.subpaths import read_vertices
from mis_integrators.resampling.light_vertices import END

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import SessionBatches, assert_same, collect_until
from foggy import agree_with_volpath
from selection import extended
from test_bdpm import last_words
from test_bdpt_media import (
    POINT,
    SCENES,
    SIGMA_T,
    curtain,
    fog_scene,
    foggy_room,
    homogeneous,
    point_in_fog,
)
from test_bdpt_ris import ResampledPaths, plugin

MORE = (
    "forward",
    "pockets",
    "lens within",
    "nested",
    "rough glass",
    "mask",
    "thin glass",
    "lamp within",
    "sky",
    "sun",
)
"""Scenes of `test_bdpt_media` with other media, boundaries and emitters; phase functions are tested
there."""


@pytest.mark.parametrize(
    "name, scene, parameters",
    [
        *extended(
            ("bdpt_ris", "grid", {"target": "f_y_f_yz", "resamples": 2}),
            ("pcbpt", "coloured", {"light_paths": 50}),
            *(("bdpt_ris", name, {}) for name in ("glass", *MORE)),
            ("pcbpt", "half the light", {"light_paths": 10, "cache_neighbors": 1}),
            ("pcbpt", "lamp within", {"light_tracing": 0.125}),
        ),
    ],
)
def test_agrees_with_volpath(rgb, name, scene, parameters):
    agree_with_volpath(
        plugin(name, max_depth=6, camera_paths=16, **parameters),
        SCENES[scene](),
        most=900,
        whole=0.02,
        block=0.06,
    )


def test_single_scattering_in_closed_form(rgb):
    """An infinite medium without any shape: all cache points lie in it."""
    scene, exact = point_in_fog(1.0, 0.5)
    batches = SessionBatches(plugin("bdpt_ris", max_depth=2), scene, 2)
    batches.add(2)
    assert_same(*collect_until(batches, exact, 0.01, 0.02), 0.01, 0.02, slack=1e-3)


def test_targets_in_an_infinite_medium(rgb):
    """At cache points, which all lie in the medium, a point light of intensity one sends
    exp(-sigma_t d) / d^2 whatever the direction."""
    scene, _ = point_in_fog(1.0, 0.5)
    session = plugin("bdpt_ris", max_depth=2, light_paths=10).session(scene, 0, 1, 0)
    session.start()
    spectral = session._spectral(0)
    r, seen, *_ = session._pilot_targets(
        scene,
        session.sensor,
        session._tables,
        session._sequence(1, 0, 10),
        session._light(0, 0, spectral),
        mi.UInt32(0),
        session.cache,
        spectral,
    )
    points = np.array(session.cache["p"]).T
    distance = np.linalg.norm(points - POINT, axis=1)
    expected = np.exp(-SIGMA_T * distance) / distance**2
    found = (np.array(r) * np.array(seen)).reshape(len(points), -1)[:, :10]
    # Shadow rays end a little before the light, by 0.15 % of their length.
    np.testing.assert_allclose(found, np.repeat(expected[:, None], 10, axis=1), rtol=6e-3)


def test_strengths_in_an_infinite_medium(rgb):
    """Light sub-paths from a point of intensity one arrive with 4 pi times the albedo of the
    vertices before, whatever lies between."""
    scene, _ = point_in_fog(0.5, 0.5)
    session = plugin("pcbpt", max_depth=8).session(scene, 0, 1, 0)
    vertices, count, _ = session._light(0, 0, session._spectral(0))
    y = read_vertices(vertices, dr.arange(mi.UInt32, int(count[0])), True, states=END)
    depth, strength = np.array(y["depth"]), np.array(y["strength"])
    assert set(depth) == set(range(1, 8))
    np.testing.assert_allclose(strength, 4 * np.pi * 0.5 ** (depth - 1.0), rtol=1e-4)


@pytest.mark.long
def test_half_transparent_surfaces(rgb):
    """Most light comes through a mask: steps of camera paths go on beyond it as if it were not
    there. An error of 2 % of the image and of 4 % of a quarter is seen."""
    agree_with_volpath(
        plugin("bdpt_ris", max_depth=2, camera_paths=16),
        curtain(0.3, 0.9, 20.0),
        whole=0.02,
        block=0.04,
    )


@pytest.mark.long
@pytest.mark.parametrize(
    "name, light, sensor, length, parameters",
    [
        ("bdpt_ris", "area", "perspective", 3, {"resamples": 4, "light_paths": 30}),
        ("bdpt_ris", "area", "perspective", 3, {"merging": True, "initial_radius": 0.02}),
        *extended(
            ("bdpt_ris", "point", "thinlens", 3, {}),
            ("pcbpt", "area", "perspective", 4, {"light_tracing": 4}),
        ),
    ],
)
def test_weights_sum_to_one(rgb, name, light, sensor, length, parameters):
    """Each technique's weight for the same joint path through the fog, from its own code; some in a
    thousand lose by rounding at grazing angles."""
    paths = ResampledPaths(foggy_room(light, sensor), length, name=name, **parameters)
    by_technique = paths.weights()
    total = sum(by_technique.values())
    assert len(total) > 100
    assert np.mean(np.abs(total - 1) < 1e-4) > 0.9 and np.mean(np.abs(total - 1) < 2e-3) > 0.995, (
        np.sort(np.abs(total - 1))[-20:]
    )
    used = {s for s, w in by_technique.items() if w.max() > 1e-3}
    assert used == set(by_technique) - ({0} if light == "point" else set())


@pytest.mark.parametrize(
    "name, parameters, words",
    [
        ("bdpt_ris", {"weights": "published"}, '"weights" = published'),
        ("pcbpt", {"weights": "published"}, '"weights" = published'),
    ],
)
def test_what_media_do_not_have_is_refused(rgb, name, parameters, words):
    with pytest.raises(Exception) as error:
        mi.render(fog_scene(homogeneous()), integrator=plugin(name, **parameters), spp=2)
    assert f"{name}: parameter {words} is not supported in scenes with" in last_words(error.value)
