"""`bdpm_opt` under the weights as they are printed: one weight function for all strategies, right
means, and the least noise that one weight for direct light and photons allows."""

from mis_integrators.app.loading import knows_of_denoisers
from mis_integrators.mis import published_optimal as published
from mis_integrators.photons.queries import LAST_VERTEX

import drjit as dr
import glossy_sphere
import mitsuba as mi
import numpy as np
import pytest
from comparing import agree, in_one_thread
from selection import extended
from test_against_path import MONO, PERSPECTIVE, RGB, SPECTRAL, oracle
from test_weights_in_renders import SPHERE, JointPaths, weighted
from worlds import tray

# --- One weight function ------------------------------------------------------


class JointChains(JointPaths):
    """Random paths with what each strategy's own code is given of them: records of their vertices,
    seen from the camera's side by its rays and from the light's by rays of its own."""

    def ray_to(self, number):
        """The ray of the camera path that leads to a vertex."""
        si, _, _ = self.vertices[number]
        return mi.Ray3f(si.p + si.to_world(si.wi) * si.t, -si.to_world(si.wi))

    def record(self, scene, number, length=None):
        """A record of `query_layout`: the vertex met by a ray from the vertex before, as long as
        the segment, or of the given length."""
        ray = self.ray_to(number)
        if length is not None:
            ray.o = self.vertices[number][0].p - length * ray.d
        hit = scene.ray_intersect_preliminary(ray)
        return {
            "ray_o": ray.o,
            "ray_d": ray.d,
            "hit": hit,
            "throughput": dr.select(self.valid & hit.is_valid(), mi.Spectrum(1), 0),
            "path": dr.arange(mi.UInt32, dr.width(self.valid)),
            "depth": mi.UInt32(LAST_VERTEX) + dr.zeros(mi.UInt32, dr.width(self.valid)),
        }

    def f_and_p(self, number):
        si, bsdf, bs = self.vertices[number]
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo, self.valid)
        scale = 1 / dr.maximum(dr.abs(bs.wo.z), 1e-6)
        return dr.mean(value) * scale, pdf * scale


class Photon:
    """A meeting with a photon that has come along the path (as `photons.pairs.Meeting`)."""

    def __init__(self, paths, number):
        self.f, self.p = paths.f_and_p(number)
        self.lit = paths.valid
        self.flux, self.cosines = mi.Spectrum(1), mi.Float(1)


class Chain:
    """Where such photons come from (as `photons.chains.PhotonChains`): photon i of `paths` has
    passed the vertex of path i with a number, and where it is `long` the next one, whose photon's
    place is i + the number of paths."""

    def __init__(self, scene, paths, number, long):
        self.scene, self.paths, self.number, self.long = scene, paths, number, long
        self.count = dr.width(paths.valid)

    def record(self, place, active):
        # From the middle of the segment: another ray than the camera path's.
        length = 0.5 * self.paths.vertices[self.number][0].t
        return self.paths.record(self.scene, self.number, length)

    def link(self, place, active):
        f, p = self.paths.f_and_p(self.number)
        before = dr.select(self.long, place + self.count, mi.UInt32(published.NONE))
        return {"before": before, "f": f, "p": p}


def known_light(theory, scene, paths, number, strategies):
    """Records of `light_layout` of the vertices with a number, and after them the next ones."""
    frozen, parts = theory.frozen, []
    for which in (number, number + 1):
        length = 0.5 * paths.vertices[which][0].t
        vertices = frozen.vertices(paths.record(scene, which, length))
        L0, L, b = frozen.light_at(vertices, strategies - 1)
        if strategies > 2:
            L0, _, _ = frozen.light_at(vertices, 1)
        parts.append([np.array(x) for x in (L0, L, b)])
    values = [mi.Float(np.concatenate(pair)) for pair in zip(*parts)]
    words = published.light_layout().room(dr.width(values[0]))
    index = dr.arange(mi.UInt32, dr.width(values[0]))
    published.light_layout().write(words, dict(zip(("L0", "L", "b"), values)), index)
    dr.eval(words)
    return words


def begun(scene, **parameters):
    session = weighted(weights="published", **parameters).session(scene, seed=1)
    session.start()
    session._learn()
    return session


def paths_of(session, length):
    paths = JointChains(session, length, count=1000)
    return paths, dr.arange(mi.UInt32, 1000)


