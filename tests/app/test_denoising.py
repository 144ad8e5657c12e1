"""``--denoise``, `mis_integrators.denoise`, and what denoisers are told of a picture."""

import sys

import mis_integrators
from mis_integrators.app import cli, denoising
from mis_integrators.app.denoising import DOUBT, shrunk, without_noise
from mis_integrators.core.film import WINDOW, direct_channels
from mis_integrators.core.windows import window_mean
from mis_integrators.paths.guides import albedo_and_normal

import lamplit
import mitsuba as mi
import numpy as np
import pytest
from comparing import in_one_thread
from lamplit import read, same, write_scene
from selection import extended

pytest.importorskip("mitsuba_oidn")


@pytest.fixture
def scene(tmp_path, rgb):
    return write_scene(tmp_path)


def painted_wall(in_front=None, behind=None, **film):
    """A wall of known reflectance that fills the picture, with something in front of it, and
    something behind the camera."""
    others = {"front": in_front, "behind": behind}
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
            "fov": 20,
            "film": {"type": "hdrfilm", "width": 6, "height": 4, **film},
        },
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(100),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.25, 0.5, 0.75]}},
        },
    }
    return mi.load_dict(scene | {name: shape for name, shape in others.items() if shape})


def slab(bsdf):
    """Two faces between the camera and the wall."""
    return {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).scale([50, 50, 0.1]),
        "bsdf": bsdf,
    }


WALL = np.array([0.25, 0.5, 0.75])


def wall_of(variant):
    return WALL if "rgb" in variant else np.full(3, WALL.mean())


def test_guides_of_a_wall(variant):
    scene = painted_wall()
    albedo, normal = albedo_and_normal(scene, scene.sensors()[0], samples=2)
    assert albedo.shape == normal.shape == (4, 6, 3)
    # Spectral reflectances are fitted to the colour; mono ones are its luminance.
    allowed = 1e-5 if "rgb" in variant else 0.1
    np.testing.assert_allclose(albedo, np.broadcast_to(wall_of(variant), (4, 6, 3)), atol=allowed)
    np.testing.assert_allclose(normal, np.broadcast_to([0, 0, 1], (4, 6, 3)), atol=1e-5)


def test_guides_see_through_glass(rgb):
    """A thin pane reflects some of the paths to where nothing is, the others meet the wall: albedo
    is that share of it, and normals keep their direction."""
    scene = painted_wall(slab({"type": "dielectric", "int_ior": 1.5}))
    albedo, normal = albedo_and_normal(scene, scene.sensors()[0], samples=256)
    share = albedo[..., 1] / 0.5
    # 1 - 2 r / (1 + r), r = 0.04: 0.923; each pixel is the mean of 256 paths, so that 0.08 is five
    # standard deviations: one false alarm in 1e5 for all pixels.
    assert np.all(np.abs(share - 0.923) < 0.08)
    np.testing.assert_allclose(albedo, share[..., None] * WALL, atol=1e-5)
    assert np.all(normal[..., 2] > 0.8) and np.all(np.abs(normal[..., :2]) < 1e-4)


def lamp_before_the_wall(distance):
    """It fills the picture, and faces the camera; its BSDF is black."""
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, distance]).scale(50),
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": 1.0},
    }


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_guides_do_not_show_what_is_hidden(rgb, hide_emitters):
    """Two lamps, one behind the other."""
    scene = painted_wall(*(lamp_before_the_wall(distance) for distance in (2, 3)))
    albedo, normal = albedo_and_normal(
        scene, scene.sensors()[0], samples=2, hide_emitters=hide_emitters
    )
    expected = WALL if hide_emitters else np.zeros(3)
    np.testing.assert_allclose(albedo, np.broadcast_to(expected, (4, 6, 3)), atol=1e-5)
    np.testing.assert_allclose(normal, np.broadcast_to([0, 0, 1], (4, 6, 3)), atol=1e-5)


