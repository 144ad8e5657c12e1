"""Lights that camera paths meet by chance behind delta surfaces: caustic light shared with
photons."""

import mis_integrators  # noqa: F401 (registers the plugins)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import grey_pictures, in_one_thread
from pilots import knowing
from selection import extended
from worlds import T, film, look

SIZE = 24
FLOORS = {
    "diffuse": {"type": "diffuse", "reflectance": 0.6},
    "glossy": {"type": "roughconductor", "alpha": 0.3, "material": "none"},
    "narrow": {"type": "roughconductor", "alpha": 0.08, "material": "none"},
}


@pytest.fixture(autouse=True)
def _rgb(rgb):
    pass


def lamp(radiance=6.0, height=3.0, size=0.8):
    down = T().translate([0, 0, height]).rotate([1, 0, 0], 180).scale(size)
    emitter = {"type": "area", "radiance": radiance}
    return {"type": "rectangle", "to_world": down, "emitter": emitter}


LIQUID = {"type": "homogeneous", "sigma_t": 0.8, "albedo": 0.0}
MILK = {"type": "homogeneous", "sigma_t": 0.6, "albedo": 0.7}


def world(floor="diffuse", inside=None, **lights):
    """A floor that `lights` reach through a pane of glass and a ball of it alone, with a medium
    `inside`; seen from beneath the pane."""
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": T().scale(4),
                "bsdf": {"type": "twosided", "bsdf": FLOORS[floor]},
            },
            "pane": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 2]).scale(8),
                "bsdf": {"type": "thindielectric"},
            },
            "ball": {
                "type": "sphere",
                "center": [0.8, 0.4, 0.6],
                "radius": 0.5,
                "bsdf": {"type": "dielectric"},
                **({"interior": inside} if inside else {}),
            },
            "sensor": {
                "type": "perspective",
                "fov": 60,
                "film": film(SIZE),
                "to_world": look((0, -3, 1.6), (0, 0, 0), (0, 0, 1)),
            },
            **(lights or {"lamp": lamp()}),
        }
    )


def session_of(scene, radius=0.1, **parameters):
    """A session that knows its radii. So long a render has no sparse photons."""
    plugin = {"type": "bdpm", "bdd": 1, "denoised": True, "direct_paths": 1, "max_depth": 6}
    plugin |= {"photon_count": 4000, **parameters}
    return knowing(mi.load_dict(plugin).session(scene, seed=3), radius, 1e6)


LIGHTS = {
    "lamp": lambda: {"a": lamp(6.0)},
    "two lamps": lambda: {"a": lamp(6.0, 3.0, 0.8), "b": lamp(6.0, 2.5, 0.2)},
    "ball": lambda: {
        "a": {
            "type": "sphere",
            "center": [0, 0, 3],
            "radius": 0.3,
            "emitter": {"type": "area", "radiance": 6.0},
        }
    },
    "sky": lambda: {"a": {"type": "constant", "radiance": 6.0}},
    "sky and lamp": lambda: {"a": {"type": "constant", "radiance": 6.0}, "b": lamp(6.0)},
}


@pytest.mark.parametrize("name", LIGHTS)
def test_density_of_starts_is_light_over_flux(name):
    """Light sub-paths carry radiance over the density per etendue, wherever they are looked at; and
    a camera ray that comes the other way finds the same density. (At the edge of a cell of the
    sky's histograms rounding decides.)"""
    from mis_integrators.core.sequences import SampleSequence
    from mis_integrators.lights.lights import Lights
    from mis_integrators.paths.light_starts import light_seen_from

    scene = world(**LIGHTS[name]())
    lights = Lights.seen_by(scene, scene.sensors()[0], "bdpm")
    sequence = SampleSequence(mi.UInt32(1), mi.UInt32(0), 1, True)
    rng = sequence.of_paths(dr.arange(mi.UInt32, 2000)).at(0)
    ray, flux, _, source = lights.sample_emission(rng, 0.0, mi.Color0f())
    hit = scene.ray_intersect(ray)
    valid = hit.is_valid() & (dr.max(flux) > 0)
    density = lights.start_density(hit, light_seen_from(hit, source, valid), valid)
    back = hit.spawn_ray(-ray.d)
    met = scene.ray_intersect(back)
    ref = mi.Interaction3f(hit)
    ds = mi.DirectionSample3f(scene, met, ref)
    # A light may hide another one.
    valid &= met.emitter(scene) == source.emitter
    found = lights.start_density(ref, ds, valid)
    keep = np.array(valid)
    assert keep.sum() > 300
    radiance = np.array(flux)[0] * np.array(density)
    for values, expected in ((radiance, 6.0), (np.array(found), np.array(density))):
        right = np.isclose(values, expected, rtol=2e-3)[keep]
        assert right.mean() > (0.99 if "sky" in name else 1 - 1e-9)


