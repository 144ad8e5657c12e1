"""The plugin `bdpm_balance`: its weights are one function of the joint path whichever strategy
makes it, and its renders are right.

Comparisons of renders: as in `test_against_path` (false-alarm rate 1e-6 each; an error of 1 % in
the image and of 3 or 8 % in a block is seen with a probability of 0.95).
"""

from mis_integrators.core.packing import float_bits, pack_direction, pack_surface, unpack_direction
from mis_integrators.core.random import next_2d, streams
from mis_integrators.core.traits import SceneTraits
from mis_integrators.lights.environment_guide import EnvironmentGuide
from mis_integrators.lights.lights import Lights
from mis_integrators.mis.heuristic import HeuristicWeights
from mis_integrators.photons.gather import QueryVertices, gather_photons
from mis_integrators.photons.grid import build_photon_map
from mis_integrators.photons.queries import LAST_VERTEX, STATE
from mis_integrators.weights.heuristics import heuristic_weights

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import PathBatches, SessionBatches, agree, assert_same, collect_until
from selection import extended, one_of_each_kind
from test_against_path import MONO, RGB, SPECTRAL
from worlds import (
    EMITTERS,
    RADIUS,
    T,
    diffuse,
    film,
    has_delta,
    lamp_inside,
    look,
    path,
    ptracer,
    tray,
)


def balance(**parameters):
    return mi.load_dict(
        {
            "type": "bdpm_balance",
            "initial_radius": RADIUS,
            "max_depth": 5,
            "photon_count": 20000,
            "camera_paths": 8,
            **parameters,
        }
    )


# --- One weight function ------------------------------------------------------


def room(bsdf, light):
    """A closed room of one material, with a lamp."""
    bsdfs = {"diffuse": diffuse(0.7), "rough": {"type": "roughconductor", "alpha": 0.3}}
    return mi.load_dict(
        {
            "type": "scene",
            "walls": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": bsdfs[bsdf]}},
            "lamp": lamp_inside(light, radiance=5.0),
            "sensor": {
                "type": "perspective",
                "fov": 70,
                "to_world": look((0, -0.9, -0.3), (0.1, 0, 0), (0, 0, 1)),
                "film": film(8),
            },
        }
    )


