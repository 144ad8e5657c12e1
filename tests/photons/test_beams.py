"""Volume photons and the beams that gather them: the map against brute force, records, memory, and
the pieces of a way through media."""

from mis_integrators.core.packing import pack_direction
from mis_integrators.core.sequences import SampleSequence
from mis_integrators.core.traits import SceneTraits
from mis_integrators.paths.media import fly, pass_straight
from mis_integrators.photons.beams import (
    FIRST,
    LONG,
    Beams,
    beam_layout,
    gather_along,
    mean_count_along,
)
from mis_integrators.photons.grid import longest_row, table_size
from mis_integrators.photons.volume import (
    VolumeMap,
    build_volume_map,
    new_volume_photons,
    number_of_medium,
    place_layout,
    read_place,
    write_volume_photon,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import Estimate, differences
from foggy import PLAIN, container, even, grid, pockets
from test_bdpt_media import FOG, ball, coloured, homogeneous

SIGMA = 0.7


def media():
    """Two media, which a scene keeps alive."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "a": container(homogeneous(SIGMA, 1.0)),
            "b": container(homogeneous(2.0, 1.0), at=(5, 0, 0)),
        }
    )
    by_id = {shape.id(): shape.interior_medium() for shape in scene.shapes()}
    return scene, by_id["a"], by_id["b"]


def written(points, flux, medium, depth=1, caustic=False):
    """Volume photons, NumPy (n, 3) and (n,): both records and their number."""
    count, capacity = len(points), len(points) + 3
    place, power = new_volume_photons(capacity)
    photon = {
        "p": mi.Point3f(np.float32(points).T.copy()),
        "towards": mi.Vector3f(0, 0, 1),
        "flux": mi.Spectrum(mi.Float(np.float32(flux))),
        "depth": mi.UInt32(depth),
        "caustic": mi.Bool(caustic),
        "medium": mi.MediumPtr(medium),
    }
    if count:
        write_volume_photon(place, power, dr.arange(mi.UInt32, count), photon, True)
    return place, power, mi.UInt32([count])


def photon_map(points, flux, medium, radius, depth=1, caustic=False):
    """Their map."""
    place, power, count = written(points, flux, medium, depth, caustic)
    return build_volume_map(place, power, count, mi.Float([radius]), len(points) + 3)


def beams(
    o,
    d,
    length,
    medium,
    depth=1,
    normal=(0, 0, 1),
    surface=dr.inf,
    bits=LONG | FIRST,
    behind=((0, 0, 1), dr.inf),
):
    """Beams (NumPy (m, 3), (m, 3), (m,)) in a medium, on rays that meet a surface, `behind` them
    the normal of another one and the distance to it."""
    words = beam_layout().room(len(o))
    values = {
        "o": mi.Point3f(np.float32(o).T.copy()),
        "path": dr.arange(mi.UInt32, len(o)),
        "d": mi.Vector3f(np.float32(d).T.copy()),
        "depth": mi.UInt32(depth | bits),
        "throughput": mi.Spectrum(1),
        "length": mi.Float(np.float32(length)),
        "medium": mi.MediumPtr(medium),
        "normal_behind": pack_direction(mi.Vector3f(*map(float, behind[0]))),
        "behind": mi.Float(behind[1]),
        "normal_ahead": pack_direction(mi.Vector3f(*map(float, normal))),
        "ahead": mi.Float(surface),
    }
    beam_layout().write(words, values, dr.arange(mi.UInt32, len(o)))
    return Beams.read(words, [], PLAIN)


def expected(points, flux, o, d, length, radius, sigma=SIGMA):
    """What the beams gather, by brute force: isotropic scattering."""
    offset = points[None] - o[:, None]
    along = (offset * d[:, None]).sum(-1)
    apart = np.linalg.norm(offset - along[..., None] * d[:, None], axis=-1)
    hit = (apart < radius) & (along >= 0) & (along < length[:, None])
    light = hit * flux[None] * np.exp(-sigma * along * hit) / (4 * np.pi)
    return light.sum(axis=1) / (np.pi * radius**2), hit.sum()


def directions(rng, kind, count):
    if kind == "anywhere":
        d = rng.normal(size=(count, 3))
        return d / np.linalg.norm(d, axis=1)[:, None]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return axes[rng.integers(0, 6, count)]


@pytest.mark.parametrize("kind", ["anywhere", "along an axis"])
@pytest.mark.parametrize("radius, length", [(0.3, 2.0), (0.05, np.inf), (1.5, 8.0), (0.05, 0.04)])
def test_beams_find_what_brute_force_finds(rgb, kind, radius, length):
    """Beams that begin within the photons' box and outside of it, short ones and endless ones, and
    radii from a fraction of the box to all of it."""
    rng = np.random.default_rng(int(100 * radius))
    _scene, medium, _ = media()
    points = rng.uniform(-1, 2, (3000, 3)).astype(np.float32).astype(float)
    flux = rng.uniform(0.5, 2, 3000).astype(np.float32).astype(float)
    o = rng.uniform(-4, 5, (500, 3)).astype(np.float32).astype(float)
    o[:200] = points[:200]  # the photon itself is at the edge of its beam
    o[:200] -= 0.01
    d = directions(rng, kind, 500).astype(np.float32).astype(float)
    lengths = np.where(np.arange(500) % 5 == 0, 0.5 * min(length, 4), length)
    built = photon_map(points, flux, medium, radius)
    (found,) = gather_along(
        built, beams(o, d, np.minimum(lengths, 1e18), medium), [mi.Float(radius)], 1, -1
    )
    right, hits = expected(points, flux, o, d, lengths, radius)
    assert hits > 20
    found = np.array(found)[0]
    # A photon right at the edge of a disk may be found by one and not by the other.
    close = np.abs(found - right) <= 1e-3 * right + 1e-6
    assert np.mean(close) > 0.995 and abs(found.sum() / right.sum() - 1) < 1e-3


def test_photons_of_a_flat_medium_count_once(rgb):
    """In a layer thinner than the radius, with cells of a tenth of that: rows that lie outside of
    the box have the places of others."""
    rng = np.random.default_rng(5)
    _scene, medium, _ = media()
    points = rng.uniform([0, 0, 0], [4, 0.1, 4], (20000, 3)).astype(np.float32).astype(float)
    built = photon_map(points, np.ones(20000), medium, 0.01)
    o = rng.uniform([0, -0.1, 0], [4, 0.2, 4], (300, 3)).astype(np.float32).astype(float)
    d = directions(rng, "anywhere", 300).astype(np.float32).astype(float)
    those = beams(o, d, np.full(300, 1.0), medium)
    (found,) = gather_along(built, those, [mi.Float(0.2)], 1, -1, grey=True)
    right, _ = expected(points, np.ones(20000), o, d, np.full(300, 1.0), 0.2)
    np.testing.assert_allclose(np.array(found), right, rtol=0.05, atol=1e-2 * right.mean())
    assert np.sum(found) == pytest.approx(right.sum(), rel=1e-3)


def test_several_radii_are_those_of_each(rgb):
    rng = np.random.default_rng(3)
    _scene, medium, _ = media()
    points, flux = rng.uniform(-1, 1, (2000, 3)), rng.uniform(0.5, 2, 2000)
    o, d = rng.uniform(-1, 1, (200, 3)), directions(rng, "anywhere", 200)
    length, radii = np.full(200, 1.0), [0.1, 0.2, 0.4]
    built = photon_map(points, flux, medium, radii[-1])
    those = beams(o, d, length, medium)
    together = gather_along(built, those, [mi.Float(r) for r in radii], 1, -1, grey=True)
    for radius, found in zip(radii, together):
        right, _ = expected(points, flux, o, d, length, radius)
        assert np.sum(found) == pytest.approx(right.sum(), rel=1e-3)
    right, hits = expected(points, flux, o, d, length, 0.4)
    assert mean_count_along(built, those, mi.Float(0.4), 100) == pytest.approx(hits / 100, rel=1e-3)


def test_photons_of_another_medium_do_not_count(rgb):
    _scene, first, second = media()
    points, flux = np.zeros((5, 3)), np.ones(5)
    built = photon_map(points, flux, first, 0.1)
    o, d, length = np.array([[0, 0, -1.0]]), np.array([[0, 0, 1.0]]), np.array([3.0])
    inside, outside = (
        gather_along(built, beams(o, d, length, medium), [mi.Float(0.1)], 1, -1)[0]
        for medium in (first, second)
    )
    assert np.array(inside).max() > 0 and np.array(outside).max() == 0


WALLS = {
    "behind": ([0.9, 0.1, 0.3], 0.4, [0, 0, 1.0], np.inf),
    "ahead": ([0, 0, 1.0], np.inf, [0.7, 0.0, -0.2], 0.3),
    "on one side": ([0.9, 0.1, 0.3], 0.2, [0.9, 0.0, -0.2], 0.6),
    "on both sides": ([0.9, 0.1, 0.2], 0.5, [-0.9, 0.0, -0.2], 1.2),
    "straight": ([0, 0, 1.0], 0.05, [0, 0, -1.0], 0.5),
}


@pytest.mark.parametrize("walls", WALLS)
def test_coverage_is_the_share_of_a_disk_between_walls(rgb, walls):
    """Against a million points of the disk; walls that cut the same side count once, though their
    lines differ a little."""
    _scene, medium, _ = media()
    behind, distance, ahead, surface = WALLS[walls]
    behind, ahead = (np.array(n) / np.linalg.norm(n) for n in (behind, ahead))
    o, d, length, radius = np.zeros((1, 3)), np.array([[0, 0, 1.0]]), np.array([3.0]), 0.8
    those = beams(o, d, length, medium, 1, -ahead, surface, behind=(-behind, distance))
    rng = np.random.default_rng(3)
    disk = radius * np.sqrt(rng.random(10**6)), rng.uniform(0, 2 * np.pi, 10**6)
    for along in (0.0, 0.1, 0.25):
        points = np.stack(
            [disk[0] * np.cos(disk[1]), disk[0] * np.sin(disk[1]), np.full(10**6, along)], axis=1
        )
        between = np.ones(10**6, bool)
        if np.isfinite(distance):
            between &= (points + [0, 0, distance]) @ behind > 0
        if np.isfinite(surface):
            between &= (points - [0, 0, surface]) @ ahead > 0
        found = float(those.coverage(mi.Float(along), mi.Float(radius))[0])
        slack = 0.03 if walls == "on one side" else 0.003
        assert found == pytest.approx(max(between.mean(), 0.25), abs=slack)
        counted = those.between_walls(mi.Point3f(*points.T.astype(np.float32)))
        assert np.mean(np.array(counted) == between) > 0.9999


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("height, found", [(0.05, True), (-0.05, False)])
def test_photons_behind_a_wall_do_not_count(rgb, height, found, sign):
    """A beam ends on a slanting wall; a photon beside it, less far along, lies before that wall or
    behind it. The side of the wall's normal does not matter."""
    _scene, medium, _ = media()
    normal, along_wall = np.array([0.6, 0.0, -0.8]), np.array([0.8, 0.0, 0.6])
    point = np.array([0, 0, 2.0]) - 0.3 * along_wall + height * normal
    built = photon_map(point[None], np.ones(1), medium, 0.5)
    o, d, length = np.array([[0, 0, 0.0]]), np.array([[0, 0, 1.0]]), np.array([2.0])
    those = beams(o, d, length, medium, normal=sign * normal, surface=2.0)
    (light,) = gather_along(built, those, [mi.Float(0.5)], 1, -1)
    assert mean_count_along(built, those, mi.Float(0.5), 1) == 1
    assert (np.array(light).max() > 0) == found


@pytest.mark.parametrize("max_depth, found", [(-1, True), (6, False), (7, True)])
def test_depths_add_up(rgb, max_depth, found):
    """A photon after four segments and a beam that is the third one."""
    _scene, medium, _ = media()
    built = photon_map(np.zeros((1, 3)), np.ones(1), medium, 0.1, depth=4)
    o, d, length = np.array([[0, 0, -1.0]]), np.array([[0, 0, 1.0]]), np.array([3.0])
    those = beams(o, d, length, medium, depth=3)
    (light,) = gather_along(built, those, [mi.Float(0.1)], 1, max_depth)
    assert (np.array(light).max() > 0) == found


def test_short_beams_take_caustic_photons_only(rgb):
    """Along them nothing is lost: that paths get so far has the share of light as its
    probability."""
    _scene, medium, _ = media()
    o, d, length = np.array([[0, 0, -1.0]]), np.array([[0, 0, 1.0]]), np.array([3.0])
    for caustic in (False, True):
        built = photon_map(np.zeros((1, 3)), np.ones(1), medium, 0.1, caustic=caustic)
        short, long = (
            gather_along(built, beams(o, d, length, medium, bits=bits), [mi.Float(0.1)], 1, -1)[0][
                0
            ]
            for bits in (0, LONG)
        )
        assert long[0] > 0
        assert short[0] == pytest.approx(long[0] * np.exp(SIGMA) * caustic)


def test_no_photons(rgb):
    _scene, medium, _ = media()
    place, power = new_volume_photons(8)
    built = build_volume_map(place, power, mi.UInt32([0]), mi.Float([0.1]), 8)
    o, d, length = np.array([[0, 0, -1.0]]), np.array([[0, 0, 1.0]]), np.array([3.0])
    (light,) = gather_along(built, beams(o, d, length, medium), [mi.Float(0.1)], 1, -1)
    assert np.array(light).tolist() == [[0]] * 3


def test_records_hold_what_was_written(rgb):
    """Depths saturate; media and kinds are told apart."""
    _scene, first, second = media()
    place, power = new_volume_photons(2)
    media_of = dr.select(mi.Bool([True, False]), mi.MediumPtr(first), mi.MediumPtr(second))
    photon = {
        "p": mi.Point3f([1, 2], [3, 4], [5, 6]),
        "towards": mi.Vector3f(0, 0, 1),
        "flux": mi.Spectrum(1),
        "depth": mi.UInt32([7, 100000]),
        "caustic": mi.Bool([False, True]),
        "medium": media_of,
    }
    write_volume_photon(place, power, dr.arange(mi.UInt32, 2), photon, True)
    landing = read_place(place, dr.arange(mi.UInt32, 2))
    assert np.array(landing.p).tolist() == [[1, 2], [3, 4], [5, 6]]
    assert np.array(landing.depth).tolist() == [7, 511]
    assert np.array(landing.medium == number_of_medium(media_of)).all()
    assert np.array(landing.caustic).tolist() == [False, True]


def test_ten_million_photons_fit_into_two_gibibytes(rgb):
    """Records, unsorted and sorted; the table's counts and first photons; rank and table entry of
    each photon."""
    count = 10**7
    place, power = new_volume_photons(1000)
    record = 4 * (dr.width(place) + dr.width(power)) / 1000
    assert record == 32
    size = table_size(count)
    total = 2 * record * count + 2 * 4 * (size + longest_row(size)) + 2 * 4 * count
    assert total < 2 * 2**30
    _scene, medium, _ = media()
    arrays = photon_map(np.zeros((1000, 3)), np.ones(1000), medium, 0.1).arrays()
    built = VolumeMap.with_grid(arrays, 1003)
    assert dr.width(built.place) == place_layout().words * 1003
    assert built.grid.table.size == table_size(1003)
    assert dr.width(built.start) == built.grid.table.size * 5 // 4


# --- The way through media ----------------------------------------------------

COUNT = 1 << 14


def pieces_along(scene, o, d, scattered=False):
    """What `pass_straight`, or `fly` if paths may be `scattered`, finds along a ray: the hits'
    distances, the share that gets there (weight), and the pieces `(first, last, share at first,
    path)`, those of the first channel."""
    traits = SceneTraits(scene)
    sequence = SampleSequence(mi.UInt32(5), mi.UInt32(0), 1, False)
    draws = sequence.of_paths(dr.arange(mi.UInt32, COUNT)).at(0)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, COUNT) + mi.Point3f(*o), mi.Vector3f(*d))
    room = 64 * COUNT
    store = type("Pieces", (), {})()
    store.count = dr.zeros(mi.UInt32, 1)
    store.values = dr.zeros(mi.Float, 4 * room)

    def keep(start, medium, length, kept, walls, mask):
        slot = dr.scatter_inc(store.count, mi.UInt32(0), mask)
        first = dr.dot(start.o - mi.Point3f(*o), mi.Vector3f(*d))
        path = mi.Float(dr.arange(mi.UInt32, COUNT))
        for place, value in enumerate((first, first + length, kept[0], path)):
            dr.scatter(store.values, value, 4 * slot + place, mask)

    none = dr.zeros(mi.MediumPtr, COUNT)
    if scattered:
        hit, ray, _, _, kept = fly(scene, traits, ray, none, draws, mi.Spectrum(1), True, keep=keep)
    else:
        hit, ray, _, kept = pass_straight(scene, traits, ray, none, draws, keep, True)
    dr.eval(hit, ray, kept, store.values, store.count)
    number = int(store.count[0])
    assert number < room
    end = np.array(dr.dot(ray(hit.t) - mi.Point3f(*o), mi.Vector3f(*d)))
    return end, np.array(kept), np.array(store.values).reshape(-1, 4)[:number]