def test_lights_that_cannot_be_met_are_left_to_photons():
    from mis_integrators.lights.lights import NEVER_MET

    point = {"type": "point", "position": [0, 0, 3], "intensity": 1.0}
    session = session_of(world(point=point, lamp=lamp()))
    assert session.by_chance
    point = next(e for e in session.scene.emitters() if e.class_name() == "PointLight")
    ds = dr.zeros(mi.DirectionSample3f)
    ds.emitter = mi.EmitterPtr(point)
    density = session.lights.start_density(dr.zeros(mi.Interaction3f), ds, mi.Bool(True))
    assert density[0] == mi.Float(NEVER_MET)[0]


def test_weights_sum_to_one():
    """And are finite where densities are zero or endless."""
    from mis_integrators.mis.chance import weight_of_hit, weight_of_photon, x_of
    from mis_integrators.photons.hits import density_ratio

    density, cosine, pdf = (
        mi.Float(np.ravel(values))
        for values in np.meshgrid([0, 1e-20, 1, 1e30], [0, 1e-4, 1], [0, 1e-10, 1, 1e10])
    )
    for radius in (0.0, 1e-4, 1.0):
        x = x_of(mi.Float(1e7), mi.Float(radius), density_ratio(density, cosine, pdf))
        photon, hit = np.array(weight_of_photon(x)), np.array(weight_of_hit(x))
        assert np.all(np.isfinite(photon) & np.isfinite(hit) & (photon >= 0) & (hit >= 0))
        np.testing.assert_allclose(photon + hit, 1, rtol=1e-6)


CASES = [
    ("diffuse", "lamp", {"bdd": 0}),
    ("glossy", "sky and lamp", {"bdd": 1, "direct_paths": 4}),
    ("narrow", "sky and lamp", {"bdd": 0, "denoised": False}),
    *extended(
        ("glossy", "lamp", {"bdd": 1}),
        ("diffuse", "sky", {"bdd": 1, "camera_paths": 2}),
        ("diffuse", "sky", {"bdd": 0, "denoised": False}),
    ),
]
BATCHES = 16


@in_one_thread
def by_path(scene, plugin="path"):
    """Images by `path`, mean over the channels: (BATCHES, height, width)."""
    integrator = mi.load_dict({"type": plugin, "max_depth": 6})
    images = [mi.render(scene, integrator=integrator, spp=512, seed=n) for n in range(BATCHES)]
    return np.array([np.array(image)[..., :3].mean(axis=-1) for image in images])


@pytest.mark.parametrize(("floor", "lights", "parameters"), CASES)
def test_means_are_those_of_path(floor, lights, parameters):
    """Of four blocks, with disks that blur little (6.5 standard errors of t with 15 degrees at
    least: 1e-5 a block, 4e-5 a case); 10 % are seen."""
    compare_means(world(floor, **LIGHTS[lights]()), "path", parameters)


@pytest.mark.long
@pytest.mark.parametrize(
    ("inside", "lights", "denoised"),
    [(LIQUID, "lamp", True), *extended((MILK, "sky and lamp", True), (MILK, "lamp", False))],
)
def test_means_are_those_of_volpath(inside, lights, denoised):
    """The same where the ball has a liquid inside."""
    scene = world("glossy", inside, **LIGHTS[lights]())
    compare_means(scene, "volpath", {"bdd": 1, "denoised": denoised})


