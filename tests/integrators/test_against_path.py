"""Every kind of emitter with every family of BSDFs against Mitsuba's `path` (or, where `path` is
blind, another oracle).

Each comparison sees an error of 1 % in the image and of 3 % in each 16 x 16 block (one block a
BSDF; 8 % where mirrors and glass are about or rough glass stands under a point light, 3 % in the
full product) with a probability of 0.95, at a false-alarm rate of 1e-6 (`comparing`). The merge
radius is a tenth of the spheres'; `test_bias_is_below_resolution` shows that what it blurs is not
seen. The rows cover every pair of (emitter, family of BSDFs), the depths bdd, sensors, variants and
filters in turn; those of `BY_DEFAULT` are in the default run, with BSDFs of each family, the others
are extended. `-m full` adds the full product of emitters, families and bdd.
"""

import mitsuba as mi
import numpy as np
import pytest
from comparing import SessionBatches, agree, assert_same, collect_until
from selection import extended
from worlds import (
    EMITTERS,
    POINT_LIKE,
    RADIUS,
    bdpm,
    bitmap,
    diffuse,
    film,
    has_delta,
    look,
    path,
    ptracer,
    tray,
    waves,
)

RGB, MONO, SPECTRAL = "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral"
PERSPECTIVE, LENS, ORTHO = "perspective", "thinlens", "orthographic"

# emitter, family, bdd, sensor, variant, filter
ROWS = [
    ("rectangle", "mixed0", 0, PERSPECTIVE, RGB, "box"),
    ("sphere", "mixed1", 1, LENS, RGB, "box"),
    ("disk", "mixed2", 2, ORTHO, MONO, "tent"),
    ("cylinder", "mixed0", 3, PERSPECTIVE, MONO, "box"),
    ("cube", "mixed1", 0, ORTHO, RGB, "gaussian"),
    ("textured", "mixed2", 1, PERSPECTIVE, RGB, "box"),
    ("constant", "mixed0", 1, ORTHO, SPECTRAL, "box"),
    ("envmap", "mixed1", 2, PERSPECTIVE, MONO, "mitchell"),
    ("envmap rotated", "mixed2", 0, LENS, RGB, "box"),
    ("sunsky", "mixed0", 2, LENS, RGB, "box"),
    ("wide sun", "mixed1", 1, PERSPECTIVE, RGB, "box"),
    ("several", "mixed1", 3, PERSPECTIVE, RGB, "box"),
    ("point", "smooth0", 0, LENS, MONO, "box"),
    ("spot", "smooth1", 1, ORTHO, SPECTRAL, "box"),
    ("directional", "smooth2", 2, PERSPECTIVE, RGB, "catmullrom"),
    ("projector", "smooth0", 1, PERSPECTIVE, RGB, "box"),
    ("directionalarea", "smooth1", 0, PERSPECTIVE, RGB, "box"),
    ("point", "lambertian", 0, PERSPECTIVE, RGB, "box"),
    ("sunsky", "lambertian", 1, ORTHO, RGB, "box"),
    ("rectangle", "lambertian", 2, LENS, SPECTRAL, "box"),
    ("several", "smooth2", 0, LENS, RGB, "lanczos"),
    ("envmap rotated", "smooth1", 1, PERSPECTIVE, MONO, "box"),
]
BY_DEFAULT = [
    ("constant", "mixed0", 1, ORTHO, SPECTRAL, "box"),
]


def oracle(emitter, depth=4):
    """`path`, but for light that only a light sub-path can carry."""
    return (ptracer if emitter == "directionalarea" else path)(max_depth=depth, rr_depth=50)


@pytest.mark.parametrize(
    "emitter, family, bdd, sensor, variant_name, rfilter",
    BY_DEFAULT + extended(*(row for row in ROWS if row not in BY_DEFAULT)),
    ids=lambda value: str(value).replace(" ", "_"),
)
def test_agrees(emitter, family, bdd, sensor, variant_name, rfilter):
    mi.set_variant(variant_name)
    depth = max(4, bdd + 3)  # so that the last vertex has photons to gather
    agree(
        bdpm(bdd=bdd, max_depth=depth),
        oracle(emitter, depth),
        tray(family, emitter, sensor, rfilter=rfilter),
        block=0.08 if has_delta(family) or family == "smooth0" else 0.03,
        most=600,
    )


