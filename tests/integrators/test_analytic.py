"""Scenes with closed-form answers, for bdd 0 to 3.

Each answer is compared with the mean of independent iterations by a t test at a false-alarm rate of
1e-6, which sees an error of 1 % of the image (3 % of a block) with a probability of 0.95
(`comparing`). On a sphere, the ball of the merge radius cuts out a cap of exactly pi R^2, and on a
plane the disk does; where irradiance is even, kernel estimates have no bias at all.
"""

import mitsuba as mi
import numpy as np
import pytest
from comparing import Estimate, SessionBatches, assert_same, collect_until
from selection import extended
from worlds import T, diffuse, film, floor_in_a_beam, grey, index_matched_pane, look

EACH = pytest.mark.parametrize("bdd", [0, 1, 2, 3])
FIRST = pytest.mark.parametrize("bdd", [0, *extended(1, 2, 3)])
THIRD = pytest.mark.parametrize("bdd", [2, *extended(0, 1, 3)])


def bdpm(**parameters):
    return mi.load_dict(
        {
            "type": "bdpm",
            "initial_radius": 0.1,
            "photon_count": 10000,
            "camera_paths": 4,
            **parameters,
        }
    )


def assert_value(scene, integrator, expected, blocks=2, whole=0.01, block=0.03, slack=1e-4):
    """Asserts that every block of the image has the closed-form value `expected` (a number, or one
    a block row by row)."""
    a = SessionBatches(integrator, scene, blocks)
    expected = np.ravel(expected).astype(float)
    values = np.full(blocks**2, expected[0]) if expected.size == 1 else expected
    values = np.concatenate([[values.mean()], values])[:, None]
    a.add(2)
    channels = a.batches[0].shape[1]
    assert_same(
        *collect_until(a, Estimate.exact(np.repeat(values, channels, axis=1)), whole, block),
        whole,
        block,
        slack,
    )


def inside_sphere(light, bsdf, emitter=None, size=16):
    """A closed unit sphere, seen from inside off its centre."""
    sphere = {
        "type": "sphere",
        "flip_normals": True,
        "bsdf": bsdf,
        **({"emitter": emitter} if emitter else {}),
    }
    return mi.load_dict(
        {
            "type": "scene",
            "room": sphere,
            **light,
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "to_world": look((0.3, 0, 0.1), (0, 1, 0), (0, 0, 1)),
                "film": film(size),
            },
        }
    )


def series(first, ratio, count):
    """Sum of `count` terms of a geometric series; all of them if `count` is None."""
    return (
        first / (1 - ratio) if count is None else first * (1 - ratio ** max(count, 0)) / (1 - ratio)
    )


# --- Point light in the middle of a diffuse sphere ----------------------------


@pytest.mark.thinned(4, 2, 6)
@EACH
@pytest.mark.parametrize("max_depth", [-1, 2, 3, 4, 5])
def test_point_in_sphere(rgb, bdd, max_depth):
    """Irradiance I/r^2 everywhere; each bounce hands on rho of it: L = rho I / pi (1 + rho + rho^2
    + ...)."""
    rho, intensity = 0.6, 2.0
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": intensity}}, diffuse(rho)
    )
    bounces = None if max_depth < 0 else max_depth - 1
    assert_value(
        scene, bdpm(bdd=bdd, max_depth=max_depth), series(rho * intensity / np.pi, rho, bounces)
    )


@pytest.mark.extended
def test_point_in_sphere_in_every_variant(variant):
    """As above; one set of wavelengths an iteration leaves the hue of spectral images to chance, so
    a narrow sensor is used there."""
    rho, intensity = 0.6, 2.0
    scene = {
        "type": "scene",
        "room": {"type": "sphere", "flip_normals": True, "bsdf": diffuse(rho)},
        "light": {"type": "point", "position": [0, 0, 0], "intensity": grey(intensity)},
        "sensor": {
            "type": "perspective",
            "fov": 60,
            "to_world": look((0.3, 0, 0.1), (0, 1, 0), (0, 0, 1)),
            "film": film(16),
        },
    }
    if not mi.is_spectral:
        return assert_value(
            mi.load_dict(scene), bdpm(bdd=1), series(rho * intensity / np.pi, rho, None)
        )
    # Grey throughout: every iteration's image is its wavelengths' colour times the answer, and
    # path's direct view has the same.
    image = np.mean(
        [
            np.array(
                mi.render(
                    mi.load_dict(scene),
                    integrator=bdpm(bdd=1, camera_paths=1, photon_count=2000),
                    seed=s,
                    spp=1500,
                )
            )
            for s in (1,)
        ],
        axis=(0, 1, 2),
    )
    direct = np.array(
        mi.render(mi.load_dict(scene), integrator=mi.load_dict({"type": "path"}), spp=256)
    ).mean(axis=(0, 1))
    assert image.shape == (3,)
    luminance = np.array([0.2126, 0.7152, 0.0722])
    # 5 sigma: see test_spectral_colour in test_bdpm.py
    assert image @ luminance == pytest.approx(direct @ luminance, rel=0.05)


