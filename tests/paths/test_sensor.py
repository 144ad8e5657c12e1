"""How points are joined with a sensor (`paths.sensor.Lens`), next to the rays that it sends."""

from mis_integrators.paths.sensor import Lens, unblocked_by_visible

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from worlds import T, look

COUNT = 4096
CROP = {"crop_offset_x": 10, "crop_offset_y": 5, "crop_width": 40, "crop_height": 20}
FILMS = {"whole": {}, "cropped": CROP}


def sensor_of(kind, film, **parameters):
    film = {"type": "hdrfilm", "width": 64, "height": 48, **FILMS[film]}
    pose = look((1, 2, 3), (0, 0.5, 0))
    return mi.load_dict(
        {"type": kind, "fov": 60.0, "to_world": pose, "film": film, "near_clip": 0.5}
        | {"far_clip": 20.0, **parameters}
    )


@pytest.mark.parametrize("film", list(FILMS))
@pytest.mark.parametrize(
    "kind, more",
    [
        ("perspective", {}),
        ("perspective", {"principal_point_offset_x": 0.25, "principal_point_offset_y": -0.1}),
        ("thinlens", {"aperture_radius": 0.2, "focus_distance": 2.0}),
    ],
    ids=["plain", "shifted", "lens"],
)
def test_points_are_joined_where_rays_come_from(rgb, kind, more, film):
    """Points along the sensor's rays lie on the film where these come from, and the density is one
    over the area across a ray at which rays through the whole film would arrive."""
    sensor = sensor_of(kind, film, **more)
    lens = Lens(sensor)
    rng = mi.PCG32(COUNT)
    place = mi.Point2f(rng.next_float32(), rng.next_float32())
    aperture = mi.Point2f(rng.next_float32(), rng.next_float32())
    ray, _ = sensor.sample_ray(0, 0.5, place, aperture)
    t = 0.1 + 8 * rng.next_float32()
    d, distance, film_place, density, valid = lens.connect(ray(t), mi.Float(0), aperture, True)
    assert np.array(valid).mean() > 0.99  # but for rounding at the border
    good = np.array(valid)
    offset = np.array(sensor.film().crop_offset())[:, None]
    size = np.array(sensor.film().crop_size())[:, None]
    expected = np.array(place) * size + offset
    np.testing.assert_allclose(np.array(film_place)[:, good], expected[:, good], atol=2e-2)
    np.testing.assert_allclose(np.array(d)[:, good], -np.array(ray.d)[:, good], atol=1e-4)
    np.testing.assert_allclose(np.array(distance)[good], np.array(t)[good], rtol=1e-3)
    # Rays through neighbouring places, of the same point of the lens: their area across the ray.
    step = 1e-2
    spread = []
    for axis in (mi.Point2f(step, 0), mi.Point2f(0, step)):
        near, far = (
            sensor.sample_ray(0, 0.5, place * 0.9 + 0.05 + sign * axis, aperture)[0]
            for sign in (-0.5, 0.5)
        )
        spread.append((near, far))
    middle, _ = sensor.sample_ray(0, 0.5, place * 0.9 + 0.05, aperture)
    p = middle(t)
    edges = []
    for near, far in spread:
        ends = [r(dr.dot(p - r.o, middle.d) / dr.dot(r.d, middle.d)) for r in (near, far)]
        edges.append((ends[1] - ends[0]) / step)
    area = np.array(dr.norm(dr.cross(*edges)))
    density = np.array(lens.density(p, mi.Float(0), aperture, True))
    np.testing.assert_allclose(density, 1 / area, rtol=5e-3)


@pytest.mark.parametrize("kind", ["perspective", "thinlens"])
def test_points_beyond_clipping_planes_are_not_joined(rgb, kind):
    more = {"aperture_radius": 0.1, "focus_distance": 3.0} if kind == "thinlens" else {}
    sensor = sensor_of(kind, "whole", **more)
    ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(0.5, 0.5), mi.Point2f(0.5, 0.5))
    depths = mi.Float([-1.0, 0.3, 0.49, 0.51, 10.0, 19.9, 20.1, 1000.0])
    p = ray.o + ray.d * (depths - 0.5)  # rays begin at the near plane
    _, _, _, density, valid = Lens(sensor).connect(p, mi.Float(0), mi.Point2f(0.5), True)
    expected = [False, False, False, True, True, True, False, False]
    assert np.array(valid).tolist() == expected
    assert (np.array(density) > 0).tolist() == expected


def test_points_far_from_the_origin_are_seen(rgb):
    """With `hide_emitters`: a look from the sensor ends where it was sent, but for rounding, which
    is 0.008 at 100 km."""
    far = 1e5
    turned = T().translate([far, 0, 0]).rotate([0, 1, 0], 90).scale(20)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": turned}})
    rng = mi.PCG32(COUNT)
    p = mi.Point3f(far, 9 * rng.next_float32(), 9 * rng.next_float32())
    towards = mi.Point3f(5.003, 0, 0) - mi.Point3f(0, p.y, p.z)
    distance = dr.norm(towards)
    integrator = mi.load_dict({"type": "bdpt", "hide_emitters": True})
    seen = unblocked_by_visible(scene, integrator, p, towards / distance, distance, mi.Bool(True))
    assert np.array(seen).mean() > 0.99
