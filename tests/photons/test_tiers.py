"""Caustic photons with radii of their own: which they have, what they bring, and that no light is
lost."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import pictures
from gathering import photons_of, vertices_at
from pilots import learned

RADIUS, TIERS = 0.05, 7
FLOOR = 1.0
"""Half the edge of a floor at z = 0."""


def light_around(points, flux, times=1.0, quantum=1 / 16, largest=math.inf):
    from mis_integrators.photons.light_around import LightAround

    around = LightAround.empty(RADIUS, quantum, times, len(points), largest)
    p = mi.Point3f(np.asarray(points, np.float32).T.copy())
    around.cells.add(p, mi.Float(np.asarray(flux, np.float32)), mi.Bool(True))
    return around


def tiers_of(around, points, flux, radius=RADIUS):
    p = mi.Point3f(np.asarray(points, np.float32).T.copy())
    flux, radius = mi.Float(np.asarray(flux, np.float32)), dr.opaque(mi.Float, radius)
    return np.array(around.tier(p, flux, radius, mi.Bool(True)))


def counts(tiered):
    """How many photons each tier has."""
    return np.array(tiered.tier(dr.arange(mi.UInt32, TIERS))[2])


def on_floor(rng, count, half=FLOOR):
    points = rng.uniform(-half, half, (count, 3))
    points[:, 2] = 0
    return points


@pytest.mark.parametrize("tier", range(TIERS))
@pytest.mark.parametrize("times, flux", [(1, 1), (8, 1), (1, 4)])
def test_radius_by_the_light_around(rgb, tier, times, flux):
    """The cube around a point is 2 r wide and holds D (2 r)^2 photons of an even density D, which
    stand for `times` as many. A photon `flux` times as bright as these wants 64 `flux` of them: it
    is in the tier where there are twice as many as that, the last one whatever there is."""
    from mis_integrators.photons import light_around as module

    assert module.TIERS == TIERS and module.MOST_OF_LIGHT == 1 / 64
    wanted = 2 * 64 * flux / times
    step = 2 * RADIUS * 2**tier / np.sqrt(wanted)
    reach = 4 * RADIUS * 2**tier
    axis = np.arange(-reach, reach, step) + 0.3 * step
    grid = np.stack([*np.meshgrid(axis, axis), np.zeros((len(axis),) * 2)], -1).reshape(-1, 3)
    found = tiers_of(
        light_around(grid, np.ones(len(grid)), times),
        on_floor(np.random.default_rng(tier), 50, RADIUS),
        np.full(50, flux),
    )
    assert np.mean(found == tier) > 0.9  # cells share places


def test_single_photons_have_the_largest_radius(rgb):
    rng = np.random.default_rng(1)
    crowd = on_floor(rng, 5000, RADIUS) + [0.5, 0.5, 0]
    around = light_around(crowd, np.ones(5000))
    assert np.all(tiers_of(around, crowd, np.ones(5000)) == 0)
    alone = on_floor(rng, 20, RADIUS) - [10, 10, 0]
    assert np.all(tiers_of(around, alone, np.ones(20)) == TIERS - 1)


@pytest.mark.parametrize(
    "largest, last", [(0.5, 0), (1, 0), (1.9, 0), (2, 1), (5, 2), (63, 5), (1e9, 6)]
)
def test_no_radius_is_larger_than_the_largest(rgb, largest, last):
    """But the first, which is all photons'. `largest` is in units of it."""
    around = light_around(np.zeros((1, 3)), [1.0], largest=largest * RADIUS)
    assert np.all(tiers_of(around, np.full((3, 3), 50.0), np.ones(3)) == last)


def test_order_of_photons_does_not_matter(rgb):
    """Light is counted in whole numbers."""
    rng = np.random.default_rng(2)
    points, flux = on_floor(rng, 2000), rng.exponential(1, 2000)
    order = rng.permutation(2000)
    one, other = light_around(points, flux), light_around(points[order], flux[order])
    np.testing.assert_array_equal(one.cells.words, other.cells.words)
    np.testing.assert_allclose(
        np.array(one.cells.words).reshape(TIERS - 1, -1, 2)[..., 0].sum(axis=1),
        np.maximum(16 * flux, 1).sum(),
        rtol=0.01,
    )


