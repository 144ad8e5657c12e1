"""Volume photons that are joined with the sensor, in images that will be denoised: their light
against `volpath`, and their noise.

Comparisons of renders as in `test_bdpm_media`, extrapolated to the radius zero, but for the disks
close to the sensor, which blur an eighth of the light or so: false-alarm rate 1e-6 each, and the
errors that are seen are those said there.
"""

import mis_integrators  # noqa: F401 (registers the plugins)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import PathBatches, assert_same, collect_until, grey_pictures
from foggy import oracle_for, view
from pilots import learned
from selection import extended, one_in_each_row
from test_bdpm_media import SLACK, SmallRadiusBatches
from test_bdpt_media import FOG, SCENES, WITHIN, ball, fog_scene, homogeneous, inner
from worlds import T, diffuse, film, grey, look


@pytest.fixture(autouse=True)
def _rgb(rgb):
    pass


def joined(scene, radius=0.06, **parameters):
    """A session that joins photons with the sensor, and knows the radius of all others."""
    plugin = {"type": "bdpm", "bdd": 0, "max_depth": 6, "denoised": True, "direct_paths": 1}
    plugin |= {"camera_paths": 1, "photon_count": 20000, **parameters}
    session = mi.load_dict(plugin).session(scene, seed=1, spp=0)
    session.recall(learned(session, radius))
    return session


class JoinedBatches(SmallRadiusBatches):
    """As those, with photons joined with the sensor."""

    def session(self, scene, radius, parameters):
        return joined(scene, radius, **parameters)


def agree(scene, max_depth=6, whole=0.02, block=0.06, **parameters):
    parameters = {"camera_paths": 16, **parameters}
    mine = JoinedBatches(scene, 2, max_depth=max_depth, **parameters)
    oracle = oracle_for(max_depth, parameters.get("hide_emitters", False))
    oracle = PathBatches(oracle, scene, 2, 512)
    assert_same(*collect_until(mine, oracle, whole, block, most=600), whole, block, slack=SLACK)


# --- Means ----------------------------------------------------------------------------------------

USUAL = ("coloured", 1), ("glass", 1)
"""Of `SCENES` and values of `bdd`, those that are not `extended`."""


@pytest.mark.long
@pytest.mark.parametrize("name, bdd", one_in_each_row(sorted(SCENES), (0, 1, 2), USUAL))
def test_agrees_with_volpath(name, bdd):
    """Glass: beams behind it, and light that is seen through it. Within the fog: the zone close to
    the sensor. (Of the light sub-paths from a sky, few meet the cube.)"""
    visible, more = (0.02, 0.06), {}
    if name in ("sky", "sun"):
        visible = (0.05, 0.15)
    if "within" in name:  # all pixels see the few photons that are close to the sensor
        visible, more = (0.08, 0.24), {"photon_count": 200000, "camera_paths": 4}
    agree(SCENES[name](), 6, *visible, bdd=bdd, **more)


@pytest.mark.extended
@pytest.mark.parametrize("max_depth, bdd", [(2, 1), (1, 0), (2, 0), (3, 0), (3, 1)])
def test_depth_is_that_of_volpath(max_depth, bdd):
    """Boundaries do not count, half transparent ones included."""
    scene = fog_scene(
        homogeneous(),
        ball=ball({"type": "mask", "opacity": 0.4, "nested": diffuse()}, **inner()),
        sky={"type": "constant", "radiance": grey(0.4)},
    )
    agree(scene, max_depth, bdd=bdd)


def parallel_fog():
    """Fog before an orthographic sensor, whose film is a crop window, too."""
    window = {"crop_width": 10, "crop_height": 12, "crop_offset_x": 4, "crop_offset_y": 2}
    sensor = {
        "type": "orthographic",
        "to_world": look((0, 0.7, 4.2), (0, 0, 0)) @ T().scale([1.5, 1.5, 1]),
        "film": film(16, **window),
    }
    return fog_scene(homogeneous(), sensor)


def test_orthographic_sensors_have_no_zone():
    """Their rays are parallel."""
    session, other = joined(parallel_fog()), joined(fog_scene(homogeneous()))
    for each in (session, other):
        each.iterate()
    assert float(session.near_zone.depth[0]) == 0 < float(other.near_zone.depth[0])


@pytest.mark.extended
def test_agrees_with_volpath_under_parallel_rays():
    agree(parallel_fog())