def test_guides_show_what_is_behind_holes(rgb):
    """A mask lets all light pass on its left half, and none on its right one."""
    opacity = mi.Bitmap(np.float32([[[0.0], [1.0]]]).repeat(2, axis=0))
    mask = {
        "type": "mask",
        "opacity": {"type": "bitmap", "bitmap": opacity, "filter_type": "nearest", "raw": True},
        "nested": {"type": "diffuse", "reflectance": 0.3},
    }
    turned = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([1, 0, 0], 30).scale(50)
    scene = painted_wall({"type": "rectangle", "to_world": turned, "bsdf": mask})
    albedo, normal = albedo_and_normal(scene, scene.sensors()[0], samples=2)
    for hole in (albedo[:, :3], albedo[:, 3:]):
        expected = WALL if np.allclose(hole[0, 0], WALL, atol=1e-4) else [0.3] * 3
        np.testing.assert_allclose(hole, np.broadcast_to(expected, hole.shape), atol=1e-4)
    assert not np.allclose(albedo[0, 0], albedo[0, -1])
    behind = np.all(np.isclose(albedo, WALL, atol=1e-4), axis=-1)
    np.testing.assert_allclose(normal[behind], [[0, 0, 1]] * behind.sum(), atol=1e-5)
    assert np.all(normal[~behind][:, 2] < 0.9)


def test_guides_of_mirrors_are_what_is_in_them(rgb):
    """A mirror before the wall that shows another wall, behind the camera: half of its light."""
    transform = mi.ScalarTransform4f
    scene = painted_wall(
        {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 2]).scale(50),
            "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": 0.5},
        },
        behind={
            "type": "rectangle",
            "to_world": transform().translate([0, 0, 9]).rotate([0, 1, 0], 180).scale(100),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.8]}},
        },
    )
    albedo, normal = albedo_and_normal(scene, scene.sensors()[0], samples=2)
    np.testing.assert_allclose(albedo, np.broadcast_to([0.1, 0.2, 0.4], (4, 6, 3)), atol=1e-5)
    np.testing.assert_allclose(normal, np.broadcast_to([0, 0, -1], (4, 6, 3)), atol=1e-5)


def test_guides_cover_the_crop_window(rgb):
    """Also where a film samples the border around it."""
    scene = painted_wall(
        crop_offset_x=1, crop_width=4, sample_border=True, rfilter={"type": "gaussian"}
    )
    assert albedo_and_normal(scene, scene.sensors()[0], 1)[0].shape == (4, 4, 3)


def test_noise_goes(rgb):
    """Three quarters of it at least (hardly by chance: 4096 pixels), and only from colours."""
    clean = np.linspace(0.2, 0.8, 64, dtype=np.float32)[:, None, None] * np.ones((64, 64, 5))
    noise = np.random.default_rng(1).normal(0, 0.1, clean.shape).astype(np.float32)
    noisy = (clean + noise).astype(np.float32)
    found = mis_integrators.denoise(noisy)
    assert found.shape == noisy.shape and found.dtype == np.float32
    assert np.mean((found - clean)[..., :3] ** 2) < np.mean(noise[..., :3] ** 2) / 4
    np.testing.assert_array_equal(found[..., 3:], noisy[..., 3:])


@pytest.mark.parametrize("shape", [(16, 16), (16, 16, 1), (16, 16, 2)])
def test_grey_images_stay_grey(rgb, shape):
    """Denoised as colours that are grey; a second channel is alpha, and stays."""
    image = np.full(shape, 0.5, np.float32)
    found = mis_integrators.denoise(mi.TensorXf(image))
    assert found.shape == shape
    np.testing.assert_allclose(found, image, atol=0.1)
    if len(shape) == 3:
        np.testing.assert_array_equal(found[..., 1:], image[..., 1:])


