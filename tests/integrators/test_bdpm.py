"""Behaviour of the plugin `bdpm`: strategies, seeds, films, limits, and errors."""

import contextlib
import dataclasses
import gc
import sys

from mis_integrators import render_views
from mis_integrators._plugins import PLUGINS
from mis_integrators.pilot.noise import MEASURES, trimmed_mean
from mis_integrators.pilot.result import PilotResult, PilotSamples, measure
from mis_integrators.pilot.setting import pilot_pixels

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    PathBatches,
    SessionBatches,
    agree,
    assert_same,
    block_means,
    collect_until,
    differences,
    extrapolate,
    in_one_thread,
    kernels_of,
    pictures,
    smallest_visible,
)
from pilots import learned
from selection import extended
from worlds import T, bdpm, diffuse, film, grey, lit_ball, look, path, sensor, tray


def box_scene(size=32, rfilter="box", film_options=None, light="area", **entries):
    """An open box of three walls with a ball, lit from above."""
    lights = {
        "area": {
            "type": "rectangle",
            "to_world": look((0, 0, 3), (0, 0, 0)) @ T().scale(0.8),
            "emitter": {"type": "area", "radiance": grey(4.0)},
        },
        "point": {"type": "point", "position": [0.5, -0.5, 3], "intensity": grey(8.0)},
        "none": diffuse(0.1),
    }
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(2.5), "bsdf": diffuse(0.7)},
            "back": {
                "type": "rectangle",
                "to_world": T().translate([0, 2.5, 0]).rotate([1, 0, 0], 90).scale(2.5),
                "bsdf": diffuse(0.5),
            },
            "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 0.5, "bsdf": diffuse(0.6)},
            "light": lights[light],
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": look((0, -5, 2.5), (0, 0, 0.6), (0, 0, 1)),
                "film": film(size, rfilter, **(film_options or {})),
            },
            **entries,
        }
    )


def glossy_box(**options):
    """As `box_scene`, with a glass and a plastic ball and a rough mirror: every pass is needed."""
    return box_scene(
        glass={
            "type": "sphere",
            "center": [-1.2, -0.5, 0.6],
            "radius": 0.4,
            "bsdf": {"type": "dielectric"},
        },
        plastic={
            "type": "sphere",
            "center": [1.2, -0.5, 0.6],
            "radius": 0.4,
            "bsdf": {"type": "plastic"},
        },
        metal={
            "type": "sphere",
            "center": [0, -1.3, 0.4],
            "radius": 0.3,
            "bsdf": {"type": "roughconductor", "alpha": 0.3},
        },
        **options,
    )


def render(scene, seed=0, spp=8, **parameters):
    return np.array(
        mi.render(
            scene,
            integrator=bdpm(camera_paths=1, photon_count=3000, **parameters),
            seed=seed,
            spp=spp,
        )
    )


def last_words(error):
    """The message of what `mi.render` wraps, else of the error itself."""
    while error.__cause__:
        error = error.__cause__
    return str(error).strip().splitlines()[-1]


# --- Strategies and bias ------------------------------------------------------


@pytest.mark.parametrize("first, second", [(0, 1), *extended((1, 2), (2, 3))])
def test_strategies_agree(rgb, first, second):
    scene = glossy_box(size=48)
    a, b = (
        SessionBatches(bdpm(bdd=bdd, initial_radius=0.03), scene, 3, seed=bdd + 1)
        for bdd in (first, second)
    )
    assert_same(*collect_until(a, b, block=0.05, most=600), block=0.05)


@pytest.mark.long
@in_one_thread
def test_bias_falls_with_the_square_of_the_radius(rgb):
    """Where irradiance is curved, E'' R^2 / 8: the bias at R over that at R / 2 is 4, and R -> 0 is
    unbiased.

    The middle of the floor right under a low point light seen through a pane: E = I h / (r^2 +
    h^2)^1.5 exactly, Laplacian at the middle -6 E / h^2; so a disk of radius R is off by -(3/4) (R
    / h)^2 there, to first order.
    """
    height = 0.5
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "point", "position": [0, 0, height], "intensity": 1.0},
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.5)},
            "pane": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 0.3]).scale(3),
                "bsdf": {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0},
            },
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 0.2), (0, 0, 0)) @ T().scale([0.004, 0.004, 1]),
                "film": film(4),
            },
        }
    )
    exact = 0.5 / np.pi / height**2
    radii, estimates = (0.2, 0.1414, 0.1), []
    for seed, radius in enumerate(radii):
        batches = SessionBatches(
            bdpm(bdd=0, max_depth=3, initial_radius=radius, photon_count=40000, camera_paths=1),
            scene,
            1,
            seed,
        )
        batches.add(80)
        estimates.append(batches.estimate())
    disk = [
        2 * height * (1 / height - 1 / np.hypot(height, r)) / r**2 * height**2 * exact
        for r in radii
    ]
    for estimate, expected in zip(estimates, disk):  # the mean over the disk in closed form
        # The pane lifts rays by Mitsuba's 1e-4 or so: for the floor, the lamp is that much lower.
        exactly = Estimate.exact(np.full_like(estimate.mean, expected))
        assert not differences(estimate, exactly, slack=6e-4)
    bias = [1 - e.mean[0, 0] / exact for e in estimates]
    slope = np.polyfit(np.log(radii), np.log(bias), 1)[0]
    assert 1.6 < slope < 2.3, (slope, bias)
    assert abs(extrapolate(radii, estimates).mean[0, 0] / exact - 1) < 0.02


def test_alpha_shrinks_the_radius(rgb):
    """R_i^2 = R_0^2 (i + 1)^(alpha - 1): two iterations with alpha = 0.5 are the mean of one at R_0
    and one at R_0 2^-1/4."""
    scene = box_scene()
    both = bdpm(bdd=0, alpha=0.5, initial_radius=0.2).session(scene, 0, 3, 0)
    both.iterate()
    first = both.image()
    both.iterate()
    second = 2 * both.image() - first
    small = bdpm(bdd=0, initial_radius=0.2 * 2**-0.25).session(scene, 0, 3, 0)
    small.iterate()
    one = small.image()
    small.iterate()
    np.testing.assert_allclose(second, 2 * small.image() - one, rtol=2e-3, atol=1e-4)


@pytest.mark.extended
def test_alpha_leaves_the_mean(rgb):
    agree(
        bdpm(alpha=0.7, initial_radius=0.08, bdd=0), path(rr_depth=50), tray("lambertian", "point")
    )


# --- Seeds --------------------------------------------------------------------