@pytest.mark.parametrize("direct_paths", extended(0, 4))
def test_paths_for_direct_light_change_nothing(direct_paths):
    """Other paths through the same pixels see emission and direct light only."""
    agree(
        fog_scene(homogeneous()), camera_paths=4, direct_paths=direct_paths, whole=0.01, block=0.03
    )


@pytest.mark.parametrize("variant_name", extended("llvm_ad_mono", "llvm_ad_spectral"))
def test_agrees_in_other_variants(variant_name):
    mi.set_variant(variant_name)
    sensor = view((0, 0.7, 4.2))
    if mi.is_spectral:  # one iteration has one set of wavelengths
        sensor["srf"] = {"type": "spectrum", "value": [(554, 0.0), (555, 1.0), (556, 0.0)]}
    agree(fog_scene(homogeneous(), sensor))


def test_films_that_sample_their_border():
    """Nothing is joined with the sensor beyond the crop window: pixels at its edge are as bright as
    in a film that takes no samples there. The same photons, so that nothing but rounding differs
    where all light is that of these."""
    images = []
    for border in (False, True):
        window = film(16, "gaussian", sample_border=border)
        session = joined(thin_fog(film=window), max_depth=2)
        session.iterate()
        images.append(session.image()[..., :3])
    lit = images[0] > 0.01 * images[0].max()
    assert lit.mean() > 0.9
    ratio = images[1][lit] / images[0][lit]
    assert abs(np.median(ratio) - 1) < 0.01 and 0.9 < np.quantile(ratio, 0.01)


@pytest.mark.long
def test_random_numbers_are_those_of_the_photon():
    """The same seed twice: photons lie in another order in their buffer, which chance decides, but
    are joined with the same points of the lens."""
    sensor = {**view((0, 0.7, 4.2)), "type": "thinlens", "aperture_radius": 0.2}
    scene = fog_scene(homogeneous(), {**sensor, "focus_distance": 4.0})
    images = []
    for _ in range(2):
        session = joined(scene)
        session.iterate()
        images.append(session.image()[..., :3])
    np.testing.assert_allclose(images[1], images[0], rtol=1e-3, atol=1e-5)


@pytest.mark.long
def test_what_the_zone_brings_is_what_joined_photons_bring():
    """Within fog all of the same photons are joined, or those of a wide zone gathered along beams:
    the image's mean is the same within 4.9 standard errors of the difference (a false alarm in a
    million), which are 3 % of what the zone brings."""
    scene = fog_scene(homogeneous(), view(*WITHIN, medium=FOG))
    images = []
    for depth in (0.0, 0.5):
        session = joined(scene, photon_count=100000, camera_paths=4)
        session.volume_density()
        session.near_zone._set(depth)
        session._list_tables()
        images.append(grey_pictures(session, 100).mean(axis=(1, 2)))
    assert float(session.near_zone.depth[0]) == 0.5
    difference = images[1] - images[0]
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    assert abs(difference.mean()) < 4.9 * error + 0.005 * images[0].mean()
    assert error < 0.03 * images[0].mean()


def test_the_zone_is_that_of_what_is_seen():
    """A wall hides most of the fog: the zone is less deep than before the wall."""
    wall = {"type": "rectangle", "to_world": look((0.6, 0.3, 0.45), (0.6, 0.3, 2)) @ T().scale(3)}
    depths = []
    for more in ({}, {"wall": wall}):
        sensor = view((0.6, 0.3, 0.7), (0.6, 0.3, -1), medium=FOG)
        session = joined(fog_scene(homogeneous(), sensor, **more), photon_count=400000)
        session.volume_density()
        depths.append(float(session.near_zone.depth[0]))
    assert 0 < depths[1] < 0.25 / 4 < 0.08 < depths[0]