def test_edges_that_guides_have_stay_and_the_rest_is_smoother(rgb):
    """Stripes of two albedos under light that changes slowly, and the guides' own noise: a quarter
    of the error goes at least. (One seed, 16384 pixels; it is nearly half.)"""
    rng = np.random.default_rng(3)
    stripes = np.where(np.arange(128) // 5 % 2, 0.8, 0.3)[None, :, None]
    clean = stripes * np.linspace(0.5, 1.5, 128)[:, None, None] * np.ones(3)
    noisy = np.maximum(clean + rng.normal(0, 0.3, clean.shape), 0).astype(np.float32)
    albedo = np.broadcast_to(stripes, clean.shape) + rng.normal(0, 0.02, clean.shape)
    normal = np.broadcast_to([0.0, 0.0, 1.0], clean.shape)
    guides = [np.ascontiguousarray(guide, np.float32) for guide in (albedo, normal)]
    left, less = (
        np.mean(np.square(without_noise(noisy, guides, all_edges) - clean))
        for all_edges in (False, True)
    )
    assert less < 0.75 * left


def test_broken_pixels_and_black_ones(rgb):
    image = np.zeros((16, 16, 3), np.float32)
    image[3, 3], image[5, 5], image[7, 7] = np.nan, np.inf, -1
    np.testing.assert_allclose(mis_integrators.denoise(image), 0, atol=0.01)


def test_images_of_other_shapes_are_refused(rgb):
    with pytest.raises(ValueError, match=r"not \(3,\)"):
        mis_integrators.denoise(np.zeros(3))
    with pytest.raises(ValueError, match=r"3 x 5 pixels, the sensor's film 6 x 4"):
        mis_integrators.denoise(np.zeros((5, 3, 3)), painted_wall())


@pytest.mark.parametrize("apart", [False, True])
def test_highlights_are_no_brighter_than_their_samples(rgb, apart):
    """Small highlights of which each sample meets all or nothing, on black: Open Image Denoise
    alone makes them brighter than any sample."""
    rng, image = np.random.default_rng(1), np.zeros((128, 128, 3), np.float32)
    row, column = np.mgrid[:128, :128]
    for y, x in rng.integers(10, 118, (12, 2)):
        highlight = (row - y) ** 2 + ((column - x) / 2) ** 2 < 4
        image[highlight & (rng.random((128, 128)) < 0.6)] = 2.5
    assert without_noise(image).max() > 1.3 * image.max()
    names = ["R", "G", "B"]
    if apart:
        names += direct_channels()
        image = np.concatenate([image, image, np.ones((128, 128, 1), np.float32)], axis=-1)
    clean = mis_integrators.denoise(image, channels=names)[..., :3]
    assert 2 < clean.max() <= 2.5


# --- direct light apart --------------------------------------------------------------------------


def test_light_is_denoised_as_far_as_it_is_noisy():
    """Towards a copy that is wrong by 0.5 on one side, and right on the other; the noise has the
    variance 0.01. The weights of the raw image are 1 - 0.01 DOUBT / 0.26 and 0. (65536 pixels in
    windows of 25: hardly by chance more than a fifth from that.)"""
    noise = np.random.default_rng(2).normal(0, 0.1, (256, 256, 1)) * np.ones(3)
    clean = np.where(np.arange(256)[:, None] < 128, 0.5, 0.0) * np.ones((256, 256))
    clean = clean[..., None] * np.ones(3)
    left = np.square(shrunk(noise, clean, np.full((256, 256), 0.01)))
    weight = 1 - DOUBT * 0.01 / 0.26
    expected = ((1 - weight) * 0.5) ** 2 + weight**2 * 0.01
    assert left[:120].mean() == pytest.approx(expected, rel=0.2)
    assert left[136:].mean() < 1e-4
    np.testing.assert_allclose(shrunk(noise, clean, np.zeros((256, 256))), noise, atol=1e-9)
    np.testing.assert_array_equal(shrunk(noise, clean, np.ones((256, 256))), clean)


def test_rare_bright_samples_do_not_come_back():
    """Two iterations in which a pixel in ten is bright, and their own estimate of the variance: a
    window in which a pixel was bright twice has a variance that is too small. Without doubt one
    pixel in fifty is a dot."""
    one, other = 10.0 * (np.random.default_rng(5).random((2, 256, 256)) < 0.1)
    variance = window_mean(np.square(one - other) / 4, WINDOW)
    raw = ((one + other) / 2)[..., None] * np.ones(3)
    left = shrunk(raw, np.ones_like(raw), variance)[..., 0]
    assert np.mean(left > 2) < 1e-3
    assert np.mean(raw[..., 0] > 2) > 0.1  # there was something to remove


def test_windows_that_bright_samples_missed_are_not_dark():
    """Five iterations in which a pixel in fifty is bright: one window in twelve has met none, and
    its own variance is zero."""
    hits = 50.0 * (np.random.default_rng(6).random((5, 256, 256)) < 0.02)
    variance = window_mean(hits.var(axis=0, ddof=1) / 5, WINDOW)
    raw = hits.mean(axis=0)[..., None] * np.ones(3)
    assert np.mean(variance == 0) > 0.05
    left = shrunk(raw, np.ones_like(raw), variance)[..., 0]
    assert np.mean(left < 0.5) < 1e-3


def test_one_bright_pixel_does_not_make_a_square():
    """Its window differs by that alone, at the image's border, too. Where all pixels of a window
    differ, they come back."""
    clean = np.ones((64, 64, 3))
    raw = clean.copy()
    raw[20, 20] = raw[0, 0] = raw[63, 20] = 50
    raw[40:50, 40:50] = 2
    left = shrunk(raw, clean, np.full((64, 64), 0.01))
    np.testing.assert_allclose(left[10:30, 10:30], 1, atol=1e-9)
    np.testing.assert_allclose(left[:3, :3], 1, atol=1e-9)
    np.testing.assert_allclose(left[61:, 10:30], 1, atol=1e-9)
    np.testing.assert_allclose(left[42:48, 42:48], 2, atol=2 * DOUBT * 0.01)


def lamp_in_a_box(rgb, **film):
    scene = mi.cornell_box()
    scene["sensor"]["film"] = {"type": "hdrfilm", "width": 48, "height": 48} | film
    scene["sensor"]["film"]["rfilter"] = {"type": "box"}
    return mi.load_dict(scene)


def denoised_with_names(plugin, scene, seed=1, **parameters):
    """A render for the denoiser, and its channels by name."""
    integrator = mi.load_dict({"type": plugin, "max_depth": 4, "denoised": True, **parameters})
    image = np.array(mi.render(scene, integrator=integrator, spp=16, seed=seed))
    names = ["R", "G", "B", *integrator.aov_names()]
    return image, names


def channels_of(image, names, prefix):
    return image[..., [names.index(f"{prefix}.{name}") for name in "RGB"]]


@pytest.mark.parametrize("plugin", ["bdpm", *extended("bdpm_opt2")])
def test_direct_light_is_the_layer_of_that_name(rgb, plugin):
    image, names = denoised_with_names(plugin, lamp_in_a_box(rgb), aovs="lit:direct,rest:indirect")
    direct = channels_of(image, names, "direct_light")
    np.testing.assert_allclose(direct, channels_of(image, names, "lit"), rtol=1e-4, atol=1e-6)
    assert 0.2 < direct.mean() / image[..., :3].mean() < 0.95


@pytest.mark.long
@pytest.mark.parametrize("sampler, most", [("sobol", 16), *extended(("independent", 1.5))])
@in_one_thread
def test_noise_of_direct_light_is_measured(rgb, sampler, most):
    """The channel of its variance against that of 24 renders, in blocks of 8 x 8 pixels without
    the lamp's: the median ratio is within a factor 1.5 (seeds are fixed). Sequences make less
    noise than the independent numbers that the channel is for, at best 16 iterations that of 256.
    """
    scene, images, estimates = lamp_in_a_box(rgb), [], []
    for seed in range(24):
        image, names = denoised_with_names("bdpm", scene, seed, sampler=sampler)
        images.append(channels_of(image, names, "direct_light").mean(axis=-1))
        estimates.append(image[..., names.index("direct_light.variance")])
    cells = (6, 8, 6, 8)
    true = np.var(images, axis=0, ddof=1).reshape(cells).mean(axis=(1, 3))
    estimated = np.mean(estimates, axis=0).reshape(cells).mean(axis=(1, 3))
    assert 1 / 1.5 < np.median(estimated / np.maximum(true, 1e-12)) < most


def test_edges_of_lamps_stay_sharp(rgb):
    """Of an image with its direct light apart: a tenth of the error of the whole one, denoised."""
    scene = lamp_in_a_box(rgb)
    truth = np.array(
        mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 4}), spp=1024)
    )
    image, names = denoised_with_names("bdpm", scene)
    apart, whole = (
        np.mean((mis_integrators.denoise(image, scene, channels=given)[..., :3] - truth) ** 2)
        for given in (names, ())
    )
    assert apart < 0.1 * whole


