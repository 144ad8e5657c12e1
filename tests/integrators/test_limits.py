"""Films without pixels, crops of huge films, numbers beyond all measure: one clear error, or the
render that was asked for; no traceback."""

from mis_integrators import _plugins
from mis_integrators.app import cli
from mis_integrators.core.traits import UnsupportedScene
from mis_integrators.paths.camera import film_sample_count

import mitsuba as mi
import numpy as np
import pytest
from selection import extended

MOST_LIGHT_PATHS = 2**28
"""As parameters have it."""
EMPTY_FILMS = [
    {"width": 0, "height": 0},
    {"width": 8, "height": 0},
    {"width": 8, "height": 8, "crop_width": 0, "crop_height": 4},
]
MANY_DIGITS = ["1" + 400 * "0", "-1" + 400 * "0", "1" + 5000 * "0"]


def scene_of(**film):
    """A ball under a bright sky, on such a film."""
    return mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere"},
            "lamp": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "film": {"type": "hdrfilm", "rfilter": {"type": "box"}, **film},
            },
        }
    )


@pytest.fixture
def scene_file(tmp_path, rgb):
    """Writes that scene into a file, on such a film, and returns the file."""

    def write(**film):
        size = "".join(f'<integer name="{name}" value="{value}"/>' for name, value in film.items())
        file = tmp_path / "scene.xml"
        file.write_text(
            '<scene version="3.0.0"><integrator type="path"/>'
            f'<sensor type="perspective"><film type="hdrfilm">{size}</film></sensor>'
            '<shape type="sphere"/><emitter type="constant"/></scene>'
        )
        return file

    return write


# --- Films --------------------------------------------------------------------


@pytest.mark.parametrize("film", EMPTY_FILMS, ids=str)
@pytest.mark.parametrize("plugin", _plugins.PLUGINS)
def test_film_without_pixels_is_refused(rgb, plugin, film):
    integrator = mi.load_dict({"type": plugin})
    sessions = [integrator.session] + (
        [integrator.views_session] if plugin == "volpath_multiview" else []
    )
    for session in sessions:
        with pytest.raises(
            UnsupportedScene, match=f"^{plugin}: .*width and height must be at least 1"
        ):
            session(scene_of(**film), spp=4)


@pytest.mark.parametrize("film", EMPTY_FILMS, ids=str)
@pytest.mark.parametrize("plugin", ["path", "bdpt"])
def test_command_refuses_a_film_without_pixels(scene_file, capsys, plugin, film):
    file = scene_file(**film)
    assert cli.main([str(file), "-i", plugin]) == 1
    error = capsys.readouterr().err
    assert (
        error.startswith(f"mis-render: {plugin}: ")
        and "at least 1" in error
        and error.count("\n") == 1
    )
    assert not file.with_suffix(".exr").exists()


@pytest.mark.parametrize("plugin", _plugins.PLUGINS)
def test_crop_of_a_huge_film(rgb, plugin):
    """What counts is what is rendered: the crop window, not the film."""
    cropped = {
        "width": 70000,
        "height": 70000,
        "crop_width": 8,
        "crop_height": 6,
        "crop_offset_x": 35000,
        "crop_offset_y": 35000,
    }
    session = mi.load_dict({"type": plugin, "max_depth": 2}).session(scene_of(**cropped), spp=4)
    session.iterate()
    assert session.image().shape[:2] == (6, 8)


@pytest.mark.parametrize(
    "plugin", [plugin for plugin in _plugins.PLUGINS if plugin != "volpath_multiview"]
)
def test_more_pixels_than_can_be_numbered(rgb, plugin):
    with pytest.raises(
        ValueError, match=f'^{plugin}: parameter "camera_paths" .* on 4900000000 pixels'
    ):
        mi.load_dict({"type": plugin}).session(scene_of(width=70000, height=70000), spp=4)


@pytest.mark.parametrize("plugin", ["bdpm", "bdpm_opt2", "bdpm_balance"])
def test_light_paths_are_bounded_by_default(rgb, plugin):
    """On a film of more pixels than a parameter could ask for."""
    scene = scene_of(width=20000, height=20000)
    assert film_sample_count(scene.sensors()[0]) > MOST_LIGHT_PATHS
    assert mi.load_dict({"type": plugin}).session(scene, spp=4).light_path_count == MOST_LIGHT_PATHS


