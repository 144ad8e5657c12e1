"""The plugin `bdpt` in participating media: images against `volpath`, closed forms, each technique
alone, and what is refused.

Comparisons of renders: false-alarm rate 1e-6 each; an error of 2 % of the whole image and of 6 % of
a quarter is seen with a probability of 0.95, where a test says nothing else (`comparing`).
"""

from mis_integrators.core.sequences import SampleSequence
from mis_integrators.core.traits import SceneTraits
from mis_integrators.lights.lights import Lights
from mis_integrators.mis.vertex_merging import ConnectionWeights, Merging
from mis_integrators.paths.setting import CameraPass, LightPass, Limits, World
from mis_integrators.paths.subpaths import (
    NO_PARENT,
    read_vertices,
    trace_camera_subpaths,
    trace_light_subpaths,
    vertex_bsdf_of,
)
from mis_integrators.paths.vertex import facing, in_medium

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    SessionBatches,
    assert_same,
    block_means,
    collect_until,
    differences,
)
from foggy import agree_with_volpath, container, even, flaky, floor, grid, lamp, pockets, view
from selection import extended
from test_bdpm import last_words
from test_bdpt import JointPaths, pyramid, technique_estimates
from worlds import T, diffuse, grey, lamp_inside, look

FOG = {"type": "ref", "id": "fog"}


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 6, "camera_paths": 16, **parameters})


def homogeneous(sigma_t=1.0, albedo=0.8, phase=None):
    """A medium without colour; isotropic if no phase function is given."""
    medium = {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo}
    return medium | ({} if phase is None else {"phase": phase})


def hg(g):
    return {"type": "hg", "g": g}


def coloured():
    """Extinction and albedo of each channel are others'."""
    return {
        "type": "homogeneous",
        "scale": 2.5,
        "sigma_t": {"type": "rgb", "value": [0.2, 0.4, 1.0]},
        "albedo": {"type": "rgb", "value": [0.9, 0.8, 0.5]},
    }


def tabulated():
    return {"type": "tabphase", "values": "0.5, 1.0, 0.3, 1.5"}


def blended():
    return {"type": "blendphase", "weight": 0.3, "a": hg(0.6), "b": {"type": "rayleigh"}}


def fog_scene(medium, sensor=None, **objects):
    """A cube of fog above a floor, under a lamp (`None` leaves one of them out)."""
    scene = {
        "type": "scene",
        "fog": {**medium, "id": "fog"},
        "cube": container(FOG),
        "floor": floor(),
        "lamp": lamp(),
        "sensor": sensor or view((0, 0.7, 4.2)),
        **objects,
    }
    return mi.load_dict({name: thing for name, thing in scene.items() if thing is not None})


def ball(bsdf, radius=0.5, **extra):
    return {"type": "sphere", "radius": radius, "bsdf": bsdf, **extra}


def inner(sigma_t=3.0):
    """Boundaries of a ball of another medium within the fog."""
    return {"exterior": FOG, "interior": homogeneous(sigma_t, 0.7)}


WITHIN = ((0.6, 0.3, 0.7), (-0.3, -0.2, 0))
"""Where a sensor is in the fog, and what it looks at."""

