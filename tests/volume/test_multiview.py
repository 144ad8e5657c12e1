"""`volpath_multiview` against Mitsuba's own integrators, view by view, and against closed forms.

False-alarm rate 1e-6 a comparison; differences of 1.5 % of everything and of 6 % in each quarter of
a view (where a test says nothing else) are seen with a probability of 0.95 (`comparing`).
"""

import functools

import mis_integrators
from mis_integrators.app import cli, output
from mis_integrators.paths.media import transmittance
from mis_integrators.volume.shifts import SHIFTS
from mis_integrators.volume.traits import VolumeTraits
from mis_integrators.volume.views import Views

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    assert_same,
    collect_until,
    differences,
    in_one_thread,
    smallest_visible,
)
from foggy import (
    SIZE,
    THREE_VIEWS,
    MultiviewBatches,
    OracleBatches,
    around,
    arrived,
    batch,
    container,
    even,
    grid,
    lamp,
    multiview,
    orbit,
    pockets,
    sparse,
    uneven,
    view,
    views_agree,
    volpath,
    world,
)
from selection import extended
from worlds import EMITTERS, bitmap, diffuse, film, grey, path, waves

STRETCHES = ("majorant_optical_depth", "raw_depth", "primary_sample")


def coloured(scale=2.0):
    return {
        "type": "homogeneous",
        "scale": scale,
        "sigma_t": {"type": "rgb", "value": [0.25, 0.5, 1.0]} if not mi.is_spectral else 0.5,
        "albedo": {"type": "rgb", "value": [0.9, 0.8, 0.6]} if not mi.is_spectral else 0.8,
        "phase": {"type": "hg", "g": -0.3},
    }


def smoky(sensor, **objects):
    """A grid and, behind a boundary of its own, a coloured medium close to it (coincident
    boundaries are ambiguous, for Mitsuba too)."""
    return world(
        sensor,
        grid(even, scale=1.5, g=0.5),
        second=container(coloured(), 0.6, (1.63, -0.4, 0)),
        **objects,
    )


def cloud(size=SIZE, g=0.0):
    """A medium with many null interactions and nothing else, seen from all sides: shifts between
    very unlike segments."""
    return mi.load_dict(
        {
            "type": "scene",
            "medium": container(grid(sparse, scale=2.5, g=g)),
            "sensor": batch(around(), size),
            "lamp": lamp(),
            "sky": {"type": "constant", "radiance": grey(0.1)},
        }
    )


@functools.cache
def reference(g):
    """The cloud by `volpath`: computed once."""
    oracle = OracleBatches(volpath(), cloud(g=g), spp=128)
    oracle.add(24)
    return oracle.estimate()


# --- One view -----------------------------------------------------------------


@pytest.mark.parametrize(
    "variant_name",
    [
        "llvm_ad_rgb",
        pytest.param("llvm_ad_mono", marks=pytest.mark.full),
        pytest.param("llvm_ad_spectral", marks=pytest.mark.full),
    ],
)
def test_one_view_is_volpath(variant_name):
    mi.set_variant(variant_name)
    sensor = view((0.5, 1.2, 4.5))
    if mi.is_spectral:
        sensor["srf"] = {"type": "spectrum", "value": [(554, 0.0), (555, 1.0), (556, 0.0)]}
    views_agree(multiview(), volpath("volpathmis" if mi.is_spectral else "volpath"), smoky(sensor))


@pytest.mark.long
@pytest.mark.parametrize("sky", ["constant", *extended("wide sun")])
def test_a_sky_and_a_picture_that_shines(rgb, sky):
    """Lamps whose own samplers are not used, or not alone, together."""
    lights = {"sky": EMITTERS[sky]("delta")["e"], "picture": EMITTERS["textured"]("")["e"]}
    views_agree(multiview(), volpath(), smoky(view((0.5, 1.2, 4.5)), **lights))


@pytest.mark.parametrize("medium", ["grid", *extended("homogeneous")])
def test_furnace(rgb, medium):
    """Albedo one under a sky of radiance one: every pixel of every view is one, whatever is in the
    way. (Depth 200: what is cut off is far below 1e-4 of it.)"""
    fog = (
        grid(even, scale=2.0, albedo=1.0, g=0.3)
        if medium == "grid"
        else {"type": "homogeneous", "sigma_t": grey(0.9), "albedo": 1.0}
    )
    scene = mi.load_dict(
        {
            "type": "scene",
            "medium": container(fog),
            "sky": {"type": "constant", "radiance": grey(1.0)},
            "sensor": batch(orbit(3)),
        }
    )
    batches = MultiviewBatches(multiview(max_depth=200), scene)
    exact = Estimate.exact(np.ones((1 + 3 * 4, 3)))
    estimates = collect_until(batches, exact, 0.003, 0.01, start=12)
    assert_same(*estimates, 0.003, 0.01, slack=1e-4)


