"""The plugin `bdpt` in participating media: images against `volpath`, closed forms, each technique
alone, and what is refused.

Comparisons of renders: false-alarm rate 1e-6 each; an error of 2 % of the whole image and of 6 % of
a quarter is seen with a probability of 0.95, where a test says nothing else (`comparing`).
"""

import mitsuba as mi
import numpy as np
import pytest
from comparing import agree
from foggy import container, even, floor, grid, lamp, pockets, view, volpath
from worlds import T, diffuse, grey, look

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
    """A cube of fog above a floor, under a lamp."""
    return mi.load_dict(
        {
            "type": "scene",
            "fog": {**medium, "id": "fog"},
            "cube": container(FOG),
            "floor": floor(),
            "lamp": lamp(),
            "sensor": sensor or view((0, 0.7, 4.2)),
            **objects,
        }
    )


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
    "rough glass": lambda: fog_scene(
        homogeneous(), ball=ball({"type": "roughdielectric", "alpha": 0.4, "int_ior": 1.2}, **inner())
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
    "point within": lambda: fog_scene(
        homogeneous(2.0), point={"type": "point", "position": [0.2, 0.3, -0.1], "intensity": 1.0}
    ),
    "lamp within": lambda: fog_scene(
        homogeneous(), small=ball(diffuse(), 0.2, emitter={"type": "area", "radiance": 5.0})
    ),
    "sky": lambda: fog_scene(homogeneous(), sky={"type": "constant", "radiance": grey(0.4)}),
    "sun": lambda: fog_scene(
        homogeneous(), sun={"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 2.0}
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_volpath(rgb, name):
    agree(
        bdpt(),
        volpath(max_depth=6),
        SCENES[name](),
        blocks=2,
        whole=0.02,
        block=0.06,
        spp=512,
        most=600,
    )