def share_along(pieces, depths, sigma=0.0):
    """Mean share of light, over the paths, at each depth: what the pieces there say."""
    found = []
    for depth in depths:
        here = (pieces[:, 0] <= depth) & (depth < pieces[:, 1])
        share = pieces[here, 2] * np.exp(-sigma * (depth - pieces[here, 0]))
        values = np.bincount(pieces[here, 3].astype(int), share, minlength=COUNT)
        found.append([group.mean() for group in np.split(values, 64)])
    return Estimate.of(np.array(found).T[:, :, None])


@pytest.mark.parametrize("sigma", [0.4, 5.0])
def test_pieces_of_a_homogeneous_medium(rgb, sigma):
    """From boundary to boundary with Beer's law along them; where light is faint, by roulette with
    the same mean."""
    scene = mi.load_dict(
        {"type": "scene", "cube": container(homogeneous(sigma)), "wall": ball({"type": "diffuse"},
         0.5, center=[0, 0, -3])}
    )  # fmt: skip
    end, kept, pieces = pieces_along(scene, (0.1, 0, 4), (0, 0, -1))
    depths = np.array([3.1, 3.5, 4.0, 4.9])
    exact = Estimate.exact(np.exp(-sigma * (depths - 3))[:, None])
    found = share_along(pieces, depths, sigma)
    assert not differences(found, exact, slack=1e-3)
    assert np.sqrt(found.error2.max()) < 0.002
    law = np.exp(-2 * sigma)
    assert abs(kept[0].mean() - law) < 6 * kept[0].std() / COUNT**0.5 + 1e-3 * law
    going = kept[0] > 0
    np.testing.assert_allclose(end[going], 7 - np.sqrt(0.25 - 0.01), atol=1e-3)
    assert going.all() == (sigma < 1), "no roulette where light is strong"


