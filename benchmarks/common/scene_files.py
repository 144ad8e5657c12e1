"""Which scenes are measured, and how their files are opened."""

from __future__ import annotations

import argparse
import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from mis_integrators.app import loading
from mis_integrators.core.traits import scene_bounds

import mitsuba as mi
import numpy as np

BUNDLED = Path(__file__).resolve().parents[2] / "scenes"


@dataclass
class OpenScene:
    """A loaded scene: its file, what its own integrator hands on to others, its sensor and film
    size."""

    path: Path | None
    """``None`` for a scene that no file holds."""
    scene: mi.Scene
    inherited: dict[str, loading.Value]
    made: str = ""
    """What a scene without a file was made from: it tells it from all others."""
    title: str = ""
    """Its name."""
    denoise: bool = False
    """Whether images are to be denoised: films have box filters, and integrators are told."""
    filtered: bool = False
    """Whether its film had another filter before that."""
    of_samplers: dict[str, mi.Sensor] = field(default_factory=dict)
    """Its sensor with another sampler, once it was asked for (`sensor_with`)."""

    @property
    def name(self) -> str:
        """The file's name, or its folder's where all files are called ``scene.xml``."""
        if self.path is None:
            return self.title
        return name_of(self.path)

    @property
    def hides_emitters(self) -> bool:
        """Whether integrators are told to hide emitters."""
        return bool(self.inherited.get("hide_emitters", False))

    @property
    def sensor(self) -> mi.Sensor:
        return self.scene.sensors()[0]

    def sensor_with(self, sampler: str | None) -> mi.Sensor:
        """Its sensor with another of Mitsuba's samplers; ``None``: with its own."""
        if sampler is None or self.path is None:
            return self.sensor
        if sampler not in self.of_samplers:
            loaded = loading.load(self.path, {}, "path", {}, sampler, self.denoise)
            other = loaded.scene.sensors()[0]
            _resize(other, self.size)
            self.of_samplers[sampler] = other
        return self.of_samplers[sampler]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the rendered window."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)

    @property
    def pixels(self) -> int:
        return self.size[0] * self.size[1]


def name_of(path: Path) -> str:
    """What a scene's file is called, or its folder where all files are called ``scene.xml``."""
    return path.resolve().parent.name if path.stem == "scene" else path.stem


def bundled() -> list[Path]:
    """The scenes that come with the project."""
    return sorted(BUNDLED.glob("*.xml"))


def open_scene(path: Path, size: tuple[int, int] | None = None, denoise: bool = False) -> OpenScene:
    """Load a scene, its film resized to ``size`` if given (the sensor keeps its field of view);
    ``denoise``: see ``OpenScene``."""
    loaded = loading.load(path, {}, "path", {})
    film = loaded.scene.sensors()[0].film()
    filtered = denoise and not film.rfilter().is_box_filter()
    if filtered:
        loaded = loading.load(path, {}, "path", {}, denoise=True)
    if size:
        _resize(loaded.scene.sensors()[0], size)
    inherited = {
        name: loaded.parameters[name] for name in loading.INHERITED if name in loaded.parameters
    }
    return OpenScene(path, loaded.scene, inherited, denoise=denoise, filtered=filtered)


def _resize(sensor: mi.Sensor, size: tuple[int, int]) -> None:
    film = mi.traverse(sensor)
    film["film.size"] = mi.ScalarVector2u(*size)
    film.update()


def merge_radius(opened: OpenScene, options: argparse.Namespace) -> float:
    """The radius that the options ``radius`` or ``radius_share`` ask for."""
    diagonal = float(np.linalg.norm(np.array(scene_bounds(opened.scene).extents())))
    return options.radius or options.radius_share * diagonal


def scaled_size(path: Path, scale: float) -> tuple[int, int] | None:
    """The scene's own film size times ``scale``; ``None`` where that changes nothing."""
    if scale == 1:
        return None
    width, height = open_scene(path).size
    return max(1, round(width * scale)), max(1, round(height * scale))


def files_of(path: Path) -> list[Path]:
    """The scene file and every file that it names."""
    named = {
        path.parent / element.get("value", "")
        for element in ElementTree.parse(path).iter("string")
        if element.get("name") == "filename"
    }
    return [path, *sorted(named)]


def digests(path: Path) -> dict[str, str]:
    """SHA-256 of the scene's files, by their names relative to its folder."""
    return {
        Path(os.path.relpath(file, path.parent)).as_posix(): hashlib.sha256(
            file.read_bytes()
        ).hexdigest()
        for file in files_of(path)
    }


def fingerprint(opened: OpenScene) -> str:
    """One SHA-256 for all of the scene's files, or for what it was made from."""
    content = repr(sorted(digests(opened.path).items())) if opened.path else opened.made
    content += " with a box filter" if opened.filtered else ""
    return hashlib.sha256(content.encode()).hexdigest()