@pytest.mark.parametrize("scale", [5.0, *extended(1.0)])
def test_transmittance(rgb, scale):
    """Ratio tracking through a grid of one value, with its majorant far above it, against the
    exponential; roulette included."""
    values = np.full((4, 4, 4, 1), 0.4, np.float32)
    values[0, 0, 0] = 1.0  # off the ray
    medium = grid(lambda rng, n: values[..., 0], scale=scale)
    scene = mi.load_dict({"type": "scene", "medium": container(medium), "sensor": view((0, 0, 4))})
    n = 400000
    ray = mi.Ray3f(mi.Point3f(0.9, 0.8, 3), mi.Vector3f(0, 0, -1), mi.Float(0), [])
    ray.maxt = 5.0
    value, _ = transmittance(
        scene,
        VolumeTraits(scene, scene.sensors()),
        ray,
        dr.zeros(mi.MediumPtr, n),
        mi.PCG32(n),
        mi.Bool([True] * n),
    )
    value, exact = np.array(value.x), np.exp(-0.4 * scale * 2)
    assert abs(value.mean() - exact) < 5 * value.std() / np.sqrt(n) < 0.03 * exact  # 6e-7


# --- Several views ------------------------------------------------------------


@pytest.mark.parametrize(
    "shift",
    ["raw_depth_copy", *extended(*(shift for shift in SHIFTS if shift != "raw_depth_copy"))],
)
def test_shifts(rgb, shift):
    batches, _ = views_agree(multiview(shift=shift), reference(0.6), cloud(g=0.6), block=0.05)
    shares = {
        name: batches.statistics[name] / batches.statistics["tried"] for name in ("reached", "lost")
    }
    assert shares["reached"] > 0.12
    if shift in STRETCHES:
        assert batches.statistics["lost"] == 0
    else:
        assert shares["lost"] > 0.005


@pytest.mark.parametrize(
    "weights",
    [
        {"weights": "power", "beta": 3.0},
        *extended({"weights": "power"}, {"weights": "mwis"}),
    ],
    ids=["power3", "power", "mwis"],
)
def test_weights(rgb, weights):
    """MWIS is consistent only: its bias is far below the resolution at the 32 samples a pixel used
    here. The phase function has a lobe: under power weights the direction of the suffix must be
    drawn from the mixture of the views' lobes, whoever's path it is (under the balance heuristic
    one's own would do, for paths of all views make up the mixture)."""
    views_agree(multiview(**weights), reference(0.6), cloud(g=0.6), block=0.05)


@pytest.mark.extended
def test_few_samples(rgb):
    """Two samples a pixel, on finer films: MIS is as right as ever, the mean of its other half
    included; MWIS is visibly biased."""
    batches = {
        weights: MultiviewBatches(multiview(weights=weights, camera_paths=1), cloud(64))
        for weights in ("mis", "mwis")
    }
    assert_same(*collect_until(batches["mis"], reference(0.0), 0.015, 0.05, start=40), 0.015, 0.05)
    batches["mwis"].add(40)
    assert differences(batches["mwis"].estimate(), reference(0.0))