@pytest.mark.long
@pytest.mark.parametrize("bdd", [1, *extended(0)])
def test_classes_of_light_are_those_without(bdd):
    """Direct, indirect and caustic light sum to the image, and have the shares that beams find."""
    aovs = ",".join(f"{name}:{name}" for name in ("direct", "indirect", "caustic"))
    scene = fog_scene(homogeneous(0.5), ball=ball({"type": "dielectric"}, 0.8, exterior=FOG))
    means = []
    for parameters in ({}, {"denoised": False, "initial_radius": 0.03}):
        plugin = {"type": "bdpm", "max_depth": 6, "denoised": True, "bdd": bdd, "aovs": aovs}
        plugin |= {"photon_count": 20000, "camera_paths": 16, "direct_paths": 1}
        session = mi.load_dict(plugin | parameters).session(scene, seed=1, spp=640)
        if not parameters:
            session.recall(learned(session, 0.03))
        for _ in range(40):
            session.iterate()
        names = list(session.channels)
        image = session.image()[..., [names.index(c) for c in "RGB"]].mean(axis=(0, 1))
        layers = np.array(
            [
                session.image()[..., [names.index(f"{layer}.{c}") for c in "RGB"]].mean(axis=(0, 1))
                for layer in ("direct", "indirect", "caustic")
            ]
        )
        assert layers.sum(axis=0) == pytest.approx(image, rel=1e-4)
        means.append(layers.mean(axis=1) / image.mean())
    # Other seeds differ by 0.003.
    assert means[1].min() > 0.03
    assert np.abs(means[0] - means[1]).max() < 0.01


# --- Noise ----------------------------------------------------------------------------------------


def thin_fog(**sensor):
    """Fog alone, of which the sensor sees all, under a point lamp."""
    lamp = {"type": "point", "position": [0.3, 2.0, 0.5], "intensity": 4.0}
    return fog_scene(homogeneous(0.5), view((0, 0, 3.6), **sensor), lamp=None, floor=None, lit=lamp)


def test_near_pixels_share_no_noise():
    """Neighbours' estimates are hardly correlated over iterations; along beams of the same photons
    by more than a half."""
    alike = []
    for parameters in ({}, {"denoised": False, "initial_radius": 0.25}):
        plugin = {"type": "bdpm", "bdd": 0, "max_depth": 2, "denoised": True}
        plugin |= {"photon_count": 20000, "sampler": "independent", **parameters}
        session = mi.load_dict(plugin).session(thin_fog(), seed=1, spp=0)
        if not parameters:
            session.recall(learned(session, 0.25))
        images = grey_pictures(session, 100)[:, 2:14, 2:14]
        noise = images / images.mean(axis=0) - 1
        alike.append((noise[..., 1:] * noise[..., :-1]).mean() / (noise**2).mean())
    assert alike[0] < 0.1 and alike[1] > 0.5


@pytest.mark.long
def test_photons_close_to_the_sensor_are_no_dots(monkeypatch):
    """Within fog, the largest pixel of images is many times brighter without the zone; the zone is
    a quarter of the median depth of the light."""
    from mis_integrators.photons import near_zone

    scene = fog_scene(homogeneous(), view(*WITHIN, medium=FOG))
    brightest = []
    for depth in (near_zone.DEPTH, 0.0):
        monkeypatch.setattr(near_zone, "DEPTH", depth)
        session = joined(scene, photon_count=200000)
        images = grey_pictures(session, 50)
        zone = float(session.near_zone.depth[0])
        assert 0.06 < zone < 0.3 if depth else zone == 0
        # Of single iterations: of a thousand pixels the brightest.
        brightest.append(np.quantile(images, 0.999) / images.mean())
    assert brightest[1] > 2 * brightest[0]


def test_beams_reach_to_the_end_of_the_zone():
    """Whatever lies in it, and within the radius of a ray, is before the end of the ray's beam;
    rays that begin far beyond have none."""
    from mis_integrators.paths.sensor import Lens
    from mis_integrators.photons.near_zone import NearZone

    zone = NearZone(Lens(mi.load_dict(view((1, 2, 3), (1, 2, 0)))))  # looks along -z
    zone._set(0.8)
    radius, rng = float(zone.radius[0]), np.random.default_rng(1)
    d = rng.normal(size=(3, 4000)) * [[0.5], [0.5], [0]] - [[0], [0], [1]]
    d /= np.linalg.norm(d, axis=0)
    along, aside = rng.uniform(0, 1.5, 4000), np.cross(d.T, rng.normal(size=(4000, 3))).T
    aside *= rng.uniform(0, radius, 4000) / np.linalg.norm(aside, axis=0)
    p = np.array([[1.0], [2.0], [3.0]]) + along * d + aside
    inside = np.array(zone.holds(mi.Point3f(p)))
    np.testing.assert_array_equal(inside, 3 - np.float32(p[2]) < 0.8)
    ray = mi.Ray3f(mi.Point3f(1, 2, 3), mi.Vector3f(d))
    reach = np.array(zone.reach(ray))
    assert 1000 < inside.sum() < 3000
    assert np.all(along[inside] <= reach[inside] + 1e-5) and np.all(reach < 4 * 0.8)
    assert zone.reach(mi.Ray3f(mi.Point3f(1, 2, 1), mi.Vector3f(0, 0, -1)))[0] == 0


