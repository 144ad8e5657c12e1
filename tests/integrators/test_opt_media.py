"""The plugins `bdpm_opt`, `bdpm_opt2`, `bdpm_opt3` in participating media: one weight function of
the joint path whichever strategy makes it, renders that are right, less noise than single
strategies, and what is refused.

Comparisons of renders: as in `test_bdpm_media`.
"""

from mis_integrators.photons.kernel_sums import ball_volume
from mis_integrators.photons.points import Points, gather_in_balls
from mis_integrators.photons.queries import STATE
from mis_integrators.photons.volume import (
    build_volume_map,
    new_volume_photons,
    number_of_medium,
    write_volume_photon,
)

import drjit as dr
import medium_sphere
import mitsuba as mi
import numpy as np
import pytest
from comparing import PathBatches, assert_same, collect_until, grey_pictures, in_one_thread
from foggy import PLAIN, volpath
from selection import extended, one_in_each_row
from test_balance_media import COUNT, NEAR, JointPaths, room
from test_bdpm import last_words
from test_bdpm_media import RADIUS, SCENES, SLACK, SmallRadiusBatches
from test_bdpt_media import fog_scene, homogeneous


def opt(strategies=2, **parameters):
    defaults = {"initial_radius": RADIUS, "max_depth": 6, "frozen_photons": 20000}
    defaults |= {"photon_count": 20000, "camera_paths": 16, "mix_diffuse": True}
    return mi.load_dict({"type": "bdpm_opt", "strategies": strategies, **defaults, **parameters})


# --- One weight function ------------------------------------------------------


class SessionWeights:
    """The weights of a session, with the weighers of its gathers."""

    def __init__(self, session):
        self.session = session
        self.weights = session.weights(session._spectral(0)["merge_settings"])

    def __getattr__(self, name):
        return getattr(self.weights, name)

    def weigher(self, kind, level, vertices, photon_map):
        return self.session.weigher(self.weights, kind, level, vertices, photon_map)


class OptimalPaths(JointPaths):
    """The same paths, under optimal weights, whose photons in media are merged in balls."""

    def camera(self, weights):
        """What a camera path stores at each vertex, the weight of direct light there, and the state
        after leaving the last one."""
        state, stored, shares = weights.init(COUNT), [], []
        for number, (_, _, si, scattering, bs) in enumerate(self.vertices):
            vertex = dr.full(mi.UInt32, number, COUNT)
            state, share = weights.propagate(state, si, scattering, vertex, self.valid)
            stored.append(weights.stored(state))
            shares.append(share)
            state = weights.scatter(state, si, scattering, bs, vertex, self.valid)
            dr.eval(state, stored, shares)
        return stored, shares, state

    near = NEAR

    def in_ball(self, weights, stored, share, level, caustic, straight=False):
        """Weight of a photon in the medium, by the code of the gather."""
        ray, _, si, _, _ = self.vertices[level]
        place, power = new_volume_photons(COUNT)
        index = dr.arange(mi.UInt32, COUNT)
        photon = {**self._photon(level), "caustic": mi.Bool(caustic)}
        photon["depth"] = mi.UInt32(1 if straight else 2)
        write_volume_photon(place, power, index, photon, True)
        words = self._words(weights.light_state(), level, not caustic)
        radius = dr.opaque(mi.Float, self.near)
        photon_map = build_volume_map(place, power, mi.UInt32([COUNT]), radius, COUNT, words)
        record = {
            "p": si.p,
            "path": index,
            "d": ray.d,
            "depth": dr.full(mi.UInt32, level + 1, COUNT),
            "throughput": dr.select(self.valid, mi.Spectrum(1), 0),
            "medium": self.medium,
            **dict(zip(STATE, stored)),
            "share": share,
        }
        points = Points.of(self.traits, record, [])
        weigh = weights.session.point_weigher(weights.weights, level, points, record, photon_map)
        found = []
        for each in (weigh, lambda index, landing, scattering, active: mi.Float(1)):
            (radiance,) = gather_in_balls(
                photon_map, points, [radius], 1, -1, each, straight=straight
            )
            dr.eval(radiance)
            found.append(np.array(dr.mean(radiance)))
        self.valid &= mi.Bool(found[1] > 0)
        return found[0] / np.maximum(found[1], 1e-30)