def test_equal_weights(rgb):
    """Without densities the noise is bounded only where these are much alike: close views, no
    surfaces, no null interactions."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": grey(0.5)},
            "lamp": lamp(),
            "sensor": batch(orbit(3, 0.03)),
            "medium": container({"type": "homogeneous", "sigma_t": grey(0.9), "albedo": 0.7}),
        }
    )
    views_agree(multiview(weights="none"), volpath(), scene)


@pytest.mark.parametrize(
    "variant_name",
    [*extended("llvm_ad_rgb"), pytest.param("llvm_ad_mono", marks=pytest.mark.full)],
)
def test_variants(variant_name):
    """Media, surfaces and all kinds of light together; coloured where there are colours."""
    mi.set_variant(variant_name)
    views_agree(multiview(), volpath(), smoky(batch(uneven())), whole=0.02, block=0.1, most=200)


def surfaces(sensor, **objects):
    """No media, but everything that surfaces can do at a pivot."""
    mask = {
        "type": "mask",
        "opacity": bitmap(0.5 + 0.45 * waves(2, 1)),
        "bsdf": {"type": "twosided", "bsdf": diffuse(0.7)},
    }
    return world(
        sensor,
        None,
        ball={
            "type": "sphere",
            "radius": 0.5,
            "center": [-0.7, 0, 0],
            "bsdf": {"type": "plastic", "diffuse_reflectance": grey(0.5)},
        },
        glass={
            "type": "sphere",
            "radius": 0.4,
            "center": [0.5, -0.4, 0.6],
            "bsdf": {"type": "dielectric"},
        },
        screen={
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0.3, 0.2, 1.2]).scale(0.5),
            "bsdf": mask,
        },
        pane={
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([-0.6, 0.1, 1.1]).scale(0.5),
            "bsdf": {"type": "thindielectric"},
        },
        blend={
            "type": "sphere",
            "radius": 0.4,
            "center": [0.6, 0.5, -0.5],
            "bsdf": {
                "type": "blendbsdf",
                "weight": 0.4,
                "a": {"type": "conductor"},
                "b": diffuse(0.6),
            },
        },
        **objects,
    )


@pytest.mark.parametrize("hide_emitters", [False, *extended(True)])
def test_surfaces(rgb, hide_emitters):
    """Without media `path` is the oracle. A lamp stands before the second view, so hiding it shows;
    `path` itself (3.9.1) misplaces what is behind a hidden lamp, `volpath` does not."""
    lens = {"kind": "thinlens", "aperture_radius": 0.08, "focus_distance": 4.0}
    views = [view((0.3, 1.0, 4.5)), view((1.5, 1.4, 4.0), **lens), view((-0.8, 3.4, 3.6))]
    scene = surfaces(batch(views), lamp=lamp((0.9, 0.85, 2.4), 0.3, 30.0))
    oracle = volpath(hide_emitters=True) if hide_emitters else path(max_depth=8, rr_depth=50)
    views_agree(
        multiview(hide_emitters=hide_emitters), oracle, scene, whole=0.02, block=0.1, most=200
    )


def flat(origin, half, target=(0, 0, 0), depth=1.0, **extra):
    """An orthographic view of 2 `half` by 2 `half`; `depth`: scale of its third axis."""
    sensor = view(origin, target, kind="orthographic", **extra)
    del sensor["fov"]
    sensor["to_world"] = sensor["to_world"] @ mi.ScalarTransform4f().scale([half, half, depth])
    return sensor


@pytest.mark.long
def test_orthographic_views(rgb):
    """Beside a perspective one, media and surfaces at the pivots; one has its third axis scaled and
    a near plane that cuts off the lamp."""
    views = [
        flat((0.5, 1.2, 4.5), 1.3),
        flat((2.0, 1.0, 3.0), 1.1, depth=0.5, near_clip=3.0, far_clip=40.0),
        view((0, 1.2, 4.5)),
    ]
    together, _ = views_agree(
        multiview(), volpath(), smoky(batch(views)), whole=0.02, block=0.1, most=200
    )
    assert together.statistics["reached"] > 0.2 * together.statistics["tried"]


def three_media(sensor):
    """Three media in a row whose majorants differ by factors of five, with gaps between them."""
    majorants = (0.3, 1.5, 7.5)
    media = {
        f"cloud{k}": container(grid(sparse if k else even, scale=majorant, seed=k), 0.45, (x, 0, 0))
        for k, (majorant, x) in enumerate(zip(majorants, (-1.1, 0, 1.1)))
    }
    return mi.load_dict(
        {
            "type": "scene",
            **media,
            "sensor": sensor,
            "lamp": lamp(),
            "sky": {"type": "constant", "radiance": grey(0.2)},
        }
    )


def in_a_row():
    """Views that look along the row from both ends, and across it."""
    return [
        view((-3.6, 0.5, 0.8), (0.2, 0, 0), fov=40.0),
        view((3.4, 0.4, 1.2), (0, 0, 0), fov=44.0),
        view((0.4, 0.8, 3.6), (0, 0, 0), fov=48.0),
    ]


@functools.cache
def reference_of_three():
    """The three media by `volpath`: computed once."""
    oracle = OracleBatches(volpath(max_depth=4), three_media(batch(in_a_row())), spp=128)
    oracle.add(24)
    return oracle.estimate()


@pytest.mark.parametrize(
    "shift", ["raw_depth", *extended("majorant_optical_depth", "primary_sample")]
)
def test_three_media(rgb, shift):
    """Where majorants differ along a line of sight, so do raw depth and majorant optical depth;
    every stretch gives what `volpath` gives."""
    batches, _ = views_agree(
        multiview(shift=shift, max_depth=4),
        reference_of_three(),
        three_media(batch(in_a_row())),
        whole=0.02,
        block=0.1,
    )
    assert batches.statistics["lost"] == 0
    # most paths meet nothing but the sky
    assert batches.statistics["reached"] > 0.03 * batches.statistics["tried"]


@pytest.mark.long
def test_stretches_differ_where_majorants_do(rgb):
    """The same paths under two stretches: other densities in three media, the same in a single
    one, where both are one function."""

    def first_images(scene):
        images = []
        for shift in ("majorant_optical_depth", "raw_depth"):
            session = multiview(shift=shift, max_depth=2, camera_paths=4).session(scene, 0, 1, 0)
            session.iterate()
            images.append(session.image()[:, :, :3])
        return np.abs(images[0] - images[1]).mean() / images[0].mean()

    assert first_images(three_media(batch(in_a_row()))) > 0.005
    assert first_images(cloud()) < 1e-4


@pytest.mark.extended
def test_views_without_overlap(rgb):
    """Two views back to back: nothing can be shared, and what comes out is plain path tracing,
    noise included."""
    views = [view((0, 1.0, 3.0), (0, 0.8, 6.0)), view((0, 1.0, -3.0), (0, 0.8, -6.0))]
    extra = {
        "near": container(
            {"type": "homogeneous", "sigma_t": grey(0.4), "albedo": 0.9}, 1.0, (0, 0.5, 6)
        ),
        "far": container(
            {"type": "homogeneous", "sigma_t": grey(0.7), "albedo": 0.8}, 1.0, (0, 0.5, -6)
        ),
    }
    together, _ = views_agree(multiview(), volpath(), world(batch(views), None, **extra))
    assert together.statistics["tried"] > 0 and together.statistics["reached"] == 0
    count = len(together.batches)
    apart = []
    for sensor in views:
        alone = MultiviewBatches(multiview(), world(sensor, None, **extra), seed=2)
        alone.add(count)
        apart.append(np.var(alone.batches, axis=0)[1:].mean())
    ratio = np.var(together.batches, axis=0)[1:].mean() / np.mean(apart)
    # variances of `count` batches, of some four independent blocks
    assert abs(np.log(ratio)) < 6 * np.sqrt(4 / count / 4)


# --- What can go wrong --------------------------------------------------------


@pytest.mark.extended
def test_hostile_views(rgb):
    """Zero-density pockets and a majorant many times the density; one view inside a medium, one
    whose near plane cuts off pivots of the others, one that sees half of them; forward-peaked phase
    functions under a point light; a glossy ball."""
    fog = {
        "type": "homogeneous",
        "sigma_t": grey(0.25),
        "albedo": 0.9,
        "phase": {"type": "hg", "g": 0.9},
    }
    smoke = grid(pockets, scale=4.0, g=0.9, albedo=0.95)
    room = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 3.2]).scale([2.0, 1.0, 2.0]),
        "bsdf": {"type": "null"},
        "interior": {"type": "ref", "id": "fog"},
    }
    inside = view((0, 0.2, 3.4)) | {"medium": {"type": "ref", "id": "fog"}}
    # its near plane stands in the fog
    near = view((0.8, 0.3, 7.0), fov=19.0, near_clip=5.0) | {"medium": {"type": "ref", "id": "fog"}}
    half = view((-2.5, 0.8, 6.0), (-0.8, 0, 0), fov=20.0)
    scene = world(
        None,
        smoke,
        fog=fog,
        room=room,
        a=inside,
        b=near,
        c=half,
        ball={
            "type": "sphere",
            "radius": 0.3,
            "center": [0.3, 0, 0.4],
            "bsdf": {"type": "roughconductor", "alpha": 0.08},
        },
    )
    together, _ = views_agree(
        multiview(max_depth=6), volpath(max_depth=6), scene, whole=0.03, block=0.15, most=200
    )
    assert (
        together.statistics["lost"] == 0
        and together.statistics["reached"] > 0.05 * together.statistics["tried"]
    )


@pytest.mark.parametrize(
    "shift", [pytest.param(shift, marks=pytest.mark.full) for shift in STRETCHES]
)
def test_thick_media(rgb, shift):
    """Optical depths of hundreds to thousands on lines of sight (exponentials of single precision
    end at 88)."""
    thick = grid(even, scale=300.0, albedo=0.7)
    homogeneous = {"type": "homogeneous", "sigma_t": grey(0.8), "scale": 500.0, "albedo": 0.8}
    scene = world(batch(orbit(2)), thick, second=container(homogeneous, 0.4, (1.5, 0, 0)))
    views_agree(
        multiview(shift=shift, max_depth=4),
        volpath(max_depth=4),
        scene,
        whole=0.02,
        block=0.1,
        most=200,
    )


@pytest.mark.extended
def test_majorants_far_above_the_density(rgb):
    """Thirty times: how many null interactions paths have then tells views apart, unless some are
    added; with them, sharing pays."""

    def spiked(rng, n):
        values = rng.uniform(0.2, 0.4, (n, n, n))
        values[0, 0, 0] = 9.0
        return values

    scene = mi.load_dict(
        {
            "type": "scene",
            "medium": container(grid(spiked, albedo=0.9)),
            "sensor": batch(orbit(4, 1.2)),
            "sky": {"type": "constant", "radiance": grey(0.2)},
            "point": {"type": "point", "position": [-2, 2.5, 1], "intensity": grey(9.0)},
        }
    )
    spread = {}
    for add in (True, False):
        batches = MultiviewBatches(
            multiview(max_depth=3, add_nulls=add, camera_paths=4), scene, blocks=8, iterations=4
        )
        batches.add(24)
        spread[add] = np.var(batches.batches, axis=0)[1:].mean()
    assert spread[True] < 0.75 * spread[False]


@pytest.mark.extended
def test_huge_density_ratios(rgb):
    """Forward-peaked smoke and a polished ball, seen by views that differ by orders of magnitude in
    what they think of each other's paths: no fireflies. On the mean samples are hardly worse than
    those of the views alone; weights that do not look at densities are far worse."""
    smoke = grid(sparse, scale=2.5, g=0.95, albedo=0.95)
    ball = {"type": "sphere", "radius": 0.35, "bsdf": {"type": "roughconductor", "alpha": 0.03}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "medium": container(smoke),
            "sensor": batch(around()),
            "ball": ball,
            "lamp": lamp(),
            "sky": {"type": "constant", "radiance": grey(0.3)},
        }
    )

    def together(weights):
        session = multiview(max_depth=4, camera_paths=4, weights=weights).session(scene, spp=0)
        for seed in range(16):
            session.restart(seed)
            for _ in range(4):
                session.iterate()
            yield session.image()[..., :3]

    alone = np.array(
        [mi.render(scene, integrator=volpath(max_depth=4), spp=16, seed=seed) for seed in range(16)]
    )[..., :3]
    found = {weights: np.array(list(together(weights))) for weights in ("mis", "mwis", "none")}
    noise = {
        weights: images.var(axis=0, ddof=1).mean() / alone.var(axis=0, ddof=1).mean()
        for weights, images in found.items()
    }
    assert noise["mis"] < 1.5 and noise["mwis"] < 1.5 and noise["none"] > 2 * noise["mis"]
    assert max(found["mis"].max(), found["mwis"].max()) < 1.5 * alone.max()


def test_roulette_spares_what_other_views_sampled(rgb):
    """Forward-peaked scattering: where a path goes from its pivot is one view's choice, and brings
    the others nothing. Roulette that asks what the path's own view would get kills those of the
    others, and the rare survivors are fireflies (1600 times the variance here). Variances of twelve
    batches, of eight blocks each, are known within a factor of two."""
    haze = {
        "type": "homogeneous",
        "scale": 4.0,
        "sigma_t": grey(0.375),
        "albedo": 0.95,
        "phase": {"type": "hg", "g": 0.99},
    }
    scene = world(
        batch([view((0.5, 1.2, 4.5)), view((1.6, 1.0, 4.0))]), haze, lamp=None, point=None
    )
    variances = []
    for rr_depth in (2, 50):
        together = MultiviewBatches(multiview(max_depth=6, rr_depth=rr_depth), scene)
        together.add(12)
        variances.append(np.var(together.batches, axis=0)[1:].mean())
    assert variances[0] < 4 * variances[1]


def test_views_on_both_sides_of_a_surface(rgb):
    """A rough boundary between fog and air, one view in the fog, one outside: each sees pivots on
    it through its own medium."""
    fog = {"type": "homogeneous", "sigma_t": grey(0.8), "albedo": 0.9}
    glass = {
        "type": "sphere",
        "bsdf": {"type": "roughdielectric", "alpha": 0.5, "int_ior": 1.2},
        "interior": {"type": "ref", "id": "fog"},
    }
    inside = view((0, 0, 0.6), (0, 0.5, -1), fov=60.0) | {"medium": {"type": "ref", "id": "fog"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": fog,
            "glass": glass,
            "a": inside,
            "b": view((0, 2.0, -3.6), fov=32.0),
            "sky": {"type": "constant", "radiance": grey(0.5)},
            "point": {"type": "point", "position": [-2, 2.5, -2], "intensity": grey(6.0)},
        }
    )
    together, _ = views_agree(
        multiview(max_depth=5), volpath(max_depth=5), scene, whole=0.02, block=0.08, most=200
    )
    assert together.statistics["reached"] > 0.1 * together.statistics["tried"]


# --- Films --------------------------------------------------------------------


@pytest.mark.parametrize(
    "rfilter, options",
    [
        ("gaussian", {"crop_offset_x": 4, "crop_width": 8, "crop_offset_y": 2, "crop_height": 8}),
        *extended(("mitchell", {"sample_border": True})),
    ],
)
def test_films(rgb, rfilter, options):
    """Reconstruction filters, crop windows and sampled borders, alpha included: every pixel's mean
    as `volpath` has it, border pixels too."""
    sensors = [
        s | {"film": film(12, rfilter, **options) | {"pixel_format": "rgba"}} for s in orbit(2)
    ]
    scene = world(sensors[0], grid(even, scale=1.0), sky=None, floor=None, b=sensors[1])
    session = multiview(max_depth=3).views_session(scene)
    images, oracle, weights = [], [], []
    for seed in range(24):
        session.restart(seed)
        for _ in range(4):
            session.iterate()
        weights.append(arrived(session.accumulator))
        images.append([np.array(t) for t in session.view_tensors()])
        oracle.append(
            [
                np.array(
                    mi.render(
                        scene, integrator=volpath(max_depth=3), sensor=i, seed=100 + seed, spp=64
                    )
                )
                for i in range(2)
            ]
        )
    # What is expected of the weights at each pixel, border pixels too: pictures forgive errors in
    # it, being nearly ratios.
    for weight in np.mean(weights, axis=0):
        edges = (weight[0], weight[-1], weight[:, 0], weight[:, -1])
        assert np.abs(weight.mean() - 1) < 0.01 and all(
            np.abs(edge.mean() - 1) < 0.04 for edge in edges
        )
    for mine, theirs in zip(zip(*images), zip(*oracle)):
        a, b = (
            Estimate.of(
                [
                    np.concatenate(
                        [
                            image.mean(axis=(0, 1))[None],
                            image[[0, -1]].mean(axis=1),
                            image[:, [0, -1]].mean(axis=0),
                        ]
                    )
                    for image in side
                ]
            )
            for side in (mine, theirs)
        )
        assert not differences(a, b)
        # of the whole, and of a border pixel
        assert smallest_visible(a, b)[0] < 0.05 and np.median(smallest_visible(a, b)) < 0.25


@pytest.mark.parametrize("sampler", extended("sobol", "independent"))
@in_one_thread
def test_variance(rgb, sampler):
    """The variance channels against the variance of independent renders. Between iterations that
    share a sequence they see noise that the mean does not have: they tell too much, never too
    little."""
    scene = smoky(batch(orbit(2)))
    for weights in ("mis", "mwis"):
        session = multiview(
            variance=True, weights=weights, camera_paths=1, sampler=sampler
        ).session(scene, spp=0)
        images = []
        for seed in range(40):
            session.restart(seed)
            for _ in range(12):
                session.iterate()
            images.append(session.image())
        images = np.array(images)
        assert session.channels[-3:] == ["var.R", "var.G", "var.B"]
        told, seen = images[..., -3:].mean(), images[..., :3].var(axis=0, ddof=1).mean()
        # twelve iterations; the mean is over 1500 values of 40 renders each
        assert 0.85 < told / seen < (1.15 if sampler == "independent" else 1.6)


# --- Random numbers -----------------------------------------------------------


@pytest.mark.extended
def test_means_of_independent_numbers(rgb):
    views_agree(multiview(sampler="independent"), reference(0.6), cloud(g=0.6), block=0.05)


@pytest.mark.extended
@in_one_thread
def test_sequences_lower_the_variance(rgb):
    """One view, so that pixels are independent: the variance of 32 paths each, over 24 seeds,
    against that of independent numbers; 0.57, by the median over pixels. Were they equal, a pixel's
    ratio would follow F(23, 23), below 0.7 with probability 0.2; half of 150 pixels with a
    probability below 1e-15."""
    fog = {"type": "homogeneous", "sigma_t": grey(0.9), "albedo": 0.7}
    scene = world(view((0, 1.2, 4.5)), fog)

    def variance(sampler):
        session = multiview(camera_paths=8, sampler=sampler).session(scene, spp=0)
        images = []
        for seed in range(24):
            session.restart(seed)
            for _ in range(4):
                session.iterate()
            images.append(session.image()[:, :, :3].mean(axis=-1))
        return np.var(images, axis=0, ddof=1)

    sobol, independent = variance("sobol"), variance("independent")
    lit = independent > 1e-8  # some see nothing but the sky
    assert lit.sum() > 150 and np.median(sobol[lit] / independent[lit]) < 0.7


def test_even_and_odd_iterations_share_no_sequence(rgb, monkeypatch):
    """What the even iterations tell of the odd ones' weights must be independent of them."""
    session = multiview(camera_paths=4).session(smoky(view((0, 1.2, 4.5))), seed=3, spp=0)
    sequences, part = [], session._part

    def record(first, seed, sequence, spectral):
        sequences.append((int(sequence.seed[0]), int(sequence.first[0])))
        return part(first, seed, sequence, spectral)

    monkeypatch.setattr(session, "_part", record)
    for iteration in (0, 1, 2, 3):
        session.iterate(iteration)
    seeds, firsts = zip(*sequences)
    assert seeds[0] == seeds[2] != seeds[1] == seeds[3] and firsts == (0, 0, 4, 4)


