"""Emitters chosen for direct light by what they bring to a place."""

from mis_integrators.core.random import next_2d, streams
from mis_integrators.lights.lights import Lights
from mis_integrators.lights.nearby import (
    BLIND_SHARE,
    MOST_SAMPLES,
    POINTS,
    box_of_view,
    grid_shape,
    probabilities,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import T, diffuse, film, look

COUNT = 1 << 18


@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.tuples(*[st.integers(1, 4)] * 3),
    st.integers(1, 5),
)
def test_probabilities(seed, shape, emitters):
    """Each cell's sum to one; what shines is never starved, what is dark never chosen; an emitter
    that brings all light to a cell and its neighbours has all but the blind share."""
    random = np.random.default_rng(seed)
    light = random.exponential(size=(*shape, emitters)) * random.integers(0, 2, (*shape, emitters))
    shines = np.arange(emitters) != 1
    found = probabilities(light * random.integers(0, 2, light.shape), light, shines)
    np.testing.assert_allclose(found.sum(axis=1), 1)
    assert (found[:, shines] >= BLIND_SHARE / 2 / shines.sum() - 1e-12).all()
    assert (found[:, ~shines] == 0).all()
    alone = np.zeros_like(light)
    alone[..., 0] = 1
    assert (probabilities(alone, light, shines)[:, 0] >= 1 - BLIND_SHARE - 1e-12).all()
    nothing = probabilities(np.zeros_like(light), np.zeros_like(light), shines)
    np.testing.assert_allclose(nothing, np.tile(shines / shines.sum(), (len(nothing), 1)))


@given(st.tuples(*[st.floats(0, 1e6)] * 3), st.integers(1, 10**6))
def test_cells_are_few(extents, emitters):
    """There is a cell, no matter how flat the box, and no more samples than allowed."""
    shape = grid_shape(extents, emitters)
    assert (shape >= 1).all()
    assert np.prod(shape) == 1 or np.prod(shape) * POINTS * emitters <= MOST_SAMPLES


def hall(**more):
    """A floor of two kilometres, of which the camera sees a square of four metres, and a wall,
    under a strong lamp far up and a weak spot near the ground."""
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(1000), "bsdf": diffuse(0.5)},
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 5, 2]).rotate([1, 0, 0], 90).scale([5, 2, 1]),
                "bsdf": diffuse(0.5),
            },
            "lamp": {"type": "point", "position": [0, 0, 6], "intensity": 20.0},
            "spot": {
                "type": "spot",
                "to_world": look((1, 0, 1), (1, 0, 0)),
                "cutoff_angle": 20,
                "beam_width": 19.9,
                "intensity": 3.0,
            },
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 3), (0, 0, 0)) @ T().scale([2, 2, 1]),
                "film": film(16),
            },
            **more,
        }
    )


def direct_light(scene, lights):
    """Direct light at points of the floor with x in [0.8, 1.2], |y| < 0.2, of independent choices;
    the densities of the choices as sampled and as asked for again."""
    rng = streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(5))
    place = next_2d(rng)
    down = mi.Ray3f(
        mi.Point3f(0.8 + 0.4 * place.x, 0.4 * place.y - 0.2, 0.5), mi.Vector3f(0, 0, -1)
    )
    si = scene.ray_intersect(down)
    ds, light, pdf = lights.sample_direct(si, rng, mi.Bool(True))
    again = lights.pdf_direct(si, ds, mi.Bool(True))
    value = light.x * dr.maximum(ds.d.z, 0)
    return np.array(value), np.array(pdf), np.array(again) * np.ones(COUNT)


def test_spots_are_not_starved(rgb):
    """Irradiance in a spot's cone is right (5.3 standard errors: 1e-7), its variance a fraction of
    what the choice by power makes. (All random numbers are fixed.)"""
    scene = hall()
    lights = Lights.seen_by(scene, scene.sensors()[0], "bdpm")
    value, *_ = direct_light(scene, lights)
    x, y = np.meshgrid(np.linspace(0.8, 1.2, 401), np.linspace(-0.2, 0.2, 401))
    expected = np.mean(20 * 6 / (x**2 + y**2 + 36) ** 1.5 + 3 / ((x - 1) ** 2 + y**2 + 1) ** 1.5)
    error = value.std() / np.sqrt(COUNT)
    assert abs(value.mean() - expected) < 5.3 * error + 2e-3 * expected
    assert 5.3 * error < 0.02 * expected, "test too weak"
    lights.nearby = None
    by_power, *_ = direct_light(scene, lights)
    assert value.var() < 0.3 * by_power.var(), value.var() / by_power.var()


def test_densities_of_choices(rgb):
    """The density of each choice is what `pdf_direct` says of it: with it rays that meet a lamp by
    chance are weighed against those sent there."""

    def lamp(x, size):
        return {
            "type": "sphere",
            "center": [x, 0, 1.5],
            "radius": size,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}},
        }

    scene = hall(lamp=lamp(1, 0.1), spot=lamp(-1, 0.2))
    lights = Lights.seen_by(scene, scene.sensors()[0], "bdpm")
    _, stated, again = direct_light(scene, lights)
    np.testing.assert_allclose(again, stated, rtol=2e-3)
    place, number = mi.Point3f(1, 0, 0), mi.UInt32([0, 1])
    assert abs(lights.nearby.probability(place, number)[0] - lights.choice.pmf[0]) > 0.05


def test_hidden_lamps_are_asked_seldom(rgb):
    """A lamp below the floor, the brightest of all, takes little from those above."""
    scene = hall(cellar={"type": "point", "position": [1, 0, -0.5], "intensity": 500.0})
    lights = Lights.seen_by(scene, scene.sensors()[0], "bdpm")
    cellar = int(np.argmax(lights.choice.pmf))
    up = mi.Point3f(1, 0, 0.02)
    assert float(lights.choice.pmf[cellar]) > 0.6
    assert lights.nearby.probability(up, mi.UInt32(cellar))[0] < 0.15


def test_one_emitter_has_no_table(rgb):
    """What a scene does not need is not made."""
    scene = mi.load_dict({"type": "scene", "lamp": {"type": "point"}})
    assert Lights(scene).nearby is None


@pytest.mark.parametrize("see", [True, False])
def test_box(rgb, see):
    """The box is around what is seen; all of the scene where nothing is."""
    scene = hall() if see else mi.load_dict({"type": "scene", "lamp": {"type": "point"}})
    sensor = scene.sensors()[0] if see else mi.load_dict({"type": "perspective"})
    low, extents = box_of_view(scene, sensor)
    if see:
        np.testing.assert_allclose(extents[:2], 12, rtol=0.05)
        np.testing.assert_allclose(low[:2], -6, rtol=0.05)
    else:
        assert (extents > 0).all()
    whole = box_of_view(scene, None)[1]
    assert whole[0] == (2000 if see else 2)