def direct_light(paths, weights, left, share):
    """Weight of next-event estimation at the last vertex."""
    si = paths.vertices[-1][2]
    return np.array(dr.mean(share * weights.next_event_weight(left, si, paths.light, paths.valid)))


def weights_found(paths, weights, strategies, straight):
    """Weights of all strategies that can make the paths, by the code of each: merging at z_0, z_1,
    ..., at the last vertex direct light and in a medium its photon, or a caustic photon."""
    last = len(paths.kinds) - 1
    stored, shares, left = paths.camera(weights)
    found = []
    for level in range(min(last, strategies)):
        if paths.kinds[level] == "M":
            found.append(paths.in_ball(weights, stored[level], shares[level], level, False))
        elif level == strategies - 1:
            found.append(np.array(dr.mean(stored[level][0])))
        else:
            plain = paths._on_surface(weights, stored, level, straight, False)
            weighed = paths._on_surface(weights, stored, level, straight, True)
            paths.valid &= plain > 0
            found.append(np.array(weighed / plain))
    if last < strategies:
        in_ball = (weights, stored[last], shares[last], last)
        if straight:
            found.append(direct_light(paths, weights, left, shares[last]))
            if paths.kinds[last] == "M":
                found.append(paths.in_ball(*in_ball, False, True))
        elif paths.kinds[last] == "S":
            found.append(np.array(dr.mean(shares[last])))
        else:
            found.append(paths.in_ball(*in_ball, True))
    valid = np.array(paths.valid)
    assert valid.sum() > 100
    return np.array([np.broadcast_to(weight, COUNT)[valid] for weight in found])


@pytest.mark.parametrize(
    "kinds, strategies, light, size",
    [
        ("MM", 2, "area", 1.0),
        ("SMM", 3, "point", 1.0),
        ("SMM", 3, "point", 1e3),
        *extended(
            ("MM", 2, "area", 1e3),
            ("MMM", 2, "point", 1.0),
            ("MS", 2, "area", 1.0),
            ("MSM", 3, "area", 1.0),
            ("MMMM", 3, "area", 1.0),
            ("SMS", 3, "point", 1.0),
            ("MMMM", 4, "area", 1.0),
        ),
    ],
)
def test_weights_of_a_path_sum_to_one(rgb, kinds, strategies, light, size):
    """The photon's packed flux and direction round, hence the tolerance. In any unit of length: a
    room in millimetres."""
    scene = room(light, size)
    session = opt(strategies, initial_radius=RADIUS * size).session(scene, seed=1, spp=0)
    session.start()
    assert session.points
    weights = SessionWeights(session)
    for straight in (True, False):
        paths = OptimalPaths(scene, kinds)
        paths.near = NEAR * size
        found = weights_found(paths, weights, strategies, straight)
        assert np.mean(np.abs(found.sum(axis=0) - 1) < 1e-3) > 0.98, found.sum(axis=0)
        assert np.median(np.abs(found), axis=1).min() > 1e-4


# --- Gathers ------------------------------------------------------------------