# --- Sessions -----------------------------------------------------------------


def test_seeds_and_parts(rgb, monkeypatch):
    """Same seed, same image, also when the paths are traced in parts; another seed, another image
    of the same mean."""
    scene = smoky(batch(uneven()))
    images = [
        np.array(mi.render(scene, integrator=multiview(), seed=seed, spp=48)) for seed in (5, 5, 6)
    ]
    module = __import__("sys").modules["mis_integrators.integrators.volpath_multiview"]
    monkeypatch.setattr(module, "PAIRS", 9000)
    monkeypatch.setattr(module, "FEWEST", 3000)
    parts = np.array(mi.render(scene, integrator=multiview(), seed=5, spp=48))
    assert np.allclose(images[0], images[1], rtol=1e-4, atol=1e-5) and np.allclose(
        images[0], parts, rtol=1e-3, atol=1e-4
    )
    assert np.abs(images[0] - images[2]).mean() > 0.01 * images[0].mean()


@pytest.mark.parametrize("sampler", ["sobol", *extended("independent")])
def test_order_of_iterations(rgb, sampler):
    """An iteration is the same whatever was rendered before."""
    images = []
    for order in ((0, 1, 2, 3), (3, 1, 0, 2)):
        session = multiview(sampler=sampler).session(smoky(batch(uneven())), spp=0)
        for iteration in order:
            session.iterate(iteration)
        images.append(session.image())
    assert np.allclose(*images, rtol=1e-3, atol=1e-4)