@FIRST
def test_many_emitters_at_one_place(rgb, bdd):
    """Four point lights in the middle, of different power, add up."""
    lights = {
        f"light{i}": {"type": "point", "position": [0, 0, 0], "intensity": value}
        for i, value in enumerate((0.1, 0.4, 0.5, 1.0))
    }
    assert_value(
        inside_sphere(lights, diffuse(0.5)), bdpm(bdd=bdd), series(0.5 * 2 / np.pi, 0.5, None)
    )


@pytest.mark.thinned(4, 1, 4)
@EACH
@pytest.mark.parametrize("rr_depth", [1, 50])
def test_roulette_in_sphere(rgb, bdd, rr_depth):
    """Roulette from the first bounce on, or never, leaves the mean alone (albedo 0.8)."""
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": 1.0}}, diffuse(0.8)
    )
    assert_value(scene, bdpm(bdd=bdd, rr_depth=rr_depth), series(0.8 / np.pi, 0.8, None))


# --- Furnaces -----------------------------------------------------------------


@pytest.mark.thinned(4, 2, 6)
@EACH
@pytest.mark.parametrize("max_depth", [-1, 1, 2, 3, 4])
def test_furnace_of_emitting_sphere(rgb, bdd, max_depth):
    """Walls of albedo rho that emit L: L (1 + rho + rho^2 + ...), one term a segment.

    Mitsuba's densities inside a sphere are not quite those of its samples: `path` too is 0.09 %
    off, so 0.2 % is let pass.
    """
    rho, emission = 0.5, 0.7
    scene = inside_sphere({}, diffuse(rho), {"type": "area", "radiance": emission})
    terms = None if max_depth < 0 else max_depth
    assert_value(
        scene, bdpm(bdd=bdd, max_depth=max_depth), series(emission, rho, terms), slack=2e-3
    )


@pytest.mark.thinned(4, 2, 8)
@EACH
@pytest.mark.parametrize(
    "material", ["diffuse", "conductor", "dielectric", "thindielectric", "mask", "null", "blend"]
)
def test_white_furnace(rgb, bdd, material):
    """A sphere of albedo one under a constant environment cannot be seen."""
    bsdf = {
        "diffuse": diffuse(1.0),
        "conductor": {"type": "conductor", "material": "none"},
        "dielectric": {"type": "dielectric"},
        "thindielectric": {"type": "thindielectric"},
        "mask": {
            "type": "mask",
            "opacity": 0.5,
            "bsdf": {"type": "twosided", "bsdf": diffuse(1.0)},
        },
        "null": {"type": "null"},
        "blend": {
            "type": "blendbsdf",
            "weight": 0.5,
            "a": diffuse(1.0),
            "b": {"type": "conductor", "material": "none"},
        },
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere", "bsdf": bsdf[material]},
            "sky": {"type": "constant", "radiance": 0.8},
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": look((0, -3, 0), (0, 0, 0), (0, 0, 1)),
                "film": film(16),
            },
        }
    )
    # Radiance inside a dielectric scatters forever; its tail is cut by roulette alone.
    assert_value(scene, bdpm(bdd=bdd, rr_depth=20), 0.8)


# --- Direct light and one bounce ----------------------------------------------


def floor_from_above(half, size=16, reflectance=0.5, **entries):
    """A large floor seen straight from above (through nothing that stands higher than 4): the
    square |x|, |y| < half."""
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(10), "bsdf": diffuse(reflectance)},
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 4), (0, 0, 0)) @ T().scale([half, half, 1]),
                "film": film(size),
            },
            **entries,
        }
    )


@THIRD
def test_directional_light_on_plane(rgb, bdd):
    """L = rho / pi E cos(theta); nothing else to meet."""
    scene = floor_from_above(
        1, sun={"type": "directional", "direction": [0, 1, -1], "irradiance": 2.0}
    )
    assert_value(scene, bdpm(bdd=bdd), 0.5 / np.pi * 2 * np.sqrt(0.5))


@pytest.mark.parametrize("shape", ["sphere", "disk"])
def test_irradiance_of_area_light(rgb, shape):
    """On its axis: E = pi L sin^2 of the half angle, for a sphere (radius / distance) and a disk
    alike."""
    lamp = {
        "type": shape,
        "emitter": {"type": "area", "radiance": 3.0},
        "to_world": look((0, 0, 2), (0, 0, 0)) @ T().scale(0.5 if shape == "sphere" else 1.0),
    }
    sine2 = (0.5 / 2) ** 2 if shape == "sphere" else 1 / (1 + 4)
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(10), "bsdf": diffuse(0.5)},
            "lamp": lamp,
            "sensor": {
                "type": "perspective",
                "fov": 0.2,
                "to_world": look((2, 0, 1), (0, 0, 0), (0, 0, 1)),
                "film": film(16),
            },
        }
    )
    assert_value(scene, bdpm(bdd=0), 0.5 * 3 * sine2, block=0.02)