class JointPaths:
    """Random paths from the camera through `length` smooth vertices to a point of a light, with the
    weights that each strategy's own code gives them."""

    COUNT, MERGE_RADIUS = 400, 1e-4

    def __init__(self, scene, length):
        self.scene, self.traits, self.lights = scene, SceneTraits(scene), Lights(scene)
        rng = streams(dr.arange(mi.UInt32, self.COUNT), mi.UInt32(5))
        ray, _ = scene.sensors()[0].sample_ray(0, 0.5, next_2d(rng), mi.Point2f(0.5))
        self.vertices, self.valid = [], dr.full(mi.Bool, True, self.COUNT)
        for number in range(length):
            hit = scene.ray_intersect_preliminary(ray)
            si = hit.compute_surface_interaction(ray)
            bsdf = si.bsdf()
            self.valid &= hit.is_valid()
            bs, _ = bsdf.sample(mi.BSDFContext(), si, rng.next_float32(), next_2d(rng))
            self.valid &= bs.pdf > 0
            if number == length - 1:
                self.light, value, _ = self.lights.sample_direct(si, rng, self.valid)
                self.valid &= dr.max(value) > 0
                bs.wo = si.to_local(self.light.d)
            # as photons remember it
            towards = dr.normalize(unpack_direction(pack_direction(si.to_world(bs.wo))))
            if number < length - 1:
                bs.wo = si.to_local(towards)
            dr.eval(ray, hit, si, bs, rng, self.valid)
            self.vertices.append((ray, hit, si, bsdf, bs))
            ray = si.spawn_ray(towards)
        dr.eval(self.light)

    def camera(self, weights):
        """What a camera path stores at each vertex, and its states after leaving them."""
        state, stored, left = weights.init(self.COUNT), [], []
        for number, (_, _, si, bsdf, bs) in enumerate(self.vertices):
            vertex = dr.full(mi.UInt32, number, self.COUNT)
            state, _ = weights.propagate(state, si, bsdf, vertex, self.valid)
            stored.append(weights.stored(state))
            state = weights.scatter(state, si, bsdf, bs, vertex, self.valid)
            dr.eval(state, stored)
            left.append(state)
        return stored, left

    def direct(self, weights, left):
        """Weight of the direct light at the last vertex: of a sample of next-event estimation, and
        of emission that the path meets."""
        _, _, si, _, _ = self.vertices[-1]
        sampled = weights.next_event_weight(left[-1], si, self.light, self.valid)
        if self.light.delta[0]:
            return sampled, sampled
        lamp = self.scene.ray_intersect(si.spawn_ray(self.light.d))
        self.valid &= lamp.emitter(self.scene) == self.light.emitter
        # the ray starts a bit off the surface, and may even miss the lamp's edge
        lamp.p = self.light.p
        met = mi.DirectionSample3f(self.scene, lamp, mi.Interaction3f(si))
        return sampled, weights.next_event_weight(left[-1], mi.Interaction3f(si), met, self.valid)

    def notes(self, weights, merged, straight):
        """Notes of the light sub-path whose photon lands on vertex `merged`; `straight`: it came to
        the last vertex straight from the light."""
        light_state = weights.light_state()
        state = light_state.init()
        source = dr.zeros(mi.DirectionSample3f, self.COUNT)
        source.p, source.n, source.emitter = self.light.p, self.light.n, self.light.emitter
        for number in reversed(range(merged + 1, len(self.vertices))):
            _, _, si, bsdf, bs = self.vertices[number]
            view = mi.SurfaceInteraction3f(si)
            view.wi = (
                mi.Vector3f(bs.wo)
                if straight
                else si.to_local(dr.normalize(unpack_direction(pack_direction(si.to_world(bs.wo)))))
            )
            state = light_state.first_vertex(
                state, view, source, self.valid & straight & (number == len(self.vertices) - 1)
            )
            state = light_state.scatter(state, view, bsdf, si.wi, self.valid)
            dr.eval(state)
        words = light_state.words(state)
        result = dr.zeros(mi.UInt32, len(words) * self.COUNT)
        for offset, word in enumerate(words):
            dr.scatter(
                result,
                word + dr.zeros(mi.UInt32, self.COUNT),
                len(words) * dr.arange(mi.UInt32, self.COUNT) + offset,
            )
        return result

    def merged(self, weights, stored, level, kind, straight):
        """Weight of a photon at vertex `level`: what a gather of just this photon brings, over what
        it would bring without weights."""
        ray, hit, si, _, bs = self.vertices[level]
        vertices = {
            "ray_o": ray.o,
            "ray_d": ray.d,
            "hit": hit,
            "path": dr.arange(mi.UInt32, self.COUNT),
            "throughput": dr.select(self.valid, mi.Spectrum(1), 0),
            "depth": dr.full(mi.UInt32, LAST_VERTEX | (level + 1), self.COUNT),
            **dict(zip(STATE, stored[level])),
        }
        towards = pack_direction(si.to_world(bs.wo))
        channels = dr.size_v(mi.Spectrum)
        surface, power = (
            dr.zeros(mi.UInt32, 4 * self.COUNT),
            dr.zeros(mi.UInt32, {1: 2, 3: 4}[channels] * self.COUNT),
        )
        index = dr.arange(mi.UInt32, self.COUNT)
        dr.scatter(
            surface,
            mi.Vector4u(
                *[float_bits(x) for x in si.p], pack_surface(si.n, mi.UInt32(2), mi.Bool(False))
            ),
            index,
        )
        record = [float_bits(dr.ones(mi.Float, self.COUNT))] * channels + [towards]
        dr.scatter(power, (mi.Vector2u if channels == 1 else mi.Vector4u)(*record), index)
        notes = (
            self.notes(weights, level, straight)
            if kind == "indirect" and weights.light_state()
            else None
        )
        photon_map = build_photon_map(
            surface,
            power,
            mi.UInt32(self.COUNT),
            self.traits.bounds,
            mi.Float(0.01),
            self.COUNT,
            "all",
            notes,
        )
        brought = []
        for weigh in (weights.weigher(kind, level, vertices, photon_map), None):
            (radiance,) = gather_photons(
                photon_map,
                QueryVertices(self.traits, vertices, [], True),
                [dr.opaque(mi.Float, self.MERGE_RADIUS)],
                1,
                -1,
                weigh=weigh,
            )
            brought.append(dr.mean(radiance))
            dr.eval(brought)  # one by one: kernels that are met again
        self.valid &= brought[1] > 0
        return brought[0] / brought[1]


