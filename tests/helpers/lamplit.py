"""A small scene of four files, and the command that renders it."""

import subprocess
import sys
from pathlib import Path

from mis_integrators.app import cli

import mitsuba as mi
import numpy as np
import OpenEXR

ROOT = Path(cli.__file__).parents[2]
SCENE = """<scene version="3.0.0">
  <default name="spp" value="6"/>
  <default name="picture" value="wall.png"/>
  <default name="size" value="24"/>
  <integrator type="path"><integer name="max_depth" value="4"/></integrator>
  <sensor type="perspective">
    <transform name="to_world">
      <lookat origin="0, 1, 4" target="0, 0.6, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/>
      <string name="pixel_format" value="rgb"/><rfilter type="gaussian"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
      <string name="filename" value="$picture"/></texture></bsdf></shape>
  <shape type="sphere"><point name="center" x="0.6" y="0.5" z="0"/>
    <float name="radius" value="0.5"/><bsdf type="conductor"/></shape>
  <include filename="lamp.xml"/>
</scene>"""
LAMP = """<scene version="3.0.0">
  <shape type="rectangle"><transform name="to_world">
      <scale value="0.5"/><rotate x="1" angle="90"/><translate y="2"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" filename="lamp.spd"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="5, 4, 3"/></emitter></shape>
</scene>"""


def write_scene(folder: Path) -> Path:
    """The file of the scene: a mirror ball on a textured floor under an area light."""
    file = folder / "scene.xml"
    file.write_text(SCENE)
    (folder / "lamp.xml").write_text(LAMP)
    (folder / "lamp.spd").write_text("400 0.5\n700 0.6\n")
    for name, seed in (("wall.png", 1), ("other.png", 2)):
        pixels = np.random.default_rng(seed).integers(100, 255, (4, 4, 3)).astype(np.uint8)
        mi.Bitmap(pixels).write(str(folder / name))
    return file


def render(scene: Path, *arguments) -> int:
    return cli.main([str(scene), *map(str, arguments)])


def command(scene: Path, *arguments) -> list[str]:
    return [sys.executable, "-m", "mis_integrators.app.cli", str(scene), *map(str, arguments)]


def run(arguments, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        arguments, capture_output=True, text=True, cwd=ROOT, timeout=200, **options
    )


def read(file: Path) -> tuple[dict, np.ndarray]:
    exr = OpenEXR.File(str(file), separate_channels=True)
    return exr.header(), np.stack(
        [channel.pixels for _, channel in sorted(exr.channels().items())], axis=-1
    )


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two images are the same up to the order of their sums."""
    return one.shape == other.shape and np.allclose(
        one, other, rtol=1e-4, atol=1e-5 * abs(one).mean()
    )
