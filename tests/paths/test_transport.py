"""Parts of the transport: the photon map against brute force, packing, and the densities that
sampling claims to have."""

from mis_integrators.core import packing
from mis_integrators.core.power_heuristic import mis_power
from mis_integrators.core.random import mix, next_2d, streams
from mis_integrators.lights import environment_guide
from mis_integrators.lights.emitter_choice import mean_power
from mis_integrators.lights.environment_guide import (
    EnvironmentGuide,
    cell_direction,
    direction_cell,
)
from mis_integrators.lights.lights import Lights
from mis_integrators.photons import grid as photon_map
from mis_integrators.photons.photon import read_power

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import assert_frequencies, kernels_of, mean_and_error, stratified_directions
from hypothesis import given, settings
from hypothesis import strategies as st
from selection import extended, one_of_each_kind
from worlds import EMITTERS, T, bitmap, diffuse, film, look, tray


@pytest.fixture(autouse=True)
def _rgb(rgb):
    pass


# --- Photon map ---------------------------------------------------------------


def test_kernels_do_not_know_where_numpy_keeps_numbers():
    """Arrays that begin at other addresses, modulo the alignment that vector loads want, are read
    by one kernel, which is that of Dr.Jit's own arrays."""
    numbers, kernels = np.arange(1000, dtype=np.float32), set()
    for offset in range(16):
        array = packing.from_numpy(mi.Float, numbers[offset : offset + 400])
        records = dr.gather(mi.Vector4f, array, dr.arange(mi.UInt32, 100)) + 1
        kernels |= kernels_of(lambda records=records: dr.eval(records))
        np.testing.assert_array_equal(
            packing.to_numpy(records).T.ravel(), numbers[offset : offset + 400] + 1
        )
    own = dr.arange(mi.Float, 400) + dr.opaque(mi.Float, 1)
    dr.eval(own)
    records = dr.gather(mi.Vector4f, own, dr.arange(mi.UInt32, 100)) + 1
    kernels |= kernels_of(lambda: dr.eval(records))
    assert len(kernels) == 1


def test_numbers_from_numpy_are_a_copy():
    """What becomes of NumPy's array is of no consequence, though Dr.Jit may not have read it."""
    numbers = np.arange(400, dtype=np.float32)
    array = packing.from_numpy(mi.Float, numbers)
    numbers[:] = -1
    del numbers
    junk = [np.full(500, -1, np.float32) for _ in range(100)]
    np.testing.assert_array_equal(np.array(array + 0), np.arange(400))
    assert len(junk) == 100


def query_counts(photons, queries, radii, cell, capacity=None, low=None, high=None):
    """Photons that the map finds within the radius of each query: their number, and the sum of
    their (fake) powers."""
    photons, queries = (
        np.asarray(photons, np.float32).reshape(-1, 3),
        np.asarray(queries, np.float32).reshape(-1, 3),
    )
    n = len(photons)
    capacity = capacity or max(n, 1)
    words = np.zeros((capacity, 4), np.uint32)
    words[:n, :3] = photons.view(np.uint32)
    power = np.zeros((capacity, 4), np.float32)
    power[:n, 0] = np.arange(1, n + 1)
    everything = np.concatenate([photons, queries])
    box = mi.ScalarBoundingBox3f(
        [float(x) for x in (everything.min(axis=0) if low is None else low)],
        [float(x) for x in (everything.max(axis=0) if high is None else high)],
    )
    built = photon_map.build_photon_map(
        mi.UInt32(words.ravel()),
        mi.UInt32(power.view(np.uint32).ravel()),
        mi.UInt32([n]),
        box,
        mi.Float(cell),
        capacity,
        "all",
    )

    def visit(index, record, offset, distance_squared, hit, state):
        number, total = state
        flux, _ = read_power(built.power, index, hit)
        return number + dr.select(hit, mi.UInt32(1), 0), total + dr.select(hit, flux[0], 0)

    m = len(queries)
    number, total = photon_map.for_each_photon(
        built,
        mi.Point3f(queries.T.copy()),
        mi.Float(radii),
        mi.Bool(True),
        visit,
        (dr.zeros(mi.UInt32, m), dr.zeros(mi.Float, m)),
    )
    return np.array(number), np.array(total)


def brute_force(photons, queries, radii):
    photons, queries = (
        np.asarray(photons, np.float32).reshape(-1, 3),
        np.asarray(queries, np.float32).reshape(-1, 3),
    )
    near = ((queries[:, None].astype(np.float64) - photons[None]) ** 2).sum(-1) < np.asarray(
        radii, np.float64
    ).reshape(-1, 1) ** 2
    return near.sum(axis=1), near @ np.arange(1.0, len(photons) + 1)


def assert_map_is_right(photons, queries, radii, cell, **options):
    number, total = query_counts(photons, queries, radii, cell, **options)
    exact_number, exact_total = brute_force(photons, queries, radii)
    assert exact_number.sum() > 0 or len(photons) == 0
    np.testing.assert_array_equal(number, exact_number)
    np.testing.assert_allclose(total, exact_total, rtol=1e-5)


