"""The parameter `aovs`: layers besides the image."""

import sys

from mis_integrators import _plugins
from mis_integrators.paths.layers import (
    CHANNELS,
    SPLIT,
    channel_names,
    parse_layers,
    render_layers,
)

import drjit as dr
import lamplit
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    assert_same,
    block_means,
    differences,
    in_one_thread,
    pictures,
)
from light_by_class import traced
from selection import extended, one_in_each_row
from worlds import T, bdpm, film, look, path, ptracer, tray

SURFACE_PLUGINS = [plugin for plugin in _plugins.PLUGINS if plugin != "volpath_multiview"]
ALL = ",".join(f"{kind}_1:{kind}" for kind in CHANNELS)
"""A layer of each type."""
REPRESENTATIVES = "bdpm", "bdpm_opt3", "vcm", "bdpt_ris"
"""Plugins that together have every strategy."""
BY_DEFAULT = [
    "bdpt_ris",
    *extended(*(plugin for plugin in SURFACE_PLUGINS if plugin != "bdpt_ris")),
]


def last_line(error) -> str:
    return str(error.value).strip().splitlines()[-1]


def film_channels(sensor):
    return [field.name for field in sensor.film().bitmap().struct_()]


def mitsubas(scene, aovs, seed):
    """Channels of Mitsuba's own `aov` by name. (The tensor that `render` returns lacks some.)"""
    integrator = mi.load_dict({"type": "aov", "aovs": aovs, "image": {"type": "path"}})
    integrator.render(scene, scene.sensors()[0], seed=seed, spp=64, develop=False)
    pixels = np.array(scene.sensors()[0].film().bitmap())
    return {name: pixels[..., i] for i, name in enumerate(film_channels(scene.sensors()[0]))}


def ours(scene, aovs, seed):
    """The same of this package, without an image."""
    layers = parse_layers(aovs)
    sensor = scene.sensors()[0]
    border = sensor.film().rfilter().border_size()
    inside = slice(border, -border) if border else slice(None)
    tensors = [np.array(tensor) for tensor in render_layers(scene, sensor, layers, seed)]
    pixels = np.concatenate(tensors, axis=2)[inside, inside]
    return {name: pixels[..., i] for i, name in enumerate(channel_names(layers))}


# --- What the layers show -------------------------------------------------------------------------


@pytest.mark.parametrize("rfilter", ["mitchell", *extended("box", "gaussian")])
def test_layers_are_those_of_mitsuba(rgb, rfilter):
    """On surfaces that are all diffuse, under the film's filter; over 4 x 4 blocks and the whole
    image, a channel after the other. Numbers of shapes are told by another name: see below. False
    alarms: 1e-6 a channel, 2e-5 a filter."""
    scene = tray("lambertian", "constant", rfilter=rfilter)
    one, other = ([of(scene, ALL, seed) for seed in range(8)] for of in (ours, mitsubas))
    compared = set(one[0]) - {"shape_index_1.I"}
    assert len(compared) == 16
    for name in sorted(compared):
        mine, its = (
            Estimate.of([block_means(image[name][..., None], 4) for image in side])
            for side in (one, other)
        )
        assert not differences(mine, its), name
        # An error of 1 % would be seen where a channel has values of about one.
        assert np.sqrt(mine.error2 + its.error2).max() < 2e-3 * max(1, np.abs(its.mean).max()), name


def test_numbers_of_shapes(rgb):
    """Mitsuba has those of its registry, which are others in each process. Pixels whose whole area
    is of one shape tell which are which."""
    scene = tray("lambertian", "constant")
    (mine,), (its,) = (
        [image[name] for name in image if name.endswith(".I")]
        for image in (of(scene, "a:shape_index", 0) for of in (ours, mitsubas))
    )
    whole = np.zeros(mine.shape, bool)
    inner = mine[1:-1, 1:-1]
    around = [mine[1 + y : 47 + y, 1 + x : 47 + x] for y in (-1, 0, 1) for x in (-1, 0, 1)]
    whole[1:-1, 1:-1] = (np.array(around) == inner).all(axis=0)
    assert whole.mean() > 0.3
    pairs = {(int(a), round(float(b))) for a, b in zip(mine[whole], its[whole])}
    shapes = scene.shapes()
    registry = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
    found = {number for number, _ in pairs}
    assert len(found) == 10  # nine spheres and the floor
    assert pairs <= {(0, 0), *((i + 1, number) for i, number in enumerate(registry))}