def path_under_bdpm_auto(scene, **parameters):
    """The image of 64 iterations of one sample a pixel, and its channels."""
    from mis_integrators.integrators.unidirectional import PathSession

    integrator = mi.load_dict({"type": "bdpm_auto", **parameters})
    session = PathSession(integrator, scene, scene.sensors()[0], seed=1, iterations=64)
    for _ in range(64):
        session.iterate()
    return session.image(), session.channels


@pytest.mark.parametrize("max_depth", [1, 2, 5, -1])
def test_path_under_bdpm_auto_keeps_its_direct_light_apart(rgb, max_depth):
    """It is the light of at most two segments, pixel by pixel a part of all light, which is that of
    renders for no denoiser. Its mean is that of `path`: seven standard errors that 24 renders tell,
    4e-7 false alarms a case."""
    scene = lamp_in_a_box(rgb)
    raw, _ = path_under_bdpm_auto(scene, max_depth=max_depth)
    image, names = path_under_bdpm_auto(scene, max_depth=max_depth, denoised=True)
    first = names.index("direct_light.R")
    direct, whole = image[..., first : first + 3], image[..., :3]
    np.testing.assert_allclose(whole, raw[..., :3], rtol=1e-5, atol=1e-6)
    assert (direct <= whole * (1 + 1e-5) + 1e-6).all()
    apart = min(max_depth, 2) if max_depth > 0 else 2
    if max_depth == apart:
        np.testing.assert_allclose(direct, whole, rtol=1e-5, atol=1e-6)
    path = mi.load_dict({"type": "path", "max_depth": apart})
    others = [np.array(mi.render(scene, integrator=path, spp=16, seed=k)) for k in range(2, 26)]
    means = [other.mean() for other in others]
    error = np.std(means, ddof=1) * (1 / 4 + 1 / 24) ** 0.5  # sequences have less
    assert abs(direct.mean() - np.mean(means)) < 7 * error + 1e-6


