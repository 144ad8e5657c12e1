"""The plugins `pcbpt` and `bdpt_ris` in participating media: images against `volpath`, a closed
form, one weight function whichever technique makes a path, and what is refused.

Comparisons of renders: false-alarm rate 1e-6 each; an error of 2 % of the whole image and of 6 % of
a quarter is seen with a probability of 0.95, where a test says nothing else (`comparing`).
"""

import mitsuba as mi
import numpy as np
import pytest
from comparing import SessionBatches, agree, assert_same, collect_until
from foggy import volpath
from selection import extended
from test_bdpm import last_words
from test_bdpt_media import SCENES, fog_scene, foggy_room, homogeneous, point_in_fog
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
        ("bdpt_ris", "glass", {}),
        ("bdpt_ris", "grid", {"target": "f_y_f_yz", "resamples": 2}),
        ("pcbpt", "coloured", {"light_paths": 50}),
        *extended(
            *(("bdpt_ris", name, {}) for name in MORE),
            ("pcbpt", "half the light", {"light_paths": 10, "cache_neighbors": 1}),
            ("pcbpt", "lamp within", {"light_tracing": 0.125}),
        ),
    ],
)
def test_agrees_with_volpath(rgb, name, scene, parameters):
    agree(
        plugin(name, max_depth=6, camera_paths=16, **parameters),
        volpath(max_depth=6),
        SCENES[scene](),
        blocks=2,
        spp=512,
        whole=0.02,
        block=0.06,
        most=900,
    )


def test_single_scattering_in_closed_form(rgb):
    """An infinite medium without any shape: all cache points lie in it."""
    scene, exact = point_in_fog(1.0, 0.5)
    batches = SessionBatches(plugin("bdpt_ris", max_depth=2), scene, 2)
    batches.add(2)
    assert_same(*collect_until(batches, exact, 0.01, 0.02), 0.01, 0.02, slack=1e-3)


@pytest.mark.parametrize(
    "name, light, sensor, length, parameters",
    [
        ("bdpt_ris", "area", "perspective", 3, {"resamples": 4, "light_paths": 30}),
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
        ("bdpt_ris", {"hide_emitters": True}, '"hide_emitters"'),
    ],
)
def test_what_media_do_not_have_is_refused(rgb, name, parameters, words):
    with pytest.raises(Exception) as error:
        mi.render(fog_scene(homogeneous()), integrator=plugin(name, **parameters), spp=2)
    assert f"{name}: parameter {words} is not supported in scenes with" in last_words(error.value)