@pytest.mark.long
@pytest.mark.parametrize("variant_name", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_the_pilot_counts_little_of_their_noise(variant_name):
    """What it predicts of them is a denoiser's share of the noise of pixels, measured over
    iterations, within a factor of two; and less light makes more of it."""
    from mis_integrators.pilot.denoiser import LEFT
    from mis_integrators.pilot.run import run_pilot
    from mis_integrators.pilot.setting import pilot_pixels

    mi.set_variant(variant_name)
    plugin = {"type": "bdpm", "bdd": 0, "denoised": True, "max_depth": 2}
    plugin |= {"photon_count": 20000, "sampler": "independent", "direct_paths": 1}
    session = mi.load_dict(plugin).session(thin_fog(size=32), seed=3, spp=512)
    setting = session.pilot_setting()
    pixels = pilot_pixels(setting)
    pilot = run_pilot(setting, pixels, session.pilot_passes(setting, pixels))
    session.start()
    images = grey_pictures(session, 64)
    weights = 1 / (images.mean(axis=0) ** 2 + 0.1 * np.mean(images) ** 2)
    measured = LEFT * (images.var(axis=0, ddof=1) * weights).mean()
    assert 0.5 * measured < pilot.joined["relmse"] < 2 * measured
    choices = [pilot._predict(choice(pilot, share), 512) for share in (1.0, 0.25)]
    variances = [prediction.errors["relmse"].variance for prediction in choices]
    assert variances[1] - variances[0] > 2.9 * pilot.joined["relmse"]


def choice(pilot, share):
    return pilot._choose(share, 512, None, 0.0)


# --- Sessions -------------------------------------------------------------------------------------


def test_who_joins_photons():
    """Images that will be denoised, where radii are chosen; no weighted plugin, nor a sensor that
    no point is joined with."""
    scene = thin_fog()

    def zone(plugin="bdpm", scene=scene, **parameters):
        return mi.load_dict({"type": plugin, **parameters}).session(scene).near_zone

    assert zone(denoised=True) is not None
    assert zone() is None and zone(denoised=True, initial_radius=0.1) is None
    assert zone("bdpm_opt2", denoised=True) is None
    meter = {"type": "radiancemeter", "origin": [0, 0, 3.6], "direction": [0, 0, -1]}
    meter["film"] = film(1)
    assert zone(scene=fog_scene(homogeneous(), meter), denoised=True) is None


def test_recalled_sessions_render_the_same():
    """The zone and the radii are found again."""
    scene = fog_scene(homogeneous(), view(*WITHIN, medium=FOG))
    images = []
    plugin = mi.load_dict({"type": "bdpm", "denoised": True, "max_depth": 6})
    first = plugin.session(scene, seed=1, spp=16)
    second = plugin.session(scene, seed=1, spp=16)
    first.start()
    second.recall(first.learned)
    for session in (first, second):
        session.iterate()
        images.append(session.image())
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-5)


def test_beams_are_thinned_beyond_the_first_segment(monkeypatch):
    """A quarter of these is kept (within 5 standard errors: 6e-7), and of first ones all."""
    from mis_integrators.photons import queries
    from mis_integrators.photons.beams import read_beams
    from mis_integrators.pilot.setting import pilot_pixels

    glass = ball({"type": "dielectric"}, exterior=FOG)
    scene = fog_scene(homogeneous(), view(*WITHIN, size=64, medium=FOG), glass=glass)
    counts = []
    for share in (1.0, queries.BEAMS_KEPT):
        monkeypatch.setattr(queries, "BEAMS_KEPT", share)
        session = joined(scene, bdd=1)
        setting = session.pilot_setting()
        iteration = session.pilot_passes(setting, pilot_pixels(setting)).trace(0)
        beams = read_beams(iteration.vertices["beams"])
        there = np.array(dr.max(beams["throughput"])) > 0
        first = (np.array(beams["depth"]) & 0xFFFF) == 1
        counts.append([np.count_nonzero(there & part) for part in (first, ~first)])
    (first, others), (first_kept, kept) = counts
    assert first == first_kept > 300 and others > 300
    share = queries.BEAMS_KEPT
    assert abs(kept - share * others) < 5 * np.sqrt(share * (1 - share) * others)