def test_instances_are_shapes(rgb):
    scene = mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "ball": {"type": "sphere"}},
            "left": {
                "type": "instance",
                "to_world": mi.ScalarTransform4f().translate([-2, 0, 0]),
                "group": {"type": "ref", "id": "group"},
            },
            "right": {
                "type": "instance",
                "to_world": mi.ScalarTransform4f().translate([2, 0, 0]),
                "group": {"type": "ref", "id": "group"},
            },
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 9), (0, 0, 0)) @ mi.ScalarTransform4f().scale(4),
                "film": film(16),
            },
        }
    )
    numbers = ours(scene, "a:shape_index", 0)["a.I"]
    kinds = [shape.class_name() for shape in scene.shapes()]
    middle = {int(numbers[8, 4]), int(numbers[8, 12])}
    assert len(middle) == 2 and all(kinds[number - 1] == "Instance" for number in middle)
    assert numbers[0, 0] == 0


def behind_glass(front, rfilter="box"):
    """A red wall with a slab before it."""
    return mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "constant"},
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(50),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": [0.8, 0.4, 0.2]},
                },
            },
            "front": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).rotate([1, 0, 0], 30),
                "bsdf": front,
            },
            "sensor": {
                "type": "perspective",
                "fov": 8,
                "to_world": look((0, 0, 6), (0, 0, 0)),
                "film": film(8, rfilter=rfilter),
            },
        }
    )


def test_albedo_and_normal_are_of_what_glass_shows(rgb):
    """All else is of the glass. It reflects some of the paths into the sky, whose albedo and normal
    are none; each is a share of the wall's."""
    scene = behind_glass({"type": "thindielectric"})
    found = ours(scene, "al:albedo,n:sh_normal,g:geo_normal,d:depth,p:position,i:shape_index", 3)
    share = found["al.R"] / 0.8
    assert 0.5 < share.min() and share.mean() < 0.99
    np.testing.assert_allclose(found["al.G"], 0.4 * share, atol=1e-5)
    np.testing.assert_allclose(found["n.Z"], share, atol=1e-5)
    np.testing.assert_allclose(found["g.Z"], np.cos(np.radians(30)), atol=1e-5)
    assert np.all(np.abs(found["d.T"] - 4) < 0.3) and np.all(np.abs(found["p.Z"] - 2) < 0.3)
    kinds = {int(number) for number in np.unique(found["i.I"])}
    assert len(kinds) == 1


@pytest.mark.parametrize("rfilter", ["mitchell", *extended("box")])
def test_bounds(variant, rfilter):
    """Albedo is in [0, 1] under filters with negative lobes, too; normals are means of unit
    vectors. The sky has neither."""
    scene = tray("rough", "constant", rfilter=rfilter)
    found = ours(scene, "a:albedo,n:sh_normal,d:depth", 1)
    albedo = np.stack([found[f"a.{letter}"] for letter in "RGB"])
    assert albedo.min() >= 0 and albedo.max() <= 1 and albedo.mean() > 0.3
    length = np.sqrt(sum(found[f"n.{letter}"] ** 2 for letter in "XYZ"))
    assert length.max() <= (1.0001 if rfilter == "box" else 1.5) and length.mean() > 0.8
    assert found["d.T"].min() > 0


# --- Where they stand in the image ----------------------------------------------------------------