@pytest.mark.parametrize("n, m", [(1, 1), (7, 13), (1001, 333), (4099, 777)])
def test_map_finds_what_brute_force_finds(n, m):
    rng = np.random.default_rng(n)
    photons, queries = rng.uniform(-3, 2, (n, 3)), rng.uniform(-3, 2, (m, 3))
    queries[0] = photons[0] + 0.01
    assert_map_is_right(photons, queries, 0.3, 0.3)


@pytest.mark.parametrize("offset", [-1000, -1, 0, 50])
def test_map_away_from_the_origin(offset):
    rng = np.random.default_rng(1)
    photons, queries = (
        np.round(rng.uniform(0, 2, (500, 3)) * 512) / 512 + offset for _ in range(2)
    )
    assert_map_is_right(photons, queries, 0.2, 0.2)


def test_queries_that_hit_in_more_rows_than_they_keep():
    rng = np.random.default_rng(2)
    photons, queries = rng.uniform(0, 1, (3000, 3)), rng.uniform(0.3, 0.7, (99, 3))
    assert_map_is_right(photons, queries, np.linspace(0.05, 0.3, 99), 0.05)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_map_of_a_plane(axis):
    """Photons and queries on one plane that is also a cell's border."""
    rng = np.random.default_rng(axis)
    photons, queries = rng.uniform(-1, 1, (2, 2000, 3))
    photons[:, axis] = queries[:, axis] = -1
    assert_map_is_right(photons, queries, 0.1, 0.1)


def test_queries_have_radii_of_their_own():
    rng = np.random.default_rng(2)
    photons, queries = rng.uniform(-1, 1, (3000, 3)), rng.uniform(-1, 1, (500, 3))
    assert_map_is_right(photons, queries, rng.uniform(0.01, 0.5, 500).astype(np.float32), 0.25)


@pytest.mark.parametrize("cell, radius", [(0.05, 0.2), (0.2, 0.05), (2.0, 0.2)])
def test_radius_and_cell_need_not_match(cell, radius):
    rng = np.random.default_rng(3)
    photons, queries = rng.uniform(-1, 1, (2000, 3)), rng.uniform(-1, 1, (300, 3))
    assert_map_is_right(photons, queries, radius, cell)


def test_empty_map():
    number, total = query_counts(
        np.zeros((0, 3)), np.zeros((5, 3)), 0.5, 0.5, capacity=16, low=(-1, -1, -1), high=(1, 1, 1)
    )
    assert not number.any() and not total.any()


def test_all_photons_in_one_cell():
    rng = np.random.default_rng(4)
    photons = rng.uniform(0.4, 0.41, (2000, 3))
    assert_map_is_right(
        photons,
        [[0.405] * 3, [0.0] * 3, [0.45] * 3],
        [0.004, 0.1, 0.1],
        0.1,
        low=(-1, -1, -1),
        high=(1, 1, 1),
    )


def test_queries_outside_the_box():
    rng = np.random.default_rng(5)
    photons = rng.uniform(-1, 1, (3000, 3))
    assert_map_is_right(
        photons, rng.uniform(-1.3, 1.3, (600, 3)), 0.3, 0.3, low=(-1, -1, -1), high=(1, 1, 1)
    )


def test_collisions_in_a_tiny_table(monkeypatch):
    """Hundreds of cells a table entry: none found twice, none missed."""
    monkeypatch.setattr(photon_map, "table_size", lambda capacity: 64)
    rng = np.random.default_rng(6)
    photons, queries = rng.uniform(-1, 1, (2000, 3)), rng.uniform(-1, 1, (400, 3))
    assert_map_is_right(photons, queries, 0.1, 0.1)


def test_map_of_one_kind():
    """`build_photon_map` keeps the kind that it is asked for."""
    n = 100
    caustic = np.arange(n) % 3 == 0
    words = np.zeros((n, 4), np.uint32)
    words[:, 3] = np.array(
        packing.pack_surface(mi.Normal3f(0, 0, 1), dr.full(mi.UInt32, 2, n), mi.Bool(caustic))
    )
    box = mi.ScalarBoundingBox3f([-1.0] * 3, [1.0] * 3)
    for kind, expected in (("all", n), ("caustic", caustic.sum()), ("indirect", n - caustic.sum())):
        built = photon_map.build_photon_map(
            mi.UInt32(words.ravel()),
            dr.zeros(mi.UInt32, 4 * n),
            mi.UInt32([n]),
            box,
            mi.Float(0.5),
            n,
            kind,
        )
        assert int(built.start[dr.width(built.start) - 1]) == expected


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.floats(0.02, 1.5), st.floats(-20, 20))
def test_map_finds_everything(seed, n, radius, offset):
    rng = np.random.default_rng(seed)
    photons, queries = rng.uniform(-1, 1, (2, n, 3)) * rng.uniform(0.1, 2, 3) + offset
    photons, queries = np.round(photons * 64) / 64, np.round(queries * 64) / 64 + 1 / 256
    number, _ = query_counts(photons, queries, radius, radius)
    distances = np.sqrt(((queries[:, None] - photons[None]) ** 2).sum(-1))
    assert (number >= (distances < radius * (1 - 1e-4)).sum(axis=1)).all()
    assert (number <= (distances < radius * (1 + 1e-4)).sum(axis=1)).all()