def test_render_views(rgb):
    """Views of different sizes, a batch among them; the scene's own integrator, or any."""
    wide = view((1.0, 1.2, 4.4)) | {"film": film(8) | {"width": 20}}
    scene = world(
        batch(orbit(2)),
        grid(even),
        extra=wide,
        integrator={"type": "volpath_multiview", "max_depth": 3},
    )
    images = mis_integrators.render_views(scene, spp=32, seed=3)
    assert sorted(image.shape for image in images) == [(8, 20, 3), (SIZE, SIZE, 3), (SIZE, SIZE, 3)]
    longer = mis_integrators.render_views(scene, multiview(max_depth=1), spp=16)
    assert all(np.array(a).mean() > np.array(b).mean() for a, b in zip(images, longer))
    alone = np.array(mi.render(world(wide, grid(even)), integrator=volpath(max_depth=3), spp=512))
    mine = np.mean(
        [
            np.array(
                mis_integrators.render_views(scene, spp=32, seed=s)[
                    [i.shape[0] for i in images].index(8)
                ]
            )
            for s in range(8)
        ],
        axis=0,
    )
    assert mine.mean() == pytest.approx(alone.mean(), rel=0.03)


def test_cameras_are_mitsubas(rgb):
    """Rays, film positions and densities next to those of Mitsuba's sensors: principal points,
    crops, rolled and mirrored frames, lenses."""
    T = mi.ScalarTransform4f
    pose = T().look_at(origin=[1, 2, 3], target=[0.5, 0, -1], up=[0.3, 1, 0]) @ T().scale(
        [-1, 1, 1]
    )
    cropped = {
        "type": "hdrfilm",
        "width": 40,
        "height": 24,
        "crop_offset_x": 5,
        "crop_offset_y": 3,
        "crop_width": 20,
        "crop_height": 11,
    }
    sensors = [
        mi.load_dict(
            {
                "type": "perspective",
                "fov": 50,
                "to_world": pose,
                "near_clip": 0.3,
                "film": cropped,
                "principal_point_offset_x": 0.1,
            }
        ),
        mi.load_dict(
            {
                "type": "thinlens",
                "fov": 30,
                "aperture_radius": 0.2,
                "focus_distance": 2.5,
                "to_world": pose,
                "film": cropped,
            }
        ),
    ]
    views = Views(sensors, 1, "test")
    rng, n = mi.PCG32(4000), 4000
    for number, sensor in enumerate(sensors):
        aperture, unit = (mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(2))
        ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), unit, aperture)
        it = mi.Interaction3f(
            mi.Float(0),
            mi.Float(0),
            [],
            ray.o + ray.d * (0.2 + 3 * rng.next_float32()),
            mi.Normal3f(0),
        )
        ds, weight = sensor.sample_direction(it, aperture)
        d, distance, density, position = views.connect(
            mi.UInt32(number), it.p, aperture, mi.Bool([True] * n)
        )
        seen = np.array(ds.pdf) > 0
        assert seen.mean() > 0.95 and ((np.array(density) > 0) == seen).mean() > 0.995
        seen &= np.array(density) > 0
        # 3.9.1 forgets the principal point in it: zero where the film is shifted to
        known = seen & (np.array(weight.x) > 0)
        assert known.mean() > (0.75 if number == 0 else 0.95)
        assert np.allclose(np.array(density)[known], np.array(weight.x)[known] * 220, rtol=1e-3)
        assert np.allclose(np.array(position)[:, seen], np.array(ds.uv)[:, seen], atol=2e-3)
        assert np.allclose(
            np.array(position)[:, seen], (np.array(unit) * [[20], [11]])[:, seen], atol=2e-3
        )
        assert np.allclose(np.array(d)[:, seen], -np.array(ray.d)[:, seen], atol=1e-4)
        assert np.allclose(
            np.array(distance)[seen], np.array(dr.norm(it.p - ray.o))[seen], atol=1e-3
        )
    # Between the near and the far plane, and nowhere else.
    straight = mi.load_dict(
        {
            "type": "perspective",
            "fov": 50,
            "to_world": pose,
            "near_clip": 0.3,
            "far_clip": 5.0,
            "film": cropped,
        }
    )
    ray, _ = straight.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(0.5))
    to_camera = np.array(ray.o).ravel() - np.array([1, 2, 3])
    d, near = np.array(ray.d).ravel(), np.linalg.norm(to_camera)
    depths = np.array([-1.0, 0.5, 0.99, 1.01, 10.0, 16.6, 16.7, 100.0]) * near
    points = mi.Point3f((np.array([1, 2, 3]) + depths[:, None] * d).T)
    density = Views([straight], 1, "test").connect(
        mi.UInt32(0), points, mi.Point2f(0.5), mi.Bool([True] * 8)
    )[2]
    assert (np.array(density) > 0).tolist() == [False, False, False, True, True, True, False, False]


