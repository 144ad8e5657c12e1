"""Volume photons with radii of their own: which they have, what they bring, that no light is lost,
and that the light beside a lamp is no longer blurred."""

import math

from mis_integrators.photons.beams import gather_along
from mis_integrators.photons.volume import (
    LEAST_SHARE,
    build_volume_map,
    place_layout,
    read_place,
    with_share,
)
from mis_integrators.photons.volume_radii import VolumeDensity, weighted_median

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import Estimate, assert_same, block_means, collect_until
from foggy import view
from pilots import learned
from selection import extended
from test_bdpm_media import SmallRadiusBatches
from test_bdpt_media import FOG, POINT, homogeneous, single_scattering
from test_beams import beams, media, written
from worlds import look

CUBE = 1.0
"""Edge of the widest cells."""


def density_of(points, flux=None):
    _scene, medium, _ = media()
    flux = np.ones(len(points)) if flux is None else flux
    place, power, count = written(points, flux, medium)
    return VolumeDensity.of(place, power, count, CUBE)


def shares(density, points, flux=1.0):
    p = mi.Point3f(np.float32(points).T.copy())
    flux = mi.Float(np.float32(np.broadcast_to(flux, len(points))))
    return np.array(density.share(p, flux, mi.Bool(True)))


def cloud(rng, count, width, at):
    return rng.uniform(-width / 2, width / 2, (count, 3)) + np.asarray(at)


def two_clouds(rng, count=20000):
    """Most photons in one cloud, and a tenth of them in a cube a quarter as wide: there they lie
    6.4 times as densely."""
    return cloud(rng, count, 4.0, (5, 0, 0)), cloud(rng, count // 10, 1.0, (-5, 0, 0))


def test_radii_by_the_square_root_law(rgb):
    """The median photon is in the wide cloud. Photons in the other one are 6.4 times as dense.
    (Cells that reach over a cloud's border hold fewer.)"""
    rng = np.random.default_rng(1)
    wide, dense = two_clouds(rng)
    density = density_of(np.concatenate([wide, dense]))
    inside = np.abs(wide - (5, 0, 0)).max(axis=1) < 1
    assert np.median(shares(density, wide[inside])) == pytest.approx(1, abs=0.1)
    within = np.abs(dense + (5, 0, 0)).max(axis=1) < 0.3
    assert np.median(shares(density, dense[within])) == pytest.approx(6.4**-0.5, rel=0.2)
    assert np.all(shares(density, cloud(rng, 30, 1.0, (0, 20, 0))) == 1)  # where there are none
    crowd = cloud(rng, 10000, 1e-3, (0, 0, 9))
    assert np.allclose(
        shares(density_of(np.concatenate([wide, crowd])), crowd), LEAST_SHARE, rtol=1e-3
    )


def test_density_is_light_over_the_photons_own(rgb):
    """A photon four times as bright as those around it has a radius twice as large; how bright all
    are does not matter."""
    rng = np.random.default_rng(2)
    wide, dense = two_clouds(rng, 40000)
    points, inner = np.concatenate([wide, dense]), dense[:200] * 0.5 + (-2.5, 0, 0)
    for scale in (1e-6, 1.0, 1e6):
        density = density_of(points, np.full(len(points), scale))
        one, four = (np.median(shares(density, inner, scale * flux)) for flux in (1.0, 4.0))
        assert four == pytest.approx(2 * one, rel=0.15)


def test_order_of_photons_does_not_matter(rgb):
    rng = np.random.default_rng(3)
    points, flux = np.concatenate(two_clouds(rng, 3000)), rng.exponential(1, 3300)
    order = rng.permutation(len(points))
    one, other = density_of(points, flux), density_of(points[order], flux[order])
    np.testing.assert_array_equal(one.cells.words, other.cells.words)
    assert np.array(one.median) == pytest.approx(np.array(other.median), rel=1e-6)


def test_no_photons(rgb):
    density = density_of(np.zeros((0, 3)))
    assert np.all(np.isfinite(shares(density, np.zeros((2, 3)))))


def test_weighted_median():
    assert weighted_median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 1.0])) == 2
    assert weighted_median(np.array([3.0, 1.0, 2.0]), np.array([5.0, 1.0, 1.0])) == 3
    assert weighted_median(np.array([3.0, 1.0]), np.array([0.0, 0.0])) == 0
    assert weighted_median(np.array([]), np.array([])) == 0


