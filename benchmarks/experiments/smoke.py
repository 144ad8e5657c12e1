"""Four views of a cloud of smoke over a floor, whose parameters are swept: how dense, how far apart
the views, how the smoke scatters."""

from __future__ import annotations

import inspect

import mitsuba as mi
import numpy as np

from common.scene_files import OpenScene

VIEWS = 4
CELLS = 12
DISTANCE, HEIGHT = 4.2, 1.4
"""Of the cameras, from the smoke's middle."""


def smoke_views(
    size: int, density: float = 2.0, spacing: float = 0.2, sideways: float = 0.5
) -> OpenScene:
    """The scene, ready to render: a batch of `VIEWS` views, each `size` / 2 pixels wide and high.

    `density`: majorant of the extinction [1/m], a few times its mean, in a cube 2 m wide;
    `spacing`: angle between neighbouring cameras, which look at the smoke from all around [rad];
    `sideways`: 1 - g of the Henyey-Greenstein phase function. What a sweep does not vary keeps
    these values.
    """
    title = f"smoke_views_density_{density:g}_spacing_{spacing:g}_sideways_{sideways:g}"
    T, edge = mi.ScalarTransform4f, size // 2
    cameras = {}
    for i in range(VIEWS):
        angle = spacing * (i - (VIEWS - 1) / 2)
        origin = [DISTANCE * np.sin(angle), HEIGHT, DISTANCE * np.cos(angle)]
        cameras[f"view{i}"] = {
            "type": "perspective",
            "fov": 36.0,
            "to_world": T().look_at(origin, [0, 0, 0], [0, 1, 0]),
        }
    values = mi.VolumeGrid(_puffs()[..., None])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "batch",
                "film": {
                    "type": "hdrfilm",
                    "width": VIEWS * edge,
                    "height": edge,
                    "rfilter": {"type": "box"},
                },
                **cameras,
            },
            "smoke": {
                "type": "cube",
                "bsdf": {"type": "null"},
                "interior": {
                    "type": "heterogeneous",
                    "scale": density,
                    "albedo": {"type": "constvolume", "value": 0.9},
                    "sigma_t": {
                        "type": "gridvolume",
                        "grid": values,
                        "to_world": T().translate([-1, -1, -1]).scale(2),
                    },
                    "phase": {"type": "hg", "g": 1 - sideways},
                },
            },
            "floor": {
                "type": "rectangle",
                "to_world": T().translate([0, -1.05, 0]).rotate([1, 0, 0], -90).scale(4),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "checkerboard", "to_uv": T().scale([8, 8, 1])},
                },
            },
            "lamp": {
                "type": "rectangle",
                "to_world": T().look_at([2, 3.5, 1], [0, 0, 0], [0, 1, 0]).scale(0.7),
                "emitter": {
                    "type": "area",
                    "radiance": {"type": "rgb", "value": [14.0, 13.0, 11.0]},
                },
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.35, 0.45, 0.6]}},
        }
    )
    made = (
        inspect.getsource(smoke_views)
        + inspect.getsource(_puffs)
        + f"{VIEWS} {CELLS} {DISTANCE} {HEIGHT} {title}"
    )
    return OpenScene(None, scene, {"max_depth": 16, "rr_depth": 8}, made=made, title=title)


def _puffs() -> np.ndarray:
    """Overlapping puffs, thin between them: (CELLS, CELLS, CELLS), at most 1."""
    axis = (np.arange(CELLS) + 0.5) / CELLS * 2 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    puffs = (
        (0.0, -0.5, 0.0, 0.5),
        (0.3, 0.1, -0.2, 0.4),
        (-0.35, 0.2, 0.25, 0.35),
        (0.05, 0.6, 0.0, 0.3),
    )
    values = sum(
        np.exp(-((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / (2 * (r / 1.5) ** 2))
        for a, b, c, r in puffs
    )
    return (0.02 + 0.98 * values / values.max()).astype(np.float32)
