"""The parameter `hide_emitters` in participating media: images and alpha for every way in which
light comes to the sensor, against `foggy.oracle_for` and, where no lamp is in the fog, `volpath`.

Comparisons of renders as in `test_bdpt_media` and `test_bdpm_media`: false-alarm rate 1e-6 each; an
error of 2 % of the whole image and of 6 % of a quarter is seen with a probability of 0.95, where a
test says nothing else (`comparing`).
"""

import mitsuba as mi
import numpy as np
import pytest
from comparing import PathBatches, agree, assert_same, collect_until, in_one_thread
from foggy import agree_with_volpath, lamp, oracle_for, view, volpath
from selection import extended
from test_bdpm_media import SLACK, bdpm
from test_bdpm_media import agree_with_volpath as bdpm_agrees
from test_bdpt_media import FOG, ball, bdpt, fog_scene, homogeneous
from test_bdpt_ris import plugin
from test_opt_media import SmallRadius
from test_sensor_light import agree as joined_agrees
from test_sensor_light import joined
from test_vcm import vcm
from worlds import diffuse, film, grey


@pytest.fixture(autouse=True)
def _rgb(rgb):
    pass


def before_the_fog():
    return lamp((-0.1, 0.6, 3.2), 0.12, 20.0)


def hidden_lamps(**options):
    """Fog under a dim sky, with lamps in it: a bare one, and one inside a half transparent ball.
    A third one stands before the fog."""
    mask = {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "nested": diffuse()}}
    shines = {"type": "area", "radiance": 5.0}
    return fog_scene(
        homogeneous(),
        view((0, 0.7, 4.2), **options),
        bare=ball(diffuse(), 0.25, center=[0.4, 0.3, 0.2], emitter=shines),
        veil=ball(mask, 0.3, center=[-0.5, 0, 0], exterior=FOG, interior=FOG),
        veiled=ball(diffuse(), 0.15, center=[-0.5, 0, 0], emitter=shines),
        near=before_the_fog(),
        sky={"type": "constant", "radiance": grey(0.2)},
    )


def hiding(**parameters):
    return {"max_depth": 6, "camera_paths": 16, "hide_emitters": True, **parameters}


@pytest.mark.extended
def test_agrees_with_volpath_before_the_fog():
    scene = fog_scene(homogeneous(), near=before_the_fog())
    oracle = volpath(max_depth=6, hide_emitters=True)
    agree(bdpt(**hiding()), oracle, scene, blocks=2, whole=0.01, block=0.03, spp=512)


@pytest.mark.long
@pytest.mark.parametrize("name", ["bdpt", *extended("bdpt_ris", "pcbpt", "vcm")])
def test_connections(name):
    """(Wider balls of `vcm` lose light at the lamps.)"""
    if name == "vcm":
        made = vcm(**hiding(initial_radius=0.005))
    else:
        made = bdpt(**hiding()) if name == "bdpt" else plugin(name, **hiding())
    agree_with_volpath(made, hidden_lamps(), most=900, whole=0.02, block=0.06)


def test_light_that_hidden_lamps_scatter_is_hidden():
    """A dim lamp in the light of a bright point, in next to no fog: nothing else scatters."""
    scene = fog_scene(
        homogeneous(1e-5),
        floor=None,
        lamp={"type": "point", "position": [1.5, 3, 3], "intensity": grey(50.0)},
        dim=ball(diffuse(), emitter={"type": "area", "radiance": 1e-3}),
    )
    shown, hidden = (
        np.array(mi.render(scene, integrator=bdpt(hide_emitters=hide), spp=64)).mean()
        for hide in (False, True)
    )
    assert hidden < 1e-3 * shown


@pytest.mark.parametrize("bdd", extended(0, 1))
def test_photons_along_beams(bdd):
    bdpm_agrees(hidden_lamps(), **hiding(bdd=bdd, direct_paths=3))


@pytest.mark.parametrize("bdd", extended(0, 1))
def test_photons_joined_with_the_sensor(bdd):
    joined_agrees(hidden_lamps(), **hiding(bdd=bdd))


@pytest.mark.extended
def test_photons_around_points():
    """The errors seen are those of `test_opt_media`."""
    mine = SmallRadius(hidden_lamps(), 2, **hiding())
    oracle = PathBatches(oracle_for(6, hide_emitters=True), hidden_lamps(), 2, 512)
    assert_same(*collect_until(mine, oracle, 0.03, 0.09, most=600), 0.03, 0.09, slack=2 * SLACK)


@in_one_thread
def alpha(session, iterations):
    for _ in range(iterations):
        session.iterate()
    return session.image()[:, :, 3]


@pytest.mark.long
@pytest.mark.parametrize(
    "made",
    [
        *extended(
            lambda scene: bdpt(**hiding()).session(scene, seed=1, spp=0),
            lambda scene: bdpm(**hiding(initial_radius=0.1)).session(scene, seed=1, spp=0),
        ),
        lambda scene: joined(scene, **hiding()),
    ],
    ids=["bdpt", "beams", "joined"],
)
def test_alpha(made):
    """Of 1024 paths a pixel, and of 4096 of the oracle: alpha's standard deviations are below 0.016
    and 0.008 there, and seven of their sum is seen (some 256 pixels: false alarms below 1e-8)."""
    scene = hidden_lamps(film=film(16, pixel_format="rgba"))
    oracle = mi.render(scene, integrator=oracle_for(6, hide_emitters=True), spp=4096, seed=5)
    oracle = np.array(oracle)[:, :, 3]
    found = alpha(made(scene), 64)
    assert oracle.min() < 0.5 < oracle.max()
    assert np.abs(found - oracle).max() < 7 * np.hypot(0.016, 0.008)
    shown = alpha(bdpt(camera_paths=16).session(scene, seed=1, spp=0), 1)
    assert shown.min() > 0.99  # the sky counts where it is not hidden