@pytest.mark.parametrize("plugin", ["bdpt", "vcm", "bdpt_ris", "pcbpt"])
def test_light_paths_of_a_part_are_bounded(rgb, plugin):
    """Those that are traced at once, where a single pixel has more camera paths than a parameter
    could ask for."""
    integrator = mi.load_dict({"type": plugin, "camera_paths": 2 * MOST_LIGHT_PATHS})
    assert (
        integrator.session(scene_of(width=1, height=1), spp=2 * MOST_LIGHT_PATHS).light_chunk
        <= MOST_LIGHT_PATHS
    )


# --- Numbers ------------------------------------------------------------------


@pytest.mark.parametrize(
    "value",
    [*MANY_DIGITS, "1e400", "nan", "inf", "", "0x10", "1" + 100 * "x"],
    ids=lambda value: value[:6],
)
@pytest.mark.parametrize("option", ["--spp", "--seed", "--sensor", "--workers"])
def test_huge_integers_are_wrong_usage(scene_file, capsys, option, value):
    with pytest.raises(SystemExit) as exit:
        cli.main([str(scene_file(width=8, height=6)), f"{option}={value}"])
    said = capsys.readouterr().err.splitlines()[-1]
    assert (
        exit.value.code == 2
        and said.startswith(f"mis-render: error: argument {option}: ")
        and len(said) < 400
        and "is not an integer from" in said
    )


@pytest.mark.parametrize(
    "value",
    [*MANY_DIGITS, "1e400", "-1e400", "nan", "inf", "0", "-0.0", "1e-400"],
    ids=lambda value: value[:6],
)
@pytest.mark.parametrize("option", ["--time", "--target-error", "--checkpoint", "--preview"])
def test_numbers_without_measure_are_wrong_usage(scene_file, capsys, option, value):
    with pytest.raises(SystemExit) as exit:
        cli.main([str(scene_file(width=8, height=6)), f"{option}={value}"])
    said = capsys.readouterr().err.splitlines()[-1]
    assert (
        exit.value.code == 2
        and said.startswith(f"mis-render: error: argument {option}: ")
        and len(said) < 400
        and "is not a finite number" in said
    )


@pytest.mark.parametrize(
    "value",
    [*MANY_DIGITS, "9223372036854775808", "4294967296", "1e400", "nan"],
    ids=lambda value: value[:6],
)
@pytest.mark.parametrize(
    "plugin, parameter",
    [
        ("path", "max_depth"),
        ("bdpt", "max_depth"),
        ("bdpt", "camera_paths"),
        ("bdpt", "beta"),
        ("path", "nope"),
    ],
)
def test_plugins_refuse_huge_parameters(scene_file, capsys, plugin, parameter, value):
    assert (
        cli.main([str(scene_file(width=8, height=6)), "-i", plugin, "-P", f"{parameter}={value}"])
        == 1
    )
    error = capsys.readouterr().err
    assert error.startswith("mis-render: ") and error.count("\n") == 1 and f'"{parameter}"' in error


def test_huge_number_that_fits_a_float(rgb):
    """Integers beyond Mitsuba's become floats, which some parameters are."""
    from mis_integrators.app import loading

    assert (
        loading.parse_value("1" + 20 * "0") == 1e20
        and type(loading.parse_value("1" + 20 * "0")) is float
    )
    assert loading.parse_value(str(2**63 - 1)) == 2**63 - 1


# --- Scenes with nothing to gather at -----------------------------------------

MIRROR = {"ball": {"type": "sphere", "bsdf": {"type": "conductor", "material": "none"}}}


@pytest.mark.parametrize("shapes", [MIRROR, *extended({})], ids=["a mirror", "none"])
@pytest.mark.parametrize("plugin", _plugins.PLUGINS)
def test_scene_without_smooth_surfaces(rgb, plugin, shapes):
    """A sky of one radiance, and nothing else but perhaps a perfect mirror: every pixel has it."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.25, 0.5, 2]}},
            "integrator": {"type": plugin, "max_depth": 4},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}},
            },
            **shapes,
        }
    )
    image = np.array(mi.render(scene, spp=4))[..., :3]
    np.testing.assert_allclose(image, np.broadcast_to([0.25, 0.5, 2], (6, 8, 3)), rtol=1e-4)