@pytest.mark.parametrize("plugin", BY_DEFAULT)
def test_every_plugin_has_them(rgb, plugin):
    """After all other channels, in the order of the text; computed once, and the image is that
    without them."""
    scene = tray("delta", "constant", size=12)
    few = {"max_depth": 3, "variance": True}
    plain, layered = (
        mi.load_dict({"type": plugin, **few, **more}).session(scene, seed=2, spp=16)
        for more in ({}, {"aovs": "nn:sh_normal, dd.y:depth"})
    )
    for session in (plain, layered):
        session.iterate()
        session.iterate()
    names = ["R", "G", "B", "var.R", "var.G", "var.B"]
    assert plain.channels == names
    assert layered.channels == [*names, "nn.X", "nn.Y", "nn.Z", "dd.y.T"]
    one, other = plain.image(), layered.image()
    np.testing.assert_allclose(other[..., :3], one[..., :3], rtol=1e-4, atol=1e-5)
    depth = ours(scene, "d:depth", 0)["d.T"]
    assert np.all(np.abs(other[..., -1] - depth) < 0.2)
    layered.iterate()
    np.testing.assert_allclose(layered.image()[..., 6:], other[..., 6:], rtol=1e-5, atol=1e-6)
    assert layered.settings["aovs"] == "nn:sh_normal,dd.y:depth"


@pytest.mark.parametrize(
    "options", [{"pixel_format": "rgba"}, *extended({}, {"rfilter": "gaussian"})]
)
def test_films_and_crops(rgb, options):
    """As channels of the image that Mitsuba returns, with alpha, and under wide filters."""
    scene = tray("lambertian", "constant", size=24, crop_offset_x=5, crop_width=16, **options)
    image = np.array(mi.render(scene, integrator=bdpm(aovs="dd:depth,n:sh_normal"), spp=8, seed=1))
    sensor = scene.sensors()[0]
    alpha = ["A"] if options.get("pixel_format") else []
    assert film_channels(sensor) == ["R", "G", "B", *alpha, "dd.T", "n.X", "n.Y", "n.Z"]
    found = ours(scene, "dd:depth", 9)["dd.T"]
    assert image.shape == (24, 16, len(film_channels(sensor)))
    assert np.abs(image[..., -4] - found).mean() < 0.02


def test_nothing_is_made_where_nothing_is_asked_for(rgb, monkeypatch):
    from mis_integrators.integrators import common

    def refuse(*arguments):
        raise AssertionError("asked for")

    monkeypatch.setattr(common, "render_layers", refuse)
    scene = tray("lambertian", "constant", size=12)
    sessions = [
        mi.load_dict({"type": "bdpt", **given}).session(scene, spp=1)
        for given in ({}, {"aovs": "a:albedo"})
    ]
    for session in sessions:
        session.iterate()
    sessions[0].image()
    with pytest.raises(AssertionError, match="asked for"):
        sessions[1].image()


# --- The split of light ---------------------------------------------------------------------------

SPLIT_ALL = "d:direct,i:indirect,c:caustic"
VARIANTS = "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb"
WIDE = {"rfilter": "gaussian", "pixel_format": "rgba"}
LARGE = {"max_depth": 4, "camera_paths": 8, "sampler": "independent"}
OF = {
    "bdpm": {"initial_radius": 0.04, "photon_count": 20000},
    "bdpm_balance": {"initial_radius": 0.04, "photon_count": 20000},
    "bdpm_opt3": {"initial_radius": 0.04, "photon_count": 20000},
    "vcm": {"initial_radius": 0.04},
}
"""Parameters of plugins for which no pilot has to be compiled, as others look at that."""


@in_one_thread
def split_batches(plugin, scene, count, blocks=3, **parameters):
    """Region means of iterations, for the three classes apart: an `Estimate` each."""
    given = {"aovs": SPLIT_ALL, **LARGE, **OF.get(plugin, {}), **parameters}
    session = mi.load_dict({"type": plugin, **given}).session(scene, seed=7, spp=0)
    images = [image[..., -9:] for image in pictures(session, count)]
    return [
        Estimate.of([block_means(image[..., 3 * k : 3 * k + 3], blocks) for image in images])
        for k in range(3)
    ]


@in_one_thread
def reference(integrator, scene, count=16, spp=64):
    """Region means of renders by one of Mitsuba's integrators."""
    images = (
        np.array(mi.render(scene, integrator=integrator, seed=100 + i, spp=spp))
        for i in range(count)
    )
    return Estimate.of([block_means(image, 3) for image in images])