@pytest.mark.parametrize("scattered", [False, True])
@pytest.mark.parametrize("density, scale", [(pockets, 2.0), (even, 4.0)])
def test_pieces_of_a_heterogeneous_medium(rgb, density, scale, scattered):
    """Their mean share is the transmittance, which is integrated in small steps; where it is faint,
    too, and where paths scatter on the way."""
    medium = grid(density, scale=scale)
    scene = mi.load_dict({"type": "scene", "cube": container(medium)})
    _, kept, pieces = pieces_along(scene, (0.1, -0.2, 3), (0, 0, -1), scattered)
    depths = np.linspace(2.05, 3.95, 9)
    fine = np.linspace(2, 4, 4001)
    middle = 0.5 * (fine[1:] + fine[:-1])
    mei = dr.zeros(mi.MediumInteraction3f, len(middle))
    mei.p = mi.Point3f(0.1, -0.2, mi.Float(3 - middle))
    mei.medium = scene.shapes()[0].interior_medium()
    _, _, sigma_t = mei.medium.get_scattering_coefficients(mei)
    thickness = np.concatenate([[0], np.cumsum(np.array(sigma_t)[0] * np.diff(fine))])
    exact = np.exp(-np.interp(depths, fine, thickness))
    found = share_along(pieces, depths)
    assert not differences(found, Estimate.exact(exact[:, None]), slack=2e-3)
    assert np.sqrt(found.error2.max()) < 0.01
    if scattered:
        return
    law = np.exp(-thickness[-1])
    assert abs(kept[0].mean() - law) < 6 * kept[0].std() / COUNT**0.5 + 2e-3 * law