def assert_sums_to_one(total, weights, valid):
    total, valid = np.array(total), np.array(valid)
    total = total[valid]
    largest = np.max([np.abs(np.array(weight))[valid] for weight in weights], axis=0)
    assert valid.sum() > 50 and np.median(largest) > 0.02
    assert np.isfinite(total).all()
    # Roundings of weights that may be far larger than one. The ray from the light's side meets the
    # vertex a rounding away, where a photon at the edge of the disk may count or not.
    wrong = np.abs(total - 1) > 1e-3 * (1 + largest)
    assert wrong.mean() < 0.02, (wrong.mean(), np.quantile(np.abs(total - 1), [0.5, 0.9, 0.98]))


@pytest.mark.parametrize(
    "variant_name, family, emitter, first",
    [
        (RGB, "rough", "rectangle", 0),
        *extended((MONO, "lambertian", "point", 1), (SPECTRAL, "smooth1", "spot", 0)),
    ],
)
def test_two_weights_of_a_path_sum_to_one(variant_name, family, emitter, first):
    """w0 as the light's side has it and w1 as the camera's side has it."""
    mi.set_variant(variant_name)
    scene = tray(family, emitter)
    with dr.suspend_grad():
        session = begun(scene, strategies=2, first_vertex=first)
        theory = session.theory(session.radii_at(0)["indirect"])
        paths, place = paths_of(session, first + 3)
        root = theory.roots(paths.record(scene, first))
        light = known_light(theory, scene, paths, first + 1, 2)
        chain = Chain(scene, paths, first + 1, mi.Bool(False))
        w0 = theory.of_photons(Photon(paths, first), chain, light, place, root)
        f, p = paths.f_and_p(first)
        w1 = theory.of_last(paths.record(scene, first + 1), {"f": f, "p": p}, root)
        assert_sums_to_one(w0 + w1, (w0, w1), paths.valid)


@pytest.mark.long
@pytest.mark.parametrize(
    "variant_name, family, emitter",
    [(RGB, "rough", "rectangle"), *extended((SPECTRAL, "lambertian", "point"))],
)
def test_three_weights_of_a_path_sum_to_one(variant_name, family, emitter):
    """w20 of the light's side and w21 of the camera's; w30 and w31 of the light's, w32 of the
    camera's."""
    mi.set_variant(variant_name)
    scene = tray(family, emitter)
    with dr.suspend_grad():
        session = begun(scene, strategies=3, frozen_photons=20000)
        theory = session.theory(session.radii_at(0)["indirect"])
        paths, place = paths_of(session, 4)
        root = theory.roots(paths.record(scene, 0))
        light = known_light(theory, scene, paths, 1, 3)
        links = [dict(zip("fp", paths.f_and_p(number))) for number in (0, 1)]
        middle = theory.of_inner(paths.record(scene, 1), links[0], root)

        w20, w30 = (
            theory.of_photons(
                Photon(paths, 0), Chain(scene, paths, 1, mi.Bool(long)), light, place, root
            )
            for long in (False, True)
        )
        w21 = 1 - middle.direct_weight()
        assert_sums_to_one(w20 + w21, (w20, w21), paths.valid)
        count = dr.width(paths.valid)
        w31 = theory.of_inner_photons(Photon(paths, 1), light, place + count, middle)
        w32 = theory.of_last(paths.record(scene, 2), links[1], middle)
        assert_sums_to_one(w30 + w31 + w32, (w30, w31, w32), paths.valid)


# --- Means --------------------------------------------------------------------


@pytest.mark.parametrize(
    "emitter, family, parameters, variant_name",
    [
        *extended(
            ("rectangle", "mixed0", {"strategies": 2}, RGB),
            # Few light sub-paths: with more the denominators are near zero, and fireflies hide all.
            ("rectangle", "lambertian", {"strategies": 3, "photon_count": 1000}, RGB),
            ("constant", "lambertian", {"strategies": 2, "first_vertex": 1}, SPECTRAL),
            ("point", "rough", {"strategies": 3, "photon_count": 1000}, MONO),
        ),
    ],
)
def test_agrees(emitter, family, parameters, variant_name):
    """As `test_weights_in_renders.test_agrees`."""
    mi.set_variant(variant_name)
    agree(
        weighted(weights="published", **parameters),
        oracle(emitter, 5),
        tray(family, emitter, PERSPECTIVE),
        block=0.08,
        most=600,
    )


# --- Noise --------------------------------------------------------------------