SCENES = {
    "half the light": lambda: fog_scene(homogeneous(albedo=0.5)),
    "all the light": lambda: fog_scene(homogeneous(albedo=1.0)),
    "forward": lambda: fog_scene(homogeneous(2.0, 0.9, hg(0.7))),
    "backward": lambda: fog_scene(homogeneous(2.0, 0.9, hg(-0.5))),
    "rayleigh": lambda: fog_scene(homogeneous(phase={"type": "rayleigh"})),
    "tabulated": lambda: fog_scene(homogeneous(phase=tabulated())),
    "blended": lambda: fog_scene(homogeneous(phase=blended())),
    "grid": lambda: fog_scene(grid(even, scale=3.0, g=0.3)),
    "pockets": lambda: fog_scene(grid(pockets, scale=3.0)),
    "coloured": lambda: fog_scene(coloured()),
    "sensor within": lambda: fog_scene(homogeneous(), view(*WITHIN, medium=FOG)),
    "lens within": lambda: fog_scene(
        homogeneous(),
        view(*WITHIN, medium=FOG, kind="thinlens", aperture_radius=0.05, focus_distance=1.0),
    ),
    "nested": lambda: fog_scene(homogeneous(), ball=ball({"type": "null"}, **inner())),
    "glass": lambda: fog_scene(
        homogeneous(), ball=ball({"type": "dielectric", "int_ior": 1.3}, **inner())
    ),
    "rough glass": lambda: fog_scene(
        homogeneous(),
        ball=ball({"type": "roughdielectric", "alpha": 0.4, "int_ior": 1.2}, **inner()),
    ),
    "mask": lambda: fog_scene(
        homogeneous(),
        ball=ball(
            {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "nested": diffuse()}},
            **inner(),
        ),
    ),
    "thin glass": lambda: fog_scene(homogeneous(), ball=ball({"type": "thindielectric"})),
    "plastic": lambda: fog_scene(homogeneous(), ball=ball({"type": "plastic"}, exterior=FOG)),
    "lamp within": lambda: fog_scene(
        homogeneous(), small=ball(diffuse(), 0.2, emitter={"type": "area", "radiance": 5.0})
    ),
    "sky": lambda: fog_scene(homogeneous(), sky={"type": "constant", "radiance": grey(0.4)}),
    "sun": lambda: fog_scene(
        homogeneous(), sun={"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 2.0}
    ),
    "many kinds": lambda: fog_scene(
        homogeneous(phase=blended()),
        veil=ball(
            {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "nested": diffuse()}},
            0.4,
            center=[-0.5, 0.3, 0],
            exterior=FOG,
            interior=homogeneous(3.0, 0.7, tabulated()),
        ),
        plastic=ball({"type": "plastic"}, 0.3, center=[0.5, 0, 0], exterior=FOG),
        sky={"type": "constant", "radiance": grey(0.4)},
    ),
}


BY_DEFAULT = ("many kinds",)
"""All kinds of media, phase functions, boundaries and emitters, in this file and in those of other
plugins."""


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [*BY_DEFAULT, *extended(*(name for name in SCENES if name not in BY_DEFAULT))]
)
def test_agrees_with_volpath(rgb, name):
    agree_with_volpath(bdpt(), SCENES[name](), whole=0.02, block=0.06)


@pytest.mark.parametrize("variant_name", extended("llvm_ad_spectral", "llvm_ad_mono"))
def test_agrees_in_other_variants(variant_name):
    """Wavelengths have extinctions of their own; one free flight serves all of a path's."""
    mi.set_variant(variant_name)
    medium, sensor = grid(even, scale=3.0, g=0.3), view((0, 0.7, 4.2))
    if mi.is_spectral:
        slope = {"type": "spectrum", "value": [(360, 2.0), (830, 0.5)]}
        medium = homogeneous() | {"sigma_t": slope}
        # One iteration has one set of wavelengths; a narrow response takes their noise away.
        sensor["srf"] = {"type": "spectrum", "value": [(554, 0.0), (555, 1.0), (556, 0.0)]}
    scene = fog_scene(medium, sensor, ball=ball({"type": "plastic"}, exterior=FOG))
    agree_with_volpath(bdpt(), scene, whole=0.02, block=0.06)


@pytest.mark.parametrize("max_depth", [2, *extended(1, 3)])
def test_depth_is_that_of_volpath(rgb, max_depth):
    """Boundaries do not count, half transparent ones included; what each depth adds is more than
    what is compared."""
    scene = fog_scene(
        homogeneous(),
        ball=ball({"type": "mask", "opacity": 0.4, "nested": diffuse()}, **inner()),
        sky={"type": "constant", "radiance": grey(0.4)},
    )
    agree_with_volpath(bdpt(max_depth=max_depth), scene, whole=0.02, block=0.05)