@pytest.mark.parametrize("bdd", [0, 1])
def test_same_seed_same_image(rgb, bdd):
    scene = glossy_box()
    a, b = (render(scene, 5, bdd=bdd) for _ in range(2))
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-7)


def test_same_seed_same_edges(rgb):
    """The probes of the correction at edges belong to a path's vertices, not to their places in a
    buffer, which chance decides."""
    images = []
    for _ in range(2):
        session = bdpm(bdd=0, initial_radius=0.0, photon_count=3000).session(
            glossy_box(size=128), seed=5
        )
        session.recall(learned(session, 0.3))
        session.iterate()
        images.append(session.image())
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6)


def test_iteration_depends_on_its_index_alone(rgb):
    """A render of 4 is the first half of a render of 8, and a session is the same as a render."""
    scene = glossy_box()
    session = bdpm(camera_paths=1, photon_count=3000).session(scene, 0, 7, 0)
    for _ in range(4):
        session.iterate()
    np.testing.assert_allclose(session.image(), render(scene, 7, 4), rtol=1e-4, atol=1e-6)
    for _ in range(4):
        session.iterate()
    np.testing.assert_allclose(session.image(), render(scene, 7, 8), rtol=1e-4, atol=1e-6)


def test_seeds_and_iterations_are_uncorrelated(rgb):
    """Correlation of the pixels' noise over pairs of renders, of different seeds and iterations:
    below 0.2, four to five standard deviations of chance (0.04 to 0.06: neighbouring pixels share
    photons). With random numbers in common it is far above."""
    scene, sampler = glossy_box(size=32), "independent"
    mean = render(scene, 1000, 256).mean(axis=2)
    session = bdpm(camera_paths=1, photon_count=3000, sampler=sampler).session(scene, 0, 3, 0)
    images = [render(scene, seed, 1, sampler=sampler).mean(axis=2) for seed in (0, 1, 2, 3)]
    images += [picture.mean(axis=2) for picture in pictures(session, 3)]
    noise = [(i - mean).ravel() for i in images[:3]] + [(i - mean).ravel() for i in images[4:]]
    # a caustic's fireflies would be all that counts
    noise = [np.clip(n, *np.quantile(n, [0.02, 0.98])) for n in noise]
    table = np.corrcoef(noise) - np.eye(len(noise))
    assert np.abs(table).max() < 0.2, table.round(2)
    assert not np.array_equal(images[0], images[1])
    # seed 3 is the session's
    np.testing.assert_allclose(images[3], images[4], rtol=1e-3, atol=1e-6)


@pytest.mark.extended
def test_error_falls_with_iterations(rgb):
    """Variance of block means over seeds: with 4 times the iterations, a quarter (within a factor
    of 2.5)."""
    scene = box_scene(light="point")
    few, many = (
        np.array(
            [block_means(render(scene, seed + 100 * n, n, bdd=0), 2)[:, 0] for seed in range(24)]
        )
        for n in (2, 8)
    )
    ratio = (few.var(axis=0, ddof=1) / many.var(axis=0, ddof=1)).mean()
    assert 1.6 < ratio < 10, ratio  # 24 seeds, 5 regions: a factor 2.5 is 4 sigma


# --- Variance AOV -------------------------------------------------------------


@pytest.mark.parametrize("rfilter", ["box", pytest.param("gaussian", marks=pytest.mark.full)])
@in_one_thread
def test_variance_is_that_of_the_mean(rgb, rfilter):
    """Mean over the image of the estimated variance, against that of 32 seeds: within 15 % (its own
    error is 3 %)."""
    scene = box_scene(16, rfilter)
    images = np.array([render(scene, seed, 8, variance=True) for seed in range(32)])
    assert images.shape[-1] == 6
    empirical, estimated = images[..., :3].var(axis=0, ddof=1).mean(), images[..., 3:].mean()
    assert estimated == pytest.approx(empirical, rel=0.15)


@pytest.mark.parametrize(
    "variant_name, names",
    [
        ("llvm_ad_rgb", ["var.R", "var.G", "var.B"]),
        ("llvm_ad_mono", ["var.Y"]),
        ("llvm_ad_spectral", ["var.R", "var.G", "var.B"]),
    ],
)
def test_variance_channels(variant_name, names):
    mi.set_variant(variant_name)
    scene = box_scene(8, film_options={"pixel_format": "luminance" if len(names) == 1 else "rgb"})
    integrator = bdpm(variance=True)
    assert integrator.aov_names() == names
    session = integrator.session(scene, 0, 0, 16)
    assert session.channels[-len(names) :] == names and session.iterations_planned == 2
    session.iterate()
    session.iterate()
    image = session.image()
    assert (
        image.shape == (8, 8, len(session.channels))
        and (image[..., -len(names) :] >= 0).all()
        and image[..., -1].max() > 0
    )
    assert np.array(mi.render(scene, integrator=integrator, spp=16)).shape == image.shape


def test_variance_needs_two_iterations(rgb):
    with pytest.raises(Exception) as error:
        render(box_scene(8), spp=1, variance=True)
    assert "bdpm" in last_words(error.value) and "at least two iterations" in last_words(
        error.value
    )


# --- Film ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "rfilter, bdd", [("gaussian", 1), *extended(("box", 0), ("box", 1), ("gaussian", 0))]
)
def test_crop_is_the_cropped_window(rgb, rfilter, bdd):
    window = {"crop_offset_x": 8, "crop_offset_y": 16, "crop_width": 16, "crop_height": 8}
    crop = box_scene(32, rfilter, window)
    integrator = bdpm(bdd=bdd, initial_radius=0.08)
    image = np.array(mi.render(crop, integrator=integrator, spp=512))
    whole = np.array(mi.render(box_scene(32, rfilter), integrator=integrator, spp=512, seed=1))
    assert image.shape == (8, 16, 3)

    def off(dx, dy):
        there = whole[16 + dy : 24 + dy, 8 + dx : 24 + dx]
        return np.abs(image / there - 1).mean()

    np.testing.assert_allclose(
        image.mean(axis=(0, 1)), whole[16:24, 8:24].mean(axis=(0, 1)), rtol=0.02
    )
    assert off(0, 0) < 0.06
    # No other place fits as well: the window is not a pixel off, to any side.
    assert all(
        off(dx, dy) > 3 * off(0, 0) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0)
    )