@pytest.mark.thinned(4, 2, 6)
@pytest.mark.parametrize("beta", [1, 2])
@pytest.mark.parametrize("strategies", [2, 3])
@pytest.mark.parametrize("bsdf", ["diffuse", "rough"])
@pytest.mark.parametrize("light", ["point", "area"])
def test_weights_of_a_path_sum_to_one(rgb, light, bsdf, strategies, beta):
    scene = room(bsdf, light)
    for length in range(1, strategies + 2):
        paths = JointPaths(scene, length)
        weights = HeuristicWeights(
            paths.lights, dr.opaque(mi.Float, 20), dr.opaque(mi.Float, 0.4), strategies, beta
        )
        stored, left = paths.camera(weights)
        merged = [
            paths.merged(weights, stored, level, "indirect", True)
            for level in range(min(length - 1, strategies))
        ]
        sampled, met = paths.direct(weights, left)
        caustic = [
            paths.merged(weights, stored, level, "indirect", False)
            for level in range(min(length - 1, strategies))
        ]
        caustic.append(paths.merged(weights, stored, length - 1, "caustic", False))
        valid = np.array(paths.valid)
        assert valid.sum() > 100
        merged, caustic = (
            np.array(values).reshape(-1, paths.COUNT)[:, valid] for values in (merged, caustic)
        )
        sampled, met = np.array(sampled[0])[valid], np.array(met[0])[valid]
        assert np.allclose(sampled, met, atol=1e-4)
        if length <= strategies:  # else direct light there is not among the strategies
            assert np.allclose(merged.sum(axis=0) + sampled, 1, atol=1e-4)
            assert np.allclose(caustic.sum(axis=0), 1, atol=1e-4)
        else:
            assert np.allclose(merged.sum(axis=0), 1, atol=1e-4)
        assert (merged >= 0).all() and (length == 1 or merged.mean() > 0.03)


def pdf_of(si, bsdf, arriving, leaving, mode):
    """Density with which a path from direction `arriving` goes on to `leaving` (local directions),
    per projected solid angle."""
    view = mi.SurfaceInteraction3f(si)
    view.wi = mi.Vector3f(arriving)
    return np.array(bsdf.pdf(mi.BSDFContext(mode), view, leaving) / dr.abs(leaving.z))


@pytest.mark.thinned(4, 1, 4)
@pytest.mark.parametrize("beta", [1, 2])
@pytest.mark.parametrize("bsdf", ["diffuse", "rough"])
@pytest.mark.parametrize("light", ["point", "area"])
def test_weights_are_veachs(rgb, light, bsdf, beta):
    """Direct light at the third vertex under three strategies, against ratios of densities made
    here, in units where the disk is 2 / N_F."""
    paths = JointPaths(room(bsdf, light), 3)
    weights = HeuristicWeights(
        paths.lights, dr.opaque(mi.Float, 2), dr.opaque(mi.Float, 1), 3, beta
    )
    stored, left = paths.camera(weights)
    found = [
        *(paths.merged(weights, stored, level, "indirect", True) for level in (0, 1)),
        paths.direct(weights, left)[0][0],
    ]
    (_, _, a, bsdf_a, to_b), (_, _, b, bsdf_b, to_c), (_, _, c, bsdf_c, to_light) = paths.vertices
    camera, importance = mi.TransportMode.Radiance, mi.TransportMode.Importance
    p = [pdf_of(a, bsdf_a, a.wi, to_b.wo, camera), pdf_of(b, bsdf_b, b.wi, to_c.wo, camera)]
    q = [
        pdf_of(b, bsdf_b, to_c.wo, b.wi, importance),
        pdf_of(c, bsdf_c, to_light.wo, c.wi, importance),
    ]
    facing = (
        np.abs(np.array(dr.dot(c.n, paths.light.d)))
        / np.maximum(np.array(paths.light.dist), 1e-6) ** 2
    )
    # Light sub-paths start evenly over the sphere or by the cosine; next-event estimation takes the
    # point, or a point of the area evenly.
    rho = (
        facing / (4 * np.pi)
        if light == "point"
        else facing * np.abs(np.array(dr.dot(paths.light.n, paths.light.d))) / np.pi
    )
    valid = np.array(paths.valid)
    expected = heuristic_weights(
        [q[0][valid] / p[0][valid], (2 * rho * q[1])[valid] / p[1][valid]], beta
    )
    for mine, truth in zip(found, expected):
        assert np.allclose(np.array(mine)[valid], truth, atol=2e-4)


