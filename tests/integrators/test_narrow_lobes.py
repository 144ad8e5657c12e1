"""Surfaces with narrow lobes, at which `bdpm` gathers none but caustic photons: paths go on."""

from mis_integrators.paths import lobes

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import agree, in_one_thread
from selection import extended
from worlds import T, diffuse, film, look, path, under_a_lamp

METAL = {"type": "roughconductor", "material": "Al"}
GLASS = {"type": "dielectric"}
FROSTED = {"type": "roughdielectric", "alpha": 0.2}


def concentration(bsdfs):
    return lobes.concentration(lobes.look_at(bsdfs))


def narrow_surfaces(scene):
    return lobes.NarrowSurfaces.of(scene, lobes.LobedBSDFs.of(scene))


def test_concentration_of_diffuse_surfaces(variant):
    one = mi.load_dict({"type": "diffuse"})
    both = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.3}}
    np.testing.assert_allclose(concentration([one, mi.load_dict(both)]), 1, rtol=4e-3)


def test_concentration_is_an_integral(rgb):
    """At normal incidence, against the midpoint rule over directions. (256 directions of the
    BSDF are sampled, stratified: 15 % is more than twice what they are off; the least lobe is five
    degrees wide.)"""
    for alpha in (0.1, 0.2, 0.4):
        bsdf = mi.load_dict({**METAL, "alpha": alpha})
        n = 1500
        index = dr.arange(mi.UInt32, n)
        theta = (mi.Float(index) + 0.5) * (dr.pi / 2 / n)  # the lobe is round: phi does not matter
        si = dr.zeros(mi.SurfaceInteraction3f, n)
        si.wi = mi.Vector3f(0, 0, 1)
        wo = mi.Vector3f(dr.sin(theta), 0, dr.cos(theta))
        f = np.array(bsdf.eval(mi.BSDFContext(), si, wo)).mean(axis=0) / np.cos(np.array(theta))
        weight = np.sin(np.array(theta)) * np.cos(np.array(theta)) * (dr.pi / 2 / n) * 2 * np.pi
        expected = np.pi * (f * f * weight).sum() / (f * weight).sum() ** 2
        assert concentration([bsdf])[0, -1] == pytest.approx(expected, rel=0.15)


def box(**bsdfs):
    """A Cornell box with other materials, by shape; 48 pixels wide."""
    scene = mi.cornell_box()
    # Off the floor: which of two faces in one plane a ray meets is chance, and not the same chance
    # from above and from below.
    lifted = mi.ScalarTransform4f().translate([0, 0.02, 0])
    scene["small-box"]["to_world"] = lifted @ scene["small-box"]["to_world"]
    for name, bsdf in bsdfs.items():
        scene[name] = {**scene[name], "bsdf": bsdf}
    scene["sensor"]["film"] = {
        "type": "hdrfilm",
        "width": 48,
        "height": 48,
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(scene)


def test_which_surfaces_are_narrow(rgb):
    plastic = {"type": "roughplastic", "alpha": 0.1}
    scene = box(
        **{"small-box": FROSTED, "large-box": {**METAL, "alpha": 0.05}},
        floor=plastic,
        back={**METAL, "alpha": 0.5},
    )
    narrow = narrow_surfaces(scene)
    assert narrow.curves is None
    from_cosines = dr.zeros(mi.SurfaceInteraction3f, 5)
    from_cosines.wi = mi.Vector3f(0, 0, mi.Float(0.05, 0.37, -0.37, 0.38, 1.0))
    found = {}
    for shape in scene.shapes():
        bsdf = dr.opaque(mi.BSDFPtr, shape.bsdf(), 5)
        found[shape.id()] = list(narrow.at(bsdf, from_cosines, True))
    assert found.pop("small-box") == found.pop("large-box") == [True] * 5
    assert found.pop("floor") == [True] * 4 + [False]  # the coat, but from above
    assert not np.any(list(found.values()))
    assert narrow_surfaces(box()) is None
    assert narrow_surfaces(box(floor={**plastic, "alpha": 0.4})) is None


def test_coats_are_as_narrow_as_they_are_alone(rgb):
    """What reflects little besides its ground shows mirror images all the same. (Few samples are
    those of the coat, and grounds are a little brighter from above than from aside, which counts
    for the rest: within a factor of 1.6.)"""
    grounds = [
        mi.load_dict({"type": "roughplastic", "alpha": 0.05, "diffuse_reflectance": value})
        for value in (0.05, 0.3)
    ]
    looks = lobes.look_at(grounds)
    assert np.all(lobes.concentration(looks)[1, 2:] < 5)
    found = lobes.concentration(lobes.rest_of(looks, np.array([True, True])))
    assert np.all(np.abs(np.log(found[0] / found[1])) < np.log(1.6))
    assert np.all(found > lobes.NARROW)
    whole = lobes.rest_of(looks, np.array([False, False]))
    np.testing.assert_array_equal(whole.value, looks.value)
    matt = lobes.look_at([mi.load_dict({"type": "diffuse", "reflectance": 0.5})])
    assert np.all(lobes.concentration(lobes.rest_of(matt, np.array([True]))) == 0)


def test_even_parts(variant):
    """Of which BSDFs photons bring the light of an even part."""
    matt = {"type": "diffuse", "reflectance": 0.5}
    coat = {"type": "roughplastic", "alpha": 0.1}
    smooth = {**METAL, "alpha": 0.05}
    expected = [
        (coat, True),
        ({"type": "twosided", "bsdf": coat}, True),
        ({"type": "blendbsdf", "weight": 0.5, "a": matt, "b": smooth}, True),
        ({"type": "principled", "roughness": 0.3, "specular": 0.5}, True),
        ({"type": "principled", "roughness": 0.1, "metallic": 1.0}, False),
        (smooth, False),
        (matt, True),
    ]
    found = lobes.parted(lobes.look_at([mi.load_dict(bsdf) for bsdf, _ in expected]))
    assert list(found) == [even for _, even in expected]


def test_the_table_has_all_surfaces(rgb):
    """Those without lobes, too, wherever they stand in Mitsuba's registry."""
    metal, matt = (
        {"type": "sphere", "bsdf": bsdf} for bsdf in ({**METAL, "alpha": 0.05}, {"type": "diffuse"})
    )
    for shapes in ({"a": metal, "b": matt}, {"a": matt, "b": metal}):
        scene = mi.load_dict({"type": "scene", **shapes})
        numbers = [
            dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(shape.bsdf()))[0] for shape in scene.shapes()
        ]
        assert max(numbers) < dr.width(lobes.narrow_bsdfs(lobes.LobedBSDFs.of(scene)))


