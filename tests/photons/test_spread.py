"""Caustic photons with radii of their own: which they have, what they bring, and that no light is
lost."""

from mis_integrators.core.packing import pack_direction, pack_surface

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

RADIUS = 0.05
FLOOR = 1.0
"""Half the edge of a floor at z = 0."""


def photons_of(points, flux):
    """Caustic photons on the floor, straight from above: `(surface, power, count)`."""
    from mis_integrators.photons.photon import new_photons, power_layout, surface_layout

    points, flux = np.asarray(points, np.float32), np.asarray(flux, np.float32)
    surface, power = new_photons(len(points))
    index, up = dr.arange(mi.UInt32, len(points)), mi.Vector3f(0, 0, 1)
    p = mi.Point3f(points.T.copy())
    word = dr.zeros(mi.UInt32, len(points)) + pack_surface(up, mi.UInt32(2), mi.Bool(True))
    surface_layout().write(surface, {"p": p, "surface": word}, index)
    towards = dr.zeros(mi.UInt32, len(points)) + pack_direction(up)
    power_layout().write(power, {"flux": mi.Spectrum(mi.Float(flux)), "towards": towards}, index)
    return surface, power, mi.UInt32([len(points)])


def light_around(points, flux, times=1.0, quantum=1 / 16):
    from mis_integrators.photons.spread import LightAround

    around = LightAround.none(RADIUS, quantum, times, len(points))
    around.add(*photons_of(points, flux))
    return around


def layers_of(around, points, flux):
    p = mi.Point3f(np.asarray(points, np.float32).T.copy())
    return np.array(around.layer(p, mi.Float(np.asarray(flux, np.float32)), mi.Bool(True)))


def on_floor(rng, count, half=FLOOR):
    points = rng.uniform(-half, half, (count, 3))
    points[:, 2] = 0
    return points


@pytest.mark.parametrize("layer", range(5))
@pytest.mark.parametrize("times, flux", [(1, 1), (8, 1), (1, 4)])
def test_radius_by_the_light_around(rgb, layer, times, flux):
    """The cube around a point is 2 r wide and holds D (2 r)^2 photons of an even density D, which
    stand for `times` as many. A photon `flux` times as bright as these wants 16 `flux` of them: it
    is in the layer where there are twice as many as that, the last one whatever there is."""
    from mis_integrators.photons.spread import LAYERS, MOST_OF_DISK

    assert LAYERS == 5 and MOST_OF_DISK == 1 / 16
    wanted = 2 * 16 * flux / times
    step = 2 * RADIUS * 2**layer / np.sqrt(wanted)
    reach = 2 * RADIUS * 2**LAYERS
    axis = np.arange(-reach, reach, step) + 0.3 * step
    grid = np.stack([*np.meshgrid(axis, axis), np.zeros((len(axis),) * 2)], -1).reshape(-1, 3)
    found = layers_of(
        light_around(grid, np.ones(len(grid)), times),
        on_floor(np.random.default_rng(layer), 50, RADIUS),
        np.full(50, flux),
    )
    assert np.mean(found == layer) > 0.9  # cells share places


def test_single_photons_have_the_largest_radius(rgb):
    rng = np.random.default_rng(1)
    crowd = on_floor(rng, 5000, RADIUS) + [0.5, 0.5, 0]
    around = light_around(crowd, np.ones(5000))
    assert np.all(layers_of(around, crowd, np.ones(5000)) == 0)
    alone = on_floor(rng, 20, RADIUS) - [10, 10, 0]
    assert np.all(layers_of(around, alone, np.ones(20)) == 4)


def test_order_of_photons_does_not_matter(rgb):
    """Light is counted in whole numbers."""
    rng = np.random.default_rng(2)
    points, flux = on_floor(rng, 2000), rng.exponential(1, 2000)
    order = rng.permutation(2000)
    one, other = light_around(points, flux), light_around(points[order], flux[order])
    np.testing.assert_array_equal(one.cells, other.cells)
    np.testing.assert_allclose(
        np.array(one.cells).reshape(5, -1, 2)[..., 0].sum(axis=1), 16 * flux.sum(), rtol=0.01
    )