@pytest.mark.parametrize(
    "plugin, options",
    [
        ("bdpm_opt3", WIDE),
        *extended(
            *((plugin, {}) for plugin in SURFACE_PLUGINS),
            *((plugin, WIDE) for plugin in REPRESENTATIVES if plugin != "bdpm_opt3"),
        ),
    ],
)
def test_split_sums_to_the_image(rgb, plugin, options):
    """Up to rounding; and the image is the one that is not split."""
    scene = tray("delta", "several", size=24, crop_offset_y=3, crop_height=17, **options)
    given = {"max_depth": 5, "hide_emitters": bool(options), **OF.get(plugin, {})}
    images = []
    for aovs in (SPLIT_ALL, "none"):
        session = mi.load_dict({"type": plugin, "aovs": aovs, **given}).session(
            scene, seed=3, spp=8
        )
        session.iterate()
        session.iterate()
        images.append(session.image())
    image, plain = images
    layers = image[..., -9:].reshape(17, 24, 3, 3)
    assert np.all(layers.mean(axis=(0, 1, 3)) > 1e-3 * image[..., :3].mean())
    assert layers.min() >= 0
    scale = image[..., :3].mean()
    np.testing.assert_allclose(layers.sum(axis=2), image[..., :3], rtol=1e-4, atol=1e-5 * scale)
    if plugin != "bdpm_auto":  # which tries `path`, too, where light is not split
        np.testing.assert_allclose(image[..., :3], plain[..., :3], rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize(
    "variant, plugin",
    one_in_each_row(VARIANTS, REPRESENTATIVES, [("llvm_ad_spectral", "vcm")]),
    indirect=["variant"],
)
def test_split_in_all_variants(variant, plugin):
    scene = tray("delta", "constant", size=12)
    session = mi.load_dict(
        {"type": plugin, "aovs": SPLIT_ALL, "max_depth": 4, **OF.get(plugin, {})}
    ).session(scene, seed=1, spp=4)
    session.iterate()
    image = session.image()
    layers = image[..., -9:].reshape(12, 12, 3, 3).sum(axis=2)
    np.testing.assert_allclose(layers, np.broadcast_to(image[..., :-9], layers.shape), rtol=2e-3)


@pytest.fixture(scope="module")
def of_paths():
    """Region means of the three classes, by camera paths that know nothing but BSDFs."""
    mi.set_variant("llvm_ad_rgb")
    scene = tray("delta", "constant")
    images = [traced(scene, scene.sensors()[0], 256, seed, max_depth=4) for seed in range(16)]
    return [Estimate.of([block_means(image[:, :, k], 3) for image in images]) for k in range(3)]


@pytest.mark.long
@pytest.mark.parametrize(
    "plugin",
    ["bdpm", *extended("bdpm_opt3", "bdpm_balance", "bdpt", "vcm", "pcbpt", "bdpt_ris")],
)
def test_split_is_that_of_paths(rgb, of_paths, plugin):
    """Mirrors, glass, masks, and BSDFs that are both, each in a block of its own: each class
    against camera paths that know nothing but BSDFs. False alarms: 1e-6 a class. What would be
    seen, of direct light, indirect light and caustics: 5, 15 and 10 % in the image."""
    visible = (0.05, 0.12), (0.15, 0.9), (0.1, 0.4)
    for k, mine in enumerate(split_batches(plugin, tray("delta", "constant"), 40)):
        assert_same(mine, of_paths[k], *visible[k])


@pytest.mark.parametrize("plugin", extended("bdpm", "bdpm_opt3", "bdpt", "vcm", "bdpt_ris"))
def test_split_without_delta_surfaces(rgb, plugin):
    """Nothing is a caustic, and direct light is that of two segments; so the rest is indirect, for
    the three sum to the image. False alarms: 1e-6."""
    scene = tray("rough", "point")
    direct, _, caustic = split_batches(plugin, scene, 48)
    assert np.all(caustic.mean == 0)
    assert_same(direct, reference(path(max_depth=2), scene), whole=0.04, block=0.2)


@pytest.mark.long
@pytest.mark.parametrize("plugin", ["bdpm", *extended("vcm")])
def test_direct_light_of_photons_alone(rgb, plugin):
    """Light that neither a camera path can meet nor next-event estimation can sample: photons that
    have scattered nowhere are no caustics. Against `ptracer`, 1e-6 false alarms."""
    scene = tray("lambertian", "directionalarea")
    direct, indirect, caustic = split_batches(plugin, scene, 16)
    assert np.all(caustic.mean == 0) and indirect.mean[0].min() > 0
    assert_same(direct, reference(ptracer(max_depth=2), scene, spp=256), whole=0.05, block=0.2)


def lamp_in_a_box(in_view=False):
    """A lamp within a box of glass above a floor; or seen through that box, without a floor."""
    transform = mi.ScalarTransform4f
    place = transform().translate([0, 0, 5])
    scene = {
        "type": "scene",
        "lamp": {
            "type": "sphere",
            "to_world": place @ transform().scale(1.4),
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": 3.0},
        },
        "box": {
            "type": "cube",
            "to_world": place @ transform().scale(1.5),
            "bsdf": {"type": "thindielectric"},
        },
        "sensor": {
            "type": "perspective",
            "fov": 30,
            "to_world": look((8, 0, 3), (0, 0, 5 if in_view else 0), up=(0, 0, 1)),
            "film": film(24),
        },
    }
    if not in_view:
        scene["floor"] = {"type": "rectangle", "to_world": transform().scale(4)}
    return mi.load_dict(scene)


@pytest.mark.parametrize("plugin", ["vcm", *extended("bdpm", "bdpm_opt2", "bdpt", "bdpt_ris")])
def test_light_that_leaves_through_glass(rgb, plugin):
    """What it lights is a caustic, all of it; the lamp itself, seen through glass, is direct. The
    caustic against `path`, which meets the lamp by chance; 1e-6 false alarms."""
    given = {"camera_paths": 16, "max_depth": 6}
    if plugin.startswith("bdpm"):
        given |= {"initial_radius": 0.1, "photon_count": 20000}
    direct, indirect, caustic = split_batches(plugin, lamp_in_a_box(), 32, **given)
    assert np.all(direct.mean == 0) and np.all(indirect.mean == 0)
    its = reference(path(max_depth=6), lamp_in_a_box(), count=32, spp=256)
    assert_same(caustic, its, whole=0.1, block=0.4)
    direct, indirect, caustic = split_batches(plugin, lamp_in_a_box(True), 8, **given)
    assert np.all(indirect.mean == 0) and np.all(caustic.mean == 0)
    assert direct.mean[0].min() > 0.05


@pytest.mark.parametrize(
    "plugin, module, size",
    [
        ("bdpm", "bdpm", "CAMERA_CHUNK"),
        *extended(("bdpt_ris", "resampled_passes", "CHUNK"), ("bdpt", "bdpt", "CHUNK")),
    ],
)
def test_split_of_films_in_parts(rgb, monkeypatch, plugin, module, size):
    monkeypatch.setattr(sys.modules[f"mis_integrators.integrators.{module}"], size, 200)
    scene = tray("delta", "constant", size=24)
    given = {"aovs": SPLIT_ALL, **OF.get(plugin, {})}
    session = mi.load_dict({"type": plugin, **given}).session(scene, seed=3, spp=4)
    session.iterate()
    assert session.chunks > 2
    image = session.image()
    layers = image[..., -9:].reshape(24, 24, 3, 3).sum(axis=2)
    np.testing.assert_allclose(layers, image[..., :3], rtol=1e-4, atol=1e-6)


def test_split_of_merges_in_rounds(rgb, monkeypatch):
    """Each round of light sub-paths brings light of its own to the layers."""
    from mis_integrators.integrators import resampled_passes

    monkeypatch.setattr(resampled_passes, "CHUNK", 200)
    monkeypatch.setattr(resampled_passes, "KNOWN_PATHS", 50)
    scene = tray("delta", "constant", size=12)
    integrator = mi.load_dict(
        {
            "type": "bdpt_ris",
            "aovs": SPLIT_ALL,
            "merging": True,
            "initial_radius": 0.2,
            "light_paths": 50,
            "light_tracing": 3,
        }
    )
    session = integrator.session(scene, seed=3, spp=0)
    session.iterate()
    assert session.light_rounds > 1
    image = session.image()
    layers = image[..., -9:].reshape(12, 12, 3, 3).sum(axis=2)
    np.testing.assert_allclose(layers, image[..., :3], rtol=1e-4, atol=1e-6)


def test_automatic_choice_leaves_out_what_cannot_split(rgb):
    """Light of two segments is `path`'s business, unless it is to be split."""
    scene = tray("lambertian", "constant", size=12)
    for aovs, plugin in (("a:albedo", "path"), ("d:direct", "bdpm")):
        integrator = mi.load_dict({"type": "bdpm_auto", "aovs": aovs, "max_depth": 2})
        session = integrator.session(scene, seed=1, spp=4)
        session.iterate()
        assert session.settings["choice"] == plugin and session.settings["aovs"] == aovs


def test_split_beside_images_of_techniques(rgb):
    """All of them in one image: the pyramid's come first, and each sums to the image."""
    scene = tray("delta", "constant", size=12)
    integrator = mi.load_dict(
        {"type": "bdpt", "aovs": f"dd:depth,{SPLIT_ALL}", "techniques": 2, "variance": True}
    )
    session = integrator.session(scene, seed=3, spp=8)
    session.iterate()
    session.iterate()
    image, names = session.image(), session.channels
    assert names[-10:] == ["dd.T", *(f"{name}.{letter}" for name in "dic" for letter in "RGB")]
    techniques = [i for i, name in enumerate(names) if name.startswith("technique.")]
    assert max(techniques) < names.index("dd.T") and names[3] == "var.R"
    for places in (techniques, range(len(names) - 9, len(names))):
        parts = image[..., list(places)].reshape(12, 12, -1, 3).sum(axis=2)
        np.testing.assert_allclose(parts, image[..., :3], rtol=1e-3, atol=1e-5)


# --- Wrong input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, wrong",
    [
        ("albedo", '"albedo" is no pair of a name and a type'),
        ("a:diffuse", 'there is no type "diffuse"'),
        ("a:b:c", 'there is no type "b:c"'),
        ("a:albedo,", '"" is no pair'),
        (":depth", '":depth" is no pair'),
        ("a b:depth", '"a b:depth" is no pair'),
        ("a:depth,a:albedo", 'the name "a" is there twice'),
    ],
)
def test_wrong_texts(rgb, text, wrong):
    """One line, which names all types."""
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "bdpt", "aovs": text})
    line = last_line(error)
    assert 'bdpt: parameter "aovs" = ' in line and wrong in line
    assert all(kind in line for kind in [*CHANNELS, *SPLIT])


