"""The plugin `bdpm` in participating media: images against `volpath` and closed forms, what counts
once, and what is refused.

The kernel blurs, and near the boundary of a medium its disk holds photons on one side only: a bias
that falls with the radius R. Estimates at R and R / 2 with the same photons are extrapolated to
R = 0; what is left of the bias is the `slack` of a comparison. False-alarm rate 1e-6 each; an error
of 2 % of the whole image and of 6 % of a quarter is seen with a probability of 0.95, where a test
says nothing else (`comparing`).
"""

from mis_integrators.photons import queries, trace

import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    PathBatches,
    SessionBatches,
    assert_same,
    block_means,
    collect_until,
    pictures,
)
from foggy import grid, oracle_for, pockets, view, volpath
from selection import extended, one_in_each_row
from test_bdpm import last_words
from test_bdpt_media import (
    FOG,
    NEAR_CLIP,
    SCENES,
    WITHIN,
    ball,
    cloud,
    coloured,
    fog_scene,
    hg,
    homogeneous,
    inner,
    single_scattering,
)
from worlds import T, diffuse, film, grey, look

RADIUS = 0.06
"""Of a scene two units wide."""
SLACK = 5e-3
"""Bias left after extrapolation, relative: seen are 1e-3 to 4e-3."""


def bdpm(**parameters):
    defaults = {"bdd": 0, "max_depth": 6, "camera_paths": 16, "photon_count": 20000}
    return mi.load_dict({"type": "bdpm", **defaults, **parameters})


class SmallRadiusBatches:
    """As `SessionBatches`, extrapolated to the radius zero: twice the estimate at half the radius
    less that at the radius, from the same photons."""

    def __init__(self, scene, blocks, radius=RADIUS, **parameters):
        self.blocks, self.batches = blocks, []
        self.sessions = [self.session(scene, r, parameters) for r in (radius, radius / 2)]

    def session(self, scene, radius, parameters):
        return bdpm(initial_radius=radius, **parameters).session(scene, seed=1, spp=0)

    def add(self, count):
        colours = 1 if mi.is_monochromatic else 3  # further channels are those for a denoiser
        for wide, narrow in zip(*(pictures(session, count) for session in self.sessions)):
            image = 2 * narrow[:, :, :colours] - wide[:, :, :colours]
            self.batches.append(block_means(image, self.blocks))

    def estimate(self):
        return Estimate.of(self.batches)


def agree_with_volpath(scene, max_depth=6, whole=0.02, block=0.06, **parameters):
    """`bdpm`, extrapolated to the radius zero, and `volpath` have the same mean in the image and in
    its quarters."""
    mine = SmallRadiusBatches(scene, 2, max_depth=max_depth, **parameters)
    oracle = oracle_for(max_depth, parameters.get("hide_emitters", False))
    oracle = PathBatches(oracle, scene, 2, 512)
    assert_same(*collect_until(mine, oracle, whole, block, most=600), whole, block, slack=SLACK)


USUAL = (("pockets", 1),)
"""Of `SCENES` and values of `bdd`, those of the default run."""


@pytest.mark.parametrize("name, bdd", one_in_each_row(sorted(SCENES), (0, 1, 2), USUAL))
def test_agrees_with_volpath(rgb, name, bdd):
    # All beams from within the fog share the few photons that are close to the sensor, unless paths
    # scatter once before; and of the light sub-paths from a sky, few meet the cube.
    visible, more = (0.02, 0.06), {}
    if name in ("sky", "sun"):
        visible = (0.05, 0.15)
    if name in ("sensor within", "lens within") and bdd == 0:
        visible = (0.08, 0.24)
        more = {"photon_count": 200000, "camera_paths": 4, "radius": 0.2}
    # Paths for direct light alone never scatter in media: what they miss counts for them, too.
    if bdd == 1:
        more = {"direct_paths": 3}
    agree_with_volpath(SCENES[name](), 6, *visible, bdd=bdd, **more)


