"""Write the scenes with several views (XML), and the smoke in two of them (Mitsuba's volume
format); called by `generate.py`.

Everything is computed here from formulas; the same files come out on every run.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np

HERE = Path(__file__).resolve().parent / "multiview"

HEADER = """<?xml version="1.0" encoding="utf-8"?>
<!--
{text}
  Written by scenes/generate.py. The film holds the views side by side; \
resx is the width of all of them.
-->
<scene version="3.0.0">
  <default name="integrator" value="volpath_multiview"/>
  <default name="spp" value="64"/>
  <default name="resx" value="{width}"/>
  <default name="resy" value="{height}"/>
  <default name="max_depth" value="{depth}"/>
  <default name="rr_depth" value="8"/>

  <integrator type="$integrator">
    <integer name="max_depth" value="$max_depth"/>
    <integer name="rr_depth" value="$rr_depth"/>
  </integrator>

"""

FILM = """    <film type="hdrfilm">
      <integer name="width" value="$resx"/>
      <integer name="height" value="$resy"/>
      <string name="pixel_format" value="rgb"/>
      <string name="component_format" value="float32"/>
      <rfilter type="box"/>
    </film>
    <sampler type="independent">
      <integer name="sample_count" value="$spp"/>
    </sampler>
"""

FLOOR = """  <shape type="rectangle" id="floor">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
    <bsdf type="diffuse">
      <texture type="bitmap" name="reflectance">
        <string name="filename" value="../textures/checker.png"/>
      </texture>
    </bsdf>
  </shape>
"""

LAMP = """  <shape type="rectangle" id="lamp">
    <transform name="to_world"><scale value="{size}"/>\
<lookat origin="{origin}" target="{target}" up="0, 0, 1"/></transform>
    <emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter>
  </shape>
"""

SKY = """  <emitter type="constant"><rgb name="radiance" value="{radiance}"/></emitter>
"""

SMOKE = """  <medium type="heterogeneous" id="smoke">
    <volume type="gridvolume" name="sigma_t">
      <string name="filename" value="smoke.vol"/>
      <transform name="to_world"><translate x="-0.5" z="-0.5"/><scale value="2"/></transform>
    </volume>
    <volume type="constvolume" name="albedo"><rgb name="value" value="{albedo}"/></volume>
    <float name="scale" value="{scale}"/>
    <phase type="hg"><float name="g" value="{g}"/></phase>
  </medium>
  <shape type="cube" id="container">
    <transform name="to_world"><translate y="1.02"/></transform>
    <bsdf type="null"/>
    <ref name="interior" id="smoke"/>
  </shape>
"""


CLOUD = """  <medium type="heterogeneous" id="smoke_{name}">
    <volume type="gridvolume" name="sigma_t">
      <string name="filename" value="smoke.vol"/>
      <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/>\
<scale value="1.1"/><translate x="{x}" y="0.75"/></transform>
    </volume>
    <volume type="constvolume" name="albedo"><rgb name="value" value="{albedo}"/></volume>
    <float name="scale" value="{scale}"/>
    <phase type="hg"><float name="g" value="{g}"/></phase>
  </medium>
  <shape type="cube" id="container_{name}">
    <transform name="to_world"><scale value="0.55"/><translate x="{x}" y="0.75"/></transform>
    <bsdf type="null"/>
    <ref name="interior" id="smoke_{name}"/>
  </shape>
"""


def numbers(values):
    return ", ".join(f"{float(x):.5g}" for x in values)


def camera(name, origin, target, fov, inner="", indent="    "):
    look = f'<lookat origin="{numbers(origin)}" target="{numbers(target)}" up="0, 1, 0"/>'
    lines = [
        f'<sensor type="perspective" id="{name}">',
        f'  <float name="fov" value="{fov}"/>',
        f'  <transform name="to_world">{look}</transform>',
        inner,
        "</sensor>",
    ]
    return "".join(indent + line + "\n" for line in lines if line)


def batch(cameras):
    return '  <sensor type="batch" id="views">\n' + "".join(cameras) + FILM + "  </sensor>\n\n"


def write(name, text, size, depth, parts):
    """Writes a scene; `size` is the film's."""
    head = HEADER.format(
        text="\n".join(("  " + line).rstrip() for line in text),
        width=size[0],
        height=size[1],
        depth=depth,
    )
    (HERE / f"{name}.xml").write_text(head + "".join(parts) + "</scene>\n")


