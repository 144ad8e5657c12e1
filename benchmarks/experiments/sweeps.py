"""Which sweeps there are, and the small scene most of them vary (see `smoke` for the other one).

A room of diffuse walls, 2 units wide, open towards the camera: a glossy floor of metal, a diffuse
sphere on it, a plastic block that leans, and a square lamp. What a sweep does not vary keeps the
values of `room`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mitsuba as mi

from common.methods import Method, registered
from common.scene_files import OpenScene
from experiments.smoke import smoke_views


def room(
    size: int,
    roughness: float = 0.15,
    light_size: float = 0.15,
    light_distance: float | None = None,
    max_depth: int = 8,
    scale: float = 1.0,
) -> OpenScene:
    """The scene, ready to render at `size` x `size` pixels.

    `roughness`: of the floor; `light_size`: half the edge of the lamp; `light_distance`: ``None``
    for a lamp close below the ceiling that faces down, else its distance from the ceiling that it
    faces; `scale`: factor of all lengths. The lamp's power is always the same.
    """
    parameters = {
        "light_distance": light_distance or 0,
        "light_size": light_size,
        "max_depth": max_depth,
        "roughness": roughness,
        "scale": scale,
    }
    title = "_".join(["room", *(f"{name}_{value:g}" for name, value in parameters.items())])
    to_scale = mi.ScalarTransform4f().scale(scale)

    def placed(kind, transform, bsdf, **more):
        return {"type": kind, "to_world": to_scale @ transform, "bsdf": bsdf, **more}

    def turned(axis, angle, x, y, z):
        return mi.ScalarTransform4f().translate([x, y, z]).rotate(axis, angle)

    facing_down = light_distance is None
    lamp = (
        mi.ScalarTransform4f()
        .translate([0, 0.98 if facing_down else 1 - light_distance, 0])
        .rotate([1, 0, 0], 90 if facing_down else -90)
        .scale([light_size, light_size, 1])
    )
    metal = {"type": "roughconductor", "material": "Al", "alpha": roughness}
    plastic = {"type": "roughplastic", "diffuse_reflectance": _rgb(0.2, 0.3, 0.6), "alpha": 0.1}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 39.0,
                "near_clip": 0.01 * scale,
                "far_clip": 100 * scale,
                "to_world": mi.ScalarTransform4f().look_at(
                    [0, 0, 3.9 * scale], [0, 0, 0], [0, 1, 0]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                },
            },
            "floor": placed("rectangle", turned([1, 0, 0], -90, 0, -1, 0), metal),
            "ceiling": placed(
                "rectangle", turned([1, 0, 0], 90, 0, 1, 0), _diffuse(0.75, 0.75, 0.75)
            ),
            "back": placed("rectangle", turned([1, 0, 0], 0, 0, 0, -1), _diffuse(0.75, 0.75, 0.75)),
            "left": placed("rectangle", turned([0, 1, 0], 90, -1, 0, 0), _diffuse(0.6, 0.1, 0.1)),
            "right": placed("rectangle", turned([0, 1, 0], -90, 1, 0, 0), _diffuse(0.1, 0.5, 0.1)),
            "ball": placed(
                "sphere",
                mi.ScalarTransform4f().translate([-0.4, -0.6, -0.2]).scale(0.4),
                _diffuse(0.7, 0.6, 0.4),
            ),
            "block": placed(
                "cube",
                turned([0, 1, 0], 25, 0.45, -0.5, -0.1)
                .rotate([0, 0, 1], 12)
                .scale([0.22, 0.4, 0.22]),
                plastic,
            ),
            "lamp": placed(
                "rectangle",
                lamp,
                _diffuse(0, 0, 0),
                emitter={"type": "area", "radiance": _rgb(*[0.4 / light_size**2] * 3)},
            ),
        }
    )
    return OpenScene(
        None, scene, {"max_depth": max_depth}, made=inspect.getsource(room) + title, title=title
    )


def _rgb(*values):
    return {"type": "rgb", "value": list(values)}


def _diffuse(*values):
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _rgb(*values)}}


@dataclass(frozen=True)
class Sweep:
    """A parameter and its values. `of_method`: a parameter of those methods that know it; else one
    of the scene."""

    name: str
    parameter: str
    values: tuple[float, ...]
    of_method: bool
    what: str
    scene: Callable[..., OpenScene] = room
    """Makes the scene: of the film's size, and of parameters."""
    labels: tuple[str, ...] = ()
    """Methods that are compared, if not those asked for."""
    reference: str = "path"
    """What renders the references."""

    def methods(self, asked: Sequence[Method]) -> Sequence[Method]:
        """Methods that are compared where these are `asked` for."""
        return registered(self.labels) if self.labels else asked

    def chosen(self, coarse: bool) -> tuple[float, ...]:
        """All values, or every other if `coarse`."""
        return self.values[::2] if coarse else self.values

    def scenes(self, coarse: bool) -> list[tuple[float, dict[str, float]]]:
        """The `chosen` values, and what each changes in the scene."""
        return [
            (value, {} if self.of_method else {self.parameter: value})
            for value in self.chosen(coarse)
        ]


OF_VIEWS = {
    "scene": smoke_views,
    "reference": "volpath",
    "labels": (
        "volpath",
        "volpath_multiview",
        "volpath_multiview:weights=power",
        "volpath_multiview:weights=mwis",
        "volpath_multiview:weights=none",
        "volpath_multiview:shift=majorant_optical_depth_copy",
    ),
}
"""Sweeps of several views: what is compared is how they share paths."""

SWEEPS = (
    Sweep(
        "radius",
        "initial_radius",
        (0.005, 0.015, 0.05, 0.15, 0.5),
        True,
        "merge radius (the room is 2 wide)",
    ),
    Sweep(
        "photons",
        "photon_count",
        (100, 1000, 4096, 30000, 200000),
        True,
        "light sub-paths an iteration, N_F",
    ),
    Sweep(
        "camera_paths",
        "camera_paths",
        (1, 2, 4, 8, 16),
        True,
        "camera paths per pixel and iteration, N_B",
    ),
    Sweep("roughness", "roughness", (0.01, 0.03, 0.1, 0.3, 0.7), False, "roughness of the floor"),
    Sweep(
        "light_size",
        "light_size",
        (0.003, 0.01, 0.04, 0.2, 0.9),
        False,
        "half the edge of the lamp",
    ),
    Sweep(
        "light_distance",
        "light_distance",
        (0.01, 0.03, 0.1, 0.3, 0.9),
        False,
        "distance of the lamp from the ceiling that it faces",
    ),
    Sweep("depth", "max_depth", (3, 4, 6, 10, 20), False, "longest path (max_depth)"),
    Sweep("scale", "scale", (1e-3, 3e-2, 1, 30, 1e3), False, "size of the whole scene"),
    Sweep(
        "density",
        "density",
        (0.1, 0.5, 2, 8, 32),
        False,
        "four views: majorant of the smoke (2 wide)",
        **OF_VIEWS,
    ),
    Sweep(
        "spacing",
        "spacing",
        (0.02, 0.06, 0.2, 0.6, 1.5),
        False,
        "four views: angle between neighbours [rad]",
        **OF_VIEWS,
    ),
    Sweep(
        "anisotropy",
        "sideways",
        (0.03, 0.1, 0.25, 0.5, 1),
        False,
        "four views: 1 - g of the phase function",
        **OF_VIEWS,
    ),
)
