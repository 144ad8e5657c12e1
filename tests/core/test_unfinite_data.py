"""Which data of a scene hold values that are not finite, in words."""

import time
from pathlib import Path

from mis_integrators.core.traits import unfinite_data

import mitsuba as mi
import numpy as np
import pytest

NAN, INF = float("nan"), float("inf")
SCENES = sorted((Path(__file__).parents[2] / "scenes").rglob("*.xml"))
MOST_SECONDS = 0.05
"""What looking at a bundled scene may take, once kernels are compiled."""


def picture(*texels):
    """A bitmap of ones, but for these texels, which are not a number."""
    values = np.ones((4, 8, 3), np.float32)
    for texel in texels:
        values[texel] = NAN
    return mi.Bitmap(values)


def grid():
    values = np.ones((3, 3, 3, 1), np.float32)
    values[1, 1, 1] = INF
    return mi.VolumeGrid(values)


def ball(**parts):
    return {"type": "sphere", **parts}


def lamp(radiance):
    return {"type": "constant", "radiance": radiance}


def diffuse(reflectance):
    return ball(bsdf={"type": "diffuse", "id": "paint", "reflectance": reflectance})


def test_what_is_found(rgb):
    """One line for each array, with the place, the class of what holds it, and how many values."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "envmap", "bitmap": picture((1, 2))},
            "good": ball(bsdf={"type": "roughplastic"}),
            "wall": diffuse({"type": "bitmap", "bitmap": picture((0, 0), (3, 7)), "raw": True}),
            "point": {"type": "point", "intensity": {"type": "rgb", "value": [1, INF, 2]}},
            "fog": ball(
                interior={
                    "type": "heterogeneous",
                    "albedo": 0.5,
                    "sigma_t": {"type": "gridvolume", "grid": grid()},
                }
            ),
        }
    )
    found = unfinite_data(scene)
    assert len(found) == 4 and all("\n" not in line for line in found)
    for place, owner, count in (
        ("sky.data", "EnvironmentMapEmitter", "3 of 120"),
        ("reflectance.data", "BitmapTextureImpl[float32]", "6 of 96"),
        ("point.intensity.value", "SRGBReflectanceSpectrum", "1 of 3"),
        ("sigma_t.data", "GridVolume", "1 of 27"),
    ):
        assert any(
            f"{place} of {owner} has {count} values that are not finite" in line for line in found
        ), found


@pytest.mark.parametrize(
    "part",
    [
        lamp(NAN),
        lamp({"type": "rgb", "value": [1, NAN, 1]}),
        lamp({"type": "rgb", "value": [1, INF, 1]}),
        lamp({"type": "blackbody", "temperature": NAN}),
        diffuse({"type": "rgb", "value": [0.5, NAN, 0.5]}),
        ball(interior={"type": "homogeneous", "albedo": 0.5, "sigma_t": INF}),
    ],
    ids=str,
)
def test_a_single_value(rgb, part):
    (line,) = unfinite_data(mi.load_dict({"type": "scene", "part": part}))
    assert "values that are not finite" in line


@pytest.mark.parametrize(
    "part",
    [
        lamp({"type": "spectrum", "value": [(400.0, 1.0), (500.0, INF), (600.0, 1.0)]}),
        lamp({"type": "blackbody", "temperature": NAN}),
        {"type": "envmap", "bitmap": picture()},
    ],
    ids=["spectrum", "blackbody", "envmap"],
)
def test_spectral(rgb, part):
    """As of the variant: the same words, and none where all is well."""
    mi.set_variant("llvm_ad_spectral")
    assert len(unfinite_data(mi.load_dict({"type": "scene", "part": part}))) == (
        part["type"] != "envmap"
    )


def test_parameters_that_are_not_given(rgb):
    """Of ``hair``, `sigma_a` has no value."""
    assert unfinite_data(mi.load_dict({"type": "scene", "part": ball(bsdf={"type": "hair"})})) == []


def test_without_an_id(rgb):
    """The class stands for it, not an address."""
    scene = mi.load_string(
        '<scene version="3.0.0"><emitter type="constant">'
        '<rgb name="radiance" value="nan, 1, 1"/></emitter></scene>'
    )
    assert unfinite_data(scene) == [
        "ConstantBackgroundEmitter.radiance.value of SRGBReflectanceSpectrum "
        "has 1 of 3 values that are not finite"
    ]


def test_vertices(rgb):
    mesh = mi.Mesh("mesh", 3, 1)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = [0, 0, 0, 1, 0, 0, 0, NAN, 0]
    parameters["faces"] = [0, 1, 2]
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    assert [line for line in unfinite_data(scene) if "vertex_positions of Mesh has 1 of 9" in line]


@pytest.mark.parametrize("file", SCENES, ids=lambda file: file.stem)
def test_bundled_scenes_are_finite(rgb, file):
    scene = mi.load_file(str(file))
    assert unfinite_data(scene) == []
    times = []
    for _ in range(3):
        start = time.perf_counter()
        unfinite_data(scene)
        times.append(time.perf_counter() - start)
    assert min(times) < MOST_SECONDS