def test_other_wrong_values(rgb):
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "bdpm", "aovs": 3})
    assert 'parameter "aovs" = 3 is not allowed' in last_line(error)
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "bdpm", "aovs": "var:albedo", "variance": True})
    assert 'the channel "var.R" is there already' in last_line(error)
    mi.load_dict({"type": "bdpm", "aovs": "var:albedo"})
    for nothing in ("", "none"):
        assert mi.load_dict({"type": "bdpm", "aovs": nothing}).aov_names() == []


def foggy(sensor):
    """A cube of fog before a wall, under a sky."""
    return mi.load_dict(
        {
            "type": "scene",
            "fog": {
                "type": "cube",
                "bsdf": {"type": "null"},
                "interior": {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0},
            },
            "wall": {"type": "rectangle", "to_world": T().translate([0.5, 0, -2]).scale(2)},
            "light": {"type": "constant"},
            "sensor": sensor,
        }
    )


def before_fog(**more):
    look = T().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "to_world": look, "film": film(12, "gaussian"), **more}


@pytest.mark.long
@pytest.mark.parametrize("plugin", ["volpath_multiview", "bdpm_auto"])
def test_layers_of_scenes_with_media_are_those_of_bdpm(rgb, plugin):
    scene, images = foggy(before_fog()), []
    for name in ("bdpm", plugin):
        integrator = mi.load_dict({"type": name, "aovs": "a:albedo,d:depth", "max_depth": 3})
        session = integrator.session(scene, seed=7, spp=2)
        session.iterate()
        assert session.channels[-4:] == ["a.R", "a.G", "a.B", "d.T"]
        images.append(session.image()[..., -4:])
    assert session.settings.get("choice", plugin) == "volpath_multiview"
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-4)
    assert len(np.unique(images[0][..., 3])) > 4