def test_words_hold_shares(rgb):
    """To an eighth of an octave, from the least to one; the other fields stay."""
    share = np.geomspace(LEAST_SHARE, 1, 50).astype(np.float32)
    _scene, medium, _ = media()
    place, _, _ = written(np.zeros((50, 3)), np.ones(50), medium, depth=511, caustic=True)
    before = place_layout().read(place, dr.arange(mi.UInt32, 50))
    record = {**before, "word": with_share(before["word"], mi.Float(share))}
    place_layout().write(place, record, dr.arange(mi.UInt32, 50))
    landing = read_place(place, dr.arange(mi.UInt32, 50))
    assert np.all(np.abs(np.log2(np.array(landing.share) / share)) <= 1 / 8 + 1e-3)
    assert np.all(np.array(landing.depth) == 511) and np.all(np.array(landing.caustic))
    number = np.array(landing.medium)
    assert np.all(number == number[0]) and number[0] > 0


@pytest.mark.parametrize("radii", [(0.2, 0.4), (0.02, 0.04)])
def test_beams_find_what_brute_force_finds(rgb, radii):
    """Each photon's flux over the area of its own disk, at two radii; small ones, too, for which
    cells of two radii would be empty: there each has a photon in the median."""
    rng = np.random.default_rng(4)
    _scene, medium, _ = media()
    points = np.concatenate([cloud(rng, 4000, 2.0, (0, 0, 0)), cloud(rng, 2000, 0.2, (0, 0, 0))])
    points, flux = np.float32(points).astype(float), np.ones(len(points))
    density = density_of(points)
    place, power, count = written(points, flux, medium)
    built = build_volume_map(
        place, power, count, mi.Float([radii[1]]), place_layout().capacity(place), density=density
    )
    cell = max(2 * radii[1], float(density.median[0]) ** (-1 / 3))
    assert built.grid.cell[0] == pytest.approx(cell, rel=1e-4)
    assert (cell > 2 * radii[1]) == (radii[1] < 0.05)
    landing = read_place(built.place, dr.arange(mi.UInt32, len(points)))
    share, p = np.array(landing.share), np.array(landing.p).T.astype(float)
    assert share.min() < 0.3 and share.max() == 1
    o = np.float32(rng.uniform(-1, 1, (300, 3))).astype(float)
    d = rng.normal(size=(300, 3))
    d = np.float32(d / np.linalg.norm(d, axis=1)[:, None]).astype(float)
    length = np.full(300, 1.5)
    those = beams(o, d, length, medium)
    found = gather_along(built, those, [mi.Float(r) for r in radii], 1, -1, grey=True)
    offset = p[None] - o[:, None]
    along = (offset * d[:, None]).sum(-1)
    apart = np.linalg.norm(offset - along[..., None] * d[:, None], axis=-1)
    for radius, light in zip(radii, found):
        own = radius * share
        hit = (apart < own) & (along >= 0) & (along < 1.5)
        right = (hit * np.exp(-0.7 * along * hit) / (4 * np.pi) / (np.pi * own**2)).sum(axis=1)
        assert np.mean(np.abs(np.array(light) - right) <= 1e-3 * right + 1e-6) > 0.97
        assert np.sum(light) == pytest.approx(right.sum(), rel=2e-3)


# --- Sessions -----------------------------------------------------------------


def lamp_in_fog(size=32, distance=2.0, half_width=0.5):
    """A point light within sight, in fog that fills a large ball."""
    return mi.load_dict(
        {
            "type": "scene",
            "fog": {**homogeneous(0.7, 0.9), "id": "fog"},
            "ball": {"type": "sphere", "radius": 6.0, "bsdf": {"type": "null"}, "interior": FOG},
            "light": {"type": "point", "position": list(POINT), "intensity": 1.0},
            "sensor": {
                **view(
                    (0, 0, distance),
                    size=size,
                    fov=np.degrees(2 * np.arctan(half_width / distance)),
                ),
                "to_world": look((0, 0, distance), (0, 0, 0), (0, 1, 0)),
                "medium": FOG,
                "near_clip": 0.5,
            },
        }
    )