def smoke(n=24):
    """Density in [0, 1] on an n^3 grid: a plume that rises, widens and breaks up; wisps, and empty
    space around it."""
    # rows of a volume: z, then y, then x
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 3, indexing="ij")
    rng = np.random.default_rng(5)
    turbulence = np.zeros((n, n, n))
    for octave in range(4):
        for _ in range(6):
            direction = rng.normal(size=3)
            direction *= 2 * np.pi * 1.7**octave / np.linalg.norm(direction)
            turbulence += (
                0.6**octave
                * np.sin(
                    direction[0] * x
                    + direction[1] * y
                    + direction[2] * z
                    + rng.uniform(0, 2 * np.pi)
                )
                / 6
            )
    sway_x, sway_z = 0.5 + 0.09 * np.sin(5 * y), 0.5 + 0.09 * np.cos(4 * y)
    away = np.hypot(x - sway_x, z - sway_z) / (0.10 + 0.26 * y)
    density = np.clip(1.35 - away + 0.9 * turbulence, 0, None) * np.clip((0.97 - y) / 0.25, 0, 1)
    density = np.clip(density - 0.15, 0, None)
    return np.clip(density / (0.4 * density.max()), 0, 1).astype(np.float32)


def orbit(count=16, radius=4.2, height=1.7):
    angles = 2 * np.pi * np.arange(count) / count
    return [
        camera(f"view{i:02d}", (radius * np.sin(a), height, radius * np.cos(a)), (0, 0.9, 0), 38)
        for i, a in enumerate(angles)
    ]


def light_field(side=8, spacing=0.12):
    places = [
        (spacing * (i - (side - 1) / 2), 1 + spacing * ((side - 1) / 2 - j))
        for j in range(side)
        for i in range(side)
    ]
    return [
        camera(f"view{k:02d}", (x, y, 4.0), (x * 0.2, 0.8, 0), 30)
        for k, (x, y) in enumerate(places)
    ]


def flight(count=8):
    """Cameras of their own, for those within the smoke must say so; each with its own film."""
    found = []
    for i, way in enumerate(np.linspace(0, 1, count)):
        origin = np.array([0.5, 1.2, 3.2]) * (1 - way) + np.array([0.1, 0.8, 0.55]) * way
        inside = np.all(np.abs(origin - [0, 1, 0]) < 1)
        medium = '  <ref id="smoke"/>\n' if inside else ""
        inner = (
            (medium + FILM.replace("\n  ", "\n").removeprefix("  ")).rstrip().replace("\n", "\n  ")
        )
        found.append(camera(f"view{i}", origin, (-0.1, 0.75, -0.4), 50, inner, "  "))
    return found