def compare_means(scene, plugin, parameters):
    session = session_of(scene, 0.06, photon_count=16000, **parameters)
    assert session.by_chance
    blocks = [
        images.reshape(-1, 2, 12, 2, 12).mean(axis=(2, 4))
        for images in (grey_pictures(session, 150), by_path(scene, plugin))
    ]
    error = np.sqrt(sum(values.var(axis=0, ddof=1) / len(values) for values in blocks))
    one, other = (values.mean(axis=0) for values in blocks)
    error += 1e-5 * other  # a light that is seen has no noise
    assert (np.abs(one - other) <= 6.5 * error).all()
    assert (6.5 * error / other)[1].max() < 0.1, "test too weak"  # those that see the floor


def without(monkeypatch, weight, scene, **parameters):
    """Images of 20 iterations where all weights of one kind are zero."""
    from mis_integrators.mis import chance

    with monkeypatch.context() as patch:
        patch.setattr(chance, weight, lambda x: 0 * x)
        return grey_pictures(session_of(scene, **parameters), 20)


def test_both_bring_light(monkeypatch):
    """Each brings a part of the caustics that the other lacks: without either, the image of the
    same paths is darker, and all three are alike in what else there is."""
    scene, parameters = world("glossy"), {"bdd": 0, "max_depth": 3, "radius": 0.02}
    whole = grey_pictures(session_of(scene, **parameters), 20)
    photons = without(monkeypatch, "weight_of_hit", scene, **parameters)
    hits = without(monkeypatch, "weight_of_photon", scene, **parameters)
    assert photons.mean() < 0.8 * whole.mean() and hits.mean() < 0.97 * whole.mean()
    # What both have is the light that is seen straight.
    rest = photons + hits - whole
    assert rest.min() > -1e-4 * whole.max()


@pytest.mark.long
@pytest.mark.parametrize("floor", ["diffuse", "glossy"])
def test_noise_is_less(monkeypatch, floor):
    """That of an iteration over that of photons alone, with disks as small as pixels (fixed seeds;
    about 0.3 and 0.15)."""
    from mis_integrators.integrators.bdpm import BDPMSession

    noise = []
    for shares in (True, False):
        monkeypatch.setattr(BDPMSession, "meets_lights", shares)
        session = session_of(world(floor), 0.01, bdd=0, max_depth=4)
        assert session.by_chance is shares
        noise.append(grey_pictures(session, 120).var(axis=0, ddof=1).mean())
    assert noise[0] < 0.5 * noise[1]


def test_who_shares():
    """Renders of scenes with lights that can be met, where the radius is automatic and there are no
    weights."""
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    point = {"type": "point", "position": [0, 0, 3], "intensity": 1.0}
    shining = {"type": "sphere", "center": [0, 2, 1], "radius": 0.2, "bsdf": {"type": "dielectric"}}
    shining |= {"emitter": {"type": "area", "radiance": 1.0}}

    def shares(scene=None, plugin="bdpm", **parameters):
        parameters = {"denoised": True, **parameters}
        return mi.load_dict({"type": plugin, **parameters}).session(scene or world()).by_chance

    assert shares()
    assert shares(denoised=False)
    assert not shares(initial_radius=0.1)
    assert not shares(world(point=point))
    assert shares(world(lamp=lamp(), fog=fog))
    assert not shares(world(lamp=lamp(), shining=shining))
    assert not shares(plugin="bdpm_opt2")
    assert not shares(plugin="bdpm_opt2", weights="published", denoised=False)