def test_media_of_sensors(rgb):
    """A view stands in the medium that its sensor names, else in its batch's, else in none."""
    fog = {"type": "homogeneous", "sigma_t": grey(0.8), "albedo": 0.9}
    first, second = orbit(2)
    together = batch([first | {"medium": {"type": "ref", "id": "haze"}}, second]) | {
        "medium": {"type": "ref", "id": "fog"}
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": fog,
            "haze": fog | {"sigma_t": grey(0.1)},
            "views": together,
            "alone": view((0, 0, 4)),
        }
    )
    media = [
        Views([sensor], 1, "test").medium(
            mi.UInt32([0, 1] if "Batch" in sensor.class_name() else [0])
        )
        for sensor in scene.sensors()
    ]
    mei = dr.zeros(mi.MediumInteraction3f)
    extinctions = sorted(
        sorted(
            0.0 if medium is None else float(np.array(medium.get_majorant(mei, True)).max())
            for medium in pointers
        )
        for pointers in media
    )
    assert extinctions == [[0.0], [pytest.approx(0.1), pytest.approx(0.8)]]


@pytest.mark.parametrize("depth, lit", [(-1, False), (0, True), (1, True)])
def test_little_light(rgb, depth, lit):
    """Scenes without emitters, and depths at which nothing or only emitters are seen."""
    light = {"sky": {"type": "constant", "radiance": grey(1.0)}} if lit else {}
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere"},
            "sensor": batch(orbit(2)),
            "medium": container(grid(even), 2.0),
            **light,
        }
    )
    image = np.array(mi.render(scene, integrator=multiview(max_depth=depth), spp=64))
    expected = np.array(mi.render(scene, integrator=volpath(max_depth=depth), spp=256))
    assert np.abs(image.mean() - expected.mean()) < 0.02 * max(expected.mean(), 1e-6) and (
        image.max() > 0
    ) == (lit and depth == 1)


