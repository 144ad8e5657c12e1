"""Random scenes for property-based tests: shapes, nested BSDFs, emitters, drawn by hypothesis.

What `path` itself cannot judge is left out: point-like lights next to mirrors, glass or holes (no
camera path meets them), textured area lights whose texture coordinates overlap. Lamps are not
small, so that a few hundred samples find them.
"""

import mitsuba as mi
import numpy as np
from hypothesis import strategies as st


def between(low, high):
    """Numbers of single precision, but none so tiny that Mitsuba cannot read them back from the six
    digits that it writes."""
    return st.floats(low, high, width=32, allow_subnormal=False).map(
        lambda x: x if abs(x) > 1e-30 else max(low, 0.0)
    )


unit = between(0.0, 1.0)


colours = st.tuples(*[between(0.125, 0.875)] * 3).map(
    lambda rgb: {"type": "rgb", "value": list(rgb)}
)
rough = between(0.1875, 0.5)

leaves = st.one_of(
    st.builds(lambda c: {"type": "diffuse", "reflectance": c}, colours),
    st.builds(lambda a: {"type": "roughconductor", "alpha": a, "material": "Al"}, rough),
    st.builds(
        lambda c, a: {"type": "roughplastic", "diffuse_reflectance": c, "alpha": a}, colours, rough
    ),
    st.builds(
        lambda c, r, m: {
            "type": "principled",
            "base_color": c,
            "roughness": 0.375 + r / 2,
            "metallic": m,
        },
        colours,
        unit,
        unit,
    ),
)
specular = st.one_of(
    st.just({"type": "conductor", "material": "Ag"}),
    st.builds(lambda c: {"type": "plastic", "diffuse_reflectance": c}, colours),
    st.just({"type": "dielectric"}),
    st.just({"type": "thindielectric"}),
)


def hills():
    """A texture of smooth hills."""
    heights = np.random.default_rng(5).random((6, 6, 1)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(heights), "raw": True, "wrap_mode": "mirror"}


def nested(inner):
    """One more layer around BSDFs."""
    return st.one_of(
        st.builds(
            lambda a, b, w: {"type": "blendbsdf", "weight": w, "one": a, "two": b},
            inner,
            inner,
            between(0.1875, 0.8125),
        ),
        st.builds(
            lambda a, s: {"type": "bumpmap", "scale": s, "bumps": hills(), "inner": a},
            inner,
            between(0.0, 0.25),
        ),
    )


@st.composite
def bsdfs(draw, may_be_specular):
    """A BSDF of up to two layers, two-sided where it can be, perhaps with holes."""
    reflecting = st.recursive(leaves, nested, max_leaves=3)
    if may_be_specular and draw(st.integers(0, 3)) == 0:
        return draw(specular)
    bsdf = {"type": "twosided", "inner": draw(reflecting)}
    if may_be_specular and draw(st.integers(0, 3)) == 0:
        bsdf = {"type": "mask", "opacity": draw(between(0.25, 0.75)), "inner": bsdf}
    return bsdf


@st.composite
def placements(draw, low=0.25, high=0.625):
    """A rigid motion and a size, somewhere above the floor. (Mitsuba takes axes for unit vectors,
    else its normals are wrong.)"""
    x, y, z = draw(between(-1.0, 1.0)), draw(between(0.5, 1.5)), draw(between(-1.0, 1.0))
    axis, angle = (
        draw(st.sampled_from([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]])),
        draw(between(0.0, 360.0)),
    )
    return (
        mi.ScalarTransform4f()
        .translate([x, y, z])
        .rotate(axis, angle)
        .scale(draw(between(low, high)))
    )


@st.composite
def lamps(draw, may_be_small):
    """One emitter, some of them inside a shape."""
    radiance = {"type": "rgb", "value": [draw(between(1.0, 4.0)) for _ in range(3)]}
    up = mi.ScalarTransform4f().translate([draw(between(-1.0, 1.0)), 2.5, draw(between(-1.0, 1.0))])
    kinds = ["rectangle", "sphere", "disk", "constant"] + [
        "point",
        "spot",
        "directional",
    ] * may_be_small
    kind = draw(st.sampled_from(kinds))
    if kind == "constant":
        return {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.625, 0.75]}}
    if kind == "point":
        return {
            "type": "point",
            "position": [0.25, 2.5, 0.5],
            "intensity": {"type": "rgb", "value": 8.0},
        }
    if kind == "spot":
        down = mi.ScalarTransform4f().look_at(origin=[0.25, 3, 0.5], target=[0, 0, 0], up=[0, 0, 1])
        return {
            "type": "spot",
            "to_world": down,
            "cutoff_angle": 40.0,
            "intensity": {"type": "rgb", "value": 20.0},
        }
    if kind == "directional":
        return {
            "type": "directional",
            "direction": [draw(between(-0.5, 0.5)), -1.0, 0.25],
            "irradiance": {"type": "rgb", "value": 2.0},
        }
    turned = up.rotate([1, 0, 0], 90).scale(draw(between(0.375, 0.75)))
    return {
        "type": kind,
        "to_world": turned,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.25}},
        "emitter": {"type": "area", "radiance": radiance},
    }


@st.composite
def scenes(draw):
    """A dictionary of a scene: floor, one to three shapes, one or two emitters, 16 x 16 pixels."""
    small = draw(st.booleans())
    scene = {
        "type": "scene",
        "sensor": {
            "type": draw(st.sampled_from(["perspective", "thinlens"])),
            "fov": 50,
            "near_clip": 0.1,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=[0, 2, 5], target=[0, 0.75, 0], up=[0, 1, 0]
            ),
            "film": {
                "type": "hdrfilm",
                "width": 16,
                "height": 16,
                "pixel_format": "rgb",
                "rfilter": {"type": draw(st.sampled_from(["box", "gaussian", "tent"]))},
            },
        },
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2.5),
            "bsdf": draw(bsdfs(False)),
        },
        "lamp": draw(lamps(small)),
    }
    if scene["sensor"]["type"] == "thinlens":
        scene["sensor"] |= {"aperture_radius": 0.0625, "focus_distance": 5.0}
    for number in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["sphere", "cube", "rectangle", "disk", "cylinder"]))
        scene[f"shape{number}"] = {
            "type": kind,
            "to_world": draw(placements()),
            "bsdf": draw(bsdfs(not small)),
        }
    if draw(st.booleans()):
        scene["second"] = draw(
            lamps(small).filter(lambda lamp: lamp["type"] != scene["lamp"]["type"])
        )
    return scene
