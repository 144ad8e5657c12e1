"""Legs, leaves and rims that are narrower than merge disks: `bdpm` gathers none but caustic photons
there, and paths go on."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import SessionBatches, agree
from foggy import volpath
from pilots import as_chosen
from selection import extended
from worlds import T, diffuse, path, under_a_lamp

RADIUS = 0.12
"""Of merge disks; legs are a fifth of it wide."""
SETTINGS = {"max_depth": 5, "rr_depth": 50}


def legs(material=None, floor=None, **objects):
    """A forest of thin legs on a floor, under a lamp: square ones and round ones."""
    rng = np.random.default_rng(4)
    ground = {"type": "rectangle", "to_world": T().scale(1.5), "bsdf": floor or diffuse(0.7)}
    scene = under_a_lamp(1, floor=ground)
    for number, (x, y) in enumerate(rng.uniform(-1, 1, (100, 2))):
        if number % 2:
            shape = {"type": "cylinder", "p0": [x, y, 0], "p1": [x, y, 0.6], "radius": RADIUS / 10}
        else:
            place = T().translate([x, y, 0.3]).scale([RADIUS / 10] * 2 + [0.3])
            shape = {"type": "cube", "to_world": place}
        scene[f"leg{number}"] = {
            **shape,
            "bsdf": {"type": "twosided", "bsdf": material or diffuse(0.7)},
        }
    return mi.load_dict({**scene, **objects})


@pytest.fixture
def merged(rgb, monkeypatch):
    return as_chosen(monkeypatch, RADIUS, **SETTINGS)


GLASS = {"type": "sphere", "center": [0, -1, 0.4], "radius": 0.3, "bsdf": {"type": "dielectric"}}
COAT = {"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": 0.5}
HALF_METAL = {
    "type": "blendbsdf",
    "weight": 0.5,
    "matt": {"type": "diffuse", "reflectance": 0.7},
    "metal": {"type": "roughconductor", "material": "Al", "alpha": 0.05},
}
"""Narrow from everywhere, with an even part."""


@pytest.mark.parametrize(
    "objects, more",
    [
        ({}, {"camera_paths": 2}),
        ({"material": HALF_METAL}, {}),
        *extended(
            ({"ball": GLASS}, {}),
            ({}, {"direct_paths": 3}),
            ({"floor": COAT}, {}),
        ),
    ],
)
def test_means(merged, objects, more):
    """As of `path`, with false alarms of 1e-6: no light is lost or counted twice. What is left is
    the bias of the floor's disks. (With photons at all vertices it is 5 % too dark.)"""
    agree(merged(**more), path(**SETTINGS), legs(**objects), blocks=1, whole=0.015, block=0.015)


def test_without_it_legs_are_dark(merged):
    """The test above is no test else."""

    def mean(pass_narrow):
        made = merged(camera_paths=2, pass_narrow=pass_narrow)
        batches = SessionBatches(made, scene, 1)
        batches.add(16)
        return batches.estimate().mean[0].mean()

    scene = legs()
    assert mean(pass_narrow=False) < 0.95 * mean(pass_narrow=True)


@pytest.mark.extended
def test_in_fog(merged):
    """As of `volpath`: volume photons light the legs, too."""
    fog = {
        "type": "cube",
        "to_world": T().translate([0, 0, 1.4]).scale([1.45, 1.45, 1.39]),
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "albedo": 0.8, "sigma_t": 0.3},
    }
    scene = legs(fog=fog)
    agree(merged(camera_paths=2), volpath(**SETTINGS), scene, blocks=1, whole=0.02, block=0.02)


@pytest.mark.parametrize("radius, expected", [(0.0, 0.0), (0.02, 0.0), (0.4, 1.0)])
@pytest.mark.parametrize("round_one", [False, True])
def test_which_vertices_are_passed(rgb, radius, expected, round_one):
    """A leg much narrower than disks, from its front; none where disks are narrower than that."""
    from types import SimpleNamespace

    from mis_integrators.photons.coverage import Edges

    leg = {"type": "cube", "to_world": T().scale([0.03, 0.03, 1])}
    if round_one:
        leg = {"type": "cylinder", "p0": [0, 0, -1], "p1": [0, 0, 1], "radius": 0.03}
    scene = mi.load_dict({"type": "scene", "leg": leg})
    n = 64
    ray = mi.Ray3f(mi.Point3f(0, -1, dr.zeros(mi.Float, n)), mi.Vector3f(0, 1, 0))
    arrival = SimpleNamespace(
        ray=ray,
        hit=scene.ray_intersect_preliminary(ray),
        path=dr.arange(mi.UInt32, n),
        depth=dr.ones(mi.UInt32, n),
    )
    edges = Edges(dr.opaque(mi.Float, radius), dr.opaque(mi.UInt32, 7))
    coverage, passed = edges.at(scene, arrival, dr.full(mi.Bool, True, n))
    assert np.mean(np.broadcast_to(np.array(passed), n)) == pytest.approx(expected, abs=0.1)
    assert radius > 0 or np.all(np.array(coverage.share) == 1)