@pytest.mark.extended
@pytest.mark.parametrize("variant_name", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_agrees_in_other_variants(variant_name):
    """Wavelengths have extinctions of their own."""
    mi.set_variant(variant_name)
    medium, sensor = grid(pockets, scale=3.0, g=0.3), view((0, 0.7, 4.2))
    if mi.is_spectral:
        slope = {"type": "spectrum", "value": [(360, 2.0), (830, 0.5)]}
        medium = homogeneous() | {"sigma_t": slope}
        # One iteration has one set of wavelengths; a narrow response takes their noise away.
        sensor["srf"] = {"type": "spectrum", "value": [(554, 0.0), (555, 1.0), (556, 0.0)]}
    scene = fog_scene(medium, sensor, ball=ball({"type": "plastic"}, exterior=FOG))
    agree_with_volpath(scene)


@pytest.mark.parametrize("max_depth, bdd", extended((2, 0), (1, 0), (2, 1), (3, 0), (1, 2), (3, 2)))
def test_depth_is_that_of_volpath(rgb, max_depth, bdd):
    """Boundaries do not count, half transparent ones included; what each depth adds is more than
    what is compared."""
    scene = fog_scene(
        homogeneous(),
        ball=ball({"type": "mask", "opacity": 0.4, "nested": diffuse()}, **inner()),
        sky={"type": "constant", "radiance": grey(0.4)},
    )
    agree_with_volpath(scene, max_depth, whole=0.02, block=0.05, bdd=bdd)


METAL = {"type": "roughconductor", "material": "Al", "alpha": 0.08}
MATT = {"type": "diffuse", "reflectance": 0.7}
COATED = {"type": "blendbsdf", "weight": 0.3, "a": MATT, "b": {**METAL, "alpha": 0.03}}


@pytest.mark.long
@pytest.mark.parametrize(
    "surface, bdd", [(COATED, 0), *extended((METAL, 0), (METAL, 1), (COATED, 1))]
)
def test_narrow_lobes_are_passed(rgb, surface, bdd):
    """Smooth metal in fog, or a matt ball with a smooth coat: paths go on, straight or not, and
    what is between it and the next vertex counts once, or for the coat only where photons bring the
    rest."""
    scene = fog_scene(homogeneous(0.7), ball=ball(surface, 0.7, exterior=FOG))
    assert bdpm(bdd=bdd).session(scene, spp=0).narrow.parted == (surface is COATED)
    agree_with_volpath(scene, bdd=bdd, direct_paths=3)


@pytest.mark.long
def test_a_mask_gathers_and_what_is_behind_it(rgb):
    """A half transparent screen: paths that go through it have asked for photons there."""
    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "nested": MATT}}
    place = T().translate([0, 0, 0.5]).scale(0.7)
    screen = {"type": "rectangle", "to_world": place, "bsdf": mask}
    agree_with_volpath(fog_scene(homogeneous(0.2), screen=screen), 5, bdd=0)


@pytest.mark.long
def test_light_through_a_half_transparent_ceiling(rgb):
    """Half of what the floor gets comes through a mask, from a sky that camera paths meet as often
    as next-event estimation finds it."""
    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "nested": diffuse()}}
    ceiling = {
        "type": "rectangle",
        "to_world": T().translate([0, 1.5, 0]).rotate([1, 0, 0], -90).scale(4),
        "bsdf": mask,
    }
    sky = {"type": "constant", "radiance": grey(0.4)}
    scene = fog_scene(homogeneous(0.2), lamp=None, ceiling=ceiling, sky=sky)
    agree_with_volpath(scene, 2, whole=0.05, block=0.15)


@pytest.mark.parametrize("bdd", [0, *extended(1)])
def test_coverage_is_that_of_volpath(rgb, bdd):
    """Alpha: what is not seen straight through the fog."""
    scene = fog_scene(coloured(), {**view((0, 0.7, 4.2)), "film": film(16, pixel_format="rgba")})
    spp = 4096 if bdd else 64  # a path that goes straight on finds the share of light itself
    mine = np.array(mi.render(scene, integrator=bdpm(initial_radius=0.1, bdd=bdd), spp=spp))[
        :, :, 3:
    ]
    right = np.array(mi.render(scene, integrator=volpath(max_depth=6), spp=4096))[:, :, 3:]
    assert np.count_nonzero((right > 0.2) & (right < 0.9)) > 50
    # 4096 samples of zero or one: 0.008 at most, and twice that with the channels' weights; five
    # times that, over 256 pixels.
    noise = 0.016 if bdd else 0.008
    assert np.abs(mine - right).max() < 5 * noise
    assert abs(mine.mean() - right.mean()) < noise / 4


