"""Meshes of the still life, `scenes/gallery/still_life.xml`: a goblet, a gem, a ring and the sweep
behind them."""

from pathlib import Path

import numpy as np


def revolve(profile, around):
    """A surface of revolution about y, from points (radius, height): vertices, normals, triangles.
    On the way along the points its outside is to the right, as seen with the axis on the left."""
    profile = np.asarray(profile, float)
    along = np.gradient(profile, axis=0)
    across = np.stack([along[:, 1], -along[:, 0]], -1)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    up = np.array([0.0, 1.0, 0.0])
    vertices, normals = (
        (pairs[:, :1, None] * ring + pairs[:, 1:, None] * up).reshape(-1, 3)
        for pairs in (profile, across)
    )
    rows = np.arange(len(profile) - 1)[:, None] * (around + 1)
    a = (rows + np.arange(around)[None, :]).ravel()
    b, c, d = a + 1, a + around + 1, a + around + 2
    radius = np.repeat(profile[:, 0], around)  # at the axis triangles have two corners in one
    lower, upper = radius[: len(a)] > 0, radius[around:] > 0
    faces = np.concatenate([np.stack([a, c, b], 1)[lower], np.stack([b, c, d], 1)[upper]])
    return vertices, normals, faces


def spline(keys, count):
    """Points on a Catmull-Rom curve through the keys."""
    keys = np.asarray(keys, float)
    ends = np.concatenate([[2 * keys[0] - keys[1]], keys, [2 * keys[-1] - keys[-2]]])
    t = np.linspace(0, len(keys) - 1, count)
    i = np.minimum(t.astype(int), len(keys) - 2)
    w = (t - i)[:, None]
    p = [ends[i + k] for k in range(4)]
    return 0.5 * (
        2 * p[1]
        + (p[2] - p[0]) * w
        + (2 * p[0] - 5 * p[1] + 4 * p[2] - p[3]) * w**2
        + (3 * p[1] - p[0] - 3 * p[2] + p[3]) * w**3
    )


LEVEL = 0.74
"""Height of the wine in the goblet."""


def goblet(write):
    """A goblet of one piece of glass, a metre high, that stands on y = 0, and its wine.

    Three surfaces, each between two media: glass and air (foot, stem, bowl, and the inside of the
    bowl down to the wine), wine and glass, wine and air.
    """
    outside = spline(
        [
            *[(0.0, 0.0), (0.16, 0.0), (0.262, 0.004), (0.27, 0.014), (0.255, 0.026)],
            *[(0.14, 0.045), (0.05, 0.085), (0.034, 0.16), (0.042, 0.24), (0.034, 0.33)],
            *[(0.05, 0.40), (0.13, 0.45), (0.23, 0.54), (0.275, 0.66), (0.268, 0.80)],
            *[(0.245, 0.93), (0.232, 0.992), (0.228, 1.0)],
        ],
        100,
    )
    inside = spline(
        [
            *[(0.228, 1.0), (0.222, 0.992), (0.232, 0.93), (0.256, 0.80), (0.259, LEVEL)],
            *[(0.261, 0.66), (0.216, 0.553), (0.12, 0.475), (0.05, 0.452), (0.0, 0.448)],
        ],
        64,
    )
    filled = int(np.argmin(np.abs(inside[:, 1] - LEVEL)))
    write("goblet.ply", *revolve(np.concatenate([outside, inside[1 : filled + 1]]), 80))
    write("wine.ply", *revolve(inside[filled:][::-1], 80))
    write("wine_surface.ply", *revolve([inside[filled], (0.0, inside[filled, 1])], 80))


def ring(write):
    """A band with rounded edges, radius 1, of half height 0.2: closed."""
    angle = np.linspace(-np.pi, np.pi, 33)
    flat = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.5
    tall = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.5
    profile = np.stack([1 + 0.07 * flat, 0.2 * tall], -1)
    write("ring.ply", *revolve(profile, 120))


def gem(write):
    """A cut stone of radius 1 with its point down, 24 facets and a flat top."""
    rings = [(0.56, 0.34, 0.0), (0.84, 0.20, 0.5), (1.0, 0.0, 0.0), (0.52, -0.42, 0.5)]
    points = [
        [r * np.cos(2 * np.pi * (k + half) / 8), y, r * np.sin(2 * np.pi * (k + half) / 8)]
        for r, y, half in rings
        for k in range(8)
    ]
    points += [[0, -0.86, 0]]
    points = np.array(points)
    faces = [[0, k + 1, k] for k in range(1, 7)]
    for level in range(3):
        for k in range(8):
            a, b = 8 * level + k, 8 * level + (k + 1) % 8
            low = 8 * (level + 1)
            if rings[level][2] == 0:
                c, d = low + k, low + (k - 1) % 8
                faces += [[a, b, c], [a, c, d]]
            else:
                c, d = low + (k + 1) % 8, low + k
                faces += [[a, b, c], [a, c, d]]
    faces += [[24 + k, 24 + (k + 1) % 8, 32] for k in range(8)]
    faces = np.array(faces)
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = np.sum(normals * corners.mean(1), -1) > 0
    faces[~outwards] = faces[~outwards][:, ::-1]
    write("gem.ply", points, None, faces)


def sweep(write):
    """A table that bends up into a wall: 12 wide, from z = 6 to a wall at z = -7."""
    bend = np.linspace(0, np.pi / 2, 33)
    arc = np.stack([-4.0 - 3.0 * np.sin(bend), 3.0 * (1 - np.cos(bend))], -1)
    side = np.concatenate([[[6.0, 0.0]], arc, [[-7.0, 9.0]]])
    slope = np.concatenate([[0.0], bend, [np.pi / 2]])
    x = np.array([-9.0, 9.0])
    vertices = [[x_, y, z] for z, y in side for x_ in x]
    normals = [[0.0, np.cos(s), np.sin(s)] for s in slope for _ in x]
    a = 2 * np.arange(len(side) - 1)
    faces = np.concatenate([np.stack([a, a + 1, a + 3], 1), np.stack([a, a + 3, a + 2], 1)])
    write("sweep.ply", np.array(vertices), np.array(normals), faces)


def write_all(folder: Path, write_ply):
    """Write them with `write_ply(path, vertices, faces, normals)`."""

    def write(name, vertices, normals, faces):
        write_ply(folder / name, vertices, faces, normals)

    for mesh in (goblet, ring, gem, sweep):
        mesh(write)
