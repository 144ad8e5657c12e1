"""The plugin `vcm`. That its weights sum to one is in `test_bdpt`, `test_bdpt_media` and
`test_bidirectional_weights`."""

import mitsuba as mi
import numpy as np
import pytest
from comparing import Estimate, SessionBatches, agree, assert_same, collect_until
from foggy import agree_with_volpath
from selection import extended
from test_analytic import inside_sphere, series
from test_bdpm import box_scene, glossy_box
from test_bdpt_media import SCENES
from worlds import T, diffuse, film, floor_in_a_beam, index_matched_pane, look, path, tray


def vcm(**parameters):
    return mi.load_dict(
        {"type": "vcm", "max_depth": 4, "camera_paths": 8, "initial_radius": 0.03, **parameters}
    )


def test_agrees(rgb):
    agree(
        vcm(),
        path(rr_depth=50),
        tray("mixed0", "rectangle", "thinlens"),
        whole=0.02,
        block=0.12,
        most=600,
    )


@pytest.mark.full
@pytest.mark.parametrize("variant_name", ["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral"])
@pytest.mark.parametrize(
    "emitter",
    [
        "point",
        "spot",
        "directional",
        "sphere",
        "envmap rotated",
        "textured",
        "sunsky",
        "several",
        "projector",
    ],
)
@pytest.mark.parametrize("family", ["smooth0", "smooth1", "smooth2"])
def test_agrees_full(variant_name, emitter, family):
    mi.set_variant(variant_name)
    agree(vcm(), path(rr_depth=50), tray(family, emitter), block=0.05, most=4096)


@pytest.mark.parametrize(
    "max_depth, parameters",
    [
        *extended((2, {"photon_count": 3000})),
        pytest.param(-1, {}, marks=pytest.mark.full),
        (3, {"photon_count": 9000, "alpha": 0.7}),
    ],
)
def test_point_in_sphere(rgb, max_depth, parameters):
    """In the middle of a diffuse sphere irradiance is even, and merging has no bias: rho I / pi (1
    + rho + ...), one term a bounce."""
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": 2.0}}, diffuse(0.6)
    )
    batches = SessionBatches(
        vcm(max_depth=max_depth, initial_radius=0.1, camera_paths=16, **parameters), scene, 2
    )
    batches.add(8)
    exact = Estimate.exact(
        np.full((5, 3), series(0.6 * 2 / np.pi, 0.6, None if max_depth < 0 else max_depth - 1))
    )
    assert_same(*collect_until(batches, exact, 0.02, 0.03), 0.02, 0.03, 1e-3)


def test_light_that_only_merging_makes(rgb):
    """A floor under a pane without refraction, seen through it, in a parallel beam: L = rho E / pi,
    all of it by merges."""
    scene = floor_in_a_beam(1, pane=index_matched_pane(0.25))
    assert_merged(scene, 0.6 / np.pi, 0.01, 0.03)
    dark = np.array(
        mi.render(scene, integrator=mi.load_dict({"type": "bdpt", "max_depth": 4}), spp=16)
    )
    assert dark.max() == 0


def assert_merged(scene, expected, whole, block, integrator=None):
    """All of the image has this value."""
    batches = SessionBatches(integrator or vcm(initial_radius=0.05), scene, 2)
    batches.add(8)
    exact = Estimate.exact(np.full((5, 3), expected))
    assert_same(*collect_until(batches, exact, whole, block), whole, block, 1e-3)


@pytest.mark.long
def test_light_that_only_merging_makes_in_media(rgb):
    """The floor of a tank without refraction, full of what only absorbs: L = rho E / pi, less what
    is lost on the way down and up."""
    sigma_t, height = 0.8, 0.25
    tank = {
        "type": "cube",
        "to_world": T().scale([10, 10, height]),
        "bsdf": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0},
        "interior": {"type": "homogeneous", "sigma_t": sigma_t, "albedo": 0.0},
    }
    scene = floor_in_a_beam(1, floor=9, tank=tank)
    assert_merged(scene, 0.6 / np.pi * np.exp(-2 * height * sigma_t), 0.02, 0.05)