def test_a_ball_finds_what_brute_force_finds(rgb):
    """Photons at random places of a medium of scattering 0.9: as many, and as much light, as a test
    of all of them against all vertices finds."""
    scene = room("point")
    medium = mi.MediumPtr(scene.sensors()[0].get_medium())
    photons, vertices, radius = 3000, 500, 0.15
    rng = np.random.default_rng(1)
    p = rng.uniform(-0.9, 0.9, (3, photons)).astype(np.float32)
    at = rng.uniform(-0.9, 0.9, (3, vertices)).astype(np.float32)
    flux = rng.uniform(0.5, 2, photons).astype(np.float32)
    place, power = new_volume_photons(photons)
    photon = {
        "p": mi.Point3f(p),
        "towards": mi.Vector3f(0, 0, 1),
        "flux": mi.Spectrum(mi.Float(flux)),
        "depth": mi.UInt32(2),
        "medium": medium,
        "caustic": mi.Bool(False),
    }
    write_volume_photon(place, power, dr.arange(mi.UInt32, photons), photon, True)
    size = dr.opaque(mi.Float, radius)
    photon_map = build_volume_map(place, power, mi.UInt32([photons]), size, photons)
    record = {
        "p": mi.Point3f(at),
        "path": dr.arange(mi.UInt32, vertices),
        "d": mi.Vector3f(0, 0, 1),
        "depth": dr.full(mi.UInt32, 1, vertices),
        "throughput": dr.full(mi.Spectrum, 1, vertices),
        "medium": medium,
    }
    points = Points.of(PLAIN, record, [])
    (light,) = gather_in_balls(photon_map, points, [size], 7, -1, _one)
    near = np.linalg.norm(at[:, :, None] - p[:, None, :], axis=0) < radius
    # Light from +z goes straight on, to a camera whose ray came along +z.
    phase = 0.75 / (4 * np.pi * 0.5**3)
    expected = near @ flux * phase / (0.9 * 4 / 3 * np.pi * radius**3 * 7)
    assert near.sum() > 1000 and (near.sum(axis=1) == 0).any()
    np.testing.assert_allclose(np.array(light)[0], expected, rtol=2e-4)
    assert float(ball_volume(mi.Float(2.0))[0]) == pytest.approx(32 / 3 * np.pi)
    assert int(number_of_medium(medium)[0]) > 0


def _one(index, landing, scattering, active):
    return mi.Float(1)


# --- Renders ------------------------------------------------------------------


class SmallRadius(SmallRadiusBatches):
    """As that, of `bdpm_opt`. What photons have of direct light goes with the number that a ball
    holds, and their bias with that: so there are as many in the smaller ball."""

    def __init__(self, scene, strategies, **parameters):
        self.blocks, self.batches = 2, []
        self.sessions = [
            opt(strategies, initial_radius=radius, photon_count=count, **parameters).session(
                scene, seed=1, spp=0
            )
            for radius, count in ((2 * RADIUS, 5000), (RADIUS, 40000))
        ]


@pytest.mark.parametrize(
    "name, strategies",
    one_in_each_row(sorted(SCENES), (2, 3)),
)
def test_agrees_with_volpath(rgb, name, strategies):
    """The radii are twice those of other tests: a ball of this size has few photons."""
    scene, visible = SCENES[name](), (0.03, 0.09)
    if name in ("sky", "sun"):
        visible = (0.05, 0.15)
    mine = SmallRadius(scene, strategies)
    oracle = PathBatches(volpath(max_depth=6), scene, 2, 512)
    assert_same(*collect_until(mine, oracle, *visible, most=600), *visible, slack=2 * SLACK)


@pytest.mark.long
@pytest.mark.parametrize("variant_name", ["llvm_ad_mono", *extended("llvm_ad_rgb")])
def test_agrees_beyond_the_first_vertex(variant_name):
    """The first strategy is that of the second vertex: direct light at the first is next-event
    estimation's alone."""
    mi.set_variant(variant_name)
    scene = SCENES["pockets"]()
    mine = SmallRadius(scene, 2, first_vertex=1)
    oracle = PathBatches(volpath(max_depth=6), scene, 2, 512)
    assert_same(*collect_until(mine, oracle, 0.03, 0.09, most=600), 0.03, 0.09, slack=2 * SLACK)


def noise_of(integrator, scene, count=40):
    """Relative variance of an iteration: the mean over pixels, and the median."""
    session = integrator.session(scene, seed=5, spp=0)
    images = grey_pictures(session, count)
    variance = images.var(axis=0, ddof=1)
    return variance.mean() / images.mean() ** 2, np.median(variance / images.mean(axis=0) ** 2)


@pytest.mark.extended
def test_less_noise_than_single_strategies(rgb):
    """Merging in balls at the first vertex alone, at the second alone, and at both under optimal
    weights: the mixture has half of the noise of the better one at most (an eighth is seen; most of
    that is next-event estimation's near the lamp), and in the median pixel no more."""
    scene = room("area")
    common = {"initial_radius": 0.3, "camera_paths": 4}
    single = [noise_of(opt(1, first_vertex=first, **common), scene) for first in (0, 1)]
    mixed = noise_of(opt(2, **common), scene)
    assert mixed[0] < 0.5 * min(mean for mean, _ in single)
    assert mixed[1] < 1.1 * min(median for _, median in single)


