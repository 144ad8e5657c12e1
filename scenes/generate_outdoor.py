"""Write the outdoor scene (XML) and the meshes of its leaves and tiles; called by `generate.py`.

A courtyard under sun and sky: a tree of some thousand leaves, hedges, roof tiles, arcades, tables
and chairs. Everything is computed here from formulas; the same files come out on every run. Metres,
y up.
"""

from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent / "outdoor"

HEAD = """<?xml version="1.0" encoding="utf-8"?>
<!--
  A courtyard with a tree, hedges and arcades, under a sky with a soft sun.

  Much small detail lit from outside: some thousand leaves hide most of the sky from each other, and
  light reaches the arcades after several diffuse reflections. A few light sub-paths, those that hit
  the sunlit wall, carry most of what the arcades get.
  Written by scenes/generate.py.
-->
<scene version="3.0.0">
  <default name="integrator" value="bdpt_ris"/>
  <default name="spp" value="64"/>
  <default name="resx" value="320"/>
  <default name="resy" value="240"/>
  <default name="max_depth" value="10"/>
  <default name="rr_depth" value="5"/>

  <integrator type="$integrator">
    <integer name="max_depth" value="$max_depth"/>
    <integer name="rr_depth" value="$rr_depth"/>
  </integrator>

  <sensor type="perspective" id="sensor">
    <string name="fov_axis" value="x"/>
    <float name="fov" value="64"/>
    <float name="near_clip" value="0.01"/>
    <float name="far_clip" value="100"/>
    <transform name="to_world">
      <lookat origin="-3.6, 1.6, 4.4" target="0.9, 1.5, -1.2" up="0, 1, 0"/>
    </transform>
    <film type="hdrfilm">
      <integer name="width" value="$resx"/>
      <integer name="height" value="$resy"/>
      <string name="pixel_format" value="rgb"/>
      <string name="component_format" value="float32"/>
      <rfilter type="box"/>
    </film>
    <sampler type="independent">
      <integer name="sample_count" value="$spp"/>
    </sampler>
  </sensor>

  <emitter type="envmap" id="sky">
    <string name="filename" value="../textures/sky.exr"/>
    <transform name="to_world"><rotate y="1" angle="150"/></transform>
  </emitter>

  <bsdf type="twosided" id="plaster"><bsdf type="diffuse">
    <rgb name="reflectance" value="0.74, 0.62, 0.44"/></bsdf></bsdf>
  <bsdf type="twosided" id="bricks"><bsdf type="diffuse">
    <texture type="bitmap" name="reflectance">
      <string name="filename" value="../textures/bricks.png"/>
      <transform name="to_uv"><scale x="4" y="3"/></transform>
    </texture></bsdf></bsdf>
  <bsdf type="twosided" id="paving"><bsdf type="diffuse">
    <texture type="bitmap" name="reflectance">
      <string name="filename" value="../textures/checker.png"/>
      <transform name="to_uv"><scale x="3" y="3"/></transform>
    </texture></bsdf></bsdf>
  <bsdf type="twosided" id="leaf"><bsdf type="diffuse">
    <rgb name="reflectance" value="0.16, 0.30, 0.07"/></bsdf></bsdf>
  <bsdf type="twosided" id="bark"><bsdf type="diffuse">
    <rgb name="reflectance" value="0.22, 0.15, 0.10"/></bsdf></bsdf>
  <bsdf type="twosided" id="clay"><bsdf type="diffuse">
    <rgb name="reflectance" value="0.52, 0.22, 0.12"/></bsdf></bsdf>
  <bsdf type="twosided" id="varnish"><bsdf type="roughplastic">
    <float name="alpha" value="0.15"/>
    <rgb name="diffuse_reflectance" value="0.30, 0.16, 0.08"/></bsdf></bsdf>

"""

SIZE, HEIGHT, DEPTH = 5.0, 3.6, 1.6
"""Half the court's edge, height of its walls, and depth of the arcades."""