@pytest.mark.thinned(5, 2)
@pytest.mark.parametrize(
    "rfilter, border",
    [
        ("mitchell", True),
        *extended(
            ("mitchell", False),
            *((rfilter, False) for rfilter in ("gaussian", "tent", "lanczos", "catmullrom")),
            *((rfilter, True) for rfilter in ("gaussian", "tent", "lanczos", "catmullrom")),
        ),
    ],
)
@in_one_thread
def test_reconstruction_filters(rgb, rfilter, border):
    """Means of border rows and columns and of the whole agree with `path`, whatever the filter and
    its border."""
    scene = box_scene(16, rfilter, {"sample_border": border})
    a, b = (
        np.array(
            [np.array(mi.render(scene, integrator=i, seed=seed, spp=spp)) for seed in range(12)]
        )
        for i, spp in ((bdpm(), 64), (path(), 256))
    )
    for region in (
        np.s_[:, :, :],
        np.s_[:, 0, :],
        np.s_[:, -1, :],
        np.s_[:, :, 0],
        np.s_[:, :, -1],
    ):
        means = [Estimate.of(x[region].reshape(12, -1, 3).mean(axis=1)[:, None]) for x in (a, b)]
        assert not differences(*means), region
        assert np.sqrt(means[0].error2.max()) < 0.02 * means[0].mean.max()


@pytest.mark.extended
def test_alpha_channel_is_that_of_path(rgb):
    for hide in (False, True):
        scene = mi.load_dict(
            {
                "type": "scene",
                "ball": {"type": "sphere", "bsdf": diffuse()},
                "glass": {
                    "type": "sphere",
                    "center": [2, 0, 0],
                    "radius": 0.7,
                    "bsdf": {"type": "dielectric"},
                },
                "mask": {
                    "type": "rectangle",
                    "to_world": T().translate([-2, 0, 0]).scale(0.7),
                    "bsdf": {"type": "mask", "opacity": 0.5, "bsdf": diffuse()},
                },
                "lamp": {
                    "type": "sphere",
                    "center": [0, 2, 0],
                    "radius": 0.6,
                    "emitter": {"type": "area", "radiance": 2.0},
                },
                "sky": {"type": "constant", "radiance": 0.5},
                "sensor": {
                    "type": "orthographic",
                    "to_world": look((0, 0, 5), (0, 0, 0)) @ T().scale([3, 3, 1]),
                    "film": film(24, pixel_format="rgba"),
                },
            }
        )
        images = [
            np.array(mi.render(scene, integrator=i, spp=256))
            for i in (bdpm(hide_emitters=hide), path(hide_emitters=hide))
        ]
        assert images[0].shape == (24, 24, 4)
        # 256 samples: 5 sigma is 0.16
        np.testing.assert_allclose(images[0][..., 3], images[1][..., 3], atol=0.2)
        assert np.abs(images[0][..., 3] - images[1][..., 3]).mean() < 0.02
        np.testing.assert_allclose(
            images[0].mean(axis=(0, 1)), images[1].mean(axis=(0, 1)), rtol=0.03
        )


@pytest.mark.parametrize("hide, bdd", [(True, 0), *extended((False, 0), (False, 1), (True, 1))])
def test_hidden_emitters(rgb, hide, bdd):
    """A lamp and a sky in view."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere", "bsdf": diffuse()},
            "lamp": {
                "type": "sphere",
                "center": [1.2, 1.2, 0.6],
                "radius": 0.6,
                "emitter": {"type": "area", "radiance": 1.0},
            },
            "sky": {"type": "constant", "radiance": 0.5},
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 5), (0, 0, 0)) @ T().scale([1.4, 1.4, 1]),
                "film": film(32),
            },
        }
    )
    agree(bdpm(bdd=bdd, hide_emitters=hide), path(hide_emitters=hide), scene, blocks=2)


# --- Limits -------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["nothing", "no emitters", "black emitter"])
def test_darkness(rgb, scene):
    scene = {
        "nothing": mi.load_dict({"type": "scene", "sensor": sensor(size=8)}),
        "no emitters": box_scene(8, light="none"),
        "black emitter": box_scene(8, light="none", lamp={"type": "point", "intensity": 0.0}),
    }[scene]
    for bdd in (0, 1):
        assert not render(scene, bdd=bdd).any()


def test_light_that_meets_nothing(rgb):
    scene = mi.load_dict(
        {
            "type": "scene",
            "lamp": {"type": "point", "position": [0, 0, 0]},
            "sensor": sensor(size=8),
        }
    )
    assert not render(scene).any()


@pytest.mark.parametrize(
    "max_depth",
    [0, *extended(1, 2, 3), *(pytest.param(depth, marks=pytest.mark.full) for depth in (4, 5))],
)
def test_max_depth(rgb, max_depth):
    """Whole paths are cut at the same length as `path` cuts them, for all bdd (1.5 % of the whole
    image)."""
    scene = glossy_box(size=24)
    if max_depth == 0:
        assert not any(render(scene, bdd=bdd, max_depth=0).any() for bdd in range(4))
        return
    oracle = PathBatches(path(max_depth=max_depth, rr_depth=50), scene, 1, spp=256)
    oracle.add(16)
    for bdd in range(4):
        side = SessionBatches(
            bdpm(bdd=bdd, max_depth=max_depth, initial_radius=0.03), scene, 1, seed=bdd
        )
        assert_same(*collect_until(side, oracle, whole=0.015), whole=0.015)


@pytest.mark.parametrize("bdd", [1, *extended(0)])
def test_direct_light_of_directionalarea(rgb, bdd):
    """Next-event estimation cannot make it, so photons do, at max_depth = 2 as well: L = rho / pi M
    cos(theta)."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.5)},
            "lamp": {
                "type": "rectangle",
                "to_world": look((0, 0, 3), (0, 0, 0)) @ T().scale(2),
                "emitter": {"type": "directionalarea", "radiance": 2.0},
            },
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "to_world": look((0, 0, 2), (0, 0, 0)),
                "film": film(16),
            },
        }
    )
    oracle = np.array(
        mi.render(scene, integrator=mi.load_dict({"type": "ptracer", "max_depth": 2}), spp=4096)
    ).mean()
    for max_depth in (2, 3, -1):
        image = render(scene, bdd=bdd, max_depth=max_depth, initial_radius=0.1, spp=64)
        assert image.mean() == pytest.approx(oracle, rel=0.02)  # 5 sigma of 200,000 photons


@pytest.mark.thinned(2, 2)
@pytest.mark.parametrize(
    "rr_depth, bdd", [(1, 2), *extended((1, 0), (2, 0), (2, 2), (50, 0), (50, 2))]
)
def test_roulette_leaves_the_mean(rgb, bdd, rr_depth):
    agree(
        bdpm(bdd=bdd, rr_depth=rr_depth, max_depth=-1),
        path(max_depth=-1, rr_depth=50),
        tray("lambertian", "rectangle"),
    )


