"""Optimal weights where they meet transport: one weight function for all strategies, unbiased
renders, less noise.

Comparisons with `path`: as in `test_against_path` (false-alarm rate 1e-6 each; an error of 1 % in
the image and of 3 or 8 % in a block is seen with a probability of 0.95).
"""

from mis_integrators.mis.optimal import OptimalWeights

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    PathBatches,
    SessionBatches,
    agree,
    assert_powerful,
    collect_until,
    differences,
    in_one_thread,
    t_quantile,
)
from selection import extended
from test_against_path import LENS, MONO, ORTHO, PERSPECTIVE, RGB, SPECTRAL, oracle
from worlds import EMITTERS, RADIUS, T, colour, diffuse, has_delta, look, sensor, tray


def weighted(plugin="bdpm_opt", **parameters):
    return mi.load_dict(
        {
            "type": plugin,
            "initial_radius": RADIUS,
            "max_depth": 5,
            "photon_count": 20000,
            "camera_paths": 8,
            "frozen_photons": 40000,
            **parameters,
        }
    )


# --- One weight function ------------------------------------------------------


class JointPaths:
    """Random paths through the smooth vertices of a scene, the first seen by the camera, with the
    weights that each strategy's own code gives them. All arrays have the width of the number of
    paths; `valid` marks those that have all `length` vertices."""

    def __init__(self, session, length, count=4000):
        scene = session.scene
        rng = mi.PCG32(size=count, initstate=3)
        point = mi.Point2f(rng.next_float32(), rng.next_float32())
        ray, _ = session.sensor.sample_ray(0, 0.5, point, mi.Point2f(0.5))
        self.vertices, self.valid = [], mi.Bool(True)
        for _ in range(length):
            si = scene.ray_intersect(ray)
            bsdf = si.bsdf(ray)
            self.valid &= si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            bs, _ = bsdf.sample(
                mi.BSDFContext(),
                si,
                rng.next_float32(),
                mi.Point2f(rng.next_float32(), rng.next_float32()),
            )
            self.valid &= (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            ray = si.spawn_ray(si.to_world(bs.wo))
            dr.eval(si, bsdf, bs, ray, rng, self.valid)
            self.vertices.append((si, bsdf, bs))

    def camera(self, weights, last):
        """What a camera path stores at each vertex up to the `last`, and its weight of direct light
        there."""
        state, stored, shares = weights.init(dr.width(self.valid)), [], []
        for number, (si, bsdf, bs) in enumerate(self.vertices[: last + 1]):
            vertex = mi.UInt32(number) + dr.zeros(mi.UInt32, dr.width(self.valid))
            state, share = weights.propagate(state, si, bsdf, vertex, self.valid)
            dr.eval(state, share)
            stored.append(weights.stored(state))
            shares.append(share)
            state = weights.scatter(state, si, bsdf, bs, vertex, self.valid)
            dr.eval(state)
        return stored, shares

    def photon(self, weights, merged, first):
        """Notes of the light sub-path that starts to scatter at vertex `first` and whose photon
        lands on vertex `merged`, written and read as a photon's are."""
        light_state = weights.light_state()
        state = light_state.init()
        for si, bsdf, bs in reversed(self.vertices[merged + 1 : first + 1]):
            view = mi.SurfaceInteraction3f(si)
            view.wi = mi.Vector3f(bs.wo)
            state = light_state.scatter(state, view, bsdf, si.wi, self.valid)
            dr.eval(state)
        words = light_state.words(state)
        notes = dr.zeros(mi.UInt32, len(words) * dr.width(self.valid))
        index = dr.arange(mi.UInt32, dr.width(self.valid))
        for offset, word in enumerate(words):
            dr.scatter(
                notes,
                mi.UInt32(word) + dr.zeros(mi.UInt32, dr.width(self.valid)),
                len(words) * index + offset,
            )
        dr.eval(notes)
        return light_state.read(merged, notes, index, mi.Bool(True))


KINDS = ("local", 2), ("local", 4), ("full", 3)
TRAYS = [
    (RGB, "lambertian", "point", True),
    (RGB, "rough", "rectangle", False),
    (MONO, "mixed0", "envmap", False),
    (SPECTRAL, "smooth1", "spot", True),
]
"""Variant, family, emitter, and whether diffuse surfaces mix."""
USUAL = (1, 2), (2, 1)
"""Pairs of them that are not `extended`."""


def mark_of(tray, kind):
    if (tray, kind) in USUAL:
        return []
    return pytest.mark.full if (tray + kind) % 3 else pytest.mark.extended


@pytest.mark.long
@pytest.mark.parametrize(
    "variant_name, family, emitter, mix, kind, strategies",
    [
        pytest.param(*tray, *kind, marks=mark_of(i, j))
        for i, tray in enumerate(TRAYS)
        for j, kind in enumerate(KINDS)
    ],
)
def test_weights_of_a_path_sum_to_one(variant_name, family, emitter, mix, kind, strategies):
    mi.set_variant(variant_name)
    session = weighted(strategies=strategies, weights=kind, mix_diffuse=mix).session(
        tray(family, emitter), seed=1
    )
    session.start()
    weights = session.weights(session._spectral(0)["merge_settings"])
    paths = JointPaths(session, strategies + 1)
    stored, shares = paths.camera(weights, strategies - 1)
    valid = np.array(paths.valid)
    assert valid.sum() > 50
    largest = 0.0
    for length in range(
        2, strategies + 2
    ):  # direct light at vertex length - 1; one more: a longer path
        last = min(length, strategies) - 1
        total, goes_on = mi.Spectrum(0), mi.Bool(paths.valid)
        for merged in range(last):
            si, bsdf, bs = paths.vertices[merged]
            f, p = weights.scattering(si, bsdf, bs.wo, paths.valid)
            dr.eval(f, p)
            weight = weights.merge_weight(
                merged, stored[merged], f, p, paths.photon(weights, merged, length - 1)
            )
            dr.eval(weight)
            largest = max(largest, np.abs(np.array(weight)[:, valid]).max())
            ends = goes_on & weights.ends(bsdf, mi.UInt32(merged), paths.valid)
            total += dr.select(ends, stored[merged][0], dr.select(goes_on, weight, 0))
            goes_on &= ~ends
        total += dr.select(goes_on, shares[last] if last == length - 1 else stored[last][0], 0)
        total = np.array(total)[:, valid]
        assert np.isfinite(total).all()
        assert np.abs(total - 1).max() < 1e-4 * (1 + largest)
    assert largest > 0.02  # else the merging strategies have not been tested


def test_a_direction_that_the_camera_never_takes_is_left_to_the_photons(rgb):
    """Where the camera path's density is zero, deeper strategies have no weight, whatever the cache
    says."""
    session = weighted(strategies=3, mix_diffuse=True).session(tray("lambertian", "point"), seed=1)
    session.start()
    weights = session.weights(session._spectral(0)["merge_settings"])
    paths = JointPaths(session, 3)
    stored, _ = paths.camera(weights, 0)
    weight = weights.merge_weight(
        0, stored[0], mi.Spectrum(0.3), mi.Float(0), paths.photon(weights, 0, 2)
    )
    assert np.allclose(np.array(weight), 1)


# --- Means --------------------------------------------------------------------

# emitter, family, parameters, sensor, variant, filter
ROWS = [
    ("rectangle", "mixed0", {"strategies": 2}, PERSPECTIVE, RGB, "box"),
    ("sphere", "mixed1", {"strategies": 2}, LENS, RGB, "box"),
    ("disk", "mixed2", {"strategies": 2, "weights": "full"}, ORTHO, MONO, "tent"),
    ("cylinder", "smooth0", {"strategies": 3, "weights": "full"}, PERSPECTIVE, MONO, "box"),
    ("cube", "lambertian", {"strategies": 4, "mix_diffuse": True}, ORTHO, MONO, "gaussian"),
    ("textured", "smooth2", {"strategies": 2}, PERSPECTIVE, RGB, "box"),
    ("constant", "lambertian", {"strategies": 3, "mix_diffuse": True}, ORTHO, SPECTRAL, "box"),
    ("envmap", "smooth1", {"strategies": 2}, PERSPECTIVE, MONO, "mitchell"),
    ("envmap rotated", "mixed2", {"strategies": 2}, LENS, RGB, "box"),
    (
        "sunsky",
        "lambertian",
        {"strategies": 3, "weights": "full", "mix_diffuse": True},
        LENS,
        RGB,
        "box",
    ),
    ("wide sun", "lambertian", {"strategies": 3, "mix_diffuse": True}, ORTHO, MONO, "box"),
    ("several", "smooth1", {"strategies": 3, "mix_diffuse": True}, PERSPECTIVE, RGB, "box"),
    ("point", "smooth0", {"strategies": 2}, LENS, MONO, "box"),
    (
        "spot",
        "lambertian",
        {"strategies": 2, "first_vertex": 1, "mix_diffuse": True},
        ORTHO,
        SPECTRAL,
        "box",
    ),
    ("directional", "smooth2", {"strategies": 3}, PERSPECTIVE, RGB, "catmullrom"),
    ("projector", "lambertian", {"strategies": 2, "mix_diffuse": True}, PERSPECTIVE, RGB, "box"),
    (
        "directionalarea",
        "lambertian",
        {"strategies": 2, "mix_diffuse": True},
        PERSPECTIVE,
        RGB,
        "box",
    ),
]


SLOW = ("sphere", "disk", "cube", "envmap rotated", "several", "sunsky", "point")
BY_DEFAULT = ("rectangle",)
MARKS = {
    **{emitter: [pytest.mark.extended] for emitter in EMITTERS if emitter not in BY_DEFAULT},
    **{emitter: [pytest.mark.full] for emitter in SLOW},
}


@pytest.mark.parametrize(
    "emitter, family, parameters, sensor, variant_name, rfilter",
    [pytest.param(*row, marks=MARKS.get(row[0], [])) for row in ROWS],
    ids=[f"{e}-{f}-{'-'.join(map(str, p.values()))}".replace(" ", "_") for e, f, p, *_ in ROWS],
)
def test_agrees(emitter, family, parameters, sensor, variant_name, rfilter):
    mi.set_variant(variant_name)
    agree(
        weighted(**parameters),
        oracle(emitter, 5),
        tray(family, emitter, sensor, rfilter=rfilter),
        block=0.08 if has_delta(family) or family == "smooth0" else 0.03,
        most=600,
    )


def test_rows_cover_all_emitters():
    assert {row[0] for row in ROWS} == set(EMITTERS)


def test_one_strategy_is_bdpm(rgb):
    """With one strategy there is nothing to weigh: the same samples, the same image."""
    scene = tray("mixed1", "rectangle")
    one = mi.render(scene, integrator=weighted(strategies=1), spp=16, seed=4)
    plain = mi.render(
        scene,
        integrator=mi.load_dict(
            {
                "type": "bdpm",
                "bdd": 0,
                "pass_narrow": False,
                "initial_radius": RADIUS,
                "max_depth": 5,
                "photon_count": 20000,
                "camera_paths": 8,
            }
        ),
        spp=16,
        seed=4,
    )
    assert np.abs(np.array(one) - np.array(plain)).max() < 2e-4 * np.array(plain).max()


# --- Noise --------------------------------------------------------------------


@in_one_thread
def variances(scene, integrator, iterations=48, trimmed=1e-3):
    """Mean variance of an iteration's pixels, relative to the squared image, with its standard
    error over groups of pixels; the noisiest pixels are left out."""
    session = integrator.session(scene, seed=11)
    for _ in range(iterations):
        session.iterate()
    image = session.image()
    colour, variance = image[..., :3].mean(-1), image[..., -3:].mean(-1) * iterations
    relative = (variance / (colour**2 + 0.01)).ravel()
    groups = np.random.default_rng(1).permutation(
        np.sort(relative)[: int(len(relative) * (1 - trimmed))]
    )
    groups = np.array([g.mean() for g in np.array_split(groups, 16)])
    return groups.mean(), groups.std(ddof=1) / 4


def glossy_room(alpha=0.12, albedo=0.6, size=1.0, **entries):
    """A room of edge 2 times `size`, open towards the camera, with a metal floor of roughness
    `alpha` and a point light."""
    T, S = mi.ScalarTransform4f, mi.ScalarTransform4f().scale(size)
    wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}}
    metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": alpha}}
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": S, "bsdf": metal},
            "ceiling": {
                "type": "rectangle",
                "to_world": S @ T().translate([0, 0, 2]).rotate([1, 0, 0], 180),
                "bsdf": wall,
            },
            "back": {
                "type": "rectangle",
                "to_world": S @ T().translate([0, 1, 1]).rotate([1, 0, 0], 90),
                "bsdf": wall,
            },
            "left": {
                "type": "rectangle",
                "to_world": S @ T().translate([-1, 0, 1]).rotate([0, 1, 0], 90),
                "bsdf": wall,
            },
            "right": {
                "type": "rectangle",
                "to_world": S @ T().translate([1, 0, 1]).rotate([0, 1, 0], -90),
                "bsdf": wall,
            },
            "light": {
                "type": "point",
                "position": [0.2 * size, -0.2 * size, 1.7 * size],
                "intensity": 3.0 * size**2,
            },
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "near_clip": 0.01 * size,
                "far_clip": 100 * size,
                "to_world": T().look_at(
                    [0, -2.6 * size, 1.2 * size], [0, 0, 0.6 * size], [0, 0, 1]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": 48,
                    "height": 48,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
            },
            **entries,
        }
    )