# --- Errors -------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, words",
    [
        ({"shift": "depth"}, ['"shift"', "majorant_optical_depth"]),
        ({"weights": "best"}, ['"weights"', "mwis"]),
        ({"weights": "power", "beta": 0.5}, ['"beta"', "from 1 to 8"]),
        ({"beta": 3.0}, ['"beta"', '"power"']),
        ({"bdd": 1}, ['"bdd"', "camera_paths"]),
        ({"max_depth": -2}, ['"max_depth"']),
    ],
)
def test_wrong_parameters(rgb, parameters, words):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "volpath_multiview", **parameters})
    assert all(word in str(error.value) for word in ["volpath_multiview", *words])


def test_scenes_refused(rgb):
    ball = {"type": "sphere"}

    def refused(words, integrator=None, **objects):
        scene = mi.load_dict({"type": "scene", "ball": ball, **objects})
        with pytest.raises((RuntimeError, ValueError)) as error:
            mis_integrators.render_views(scene, integrator, spp=1)
        assert all(word in str(error.value) for word in words), error.value

    meter = {"type": "sphere", "sensor": {"type": "irradiancemeter", "film": film(1)}}
    refused(["volpath_multiview", "IrradianceMeter", "perspective"], meter=meter)
    refused(
        ["reconstruction filter"],
        s=view((0, 0, 4)),
        t=view((0, 0, 5)) | {"film": film(8, "gaussian")},
    )
    refused(["no sensor"])
    refused(["render_views", "PathIntegrator"], path(), s=view((0, 0, 4)))
    refused(["cropped"], s=batch(orbit(2), crop_width=8, crop_height=8))
    refused(["at least two"], multiview(variance=True), s=view((0, 0, 4)))