@pytest.mark.parametrize("camera_paths, photon_count", extended((7, 3000), (2, 50000), (16, 0)))
def test_numbers_of_paths_leave_the_mean(rgb, camera_paths, photon_count):
    agree(
        bdpm(bdd=0, camera_paths=camera_paths, photon_count=photon_count),
        path(rr_depth=50),
        tray("lambertian", "rectangle"),
    )


@contextlib.contextmanager
def said():
    """The lines that Mitsuba's log gets meanwhile."""
    lines = []

    class Listener(mi.Appender):
        def append(self, level, text):
            lines.append(text)

        def log_progress(self, *args):
            pass

    listener = Listener()
    logger = mi.Thread.thread().logger() if hasattr(mi, "Thread") else mi.logger()
    logger.add_appender(listener)
    try:
        yield lines
    finally:
        logger.remove_appender(listener)


def test_rounding_up_is_said_once(rgb):
    with said() as lines:
        mi.render(box_scene(8), integrator=bdpm(camera_paths=4), spp=10)
        rounded = [text for text in lines if "rounded up" in text]
        assert len(rounded) == 1 and "10 samples" in rounded[0] and "3 iterations" in rounded[0]
        lines.clear()
        mi.render(box_scene(8), integrator=bdpm(camera_paths=4), spp=8)
        assert not [text for text in lines if "rounded up" in text]


@pytest.mark.parametrize(
    "plugin, sampler",
    [
        ("bdpm", "multijitter"),
        ("volpath_multiview", "multijitter"),
        ("volpath_multiview", "independent"),
        *extended(
            ("bdpt", "multijitter"),
            ("bdpm_auto", "multijitter"),
            *((plugin, "independent") for plugin in ("bdpm", "bdpt", "bdpm_auto")),
        ),
    ],
)
def test_samplers_that_are_not_used_are_named_once(rgb, plugin, sampler):
    """By `mi.render`, and for `mis-render` in the remarks of the session."""
    scene = lit_ball(4, 4, sampler={"type": sampler, "sample_count": 4})
    integrator = mi.load_dict({"type": plugin, "max_depth": 2, "sampler": "independent"})
    with said() as lines:
        for seed in range(2):
            mi.render(scene, integrator=integrator, seed=seed)
    session = integrator.session(scene, spp=4)
    session.iterate()
    for texts in (lines, session.remarks):
        found = [text for text in texts if "Sampler" in text]
        assert len(found) == (sampler != "independent")
        assert all("Multijitter" in t and '"sampler" = independent' in t for t in found)


# --- Buffers ------------------------------------------------------------------


def with_capacity(scene, photons=None, vertices=None, **parameters):
    session = bdpm(camera_paths=2, photon_count=3000, **parameters).session(scene, 0, 3, 0)
    if photons is not None:
        session.photon_capacity = photons
    if vertices is not None:
        session.vertex_capacity = vertices
    session._freeze()
    for _ in range(3):
        session.iterate()
    return session.image()


@pytest.mark.parametrize("bdd", [1, *extended(0)])
def test_photons_that_overflow_are_not_lost(rgb, bdd):
    scene = glossy_box()
    np.testing.assert_allclose(
        with_capacity(scene, photons=7, bdd=bdd),
        with_capacity(scene, bdd=bdd),
        rtol=1e-3,
        atol=1e-6,
    )


def test_photons_that_overflow_later_are_not_lost(rgb):
    """The passes are recorded when an iteration overflows: none of them may go on with the old
    room."""
    sessions = [
        bdpm(bdd=0, camera_paths=2, photon_count=3000, initial_radius=0.05).session(
            box_scene(16), 0, 3, 0
        )
        for _ in range(2)
    ]
    room, tight = sessions
    room.photon_capacity = 1 << 16
    room._freeze()
    images = dict(enumerate(pictures(room, 8)))
    found = {}
    for number in range(8):
        room._photons(number, room._spectral(number))
        found[number] = round(room.photons_a_path * room.light_path_count)
    order = sorted(found, key=found.get)
    tight.photon_capacity = found[order[4]]
    tight._freeze()
    for done, number in enumerate(order):
        before = done * tight.image().astype(np.float64) if done else 0.0
        tight.iterate(number)
        np.testing.assert_allclose(
            (done + 1) * tight.image().astype(np.float64) - before,
            images[number],
            rtol=1e-3,
            atol=1e-4,
        )
    assert tight.photon_capacity > found[order[-1]] > found[order[4]]


def test_vertices_that_overflow_are_not_lost(rgb):
    scene = glossy_box()  # plastic and glass: several vertices a path
    np.testing.assert_allclose(
        with_capacity(scene, vertices=11), with_capacity(scene), rtol=1e-3, atol=1e-6
    )


def test_vertices_that_overflow_in_the_pilot_are_not_lost(rgb, monkeypatch):
    scene, radii = glossy_box(), []
    for room in (None, 11):
        session = bdpm(bdd=1, initial_radius=0.0).session(scene, seed=1, spp=4)
        if room:
            monkeypatch.setattr(session, "_vertex_room", lambda paths, room=room: room)
        session.start()
        radii.append(session.radii)
    assert radii[0].keys() == radii[1].keys() == {"caustic", "indirect"}
    for kind, radius in radii[0].items():
        assert radii[1][kind] == pytest.approx(radius, rel=0.05)


def test_pilots_find_the_room_that_vertices_need(rgb):
    """No iteration after one has to trace its camera paths twice."""
    session = bdpm(bdd=1, initial_radius=0.0).session(glossy_box(), seed=1, spp=32)
    session.vertex_capacity = 11
    session.start()
    room = session.vertex_capacity
    for _ in range(4):
        session.iterate()
    assert session.vertex_capacity == room > 11


def test_pilots_find_the_room_that_photons_need(rgb, monkeypatch):
    """Light sub-paths leave more photons than were expected before the first pass: it is recorded
    anew once for the pilot, but not for the render, which has twice as many."""
    session = bdpm(bdd=0, initial_radius=0.0, photon_count=16384).session(
        box_scene(), seed=1, spp=32
    )
    kind = type(session)
    monkeypatch.setattr(kind, "_photon_room", small_first(kind._photon_room))
    session._make_room_for_photons()
    recorded, trace = [], kind._trace_light
    monkeypatch.setattr(
        kind,
        "_trace_light",
        lambda *arguments: recorded.append(arguments[0].light_path_count) or trace(*arguments),
    )
    session._freeze()
    for _ in range(4):
        session.iterate()
    assert recorded == [8192, 8192, 16384]


def small_first(room):
    """`_photon_room`, but for a hundredth of the three photons a path that are expected first."""
    return lambda session, a_path: room(session, a_path / 100 if a_path == 3 else a_path)