def test_layers_bring_what_brute_force_finds(rgb):
    """Sum over the photons within their own radii, of BSDF x flux over the area of their disks."""
    from mis_integrators.core.traits import SceneTraits
    from mis_integrators.photons.gather import QueryVertices
    from mis_integrators.photons.layered import LayeredMap, build_layered_map, gather_layers

    rng, n, m = np.random.default_rng(7), 3000, 700
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
            },
        }
    )
    points = np.concatenate([on_floor(rng, n // 2, 0.2), on_floor(rng, n - n // 2)])
    flux = rng.exponential(1, n)
    around = light_around(points, flux)
    layers = layers_of(around, points, flux)
    assert len(np.unique(layers)) >= 4
    surface, power, count = photons_of(points, flux)
    box = scene.bbox()
    radius = dr.opaque(mi.Float, RADIUS)
    built = build_layered_map(surface, power, count, box, radius, n, around)
    np.testing.assert_array_equal(built.count, np.bincount(layers, minlength=5))
    assert LayeredMap.has_made(built.arrays())
    queries = on_floor(rng, m)
    ray = mi.Ray3f(mi.Point3f((queries + [0, 0, 1]).T.copy()), mi.Vector3f(0, 0, -1))
    record = {
        "ray_o": ray.o,
        "ray_d": ray.d,
        "hit": scene.ray_intersect_preliminary(ray),
        "throughput": mi.Spectrum(dr.ones(mi.Float, m)),
        "depth": dr.ones(mi.UInt32, m),
        "path": dr.arange(mi.UInt32, m),
    }
    vertices = QueryVertices(SceneTraits(scene, None), record, [])
    (found,) = gather_layers(LayeredMap(built.arrays(), box, n), vertices, 10.0, -1)
    distance = np.linalg.norm(queries[:, None] - points[None], axis=-1)
    radii = RADIUS * 2.0**layers
    assert np.abs(distance / radii - 1).min() > 1e-6  # what single precision tells apart
    expected = (distance < radii) @ (flux / (np.pi * radii**2)) * 0.5 / np.pi / 10
    np.testing.assert_allclose(np.array(found)[0], expected, rtol=2e-3, atol=1e-4)


def mirror_over_floor():
    """A floor lit by a small lamp over it, and by what a mirror beside it throws: few photons."""
    transform = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": transform().scale(6)},
            "mirror": {
                "type": "rectangle",
                "to_world": transform().translate([-2, 0, 1]).rotate([0, 1, 0], 90).scale(1),
                "bsdf": {"type": "conductor"},
            },
            "lamp": {"type": "point", "position": [0, 0, 2], "intensity": 10.0},
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "to_world": transform().look_at([0, 0, 12], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 24,
                    "height": 24,
                    "rfilter": {"type": "box"},
                },
            },
        }
    )


def caustic_images(scene, spread, radius, count=96):
    """Images of the caustic by so many iterations of few photons, each alone: (count, H, W)."""
    session = mi.load_dict(
        {"type": "bdpm", "photon_count": 256, "max_depth": 3, "direct_paths": 1, "bdd": 0}
    ).session(scene, seed=4)
    session.recall(
        {
            "radii": {"caustic": radius, "indirect": radius},
            "corrected": {"caustic": False, "indirect": False},
            "light_share": 1.0,
            "caustic_spread": spread,
            "direct_light": {},
        }
    )
    images = []
    for number in range(count):
        block = session._render(number)
        images.append(np.array(block).reshape(24, 24, -1)[..., 0])
    return np.array(images), session


def test_no_light_is_lost_and_noise_falls(rgb):
    """Spread photons bring as much light, on average, as others: within 4.9 standard errors (a
    false alarm in a million). The noise of pixels is far less."""
    scene = mirror_over_floor()
    plain, session = caustic_images(scene, 0.0, 0.2)
    assert session.caustic_spread.around is None
    spread, session = caustic_images(scene, 4.0, 0.2)
    assert session.caustic_spread.around is not None
    sums = plain.sum(axis=(1, 2)), spread.sum(axis=(1, 2))
    error = np.sqrt(sum(np.var(s, ddof=1) / len(s) for s in sums))
    assert error < 0.05 * sums[0].mean()
    assert abs(sums[0].mean() - sums[1].mean()) < 4.9 * error
    assert spread.var(axis=0).mean() < 0.3 * plain.var(axis=0).mean()


def test_long_renders_spread_less(rgb):
    """Where many iterations add up, no photon needs a larger radius."""
    scene = mirror_over_floor()
    layers = []
    for iterations in (1.0, 1e6):
        session = caustic_images(scene, iterations, 0.4, 1)[1]
        maps = session._map_pass(
            session.trace_photons(0, 0), session.radii_at(0), session.caustic_spread.around
        )
        layers.append(np.array(maps["caustic"]["layer_count"]))
        if iterations > 1:
            break
    assert layers[0][0] < layers[1][0] and layers[0][1:].sum() > layers[1][1:].sum()


def test_sessions_of_a_render_spread_alike(rgb):
    """What one has learned is all that another needs; a radius that is given is every photon's."""
    scene = mirror_over_floor()
    one, other = (
        mi.load_dict({"type": "bdpm", "photon_count": 4096, "bdd": 0}).session(scene, seed=1)
        for _ in range(2)
    )
    one.start()
    assert one.learned["caustic_spread"] > 0
    other.recall(one.learned)
    np.testing.assert_array_equal(
        one.caustic_spread.around.cells, other.caustic_spread.around.cells
    )
    for session in (one, other):
        session.iterate()
    np.testing.assert_allclose(one.image(), other.image(), rtol=1e-4, atol=1e-5)
    given = mi.load_dict({"type": "bdpm", "initial_radius": 0.2}).session(scene, seed=1)
    given.start()
    given.iterate()
    assert given.caustic_spread.around is None and given.learned["caustic_spread"] == 0
