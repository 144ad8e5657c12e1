"""The covered share of merge disks, which corrects estimates near edges, against areas in closed
form."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_radius import FIVE_SIGMA, lost_share

COUNT = 4096
RADIUS = 0.1
EDGES = [0.2, 0.4, 0.6, 0.8]
"""Distances of edges, in radii. Between 0.5 and 0.7 probes may end before they meet one: 0.002 are
allowed."""


def scene_with(**shapes):
    """A floor at z = 0, from -1 to 1, with more shapes."""
    return mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}, **shapes})


def share_at(scene, x, height=0.5):
    """Covered shares of `COUNT` disks around the floor's point (x, 0, 0), seen from so high above
    it."""
    from mis_integrators.paths.bent_surfaces import FLAGS
    from mis_integrators.photons.coverage import coverage  # of the active variant

    ray = mi.Ray3f(mi.Point3f(dr.full(mi.Float, x, COUNT), 0, height), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect_preliminary(ray).compute_surface_interaction(ray, FLAGS)
    vertices = {
        "ray_d": ray.d,
        "path": dr.arange(mi.UInt32, COUNT),
        "depth": dr.ones(mi.UInt32, COUNT),
    }
    radius, seed = dr.opaque(mi.Float, RADIUS), dr.opaque(mi.UInt32, 7)
    return np.array(coverage(scene, vertices, si, radius, seed, mi.Bool(True)).share)


def lacks(shares, expected):
    assert abs(1 - shares.mean() - expected) < FIVE_SIGMA * shares.std() / np.sqrt(COUNT) + 0.002


def test_whole_disks_are_covered(rgb):
    assert np.all(share_at(scene_with(), 0.0) == 1)


@pytest.mark.parametrize("u", EDGES)
def test_where_the_floor_ends(rgb, u):
    lacks(share_at(scene_with(), 1 - u * RADIUS), lost_share(u))


@pytest.mark.parametrize("u", EDGES)
def test_in_front_of_a_wall(rgb, u):
    """The floor goes on behind the wall, but no photon of this side lands there."""
    place = mi.ScalarTransform4f().translate([u * RADIUS, 0, 0]).rotate([0, 1, 0], -90)
    lacks(share_at(scene_with(wall={"type": "rectangle", "to_world": place}), 0.0), lost_share(u))


def test_above_a_step(rgb):
    """What lies deeper than half of the radius takes no photons of the disk."""
    below = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([1, 0, -0.6 * RADIUS]),
    }
    lacks(share_at(scene_with(below=below), 1 - 0.2 * RADIUS), lost_share(0.2))


def test_in_a_corner(rgb):
    """An edge through the centre leaves one half, another at right angles a quarter: shares stop at
    0.4."""
    place = mi.ScalarTransform4f().rotate([1, 0, 0], 90).translate([0, 0, 1e-4])
    shares = share_at(scene_with(wall={"type": "rectangle", "to_world": place}), 1 - 1e-4)
    assert np.all(shares == pytest.approx(0.4))


@pytest.mark.parametrize("depth", [0.1, 0.3])
@pytest.mark.parametrize("u", [0.1, 0.4])
def test_beside_a_step_down(rgb, u, depth):
    """Photons on a step less than half of the radius deep count, within the radius in space.
    Probes may be a hundredth longer."""
    below = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([1, 0, -depth * RADIUS]),
    }
    x, y = np.meshgrid(*[(np.arange(1000) + 0.5) / 500 - 1] * 2)
    disk = x**2 + y**2 < 1
    lost = np.mean((x > u)[disk] & (x**2 + y**2 + depth**2 > 1)[disk])
    assert abs(1 - share_at(scene_with(below=below), 1 - u * RADIUS).mean() - lost) < 0.012


@pytest.mark.parametrize("gap", [0.02, 0.2, 0.6])
def test_under_a_solid(rgb, gap):
    """Photons reach the floor under a block that hovers, however close: probes must not start
    inside it."""
    block = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 0, gap * RADIUS + 0.5]).scale(0.5),
    }
    assert np.all(share_at(scene_with(block=block), 0.0, 0.5 * gap * RADIUS) == 1)


BENT = 0.15
"""Radius of curved surfaces: disks of `RADIUS` around their points reach as far as those of
`curvature.bounded` may."""


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "sphere", "radius": BENT},
        {"type": "cylinder", "p0": [-1, 0, 0], "p1": [1, 0, 0], "radius": BENT},
    ],
)
@pytest.mark.parametrize("height", [0.5, 0.0])
def test_curved_surfaces_are_covered(rgb, shape, height):
    """From outside and from within: photons around lie on them all the same."""
    assert np.all(share_at(mi.load_dict({"type": "scene", "shape": shape}), 0.01, height) == 1)


@pytest.mark.parametrize("u", EDGES)
def test_where_a_cylinder_ends(rgb, u):
    """It can be unrolled: as where a floor ends, but for chords that are shorter than arcs (2 % at
    most)."""
    shape = {"type": "cylinder", "p0": [-1, 0, 0], "p1": [1, 0, 0], "radius": 0.2}
    shares = share_at(mi.load_dict({"type": "scene", "shape": shape}), 1 - u * RADIUS)
    assert abs(1 - shares.mean() - lost_share(u)) < 0.02