@pytest.mark.parametrize("chunk", [333, *extended(1024)])
def test_camera_pass_in_parts(rgb, monkeypatch, chunk):
    scene = glossy_box()
    whole = with_capacity(scene)
    monkeypatch.setattr(sys.modules["mis_integrators.integrators.bdpm"], "CAMERA_CHUNK", chunk)
    np.testing.assert_allclose(with_capacity(scene), whole, rtol=1e-3, atol=1e-6)


# --- Surfaces that photons must not pass --------------------------------------


def two_sided(*bsdfs):
    return {"type": "twosided", **{f"b{i}": b for i, b in enumerate(bsdfs)}}


def lit_from_one_side(thickness=0.0):
    """A wall between a lit half space and a dark one, seen from the dark side (`thickness` 0: one
    surface, else two)."""
    walls = {"wall": {"type": "rectangle", "bsdf": two_sided(diffuse(0.9))}}
    if thickness or thickness is None:
        gap = thickness or 0.0
        walls = {
            "wall": {"type": "rectangle", "bsdf": diffuse(0.9)},
            "behind": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, -gap]).rotate([1, 0, 0], 180),
                "bsdf": diffuse(0.8),
            },
        }
    return mi.load_dict(
        {
            "type": "scene",
            **walls,
            "lamp": {"type": "point", "position": [0, 0, 1], "intensity": 5.0},
            "ceiling": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 1.5]).rotate([1, 0, 0], 180),
                "bsdf": diffuse(0.91),
            },
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, -3), (0, 0, 0)) @ T().scale([0.8, 0.8, 1]),
                "film": film(16),
            },
        }
    )


@pytest.mark.thinned(4, 1, 3)
@pytest.mark.parametrize("thickness", [0.0, None, 1e-4, 0.01])
@pytest.mark.parametrize("bdd", [0, 1])
def test_no_light_leaks_through_a_wall(rgb, thickness, bdd):
    """The dark side of a wall is black: one two-sided surface, two opposite faces in one plane, and
    thin walls (R = 0.2)."""
    image = render(lit_from_one_side(thickness), bdd=bdd, initial_radius=0.2, spp=32)
    assert image.max() == 0


def test_no_light_leaks_around_a_corner(rgb):
    """A wall that the light only grazes from its front does not catch the photons of a bright floor
    beside it."""
    # the wall's front looks away from the lamp
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(1), "bsdf": diffuse(0.9)},
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 1, 0]).rotate([1, 0, 0], -90),
                "bsdf": diffuse(0.9),
            },
            "ceiling": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180),
                "bsdf": diffuse(0.91),
            },
            "lamp": {"type": "point", "position": [0, 0, 1.5], "intensity": 5.0},
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 3, 0.5), (0, 1, 0.5), (0, 0, 1)) @ T().scale([0.5, 0.4, 1]),
                "film": film(16),
            },
        }
    )
    assert render(scene, bdd=0, initial_radius=0.3, spp=32).max() == 0


@pytest.mark.long
@pytest.mark.parametrize(
    "plugin, spp",
    [
        ({"type": "bdpm", "bdd": 0}, 8),
        ({"type": "vcm"}, 8),
        ({"type": "bdpm_opt", "weights": "published", "strategies": 2}, 1),
    ],
    ids=["bdpm", "vcm", "published"],
)
def test_no_light_through_curved_sheets(rgb, plugin, spp):
    """Nothing leaves a closed lampshade, however wide the merge disks are on its outside: light
    that grazes its inside comes from beyond the plane through a vertex close by."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "shade": {
                "type": "sphere",
                "bsdf": {"type": "twosided", "both": diffuse(0.8)},
            },
            "lamp": {"type": "point", "position": [0, 0.5, 0], "intensity": 5.0},
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 3), (0, 0, 0)) @ T().scale([0.9, 0.9, 1]),
                "film": film(16),
            },
        }
    )
    integrator = mi.load_dict({**plugin, "max_depth": 5, "initial_radius": 0.4})
    assert np.array(mi.render(scene, integrator=integrator, spp=spp, seed=1))[..., :3].max() == 0


@pytest.mark.long
def test_sheets_that_let_light_through_keep_their_photons(rgb):
    """Two thin diffusers back to back, far closer than R, pass light on in all directions: each
    gathers its own photons, not both."""
    sheet = {
        "type": "principledthin",
        "base_color": {"type": "rgb", "value": 0.8},
        "roughness": 0.9,
        "diff_trans": 1.0,
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "upper": {"type": "rectangle", "to_world": T().scale(5), "bsdf": sheet},
            "lower": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, -0.002]).rotate([1, 0, 0], 180).scale(5),
                "bsdf": sheet,
            },
            "ceiling": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(5),
                "bsdf": diffuse(0.9),
            },
            "lamp": {"type": "point", "position": [0, 0, 1], "intensity": 5.0},
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, -3), (0, 0, 0)),
                "film": film(16),
            },
        }
    )
    agree(bdpm(bdd=0, max_depth=5, initial_radius=0.05), path(max_depth=5), scene, blocks=2)


@pytest.mark.parametrize("bdd", [1, *extended(0)])
def test_merged_shapes(rgb, bdd):
    """Mitsuba merges shapes that share a BSDF into one mesh: photons must be found there too."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(6), "bsdf": diffuse(0.6)},
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(6),
                "bsdf": diffuse(0.6),
            },
            "lamp": {"type": "point", "position": [0, 0, 3], "intensity": 6.0},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look((0, 0, 2), (1, 0, 0)),
                "film": film(24),
            },
        }
    )
    agree(bdpm(bdd=bdd, max_depth=4, initial_radius=0.1), path(max_depth=4), scene, blocks=2)


@pytest.mark.parametrize("lamps", [2, *extended(1)])
def test_shapes_without_points_to_sample(rgb, tmp_path, lamps):
    """Instances and curves have no points on them to give, and are not asked for any: they are no
    lamps. (`path` 2 % and 5 %.)"""
    curve = tmp_path / "curve.txt"
    curve.write_text("".join(f"{i * 0.3 - 1.2} -1 0.4 0.15\n" for i in range(9)))
    lamp = {
        "type": "sphere",
        "center": [1.5, -1, 2.5],
        "radius": 0.5,
        "emitter": {"type": "area", "radiance": grey(2.0)},
    }
    scene = box_scene(
        size=24,
        curve={"type": "bsplinecurve", "filename": str(curve), "bsdf": diffuse(0.6)},
        group={
            "type": "shapegroup",
            "cube": {"type": "cube", "to_world": T().scale(0.3), "bsdf": diffuse(0.8)},
            "ball": {
                "type": "sphere",
                "center": [0, 0, 0.7],
                "radius": 0.4,
                "bsdf": {"type": "roughconductor", "alpha": 0.3},
            },
        },
        copy={
            "type": "instance",
            "to_world": T().translate([1.3, 0, 0.5]).rotate([0, 0, 1], 30),
            "of": {"type": "ref", "id": "group"},
        },
        **({"lamp": lamp} if lamps == 2 else {}),
    )
    agree(bdpm(bdd=1), path(), scene, blocks=2, whole=0.02, block=0.05, most=200)