def test_names_of_another_number_of_channels_are_refused(rgb):
    with pytest.raises(ValueError, match="2 names of channels for an image of shape"):
        mis_integrators.denoise(np.zeros((4, 4, 3)), channels=["R", "G"])


def test_grey_images_beside_other_channels(rgb):
    """The colour is what names say: one channel of grey; all others stay as they are. Direct light
    is grey there, too."""
    rng = np.random.default_rng(1)
    grey = 0.5 + 0.1 * rng.random((32, 32, 1), dtype=np.float32)
    direct = np.zeros((32, 32, 3), np.float32)
    direct[:, 16:] = [0.5, 0.25, 0.1]
    variance = np.full((32, 32, 1), 1e-6, np.float32)
    image = np.concatenate([grey, direct, variance], axis=-1)
    found = mis_integrators.denoise(image, channels=["Y", *direct_channels()])
    assert same(found[..., 1:], image[..., 1:])
    assert found[..., 0].std() < 0.3 * grey.std()
    alone = mis_integrators.denoise(grey[..., 0])
    assert abs(found[..., 0].mean() - alone.mean()) < 0.01
    layers = np.concatenate([grey, direct[..., :2]], axis=-1)
    found = mis_integrators.denoise(layers, channels=["Y", "uv.U", "uv.V"])
    assert same(found[..., 1:], layers[..., 1:])