# --- Packing ------------------------------------------------------------------

unit_vectors = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda v: 0.01 < np.linalg.norm(v))
    .map(lambda v: v / np.linalg.norm(v))
)
axes = st.sampled_from(
    [np.roll(np.array([s, 0.0, 0.0]), k) for s in (1, -1, -0.0) for k in range(3)]
).filter(np.any)


def angle(a, b):
    """Angle between directions; their lengths do not matter here."""
    a, b = (np.ravel(v) / np.linalg.norm(v) for v in (a, b))
    return 2 * np.arcsin(min(np.linalg.norm(a - b) / 2, 1))


@settings(max_examples=300, deadline=None)
@given(unit_vectors | axes)
def test_direction_round_trip(v):
    back = packing.unpack_direction(packing.pack_direction(mi.Vector3f(*[float(x) for x in v])))
    assert angle(back, v) < 1e-4


@settings(max_examples=300, deadline=None)
@given(unit_vectors | axes, st.integers(0, 2000), st.booleans())
def test_surface_round_trip(v, depth, caustic):
    word = packing.pack_surface(
        mi.Normal3f(*[float(x) for x in v]), mi.UInt32(depth), mi.Bool(caustic)
    )
    assert angle(packing.unpack_normal(word), v) < 0.0025
    assert int(packing.unpack_depth(word)[0]) == min(depth, packing.MAX_DEPTH)
    assert bool(packing.unpack_caustic(word)[0]) == caustic


@given(st.floats(width=32, allow_nan=False))
def test_float_bits_round_trip(x):
    assert float(packing.bits_float(packing.float_bits(mi.Float(x)))[0]) == np.float32(x)


# --- Random numbers -----------------------------------------------------------


def test_streams_are_uniform_and_differ():
    rng = streams(dr.arange(mi.UInt32, 1 << 16), mi.UInt32(mix(1, 0, 0)))
    first, second = np.array(rng.next_float32()), np.array(rng.next_float32())
    other = np.array(streams(dr.arange(mi.UInt32, 1 << 16), mi.UInt32(mix(1, 1, 0))).next_float32())
    for u in (first, second, other):
        assert_frequencies(np.histogram(u, 64, (0, 1))[0], np.full(64, len(u) / 64))
    for a, b in ((first, second), (first, other), (first[:-1], first[1:])):
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(len(a))
        assert_frequencies(
            np.histogram2d(a, b, 16, [(0, 1)] * 2)[0], np.full((16, 16), len(a) / 256)
        )


def test_seeds_of_purposes_differ():
    words = {
        mix(seed, iteration, purpose)
        for seed in range(20)
        for iteration in range(50)
        for purpose in range(3)
    }
    assert len(words) == 20 * 50 * 3


# --- Light sub-paths ----------------------------------------------------------


def emission(scene, count=1 << 18, seed=7):
    """Rays (origins, directions) and flux of `count` light sub-paths."""
    guide = (
        EnvironmentGuide(scene, scene.sensors()[0])
        if any(e.flags() & mi.EmitterFlags.Infinite for e in scene.emitters())
        else None
    )
    lights = Lights(scene, guide=guide)
    ray, flux, *_ = lights.sample_emission(
        streams(dr.arange(mi.UInt32, count), mi.UInt32(seed)), mi.Float(0), []
    )
    grey = np.array(dr.mean(flux) + dr.zeros(mi.Float, count))
    return lights, ray, grey


def flux_through_floor(scene, half):
    """Estimated flux that arrives directly on the square |x|, |y| < half of the plane z = 0, and
    its standard error."""
    _, ray, flux = emission(scene, 1 << 19)
    si = scene.ray_intersect(ray)
    p = np.array(si.p)
    arrives = (
        np.array(si.is_valid())
        & (np.abs(p[:2]) < half).all(axis=0)
        & (np.abs(p[2]) < 1e-3)
        & (np.array(ray.d)[2] < 0)
    )
    return mean_and_error(np.where(arrives, flux, 0))


def irradiance_of_floor(scene, half, samples=1 << 18):
    """The same by next-event estimation, Mitsuba's own, at points of the square."""
    rng = np.random.default_rng(3)
    si = dr.zeros(mi.SurfaceInteraction3f, samples)
    xy = rng.uniform(-half, half, (2, samples)).astype(np.float32)
    si.p, si.n = mi.Point3f(mi.Float(xy[0]), mi.Float(xy[1]), 1e-4), mi.Normal3f(0, 0, 1)
    si.sh_frame, si.t = mi.Frame3f(si.n), 1.0
    total, error2 = 0.0, 0.0
    for emitter in scene.emitters():
        ds, weight = emitter.sample_direction(
            si, mi.Point2f(*[mi.Float(u) for u in rng.random((2, samples)).astype(np.float32)])
        )
        lit = (ds.pdf > 0) & ~scene.ray_test(si.spawn_ray_to(ds.p))
        value = np.array(
            dr.select(lit, dr.mean(weight) * dr.maximum(ds.d.z, 0), 0) + dr.zeros(mi.Float, samples)
        )
        mean, error = mean_and_error(value * (2 * half) ** 2)
        total, error2 = total + mean, error2 + error**2
    return total, np.sqrt(error2)