# --- Caustics -----------------------------------------------------------------


def point_irradiance(height, x, y):
    return height / (x * x + y * y + height * height) ** 1.5


def block_average(function, half, blocks):
    """Averages of a function of (x, y) over the blocks of the image of `floor_from_above`."""
    n = 64
    grid = (np.arange(blocks * n) + 0.5) / (blocks * n) * 2 * half - half
    # the camera looks down: signs do not matter to symmetric functions
    x, y = np.meshgrid(-grid, -grid)
    return function(x, y).reshape(blocks, n, blocks, n).mean(axis=(1, 3)).ravel()


@FIRST
def test_caustic_of_plane_mirror(rgb, bdd):
    """A mirror above a point light: the image light shines from its far side. rho I / pi (E(h) +
    E(2 m - h)), exactly."""
    height, mirror = 1.0, 1.5
    scene = floor_from_above(
        0.5,
        light={"type": "point", "position": [0, 0, height], "intensity": 2.0},
        mirror={
            "type": "rectangle",
            "to_world": T().translate([0, 0, mirror]).rotate([1, 0, 0], 180).scale(10),
            "bsdf": {"type": "conductor", "material": "none"},
        },
        sensor={
            "type": "orthographic",
            "to_world": look((0, 0, 1.4), (0, 0, 0)) @ T().scale([0.5, 0.5, 1]),
            "film": film(16),
        },
    )
    expected = (
        0.5
        * 2
        / np.pi
        * block_average(
            lambda x, y: (
                point_irradiance(height, x, y) + point_irradiance(2 * mirror - height, x, y)
            ),
            0.5,
            2,
        )
    )
    assert_value(scene, bdpm(bdd=bdd, max_depth=3, initial_radius=0.03), expected)


@THIRD
def test_light_through_pane(rgb, bdd):
    """A parallel beam through a thin pane: T = (1 - F) / (1 + F) of the light passes, F Fresnel's
    reflectance of one side."""
    eta = 1.5
    reflectance = ((eta - 1) / (eta + 1)) ** 2
    passes = (1 - reflectance) / (1 + reflectance)
    scene = floor_from_above(
        0.5,
        sun={"type": "directional", "direction": [0, 0, -1], "irradiance": 2.0},
        pane={
            "type": "rectangle",
            "to_world": T().translate([0, 0, 2]).scale(9),
            "bsdf": {"type": "thindielectric", "int_ior": eta, "ext_ior": 1.0},
        },
        sensor={
            "type": "orthographic",
            "to_world": look((0, 0, 1.9), (0, 0, 0)) @ T().scale([0.5, 0.5, 1]),
            "film": film(16),
        },
    )
    assert_value(scene, bdpm(bdd=bdd, max_depth=3), 0.5 / np.pi * 2 * passes)


@FIRST
def test_light_through_mask(rgb, bdd):
    """A mask of opacity 0.3 lets 0.7 through; where it is opaque, it is black."""
    scene = floor_from_above(
        0.5,
        sun={"type": "directional", "direction": [0, 0, -1], "irradiance": 2.0},
        mask={
            "type": "rectangle",
            "to_world": T().translate([0, 0, 2]).scale(9),
            "bsdf": {"type": "mask", "opacity": 0.3, "bsdf": diffuse(0.0)},
        },
        sensor={
            "type": "orthographic",
            "to_world": look((0, 0, 1.9), (0, 0, 0)) @ T().scale([0.5, 0.5, 1]),
            "film": film(16),
        },
    )
    assert_value(scene, bdpm(bdd=bdd, max_depth=3), 0.5 / np.pi * 2 * 0.7)


# --- What is not there --------------------------------------------------------


@pytest.mark.parametrize("bdd", [1, *extended(0)])
def test_index_matched_pane(rgb, bdd):
    """A pane without refraction is no obstacle: all direct light comes by way of caustic
    photons."""
    scene = floor_in_a_beam(0.2, pane=index_matched_pane(0.25))
    assert_value(scene, bdpm(bdd=bdd, max_depth=4), 0.6 / np.pi)


def test_no_media_in_a_vacuum(rgb):
    """An index-matched sphere full of nothing changes nothing."""
    scene = floor_from_above(
        0.5,
        sun={"type": "directional", "direction": [0, 0, -1], "irradiance": 2.0},
        ball={"type": "sphere", "center": [0, 0, 2], "bsdf": {"type": "null"}},
    )
    assert_value(scene, bdpm(bdd=1), 0.5 / np.pi * 2)