def point_film():
    return {
        "type": "hdrfilm",
        "width": 1,
        "height": 1,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }


@in_one_thread
def test_a_camera_that_sees_one_point(rgb):
    """The automatic radius then follows from the photons, not from the spread of what is seen:
    indirect light, two fifths here, is not lost."""
    scene = box_scene(
        sensor={
            "type": "radiancemeter",
            "origin": [0, -5, 2.5],
            "direction": [0, 5, -2.3],
            "film": point_film(),
        }
    )
    a = SessionBatches(
        mi.load_dict(
            {"type": "bdpm", "bdd": 0, "max_depth": 4, "photon_count": 4000, "camera_paths": 64}
        ),
        scene,
        1,
        seed=2,
    )
    b = PathBatches(path(), scene, 1, spp=8192)
    a.add(150)
    b.add(16)
    assert smallest_visible(a.estimate(), b.estimate())[0] < 0.25, "test too weak"
    # a disk around one point is as wrong as its light is curved
    assert not differences(a.estimate(), b.estimate(), slack=0.05)
    assert a.session.radii["indirect"] > 0.03


@pytest.mark.parametrize("plugin", ["bdpm", *extended("bdpt")])
def test_irradiance_meter(rgb, plugin):
    """A sensor of another kind, on a surface, under a lamp and a sky (5 % of its one value)."""
    scene = box_scene(
        sensor=diffuse(0.1),
        sky={"type": "constant", "radiance": 0.3},
        ball={
            "type": "sphere",
            "center": [0, 0, 1],
            "radius": 0.5,
            "sensor": {"type": "irradiancemeter", "film": point_film()},
        },
    )
    radius = {"initial_radius": 0.05} if plugin == "bdpm" else {}
    agree(
        mi.load_dict({"type": plugin, "max_depth": 4, "camera_paths": 4096, **radius}),
        path(),
        scene,
        blocks=1,
        whole=0.05,
        block=0.05,
        spp=16384,
    )


def test_rare_photons_get_no_smallest_radius(rgb):
    """Where the pilot meets no photon at all, nothing speaks for the smallest radius that it
    tries."""
    scene = box_scene(16)
    session = bdpm(bdd=0, photon_count=1, initial_radius=0.0).session(scene, seed=1, spp=4)
    setting = session.pilot_setting()
    samples = PilotSamples(
        {"indirect": np.array([0.01 * 2**i for i in range(7)])},
        {"indirect": 0.0},
        {"indirect": np.zeros((4, 7, 1, 256))},
        np.ones((4, 1, 256)),
        np.zeros(256),
    )
    choice = measure(setting, pilot_pixels(setting), samples, 1.0).choose(100)
    assert choice.radii["indirect"] == pytest.approx(0.16)


# --- Camera paths of an iteration ---------------------------------------------


@pytest.mark.parametrize(
    "plugin, given, camera_paths",
    [
        ("bdpm", {"bdd": 0}, 8),
        *extended(
            ("bdpm", {"bdd": 0}, 2),
            *(("bdpm", {"bdd": 1}, paths) for paths in (2, 8)),
            *(("bdpm_opt2", {}, paths) for paths in (2, 8)),
        ),
    ],
)
@in_one_thread
def test_noise_of_several_camera_paths_is_foreseen(rgb, plugin, given, camera_paths):
    """The pilot has as many: within a factor 1.3 of twelve iterations, the geometric mean of three
    renders. (Its law is that of independent numbers.)"""
    integrator = mi.load_dict(
        {
            "type": plugin,
            "max_depth": 4,
            "photon_count": 20000,
            "camera_paths": camera_paths,
            "sampler": "independent",
            "direct_paths": 1,
            **given,
        }
    )
    scene, ratios = glossy_box(size=48), {name: [] for name in MEASURES}
    for seed in range(3):
        session = integrator.session(scene, seed=seed, spp=16 * camera_paths)
        session.keep_variance()
        for _ in range(12):
            session.iterate()
        mean, variance = session.estimate()
        for name, weigh in MEASURES.items():
            measured = weigh(mean.mean(axis=-1).ravel()) * 12 * variance.mean(axis=-1).ravel()
            predicted = session.prediction.errors[name].variance
            ratios[name].append(predicted / trimmed_mean(measured))
    for name, found in ratios.items():
        assert 1 / 1.3 < np.exp(np.mean(np.log(found))) < 1.3, name


# --- Errors -------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, value, allowed",
    [
        ("max_depth", -2, "-1"),
        ("max_depth", 2**40, "at most 2147483647"),
        ("max_depth", 1.5, "integer"),
        ("max_depth", "many", "integer"),
        ("rr_depth", 0, "at least 1"),
        ("rr_depth", -1, "at least 1"),
        ("hide_emitters", 1, "true or false"),
        ("hide_emitters", "yes", "true or false"),
        ("photon_count", -1, "at least 0"),
        ("photon_count", 1000.5, "integer"),
        ("photon_count", 2**40, "at least 0"),
        ("initial_radius", -0.1, "from 1e-15 to"),
        ("initial_radius", float("inf"), "from 1e-15 to"),
        ("initial_radius", float("nan"), "from 1e-15 to"),
        ("initial_radius", 1e-40, "from 1e-15 to"),
        ("bdd", 10**12, "at most 2147483647"),
        ("photon_count", 2**30, "at most 268435456"),
        ("initial_radius", "big", "number"),
        ("alpha", 0.0, "(0, 1]"),
        ("alpha", 1.1, "(0, 1]"),
        ("alpha", -1.0, "(0, 1]"),
        ("camera_paths", 0, "at least 1"),
        ("camera_paths", 1.5, "integer"),
        ("camera_paths", True, "integer"),
        ("variance", 1, "true or false"),
        ("bdd", -1, "at least 0"),
        ("bdd", 1.5, "integer"),
        ("bdd", True, "integer"),
        ("samples_per_pass", 4, "camera_paths"),
        ("timeout", 3.0, "--time"),
        ("block_size", 32, "film"),
        ("radius", 0.1, "initial_radius"),
        ("strategies", 3, "bdd"),
    ],
)
def test_bad_parameter(rgb, name, value, allowed):
    """One message that names the plugin, the parameter and what is allowed."""
    with pytest.raises(Exception) as error:
        mi.load_dict({"type": "bdpm", name: value})
    last = str(error.value).strip().splitlines()[-1]
    assert "bdpm" in last and f'"{name}"' in last and allowed in last, last


