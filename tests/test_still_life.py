"""The meshes of `scenes/gallery/still_life.xml`: closed where they bound glass, wine and gold, with
normals that look out of them, and those that `scenes/generate.py` makes."""

import sys
from collections import Counter
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

SCENES = Path(__file__).parent.parent / "scenes"
CLOSED = {
    "glass": (("goblet", 1), ("wine", -1)),
    "wine": (("wine", 1), ("wine_surface", 1)),
    "gold": (("ring", 1),),
    "gem": (("gem", 1),),
}
"""Bodies by the meshes around them; -1 where the body is on the side to which the normals point."""


@pytest.fixture(scope="module")
def meshes():
    """Vertices, normals and triangles by name, as they are generated."""
    sys.path.insert(0, str(SCENES))
    try:
        import generate_still_life
    finally:
        sys.path.remove(str(SCENES))
    found = {}

    def keep(path, vertices, faces, normals):
        found[path.stem] = vertices, normals, faces

    generate_still_life.write_all(SCENES / "gallery", keep)
    return found


def corners(mesh):
    vertices, _, faces = mesh
    return np.asarray(vertices, float)[faces]


@pytest.mark.parametrize("body", CLOSED)
def test_bodies_are_closed(meshes, body):
    """Each edge of a triangle is one of another, which goes the other way; the volume that the
    normals leave behind is positive."""
    edges, volume = Counter(), 0.0
    for name, side in CLOSED[body]:
        triangles = corners(meshes[name])[:, ::side]
        volume += np.linalg.det(triangles).sum() / 6
        for a, b, c in np.round(triangles, 6) + 0.0:
            for start, end in ((a, b), (b, c), (c, a)):
                edges[tuple(start), tuple(end)] += 1
    assert all(edges[end, start] == count for (start, end), count in edges.items())
    assert volume > 1e-3


def test_normals_look_where_triangles_do(meshes):
    for name, mesh in meshes.items():
        _, normals, faces = mesh
        a, b, c = np.moveaxis(corners(mesh), 1, 0)
        across = np.cross(b - a, c - a)
        area = np.linalg.norm(across, axis=1)
        assert area.min() > 0, name
        if normals is not None:
            cosines = np.sum(across[:, None] * normals[faces], axis=2) / area[:, None]
            assert cosines.min() > 0.5, name


def test_files_are_the_generated_ones(rgb, meshes):
    """Vertex by vertex, as the scene loads them."""
    named = set()
    for shape in mi.load_file(str(SCENES / "gallery" / "still_life.xml")).shapes():
        if shape.id() in meshes:
            named.add(shape.id())
    assert named == meshes.keys()
    for name, (vertices, *_, faces) in meshes.items():
        file = SCENES / "gallery" / f"{name}.ply"
        mesh = mi.load_dict({"type": "ply", "filename": str(file)})
        np.testing.assert_allclose(
            np.array(mesh.vertex_positions_buffer()).reshape(-1, 3), vertices, atol=1e-6
        )
        np.testing.assert_array_equal(np.array(mesh.faces_buffer()).reshape(-1, 3), faces)