@pytest.mark.parametrize("emitter", one_of_each_kind(e for e in EMITTERS if e != "directionalarea"))
def test_flux_through_known_area(emitter):
    """Light sub-paths bring the flux that Mitsuba's next-event estimation measures (5.3 standard
    errors: 1e-7; an error of 12 % is seen)."""
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": T().scale(4), "bsdf": diffuse(0.5)},
        "sensor": {
            "type": "perspective",
            "to_world": look((0, -1.5, 6), (0, 0, 0)),
            "fov": 30,
            "film": film(32),
        },
        **EMITTERS[emitter]("lambertian"),
    }
    scene = mi.load_dict(scene)
    a, error_a = flux_through_floor(scene, 1.5)
    b, error_b = irradiance_of_floor(scene, 1.5)
    error = np.hypot(error_a, error_b)
    assert abs(a - b) < 5.3 * error, f"{a} against {b}"
    assert (5.3 + 1.65) * error < 0.12 * b, "test too weak"


@pytest.mark.parametrize("rotation", [None, ([1, 0, 0], 90), ([0, 0.6, 0.8], 50)])
@pytest.mark.parametrize("shape", ["sphere", "rectangle", "disk", "cylinder", "cube"])
def test_area_lights_emit_outwards_like_cosine(shape, rotation):
    """Power pi A L; no sub-path starts into its own (convex) shape; the cosine's mean is 2/3."""
    to_world = T().rotate(*rotation) if rotation else T()
    scene = mi.load_dict(
        {
            "type": "scene",
            "lamp": {
                "type": shape,
                "to_world": to_world,
                "emitter": {"type": "area", "radiance": 3.0},
            },
        }
    )
    _, ray, flux = emission(scene, 1 << 16)
    area = float(scene.shapes()[0].surface_area()[0])
    np.testing.assert_allclose(flux, np.pi * 3 * area, rtol=1e-4)
    assert not np.array(scene.ray_test(ray)).any()
    back = scene.ray_intersect(mi.Ray3f(ray.o + 0.01 * ray.d, -ray.d))
    assert np.array(back.is_valid()).mean() > 0.999
    cosine = np.array(dr.dot(back.n, ray.d))
    assert cosine.mean() == pytest.approx(2 / 3, abs=5 * 0.24 / 256)
    assert_frequencies(
        np.histogram(np.clip(cosine, 0, 1) ** 2, 32, (0, 1))[0], np.full(32, (1 << 16) / 32)
    )


def test_point_light_directions():
    _, ray, flux = emission(
        mi.load_dict({"type": "scene", "p": {"type": "point", "intensity": 2.0}}), 1 << 16
    )
    np.testing.assert_allclose(flux, 8 * np.pi, rtol=1e-5)
    d = np.array(ray.d)
    assert_frequencies(
        np.histogram2d(d[2], np.arctan2(d[1], d[0]), 16, [(-1, 1), (-np.pi, np.pi)])[0],
        np.full((16, 16), (1 << 16) / 256),
    )


