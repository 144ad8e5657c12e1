"""Merge disks on curved surfaces."""

import mitsuba as mi
import numpy as np
import pytest
from test_bdpm import glossy_box
from worlds import T, diffuse, film, grey, look


@pytest.fixture(autouse=True)
def _rgb(rgb):
    pass


@pytest.mark.parametrize(
    "shape, radius",
    [
        ({"type": "sphere", "radius": 0.5}, 0.5),
        ({"type": "cylinder", "radius": 0.3, "p0": [0, -1, 0], "p1": [0, 1, 0]}, 0.3),
        ({"type": "rectangle"}, np.inf),
        ({"type": "cube"}, np.inf),
    ],
)
def test_disks_are_no_wider_than_surfaces_are_bent(shape, radius):
    from mis_integrators.photons.curvature import LEAST_LEFT, bounded, most_bent
    from mis_integrators.photons.gather import FLAGS

    scene = mi.load_dict({"type": "scene", "shape": shape})
    ray = mi.Ray3f(mi.Point3f(0.05, 0.1, 5), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect_preliminary(ray).compute_surface_interaction(ray, FLAGS)
    for wide in (0.01, 0.3, 1.0, 20.0):
        found = float(bounded(si, mi.Float(wide))[0])
        assert found == pytest.approx(
            min(wide, max(most_bent() * radius, LEAST_LEFT * wide)), rel=1e-4
        )


def test_small_balls_are_as_bright_as_they_should_be():
    """Indirect light on a ball that is no wider than the merge disks, against `path`: within 14 %
    of the mean over its pixels. (Disks of one radius lack 79 %, those bounded 10 %.) The standard
    error is below 0.6 %: false alarms below 1e-6."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "room": {
                "type": "cube",
                "flip_normals": True,
                "bsdf": diffuse(0.7),
            },
            "ball": {"type": "sphere", "radius": 0.25, "bsdf": diffuse(0.6)},
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([0, 0.98, 0]).rotate([1, 0, 0], 90).scale(0.4),
                "emitter": {"type": "area", "radiance": grey(5.0)},
            },
            "sensor": {
                "type": "perspective",
                "fov": 12,
                "to_world": look((0, -0.2, 0.98), (0, 0, 0), (0, 1, 0)),
                "film": film(16),
            },
        }
    )

    def mean(image):
        return np.array(image)[4:12, 4:12, :3].mean()

    def path(max_depth):
        integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        return mean(mi.render(scene, integrator=integrator, spp=1 << 14))

    session = mi.load_dict(
        {"type": "bdpm", "bdd": 0, "max_depth": 6, "photon_count": 20000}
    ).session(scene, seed=1, spp=64)
    session.radii = {"indirect": 0.4}
    for _ in range(64):
        session.iterate()
    direct = path(2)
    assert mean(session.image()) - direct == pytest.approx(path(6) - direct, rel=0.14)


@pytest.mark.parametrize(
    "weighted",
    [
        {"type": "bdpm_opt", "weights": "published", "strategies": 2},
        {"type": "bdpm_opt2"},
        {"type": "bdpm_balance"},
    ],
)
def test_under_weights_all_disks_are_as_wide(weighted):
    """Weights know one radius. So it is, too, where `bdpm` is given one."""
    scene = glossy_box()
    for integrator, bounds in (
        (weighted, False),
        ({"type": "bdpm"}, True),
        ({"type": "bdpm", "initial_radius": 0.1}, False),
    ):
        session = mi.load_dict(integrator).session(scene, seed=1, spp=1)
        assert session._bounds_disks == bounds
