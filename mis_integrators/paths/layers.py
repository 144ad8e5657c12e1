"""Layers of an image that tell what the camera sees besides its light: Mitsuba's arbitrary output
variables, of which its own integrator `aov` makes no layers for integrators like these."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ..core.film import splat_channels
from ..core.traits import lookup, registry_table
from .camera import start_camera_paths
from .guides import SAMPLES, camera_passes, displayed_albedo, first_smooth_surface
from .light_classes import CLASSES

CHANNELS = {
    "albedo": "RGB",
    "depth": "T",
    "geo_normal": "XYZ",
    "position": "XYZ",
    "prim_index": "I",
    "sh_normal": "XYZ",
    "shape_index": "I",
    "uv": "UV",
}
"""The types of layers of surfaces, and the last letters of their channels' names."""
SPLIT = dict.fromkeys(CLASSES, "RGB")
"""The same of layers that split the light, which integrators must do themselves."""
BEHIND_DELTA = {"albedo", "sh_normal"}
"""Types that are of the first surface that scatters smoothly; all others are of the first one."""
NONE = "none"
"""Stands for no layers."""


class Layer(NamedTuple):
    """A layer's name, and its type (one of `CHANNELS` or `SPLIT`)."""

    name: str
    type: str

    @property
    def channels(self) -> list[str]:
        """The names of its channels."""
        return [f"{self.name}.{letter}" for letter in (CHANNELS | SPLIT)[self.type]]


def parse_layers(text: str, types: Iterable[str] = CHANNELS) -> tuple[Layer, ...]:
    """The layers of some `types` that a text like ``albedo:albedo,nn:sh_normal`` asks for: pairs
    ``name:type`` with commas between them, as of Mitsuba's ``aov``. Raises ``ValueError``, which
    says what is wrong."""
    if text.strip() in ("", NONE):
        return ()
    layers = []
    for pair in text.split(","):
        name, colon, kind = pair.strip().partition(":")
        if not colon or not name or not name.isprintable() or " " in name:
            raise ValueError(f'"{pair.strip()}" is no pair of a name and a type')
        if kind not in types:
            raise ValueError(f'there is no type "{kind}"')
        if name in [layer.name for layer in layers]:
            raise ValueError(f'the name "{name}" is there twice')
        layers.append(Layer(name, kind))
    return tuple(layers)


def written(layers: tuple[Layer, ...]) -> str:
    """The text that asks for these layers."""
    return ",".join(f"{layer.name}:{layer.type}" for layer in layers) or NONE


def channel_names(layers: tuple[Layer, ...]) -> list[str]:
    """Names of all channels of the layers, in their order."""
    return [channel for layer in layers for channel in layer.channels]


def shape_numbers(scene):
    """Places of the scene's shapes in `scene.shapes()`, counted from one: a table for `lookup`."""
    shapes = scene.shapes()
    return registry_table(shapes, mi.ShapePtr, range(1, len(shapes) + 1), mi.UInt32)


def values_of_types(scene, camera_pass, types, numbers):
    """What the camera paths of a pass find, zero where there is nothing: by type a list of arrays,
    one a channel; and the positions on the film, and which paths there are. `numbers`: as of
    `shape_numbers`."""
    _, there, _, ray, _, splat, _ = start_camera_paths(camera_pass)
    found = {}
    if set(types) & BEHIND_DELTA:
        albedo, normal = first_smooth_surface(scene, camera_pass)
        found |= {"albedo": displayed_albedo(albedo), "sh_normal": normal}
    if set(types) - BEHIND_DELTA:
        si = scene.ray_intersect(ray, there)
        valid = si.is_valid()
        shape = dr.select(si.instance != None, si.instance, si.shape)  # noqa: E711 (array comparison)
        known = valid & (dr.reinterpret_array(mi.UInt32, shape) < dr.width(numbers))
        found |= {
            "depth": [si.t],
            "geo_normal": si.n,
            "position": si.p,
            "prim_index": [mi.Float(si.prim_index)],
            "shape_index": [mi.Float(lookup(numbers, shape, mi.UInt32, known))],
            "uv": si.uv,
        }
        for name in found.keys() - BEHIND_DELTA:
            found[name] = [dr.select(valid, value, 0) for value in found[name]]
    finite = {
        name: [dr.select(dr.isfinite(value), value, 0) for value in values]
        for name, values in found.items()
    }
    return finite, splat, there


def render_layers(scene, sensor, layers: tuple[Layer, ...], seed=0, samples: int = SAMPLES):
    """The layers (of `CHANNELS`), a list of tensors (height, width, channels) with the border that
    blocks of the film have. Means over `samples` camera paths a pixel under the film's
    reconstruction filter; albedo is at most one. `seed`: an integer.

    Albedo and shading normal are those of `guides.first_smooth_surface`, through glass and in
    mirrors; all else is of the first surface, as of Mitsuba's `aov`, emitters that are hidden among
    them. The number of a shape is its place in `scene.shapes()`, from one (of an instance that of
    the instance); Mitsuba's is one of its registry, which differs from process to process.
    """
    film, numbers = sensor.film(), shape_numbers(scene)
    total = None
    for camera_pass in camera_passes(sensor, samples, seed):
        values, splat, there = values_of_types(
            scene, camera_pass, [layer.type for layer in layers], numbers
        )
        channels = [value for layer in layers for value in values[layer.type]]
        block = splat_channels(film, splat, [*channels, mi.Float(1)], there)
        total = block if total is None else total + block
        dr.eval(total)
    weight = total[:, :, -1:]
    means = total[:, :, :-1] * dr.select(weight != 0, dr.rcp(dr.select(weight != 0, weight, 1)), 0)
    parts, first = [], 0
    for layer in layers:
        last = first + len(layer.channels)
        part = means[:, :, first:last]
        # Single samples of a BSDF, and filters with negative lobes, may leave [0, 1].
        parts.append(dr.clip(part, 0, 1) if layer.type == "albedo" else part)
        first = last
    dr.eval(parts)
    return parts
