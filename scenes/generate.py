"""Write the meshes (PLY), textures (PNG) and the sky (EXR) of the bundled scenes, and the scenes
with several views and outdoors.

    python scenes/generate.py

Everything is computed here from formulas; nothing is copied from elsewhere. The same files come out
on every run. Meshes are in metres, y up unless stated. NumPy does the work, Mitsuba's Bitmap writes
the images.
"""

from pathlib import Path

import generate_multiview
import generate_outdoor
import generate_still_life
import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")  # only for mi.Bitmap: needs no LLVM

HERE = Path(__file__).resolve().parent
MESHES = HERE / "meshes"
TEXTURES = HERE / "textures"


# --- writing ------------------------------------------------------------------


def write_ply(name, vertices, faces, normals=None, uv=None):
    """Binary PLY with float32 positions, optional normals and texture coordinates, and
    triangles."""
    columns, names = [vertices], ["x", "y", "z"]
    if normals is not None:
        columns.append(normals)
        names += ["nx", "ny", "nz"]
    if uv is not None:
        columns.append(uv)
        names += ["u", "v"]
    table = np.concatenate(columns, axis=1).astype("<f4")
    triangles = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    triangles["n"], triangles["i"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {n}" for n in names]
    header += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    (MESHES / name).write_bytes("\n".join(header).encode() + table.tobytes() + triangles.tobytes())


def write_png(name, image):
    """8-bit image from values in [0, 1], written as they are (encode colours to sRGB first)."""
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(TEXTURES / name))