def test_rows_cover_all_pairs():
    """Every emitter meets each of the families that its oracle can judge, every bdd each family,
    sensor and variant."""
    rows = [
        (
            e,
            "lambertian rough delta"
            if f.startswith("mixed")
            else "lambertian rough"
            if f.startswith("smooth")
            else f,
            b,
            s,
            v,
        )
        for e, f, b, s, v, _ in ROWS
    ]
    meets = {(e, name) for e, f, *_ in rows for name in f.split()}
    families = ("lambertian", "rough", "delta")
    assert meets >= {
        (e, f) for e in EMITTERS for f in families if not (f == "delta" and e in POINT_LIKE)
    }
    assert {(b, name) for _, f, b, *_ in rows for name in f.split()} >= {
        (b, f) for b in range(4) for f in families
    }
    assert {r[3] for r in rows} == {PERSPECTIVE, LENS, ORTHO} and {r[4] for r in rows} == {
        RGB,
        MONO,
        SPECTRAL,
    }
    assert {(r[3], r[4]) for r in rows} >= {
        (s, v) for s in (PERSPECTIVE, LENS, ORTHO) for v in (RGB, MONO)
    }


@pytest.mark.parametrize(
    "emitter, family, bdd",
    [
        (e, f, b)
        for e in EMITTERS
        for f in ("lambertian", "rough", "delta")
        for b in range(4)
        if not (f == "delta" and e in POINT_LIKE)
    ],
)
@pytest.mark.full
def test_agrees_full(rgb, emitter, family, bdd):
    agree(bdpm(bdd=bdd, max_depth=6), oracle(emitter, 6), tray(family, emitter), most=8192)


# --- Mirrors and glass under lights that no ray can meet ----------------------


def strategies_agree(emitter, first, second, whole=0.01, block=0.03, most=1024):
    scene = tray("delta", emitter)
    a, b = (
        SessionBatches(bdpm(bdd=bdd, max_depth=6), scene, 3, seed=bdd + 1)
        for bdd in (first, second)
    )
    assert_same(*collect_until(a, b, whole, block, most=most), whole, block)


@pytest.mark.extended
@pytest.mark.thinned(3, 3)
@pytest.mark.parametrize(
    "emitter, first, second", [("spot", 0, 1), ("directional", 1, 2), ("projector", 0, 3)]
)
def test_delta_surfaces_under_point_like_lights(rgb, emitter, first, second):
    """`path` is blind to these caustics; the strategies must agree among themselves (blocks at 8
    %)."""
    strategies_agree(emitter, first, second, block=0.08, most=500)


@pytest.mark.parametrize("emitter", POINT_LIKE)
@pytest.mark.parametrize("bdd", [1, 2, 3])
@pytest.mark.full
def test_delta_surfaces_under_point_like_lights_full(rgb, emitter, bdd):
    strategies_agree(emitter, 0, bdd, most=8192)


def caustic_scene(emitter, **more):
    """A floor on which a mirror and a glass sphere outside the picture throw caustics; the camera
    sees the floor alone. `more`: what else is in the scene."""
    T = mi.ScalarTransform4f
    lights = {
        "point": {"type": "point", "position": [0, 0, 3.5], "intensity": 10.0},
        "directional": {"type": "directional", "direction": [1, 0, -0.7], "irradiance": 3.0},
        "projector": {
            "type": "projector",
            "to_world": look((0, 0, 3.5), (0.4, 0, 0)),
            "fov": 90,
            "irradiance": 8.0,
        },
        "directionalarea": {
            "type": "rectangle",
            "to_world": look((-2.2, 0, 2.5), (1.2, 0, 0.6)) @ T().scale(1.6),
            "emitter": {"type": "directionalarea", "radiance": 3.0},
        },
    }
    return mi.load_dict(
        {
            "type": "scene",
            "light": lights[emitter],
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.6)},
            "mirror": {
                "type": "rectangle",
                "to_world": T().translate([2, 0, 1.2]).rotate([0, 1, 0], -90).scale(1.2),
                "bsdf": {"type": "conductor"},
            },
            "glass": {
                "type": "sphere",
                "center": [0.3, 1.5, 0.9],
                "radius": 0.35,
                "bsdf": {"type": "dielectric"},
            },
            "sensor": {
                "type": "perspective",
                "fov": 36,
                "to_world": look((0, 0, 3), (0, 0, 0), (0, 1, 0)),
                "film": film(48),
            },
            **more,
        }
    )


