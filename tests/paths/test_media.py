"""Free flight, transmittance, and the media in which emitters stand.

Statistical tests: false-alarm rate 1e-6 each.
"""

from mis_integrators.core.random import streams
from mis_integrators.core.sequences import SampleSequence
from mis_integrators.core.traits import SceneTraits, UnsupportedScene
from mis_integrators.lights.lights import Lights
from mis_integrators.paths.media import fly, interaction_at, sample_phase, transmitted
from mis_integrators.paths.vertex import Sides

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import Estimate, assert_frequencies, differences
from foggy import PLAIN, container, grid, pockets
from test_bdpt_media import FOG, ball, coloured, fog_scene, homogeneous
from worlds import T, diffuse

COUNT = 1 << 16


def draws(seed=0):
    """Independent random numbers of `COUNT` paths at a vertex."""
    sequence = SampleSequence(mi.UInt32(seed), mi.UInt32(0), 1, False)
    return sequence.of_paths(dr.arange(mi.UInt32, COUNT)).at(0)


def flown(scene, o, d, medium=None, seed=0):
    """What `fly` finds along a ray."""
    traits = SceneTraits(scene, scene.sensors()[0] if scene.sensors() else None)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, COUNT) + mi.Point3f(*o), mi.Vector3f(*d))
    medium = dr.zeros(mi.MediumPtr, COUNT) if medium is None else medium
    hit, ray, medium, scatters, weight = fly(
        scene, traits, ray, medium, draws(seed), mi.Spectrum(1), True
    )
    return np.array(ray(hit.t)), np.array(scatters), np.array(weight), medium


def kept(scene, o, d, distance):
    """Transmittance (COUNT estimates a channel) along a ray that starts in no medium."""
    traits = SceneTraits(scene)
    p = dr.zeros(mi.Point3f, COUNT) + mi.Point3f(*o)
    d, none = mi.Vector3f(*d), dr.zeros(mi.MediumPtr, COUNT)
    sides = Sides(none, none, p, [])
    rng = streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(3))
    n = dr.zeros(mi.Vector3f, COUNT)
    return np.array(transmitted(scene, traits, p, n, sides, d, mi.Float(distance), [], rng, True))


def estimate(values):
    """The mean of independent numbers, one a row, by 64 groups."""
    return Estimate.of([group.mean(axis=1)[None] for group in np.split(values, 64, axis=1)])


def test_flights_are_exponential(rgb):
    """Through a cube of a medium between z = -1 and z = 1: where they end, and what they carry."""
    sigma, albedo = 1.3, 0.6
    scene = mi.load_dict({"type": "scene", "cube": container(homogeneous(sigma, albedo))})
    p, scatters, weight, medium = flown(scene, (0.2, 0.1, 3), (0, 0, -1))
    assert (np.array(medium != None) == scatters).all()  # noqa: E711 (array comparison)
    np.testing.assert_allclose(weight, np.where(scatters, albedo, 1)[None].repeat(3, 0), rtol=1e-5)
    edges = np.linspace(0, 2, 41)
    counts = np.histogram(1 - p[2][scatters], edges)[0]
    law = np.exp(-sigma * edges)
    assert_frequencies([*counts, (~scatters).sum()], COUNT * np.array([*-np.diff(law), law[-1]]))


@pytest.mark.parametrize("kind", ["coloured", "grid"])
def test_free_flight_is_the_transmittance_of_each_channel(rgb, kind):
    """What passes a medium, by free flight and by ratio tracking; of a homogeneous one by Beer's
    law, too. And what scatters there is the albedo's share of all the rest."""
    medium = coloured() if kind == "coloured" else grid(pockets, scale=2.0)
    scene = mi.load_dict({"type": "scene", "cube": container(medium)})
    o, d = (0.1, -0.2, 3), (0, 0, -1)
    _, scatters, weight, _ = flown(scene, o, d)
    passed, tracked = estimate(weight * ~scatters), estimate(kept(scene, o, d, 6.0))
    assert not differences(passed, tracked)
    assert np.sqrt(passed.error2.max()) < 0.01
    albedo = np.array([0.9, 0.8, 0.5]) if kind == "coloured" else np.full(3, 0.8)
    scattered = estimate(weight * scatters / albedo[:, None])
    assert not differences(scattered, Estimate.exact(1 - tracked.mean), slack=0.01)
    if kind == "coloured":
        law = Estimate.exact(np.exp(-2 * 2.5 * np.array([[0.2, 0.4, 1.0]])))
        # Crossing a boundary skips a few ten-thousandths.
        assert not differences(tracked, law, slack=1e-3)
        assert not differences(passed, law, slack=1e-3)