# --- Closed forms -------------------------------------------------------------


@pytest.mark.parametrize(
    "albedo, g, bdd", [(1.0, 0.5, 1), *extended((0.5, 0.0, 0), (1.0, 0.5, 0), (1.0, -0.5, 0))]
)
def test_single_scattering_in_closed_form(rgb, albedo, g, bdd):
    """An infinite medium without any shape. (All pixels share the few photons close to the sensor:
    errors of 3 % and 8 % are seen.)"""
    sigma_t, distance, half_width, at = 0.7, 2.0, 0.5, (1.5, 0.3, 0.4)
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": {**homogeneous(sigma_t, albedo, hg(g)), "id": "fog"},
            "light": {"type": "point", "position": list(at), "intensity": 1.0},
            "sensor": {
                **view((0, 0, distance), fov=np.degrees(2 * np.arctan(half_width / distance))),
                "to_world": look((0, 0, distance), (0, 0, 0), (0, 1, 0)),
                "medium": FOG,
                "near_clip": NEAR_CLIP,
            },
        }
    )
    picture = single_scattering(sigma_t, albedo, g, at, 16, half_width, distance)
    exact = Estimate.exact(np.repeat(block_means(picture[:, :, None], 2), 3, axis=1))
    batches = SmallRadiusBatches(scene, 2, max_depth=2, photon_count=100000, bdd=bdd)
    batches.add(2)
    assert_same(*collect_until(batches, exact, 0.03, 0.08), 0.03, 0.08, slack=2e-3)


@pytest.mark.parametrize("bdd", extended(0, 1, 3))
def test_furnace(rgb, bdd):
    """A medium that absorbs nothing cannot be told from an even sky."""
    batches = SmallRadiusBatches(cloud(1.0), 2, max_depth=-1, rr_depth=100, bdd=bdd)
    batches.add(2)
    exact = Estimate.exact(np.ones((5, 3)))
    assert_same(*collect_until(batches, exact, 0.01, 0.02), 0.01, 0.02, slack=2e-3)