@pytest.mark.extended
def test_weights_lower_the_noise(rgb):
    """Under optimal weights a glossy room is less noisy than by the better of its two strategies,
    beyond the error of the measurement (one-sided, false-alarm rate 1e-3)."""
    scene = glossy_room()
    common = {"initial_radius": 0.06, "photon_count": 8000, "variance": True, "max_depth": 8}
    strategies = ({"type": "bdpm", "bdd": bdd, "pass_narrow": False, **common} for bdd in (0, 1))
    single = [variances(scene, mi.load_dict(strategy)) for strategy in strategies]
    best, error = min(single)
    for kind in ("local", "full"):
        mixed, mixed_error = variances(
            scene, mi.load_dict({"type": "bdpm_opt2", "weights": kind, **common})
        )
        assert mixed + t_quantile(2e-3, 15) * np.hypot(error, mixed_error) < best, (
            kind,
            mixed,
            single,
        )


@pytest.mark.extended
@in_one_thread
def test_noise_law(rgb):
    """Variance of an iteration = X / (N_F N_B) + B / N_B + (1 - 1 / N_B) F / N_F (Ershov et al.
    2019: cross, camera and light noise): fitted to three pairs (N_B, N_F), it predicts three others
    within 12 % (three standard deviations of a prediction: false-alarm rate below 1 %)."""
    scene = glossy_room()

    def law(n_b, n_f):
        return np.array([1e3 / (n_f * n_b), 1 / n_b, 1e3 * (1 - 1 / n_b) / n_f])

    def measured(n_b, n_f):
        integrator = mi.load_dict(
            {
                "type": "bdpm",
                "bdd": 1,
                "initial_radius": 0.06,
                "photon_count": n_f,
                "camera_paths": n_b,
                "variance": True,
                "max_depth": 8,
                "sampler": "independent",
                "direct_paths": 1,
            }
        )
        session = integrator.session(scene, seed=n_b + n_f)
        for _ in range(96):
            session.iterate()
        return session.image()[..., -3:].mean() * session.iterations

    fitted, others = [(1, 1000), (1, 30000), (8, 1000)], [(1, 4000), (4, 1000), (8, 8000)]
    terms = np.linalg.solve(
        np.array([law(*pair) for pair in fitted]), np.array([measured(*pair) for pair in fitted])
    )
    for pair in others:
        assert abs(measured(*pair) / (law(*pair) @ terms) - 1) < 0.12, (pair, terms)