def test_direct_light_is_found_in_xyz(rgb):
    """Its channels are those of sRGB whatever the film has: a picture of nothing else has no rest,
    and so keeps the edges of its light."""
    light = np.zeros((32, 32, 3), np.float32)
    light[:, 16:] = [0.5, 0.25, 0.1]
    bitmap = mi.Bitmap(light, mi.Bitmap.PixelFormat.RGB)
    bitmap = bitmap.convert(mi.Bitmap.PixelFormat.XYZ, mi.Struct.Type.Float32, False)
    image = np.concatenate([np.array(bitmap), light, np.zeros((32, 32, 1), np.float32)], axis=-1)
    found = mis_integrators.denoise(image, channels=["X", "Y", "Z", *direct_channels()])
    np.testing.assert_allclose(found, image, atol=2e-3)


def test_sensors_that_are_not_there(rgb):
    scene = painted_wall()
    for number in (1, -1):
        with pytest.raises(ValueError, match="has 1 sensors"):
            mis_integrators.denoise(np.zeros((4, 6, 3)), scene, sensor=number)


# --- the command ---------------------------------------------------------------------------------


def render(scene, *arguments):
    return lamplit.render(scene, "-i", "path", "--spp", 4, *arguments)


def test_both_images_are_written(scene, tmp_path, capfd):
    assert render(scene, "-o", tmp_path / "a.exr", "--denoise") == 0
    assert f"denoised {tmp_path / 'a.denoised.exr'}" in capfd.readouterr().err
    header, image = read(tmp_path / "a.exr")
    header_denoised, denoised = read(tmp_path / "a.denoised.exr")
    assert (tmp_path / "a.denoised.png").stat().st_size > 0
    assert header_denoised["denoiser"].startswith("Open Image Denoise ")
    assert "denoiser" not in header and header_denoised["spp"] == header["spp"]
    assert image.shape == denoised.shape and not same(image, denoised)


def test_the_film_gets_a_box_filter(scene, tmp_path):
    """The raw image is then that of the scene with such a filter."""
    assert render(scene, "-o", tmp_path / "a.exr", "--denoise") == 0
    assert render(scene, "-o", tmp_path / "c.exr") == 0
    text = scene.read_text()
    assert '<rfilter type="gaussian"/>' in text
    for number, boxed in enumerate(
        (
            text.replace('<rfilter type="gaussian"/>', '<rfilter type="box"/>'),
            text.replace('<rfilter type="gaussian"/>', ""),  # Mitsuba's default is a gaussian
        )
    ):
        scene.write_text(boxed)
        denoise = ["--denoise"] if number else []
        assert render(scene, "-o", tmp_path / "b.exr", *denoise) == 0
        assert same(read(tmp_path / "a.exr")[1], read(tmp_path / "b.exr")[1])
    assert not same(read(tmp_path / "a.exr")[1], read(tmp_path / "c.exr")[1])