def cube(centre, half, bsdf):
    scale = " ".join(f'{axis}="{value:.4g}"' for axis, value in zip("xyz", half))
    move = " ".join(f'{axis}="{value:.4g}"' for axis, value in zip("xyz", centre))
    return (
        f'  <shape type="cube"><transform name="to_world"><scale {scale}/><translate {move}/>'
        f'</transform><ref id="{bsdf}"/></shape>\n'
    )


def cylinder(foot, head, radius, bsdf):
    p0, p1 = (
        " ".join(f'{axis}="{value:.4g}"' for axis, value in zip("xyz", point))
        for point in (foot, head)
    )
    return (
        f'  <shape type="cylinder"><point name="p0" {p0}/><point name="p1" {p1}/>'
        f'<float name="radius" value="{radius:.4g}"/><ref id="{bsdf}"/></shape>\n'
    )


def mesh(name, bsdf):
    return (
        f'  <shape type="ply"><string name="filename" value="{name}"/>'
        f'<boolean name="face_normals" value="true"/><ref id="{bsdf}"/></shape>\n'
    )


def leaves(centres, size, rng):
    """Vertices and faces of two triangles each, turned at random, folded along their middle."""
    count = len(centres)
    along = rng.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, rng.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(along, across)
    length = size * rng.uniform(0.6, 1.4, (count, 1))
    corners = [
        centres - along * length,
        centres + (across + 0.3 * up) * 0.5 * length,
        centres + along * length,
        centres + (0.3 * up - across) * 0.5 * length,
    ]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return vertices, faces


def crown(count, rng):
    """Places of leaves in lumps about the ends of branches."""
    lumps = np.array([1.2, 3.0, -0.6]) + rng.normal(size=(28, 3)) * [0.85, 0.5, 0.85]
    which = rng.integers(0, len(lumps), count)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return lumps[which] + d * 0.42 * rng.uniform(0.5, 1, (count, 1)) ** (1 / 3)


def hedge(count, rng):
    """Places of leaves in the skin of two low boxes."""
    side = rng.integers(0, 2, count)
    p = rng.uniform(-1, 1, (count, 3)) * [1.3, 0.35, 0.3]
    axis = rng.integers(0, 3, count)
    p[np.arange(count), axis] = (
        np.sign(p[np.arange(count), axis]) * np.array([1.3, 0.35, 0.3])[axis]
    )
    return p + np.where(side[:, None] == 0, [-1.6, 0.35, -2.6], [2.9, 0.35, 2.2])


def arcade():
    """Back and right side of the court: columns, a roof over them, and the wall behind."""
    parts = [
        cube((0, HEIGHT / 2, -SIZE - DEPTH), (SIZE + DEPTH, HEIGHT / 2, 0.1), "bricks"),
        cube((SIZE + DEPTH, HEIGHT / 2, 0), (0.1, HEIGHT / 2, SIZE + DEPTH), "bricks"),
        cube((-SIZE, HEIGHT / 2, 0), (0.1, HEIGHT / 2, SIZE), "plaster"),
        cube((0, HEIGHT / 2, SIZE), (SIZE, HEIGHT / 2, 0.1), "plaster"),
        cube((0, 2.75, -SIZE - DEPTH / 2), (SIZE + DEPTH, 0.1, DEPTH / 2 + 0.2), "plaster"),
        cube((SIZE + DEPTH / 2, 2.75, 0), (DEPTH / 2 + 0.2, 0.1, SIZE), "plaster"),
        cube((0, 3.2, -SIZE), (SIZE, 0.4, 0.12), "plaster"),
        cube((SIZE, 3.2, 0), (0.12, 0.4, SIZE), "plaster"),
    ]
    for place in np.linspace(-SIZE, SIZE, 7):
        parts.append(cylinder((place, 0, -SIZE), (place, 2.7, -SIZE), 0.16, "plaster"))
        parts.append(cube((place, 0.1, -SIZE), (0.24, 0.1, 0.24), "plaster"))
        parts.append(cube((place, 2.6, -SIZE), (0.22, 0.08, 0.22), "plaster"))
        if place > -SIZE:
            parts.append(cylinder((SIZE, 0, place), (SIZE, 2.7, place), 0.16, "plaster"))
            parts.append(cube((SIZE, 0.1, place), (0.24, 0.1, 0.24), "plaster"))
    return parts