# --- The command --------------------------------------------------------------


def test_command(rgb, tmp_path, capsys):
    """Side by side, as a contact sheet, and as frames."""
    scene = tmp_path / "a.xml"
    scene.write_text(THREE_VIEWS)

    def run(*options):
        return cli.main(
            [
                str(scene),
                "-o",
                str(tmp_path / "b.exr"),
                "-D",
                "resx=24",
                "-D",
                "resy=6",
                "--spp",
                "4",
                "--quiet",
                *options,
            ]
        )

    def same(a, b):  # Mitsuba dithers
        return np.abs(a.astype(int) - b).max() <= 1 and b.std() > 1

    assert run("--frames") == 0
    assert tuple(mi.Bitmap(str(tmp_path / "b.exr")).size()) == (24, 6)
    strip = np.array(mi.Bitmap(str(tmp_path / "b.png")))
    frames = np.concatenate(
        [np.array(mi.Bitmap(str(tmp_path / f"b.00{i}.png"))) for i in range(3)], axis=1
    )
    assert same(frames, strip)
    assert run("--all-views") == 0
    sheet = np.array(mi.Bitmap(str(tmp_path / "b.png")))
    assert (
        sheet.shape[:2] == (12, 16)
        and same(sheet[:6, :8], strip[:, :8])
        and same(sheet[6:, :8], strip[:, 16:])
    )
    assert run("-i", "path", "--all-views") == 1 and "volpath_multiview" in capsys.readouterr().err
    assert run("-i", "path", "--frames") == 1


def test_contact_sheet():
    images = [np.full((4, 6, 3), i + 1.0) for i in range(4)] + [np.full((2, 3, 3), 5.0)]
    sheet = output.contact_sheet(images)
    assert sheet.shape == (12, 12, 3)
    assert [
        sheet[y, x, 0] for y, x in ((0, 0), (0, 6), (4, 0), (4, 6), (8, 0), (8, 3), (10, 0))
    ] == [1, 2, 3, 4, 5, 0, 0]