# A closed white sphere lit from its middle, as in `test_weights_in_renders`. Everything is even, so
# the noise of any weights is known: a photon of whatever strategy brings as much as one of any
# other to the same path, but for the albedo, and photons of one pixel are independent. Few light
# sub-paths beside the frozen ones: 1 - n B2 and the like are then far from zero.
LIGHT_PATHS, FROZEN_PATHS = 100, 40000


def noise_of_two(w1):
    """Variance of an iteration's pixel over what photons of two segments alone would have, where
    photons and direct light at z_1 have the weight w1."""
    rho = SPHERE["albedo"]
    return ((1 - w1) * rho) ** 2 + ((1 - w1) ** 2 + w1**2) * rho**4


def noise_of_three(w20, w30, w31):
    """The same of three strategies, paths of five segments at most."""
    rho = SPHERE["albedo"]
    others = w30**2 + w31**2
    return (w20 * rho) ** 2 + others * rho**4 + (others + (1 - w30 - w31) ** 2) * rho**6


def least_noise(strategies):
    """The least of these. Direct light at z_1 of three strategies has no noise and all the
    weight."""
    grid = np.linspace(0, 1, 401)
    if strategies == 2:
        return noise_of_two(grid).min()
    return noise_of_three(0, *np.meshgrid(grid, grid)).min()