def curtain(opacity, radius, fov):
    """Fog behind a half transparent ball, which fills most of the view."""
    mask = {"type": "mask", "opacity": opacity, "nested": {"type": "twosided", "nested": diffuse()}}
    return fog_scene(
        homogeneous(1.5, 0.95),
        view((0, 0.3, 4.2), fov=fov),
        floor=None,
        curtain=ball(mask, radius, exterior=FOG, interior=FOG),
        sky={"type": "constant", "radiance": grey(0.4)},
    )


@pytest.mark.parametrize(
    "max_depth, opacity, radius, fov", extended((2, 0.3, 0.9, 20.0), (4, 0.03, 0.5, 40.0))
)
def test_half_transparent_surfaces(rgb, max_depth, opacity, radius, fov):
    """All that is seen, and most light, comes through a mask: paths that pass it go on as if it
    were not there, and their weights with them."""
    scene = curtain(opacity, radius, fov)
    agree_with_volpath(bdpt(max_depth=max_depth), scene, whole=0.01, block=0.02)


# --- Closed forms -------------------------------------------------------------


NEAR_CLIP = 0.5
SIGMA_T, POINT = 0.7, (1.5, 0.3, 0.4)
"""Of `point_in_fog`: extinction, and the place of the light."""


def single_scattering(sigma_t, albedo, g, light, pixels, half_width, distance):
    """Radiance (pixels, pixels) of light that a point of intensity one sends into an infinite
    medium and that scatters once, for a pinhole at z = `distance` that looks down and sees
    +-`half_width` in the plane z = 0: the integral along the ray of
    sigma_s exp(-sigma_t (t + d)) p(cos) / d^2, by the midpoint rule. As Mitsuba's rays, it begins
    at the near clipping plane."""
    fine = 4
    edge = ((np.arange(pixels * fine) + 0.5) / (pixels * fine) * 2 - 1) * half_width
    x, y = np.meshgrid(edge, -edge)
    direction = np.stack([x, y, np.full_like(x, -distance)], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    near = NEAR_CLIP / -direction[..., 2:]
    radiance, step = np.zeros(x.shape), 0.01
    for t in np.arange(step / 2, 25, step):
        p = np.array([0, 0, distance]) + (near + t) * direction
        away = p - np.array(light)
        d = np.linalg.norm(away, axis=-1)
        cosine = -np.sum(away / d[..., None] * direction, axis=-1)
        phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
        radiance += step * sigma_t * albedo * np.exp(-sigma_t * (t + d)) * phase / d**2
    return radiance.reshape(pixels, fine, pixels, fine).mean(axis=(1, 3))


def point_in_fog(albedo, g):
    """A point light in an infinite medium without any shape, and the means of the image and of its
    quarters, of light that has scattered once."""
    distance, half_width = 2.0, 0.5
    medium = homogeneous(SIGMA_T, albedo, hg(g))
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": {**medium, "id": "fog"},
            "light": {"type": "point", "position": list(POINT), "intensity": 1.0},
            "sensor": {
                **view((0, 0, distance), fov=np.degrees(2 * np.arctan(half_width / distance))),
                "to_world": look((0, 0, distance), (0, 0, 0), (0, 1, 0)),
                "medium": FOG,
                "near_clip": NEAR_CLIP,
            },
        }
    )
    picture = single_scattering(SIGMA_T, albedo, g, POINT, 16, half_width, distance)
    return scene, Estimate.exact(np.repeat(block_means(picture[:, :, None], 2), 3, axis=1))


@pytest.mark.parametrize("albedo, g", extended((1.0, -0.5), (0.5, 0.0), (1.0, 0.5)))
def test_single_scattering_in_closed_form(rgb, albedo, g):
    """Next-event estimation and joining to the sensor, each alone, and both."""
    scene, exact = point_in_fog(albedo, g)
    batches = SessionBatches(bdpt(max_depth=2), scene, 2)
    batches.add(2)
    assert_same(*collect_until(batches, exact, 0.01, 0.02), 0.01, 0.02, slack=1e-3)
    alone = technique_estimates(scene, pyramid(2, camera_paths=64), 48, 2)
    for technique in ((1, 2), (2, 1)):
        assert not differences(alone[technique], exact, slack=1e-3), technique
        assert 6 * np.sqrt(alone[technique].error2[0].max()) < 0.25 * exact.mean[0, 0]
    assert alone[0, 3].mean.max() == 0