# --- Emitters -----------------------------------------------------------------


@pytest.mark.parametrize(
    "emitter",
    one_of_each_kind(name for name in EMITTERS if name not in ("projector", "directionalarea")),
)
def test_emission_ratio(rgb, emitter):
    """The flux of a light sub-path is what next-event estimation would weigh the same light with,
    over the ratio of their densities."""
    scene = tray("lambertian", emitter)
    guide = (
        EnvironmentGuide(scene, scene.sensors()[0])
        if any(e.flags() & mi.EmitterFlags.Infinite for e in scene.emitters())
        else None
    )
    lights = Lights(scene, guide=guide)
    ray, flux, _, source = lights.sample_emission(
        streams(dr.arange(mi.UInt32, 4096), mi.UInt32(7)), mi.Float(0), []
    )
    si = scene.ray_intersect(ray)
    active = si.is_valid() & (dr.max(flux) > 0)
    ds = dr.copy(source)
    ds.d, ds.dist = -ray.d, dr.norm(ds.p - si.p)
    ratio = lights.emission_over_nee_pdf(si, ds, active)
    delta = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Delta)
    _, sampled = ds.emitter.sample_direction(si, mi.Point2f(0.5), active)
    pdf = lights.pdf_direct(si, ds, active & ~delta)
    seen = scene.ray_intersect(si.spawn_ray(ds.d), active)
    evaluated = seen.emitter(scene).eval(seen, active & ~delta) / pdf
    index = dr.gather(
        mi.UInt32, lights.numbers, dr.reinterpret_array(mi.UInt32, ds.emitter), active
    )
    chosen = lights.nearby.probability(si.p, index) if lights.nearby else mi.Float(1)
    weighed = dr.select(delta, sampled * dr.rcp(chosen), evaluated)
    used = np.array(active) & np.ones(4096, bool)
    assert used.sum() > 500
    expected, found = (
        np.broadcast_to(np.array(dr.mean(x)), 4096)[used] for x in (weighed, flux * ratio)
    )
    assert np.median(expected) > 0
    # Cells of the environment's guide, edges of textures and of cones: rounding decides there, on a
    # few paths.
    assert (np.abs(found - expected) < 3e-3 * expected).mean() > 0.995


# --- Renders ------------------------------------------------------------------

RENDERS = [
    (RGB, "smooth0", "rectangle", 3, 1.0),
    *extended(
        (MONO, "mixed0", "envmap", 2, 2.0),
        (SPECTRAL, "lambertian", "spot", 4, 1.0),
        (RGB, "lambertian", "sphere", 6, 1.5),
    ),
]
MORE_RENDERS = [
    pytest.param(RGB, family, emitter, strategies, beta, marks=pytest.mark.full)
    for strategies, beta in ((2, 1.0), (3, 2.0))
    for family, emitter in (
        ("mixed1", "several"),
        ("rough", "directional"),
        ("smooth2", "textured"),
        ("mixed2", "sunsky"),
    )
]


@pytest.mark.parametrize("variant_name, family, emitter, strategies, beta", RENDERS + MORE_RENDERS)
def test_agrees_with_path(variant_name, family, emitter, strategies, beta):
    mi.set_variant(variant_name)
    agree(
        balance(strategies=strategies, beta=beta),
        path(max_depth=5, rr_depth=50),
        tray(family, emitter),
        block=0.08 if has_delta(family) else 0.05,
        most=600,
    )


def storeys(emitter, pane):
    """Floor and ceiling without ends, a lamp below the ceiling, and a glass pane across: all the
    lamp's light on the floor is caustic."""
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": T().scale(6), "bsdf": diffuse(0.7)},
        "ceiling": {
            "type": "rectangle",
            "to_world": look((0, 0, 2), (0, 0, 0)) @ T().scale(6),
            "bsdf": diffuse(0.8),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": look((0.2, 0, 1.8), (0.2, 0, 0)) @ T().scale(0.6),
            "emitter": {"type": emitter, "radiance": 3.0},
        },
        "sensor": {
            "type": "perspective",
            "fov": 60,
            "to_world": look((0, -1, 1), (0, 0, 0)),
            "film": film(24),
        },
    }
    if pane:
        scene["pane"] = {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 1.3]).scale(6),
            "bsdf": {"type": "thindielectric"},
        }
    return mi.load_dict(scene)