# A closed sphere full of fog around an empty ball, with the lamp and the camera at the centre.
SPHERE = {"inner": 0.3, "extinction": 1.5, "albedo": 0.9, "wall": 0.7, "intensity": 1.0}
SMALL, LIGHT_PATHS = 0.05, 500


def sphere_full_of_fog():
    """The scene of a `medium_sphere.MediumSphere` with the numbers of `SPHERE`."""
    fog = {"type": "homogeneous", "sigma_t": SPHERE["extinction"], "albedo": SPHERE["albedo"]}
    wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [SPHERE["wall"]] * 3}}
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "fog": fog,
            "room": {
                "type": "sphere",
                "interior": {"type": "ref", "id": "fog"},
                "bsdf": {"type": "twosided", "bsdf": wall},
            },
            "hole": {
                "type": "sphere",
                "radius": SPHERE["inner"],
                "exterior": {"type": "ref", "id": "fog"},
                "bsdf": {"type": "null"},
            },
            "lamp": {"type": "point", "position": [0, 0, 0], "intensity": SPHERE["intensity"]},
            "sensor": {"type": "perspective", "fov": 90, "near_clip": 0.001, "film": film},
        }
    )


@in_one_thread
def variance_in_sphere(iterations, strategies, **parameters):
    """Variance of an iteration's pixel over the squared mean: mean and standard error by blocks of
    the image."""
    integrator = opt(
        strategies,
        initial_radius=SMALL,
        photon_count=LIGHT_PATHS,
        max_depth=4,
        rr_depth=100,
        camera_paths=1,
        direct_paths=1,
        frozen_photons=0,
        variance=True,
        sampler="independent",
        **parameters,
    )
    session = integrator.session(sphere_full_of_fog(), seed=2, spp=0)
    for _ in range(iterations):
        session.iterate()
    image = session.image()
    noise = image[..., -3:].mean(-1).reshape(4, 6, 4, 6).mean(axis=(1, 3)) * iterations
    noise /= image[..., :3].mean() ** 2
    return float(noise.mean()), float(noise.std(ddof=1) / 4)


@pytest.mark.long
def test_least_noise_in_a_sphere_full_of_fog(rgb):
    """Balls in the fog and disks on the wall, against quadrature. The noise of merging at z_0 alone
    and at z_1 alone is what the noise functional says, A = V sigma and pi R^2 in it (5 % for what
    of balls lies outside, and three standard errors). Under optimal weights, `local` as they are
    in media, it is not below the least, and at most 10 % above. (False-alarm rate below 1 %.)"""
    world = medium_sphere.MediumSphere(**SPHERE)
    first, second, least = world.variances(SMALL, LIGHT_PATHS)
    assert least < 0.75 * min(first, second)
    for expected, vertex in ((first, 0), (second, 1)):
        measured, error = variance_in_sphere(400, 1, first_vertex=vertex)
        assert abs(measured - expected) < 0.05 * expected + 3 * error, (measured / expected, error)
    measured, error = variance_in_sphere(400, 2)
    assert 0.97 * least - 3 * error < measured < 1.1 * least + 3 * error, (measured / least, error)


def test_diffuse_scenes_are_those_of_bdpm(rgb):
    """Nothing but Lambertian surfaces in the fog, and no `mix_diffuse`: the photons are gathered
    along beams, and the image is that of `bdpm`."""
    scene = fog_scene(homogeneous())
    images = []
    for plugin in ({"type": "bdpm_opt2"}, {"type": "bdpm", "bdd": 0, "pass_narrow": False}):
        integrator = mi.load_dict({**plugin, "initial_radius": 0.1, "max_depth": 4})
        images.append(np.array(mi.render(scene, integrator=integrator, spp=4, seed=2)))
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    "parameters, words",
    [
        ({"weights": "full"}, '"weights" = full'),
        ({"weights": "published"}, '"weights" = published'),
    ],
)
def test_what_media_do_not_have_is_refused(rgb, parameters, words):
    with pytest.raises(Exception) as error:
        mi.render(fog_scene(homogeneous()), integrator=opt(**parameters), spp=2)
    assert f"parameter {words} is not supported in scenes with" in last_words(error.value)