def test_power_decides_among_emitters():
    """The choice is by power with a tenth shared evenly; the flux's mean is the sum of the
    powers."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "a": {"type": "point", "intensity": 1.0, "position": [0, 0, 0]},
            "b": {"type": "point", "intensity": 3.0, "position": [5, 0, 0]},
        }
    )
    lights, ray, flux = emission(scene)
    chosen = np.array(ray.o)[0] > 2
    order = [0 if "5, 0, 0" in str(e) else 1 for e in scene.emitters()]
    expected = 0.9 * 0.75 + 0.1 / 2
    assert chosen.mean() == pytest.approx(expected, abs=5 / 1024)
    assert lights.choice.pmf[order.index(0)] == pytest.approx(expected, rel=0.01)
    mean, error = mean_and_error(flux)
    assert abs(mean - 16 * np.pi) < 5 * error


def test_small_spots_of_light_are_not_taken_for_darkness():
    """A lamp of one bright texel on a rotated sphere, where Mitsuba's light rays do not meet it:
    its flux is the texel's all the same, and beside other lamps it has its even share of the
    choices."""
    texels = np.zeros((256, 256, 3), np.float32)
    texels[131, 28] = 1e5
    lamp = {
        "type": "sphere",
        "to_world": look((1, 2, 3), (0, 1, 0)),
        "emitter": {"type": "area", "radiance": bitmap(texels, filter_type="nearest")},
    }
    scene = mi.load_dict({"type": "scene", "lamp": lamp})
    emitter = scene.emitters()[0]
    assert mean_power(emitter) == 0, "test too weak"
    lights, _, flux = emission(scene, 1 << 21)
    assert not lights.dark
    mean, error = mean_and_error(flux)
    everywhere = mi.warp.square_to_uniform_sphere(
        next_2d(streams(dr.arange(mi.UInt32, 1 << 22), mi.UInt32(3)))
    )
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(1, 2, 3), everywhere))
    si.wi = mi.Vector3f(0, 0, 1)
    radiance, radiance_error = mean_and_error(np.array(dr.mean(emitter.eval(si))))
    power, power_error = 4 * np.pi**2 * radiance, 4 * np.pi**2 * radiance_error
    assert abs(mean - power) < 5 * np.hypot(error, power_error)
    assert 5 * np.hypot(error, power_error) < mean, "test too weak"
    both = Lights(
        mi.load_dict({"type": "scene", "lamp": lamp, "other": {"type": "point", "intensity": 3.0}})
    )
    assert both.choice.pmf.min() == pytest.approx(0.05, rel=1e-3)


def test_spectral_suns_are_chosen_by_their_light():
    """A sun and a sky: the choice between them is the same in rgb and in spectral variants (looked
    at without wavelengths, the sun is dark)."""
    chosen = []
    for variant_name in ("llvm_ad_rgb", "llvm_ad_spectral"):
        mi.set_variant(variant_name)
        scene = mi.load_dict(
            {
                "type": "scene",
                "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.5)},
                "sun": {
                    "type": "directional",
                    "direction": [0.3, 0.2, -1],
                    "irradiance": {"type": "rgb", "value": 5.0},
                },
                "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.2}},
                "sensor": {
                    "type": "perspective",
                    "to_world": look((0, -1.5, 6), (0, 0, 0)),
                    "fov": 30,
                    "film": film(16),
                },
            }
        )
        lights = Lights.seen_by(scene, scene.sensors()[0], "bdpm")
        chosen.append(lights.choice.pmf[lights.kinds.index("directional")])
    assert chosen[1] == pytest.approx(chosen[0], rel=0.1)


# --- Direct light -------------------------------------------------------------


SINGULAR = "point", "spot", "directional", "projector", "directionalarea"
"""Emitters whose direct light has no density."""


@pytest.mark.parametrize(
    "emitter",
    [
        *one_of_each_kind(name for name in EMITTERS if name not in SINGULAR),
        "wide sun and textured",
    ],
)
def test_density_of_direct_light(emitter):
    """The density that `sample_direct` states is the one that `pdf_direct` gives for the same
    direction, and is that of the samples (5.3 standard errors: 1e-7; an error of 5 % is seen with a
    probability of 0.95)."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": T().scale([0.01, 0.01, 1]),
                "bsdf": diffuse(),
            },
            "sensor": {
                "type": "perspective",
                "to_world": look((0, 0, 5), (0, 0, 0)),
                "film": film(16),
            },
            **{
                f"{name} of {kind}": light
                for kind in emitter.split(" and ")
                for name, light in EMITTERS[kind]("delta").items()
            },
        }
    )
    infinite = environment_guide.infinite_emitters(scene)
    guide = EnvironmentGuide(scene, scene.sensors()[0]) if infinite else None
    assert "wide sun" not in emitter or guide.sampler.by_table
    lights = Lights(scene, guide=guide)
    n = 1 << 20
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.p, si.n, si.sh_frame, si.t = (
        mi.Point3f(0.1, 0.2, 0.3),
        mi.Normal3f(0, 0, 1),
        mi.Frame3f(mi.Normal3f(0, 0, 1)),
        1.0,
    )
    rng = streams(dr.arange(mi.UInt32, n), mi.UInt32(5))
    ds, weight, pdf = lights.sample_direct(si, rng, mi.Bool(True))
    valid = np.array((pdf > 0) & (dr.max(weight) > 0))
    assert valid.mean() > 0.1
    hit = scene.ray_intersect(si.spawn_ray(ds.d))
    found = mi.DirectionSample3f(scene, hit, si)
    again = np.array(lights.pdf_direct(si, found, mi.Bool(True)))
    stated = np.array(pdf + dr.zeros(mi.Float, n))
    relative = np.abs(again - stated)[valid] / stated[valid]
    # grazing ones suffer from rounding
    assert np.quantile(relative, 0.9) < 0.02, np.quantile(relative, [0.5, 0.9, 0.98])
    # Radiance integrated with that density is radiance integrated with uniform directions.
    value, error = mean_and_error(np.array(dr.mean(weight) + dr.zeros(mi.Float, n)))
    d = mi.warp.square_to_uniform_sphere(next_2d(rng))
    hit = scene.ray_intersect(si.spawn_ray(d))
    uniform = np.array(dr.mean(hit.emitter(scene).eval(hit)) * (4 * np.pi))
    expected, expected_error = mean_and_error(uniform)
    error = np.hypot(error, expected_error)
    assert abs(value - expected) < 5.3 * error, f"{value} against {expected}"
    assert (5.3 + 1.65) * error < 0.05 * expected, "test too weak"


@given(st.floats(0, 1e10, width=32), st.floats(0, 1e10, width=32))
def test_weights_sum_to_one(a, b):
    weights = [float(np.ravel(mis_power(mi.Float(x), mi.Float(y)))[0]) for x, y in ((a, b), (b, a))]
    assert all(0 <= w <= 1 for w in weights)
    if a > 1e-20 or b > 1e-20:
        assert sum(weights) == pytest.approx(1, abs=1e-4)
    if 1e-3 < a < 1e3 and 1e-3 < b < 1e3:
        assert weights[0] == pytest.approx(a * a / (a * a + b * b), rel=1e-3)


# --- Environments -------------------------------------------------------------