@pytest.mark.long
@pytest.mark.parametrize(
    "plugin", [{"type": "vcm"}, *extended({"type": "bdpt_ris", "merging": True})]
)
def test_fog_that_only_merging_lights(rgb, plugin):
    """The same tank full of fog: what scatters once, straight back, and the floor, both through the
    surface of the tank. Balls are 0.016 wide, and lose 2 % of the fog's light at its boundaries."""
    sigma_t, albedo, height = 3.0, 0.9, 0.25
    tank = {
        "type": "cube",
        "to_world": T().scale([1, 1, height]),
        "bsdf": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0},
        "interior": {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo},
    }
    scene = floor_in_a_beam(1, floor=1, tank=tank)
    left = np.exp(-2 * height * sigma_t)
    floor, fog = 0.6 / np.pi * left, albedo / (8 * np.pi) * (1 - left)
    assert 0.3 < fog / (floor + fog) < 0.5
    common = {"max_depth": 4, "camera_paths": 8, "initial_radius": 0.004}
    integrator = mi.load_dict({**common, **plugin})
    assert_merged(scene, floor + fog, 0.03, 0.09, integrator)


@pytest.mark.parametrize(
    "name",
    [
        *extended("sensor within", "coloured", "glass", "mask"),
        *(pytest.param(name, marks=pytest.mark.full) for name in ("grid", "sky", "lamp within")),
    ],
)
def test_agrees_in_media(rgb, name):
    """An error of 2 % of the whole image and of 6 % of a quarter is seen."""
    agree_with_volpath(vcm(max_depth=6, camera_paths=16), SCENES[name](), whole=0.02, block=0.06)


def test_small_radius_is_bdpt(rgb):
    """At a vanishing radius nothing merges: the image of `bdpt` under the same seed, but for
    rounding and thinning."""
    scene = box_scene(24)
    images = [
        np.array(
            mi.render(
                scene,
                integrator=mi.load_dict({"type": name, "max_depth": 4, **more}),
                spp=64,
                seed=3,
            )
        ).mean(axis=(0, 1))
        for name, more in (("bdpt", {}), ("vcm", {"initial_radius": 1e-6}))
    ]
    np.testing.assert_allclose(*images, rtol=1e-4)


def test_same_seed_same_image(rgb):
    scene = glossy_box()
    first, second, other = (
        np.array(mi.render(scene, integrator=vcm(camera_paths=1), spp=4, seed=seed))
        for seed in (5, 5, 6)
    )
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5)
    assert np.abs(first - other).max() > 1e-2 * first.max()


def test_radii(rgb):
    """Automatic: a share of what the camera sees, whatever the seed; then R_i^2 = R_0^2 (i +
    1)^(alpha - 1)."""
    scene = box_scene(24)
    radii = []
    for seed in (1, 2):
        session = vcm(initial_radius=0.0, alpha=0.5).session(scene, 0, seed, 0)
        session.iterate()
        radii.append(session.settings["radius"])
    assert 0.002 < radii[0] < 0.05 and radii[1] == pytest.approx(radii[0], rel=0.05)
    weights = session.weights(session._spectral(3))
    assert weights.merging.disk[0] == pytest.approx(
        np.pi * session.radius_at(3) ** 2 * 24 * 24 * 8, rel=1e-5
    )
    assert session.radius_at(0) == session.radius and session.radius_at(15) == pytest.approx(
        session.radius / 2
    )


@pytest.mark.parametrize(
    "name, value, allowed",
    [
        ("beta", 9, "from 1"),
        ("photon_count", -1, "at least 0"),
        ("initial_radius", -1.0, "from 1e-15 to"),
        ("alpha", 0.0, r"in \(0, 1\]"),
        ("techniques", 2, "unknown parameter"),
    ],
)
def test_bad_parameter(rgb, name, value, allowed):
    with pytest.raises(RuntimeError, match=allowed) as error:
        mi.load_dict({"type": "vcm", name: value})
    assert "vcm: " in str(error.value) and f'"{name}"' in str(error.value)


def test_darkness(rgb):
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle"},
            "sensor": {
                "type": "perspective",
                "to_world": look((0, 0, 3), (0, 0, 0)),
                "film": film(8),
            },
        }
    )
    assert (np.array(mi.render(scene, integrator=vcm(initial_radius=0.0), spp=8)) == 0).all()