def test_light_in_media_is_split_by_photons(rgb):
    integrator = mi.load_dict({"type": "bdpm_auto", "aovs": SPLIT_ALL, "max_depth": 3})
    session = integrator.session(foggy(before_fog()), seed=7, spp=2)
    session.iterate()
    assert session.settings["choice"] == "bdpm"
    with pytest.raises(RuntimeError, match='no type "direct"'):
        mi.load_dict({"type": "volpath_multiview", "aovs": "d:direct"})


@pytest.mark.parametrize("plugin", ["volpath_multiview", "bdpm_auto"])
def test_several_views_have_no_layers(rgb, plugin):
    views = {f"view{number}": before_fog() for number in range(2)}
    scene = foggy({"type": "batch", "film": film(12), **views})
    integrator = mi.load_dict({"type": plugin, "aovs": "a:albedo"})
    with pytest.raises(Exception, match="of several views there are no layers"):
        integrator.session(scene, spp=4)


# --- The command ----------------------------------------------------------------------------------


@pytest.fixture
def scene_file(tmp_path, rgb):
    return lamplit.write_scene(tmp_path)


AOVS = "-P", "aovs=al:albedo,d:depth,c:caustic", "-P", "variance=true"
NAMES = [*"BGR", "al.B", "al.G", "al.R", "c.B", "c.G", "c.R", "d.T", "var.B", "var.G", "var.R"]
"""In the order of the alphabet, as `lamplit.read` has them."""