def test_lobe_widths(rgb):
    """c^(-1/2) of the concentration c under the angles that were looked at, a mean between; one of
    BSDFs with an even part."""
    rough = [{**METAL, "alpha": alpha} for alpha in (0.05, 0.2)]
    scene = box(**dict(zip(("small-box", "large-box"), rough)), floor={"type": "roughplastic"})
    widths = lobes.LobeWidths.of(lobes.LobedBSDFs.of(scene))
    si = dr.zeros(mi.SurfaceInteraction3f, 7)
    si.wi = mi.Vector3f(0, 0, mi.Float(-0.1, 0.25, 0.5, -0.75, 1, 0.6, 0.85))
    found = {
        shape.id(): np.array(widths.at(dr.opaque(mi.BSDFPtr, shape.bsdf(), 7), si, True))
        for shape in scene.shapes()
    }
    for name, bsdf in zip(("small-box", "large-box"), rough):
        expected = concentration([mi.load_dict(bsdf)])[0] ** -0.5
        np.testing.assert_allclose(found[name][1:5], expected, rtol=2 ** (1 / 32) - 1)
        assert found[name][0] == found[name][1]
        for between, (low, high) in ((5, (2, 3)), (6, (3, 4))):
            assert np.prod(found[name][[low, high]] - found[name][between]) < 0
    assert np.all(found["small-box"] < found["large-box"] / 2)
    assert np.all(found["floor"] == 1)
    assert lobes.LobeWidths.of(lobes.LobedBSDFs.of(box())) is None


def glass_on_metal():
    """A lamp behind a ball of glass, and a floor that shines; 48 pixels wide."""
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": T().scale(10) @ T().rotate([1, 0, 0], -90),
                "bsdf": {**METAL, "alpha": 0.15},
            },
            "ball": {"type": "sphere", "center": [0, 0.35, 0], "radius": 0.35, "bsdf": GLASS},
            "lamp": {
                "type": "cylinder",
                "p0": [-0.2, 0.3, -1.8],
                "p1": [0.4, 2.1, -1.5],
                "radius": 0.05,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 20.0}},
            },
            "sensor": {
                "type": "perspective",
                "fov": 22,
                "to_world": look([0, 1.5, 5], [0, 0.1, 0.6]),
                "film": film(48, height=32),
            },
        }
    )


@pytest.mark.long
@pytest.mark.parametrize("denoised", [False, True], ids=["raw", "denoised"])
def test_glossy_floors_show_sharp_images(rgb, denoised):
    """Of a lamp in a ball of glass: light has other directions a little further, so that wide disks
    of photons would blur it. In blocks of four pixels (noise is .04 and .06 of all light there;
    with disks as wide as on matt floors errors are .46 and .12)."""
    scene = glass_on_metal()
    expected = np.array(path(max_depth=8).render(scene, spp=2048))
    integrator = mi.load_dict({"type": "bdpm", "bdd": 0, "denoised": denoised, "max_depth": 8})
    image = np.array(integrator.render(scene, spp=64))
    one, other = (
        x[20:, :, :3].mean(axis=-1).reshape(-1, 4, 12, 4).mean(axis=(1, 3))
        for x in (image, expected)
    )
    assert np.abs(one - other).sum() < 0.09 * other.sum()