@pytest.mark.parametrize("left, lobe_width", [(0, 1), (1, 1), (0, 0.3)])
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)], ids="zy")
def test_tiers_bring_what_brute_force_finds(rgb, up, left, lobe_width):
    """Sum over the photons within their own radii, of BSDF x flux over the area of their disks.
    Where photons of a few tiers are `left` to a denoiser, these are all in the first, and each
    vertex has its own radius there. Disks are smaller where lobes are narrow. The scene is a floor:
    flat along one axis or another, where wide disks reach beyond the grid."""
    from mis_integrators.photons.tiers import TieredMap, build_tiered_map, gather_tiers

    rng, n, m = np.random.default_rng(7), 3000, 700
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90 * up[1]),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
            },
        }
    )
    axes = [0, 1, 2] if up[2] else [0, 2, 1]
    points = np.concatenate([on_floor(rng, n // 2, 0.2), on_floor(rng, n - n // 2)])[:, axes]
    flux = rng.exponential(1, n)
    around = light_around(points, flux)
    tiers = tiers_of(around, points, flux)
    assert len(np.unique(tiers)) >= 4
    tiers[tiers <= left] = 0
    surface, power, count = photons_of(points, flux, up)
    box = mi.ScalarBoundingBox3f(
        *(mi.ScalarPoint3f(edge) for edge in (points.min(0), points.max(0)))
    )
    radius = dr.opaque(mi.Float, RADIUS)
    built = build_tiered_map(surface, power, count, box, radius, n, around, left)
    np.testing.assert_array_equal(counts(built), np.bincount(tiers, minlength=TIERS))
    assert TieredMap.has_made(built.arrays())
    queries = on_floor(rng, m)[:, axes]
    ray = mi.Ray3f(mi.Point3f((queries + up).T.copy()), -mi.Vector3f(*up))
    vertices = vertices_at(scene, ray, m)
    first = RADIUS * rng.uniform(0.3, 6, m) if left else np.full(m, RADIUS)
    tiered = TieredMap(built.arrays(), box, n)
    vertices.lobe_width = lobe_width
    (found,) = gather_tiers(tiered, vertices, mi.Float(first), 10.0, -1)
    distance = np.linalg.norm(queries[:, None] - points[None], axis=-1)
    least = np.float32(first)[:, None]
    radii = np.where(tiers == 0, least, np.maximum(lobe_width * RADIUS * 2.0**tiers, least))
    assert np.abs(distance / radii - 1).min() > 1e-6  # what single precision tells apart
    lit = (distance < radii) * flux / (np.pi * radii**2)
    expected = lit.sum(axis=1) * 0.5 / np.pi / 10
    np.testing.assert_allclose(np.array(found)[0], expected, rtol=2e-3, atol=1e-4)


def test_smaller_disks_hold_less_light(rgb):
    """Where the area of progressive disks has shrunk to 2 / 5, photons want 5 / 2 of the light."""
    rng = np.random.default_rng(4)
    points = on_floor(rng, 16000)
    around = light_around(points, np.ones(16000))
    inside = on_floor(rng, 200, 0.5)
    of_bright = tiers_of(around, inside, np.full(200, 2.5))
    shrunk = tiers_of(around, inside, np.ones(200), RADIUS * 0.4**0.5)
    assert len(np.unique(of_bright)) > 1 and np.any(of_bright != tiers_of(around, inside, [1.0]))
    assert np.mean(shrunk == of_bright) > 0.9  # where the light is just enough, rounding decides


def mirror_beside_floor(floor="diffuse"):
    """A floor with a box on it, lit by a lamp and by what a mirror throws: few photons."""
    transform = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": transform().scale(6),
                "bsdf": {"type": floor},
            },
            "box": {"type": "cube", "to_world": transform().translate([2, 0, 0]).scale(0.4)},
            "mirror": {
                "type": "rectangle",
                "to_world": transform().translate([-2, 0, 1]).rotate([0, 1, 0], 90),
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


def session_of(scene, iterations, radius, plugin="bdpm", **parameters):
    """A session of few photons whose caustic ones have radii for a render of so many iterations;
    its image has the caustic as a layer."""
    session = mi.load_dict(
        {
            "type": plugin,
            "photon_count": 1024,
            "aovs": "caustic:caustic",
            "direct_paths": 1,
            **({"bdd": 0, "max_depth": 3} if plugin == "bdpm" else {}),
            **parameters,
        }
    ).session(scene, seed=4)
    session.recall(learned(session, radius, iterations))
    return session


def caustics(session, count):
    """The caustic in so many iterations, each alone: (count, H, W)."""
    return np.array([picture[..., -3] for picture in pictures(session, count)])


def test_no_light_is_lost_and_noise_falls(rgb):
    """Photons with larger radii bring as much light, on average: within 4.9 standard errors (a
    false alarm in a million), which are 2 % of it; and a twentieth may be lost at the edges of the
    box. The noise of pixels is far less."""
    scene = mirror_beside_floor()
    plain, wide = session_of(scene, 0.0, 0.2), session_of(scene, 4.0, 0.2)
    assert plain.caustic_radii.find() is None and wide.caustic_radii.find() is not None
    plain, wide = caustics(plain, 192), caustics(wide, 192)
    sums = plain.sum(axis=(1, 2)), wide.sum(axis=(1, 2))
    error = np.sqrt(sum(np.var(s, ddof=1) / len(s) for s in sums))
    mean = sums[0].mean()
    assert error < 0.02 * mean
    assert abs(mean - sums[1].mean()) < 4.9 * error + 0.05 * mean
    assert wide.var(axis=0).mean() < 0.3 * plain.var(axis=0).mean()


def tiers_in(session):
    """How many photons of an iteration are in each tier."""
    maps = session._map_pass(
        session.trace_photons(0, 0), session.radii_at(0), session.caustic_radii.find(), None
    )
    photon_map = session._map_again(maps["caustic"], "caustic", session.radii_at(0)["caustic"])
    return counts(photon_map)


def test_long_renders_have_smaller_radii(rgb):
    """Where many iterations add up, few photons need a larger radius."""
    scene = mirror_beside_floor()
    short, long = (tiers_in(session_of(scene, n, 0.4)) for n in (1.0, 1e6))
    assert short.sum() == long.sum() > 0
    assert short[0] < 0.1 * short.sum() and long[0] > 0.8 * long.sum()


def test_sessions_of_a_render_have_the_same_radii(rgb):
    """What one has learned is all that another needs, also where its photons need more room than
    was thought. A radius that is given is every photon's."""
    scene = mirror_beside_floor()
    one, other = (
        mi.load_dict({"type": "bdpm", "photon_count": 4096, "bdd": 0}).session(scene, seed=1)
        for _ in range(2)
    )
    one.start()
    assert one.learned["caustic_radii"]["iterations"] > 0
    other.recall(one.learned)
    other.photon_capacity = 64
    other._freeze()
    for session in (one, other):
        session.iterate()
    np.testing.assert_array_equal(*(each.caustic_radii.find().cells.words for each in (one, other)))
    np.testing.assert_allclose(one.image(), other.image(), rtol=1e-4, atol=1e-5)
    given = mi.load_dict({"type": "bdpm", "initial_radius": 0.2}).session(scene, seed=1)
    given.start()
    given.iterate()
    assert given.caustic_radii.find() is None
    assert given.learned["caustic_radii"] == {"iterations": 0}


def test_radii_for_scenes_that_have_no_caustics_are_refused(rgb):
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle"},
            "lamp": {"type": "point", "position": [0, 0, 2]},
            "sensor": {"type": "perspective"},
        }
    )
    with pytest.raises(Exception, match="iterations"):
        session_of(scene, 4.0, 0.2, max_depth=-1)


@pytest.mark.parametrize("plugin", ["bdpm_balance", "bdpm_opt2"])
def test_weights_stay_consistent(rgb, plugin):
    """Weighted plugins merge the same caustic photons: as much light as without larger radii,
    within 4.9 standard errors, and a twentieth lost at edges."""
    scene = mirror_beside_floor("roughplastic")
    sums = []
    for iterations in (0.0, 4.0):
        session = session_of(scene, iterations, 0.2, plugin)
        sums.append(caustics(session, 96).sum(axis=(1, 2)))
    error = np.sqrt(sum(np.var(s, ddof=1) / len(s) for s in sums))
    mean = sums[0].mean()
    assert error < 0.05 * mean
    assert abs(mean - sums[1].mean()) < 4.9 * error + 0.05 * mean