def rendered(scene_file, output, *arguments):
    options = "-i", "bdpm", "-P", "initial_radius=0.05", "--spp", 4, *arguments
    assert lamplit.render(scene_file, *options, "-o", output) == 0
    return lamplit.read(output)


def test_command_writes_them_and_reads_them_back(scene_file, tmp_path):
    """`--like` renders them again; a preview and the PNG show colours alone."""
    header, image = rendered(scene_file, tmp_path / "a.exr", *AOVS, "--preview", 0.01)
    assert header["aovs"] == "al:albedo,d:depth,c:caustic" and image.shape == (24, 24, len(NAMES))
    plain_header, plain = rendered(scene_file, tmp_path / "p.exr", "-P", "variance=true")
    assert plain_header["aovs"] == "none"
    assert lamplit.same(image[..., [0, 1, 2, 10, 11, 12]], plain)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "p.png").read_bytes()
    assert image[..., 9].max() > 1 and image[..., 3:6].max() <= 1
    assert lamplit.render(scene_file, "-o", tmp_path / "b.exr", "--like", tmp_path / "a.exr") == 0
    assert lamplit.same(lamplit.read(tmp_path / "b.exr")[1], image)


@pytest.mark.extended
def test_command_resumes_with_them(scene_file, tmp_path):
    """A render in two parts is the whole one, and the layers are no sums of iterations."""
    whole = rendered(scene_file, tmp_path / "a.exr", *AOVS)[1]
    rendered(scene_file, tmp_path / "b.exr", *AOVS, "--checkpoint", 1000, "--spp", 2)
    parts = rendered(scene_file, tmp_path / "b.exr", *AOVS, "--checkpoint", 1000, "--resume")[1]
    assert lamplit.same(parts, whole)


def test_command_denoises_colours_alone(scene_file, tmp_path):
    pytest.importorskip("mitsuba_oidn")
    _, image = rendered(scene_file, tmp_path / "a.exr", *AOVS, "--denoise")
    _, denoised = lamplit.read(tmp_path / "a.denoised.exr")
    assert denoised.shape == image.shape
    np.testing.assert_array_equal(denoised[..., 3:], image[..., 3:])
    assert not lamplit.same(denoised[..., :3], image[..., :3])


@pytest.mark.extended
def test_workers_have_them(scene_file, tmp_path):
    pytest.importorskip("distributed")
    _, alone = rendered(scene_file, tmp_path / "a.exr", *AOVS)
    _, shared = rendered(scene_file, tmp_path / "b.exr", *AOVS, "--workers", 2)
    assert lamplit.same(shared, alone)