def main():
    HERE.mkdir(exist_ok=True)
    grid = smoke()
    mi.VolumeGrid(grid[..., None]).write(str(HERE / "smoke.vol"))
    thick = SMOKE.format(albedo="0.93, 0.92, 0.90", scale=6, g=0.3)
    lamp = LAMP.format(size=0.8, origin="2.2, 4.5, 1.2", target="0, 0.8, 0", radiance="14, 13, 11")
    sky = SKY.format(radiance="0.35, 0.45, 0.6")
    write(
        "smoke_orbit",
        [
            "Smoke over a textured floor, seen from 16 cameras all around it.",
            "",
            "A heterogeneous grid, many null collisions; "
            "every view sees the smoke and most of the floor.",
            "Claim: sharing paths saves most of the long multiple scattering.",
        ],
        (1024, 64),
        64,
        [batch(orbit()), thick, FLOOR, lamp, sky],
    )
    write(
        "light_field",
        [
            "A light field of 8 x 8 cameras: a glossy knot in homogeneous fog.",
            "",
            "64 close views share almost all of their paths; "
            "the knot's lobes differ from view to view,",
            "so suffixes must come from the mixture.",
        ],
        (2048, 32),
        16,
        [
            batch(light_field()),
            '  <medium type="homogeneous" id="fog">\n    <float name="sigma_t" value="0.35"/>\n'
            '    <float name="albedo" value="0.9"/>\n'
            '    <phase type="hg"><float name="g" value="0.5"/></phase>\n  </medium>\n',
            '  <shape type="cube" id="container">\n'
            '    <transform name="to_world"><scale x="2.5" y="1.6" z="2"/>'
            '<translate y="1"/></transform>\n'
            '    <bsdf type="null"/>\n    <ref name="interior" id="fog"/>\n  </shape>\n',
            '  <shape type="ply" id="knot">\n'
            '    <string name="filename" value="../meshes/knot.ply"/>\n'
            '    <transform name="to_world"><scale value="1.6"/><translate y="0.8"/></transform>\n'
            '    <bsdf type="roughconductor"><string name="material" value="Cu"/>'
            '<float name="alpha" value="0.12"/></bsdf>\n'
            "  </shape>\n",
            FLOOR,
            lamp,
            SKY.format(radiance="0.2, 0.25, 0.3"),
        ],
    )
    write(
        "fly_through",
        [
            "A camera flies into the smoke: eight views with films of their own, "
            "the last two within the medium.",
            "",
            "Views that see each other's pivots from very different distances.",
            "Render with mis_integrators.render_views or mis-render (option all-views).",
        ],
        (64, 64),
        64,
        [thick, *flight(), FLOOR, lamp, sky],
    )
    write(
        "three_media",
        [
            "Three clouds in a row, majorants apart by factors of six: thin, middling, dense.",
            "",
            "Views from both ends look through all three of them, those across through one:",
            "raw depth and majorant optical depth then put null interactions to different places.",
        ],
        (512, 64),
        32,
        [
            batch(
                [
                    camera(f"view{i}", (4.2 * np.sin(a), 1.3, 4.2 * np.cos(a)), (0, 0.6, 0), 46)
                    for i, a in enumerate(np.radians([-95, -75, -45, -10, 15, 50, 80, 100]))
                ]
            ),
            *(
                CLOUD.format(name=name, x=x, scale=scale, albedo=albedo, g=g)
                for name, x, scale, albedo, g in (
                    ("thin", -1.3, 0.6, "0.95, 0.9, 0.85", 0.0),
                    ("middling", 0.0, 3.6, "0.95, 0.94, 0.92", 0.4),
                    ("dense", 1.3, 21.6, "0.85, 0.9, 0.95", 0.2),
                )
            ),
            FLOOR,
            lamp,
            sky,
        ],
    )
    write(
        "apart",
        [
            "Two views back to back, each with a cloud of its own: no path can be shared.",
            "",
            "Must cost little more than two plain renders, and be as noisy.",
        ],
        (128, 64),
        16,
        [
            batch(
                [
                    camera("front", (0, 1.2, 0.5), (0, 0.9, 4), 45),
                    camera("back", (0, 1.2, -0.5), (0, 0.9, -4), 45),
                ]
            ),
            '  <medium type="homogeneous" id="cloud">\n'
            '    <float name="sigma_t" value="0.8"/>\n'
            '    <float name="albedo" value="0.95"/>\n'
            "  </medium>\n",
            *(
                f'  <shape type="sphere" id="{name}">\n'
                f'    <point name="center" x="0" y="1" z="{z}"/>\n'
                '    <float name="radius" value="0.9"/>\n'
                f'    <bsdf type="null"/>\n    <ref name="interior" id="cloud"/>\n  </shape>\n'
                for name, z in (("cloud_front", 3), ("cloud_back", -3))
            ),
            FLOOR.replace('"4"', '"6"'),
            lamp,
            sky,
        ],
    )


if __name__ == "__main__":
    mi.set_variant("scalar_rgb")
    main()