def test_direction_cells():
    cell = dr.arange(mi.UInt32, 512)
    for u in ((0.01, 0.01), (0.5, 0.5), (0.99, 0.99)):
        np.testing.assert_array_equal(
            np.array(direction_cell(cell_direction(cell, mi.Point2f(*u)))), np.arange(512)
        )
    d = mi.warp.square_to_uniform_sphere(
        next_2d(streams(dr.arange(mi.UInt32, 1 << 17), mi.UInt32(1)))
    )
    assert_frequencies(
        np.bincount(np.array(direction_cell(d)), minlength=512), np.full(512, (1 << 17) / 512)
    )


def test_places_of_a_guide_share_kernels(rgb):
    """A guide looks for the sky from four vertices of camera paths with few kernels that take long
    to compile: one goes from vertex to vertex, one meets all of them again, two look from each."""
    scene = tray("lambertian", "constant")
    made = kernels_of(lambda: EnvironmentGuide(scene, scene.sensors()[0]), 800)
    assert 0 < len(made) <= 3


@pytest.mark.parametrize("emitter", ["envmap rotated", "wide sun", *extended("constant", "sunsky")])
def test_environment_directions(emitter):
    """Densities over the sphere integrate to one and are those of the samples."""
    scene = tray("lambertian", emitter)
    guide = EnvironmentGuide(scene, scene.sensors()[0])
    environment = scene.environment()
    n = 1 << 18
    rng = streams(dr.arange(mi.UInt32, n), mi.UInt32(3))
    it = dr.zeros(mi.Interaction3f, n)
    it.p = guide.center
    towards, pdf, *_ = guide.sample_direction(
        environment, mi.UInt32(0), it, next_2d(rng), rng.next_float32(), mi.Bool(True)
    )
    inverse = np.array(dr.select(pdf > 0, dr.rcp(pdf), 0))
    cells = np.array(direction_cell(towards))
    # The mean of 1/pdf over the samples of a cell is the cell's solid angle, where samples come at
    # all.
    per_cell = np.bincount(cells, weights=inverse, minlength=512) / n
    square = np.bincount(cells, weights=inverse**2, minlength=512) / n
    error = np.sqrt(np.maximum(square - per_cell**2, 0) / n)
    met = np.bincount(cells, minlength=512) > 200
    assert met.sum() > 100
    wrong = met & (np.abs(per_cell - 4 * np.pi / 512) > 5.5 * error + 0.02 * 4 * np.pi / 512)
    assert not wrong.any(), np.flatnonzero(wrong)
    # A cell alone says no more than that to a fifth; all of them together, to 2 %.
    total, total_error = mean_and_error(np.where(met[cells], inverse, 0))
    expected = met.sum() * 4 * np.pi / 512
    assert abs(total - expected) < 5.3 * total_error, (total / expected, total_error / expected)
    assert (5.3 + 1.65) * total_error < 0.02 * expected, "test too weak"


@pytest.mark.parametrize(
    "sun", [(1, -1, 0), (1, 0, 0), (-0.3, -1, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)]
)
def test_position_density_of_rounded_directions(sun):
    """Strategies round the direction of a sun, each in its own way: to either side of zero in
    scenes where it has no third coordinate. All mean the same cell."""
    scene = tray("lambertian", "directional")
    guide = EnvironmentGuide(scene, scene.sensors()[0])
    rng = streams(dr.arange(mi.UInt32, 4096), mi.UInt32(7))
    p = guide.focus_center + guide.focus_radius * (
        2 * mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32()) - 1
    )
    exact = dr.normalize(mi.Vector3f(*map(float, sun)))
    found = [
        np.array(guide.position_density(exact + mi.Vector3f(shift), mi.UInt32(0), p))
        for shift in (0.0, -0.0, 1e-8, -1e-8)
    ]
    assert len(np.unique(found[0])) > 10
    for other in found[1:]:
        assert np.mean(np.abs(other / found[0] - 1) > 0.01) < 1e-3  # at borders of cells


