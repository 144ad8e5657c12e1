"""Random rooms: scenes that nothing was tuned on, drawn from a number."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SIZE = 256
"""Pixels a side."""
DEPTH = 10
"""Longest path in segments."""


def write_rooms(folder: Path, count: int) -> list[Path]:
    """Write the rooms of the numbers 0 to `count` - 1 as scene files; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"room{number:02d}.xml" for number in range(count)]
    for number, path in enumerate(paths):
        path.write_text(room(number))
    return paths


def room(number: int) -> str:
    """A closed room of 4 to 8 m by 3 to 7 m by 2.5 to 3.5 m, with three to seven objects, one to
    three lamps, and a camera at one end; materials and lamps are drawn, too. Mitsuba XML."""
    rng = np.random.default_rng(number)
    width, depth, height = rng.uniform(3, 7), rng.uniform(4, 8), rng.uniform(2.5, 3.5)
    parts = [_camera(rng, width, depth), *_walls(rng, width, depth, height)]
    parts += [_object(rng, width, depth) for _ in range(rng.integers(3, 8))]
    parts += [_lamp(rng, width, depth, height) for _ in range(rng.integers(1, 4))]
    body = "\n".join(parts)
    return (
        '<scene version="3.0.0">\n'
        f'<integrator type="path"><integer name="max_depth" value="{DEPTH}"/></integrator>\n'
        f"{body}\n</scene>\n"
    )


def _camera(rng, width, depth):
    x = rng.uniform(-0.3, 0.3) * width
    return f"""<sensor type="perspective"><float name="fov" value="{rng.uniform(50, 75):.1f}"/>
<transform name="to_world"><lookat origin="{x:.3f}, 1.5, {depth / 2 - 0.2:.3f}"
    target="{-x / 2:.3f}, 1, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
<rfilter type="box"/></film></sensor>"""


def _walls(rng, width, depth, height):
    """Six rectangles that face inwards."""
    half = height / 2
    placed = (
        (f'<rotate x="1" angle="-90"/><scale x="{width / 2}" z="{depth / 2}"/>', 0, 0, 0),
        (f'<rotate x="1" angle="90"/><scale x="{width / 2}" z="{depth / 2}"/>', 0, height, 0),
        (f'<scale x="{width / 2}" y="{half}"/>', 0, half, -depth / 2),
        (f'<scale x="{width / 2}" y="{half}"/><rotate y="1" angle="180"/>', 0, half, depth / 2),
        (f'<scale x="{depth / 2}" y="{half}"/><rotate y="1" angle="90"/>', -width / 2, half, 0),
        (f'<scale x="{depth / 2}" y="{half}"/><rotate y="1" angle="-90"/>', width / 2, half, 0),
    )
    for transform, x, y, z in placed:
        yield (
            f'<shape type="rectangle"><transform name="to_world">{transform}'
            f'<translate x="{x}" y="{y}" z="{z}"/></transform>{_surface(rng)}</shape>'
        )


def _colour(rng, low=0.15, high=0.8):
    return ", ".join(f"{value:.3f}" for value in rng.uniform(low, high, 3))


def _surface(rng):
    """Half of them diffuse, the others glossy."""
    alpha = 10 ** rng.uniform(-1.5, -0.4)
    diffuse = f'<rgb name="reflectance" value="{_colour(rng)}"/>'
    kinds = (
        f'<bsdf type="diffuse">{diffuse}</bsdf>',
        f'<bsdf type="roughplastic"><float name="alpha" value="{alpha:.3f}"/>'
        f'<rgb name="diffuse_reflectance" value="{_colour(rng)}"/></bsdf>',
        f'<bsdf type="roughconductor"><float name="alpha" value="{alpha:.3f}"/>'
        '<string name="material" value="Al"/></bsdf>',
        f'<bsdf type="principled"><rgb name="base_color" value="{_colour(rng)}"/>'
        f'<float name="roughness" value="{alpha**0.5:.3f}"/>'
        f'<float name="metallic" value="{rng.integers(0, 2)}"/></bsdf>',
    )
    return rng.choice(kinds, p=(0.5, 0.2, 0.1, 0.2))


def _object(rng, width, depth):
    size = rng.uniform(0.2, 0.6)
    x, z = rng.uniform(-0.35, 0.35) * width, rng.uniform(-0.4, 0.2) * depth
    special = ('<bsdf type="dielectric"/>', '<bsdf type="conductor"/>', _surface(rng))
    bsdf = rng.choice(special, p=(0.2, 0.15, 0.65))
    shape = rng.choice(("sphere", "cube"))
    return (
        f'<shape type="{shape}"><transform name="to_world"><scale value="{size}"/>'
        f'<rotate y="1" angle="{rng.uniform(0, 90):.1f}"/>'
        f'<translate x="{x}" y="{size + 0.001}" z="{z}"/></transform>{bsdf}</shape>'
    )


def _lamp(rng, width, depth, height):
    """On the ceiling, as a globe, or without extent."""
    x, z = rng.uniform(-0.35, 0.35) * width, rng.uniform(-0.4, 0.3) * depth
    y, power = height - rng.uniform(0.05, 0.6), rng.uniform(20, 60)
    kind = rng.choice(("panel", "globe", "point", "spot"), p=(0.4, 0.2, 0.2, 0.2))
    if kind == "point":
        return (
            f'<emitter type="point"><point name="position" x="{x}" y="{y}" z="{z}"/>'
            f'<rgb name="intensity" value="{power / 12.6}"/></emitter>'
        )
    if kind == "spot":
        return (
            f'<emitter type="spot"><transform name="to_world"><lookat origin="{x}, {y}, {z}" '
            f'target="{-x / 2}, 0, {z / 2 + 0.01}" up="0, 0, 1"/></transform>'
            f'<float name="cutoff_angle" value="{rng.uniform(20, 50):.1f}"/>'
            f'<rgb name="intensity" value="{power / 3}"/></emitter>'
        )
    size = 10 ** rng.uniform(-1.5, -0.3)
    if kind == "globe":
        shape, area = "sphere", 12.57 * size**2
        transform = f'<scale value="{size}"/>'
    else:
        shape, area = "rectangle", 4 * size**2
        transform = f'<scale value="{size}"/><rotate x="1" angle="90"/>'
    y = min(y, height - size - 0.01) if kind == "globe" else y
    return (
        f'<shape type="{shape}"><transform name="to_world">{transform}'
        f'<translate x="{x}" y="{y}" z="{z}"/></transform><bsdf type="diffuse"/>'
        f'<emitter type="area"><rgb name="radiance" value="{power / (3.14 * area)}"/></emitter>'
        "</shape>"
    )