@pytest.mark.parametrize(
    "emitter, bdd",
    [("directionalarea", 1), *extended(("point", 0), ("directional", 1), ("projector", 2))],
)
def test_caustics_against_ptracer(rgb, emitter, bdd):
    """Light that reaches a floor by mirror and glass: `ptracer` connects the floor to the camera (2
    % and 8 %)."""
    agree(
        bdpm(bdd=bdd),
        ptracer(rr_depth=50),
        caustic_scene(emitter),
        whole=0.02,
        block=0.08,
        most=600,
    )


# --- Shading normals ----------------------------------------------------------


@pytest.mark.extended
@pytest.mark.thinned(2, 2)
@pytest.mark.parametrize("bdd", [0, 1])
@pytest.mark.parametrize("tilt", [-0.5, 0.5])
def test_shading_normals_seen_from_the_light(rgb, bdd, tilt):
    """A wall whose normal map tilts all its normals lights a floor that nothing else lights:
    photons that leave the wall carry the adjoint factor of shading normals (Veach 1997, section
    5.3), as large as cos 60 / cos 30 here."""
    normals = np.broadcast_to(
        np.array([0.0, tilt, np.sqrt(1 - tilt * tilt)]) * 0.5 + 0.5, (4, 4, 3)
    )
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.6)},
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 2, 1.5]).rotate([1, 0, 0], 90).scale(1.5),
                "bsdf": {"type": "normalmap", "normalmap": bitmap(normals), "bsdf": diffuse(0.8)},
            },
            "spot": {
                "type": "spot",
                "to_world": look((0, -1.5, 3), (0, 2, 1.5)),
                "intensity": 20.0,
                "cutoff_angle": 15,
            },
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look((0, 0, 3), (0, 0, 0)),
                "film": film(24),
            },
        }
    )
    agree(
        bdpm(bdd=bdd, max_depth=3 + bdd),
        path(max_depth=3 + bdd),
        scene,
        blocks=2,
        whole=0.02,
        block=0.04,
    )


# --- Light whose texture coordinates overlap ----------------------------------


@pytest.mark.parametrize("bdd", [0, *extended(1)])
def test_textured_cube_light(rgb, bdd):
    """A cube's faces share their texture coordinates; there `path` is wrong, and BSDF sampling
    alone (`direct`) is the oracle."""
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(6), "bsdf": diffuse(0.6)},
            "lamp": {
                "type": "cube",
                "to_world": T().translate([0, 0, 1.5]).scale(0.6),
                "emitter": {
                    "type": "area",
                    "radiance": bitmap(np.stack([3 + 2.5 * waves(1, 1)] * 3, axis=-1)),
                },
            },
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "to_world": look((0, -3, 0.8), (0, -1, 0)),
                "film": film(48),
            },
        }
    )
    agree(
        bdpm(bdd=bdd, max_depth=2),
        mi.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 4}),
        scene,
    )


# --- Bias ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "family, emitter",
    [*extended(("mixed0", "rectangle")), pytest.param("smooth1", "point", marks=pytest.mark.full)],
)
def test_bias_is_below_resolution(rgb, family, emitter):
    """At twice the radius, four times the bias: if even that is not seen against half the radius,
    neither is the tests' own."""
    scene = tray(family, emitter)
    a, b = (
        SessionBatches(bdpm(bdd=0, initial_radius=radius), scene, 3, seed=seed)
        for seed, radius in ((1, 2 * RADIUS), (2, RADIUS / 2))
    )
    estimates = collect_until(a, b, block=0.06)
    assert_same(*estimates, block=0.06)