def bristles(folder, **objects):
    """A brush of thin diffuse curves on a floor, under a lamp. The last curve is out of sight, for
    where a ray meets the end of it, Mitsuba (3.9.1) reads beyond a table."""
    rng = np.random.default_rng(4)
    with (folder / "bristles.txt").open("w") as file:
        for number in range(1201):
            x, y = rng.uniform(-1, 1, 2)
            dx, dy = rng.uniform(-0.1, 0.1, 2)
            low = -5 if number == 1200 else 0
            for k in range(4):
                file.write(f"{x + dx * k:.4f} {y + dy * k:.4f} {low + 0.2 * k:.4f} 0.008\n")
            file.write("\n")
    brush = {
        "type": "bsplinecurve",
        "filename": str(folder / "bristles.txt"),
        "bsdf": diffuse(0.7),
    }
    return mi.load_dict(under_a_lamp(2, brush=brush, **objects))


@pytest.mark.long
@pytest.mark.parametrize("bdd", [0, *extended(1)])
def test_no_photons_are_gathered_on_curves(rgb, tmp_path, bdd):
    """They are thinner than disks: with photons the image is 13 % too dark."""
    scene = bristles(tmp_path)
    parameters = {"max_depth": 5, "initial_radius": 0.04, "camera_paths": 4}
    made = mi.load_dict({"type": "bdpm", "bdd": bdd, **parameters})
    agree(made, path(max_depth=5), scene, blocks=1, whole=0.01, block=0.01)


COATS = {
    "plastic": {"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": 0.5},
    "principled": {"type": "principled", "roughness": 0.15, "specular": 0.5, "sheen": 0.5},
}
"""Narrow coats above what scatters evenly."""


def narrow_box(coat):
    """Of lobes that are narrow from everywhere, and of a coat."""
    return box(**{"small-box": FROSTED, "large-box": {**METAL, "alpha": 0.05}}, floor=coat)


@pytest.mark.long
@pytest.mark.parametrize(
    "coat, bdd, more",
    [
        ("principled", 0, {"camera_paths": 4}),
        *extended(
            ("plastic", 0, {"direct_paths": 3}),
            ("plastic", 1, {"camera_paths": 2}),
            ("principled", 1, {}),
        ),
    ],
)
def test_means(rgb, coat, bdd, more):
    """As of `path`, with false alarms of 1e-6 each: no light is lost or counted twice where paths
    go on, whatever sees direct light besides."""
    settings, scene = {"max_depth": 6, "rr_depth": 50}, narrow_box(COATS[coat])
    assert mi.load_dict({"type": "bdpm"}).session(scene).narrow is not None
    integrator = mi.load_dict(
        {"type": "bdpm", "bdd": bdd, "initial_radius": 0.03, **settings, **more}
    )
    agree(integrator, path(**settings), scene, block=0.08)


def variance(scene, **parameters):
    """Of the pixels by `bdpm` with `bdd` 0, mean over the image."""
    integrator = mi.load_dict({"type": "bdpm", "bdd": 0, **parameters})
    images = [
        np.array(mi.render(scene, integrator=integrator, spp=4, seed=seed)) for seed in range(8)
    ]
    return np.var(images, axis=0, ddof=1).mean()


@pytest.mark.parametrize("coat", COATS)
@in_one_thread
def test_no_noise_of_even_parts(rgb, monkeypatch, coat):
    """A coated floor seen at a grazing angle, below a ceiling that one small spot lights: photons
    bring what the floor scatters evenly. A twentieth of the variance, at the most, of paths that go
    on for all of it. (The seeds are fixed.)"""
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": T().scale(4),
                "bsdf": COATS[coat],
            },
            "ceiling": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(4),
                "bsdf": diffuse(0.8),
            },
            "lamp": {
                "type": "spot",
                "to_world": look((0, 0, 0.1), (0, 0, 1)),
                "cutoff_angle": 8.0,
                "intensity": 10.0,
            },
            "sensor": {
                "type": "perspective",
                "fov": 10,
                "to_world": look((0, -3, 0.9), (0, 0, 0), (0, 0, 1)),
                "film": film(24),
            },
        }
    )
    less = variance(scene, initial_radius=0.1)
    monkeypatch.setattr(lobes, "parted", lambda looks: np.zeros(len(looks.value), bool))
    assert less < 0.05 * variance(scene, initial_radius=0.1)


@in_one_thread
def test_no_dots_on_smooth_metal(rgb):
    """Of a plate of metal that fills the picture: a fifth of the variance, at the most, of photons
    gathered there. (The seeds are fixed.)"""
    scene = mi.cornell_box()
    scene["back"]["bsdf"] = {**METAL, "alpha": 0.05}
    scene["sensor"]["fov"] = 15
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": 24, "height": 24}
    scene = mi.load_dict({k: v for k, v in scene.items() if k not in ("small-box", "large-box")})
    passed = variance(scene, initial_radius=0.05)
    assert passed < 0.2 * variance(scene, initial_radius=0.05, pass_narrow=False)