@pytest.mark.parametrize("emitter", ["directional", "constant", "sunsky"])
def test_position_density(emitter):
    """Over the plane across a direction it integrates to one, and it is that of the samples."""
    scene = tray("lambertian", emitter)
    guide = EnvironmentGuide(scene, scene.sensors()[0])
    n, row = 1 << 18, 0
    if emitter == "directional":
        towards = np.array([0.5, 0.3, 1.0]) / np.linalg.norm([0.5, 0.3, 1.0])
    else:
        towards = np.array([0.3, 0.2, 0.9]) / np.linalg.norm([0.3, 0.2, 0.9])
        row = int(direction_cell(mi.Vector3f(*towards.tolist()))[0])
    direction = mi.Vector3f(*towards.tolist())
    rng = streams(dr.arange(mi.UInt32, n), mi.UInt32(4))
    p, density = guide.sample_position(
        direction, mi.UInt32(row), next_2d(rng), next_2d(rng), rng.next_float32(), mi.Bool(True)
    )
    again = guide.position_density(direction, mi.UInt32(row), p)
    differ = np.abs(np.array(again / density + dr.zeros(mi.Float, n)) - 1) > 0.05
    assert differ.mean() < 1e-4  # a point on a cell's border may fall to either side
    frame = mi.Frame3f(direction)
    center = np.array(guide.center).ravel()
    offset = np.array(p).T - center
    s, t = (np.array(v).ravel() for v in (frame.s, frame.t))
    side = 1.05 * max(
        guide.radius,
        float(np.linalg.norm(np.array(guide.focus_center).ravel() - center))
        + 1.5 * guide.focus_radius,
    )
    bins, fine = 24, 40
    observed = np.histogram2d(offset @ s, offset @ t, bins, [(-side, side)] * 2)[0]
    grid = (np.arange(bins * fine) + 0.5) / (bins * fine) * 2 * side - side
    u, v = np.meshgrid(grid, grid, indexing="ij")
    points = center[:, None] + s[:, None] * u.ravel() + t[:, None] * v.ravel()
    values = np.array(
        guide.position_density(direction, mi.UInt32(row), mi.Point3f(points.astype(np.float32)))
    )
    cell = (2 * side / (bins * fine)) ** 2
    assert values.sum() * cell == pytest.approx(1, abs=0.01)
    expected = values.reshape(bins, fine, bins, fine).sum(axis=(1, 3)) * cell * n
    assert observed.sum() == n
    # The grid resolves the cells' borders to 1 in 40: counts may be off by that, besides chance.
    assert (
        np.abs(observed - expected)
        < 5.5 * np.sqrt(expected + 1) + 0.06 * expected + 0.003 * n / bins
    ).all()