def test_parameters_are_shown(rgb):
    text = str(bdpm(bdd=2, alpha=0.8))
    assert "bdd = 2" in text and "alpha = 0.8" in text and "photon_count = 20000" in text


def test_polarised_variant():
    name = "llvm_ad_spectral_polarized"
    if name not in mi.variants():
        pytest.skip(f"Mitsuba here lacks {name}")
    mi.set_variant(name)
    scene = box_scene(8)
    for plugin in PLUGINS:
        with pytest.raises(Exception) as error:
            mi.render(scene, integrator=mi.load_dict({"type": plugin}), spp=8)
        assert last_words(error.value).startswith(f"{plugin}: ") and "polarised" in last_words(
            error.value
        )


def test_hair(rgb):
    """Mitsuba's BSDF of fibres scatters unlike in the two directions of a path: only what follows
    camera paths alone can render it."""
    scene = box_scene(8, extra={"type": "sphere", "bsdf": {"type": "hair"}})
    for plugin in set(PLUGINS) - {"bdpm_auto", "volpath_multiview"}:
        with pytest.raises(Exception) as error:
            mi.render(scene, integrator=mi.load_dict({"type": plugin}), spp=8)
        assert last_words(error.value).startswith(f'{plugin}: BSDF "hair" is not supported')


@pytest.mark.parametrize("case", ["curve emitter", "sdfgrid emitter", "inside aov"])
def test_unrenderable_scene(rgb, case, tmp_path):
    curve = tmp_path / "curve.txt"
    curve.write_text("".join(f"{i * 0.2} 0 1 0.1\n" for i in range(6)))
    with pytest.raises(Exception) as error:
        if case == "inside aov":
            mi.load_dict({"type": "aov", "aovs": "d:depth", "inner": {"type": "bdpm"}})
        else:
            entry = {
                "curve emitter": {
                    "type": "linearcurve",
                    "filename": str(curve),
                    "emitter": {"type": "area", "radiance": 1.0},
                },
                "sdfgrid emitter": {
                    "type": "sdfgrid",
                    "grid": mi.TensorXf(np.indices((4, 4, 4, 1)).sum(axis=0) - 3.5),
                    "emitter": {"type": "area", "radiance": 1.0},
                },
            }[case]
            render(box_scene(8, extra=entry))
    message = last_words(error.value)
    words = {
        "curve emitter": ("bdpm", "emitter"),
        "sdfgrid emitter": ("bdpm", "SDFGrid", "emitter"),
        "inside aov": ("AOVIntegrator", "Child objects must be of type 'SamplingIntegrator'"),
    }[case]  # that is Mitsuba's
    assert all(word in message for word in words), message


def test_special_film():
    mi.set_variant("llvm_ad_spectral")
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere"},
            "sensor": {
                "type": "perspective",
                "film": {
                    "type": "specfilm",
                    "width": 8,
                    "height": 8,
                    "band": {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]},
                },
            },
        }
    )
    for plugin in PLUGINS:
        with pytest.raises(Exception) as error:
            mi.render(scene, integrator=mi.load_dict({"type": plugin}), spp=8)
        assert last_words(error.value).startswith(f"{plugin}: ") and "specfilm" in last_words(
            error.value
        )


def test_fewer_samples_than_one_are_refused(rgb):
    for plugin in ("bdpm", "bdpt", "volpath_multiview"):
        integrator = mi.load_dict({"type": plugin, "max_depth": 2})
        with pytest.raises(ValueError, match=f"{plugin}: -1 samples per pixel"):
            integrator.render(box_scene(8), spp=-1)
    with pytest.raises(ValueError, match="-1 samples per pixel"):
        render_views(box_scene(8), spp=-1)


def test_gradients_are_refused(rgb):
    scene = box_scene(8)
    parameters = mi.traverse(scene)
    key = next(k for k in parameters.keys() if k.endswith("reflectance.value"))
    dr.enable_grad(parameters[key])
    parameters.update()
    for plugin in PLUGINS:
        with pytest.raises(Exception) as error:
            integrator = mi.load_dict({"type": plugin, "max_depth": 2})
            image = mi.render(scene, parameters, integrator=integrator, spp=8)
            dr.backward(dr.sum(image))
        assert f"{plugin}: gradients are not supported" in last_words(error.value)


def test_scene_of_another_variant():
    mi.set_variant("llvm_ad_mono")
    scene = box_scene(8)
    mi.set_variant("llvm_ad_rgb")
    with pytest.raises(Exception, match="loaded under another variant"):
        bdpm().render(scene, spp=1)


def test_missing_sensor(rgb):
    with pytest.raises(Exception, match="sensor 3"):
        bdpm().render(box_scene(8), sensor=3, spp=1)


# --- Variants -----------------------------------------------------------------


@in_one_thread
def test_every_variant_renders(variant):
    """Mono and spectral agree with `path` of the same variant (the grey world's mean; hue of few
    wavelengths is chance)."""
    scene = box_scene(16)
    # In spectral variants many iterations, of other wavelengths each.
    paths = {"camera_paths": 1, "photon_count": 2000} if mi.is_spectral else {}
    image, oracle = (
        np.array(mi.render(scene, integrator=i, spp=400))
        for i in (bdpm(initial_radius=0.1, **paths), path())
    )
    assert np.isfinite(image).all() and image.mean() > 0
    assert image.mean() == pytest.approx(oracle.mean(), rel=0.3 if mi.is_spectral else 0.03)


@pytest.mark.full
def test_spectral_colour():
    """Iterations share their wavelengths: their spread says how far the mean of 1500 may be off (t
    test at 1e-6)."""
    mi.set_variant("llvm_ad_spectral")
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": T().scale(4),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]},
                },
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.6, 0.8]}},
            "sensor": {
                "type": "perspective",
                "to_world": look((0, 0, 5), (0, 0, 0)),
                "fov": 30,
                "film": film(8),
            },
        }
    )
    a = SessionBatches(bdpm(camera_paths=1, photon_count=200), scene, 1)
    b = PathBatches(path(), scene, 1, spp=512)
    a.add(1500)
    b.add(16)
    a, b = a.estimate(), b.estimate()
    assert not differences(a, b)
    assert (np.sqrt(a.error2) < 0.05 * a.mean).all(), "test too weak"