def test_many_flights_make_no_channel_bright(rgb):
    """Ten flights through a medium that absorbs nothing, whose channels scatter differently: the
    sum of the channels' throughput stays what it was, and each channel's flights have its law."""
    medium = coloured() | {"albedo": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    scene = mi.load_dict({"type": "scene", "cube": container(medium, 1000.0)})
    traits = SceneTraits(scene)
    sequence = SampleSequence(mi.UInt32(5), mi.UInt32(0), 1, False)
    numbers = sequence.of_paths(dr.arange(mi.UInt32, COUNT))
    ray = mi.Ray3f(dr.zeros(mi.Point3f, COUNT) + mi.Point3f(0, 0, 900), mi.Vector3f(0, 0, -1))
    throughput = mi.Spectrum(dr.full(mi.Float, 1, COUNT))
    inside = mi.MediumPtr(traits.media[0])
    sigma = 2.5 * np.array([0.2, 0.4, 1.0])
    for flight in range(10):
        hit, ray, inside, scatters, weight = fly(
            scene, traits, ray, inside, numbers.at(flight), throughput, True
        )
        assert np.array(scatters).all()
        throughput *= weight
        length = np.array(hit.t)
        ray.o = ray(hit.t)
        dr.eval(ray, inside, throughput)
    np.testing.assert_allclose(np.array(throughput).sum(axis=0), 3, rtol=1e-3)
    assert not differences(estimate(np.array(throughput)), Estimate.exact(np.ones((1, 3))))
    law = Estimate.exact(1 / sigma[None])
    assert not differences(estimate(np.array(throughput) * length), law)


def test_flights_cross_boundaries(rgb):
    """Two boxes, one within the other, a mask between them and the floor: paths stop at the mask
    (their next direction decides whether they pass), connections take its share."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": {**homogeneous(0.5, 1.0), "id": "fog"},
            "outer": container(FOG),
            "inner": {**container(homogeneous(2.0, 1.0), 0.5), "exterior": FOG},
            "mask": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, -2]),
                "bsdf": {"type": "mask", "opacity": 0.25, "nested": diffuse()},
            },
        }
    )
    law = np.exp(-(0.5 * 1 + 2.0 * 1))
    p, scatters, _, medium = flown(scene, (0.1, 0.2, 3), (0, 0, -1))
    through = ~scatters
    assert_frequencies(
        [(scatters & (p[2] > 0.5)).sum(), (scatters & (abs(p[2]) <= 0.5)).sum(), through.sum()]
        + [(scatters & (p[2] < -0.5)).sum()],
        COUNT
        * np.array(
            [
                1 - np.exp(-0.25),
                np.exp(-0.25) * (1 - np.exp(-2)),
                law,
                np.exp(-2.25) * (1 - np.exp(-0.25)),
            ]
        ),
    )
    np.testing.assert_allclose(p[2][through], -2, atol=1e-4)
    assert not np.array(medium != None)[through].any()  # noqa: E711 (array comparison)
    # Crossing a boundary skips a few ten-thousandths.
    np.testing.assert_allclose(kept(scene, (0.1, 0.2, 3), (0, 0, -1), 6.0), 0.75 * law, rtol=1e-3)
    np.testing.assert_allclose(kept(scene, (0.1, 0.2, 3), (0, 0, -1), 4.5), law, rtol=1e-3)


# --- Media in which emitters stand --------------------------------------------

LAMP = {"type": "sphere", "radius": 0.1, "emitter": {"type": "area"}}
POINT = {"type": "point", "intensity": 1.0}


@pytest.mark.parametrize(
    "lamp, inside",
    [
        ({**POINT, "position": [0.2, 0, 0]}, True),
        ({**POINT, "position": [0, 3, 0]}, False),
        ({**LAMP, "center": [0.2, 0, 0]}, True),
        ({**LAMP, "center": [0.2, 0, 0], "exterior": FOG}, True),
        ({**LAMP, "center": [0, 3, 0]}, False),
        ({"type": "constant"}, False),
        ({"type": "directional", "direction": [0, -1, 0]}, False),
    ],
)
def test_emitters_find_their_medium(rgb, lamp, inside):
    """By the boundary around them, whatever they say and whatever walls stand there."""
    scene = fog_scene(homogeneous(), lamp=lamp, ball=ball(diffuse(), 0.1, center=[0.5, 0, 0]))
    lights = Lights(scene, "bdpt")
    lights.find_media(scene.sensors()[0], "bdpt")
    found = lights.medium_at(mi.EmitterPtr(scene.emitters()[0]))
    assert bool(np.array(found != None)[0]) == inside  # noqa: E711 (array comparison)


def test_emitters_in_several_media_are_refused(rgb):
    """A lamp that a boundary cuts in two halves."""
    scene = fog_scene(homogeneous(), lamp={**LAMP, "center": [0, 1, 0]})
    with pytest.raises(UnsupportedScene, match=r"AreaLight .* stands in several media"):
        Lights(scene, "bdpt").find_media(scene.sensors()[0], "bdpt")


def test_directions_stay_unit_vectors(rgb):
    """However often a path scatters: what rounding adds must not grow from one to the next."""
    medium, count = mi.load_dict(homogeneous(phase={"type": "hg", "g": 0.7})), 1000
    rng = streams(dr.arange(mi.UInt32, count), mi.UInt32(1))
    direction = dr.normalize(mi.Vector3f(1, 2, 3) + dr.zeros(mi.Vector3f, count))
    hit = dr.zeros(mi.PreliminaryIntersection3f, count)
    hit.t = mi.Float(1)
    everywhere = dr.ones(mi.Bool, count)
    for _ in range(60):
        si = interaction_at(hit, mi.Ray3f(mi.Point3f(0), direction), everywhere, everywhere)
        point = mi.Point2f(rng.next_float32(), rng.next_float32())
        sample, _ = sample_phase(
            PLAIN,
            mi.MediumPtr(medium),
            si,
            rng.next_float32(),
            point,
            dr.zeros(mi.BSDFSample3f, count),
            mi.Spectrum(1),
            everywhere,
        )
        direction = si.to_world(sample.wo)
        dr.eval(direction, rng)
    assert np.abs(np.array(dr.norm(direction)) - 1).max() < 1e-5


@pytest.mark.parametrize("scale, at", [(1, 0), (0.05, 0), (1, 30)])
def test_short_ways_through_boundaries(rgb, scale, at):
    """From within a cube of fog to a lamp that is closer above it than a new ray begins in front of
    the boundary: the light of that way, not none."""
    above = 2e-3 * scale
    place = T().translate([at, 0, scale + above]).scale(scale)
    shape = {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "cube": container(homogeneous(0.5 / scale), scale, (at, 0, 0)),
            "lamp": shape,
        }
    )
    traits = SceneTraits(scene)
    p, d = mi.Point3f(at, 0, 0.9 * scale), mi.Vector3f(0, 0, 1)
    (fog,) = (shape.interior_medium() for shape in scene.shapes() if shape.is_medium_transition())
    medium = mi.MediumPtr(fog)
    way = 0.1 * scale + above
    rng = streams(mi.UInt32(0), mi.UInt32(3))
    sides = Sides(medium, medium, p, [])
    n = mi.Vector3f(0, 0, 1)
    found = transmitted(scene, traits, p, n, sides, d, mi.Float(way), [], rng, mi.Bool(True))
    np.testing.assert_allclose(np.array(found).ravel(), np.exp(-0.05), rtol=2e-2)