@pytest.mark.parametrize("inside", [None, LIQUID], ids=["air", "liquid"])
def test_hits_know_the_flux_of_photons(inside):
    """By which disks differ: the lamp's radiance over D, here the same for all photons. Roulette
    and what the liquid takes away are the path's own. (Photons that have survived roulette have up
    to 1 / 0.95 of it.)"""
    from mis_integrators.photons.photon import read_power
    from mis_integrators.photons.queries import read_queries

    scene = world(inside=inside, lamp=lamp(size=3))
    session = session_of(scene, bdd=1, denoised=False, rr_depth=1, camera_paths=32)
    spectral = session._spectral(0)
    _, power, count, *_ = session.trace_photons(0, 0)
    flux, _ = read_power(power, dr.arange(mi.UInt32, int(count[0])), mi.Bool(True))
    usual = np.median(np.array(flux)[0])
    camera_pass = session.describe_camera_pass(
        session.sensor,
        session._sequence(0, 1, 32),
        dr.arange(mi.UInt32, session.path_count),
        spectral,
    )
    vertices = session._trace_camera(camera_pass, session.vertex_capacity, spectral)[3]
    hits = read_queries(vertices)["hits"]
    found = np.array(hits["flux"])[np.array(hits["light"])[0] > 0]
    assert len(found) > 30
    np.testing.assert_allclose(found, usual, rtol=0.06)


def test_published_weights_know_of_photons_alone():
    """They render where lights could be met, with a pilot."""
    plugin = {"type": "bdpm_opt2", "weights": "published", "max_depth": 4}
    image = mi.render(world(), integrator=mi.load_dict(plugin), spp=1)
    assert np.all(np.isfinite(np.array(image)))


def test_light_is_of_the_class_of_caustics():
    """Where light is split, the layers sum to the image, and that of caustics has what is met:
    without hits there is much less of it."""
    session = session_of(world("glossy"), bdd=0, max_depth=4, aovs="d:direct,i:indirect,c:caustic")
    assert session.by_chance
    for _ in range(8):
        session.iterate()
    image, names = session.image(), list(session.channels)
    layer = {n: image[..., names.index(f"{n}.R")] for n in "dic"}
    np.testing.assert_allclose(sum(layer.values()), image[..., 0], rtol=1e-4, atol=1e-5)
    assert layer["c"].mean() > 0.5 * image[..., 0].mean()


@pytest.mark.long
@pytest.mark.thinned(2, 1, 2)
@pytest.mark.parametrize("denoised", [False, True])
@pytest.mark.parametrize("name", ["lamp", "sky and lamp"])
@pytest.mark.parametrize("floor", ["diffuse", "glossy"])
def test_photons_tell_how_noisy_paths_are(name, floor, denoised):
    """The second moment of what a camera path brings that meets lights by chance, of which photons
    know, is that of `path`, to which all light comes through the pane. Three iterations of a pilot
    with 576 pixels know it within a tenth (seen over seeds); what they leave out, that a path
    chooses at the glass, is 0.05 to 0.1. An error of a cosine or of a factor of two is seen.
    Photons share their light with chance, and for a denoiser those that the camera sees have disks
    of a pixel's size: the moment knows of neither."""
    sensor = {"type": "perspective", "fov": 30, "film": film(SIZE)}
    sensor["to_world"] = look((0, -3, 1.6), (0, 0, 0), (0, 0, 1))  # sees the floor and the ball
    scene = world(floor, sensor=sensor, **LIGHTS[name]())
    plugin = {"type": "bdpm", "bdd": int(denoised), "denoised": denoised, "max_depth": 6}
    plugin |= {"photon_count": 40000}
    session = mi.load_dict(plugin).session(scene, seed=3, spp=64)
    session.judge_chance()
    session.predict()
    path = mi.load_dict({"type": "path", "max_depth": 6, "rr_depth": 100})
    image = np.array(mi.render(scene, integrator=path, spp=4096)).mean(axis=-1)
    squares = [
        np.square(np.array(mi.render(scene, integrator=path, spp=1, seed=seed)).mean(axis=-1))
        for seed in range(1, 400)
    ]
    usual = np.mean(np.minimum(image, np.quantile(image, 0.9)))
    assert session.prediction.chance["mse"] == pytest.approx(np.mean(squares) / usual**2, rel=0.3)


def test_who_does_not_ask_is_told_nothing():
    session = mi.load_dict({"type": "bdpm", "bdd": 0, "max_depth": 6}).session(world(), spp=8)
    session.predict()
    assert session.prediction.chance == {}