def srgb(linear):
    """sRGB encoding of linear values."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def normalised(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def grid_faces(rows, columns):
    """Triangles of a grid of rows x columns vertices, row by row; counter-clockwise where rows x
    columns is the normal."""
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    return np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)])


# --- meshes -------------------------------------------------------------------


def water(size=1.15, n=136):
    """Height field y(x, z) on [-size, size]^2, normals up: six plane waves, normals from the exact
    derivative."""
    rng = np.random.default_rng(7)
    # rows along z
    x, z = np.meshgrid(np.linspace(-size, size, n), np.linspace(-size, size, n), indexing="xy")
    y, dx, dz = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    for i in range(6):
        wavelength = 0.95 * 0.80**i
        angle = 0.6 + 2.4 * i + rng.uniform(-0.3, 0.3)
        kx, kz = 2 * np.pi / wavelength * np.array([np.cos(angle), np.sin(angle)])
        amplitude, phase = 0.0195 * wavelength, rng.uniform(0, 2 * np.pi)
        y += amplitude * np.sin(kx * x + kz * z + phase)
        dx += amplitude * kx * np.cos(kx * x + kz * z + phase)
        dz += amplitude * kz * np.cos(kx * x + kz * z + phase)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    normals = normalised(np.stack([-dx, np.ones_like(x), -dz], -1).reshape(-1, 3))
    write_ply("water.ply", vertices, grid_faces(n, n), normals)


def knot(n=220, m=18, tube=0.075):
    """Torus knot (2, 3) about the z axis, about 0.8 across, centred at the origin; normals and
    texture coordinates."""

    def curve(t):
        r = 0.25 + 0.10 * np.cos(3 * t)
        return np.stack([r * np.cos(2 * t), r * np.sin(2 * t), -0.12 * np.sin(3 * t)], -1)

    t = np.linspace(0, 2 * np.pi, n + 1)
    h = 1e-4
    tangent = normalised(curve(t + h) - curve(t - h))
    outward = curve(t) - np.array([0.25, 0.25, 0]) * np.stack(
        [np.cos(2 * t), np.sin(2 * t), 0 * t], -1
    )
    side = normalised(outward - np.sum(outward * tangent, -1, keepdims=True) * tangent)
    binormal = np.cross(tangent, side)
    s = np.linspace(0, 2 * np.pi, m + 1)
    normals = (
        np.cos(s)[None, :, None] * side[:, None] + np.sin(s)[None, :, None] * binormal[:, None]
    )
    vertices = curve(t)[:, None] + tube * normals
    uv = np.stack(np.meshgrid(t / (2 * np.pi), s / (2 * np.pi), indexing="ij"), -1)
    faces = grid_faces(n + 1, m + 1)[:, ::-1]
    write_ply("knot.ply", vertices.reshape(-1, 3), faces, normals.reshape(-1, 3), uv.reshape(-1, 2))


def vase(n=56, m=64, height=0.40):
    """Closed vase: solid of revolution about y, foot at y = 0, with an inner wall; normals and
    texture coordinates."""

    def smooth(keys, t):  # cosine steps between (t, value) keys
        keys = np.array(keys)
        i = np.clip(np.searchsorted(keys[:, 0], t, side="right") - 1, 0, len(keys) - 2)
        w = (t - keys[i, 0]) / (keys[i + 1, 0] - keys[i, 0])
        w = 0.5 - 0.5 * np.cos(np.pi * w)
        return keys[i, 1] * (1 - w) + keys[i + 1, 1] * w

    t = np.linspace(0, 1, n)
    outer_r = smooth([(0, 0.065), (0.42, 0.135), (0.82, 0.045), (1, 0.075)], t)
    outer = np.stack([outer_r, height * t], -1)
    inner_t = np.linspace(1, 0.06, n)
    inner = np.stack(
        [
            smooth([(0, 0.065), (0.42, 0.135), (0.82, 0.045), (1, 0.075)], inner_t) - 0.008,
            height * inner_t,
        ],
        -1,
    )
    vertices, normals, uvs, faces, count = [], [], [], [], 0

    def revolve(profile, v):
        nonlocal count
        d = np.gradient(profile, axis=0)
        across = normalised(np.stack([d[:, 1], -d[:, 0]], -1))
        a = np.linspace(0, 2 * np.pi, m + 1)
        ring = np.stack([np.cos(a), 0 * a, np.sin(a)], -1)
        up = np.array([0.0, 1.0, 0.0])
        vertices.append((profile[:, :1, None] * ring + profile[:, 1:, None] * up).reshape(-1, 3))
        normals.append((across[:, :1, None] * ring + across[:, 1:, None] * up).reshape(-1, 3))
        uvs.append(
            np.stack(np.meshgrid(v, a / (2 * np.pi), indexing="ij")[::-1], -1).reshape(-1, 2)
        )
        faces.append(grid_faces(len(profile), m + 1) + count)
        count += len(profile) * (m + 1)

    revolve(np.array([[0.0, 0.0], [outer[0, 0], 0.0]]), np.array([0.0, 0.0]))  # foot, looks down
    revolve(outer, t)
    # rim
    revolve(
        np.stack([np.linspace(outer[-1, 0], inner[0, 0], 2), [height, height]], -1),
        np.array([1.0, 1.0]),
    )
    revolve(inner, inner_t)
    # inner floor, looks up
    revolve(np.array([[inner[-1, 0], inner[-1, 1]], [0.0, inner[-1, 1]]]), np.array([0.06, 0.06]))
    triangles, points = np.concatenate(faces), np.concatenate(vertices)
    a, b, c = (points[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    write_ply(
        "vase.ply", points, triangles[area > 1e-9], np.concatenate(normals), np.concatenate(uvs)
    )


def tiles(
    name, columns, rows, size=0.3, bevel=0.008, height=0.003, tilt=0.004, parity=None, seed=1
):
    """A panel of square tiles in the xy plane, lower left corner at the origin, looking along +z.

    Each tile is a flat top, tilted by a random fraction of `tilt` (radians), with a bevel down to
    the plane z = 0, where neighbours share their edge: the panel has no gaps. `parity` 0 or 1 keeps
    every other tile (chessboard).
    """
    rng = np.random.default_rng(seed)
    vertices, faces = [], []
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    for j in range(rows):
        for i in range(columns):
            slope = rng.uniform(-tilt, tilt, 2)
            if parity is not None and (i + j) % 2 != parity:
                continue
            base = len(vertices)
            low = (np.array([i, j]) + corner) * size
            top = low + (1 - 2 * corner) * bevel
            top_z = height + (top - top.mean(0)) @ slope
            vertices += [[x, y, 0.0] for x, y in low]
            vertices += [[x, y, z] for (x, y), z in zip(top, top_z)]
            faces += [[base + 4, base + 5, base + 6], [base + 4, base + 6, base + 7]]
            for k in range(4):
                after = (k + 1) % 4
                faces += [
                    [base + k, base + after, base + 4 + after],
                    [base + k, base + 4 + after, base + 4 + k],
                ]
    write_ply(name, np.array(vertices), np.array(faces))


# --- textures -----------------------------------------------------------------


def noise(n, cells, octaves, seed, stretch=(1, 1)):
    """Periodic value noise on n x n pixels in [0, 1]; `stretch` multiplies the cells along (rows,
    columns)."""
    rng = np.random.default_rng(seed)
    total, weight = np.zeros((n, n)), 0.0
    for o in range(octaves):
        cy, cx = cells * 2**o * stretch[0], cells * 2**o * stretch[1]
        lattice = rng.uniform(0, 1, (cy, cx))
        py, px = (np.arange(n) + 0.5) / n * cy, (np.arange(n) + 0.5) / n * cx
        iy, ix = py.astype(int), px.astype(int)
        fy, fx = (f * f * (3 - 2 * f) for f in (py - iy, px - ix))
        fy, fx = fy[:, None], fx[None, :]
        rows, columns = (iy, (iy + 1) % cy), (ix, (ix + 1) % cx)
        at = [[lattice[np.ix_(row, column)] for column in columns] for row in rows]
        total += 0.5**o * (
            (at[0][0] * (1 - fx) + at[0][1] * fx) * (1 - fy)
            + (at[1][0] * (1 - fx) + at[1][1] * fx) * fy
        )
        weight += 0.5**o
    return total / weight


def mix(a, b, w):
    return np.asarray(a) * (1 - w[..., None]) + np.asarray(b) * w[..., None]


def wood(n=256, boards=4):
    """Floor boards along the columns of the image: colour (sRGB) and roughness (raw)."""
    rng = np.random.default_rng(11)
    y = (np.arange(n) + 0.5) / n * boards
    board, across = y.astype(int), y % 1.0
    grain = noise(n, 2, 4, 12, stretch=(16, 1))
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (7 * noise(n, 2, 2, 13, stretch=(4, 1)) + 0.4 * grain))
    shift = rng.uniform(-0.16, 0.16, boards)[board][:, None]
    w = np.clip(0.30 + 0.30 * rings + 0.35 * (grain - 0.5) + shift, 0, 1)
    joint = (np.minimum(across, 1 - across) < 0.018)[:, None] * np.ones((1, n), bool)
    colour = mix([0.46, 0.27, 0.13], [0.20, 0.095, 0.04], w)
    colour[joint] = [0.05, 0.03, 0.02]
    write_png("wood.png", srgb(colour))
    rough = 0.22 + 0.25 * grain
    rough[joint] = 0.7
    write_png("wood_roughness.png", rough)


def bricks(n=256, columns=4, rows=8):
    """Brick wall: colour (sRGB) and tangent-space normal map (raw)."""
    rng = np.random.default_rng(21)
    v, u = np.meshgrid(
        (np.arange(n) + 0.5) / n * rows, (np.arange(n) + 0.5) / n * columns, indexing="ij"
    )
    row = v.astype(int)
    u = (u + 0.5 * (row % 2)) % columns
    column = u.astype(int)
    edge = np.minimum(np.minimum(u % 1, 1 - u % 1) / columns, np.minimum(v % 1, 1 - v % 1) / rows)
    face = np.clip((edge - 0.006) / 0.010, 0, 1)
    face = face * face * (3 - 2 * face)
    rough = noise(n, 16, 3, 22)
    tone = rng.uniform(0, 1, (rows, columns))[row, column]
    colour = mix([0.44, 0.15, 0.09], [0.30, 0.11, 0.07], np.clip(tone + 0.6 * (rough - 0.5), 0, 1))
    write_png(
        "bricks.png", srgb(mix([0.42, 0.39, 0.35], [0, 0, 0], face) + colour * face[..., None])
    )
    height = 0.010 * face + 0.003 * rough  # in widths of the image
    du = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * n / 2
    dv = (np.roll(height, 1, 0) - np.roll(height, -1, 0)) * n / 2  # image rows run against v
    write_png(
        "bricks_normal.png", 0.5 + 0.5 * normalised(np.stack([-du, -dv, np.ones_like(du)], -1))
    )


def checker(n=128, cells=8):
    """Two-coloured checker with a fine border (sRGB)."""
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n * cells] * 2, indexing="ij")
    odd = (y.astype(int) + x.astype(int)) % 2 == 1
    write_png("checker.png", srgb(np.where(odd[..., None], [0.75, 0.70, 0.60], [0.05, 0.18, 0.24])))


def lattice(n=128, cells=4):
    """Opacity of a pierced screen (raw, 1 where solid): a round hole in each cell, a small one at
    each corner."""
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n * cells % 1] * 2, indexing="ij")
    middle = np.hypot(x - 0.5, y - 0.5)
    corner = np.hypot(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    write_png("lattice.png", ((middle > 0.36) & (corner > 0.17)).astype(float))


def patina(n=128):
    """Blotches in [0, 1] (raw): blend weight, roughness variation, bump."""
    w = noise(n, 4, 5, 31)
    write_png("patina.png", np.clip((w - 0.5) * 5 + 0.5, 0, 1))
    write_png("bumps.png", noise(n, 8, 4, 32))


# --- sky ----------------------------------------------------------------------


def sky(width=256, height=128):
    """Sky with a soft sun 40 degrees above the horizon, over -z in the map's own frame; hills,
    fields. Linear radiance.

    Mitsuba's lat-long frame: column u looks along (sin 2 pi u, ., -cos 2 pi u), row v at the angle
    pi v from +y.
    """
    theta = (np.arange(height) + 0.5)[:, None] / height * np.pi
    phi = (np.arange(width) + 0.5)[None, :] / width * 2 * np.pi
    d = np.stack(
        [
            np.sin(phi) * np.sin(theta),
            np.cos(theta) * np.ones_like(phi),
            -np.cos(phi) * np.sin(theta),
        ],
        -1,
    )
    elevation = np.radians(40)
    sun = np.array([0, np.sin(elevation), -np.cos(elevation)])
    cosine = np.clip(d @ sun, -1, 1)
    angle = np.degrees(np.arccos(cosine))
    up = np.clip(d[..., 1], 0, 1)
    image = mix([1.05, 1.05, 1.0], [0.30, 0.52, 1.0], np.sqrt(up))
    image += np.exp(-angle / 18)[..., None] * np.array([1.6, 1.35, 1.0])
    # height of the hills
    ground = np.radians(2.5) * (1.2 + np.sin(3 * phi + 0.5) + 0.5 * np.sin(8 * phi + 2))
    below = np.clip((ground - d[..., 1]) / 0.03, 0, 1)[..., None]
    depth = np.clip(-d[..., 1] / 0.25, 0, 1) * np.ones_like(phi)
    image = mix([0.20, 0.30, 0.24], [0.26, 0.28, 0.12], depth) * below + image * (1 - below)
    image += (np.exp(-0.5 * (angle / 2.2) ** 2) * 520)[..., None] * np.array([1.0, 0.90, 0.74])
    mi.Bitmap(np.ascontiguousarray(image.astype(np.float16))).write(str(TEXTURES / "sky.exr"))


def main():
    MESHES.mkdir(exist_ok=True)
    TEXTURES.mkdir(exist_ok=True)
    water()
    knot()
    vase()
    tiles("tiles_floor_light.ply", 6, 30, parity=0, seed=1)
    tiles("tiles_floor_dark.ply", 6, 30, parity=1, seed=1)
    tiles("tiles_wall.ply", 30, 4, seed=2)
    wood()
    bricks()
    checker()
    lattice()
    patina()
    sky()
    generate_multiview.main()
    generate_outdoor.main(write_ply)
    generate_still_life.write_all(HERE / "gallery", write_ply)


if __name__ == "__main__":
    main()
