"""Walls in merge disks: which are known, which photons they hide, and rooms without leaks of
light."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import agree
from gathering import photons_of, vertices_at
from pilots import as_chosen, learned
from worlds import T, diffuse, film, look, path

SETTINGS = {"max_depth": 5, "rr_depth": 50}
OUTSIDE, RADIUS = 100.0, 0.15


def room(**objects):
    """A dim room on a bright plain: its walls and ceiling stand on the floor that goes on outside,
    as far as those go on beyond its corners."""
    places = {
        "left": T().translate([-0.5, 0, 0.5]).rotate([0, 1, 0], 90),
        "right": T().translate([0.5, 0, 0.5]).rotate([0, 1, 0], -90),
        "back": T().translate([0, 0.5, 0.5]).rotate([1, 0, 0], 90),
        "front": T().translate([0, -0.5, 0.5]).rotate([1, 0, 0], -90),
        "ceiling": T().translate([0, 0, 1]).rotate([1, 0, 0], 180),
        "floor": T(),
    }
    grey = {"type": "twosided", "bsdf": diffuse(0.7)}
    walls = {
        name: {"type": "rectangle", "to_world": place, "bsdf": grey}
        for name, place in places.items()
    }
    return mi.load_dict(
        {
            "type": "scene",
            **walls,
            "lamp": {
                "type": "sphere",
                "center": [0.1, 0, 0.6],
                "radius": 0.1,
                "emitter": {"type": "area", "radiance": 3.0},
            },
            "sun": {"type": "point", "position": [0, 0, 4], "intensity": OUTSIDE},
            "sensor": {
                "type": "perspective",
                "fov": 80,
                "to_world": look((0, -0.45, 0.6), (0, 0.5, 0.3), (0, 0, 1)),
                "film": film(32),
            },
            **objects,
        }
    )


@pytest.fixture
def merged(rgb, monkeypatch):
    return as_chosen(monkeypatch, RADIUS, **SETTINGS)


@pytest.mark.parametrize("denoised", [False, True])
def test_no_light_leaks_into_a_room(merged, denoised):
    """As bright as of `path`, all of it within 3 %, in images that will be denoised, too, whose
    camera paths pass no edges. (With the photons of outside a fifth too bright.)"""
    whole = 0.015 if not denoised else 0.03
    agree(merged(denoised=denoised), path(**SETTINGS), room(), blocks=1, whole=whole, block=whole)


def test_it_leaks_without_walls(merged, monkeypatch):
    """The test above is no test else."""
    from mis_integrators.integrators.bdpm import BDPMSession

    def mean(leaves_out):
        monkeypatch.setattr(BDPMSession, "leaves_out_hidden", leaves_out)
        session = merged(camera_paths=2).session(room(), seed=1)
        for _ in range(16):
            session.iterate()
        return np.mean(session.image())

    assert mean(False) > 1.1 * mean(True)


def gathered_by_pilot(radii, leaves_out_hidden=False, at_first_vertex=True, coverage=None):
    """What the first iteration of a pilot gathers, a mean for each radius. `coverage`: in place of
    `PhotonPasses._coverage`."""
    from mis_integrators.pilot.setting import pilot_pixels

    session = mi.load_dict({"type": "bdpm", "bdd": 0, **SETTINGS}).session(room(), seed=1)
    session.leaves_out_hidden = leaves_out_hidden
    setting = session.pilot_setting()
    pixels = pilot_pixels(setting)
    passes = session.pilot_passes(
        dataclasses.replace(setting, at_first_vertex=at_first_vertex), pixels
    )
    if coverage is not None:
        passes._coverage = coverage
    gathered, _ = passes.trace(0).gather({"indirect": np.array(radii)})
    return gathered["indirect"].mean(axis=(1, 2))


def test_pilots_correct_each_radius(rgb):
    """What a pilot gathers is corrected by the share of the very disk: more for larger ones."""
    radii = [0.01, 0.05, 0.2]
    ratio = gathered_by_pilot(radii) / gathered_by_pilot(radii, at_first_vertex=False)
    assert 1 <= ratio[0] < 1.1 and np.all(ratio[1:] > 1.1 * ratio[:-1]), ratio


def test_what_is_seen_behind_walls_counts(rgb):
    """Half of all disks are behind a wall that is not there: next to nothing is hidden from places
    above their centres."""

    def halves(scene, tables, vertices, radius, seed):
        towards = {"near": mi.Vector3f(1000, 0, 0), "far": mi.Vector3f(0)}
        return mi.Float(1), {**towards, "height": 0.2 * radius}

    radii = [0.02, 0.04]
    all_of_it = gathered_by_pilot(radii, at_first_vertex=False)
    assert gathered_by_pilot(radii, True, coverage=halves) == pytest.approx(all_of_it, rel=0.05)


def vectors(rows):
    return mi.Vector3f(*np.array(rows, dtype=np.float32).T)


def test_the_two_nearest_walls_that_do_not_face_alike(rgb):
    """Among walls at distances 0.5 and 0.2 on the right, 0.3 behind and 0.1 on the left, in all
    orders."""
    from types import SimpleNamespace

    from mis_integrators.photons.disk_walls import DiskWalls, with_wall

    met = [((0.5, 0, 0), (1, 0, 0)), ((0.2, 0, 0), (1, 0, 0)), ((0, 0.3, 0), (0, 1, 0))]
    met.append(((-0.1, 0, 0), (1, 0, 0)))
    rng = np.random.default_rng(2)
    for _ in range(8):
        near, far = mi.Vector3f(0), mi.Vector3f(0)
        for at in rng.permutation(len(met)):
            p, n = met[at]
            hit = SimpleNamespace(p=mi.Point3f(*p), n=mi.Normal3f(*n))
            near, far = with_wall(
                near, far, mi.Point3f(0), hit, mi.Point3f(0, 0, 0.01), mi.Float(1), mi.Bool(True)
            )
        walls = DiskWalls(near, far, mi.Float(0.01))
        places = vectors([(-0.15, 0, 0), (0.25, 0, 0), (0.15, 0.35, 0), (-0.05, 0.1, 0)])
        assert list(np.array(walls.behind(places))) == [True, True, False, False]


def seen_by_many(photons, reflectance, n=4096, below=0.0, wall=1000.0):
    """What `gather_seen` finds at n vertices at the origin of a floor of this reflectance, from
    photons (x, y, flux) that are all behind a wall, in units of what one of flux one brings to a
    white floor: (3, n). A screen hides those at negative y. `below`: how far below the floor they
    lie; `wall`: one over its distance."""
    from mis_integrators.photons.disk_walls import DiskWalls
    from mis_integrators.photons.gather import gather_photons, gather_seen
    from mis_integrators.photons.grid import build_photon_map

    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    place = T().translate([0.05, -1, 0]).rotate([0, 1, 0], 90)
    screen = {"type": "rectangle", "to_world": place}
    scene = mi.load_dict({"type": "scene", "floor": floor, "screen": screen})
    places, flux = [(x, y, -below) for x, y, _ in photons], [flux for *_, flux in photons]
    made = photons_of(places, flux, caustic=False)
    radius = dr.opaque(mi.Float, 0.2)
    photon_map = build_photon_map(*made, scene.bbox(), radius, len(photons), "indirect")
    ray = mi.Ray3f(mi.Point3f(dr.zeros(mi.Float, n), 0, 0.01), mi.Vector3f(0, 0, -1))
    vertices = vertices_at(scene, ray, n)
    walls = DiskWalls(mi.Vector3f(wall, 0, 0), mi.Vector3f(0), mi.Float(0.02))
    (found,) = gather_seen(scene, photon_map, vertices, [walls], [radius], 1, -1)
    (everything,) = gather_photons(photon_map, vertices, [radius], 1, -1)
    assert np.all(np.array(everything) >= np.array(found)) and np.any(np.array(everything) > 0)
    return np.array(found) * 0.2**2 * np.pi**2


def test_one_photon_is_tested_in_proportion(rgb):
    """It is seen as often as the share of the light that is: three quarters. (Five standard
    deviations.)"""
    photons = [(0.1, -0.1, [1.0] * 3), (0.1, 0.1, [3.0] * 3), (0.1, -0.12, [0.5] * 3)]
    photons.append((0.1, 0.12, [1.5] * 3))
    found = seen_by_many(photons, 1.0)[0]
    assert found.max() == pytest.approx(6, rel=1e-3) and found.min() == 0
    share = np.mean(found > 0)
    assert abs(share - 0.75) < 5 * np.sqrt(0.75 * 0.25 / len(found))


def test_light_of_another_colour(rgb):
    """Hidden blue photons, however bright, bring a red floor nothing, and take nothing from it."""
    photons = [(0.1, -0.1, [0, 0, 10.0]), (0.1, 0.1, [1.0, 0, 0])]
    red = {"type": "rgb", "value": [0.8, 0, 0]}
    found = seen_by_many(photons, red)
    np.testing.assert_allclose(found[0], 0.8, rtol=1e-3)


@pytest.mark.parametrize("below, seen", [(0.0, 1.0), (0.01, 1.0), (0.05, 0.0)])
def test_photons_on_another_sheet_must_be_seen(rgb, below, seen):
    """Those of the next slat of a blind are hidden by this one, but for a distance that may be the
    same sheet's."""
    found = seen_by_many([(0.1, 0.1, [1.0] * 3)], 1.0, below=below, wall=0.0)
    np.testing.assert_allclose(found, seen, rtol=1e-3)


def test_same_seed_same_walls(rgb):
    """Which photon is tested does not depend on its place in a map, which chance decides."""
    images = []
    for _ in range(2):
        session = mi.load_dict({"type": "bdpm", "bdd": 0, **SETTINGS}).session(room(), seed=5)
        session.recall(learned(session, 0.3))
        session.iterate()
        images.append(session.image())
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-5)