def cloud(albedo, sky=1.0, size=16, sigma_t=1.5, phase=None):
    """A sphere of a medium under an even sky, which fills the view."""
    return mi.load_dict(
        {
            "type": "scene",
            "cloud": ball(
                {"type": "null"}, 1.0, interior=homogeneous(sigma_t, albedo, phase or hg(0.3))
            ),
            "sky": {"type": "constant", "radiance": grey(sky)},
            "sensor": view((0, 0, 4), fov=20.0, size=size),
        }
    )


def test_furnace(rgb):
    """A medium that absorbs nothing cannot be told from an even sky."""
    batches = SessionBatches(bdpt(max_depth=-1, rr_depth=100), cloud(1.0), 2)
    batches.add(2)
    exact = Estimate.exact(np.ones((5, 3)))
    assert_same(*collect_until(batches, exact, 0.005, 0.01), 0.005, 0.01, slack=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("of_flakes", [True, *extended(False)])
def test_each_technique_alone(rgb, of_flakes):
    """Paths of two and three segments bring the same whether they meet the sky, find it by
    next-event estimation, or come from there to the sensor. (Joining two vertices of a medium has
    no finite variance alone.)"""
    phase = flaky() if of_flakes else hg(0.3)
    estimates = technique_estimates(cloud(0.8, phase=phase), pyramid(3, camera_paths=64), 48)
    for k in (2, 3):
        first = estimates[1, k]
        for other in ((0, k + 1), (k, 1)):
            assert not differences(estimates[other], first), other
            assert 6 * np.sqrt(estimates[other].error2[0].max()) < 0.08 * first.mean[0].max()


# --- Weights ------------------------------------------------------------------


def foggy_room(light, sensor="perspective"):
    """A room whose walls let nothing through, full of fog; a glass ball, and one of another
    medium."""
    eye = {**view((0, -0.9, -0.3), (0.1, 0, 0), size=8, fov=70.0, kind=sensor), "medium": FOG}
    if sensor == "thinlens":
        eye.update(aperture_radius=0.05, focus_distance=1.0)
    return mi.load_dict(
        {
            "type": "scene",
            "fog": {**homogeneous(1.0, 0.9, hg(0.5)), "id": "fog"},
            "walls": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": diffuse(0.7)}},
            "cloud": ball({"type": "null"}, 0.3, center=[-0.5, 0.3, 0], **inner(5.0)),
            "glass": ball({"type": "dielectric"}, 0.3, center=[0.5, 0.3, 0], exterior=FOG),
            "lamp": lamp_inside(light),
            "sensor": eye,
        }
    )


@pytest.mark.long
@pytest.mark.parametrize(
    "light, sensor, length, beta, eta",
    [
        ("point", "thinlens", 3, 2, 0.0),
        ("area", "perspective", 4, 1, 2.0),
        *extended(("area", "perspective", 3, 1, 0.0), ("point", "perspective", 3, 2, 1.0)),
    ],
)
def test_weights_sum_to_one(rgb, light, sensor, length, beta, eta):
    """Each technique's weight for the same joint path through the fog, from its own code, merges
    among them: on surfaces (pi R^2 N) and in the fog (half of that, for the extinction 1)."""
    paths = JointPaths(foggy_room(light, sensor), length)
    disk, ball = (dr.opaque(mi.Float, size) for size in (eta, 0.5 * eta))
    merging = Merging(disk, ball) if eta else None
    by_technique = paths.weights(ConnectionWeights(paths.lights, beta, 0.7, merging, media=True))
    total = sum(by_technique.values())
    assert len(total) > 100
    assert np.mean(np.abs(total - 1) < 2e-3) > 0.995, np.sort(np.abs(total - 1))[-20:]
    used = {s for s, w in by_technique.items() if w.max() > 1e-3}
    assert used == set(by_technique) - ({0} if light == "point" else set())


@pytest.mark.parametrize("kind", ["camera", "light"])
def test_states_behind_half_transparent_surfaces(rgb, kind):
    """Kept vertices carry what the hooks say of the vertices before them (of those in the fog), as
    if the masks between them were not there."""
    # Reflections leave no vertex, but count.
    mask = {"type": "mask", "opacity": 0.1, "nested": {"type": "conductor"}}
    spheres = {f"mask{i}": ball(mask, 0.3 * i, exterior=FOG, interior=FOG) for i in (1, 2, 3)}
    scene = fog_scene(homogeneous(1.5, 0.95, hg(0.4)), floor=None, **spheres)
    sensor = scene.sensors()[0]
    traits, lights = SceneTraits(scene, sensor), Lights(scene)
    lights.find_media(sensor, "bdpt")
    world, limits, capacity = World(scene, lights, traits), Limits(8, 50), 20000
    weights = ConnectionWeights(lights, 2, 1.3, media=True)
    sequence = SampleSequence(mi.UInt32(3), mi.UInt32(0), 1, False)
    if kind == "light":
        light_pass = LightPass(sequence, 2000, [])
        vertices, found, _ = trace_light_subpaths(world, limits, light_pass, weights, capacity)
    else:
        path = dr.arange(mi.UInt32, 256)
        camera_pass = CameraPass(sensor, None, sequence, path // 4, path % 4, 0.5)
        traced = trace_camera_subpaths(world, limits, camera_pass, weights, capacity)
        vertices, found = traced[-2:]
    found = int(found[0])
    here = read_vertices(vertices, dr.arange(mi.UInt32, found), True)
    later = here["parent"] != NO_PARENT
    before = read_vertices(vertices, here["parent"], later)
    later &= in_medium(before["n"])
    d = -here["towards"]
    sides = (before["towards"], d) if kind == "camera" else (d, before["towards"])
    _, p_camera, p_light = vertex_bsdf_of(traits, before, [], later).f_and_pdfs(*sides, later)
    forward, back = (p_camera, p_light) if kind == "camera" else (p_light, p_camera)
    state = [before["d_vcm"], before["d_vc"]]
    left = weights.scatter(state, forward, back, mi.Bool(False), None, before)
    squared = dr.squared_norm(here["p"] - before["p"])
    near, far = weights.propagate(left, forward * facing(traits, here["n"], d) / squared)
    mask = np.array(later) & (np.array(here["depth"]) == np.array(before["depth"]) + 1)
    assert mask.sum() > 100
    for mine, expected in ((here["d_vcm"], near), (here["d_vc"], far)):
        ratio = np.array(mine)[mask] / np.array(expected)[mask]
        assert np.mean(np.abs(ratio - 1) < 5e-3) > 0.98, np.sort(ratio)


# --- What is refused ----------------------------------------------------------


def test_a_sensor_must_name_its_medium(rgb):
    """Camera paths would start in no medium, and light that goes to the sensor would end in one."""
    with pytest.raises(Exception) as error:
        mi.render(fog_scene(homogeneous(), view(*WITHIN)), integrator=bdpt(), spp=16)
    assert "bdpt: the sensor stands in a medium" in last_words(error.value)


def test_techniques_of_paths_that_pass_a_mask_are_whole(rgb):
    """Such a path comes to the same depth twice, on the mask and behind it: images of techniques
    have the light of both, and nothing is left for the rest, which is that of longer paths."""
    curtain = {
        "type": "rectangle",
        "to_world": T().translate([0, 0.2, 1.5]).scale(1.5),
        "bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "b": diffuse(0.8)}},
    }
    scene = fog_scene(homogeneous(0.3), curtain=curtain)
    session = bdpt(max_depth=3, techniques=3, camera_paths=4).session(scene, 0, seed=1, spp=0)
    session.iterate()
    image, names = session.image(), session.channels
    rest = image[..., [names.index(f"technique.rest.{letter}") for letter in "RGB"]]
    total = image[..., [names.index(letter) for letter in "RGB"]]
    assert total.mean() > 0 and np.abs(rest).max() < 1e-4 * total.max()