@pytest.mark.parametrize(
    "arguments, told",
    [
        (["-i", "bdpm"], True),
        (["-i", "bdpm", "-P", "denoised=false"], False),
        (["-i", "bdpt"], None),
        (["-i", "path"], None),
    ],
)
def test_integrators_are_told(scene, tmp_path, arguments, told):
    """Those that have the parameter `denoised`, unless it is given."""
    rest = "-o", tmp_path / "a.exr", "--denoise"
    assert lamplit.render(scene, *arguments, "--spp", 2, *rest) == 0
    assert read(tmp_path / "a.exr")[0].get("denoised") == told
    if told is not None:
        assert lamplit.render(scene, *arguments, "--spp", 2, *rest[:2]) == 0
        assert read(tmp_path / "a.exr")[0]["denoised"] == 0


@pytest.mark.parametrize("hidden", ["true", "false"])
def test_guides_are_told_of_hidden_emitters(scene, tmp_path, monkeypatch, hidden):
    told = []

    def noted(*arguments, hide_emitters, **others):
        told.append(hide_emitters)
        return albedo_and_normal(*arguments, hide_emitters=hide_emitters, **others)

    monkeypatch.setattr(denoising, "albedo_and_normal", noted)
    chosen = "-i", "path", "-P", f"hide_emitters={hidden}"
    assert lamplit.render(scene, *chosen, "--spp", 2, "-o", tmp_path / "a.exr", "--denoise") == 0
    assert told == [hidden == "true"]


@pytest.mark.parametrize("plugin", ["path", "bdpm"])
def test_like_denoises_again(scene, tmp_path, plugin):
    arguments = "-i", plugin, "--spp", 4, "-o", tmp_path / "a.exr", "--denoise"
    assert lamplit.render(scene, *arguments) == 0
    assert lamplit.render(scene, "-o", tmp_path / "b.exr", "--like", tmp_path / "a.exr") == 0
    for name in (".exr", ".denoised.exr"):
        assert same(read(tmp_path / f"a{name}")[1], read(tmp_path / f"b{name}")[1])


def test_checkpoints_tell_the_filter(scene, tmp_path, capfd):
    arguments = "-o", tmp_path / "a.exr", "--checkpoint", 1000
    assert render(scene, *arguments, "--denoise") == 0
    assert render(scene, *arguments, "--resume") == cli.EXIT_CHECKPOINT
    assert "reconstruction filter" in capfd.readouterr().err
    assert render(scene, *arguments, "--resume", "--denoise") == 0


def test_without_the_denoiser(scene, tmp_path, capfd, monkeypatch):
    """One line, before anything is rendered."""
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    assert render(scene, "-o", tmp_path / "a.exr", "--denoise") == cli.EXIT_USAGE
    message = capfd.readouterr().err
    assert "pip install 'mis-integrators[denoise]'" in message and message.count("\n") == 1
    assert not (tmp_path / "a.exr").exists()


@pytest.mark.parametrize("flag", ["--all-views", "--frames"])
def test_views_are_not_denoised(scene, capfd, flag):
    with pytest.raises(SystemExit) as exit:
        render(scene, "--denoise", flag)
    assert exit.value.code == cli.EXIT_USAGE
    assert f"not allowed with argument {flag}" in capfd.readouterr().err


def test_a_film_without_colours(scene, tmp_path, capfd):
    """One line, before anything is rendered."""
    text = scene.read_text()
    start, end = text.index("<film "), text.index("</film>") + len("</film>")
    bands = (
        '<film type="specfilm"><integer name="width" value="8"/><integer name="height" value="8"/>'
        '<spectrum name="band" value="400:1, 500:1"/></film>'
    )
    scene.write_text(text[:start] + bands + text[end:])
    spectral = "--variant", "llvm_ad_spectral"
    assert render(scene, *spectral, "-o", tmp_path / "a.exr", "--denoise") == cli.EXIT_SCENE
    message = capfd.readouterr().err
    assert "--denoise: the film has no colours" in message and message.count("\n") == 1
    assert not (tmp_path / "a.exr").exists()
    assert render(scene, *spectral, "-o", tmp_path / "a.exr") == 0