@pytest.mark.long
@pytest.mark.parametrize(
    "emitter, pane, beta", [("area", True, 1.0), *extended(("directionalarea", False, 2.0))]
)
def test_caustic_photons_have_the_weight_of_direct_light(rgb, emitter, pane, beta):
    """Light that next-event estimation cannot make, with photons of their own radius, against
    `ptracer`."""
    scene, depth = storeys(emitter, pane), 7 if pane else 4
    mine = SessionBatches(
        balance(strategies=3, beta=beta, max_depth=depth, photon_count=10000), scene, 2
    )
    mine.session.radii = {"caustic": 0.1, "indirect": 0.06}
    sides = mine, PathBatches(ptracer(max_depth=depth, rr_depth=50), scene, 2, 256)
    assert_same(*collect_until(*sides, whole=0.015, most=600), whole=0.015)


@pytest.mark.parametrize(
    "strategies, beta",
    [
        *extended((2, 1.0)),
        *(pytest.param(*pair, marks=pytest.mark.full) for pair in ((1, 1.0), (3, 2.0))),
    ],
)
def test_agrees_with_one_strategy(rgb, strategies, beta):
    scene = tray("lambertian", "rectangle")
    one = mi.load_dict(
        {
            "type": "bdpm",
            "bdd": 0,
            "initial_radius": RADIUS,
            "max_depth": 5,
            "photon_count": 20000,
            "camera_paths": 8,
        }
    )
    sides = (
        SessionBatches(integrator, scene, 3, seed)
        for seed, integrator in ((2, balance(strategies=strategies, beta=beta)), (3, one))
    )
    assert_same(*collect_until(*sides, whole=0.015, block=0.06, most=600), whole=0.015, block=0.06)


# --- Plugin -------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, value, allowed",
    [
        ("strategies", 0, "from 1 to 6"),
        ("strategies", 7, "from 1 to 6"),
        ("strategies", 2.0, "an integer"),
        ("beta", 0.5, "from 1"),
        ("beta", 9, "from 1"),
        ("beta", "power", "a number"),
        ("bdd", 1, "unknown parameter"),
        ("first_vertex", 0, "unknown parameter"),
    ],
)
def test_bad_parameter(rgb, name, value, allowed):
    with pytest.raises(RuntimeError, match=allowed) as error:
        mi.load_dict({"type": "bdpm_balance", name: value})
    assert "bdpm_balance: " in str(error.value) and f'"{name}"' in str(error.value)


def test_parameters(rgb):
    settings = mi.load_dict({"type": "bdpm_balance"}).settings()
    assert settings["strategies"] == 3 and settings["beta"] == 1 and "bdd" not in settings


def test_darkness_and_no_indirect_light(rgb):
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle"},
        "sensor": {"type": "perspective", "to_world": look((0, 0, 3), (0, 0, 0)), "film": film(8)},
    }
    assert (np.array(mi.render(mi.load_dict(scene), integrator=balance(), spp=8)) == 0).all()
    lit = mi.load_dict({**scene, "light": {"type": "point", "position": [0, 0, 1]}})
    for depth in (0, 1, 2, 3, -1):
        mine, truth = (
            np.array(mi.render(lit, integrator=integrator, spp=64)).mean()
            for integrator in (balance(max_depth=depth), path(max_depth=depth))
        )
        assert mine == pytest.approx(truth, rel=0.02)


def test_same_seed_same_image(rgb):
    scene = tray("mixed1", "rectangle")
    first, second, other = (
        np.array(mi.render(scene, integrator=balance(), spp=16, seed=seed)) for seed in (5, 5, 6)
    )
    assert np.abs(first - second).max() <= 1e-4 * first.max()
    assert np.abs(first - other).max() > 1e-2 * first.max()


def test_radii(rgb):
    """Caustic and indirect photons have their own radii, of which the weights know."""
    session = mi.load_dict({"type": "bdpm_balance", "photon_count": 5000}).session(
        tray("mixed1", "rectangle"), seed=1
    )
    session.iterate()
    assert session.radii["indirect"] > 0 and session.radii["caustic"] > 0
    session.radii = {"indirect": 0.04, "caustic": 0.02}
    session.prepare(None)
    weights = session.weights(session._spectral(0)["merge_settings"])
    assert weights.caustic_share[0] == pytest.approx(4, rel=1e-5)
    assert weights.disk_paths[0] == pytest.approx(np.pi * 0.04**2 * 5000, rel=1e-5)