def furniture(rng):
    """Tables with four chairs each, and pots."""
    parts = []
    for x, z in ((-1.4, 1.2), (0.9, 2.2), (-2.6, -1.4)):
        parts.append(cylinder((x, 0, z), (x, 0.72, z), 0.05, "varnish"))
        parts.append(cube((x, 0.74, z), (0.45, 0.025, 0.45), "varnish"))
        for angle in 0.4 + np.pi / 2 * np.arange(4):
            dx, dz = 0.75 * np.cos(angle), 0.75 * np.sin(angle)
            parts.append(cube((x + dx, 0.44, z + dz), (0.19, 0.02, 0.19), "varnish"))
            back = (x + 1.25 * dx, 0.68, z + 1.25 * dz)
            half = (0.02, 0.24, 0.19) if abs(dx) > abs(dz) else (0.19, 0.24, 0.02)
            parts.append(cube(back, half, "varnish"))
            for sx in (-0.16, 0.16):
                for sz in (-0.16, 0.16):
                    foot = (x + dx + sx, 0, z + dz + sz)
                    parts.append(cylinder(foot, (foot[0], 0.44, foot[2]), 0.015, "varnish"))
        parts.append(cylinder((x, 0.765, z), (x, 0.95, z), 0.06, "clay"))
    for place in rng.uniform(-4.4, 4.4, 6):
        parts.append(cylinder((place, 0, -4.4), (place, 0.4, -4.4), 0.2, "clay"))
    return parts


def roof_tiles(rng):
    """Vertices and faces of slightly turned tiles on the arcades' roofs."""
    x, z = np.meshgrid(np.linspace(-SIZE, SIZE, 34), np.linspace(0.05, DEPTH, 9), indexing="ij")
    x, z = x.ravel(), z.ravel()
    centres = np.stack([x, 3.55 + 0.3 * z / DEPTH, -SIZE - z], axis=1)
    centres = np.concatenate([centres, centres[:, [2, 1, 0]] * [-1, 1, 1]])
    tilt = rng.uniform(-0.05, 0.05, (len(centres), 4, 1)) * [0, 1, 0]
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * 0.145
    vertices = (centres[:, None] + square + tilt).reshape(-1, 3)
    first = 4 * np.arange(len(centres))[:, None]
    return vertices, np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])


def main(write_ply):
    """`write_ply(path, vertices, faces)`: writes a mesh."""
    HERE.mkdir(exist_ok=True)
    rng = np.random.default_rng(27)
    write_ply(HERE / "leaves.ply", *leaves(crown(3600, rng), 0.07, rng))
    write_ply(HERE / "hedge.ply", *leaves(hedge(1800, rng), 0.05, rng))
    write_ply(HERE / "roof.ply", *roof_tiles(rng))
    ground = (
        '  <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/>'
        '<scale value="8"/></transform><ref id="paving"/></shape>\n'
    )
    branches = [
        cylinder((1.2, 0, -0.6), (1.2, 2.2, -0.6), 0.14, "bark"),
        *(
            cylinder(
                (1.2, 1.9, -0.6), (1.2 + 0.9 * np.cos(a), 2.9, -0.6 + 0.9 * np.sin(a)), 0.05, "bark"
            )
            for a in 2 * np.pi * np.arange(5) / 5
        ),
    ]
    parts = [ground, *arcade(), *furniture(rng), *branches]
    parts += [mesh("leaves.ply", "leaf"), mesh("hedge.ply", "leaf"), mesh("roof.ply", "clay")]
    (HERE / "courtyard.xml").write_text(HEAD + "".join(parts) + "</scene>\n")