@pytest.mark.extended
def test_variants_in_turn():
    """rgb, spectral, rgb: the plugin works each time, and the first image comes back."""
    images = []
    for name in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_rgb"):
        mi.set_variant(name)
        images.append(render(glossy_box(size=16), 1))
    np.testing.assert_allclose(images[0], images[2], rtol=1e-4, atol=1e-6)
    assert images[1].mean() > 0


@pytest.mark.parametrize("max_depth", [1, *extended(2, 3)])
def test_alpha_at_the_last_depth(rgb, max_depth):
    """What a path meets at its very last segment covers the background too, as in `path`: opaque,
    half transparent, or through a pane. (Standard error of a corner's mean 0.002; five of them.)"""
    pane = {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(0.7)}
    scenes = [
        {"pane": {**pane, "bsdf": bsdf}}
        for bsdf in (
            diffuse(),
            {"type": "null"},
            {"type": "mask", "opacity": 0.5, "nested": diffuse()},
        )
    ]
    for extra in scenes:
        scene = mi.load_dict(
            {
                "type": "scene",
                "light": {"type": "point", "position": [0, 0, 3]},
                **extra,
                "floor": {"type": "rectangle", "to_world": T().scale(0.5), "bsdf": diffuse()},
                "sensor": {
                    "type": "perspective",
                    "fov": 40,
                    "to_world": look((0, 0, 4), (0, 0, 0), (0, 1, 0)),
                    "film": film(16, pixel_format="rgba"),
                },
            }
        )
        ours, theirs = (
            np.array(
                mi.render(
                    scene, integrator=mi.load_dict({"type": kind, "max_depth": max_depth}), spp=256
                )
            )[:, :, 3]
            for kind in ("bdpm", "path")
        )
        assert abs(ours.mean() - theirs.mean()) < 0.01


# --- Set-up -------------------------------------------------------------------


@pytest.mark.parametrize("changed", [False, True], ids=["kept", "changed"])
def test_timed_iterations_are_of_the_radii_rendered_with(rgb, monkeypatch, changed):
    """Iterations by which a pilot measures time belong to the image, unless the time they took
    changes the radii."""
    scene, decisions = box_scene(), []
    choose = PilotResult.choose

    def choose_again(pilot, count, kept=None, reluctance=0.0):
        choice = choose(pilot, count, kept, 1.0 if kept else 0.0)
        if changed and decisions:
            radii = {kind: 1.5 * radius for kind, radius in choice.radii.items()}
            choice = dataclasses.replace(choice, radii=radii)
        decisions.append(count)
        return choice

    monkeypatch.setattr(PilotResult, "choose", choose_again)
    timed, same = (
        bdpm(bdd=0, initial_radius=0.0, photon_count=3000).session(scene, seed=4) for _ in range(2)
    )
    timed.plan_time(2.0)
    timed.start()
    assert len(decisions) == 2 and bool(timed.kept) != changed
    same.recall(timed.learned)
    for session in (timed, same):
        for _ in range(3):
            session.iterate()
    np.testing.assert_allclose(timed.image(), same.image(), rtol=1e-4, atol=1e-5)
    assert not timed.kept


def test_fewer_light_sub_paths_where_they_pay(rgb, monkeypatch):
    """Paths that gather at their second vertex make more noise than photons do. What gathers at the
    first has no other noise, weights are made for the photons there are, and a number that is given
    is given. Another session needs no pilot to render the same."""
    monkeypatch.setattr("mis_integrators.pilot.setting.FEWEST_LIGHT_PATHS", 1)
    scene = box_scene()
    pixels = 32 * 32
    for plugin, parameters in (
        ("bdpm", {"bdd": 0}),
        ("bdpm", {"bdd": 1, "photon_count": pixels}),
        ("bdpm_opt2", {}),
    ):
        session = mi.load_dict({"type": plugin, **parameters}).session(scene, seed=1)
        session.start()
        assert session.light_path_count == session.settings["photon_count"] == pixels
    one, other = (mi.load_dict({"type": "bdpm"}).session(scene, seed=1) for _ in range(2))
    one.start()
    assert one.light_path_count == one.light_share * pixels < pixels
    other.recall(one.learned)
    for session in (one, other):
        session.iterate()
    np.testing.assert_allclose(one.image(), other.image(), rtol=1e-4, atol=1e-5)


def kernels(integrator, scene, seed):
    """What a short render launches: hashes of its kernels."""
    session = integrator.session(scene, seed=seed)
    return kernels_of(lambda: [session.iterate() for _ in range(2)])


@pytest.mark.parametrize("plugin", ["bdpm_opt2", *extended("bdpm")])
def test_no_seed_has_kernels_of_its_own(rgb, plugin):
    """Numbers that depend on chance are not literals: seconds of compiling would come again with
    each seed."""
    gc.collect()  # kernels know all the scenes that there are
    scene, integrator = glossy_box(), mi.load_dict({"type": plugin, "photon_count": 3000})
    first, second, third = (kernels(integrator, scene, seed) for seed in (1, 2, 3))
    assert first and second <= first and third <= first


@pytest.mark.parametrize("plugin", ["bdpm", *extended("bdpm_opt2", "bdpt")])
def test_kinds_of_numbers_share_kernels(rgb, plugin):
    """Independent and low-discrepancy numbers come from the same kernels: of a render with a pilot,
    whose numbers are independent, half would else be compiled twice."""
    gc.collect()  # kernels know all the scenes that there are
    scene, of_sampler = glossy_box(), {}
    for sampler in ("sobol", "independent"):
        integrator = mi.load_dict({"type": plugin, "sampler": sampler})
        of_sampler[sampler] = kernels(integrator, scene, 1)
    assert of_sampler["independent"] == of_sampler["sobol"]


def test_buffers_that_grow_keep_their_kernels(rgb):
    """How much room there is for photons and vertices is no literal of the passes that find them,
    which take longest to compile."""
    gc.collect()
    scene, passes = glossy_box(), []
    for room in (2000, 3000):
        session = bdpm(bdd=1).session(scene, seed=1, spp=2)
        session.photon_capacity = session.vertex_capacity = room
        session._freeze()
        spectral = session._spectral(0)
        sequence = session._sequence(0, 0, 100)

        def traced(session=session, spectral=spectral, sequence=sequence):
            path = session.part_of_paths(mi.UInt32(0))
            seen = session.describe_camera_pass(session.sensor, sequence, path, spectral)
            light = session._trace_light(session.scene, session.sensor, [], sequence, spectral)
            dr.eval(light)
            dr.eval(session._trace_camera(seen, session.vertex_capacity, spectral))

        passes.append(kernels_of(traced, 500))
    assert passes[0] and passes[0] == passes[1]