def test_pieces_of_flights_in_a_coloured_medium(rgb):
    """One density serves all channels: their weights make up for it."""
    scene = mi.load_dict({"type": "scene", "cube": container(coloured())})
    _, _, pieces = pieces_along(scene, (0.1, 0, 4), (0, 0, -1), scattered=True)
    depths = np.array([3.1, 3.5, 4.0, 4.9])
    exact = Estimate.exact(np.exp(-2.5 * 0.2 * (depths - 3))[:, None])  # of the first channel
    found = share_along(pieces, depths)
    assert not differences(found, exact, slack=1e-3)
    assert np.sqrt(found.error2.max()) < 0.02


def test_boundaries_within_one_another(rgb):
    """Pieces end at each boundary."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": {**homogeneous(0.2), "id": "fog"},
            "outer": container(FOG),
            "inner": {**container(homogeneous(1.0), 0.5), "exterior": FOG},
        }
    )
    _, kept, pieces = pieces_along(scene, (0.1, 0.2, 3), (0, 0, -1))
    ends = np.unique(np.round(pieces[:, :2], 2), axis=0)
    np.testing.assert_allclose(ends, [[2, 2.5], [2.5, 3.5], [3.5, 4]], atol=0.011)
    np.testing.assert_allclose(kept, np.exp(-(0.2 + 1.0)), rtol=1e-3)