def room_with_window(sky=None):
    """A closed room of 6 x 4 x 3 with a window of 1 x 1 in one wall; the camera stands inside, the
    sky (a sun, unless told otherwise) looks in."""
    sky = sky or {"type": "sunsky", "sun_direction": [0.8, 0.1, 0.5], "turbidity": 3.0}
    wall = {"type": "twosided", "bsdf": diffuse(0.7)}

    def slab(x0, x1, y0, y1, z0, z1):
        center, half = (
            [(x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2],
            [(x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2],
        )
        return {"type": "cube", "to_world": T().translate(center).scale(half), "bsdf": wall}

    e = 0.05
    return mi.load_dict(
        {
            "type": "scene",
            "floor": slab(0, 6, 0, 4, -e, 0),
            "ceiling": slab(0, 6, 0, 4, 3, 3 + e),
            "left": slab(-e, 0, 0, 4, 0, 3),
            "front": slab(0, 6, -e, 0, 0, 3),
            "back": slab(0, 6, 4, 4 + e, 0, 3),
            "below": slab(6, 6 + e, 0, 4, 0, 1),
            "above": slab(6, 6 + e, 0, 4, 2, 3),
            "one side": slab(6, 6 + e, 0, 1.5, 1, 2),
            "other side": slab(6, 6 + e, 2.5, 4, 1, 2),
            "ground": {
                "type": "rectangle",
                "to_world": T().translate([3, 2, -0.1]).scale(30),
                "bsdf": diffuse(0.2),
            },
            "sky": sky,
            "sensor": {
                "type": "perspective",
                "fov": 70,
                "to_world": look((0.5, 0.5, 1.5), (5, 3, 1), (0, 0, 1)),
                "film": film(32),
            },
        }
    )


def inside_room(scene, ray):
    """Which light rays end in the room of `room_with_window`."""
    si = scene.ray_intersect(ray)
    p = np.array(si.p)
    return (
        np.array(si.is_valid())
        & (p[0] > -1e-3)
        & (p[0] < 5.999)
        & (p[1] > -1e-3)
        & (p[1] < 4.001)
        & (p[2] > -1e-3)
        & (p[2] < 3.001)
    )


def test_sky_enters_by_the_window():
    """At least 30 % of the light sub-paths of sun and sky enter a room by its one small window
    (1/300 of the scene's disk)."""
    scene = room_with_window()
    _, ray, flux = emission(scene, 1 << 16)
    inside, sent = inside_room(scene, ray), np.array(flux) > 0
    assert (inside & sent).mean() > 0.3, (inside & sent).mean()


@pytest.mark.parametrize("small", [True, False])
def test_windows_are_known_from_all_directions(monkeypatch, small):
    """What an even sky sends through the window is the same flux where the guide knows the faces by
    which light enters, and where it knows each direction by itself. After a small pilot that has
    met few directions, hundreds of 2^18 sub-paths bring half of it with the faces (193 to 518 over
    four seeds), and one or two without. (All random numbers are fixed.)"""
    if small:
        monkeypatch.setattr(environment_guide, "PILOT_PATHS", 2048)
    scene = room_with_window({"type": "constant"})
    guide = EnvironmentGuide(scene, scene.sensors()[0])
    count, found = 1 << 18, []
    for known in (True, False):
        if not known:
            guided = np.array(guide._guided)
            guide._guided = mi.Float(np.where(guided > 0, guided + np.array(guide._entering), 0))
            guide.portals = None
        ray, flux, *_ = Lights(scene, guide=guide).sample_emission(
            streams(dr.arange(mi.UInt32, count), mi.UInt32(7)), mi.Float(0), []
        )
        entering = np.array(dr.mean(flux) + dr.zeros(mi.Float, count)) * inside_room(scene, ray)
        brought = np.cumsum(np.sort(entering)[::-1])
        found.append((np.searchsorted(brought, brought[-1] / 2), *mean_and_error(entering)))
    (many, mean, error), (few, other, other_error) = found
    assert abs(mean - other) < 5.3 * np.hypot(error, other_error)
    assert not small or (many > 100 and few < 10), (many, few)


def direct_light_of_floor(scene, lights, count=1 << 18):
    """Direct light at places of the room's floor: irradiances by one sample each, their directions'
    densities as stated, and as `pdf_direct` has them."""
    rng = np.random.default_rng(1)
    x, y = (
        mi.Float(v)
        for v in rng.uniform([[0.2], [0.2]], [[5.8], [3.8]], (2, count)).astype(np.float32)
    )
    ray = mi.Ray3f(mi.Point3f(x, y, 1), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    ds, weight, pdf = lights.sample_direct(
        si, streams(dr.arange(mi.UInt32, count), mi.UInt32(2)), mi.Bool(True)
    )
    lit = dr.max(weight) > 0
    found = mi.DirectionSample3f(scene, scene.ray_intersect(si.spawn_ray(ds.d), lit), si)
    value = np.array(
        dr.select(lit, dr.mean(weight) * dr.maximum(ds.d.z, 0), 0) + dr.zeros(mi.Float, count)
    )
    lit = np.array(lit)
    return value, np.array(pdf)[lit], np.array(lights.pdf_direct(si, found, mi.Bool(True)))[lit]


def assert_same_mean_less_noise(mended, own, seen, left):
    """Two ways to estimate direct light have the same mean (5.3 standard errors: 1e-7; a difference
    of the share `seen` is seen with a probability of 0.95), and the first one `left` of the second
    one's variance at most."""
    (a, error_a), (b, error_b) = mean_and_error(mended), mean_and_error(own)
    error = np.hypot(error_a, error_b)
    assert abs(a - b) < 5.3 * error, f"{a} against {b}"
    assert (5.3 + 1.65) * error < seen * b, "test too weak"
    assert mended.var() < left * own.var(), mended.var() / own.var()


@pytest.mark.parametrize("sky", ["constant", "sunsky"])
def test_direct_light_is_looked_for_at_windows(sky):
    """Next-event estimation in a room aims at the window: its mean is that of the sky's own sampler
    (5.3 standard errors: 1e-7; 10 % are seen) and its variance a fraction of it; the density of
    each direction is what `pdf_direct` says. (All random numbers are fixed.)"""
    scene = room_with_window(
        {"type": "constant"}
        if sky == "constant"
        else {"type": "sunsky", "sun_direction": [-0.8, 0.1, 0.5], "turbidity": 3.0}
    )
    guide = EnvironmentGuide(scene, scene.sensors()[0])
    assert guide.aims
    aimed, stated, again = direct_light_of_floor(scene, Lights(scene, guide=guide))
    assert np.quantile(np.abs(again / stated - 1), 0.999) < 0.01
    guide.aims = False
    own, *_ = direct_light_of_floor(scene, Lights(scene, guide=guide), 1 << 22)
    assert_same_mean_less_noise(aimed, own, seen=0.1, left=0.3)


@pytest.mark.long
def test_a_wide_sun_is_found_at_windows():
    """As above, with a sun that its own sampler misses: three ways to choose a direction have one
    density (20 % are seen)."""
    sky = {"type": "sunsky", "sun_direction": [0.1, 0.8, 0.5], "sun_aperture": 10.0}
    scene = room_with_window(sky)
    guide = EnvironmentGuide(scene, scene.sensors()[0])
    assert guide.aims and guide.sampler.by_table
    mended, stated, again = direct_light_of_floor(scene, Lights(scene, guide=guide), 1 << 20)
    assert np.quantile(np.abs(again / stated - 1), 0.999) < 0.01
    guide.aims = guide.sampler.by_table = False
    own, *_ = direct_light_of_floor(scene, Lights(scene, guide=guide), 1 << 23)
    assert_same_mean_less_noise(mended, own, seen=0.2, left=0.2)


def test_densities_of_direct_light_at_windows_are_one_in_all():
    """The integral over all directions of the density of next-event estimation, at three places of
    a room with a window; stratified directions, 5 standard errors."""
    scene = room_with_window({"type": "constant"})
    guide, n = EnvironmentGuide(scene, scene.sensors()[0]), 1 << 9
    towards = stratified_directions(n)
    for place in ([1, 1, 0.5], [3, 2, 1.5], [5, 3, 1]):
        p = mi.Point3f(place) + dr.zeros(mi.Point3f, n * n)
        density = guide.direct_density(mi.Float(1 / (4 * np.pi)), p, towards)
        total, error = mean_and_error(4 * np.pi * np.array(density))
        assert error < 0.02 and abs(total - 1) < 5 * error, (place, total, error)


@pytest.mark.parametrize("emitter", ["constant", "sunsky"])
def test_open_skies_are_not_aimed_at(emitter):
    """Where the sky is everywhere there is nothing to aim at, and what that costs is not done."""
    scene = tray("lambertian", emitter)
    assert not EnvironmentGuide(scene, scene.sensors()[0]).aims