@in_one_thread
def measured_in_sphere(
    strategies, weights, iterations, size, light_paths=LIGHT_PATHS, frozen=FROZEN_PATHS
):
    """Variance of an iteration's pixel in the same unit, and its standard error over blocks of the
    image."""
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
                    "width": size,
                    "height": size,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
            },
        }
    )
    integrator = mi.load_dict(
        {
            "type": "bdpm_opt",
            "strategies": strategies,
            "weights": weights,
            "mix_diffuse": True,
            "max_depth": strategies + 2,
            "rr_depth": 100,
            "initial_radius": SPHERE["radius"],
            "photon_count": light_paths,
            "frozen_photons": frozen,
            "variance": True,
            "sampler": "independent",
            "direct_paths": 1,
        }
    )
    session = integrator.session(scene, seed=1)
    for _ in range(iterations):
        session.iterate()
    noise = session.image()[..., -3:].mean(-1) * iterations
    blocks = noise.reshape(4, size // 4, 4, size // 4).mean(axis=(1, 3))
    # Of the closed form: the noise of photons of two segments alone, albedo apart.
    share = SPHERE["radius"] ** 2 / 4
    flux = 4 * np.pi * SPHERE["intensity"]
    photon = SPHERE["albedo"] / np.pi * flux / (np.pi * SPHERE["radius"] ** 2)
    unit = share / light_paths * photon**2
    return blocks.mean() / unit, blocks.std(ddof=1) / 4 / unit


@pytest.mark.parametrize(
    "strategies, settings",
    [
        *extended((2, {"iterations": 200, "size": 24, "light_paths": 200})),
        # A gather for each pair of a vertex and a frozen photon: ten times the seconds.
        pytest.param(
            3,
            {"iterations": 150, "size": 16, "light_paths": 50, "frozen": 20000},
            marks=[pytest.mark.full, pytest.mark.timeout(1200)],
        ),
    ],
)
def test_least_noise_of_one_weight(rgb, strategies, settings):
    """Where direct light and photons at the last vertex share a weight, published weights come
    within 5 % of the least noise (four standard errors of the measurement allowed below it, two
    above)."""
    least = least_noise(strategies)
    measured, error = measured_in_sphere(strategies, "published", **settings)
    print(f"{strategies} strategies: {measured / least:.3f}, error {error / least:.3f}")
    assert error < 0.02 * least
    assert least - 4 * error < measured < 1.05 * least + 2 * error, (
        measured / least,
        error / least,
    )


@pytest.mark.long
def test_gain_of_weights_apart(rgb):
    """Where direct light and photons at z_1 have weights of their own (those of the cells): half of
    the noise of gathering at z_1 alone, within 5 %; under one weight it is 0.68."""
    apart, error = measured_in_sphere(2, "full", 200, 24)
    rho = SPHERE["albedo"]
    assert apart == pytest.approx(0.5 * rho**4, rel=0.05)
    assert apart + 4 * error < 0.8 * least_noise(2)


GLOSSY = {
    "type": "roughconductor",
    "material": "none",
    "distribution": "ggx",
    "alpha": 0.5,
    "specular_reflectance": {"type": "rgb", "value": [0.9] * 3},
}


@pytest.mark.extended
def test_least_noise_in_a_glossy_sphere(rgb):
    """In a sphere of rough metal, seen and lit from its centre, the variance of single strategies
    is what quadrature says (5 % for the finite disk, and three standard errors), and under
    published weights it comes within 5 % of the least (two errors above that allowed)."""
    intensity, size = 2.0, 16
    world = glossy_sphere.glossy_sphere(mi.load_dict(GLOSSY), intensity)
    disk = np.pi * SPHERE["radius"] ** 2
    best = world.best(disk, LIGHT_PATHS)
    assert best.max() > best.min() + 0.1  # the best weights do depend on the direction
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 90, "near_clip": 0.001, "film": film}
    scene = mi.load_dict(
        {
            "type": "scene",
            "room": {"type": "sphere", "flip_normals": True, "bsdf": GLOSSY},
            "light": {"type": "point", "position": [0, 0, 0], "intensity": intensity},
            "sensor": sensor,
        }
    )

    def measured(iterations=200, **plugin):
        integrator = mi.load_dict(
            {
                "max_depth": 4,
                "rr_depth": 100,
                "initial_radius": SPHERE["radius"],
                "photon_count": LIGHT_PATHS,
                "variance": True,
                "sampler": "independent",
                "direct_paths": 1,
                **plugin,
            }
        )
        session = integrator.session(scene, seed=1)
        for _ in range(iterations):
            session.iterate()
        noise = session.image()[..., -3:].mean(-1) * iterations
        blocks = noise.reshape(4, size // 4, 4, size // 4).mean(axis=(1, 3))
        return blocks.mean(), blocks.std(ddof=1) / 4

    for bdd in (0, 1):
        noise, error = measured(type="bdpm", bdd=bdd)
        expected = world.noise(np.full(best.shape, float(bdd)), disk, LIGHT_PATHS)
        assert abs(noise - expected) < 0.05 * expected + 3 * error, (bdd, noise / expected)
    noise, error = measured(type="bdpm_opt2", weights="published", frozen_photons=FROZEN_PATHS)
    least = world.noise(best, disk, LIGHT_PATHS)
    print(f"glossy: {noise / least:.3f}, error {error / least:.3f}")
    assert error < 0.03 * least
    assert least - 4 * error < noise < 1.05 * least + 2 * error, (noise / least, error / least)


# --- Parameters ---------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, message",
    [
        ({"type": "bdpm_opt", "strategies": 4}, '"strategies" 2 or 3'),
        ({"type": "bdpm_opt", "strategies": 1}, '"strategies" 2 or 3'),
        ({"type": "bdpm_opt3", "mix_diffuse": False}, 'no "mix_diffuse" = false'),
        ({"type": "bdpm_opt2", "aovs": "light:direct"}, '"direct"'),
        ({"type": "bdpm_opt3", "denoised": True}, 'no "denoised"'),
    ],
)
def test_what_published_weights_do_not_have(rgb, parameters, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({**parameters, "weights": "published"})


def test_images_of_published_weights_are_denoised_as_a_whole(rgb):
    """`--denoise` tells all plugins of it that have the parameter, but not these."""
    assert not knows_of_denoisers("bdpm_opt3", {"weights": "published"})
    assert knows_of_denoisers("bdpm_opt3", {})


def test_renders_from_a_file(rgb, tmp_path):
    """By its name from an XML file, with a radius that a pilot chooses; and a scene without photons
    to merge."""
    from mis_integrators.app.cli import main

    scene = tmp_path / "scene.xml"
    scene.write_text(
        """<scene version="3.0.0">
        <integrator type="bdpm_opt2"><string name="weights" value="published"/>
        <integer name="max_depth" value="5"/></integrator>
        <sensor type="perspective"><transform name="to_world">
        <lookat origin="0, -3, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
        <rfilter type="box"/></film></sensor>
        <shape type="rectangle"><bsdf type="roughconductor"/></shape>
        <shape type="sphere"><point name="center" x="0" y="0" z="0.6"/>
        <float name="radius" value="0.3"/></shape>
        <emitter type="point"><point name="position" x="1" y="-1" z="2"/></emitter>
        </scene>"""
    )
    out = tmp_path / "out.exr"
    main([str(scene), "-o", str(out), "--spp", "2"])
    assert np.array(mi.Bitmap(str(out))).max() > 0