@pytest.mark.long
@pytest.mark.parametrize(
    "boundary, radius, left", [("null", 0.1, 0.03), ("dielectric", 0.25, 0.022)]
)
def test_walls_do_not_darken_what_is_dense(rgb, boundary, radius, left):
    """A ball under an even sky, five mean free paths wide on each side. Disks reach beyond it: if
    all of them counted in full, the image would be 8 % and 5 % too dark. 2 % are left."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": grey(1.0)},
            "ball": ball({"type": boundary}, 1.0) | {"interior": homogeneous(5.0, 0.9)},
            "sensor": view((0, 0, 4), fov=32, size=8),
        }
    )
    mine = SessionBatches(bdpm(initial_radius=radius, max_depth=24), scene, 1)
    truth = PathBatches(oracle_for(24), scene, 1, 512)
    assert_same(*collect_until(mine, truth, 0.015, 0.015), 0.015, 0.015, slack=left)


# --- Sessions -----------------------------------------------------------------


def small_scene():
    return fog_scene(homogeneous(2.0), ball=ball({"type": "dielectric"}, exterior=FOG))


@pytest.mark.long
def test_buffers_that_overflow_grow(rgb):
    """Nothing is lost: the image is that of a session with room enough."""
    images = []
    for little in (False, True):
        session = bdpm(initial_radius=0.1, camera_paths=1).session(small_scene(), seed=1, spp=0)
        if little:
            session.volume_capacity, session.beam_capacity = 16, 16
            session._freeze()
        session.iterate()
        assert min(session.volume_capacity, session.beam_capacity) > 100
        images.append(session.image())
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)


@pytest.mark.long
def test_radii_are_found_and_recalled(rgb):
    """Volume photons have a radius of their own, which another session of the render takes over."""
    session = bdpm(camera_paths=1).session(small_scene(), seed=1, spp=32)
    session.iterate()
    assert sorted(session.radii) == ["caustic", "indirect", "volume"]
    assert 0.01 < session.radii["volume"] < 0.3
    assert session.radii["volume"] not in (session.radii["caustic"], session.radii["indirect"])
    other = bdpm(camera_paths=1).session(small_scene(), seed=1, spp=32)
    other.recall(session.learned)
    other.iterate()
    np.testing.assert_allclose(other.image(), session.image(), rtol=1e-4, atol=1e-5)


def test_radius_without_surfaces(rgb):
    """A cloud under a sky: only volume photons are gathered."""
    session = bdpm(camera_paths=1).session(cloud(0.8), seed=1, spp=32)
    session.iterate()
    assert session.prediction is not None and 0.005 < session.radii["volume"] < 0.5


@pytest.mark.long
@pytest.mark.parametrize("bdd", [1, *extended(0)])
def test_classes_of_light_are_those_of_bdpt(rgb, bdd):
    """Direct, indirect and caustic light sum to the image, and have the shares that `bdpt`
    finds."""
    aovs = ",".join(f"{name}:{name}" for name in ("direct", "indirect", "caustic"))
    glass = ball({"type": "dielectric"}, 0.8, exterior=FOG)
    scene, means = fog_scene(homogeneous(0.5), ball=glass), []
    for integrator in (
        bdpm(initial_radius=0.03, aovs=aovs, bdd=bdd),
        mi.load_dict({"type": "bdpt", "max_depth": 6, "camera_paths": 16, "aovs": aovs}),
    ):
        image = np.array(mi.render(scene, integrator=integrator, spp=640)).mean(axis=(0, 1))
        assert image[3:].reshape(3, 3).sum(axis=0) == pytest.approx(image[:3], rel=1e-4)
        means.append(image[3:].reshape(3, 3).mean(axis=1) / image[:3].mean())
    # Other seeds differ by 0.003.
    assert means[1].min() > 0.03
    assert np.abs(means[0] - means[1]).max() < 0.01


def test_variance_and_time_limit(rgb):
    """A render of given seconds chooses its radii by the clock, and estimates its variance."""
    session = bdpm(camera_paths=1, variance=True).session(small_scene(), seed=1, spp=0)
    session.plan_time(2.0)
    session.iterate()
    session.iterate()
    assert session.prediction.iterations > 0 and session.radii["volume"] > 0
    image = session.image()
    assert np.isfinite(image).all() and image[6:10, 6:10].min() > 0


def test_scenes_without_media_trace_none_of_this(rgb, monkeypatch):
    """Nothing of volume photons and beams is called there."""
    from mis_integrators.integrators import photon_passes  # of this variant

    def forbidden(*args, **kwargs):
        raise AssertionError("called in a scene without media")

    for where, names in (
        (queries, ("next_hit_straight_on", "direct_light", "new_beams", "Sides")),
        (trace, ("new_volume_photons", "write_volume_photon")),
        (photon_passes, ("gather_along", "build_volume_map", "Beams")),
    ):
        for name in names:
            monkeypatch.setattr(where, name, forbidden)
    scene = {
        "type": "scene",
        "ball": ball(diffuse()),
        "lamp": {"type": "point", "position": [0, 2, 2]},
    }
    session = bdpm().session(mi.load_dict({**scene, "sensor": view((0, 0, 4))}), spp=16)
    session.iterate()
    assert "volume" not in session.radii and session.image().max() > 0
    fog = {**scene, "sensor": {**view(*WITHIN), "medium": homogeneous()}}
    with pytest.raises(AssertionError, match="called"):
        bdpm().session(mi.load_dict(fog), spp=16).iterate()


# --- What is refused ----------------------------------------------------------


def test_a_sensor_must_name_its_medium(rgb):
    with pytest.raises(Exception) as error:
        mi.render(fog_scene(homogeneous(), view(*WITHIN)), integrator=bdpm(), spp=16)
    assert "bdpm: the sensor stands in a medium" in last_words(error.value)