# A closed white sphere lit from its middle: everything is even, so the noise of any weights is
# known. With `max_depth` 4 and two strategies, a path of three segments is a photon of two at z0 or
# direct light at z1, which has no noise; one of four is a photon of three at z0 or of two at z1,
# equally noisy. Best is no weight for the former's photon, and half for each of the latter's.
SPHERE = {"albedo": 0.95, "intensity": 2.0, "radius": 0.1, "light_paths": 4000}


def noise_in_sphere(direct_weight, final_weight):
    """Variance of an iteration's pixel where direct light at z1 has the first weight, and photons
    there have the second."""
    share = SPHERE["radius"] ** 2 / 4  # of the sphere in a merge disk (exactly, also on a sphere)
    rho, flux = SPHERE["albedo"], 4 * np.pi * SPHERE["intensity"]
    photon = rho / np.pi * flux / (np.pi * SPHERE["radius"] ** 2)  # of one segment
    squares = ((1 - direct_weight) * rho) ** 2 + (
        (1 - final_weight) ** 2 + final_weight**2
    ) * rho**4
    return share / SPHERE["light_paths"] * photon**2 * squares


@in_one_thread
def measured_in_sphere(iterations):
    """The same of the weights as they are: mean, and standard error over blocks of the image."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "room": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": [SPHERE["albedo"]] * 3},
                },
            },
            "light": {"type": "point", "position": [0, 0, 0], "intensity": SPHERE["intensity"]},
            "sensor": {
                "type": "perspective",
                "fov": 90,
                "to_world": mi.ScalarTransform4f().look_at([0.3, 0, 0.1], [0, 1, 0], [0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": 24,
                    "height": 24,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
            },
        }
    )
    integrator = mi.load_dict(
        {
            "type": "bdpm_opt2",
            "weights": "full",
            "mix_diffuse": True,
            "max_depth": 4,
            "rr_depth": 100,
            "initial_radius": SPHERE["radius"],
            "photon_count": SPHERE["light_paths"],
            "variance": True,
            "sampler": "independent",
        }
    )
    session = integrator.session(scene, seed=1)
    for _ in range(iterations):
        session.iterate()
    noise = session.image()[..., -3:].mean(-1).reshape(4, 6, 4, 6).mean(axis=(1, 3)) * iterations
    return float(noise.mean()), float(noise.std(ddof=1) / 4)


def test_predicted_optimum(rgb):
    """Full weights come within 10 % of the least noise that theory allows (and not below it by more
    than the error of the measurement)."""
    least = noise_in_sphere(1, 0.5)
    measured, error = measured_in_sphere(300)
    assert error < 0.03 * least
    assert least - 4 * error < measured < 1.1 * least + 2 * error, (measured / least, error / least)


@pytest.mark.parametrize(
    "number",
    [*extended(0), *(pytest.param(n, marks=pytest.mark.full) for n in range(1, 20))],
)
def test_other_weights_are_worse(rgb, monkeypatch, number):
    """Weights that differ from the optimal ones by 20 % (RMS over the two kinds of paths, in a
    random direction) are noisier by more than the error of the measurement (4 standard deviations),
    and by as much as the closed form says (the noise of our own weights aside)."""
    angle = 2 * np.pi * np.random.default_rng(5).random(20)[number]
    steps = 0.2 * 2**0.5 * np.cos(angle), 0.2 * 2**0.5 * np.sin(angle)
    direct, final = OptimalWeights.direct_weight, OptimalWeights.final_weight
    monkeypatch.setattr(
        OptimalWeights,
        "direct_weight",
        staticmethod(lambda *args: direct(*args) + dr.opaque(mi.Float, steps[0])),
    )
    monkeypatch.setattr(
        OptimalWeights,
        "final_weight",
        staticmethod(lambda *args: final(*args) + dr.opaque(mi.Float, steps[1])),
    )
    measured, error = measured_in_sphere(150)
    least = noise_in_sphere(1, 0.5)
    assert measured - 4 * error > 1.06 * least, (measured / least, error / least)
    assert measured == pytest.approx(noise_in_sphere(1 + steps[0], 0.5 + steps[1]), rel=0.15)


# --- Where weights could fail -------------------------------------------------

LAMP_AT_A_WALL = {"type": "point", "position": [-0.98, 0.5, 1.0], "intensity": 1e-6}

# name -> (room, parameters)
HARD = {
    "tiny room": ({"size": 1e-3}, {"initial_radius": 2e-5}),
    "huge room": ({"size": 1e4}, {"initial_radius": 200.0}),
    "hardly a photon": ({}, {"photon_count": 60}),
    "many photons a disk": ({}, {"photon_count": 60000, "initial_radius": 0.06}),
    "radius far below": ({}, {"initial_radius": 2e-3}),
    "nearly a mirror": ({"alpha": 0.002}, {}),
    "as rough as can be": ({"alpha": 1.0}, {}),
    "black walls": ({"albedo": 0.0}, {}),
    "white walls": ({"albedo": 0.99}, {}),
    "lamps a million apart": ({"dim": LAMP_AT_A_WALL}, {}),
    "nothing known": ({}, {"frozen_photons": 1}),
}


@pytest.mark.thinned(2, 2, 12)
@pytest.mark.parametrize(
    "plugin",
    [{"type": "bdpm_opt3"}, {"type": "bdpm_opt", "weights": "full", "mix_diffuse": True}],
    ids=["default", "full"],
)
@pytest.mark.parametrize("case", HARD)
def test_mean_survives(rgb, case, plugin):
    """No light is lost or made, and every pixel is a number: the mean image is that of `path`, up
    to 4 % for the blur of the merge disk (false-alarm rate 1e-6 beyond that; an error of 10 % is
    seen with a probability of 0.95, and one of 16 % where the floor is nearly a mirror: there
    `path` is noisy)."""
    room, parameters = HARD[case]
    scene = glossy_room(**room)
    common = {
        "initial_radius": 0.02,
        "photon_count": 4000,
        "max_depth": 7,
        "frozen_photons": 20000,
        **parameters,
    }
    power = 0.12 if case == "nearly a mirror" else 0.06
    mine = SessionBatches(mi.load_dict({**plugin, **common}), scene, 1, seed=1)
    reference = PathBatches(mi.load_dict({"type": "path", "max_depth": 7}), scene, 1)
    a, b = collect_until(mine, reference, power, power, most=800)
    assert b.mean[0].max() > 0
    assert not differences(a, b, slack=0.04)
    assert_powerful(a, b, power, power)


# --- Plugins ------------------------------------------------------------------


@pytest.mark.parametrize("plugin, strategies", [("bdpm_opt2", 2), ("bdpm_opt3", 3)])
def test_presets_fix_the_number_of_strategies(rgb, plugin, strategies):
    assert mi.load_dict({"type": plugin}).settings()["strategies"] == strategies
    with pytest.raises(RuntimeError, match='unknown parameter "strategies"'):
        mi.load_dict({"type": plugin, "strategies": 2})


@pytest.mark.long
def test_what_the_cache_knows_of_direct_light():
    """Cells that a lamp shines upon know it, and so do their surroundings; in spectral variants no
    less than in rgb."""
    facts = []
    for variant_name in (RGB, SPECTRAL):
        mi.set_variant(variant_name)
        lamp = {
            "type": "rectangle",
            "to_world": look((0, 0, 3), (0, 0, 0)) @ T().scale(0.8),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 4.0}},
        }
        floor = {
            "type": "rectangle",
            "to_world": T().scale(2.5),
            "bsdf": {"type": "diffuse", "reflectance": colour(0.7, 0.7, 0.7)},
        }
        scene = mi.load_dict(
            {
                "type": "scene",
                "lamp": lamp,
                "floor": floor,
                "ball": {
                    "type": "sphere",
                    "center": [0, 0, 1],
                    "radius": 0.5,
                    "bsdf": {"type": "roughconductor", "alpha": 0.2},
                },
                "sensor": sensor(size=16),
            }
        )
        session = mi.load_dict(
            {
                "type": "bdpm_opt2",
                "weights": "full",
                "initial_radius": 0.05,
                "frozen_photons": 20000,
            }
        ).session(scene)
        session.start()
        known = session.cache.lookup(session.cache.center, session.cache.facing)
        facts.append(
            [
                np.median(np.array(known.noise)),
                (np.array(known.visible_share) > 0).mean(),
                float(session.neighbour_radiance.albedo[0]),
            ]
        )
    assert facts[0][0] < 5 and facts[0][1] > 0.5
    np.testing.assert_allclose(facts[1], facts[0], rtol=0.1)


def test_the_strongest_of_many_lights_is_known(rgb):
    """However many lights stand before it in the scene."""
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": T().scale(2.5), "bsdf": diffuse(0.7)},
        "sensor": sensor(size=16),
    }
    for number in range(70):
        scene[f"dim{number:02d}"] = {"type": "point", "position": [0, 0, 2], "intensity": 1e-4}
    scene["strong"] = {"type": "point", "position": [0, 0, 2], "intensity": 10.0}
    session = mi.load_dict(
        {"type": "bdpm_opt2", "mix_diffuse": True, "weights": "full", "frozen_photons": 20000}
    ).session(mi.load_dict(scene), seed=1)
    session.start()
    known = session.cache.lookup(session.cache.center, session.cache.facing)
    lit = np.array(known.visible_share) > 0
    strong = int(np.argmax(session.lights.choice.pmf))
    assert lit.sum() > 10 and strong >= 64 and np.all(np.array(known.light)[lit] == strong)


@pytest.mark.parametrize("given", [True, False])
def test_diffuse_surfaces_mix_where_asked(rgb, given):
    session = mi.load_dict({"type": "bdpm_opt2", "mix_diffuse": given}).session(
        tray("lambertian", "rectangle"), seed=1
    )
    assert session.settings["mix_diffuse"] is given and bool(session.mixes()) is given
    assert (session.cache is not None) is given  # the frozen pass


@pytest.mark.parametrize(
    "name, value, allowed",
    [
        ("strategies", 0, "from 1 to 6"),
        ("strategies", 2.0, "an integer"),
        ("weights", "best", '"full" or "local" or "published"'),
        ("first_vertex", -1, "from 0 to 16"),
        ("frozen_photons", -1, "at least 0"),
        ("bdd", 1, "unknown parameter"),
    ],
)
def test_bad_parameter(rgb, name, value, allowed):
    with pytest.raises(RuntimeError, match=allowed):
        mi.load_dict({"type": "bdpm_opt", name: value})


@pytest.mark.parametrize("kind", ["full", *extended("local")])
def test_darkness_and_no_indirect_light(rgb, kind):
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle"},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        },
    }
    image = mi.render(
        mi.load_dict(scene), integrator=mi.load_dict({"type": "bdpm_opt", "weights": kind}), spp=2
    )
    assert (np.array(image)[..., :3] == 0).all()
    lit = mi.load_dict({**scene, "light": {"type": "point", "position": [0, 0, 1]}})
    for depth in (1, 2, 3):
        mine = mi.render(
            lit,
            integrator=mi.load_dict({"type": "bdpm_opt", "weights": kind, "max_depth": depth}),
            spp=64,
        )
        truth = mi.render(
            lit, integrator=mi.load_dict({"type": "path", "max_depth": depth}), spp=64
        )
        assert np.allclose(
            np.array(mine)[..., :3].mean(), np.array(truth)[..., :3].mean(), rtol=0.02
        )


@pytest.mark.parametrize(
    "parameters",
    [
        {"initial_radius": 0.05, "mix_diffuse": True, "weights": "full"},
        *extended({}, {"initial_radius": 0.05}),
    ],
)
def test_light_that_meets_nothing_smooth(rgb, parameters):
    """A sky and glass, and rough metal out of its reach: nothing is learned, nothing is mixed, and
    what is seen is right."""
    hidden = {"type": "sphere", "center": [0, 0, 9], "radius": 0.5}
    scene = mi.load_dict(
        {
            "type": "scene",
            "glass": {"type": "sphere", "bsdf": {"type": "dielectric"}},
            "sensor": sensor(size=16),
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}},
            "box": {**hidden, "bsdf": {"type": "conductor"}},
            "metal": {**hidden, "radius": 0.4, "bsdf": {"type": "roughconductor", "alpha": 0.2}},
        }
    )
    images = [
        np.array(
            mi.render(
                scene, integrator=mi.load_dict({"type": plugin, "max_depth": 6, **extra}), spp=64
            )
        )
        for plugin, extra in (("bdpm_opt3", parameters), ("path", {}))
    ]
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=0.02) and images[1].mean() > 0.01


def test_same_seed_same_image(rgb):
    scene = tray("smooth1", "point")
    first, second, other = (
        np.array(
            mi.render(scene, integrator=weighted(strategies=2, weights="local"), spp=16, seed=seed)
        )
        for seed in (5, 5, 6)
    )
    assert np.abs(first - second).max() <= 1e-4 * first.max()
    assert np.abs(first - other).max() > 1e-2 * first.max()


def test_automatic_radius(rgb):
    """The noise of a long render lets a smaller radius be the best: of a thousand times the
    iterations, about a third."""
    scene, radii = tray("smooth1", "rectangle"), []
    for spp in (4, 4000):
        session = mi.load_dict({"type": "bdpm_opt2"}).session(scene, seed=1, spp=spp)
        session.start()
        radii.append(session.radii["indirect"])
    assert 0.02 < radii[1] < 0.6 * radii[0] < 0.2