def session_of(scene, radius, uniform=False, **parameters):
    """A session that merges as one with an automatic radius, of this value."""
    defaults = {"bdd": 0, "max_depth": 2, "photon_count": 60000, "direct_paths": 1}
    session = mi.load_dict({"type": "bdpm", **defaults, **parameters}).session(scene, seed=1, spp=0)
    session.narrows_volume = not uniform
    session.recall(learned(session, radius))
    return session


class Extrapolated(SmallRadiusBatches):
    """The same with radii of the photons' own."""

    def session(self, scene, radius, parameters):
        return session_of(scene, radius, **parameters)


@pytest.mark.long
@pytest.mark.parametrize("bdd", [0, *extended(1)])
def test_single_scattering_in_closed_form(rgb, bdd):
    """Radii differ by thirty times, and the light is right. (False-alarm rate 1e-6; errors of 3 %
    and 8 % are seen, as all pixels share the photons close to the sensor.)"""
    scene = lamp_in_fog(16)
    picture = single_scattering(0.7, 0.9, 0.0, POINT, 16, 0.5, 2.0)
    exact = Estimate.exact(np.repeat(block_means(picture[:, :, None], 2), 3, axis=1))
    batches = Extrapolated(scene, 2, 0.06, bdd=bdd, camera_paths=16)
    batches.add(2)
    assert_same(*collect_until(batches, exact, 0.03, 0.08), 0.03, 0.08, slack=2e-3)


def squared_error(session, exact, iterations):
    for _ in range(iterations):
        session.iterate()
    return np.mean((session.image()[:, :, 0] - exact) ** 2)


def test_light_beside_a_lamp_is_sharp(rgb):
    """The lamp is in the middle of the image: around it light grows as one over the distance from
    the pixel. With the same photons and radius, the squared error is less than a tenth of that
    with one radius for all (a thirtieth was seen)."""
    half_width, distance, at = 0.5, 2.0, (0.05, 0.02, 0.0)
    scene = lamp_in_fog()
    params = mi.traverse(scene)
    params["light.position"] = mi.Point3f(at)
    params.update()
    exact = single_scattering(0.7, 0.9, 0.0, at, 32, half_width, distance)
    errors = [
        squared_error(session_of(scene, 0.08, uniform), exact, 16) for uniform in (False, True)
    ]
    assert errors[0] < 0.1 * errors[1]


def test_sessions_of_a_render_have_the_same_radii(rgb):
    """What one has learned is all that another needs. A radius that is given is every photon's."""
    scene = lamp_in_fog(8)
    one, other = (
        mi.load_dict({"type": "bdpm", "photon_count": 20000, "bdd": 0}).session(scene, seed=1)
        for _ in range(2)
    )
    one.start()
    other.recall(one.learned)
    for session in (one, other):
        session.iterate()
    densities = [session.volume_density() for session in (one, other)]
    np.testing.assert_array_equal(*(density.cells.words for density in densities))
    assert densities[0].median[0] == densities[1].median[0] > 0
    np.testing.assert_allclose(one.image(), other.image(), rtol=1e-4, atol=1e-5)
    given = mi.load_dict({"type": "bdpm", "initial_radius": 0.2}).session(scene, seed=1)
    given.start()
    assert given.volume_density() is None
    balance = mi.load_dict({"type": "bdpm_balance"}).session(scene, seed=1)
    assert balance.volume_density() is None  # weights know one radius


def test_scenes_without_shapes(rgb):
    """Which have no extent to scale cells by."""
    fog = {**homogeneous(0.7, 0.9), "id": "fog"}
    light = {"type": "point", "position": list(POINT)}
    sensor = {**view((0, 0, 2.0), size=8), "medium": FOG}
    scene = mi.load_dict({"type": "scene", "fog": fog, "light": light, "sensor": sensor})
    session = mi.load_dict({"type": "bdpm", "bdd": 0, "photon_count": 2000}).session(scene, seed=1)
    session.iterate()
    assert np.all(np.isfinite(session.image())) and math.isfinite(session.radii["volume"])
