"""``--denoise``, `mis_integrators.denoise`, and what denoisers are told of a picture."""

import sys

import mis_integrators
from mis_integrators.app import cli
from mis_integrators.paths.guides import albedo_and_normal

import lamplit
import mitsuba as mi
import numpy as np
import pytest
from lamplit import read, same, write_scene

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


def test_broken_pixels_and_black_ones(rgb):
    image = np.zeros((16, 16, 3), np.float32)
    image[3, 3], image[5, 5], image[7, 7] = np.nan, np.inf, -1
    np.testing.assert_allclose(mis_integrators.denoise(image), 0, atol=0.01)


def test_images_of_other_shapes_are_refused(rgb):
    with pytest.raises(ValueError, match=r"not \(3,\)"):
        mis_integrators.denoise(np.zeros(3))
    with pytest.raises(ValueError, match=r"3 x 5 pixels, the sensor's film 6 x 4"):
        mis_integrators.denoise(np.zeros((5, 3, 3)), painted_wall())


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


def test_like_denoises_again(scene, tmp_path):
    assert render(scene, "-o", tmp_path / "a.exr", "--denoise") == 0
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
