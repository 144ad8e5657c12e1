"""The command ``mis-render``, with Mitsuba's own integrators and with fake sessions."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from mis_integrators.app import cli, loading, output
from mis_integrators.core.session import MitsubaSession

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

SCENE = """<scene version="3.0.0">
  <default name="spp" value="10"/>
  <default name="integrator" value="path"/>
  <integrator type="$integrator"><integer name="max_depth" value="3"/></integrator>
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="5"/><integer name="height" value="6"/></film>
  </sensor>
  <emitter type="constant"><rgb name="radiance" value="0.25, 0.5, 2"/></emitter>
</scene>"""


@pytest.fixture
def scene(tmp_path, rgb) -> Path:
    """A scene of which every pixel has the radiance (0.25, 0.5, 2)."""
    file = tmp_path / "scene.xml"
    file.write_text(SCENE)
    return file


def render(scene: Path, *arguments) -> int:
    return cli.main([str(scene), *map(str, arguments)])


def read(file: Path) -> tuple[dict, dict[str, np.ndarray]]:
    exr = OpenEXR.File(str(file), separate_channels=True)
    return exr.header(), {name: channel.pixels for name, channel in exr.channels().items()}


class FakeSession:
    """Iteration k adds an image of the value k, so that the mean after n of them is (n + 1) / 2."""

    iterations_planned = 5
    camera_paths = 2
    channels = ["R", "G", "B", "var.R"]
    settings, learned = {"initial_radius": 0.5}, {}

    def __init__(self, seconds=0.0, on_iteration=lambda iterations: None):
        self.iterations, self.planned_seconds = 0, None
        self._seconds, self._on_iteration = seconds, on_iteration

    def plan_time(self, seconds):
        assert self.iterations == 0
        self.planned_seconds = seconds

    def iterate(self):
        time.sleep(self._seconds)
        self._on_iteration(self.iterations)
        self.iterations += 1

    def image(self):
        return np.full((8, 12, 4), (self.iterations + 1) / 2, np.float32)

    def unfinite_pixels(self):
        return 0


@pytest.fixture
def use(monkeypatch):
    """Makes the command use a session of the test's own."""

    def use(session):
        monkeypatch.setattr("mis_integrators.app.request.make_session", lambda *_: session)
        return session

    return use


# --- What is written ----------------------------------------------------------


def test_image_metadata_and_preview(scene, tmp_path):
    assert render(scene, "-o", tmp_path / "new" / "a.exr", "--seed", 7, "-D", "spp=6") == 0
    header, channels = read(tmp_path / "new" / "a.exr")
    assert set(channels) == {"R", "G", "B"}
    for name, value in {"R": 0.25, "G": 0.5, "B": 2}.items():
        assert channels[name].shape == (8, 12) and channels[name].dtype == np.float32
        np.testing.assert_allclose(channels[name], value, rtol=1e-5)
    expected = {"integrator": "path", "max_depth": 3, "spp": 6, "seed": 7, "variant": "llvm_ad_rgb"}
    assert {name: header[name] for name in expected} == expected
    assert mi.__version__ in header["versions"] and header["renderTime"] > 0
    preview = np.array(mi.Bitmap(str(tmp_path / "new" / "a.png")))
    assert preview.shape == (8, 12, 3) and preview.dtype == np.uint8
    # the sRGB curve at 0.25, 0.5 and 1
    np.testing.assert_allclose(preview[0, 0], [137, 188, 255], atol=1)
    assert sorted(file.name for file in (tmp_path / "new").iterdir()) == ["a.exr", "a.png"]


def test_default_output_is_beside_the_scene(scene):
    assert render(scene, "--spp", 1) == 0
    assert scene.with_suffix(".exr").exists() and scene.with_suffix(".png").exists()


def test_channels_and_settings_of_a_session_are_written(scene, tmp_path, use):
    use(FakeSession())
    assert render(scene, "-o", tmp_path / "a.exr") == 0
    header, channels = read(tmp_path / "a.exr")
    assert set(channels) == {"R", "G", "B", "var.R"}
    np.testing.assert_array_equal(channels["var.R"], 3)
    assert header["initial_radius"] == 0.5 and header["spp"] == 10 and header["iterations"] == 5


def test_aovs_keep_their_names(scene, tmp_path):
    scene.write_text(
        SCENE.replace(
            '<integrator type="$integrator">',
            """<integrator type="aov">
        <string name="aovs" value="dd.y:depth"/><integrator type="$integrator">""",
        ).replace("</integrator>", "</integrator></integrator>")
    )
    assert render(scene, "-o", tmp_path / "a.exr") == 0
    channels = read(tmp_path / "a.exr")[1]
    assert {"R", "G", "B", "dd.y.T"} < set(channels)
    np.testing.assert_allclose(channels["B"], 2, rtol=1e-5)
    np.testing.assert_array_equal(channels["dd.y.T"], 0)


def test_bdpm_with_variance(scene, tmp_path):
    assert (
        render(scene, "-i", "bdpm", "-P", "variance=true", "--spp", 2, "-o", tmp_path / "a.exr")
        == 0
    )
    header, channels = read(tmp_path / "a.exr")
    assert set(channels) == {"R", "G", "B", "var.R", "var.G", "var.B"}
    np.testing.assert_allclose(channels["B"], 2, rtol=1e-4)
    assert header["integrator"] == "bdpm" and header["max_depth"] == 3 and header["spp"] == 2


def test_variance_of_a_short_render(scene, tmp_path):
    """An image that shows its variance needs a second iteration, whatever the time says; nor is
    there a preview before."""
    arguments = (
        "-i",
        "bdpt",
        "-P",
        "variance=true",
        "-P",
        "max_depth=2",
        "--time",
        "1e-6",
        "--preview",
        "1e-6",
        "-o",
        tmp_path / "a.exr",
    )
    assert render(scene, *arguments) == 0
    header, channels = read(tmp_path / "a.exr")
    assert header["iterations"] == 2 and np.isfinite(channels["var.R"]).all()


def test_interrupt_waits_for_an_image_that_shows_its_variance(scene, tmp_path, use):
    session = use(
        FakeSession(
            on_iteration=lambda number: signal.raise_signal(signal.SIGINT) if number == 1 else None
        )
    )
    session.fewest_iterations = 3
    assert render(scene, "-o", tmp_path / "a.exr") == 130
    assert read(tmp_path / "a.exr")[0]["iterations"] == 3


def test_largest_seed_is_kept_with_the_image(scene, tmp_path):
    assert render(scene, "-o", tmp_path / "a.exr", "--seed", 2**32 - 1, "--spp", 1) == 0
    assert int(read(tmp_path / "a.exr")[0]["seed"]) == 2**32 - 1


def test_failed_write_leaves_the_old_file(tmp_path):
    file = tmp_path / "a.exr"
    output.write_exr(file, np.ones((2, 3, 1)), ["Y"], {})
    with pytest.raises(Exception, match="object"):
        output.write_exr(file, np.zeros((2, 3, 1)), ["Y"], {"name": object()})
    np.testing.assert_array_equal(read(file)[1]["Y"], 1)
    assert list(tmp_path.iterdir()) == [file]


def test_preview_of_luminance_and_of_spectral_bands(tmp_path, rgb):
    image = np.array([[[0.5], [np.nan]]], np.float32)
    assert output.write_png(tmp_path / "y.png", image, ["Y"])
    np.testing.assert_allclose(
        np.array(mi.Bitmap(str(tmp_path / "y.png"))).ravel(), [188, 0], atol=1
    )
    assert not output.write_png(tmp_path / "bands.png", image, ["S400"])


# --- Which integrator, which sensor -------------------------------------------


@pytest.mark.parametrize(
    "plugin, kept",
    [
        ("volpath", {"max_depth": 3, "rr_depth": 7, "hide_emitters": True}),
        ("direct", {"hide_emitters": True}),
        ("aov", {"aovs": "d:depth", "hide_emitters": True}),
    ],
)
def test_replaced_integrator_hands_on_what_the_new_one_knows(scene, plugin, kept):
    scene.write_text(
        SCENE.replace(
            'value="3"/></integrator>',
            'value="3"/><integer name="rr_depth" value="7"/>'
            '<boolean name="hide_emitters" value="true"/></integrator>',
        )
    )
    loaded = loading.load(scene, {}, plugin, {"aovs": "d:depth"} if plugin == "aov" else {})
    assert loaded.plugin == plugin and loaded.parameters == kept


def test_integrator_inside_a_replaced_one_hands_on_too(scene):
    scene.write_text(
        SCENE.replace(
            '<integrator type="$integrator">',
            '<integrator type="moment"><integrator type="$integrator">',
        ).replace("</integrator>", "</integrator></integrator>")
    )
    assert loading.load(scene, {}, "ptracer", {}).parameters == {"max_depth": 3}


def test_replaced_integrator_is_never_built(scene):
    assert loading.load(scene, {"integrator": "no_such_plugin"}, "path", {}).plugin == "path"


def test_scene_without_integrator_gets_one(scene):
    scene.write_text(
        SCENE.replace(
            '<integrator type="$integrator"><integer name="max_depth" value="3"/></integrator>', ""
        ).replace('<default name="integrator" value="path"/>', "")
    )
    loaded = loading.load(scene, {}, None, {"max_depth": 4})
    assert "max_depth = 4" in str(loaded.integrator)


def test_parameters_reach_the_integrator(scene):
    loaded = loading.load(scene, {}, None, {"max_depth": 5, "hide_emitters": True})
    assert loaded.parameters == {"max_depth": 5, "hide_emitters": True}
    assert "max_depth = 5" in str(loaded.integrator)


@pytest.mark.parametrize(
    "text, value",
    [
        ("3", 3),
        ("-1", -1),
        ("0.5", 0.5),
        ("1e-3", 1e-3),
        ("true", True),
        ("False", False),
        ("full", "full"),
    ],
)
def test_parameter_types(text, value):
    assert loading.parse_value(text) == value and type(loading.parse_value(text)) is type(value)


def test_sensor_is_chosen(scene, tmp_path):
    assert render(scene, "-o", tmp_path / "a.exr", "--sensor", 1, "--spp", 1) == 0
    assert read(tmp_path / "a.exr")[1]["R"].shape == (6, 5)


# --- How much is rendered -----------------------------------------------------


def test_passes_are_independent_and_add_up(scene, monkeypatch):
    monkeypatch.setattr("mis_integrators.core.session.PATHS_PER_PASS", 12 * 8 * 4)
    loaded = mi.load_file(str(scene))
    noisy = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "point"},
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, 3]).rotate([0, 1, 0], 180),
            },
        }
    )
    sensor = mi.load_dict(
        {"type": "perspective", "film": {"type": "hdrfilm", "width": 12, "height": 8}}
    )
    integrator = mi.load_dict({"type": "ptracer"})
    session = MitsubaSession(loaded.integrator(), loaded, loaded.sensors()[0], seed=0, spp=10)
    assert (session.iterations_planned, session.camera_paths) == (3, 4)
    first, again, other = (
        MitsubaSession(integrator, noisy, sensor, seed=seed, spp=8) for seed in (0, 0, 1)
    )
    for each in (first, again, other):
        each.iterate()
    single = first.image()
    np.testing.assert_allclose(single, again.image(), rtol=1e-4, atol=1e-6)
    assert not np.allclose(single, other.image(), rtol=1e-2)
    first.iterate()
    assert not np.allclose(single, first.image(), rtol=1e-2)
    second = MitsubaSession(integrator, noisy, sensor, seed=0, spp=8)
    second.iterate(1)
    assert single.mean() > 0
    np.testing.assert_allclose(first.image(), (single + second.image()) / 2, rtol=1e-4, atol=1e-6)


def test_sampler_that_rounds_up(rgb):
    """A stratified sampler knows only squares: 10 samples become 16."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "sampler": {"type": "stratified"},
                "film": {"type": "hdrfilm", "width": 4, "height": 4},
            },
            "light": {"type": "constant"},
        }
    )
    session = MitsubaSession(
        mi.load_dict({"type": "path"}), scene, scene.sensors()[0], seed=0, spp=10
    )
    assert (session.iterations_planned, session.camera_paths) == (1, 16)
    session.iterate()
    np.testing.assert_allclose(session.image(), 1, rtol=1e-5)


def test_time_limit(scene, tmp_path, use):
    session = use(FakeSession(seconds=0.02))
    assert render(scene, "-o", tmp_path / "a.exr", "--time", 0.3) == 0
    assert session.planned_seconds == 0.3 and 5 < session.iterations <= 15
    header, _ = read(tmp_path / "a.exr")
    half = 0.5 * header["renderTime"] / (session.iterations + 1)  # of an iteration: more must fit
    assert 0.3 - half <= header["renderTime"] < 0.5


def test_time_limit_renders_at_least_once(scene, tmp_path, use):
    session = use(FakeSession(seconds=0.02))
    assert render(scene, "-o", tmp_path / "a.exr", "--time", 1e-6) == 0
    assert session.iterations == 1


def test_rounding_up_is_said_once(scene, tmp_path, use, capsys):
    use(FakeSession())
    assert render(scene, "-o", tmp_path / "a.exr", "--spp", 9) == 0
    assert capsys.readouterr().err.count("rounded up to 10") == 1


@pytest.mark.parametrize("quiet", [False, True])
def test_rounding_up_of_an_integrator_is_said_once(scene, tmp_path, capfd, quiet):
    arguments = (
        "-i",
        "bdpt",
        "-P",
        "max_depth=1",
        "-P",
        "camera_paths=3",
        "-o",
        tmp_path / "a.exr",
        *["--quiet"] * quiet,
    )
    assert render(scene, *arguments) == 0
    assert sum(text.count("rounded up") for text in capfd.readouterr()) == (0 if quiet else 1)


def test_progress_in_lines_and_quiet(scene, tmp_path, use, capsys, monkeypatch):
    monkeypatch.setattr("mis_integrators.app.progress.SECONDS_BETWEEN_LINES", 0.0)
    use(FakeSession())
    assert render(scene, "-o", tmp_path / "a.exr") == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 6 and all(
        "iteration" in line and "samples/s" in line for line in lines[:5]
    )
    use(FakeSession())
    assert render(scene, "-o", tmp_path / "a.exr", "--quiet") == 0
    assert capsys.readouterr() == ("", "")


def test_remarks_are_said_once(scene, tmp_path, use, capsys):
    remarks = ["one: [of] two", "another that is long " + 20 * "and longer "]
    use(FakeSession()).remarks = remarks
    assert render(scene, "-o", tmp_path / "a.exr") == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == remarks and len(lines) == 3


def test_why_bdpm_auto_chose_is_said(scene, tmp_path, capsys):
    arguments = "-i", "bdpm_auto", "-P", "max_depth=2", "-o", tmp_path / "a.exr"
    assert render(scene, *arguments) == 0
    said = [
        line.partition(": ")[2]
        for line in capsys.readouterr().err.splitlines()
        if line.startswith("bdpm_auto: ")
    ]
    header, _ = read(tmp_path / "a.exr")
    assert (
        said == [header[name] for name in sorted(header) if name.startswith("choice.because.")]
        and "needs no photons" in said[0]
    )
    assert render(scene, *arguments, "--quiet") == 0
    assert capsys.readouterr() == ("", "")


# --- Errors -------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["-D", "nope=1"], "nope"),
        (["-D", "spp=many"], "many"),
        (["-P", "nope=1"], "nope"),
        (["-P", "max_depth=deep"], "max_depth"),
        (["-i", "no_such_plugin"], "no_such_plugin"),
        (["--sensor", "2"], "0 to 1"),
        (["-i", "bdpm", "-P", "nope=1"], "nope"),
        (["-i", "bdpm", "--variant", "scalar_rgb"], "llvm_ad_*"),
    ],
)
def test_error_in_scene_or_parameter_is_one_line(scene, tmp_path, capsys, arguments, message):
    assert render(scene, "-o", tmp_path / "a.exr", *arguments) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and "Traceback" not in error
    assert not (tmp_path / "a.exr").exists()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<scene",
        "<scene version='3.0.0'><shape type='obj'><string name='filename' value='none.obj'/>"
        "</shape></scene>",
        "<scene version='3.0.0'/>",
        "<bsdf version='3.0.0' type='diffuse'/>",
    ],
)
def test_broken_scene_is_one_line(scene, capsys, text):
    scene.write_text(text)
    assert render(scene) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_missing_scene(tmp_path, capsys, rgb):
    assert render(tmp_path / "none.xml") == 1
    assert "none.xml" in capsys.readouterr().err


def test_error_of_a_python_plugin_loses_its_traceback(rgb):
    def broken(props):
        raise ValueError("broken: wings must be even,\n  not 3")

    mi.register_integrator("broken", broken)
    with pytest.raises(RuntimeError) as error:
        mi.load_string('<scene version="3.0.0"><integrator type="broken"/></scene>')
    message = loading.one_line(error.value)
    assert message.endswith('plugin of type "broken": broken: wings must be even, not 3')


def test_document_that_is_no_scene_is_called_so(scene, capsys):
    scene.write_text("<bsdf version='3.0.0' type='diffuse'/>")
    assert render(scene) == 1
    assert "is not a scene" in capsys.readouterr().err


def test_variant_without_its_gpu(scene, capsys, monkeypatch):
    def refuse(variant):
        raise ImportError("jit_init_thread_state(): the CUDA backend hasn't been initialized.")

    monkeypatch.setattr(mi, "set_variant", refuse)
    monkeypatch.setattr(dr, "has_backend", lambda backend: False)
    assert render(scene, "--variant", "cuda_ad_rgb") == 1
    error = capsys.readouterr().err
    assert "NVIDIA" in error and "llvm_ad_rgb" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--spp", "many"], "many is not an integer"),
        (["--seed", "x"], "x is not an integer"),
        (["--time", "long"], "long is not a number"),
        (["--all-views", "--sensor", "1"], "not allowed with"),
    ],
)
def test_wrong_usage_is_said_in_words(scene, capsys, arguments, message):
    with pytest.raises(SystemExit) as exit:
        render(scene, *arguments)
    assert exit.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("folder", [".", "..", ""])
def test_folder_instead_of_a_scene(folder, capsys):
    with pytest.raises(SystemExit) as exit:
        cli.main([folder])
    assert exit.value.code == 2 and "is a directory" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["--spp", "0"],
        ["--spp", "1", "--time", "1"],
        ["--time", "-1"],
        ["-D", "x"],
        ["-o", "a.png"],
        ["--variant", "llvm_ad_xyz"],
        ["--seed", "-1"],
        ["--nope"],
    ],
)
def test_wrong_usage(scene, arguments):
    with pytest.raises(SystemExit) as exit:
        render(scene, *arguments)
    assert exit.value.code == 2


def test_output_is_checked_before_rendering(scene, tmp_path, use, capsys):
    session = use(FakeSession())
    (tmp_path / "file").touch()
    assert render(scene, "-o", tmp_path / "file" / "a.exr") == 3
    (tmp_path / "a.exr").mkdir()
    assert render(scene, "-o", tmp_path / "a.exr") == 3
    (tmp_path / "b.png").mkdir()
    assert render(scene, "-o", tmp_path / "b.exr") == 3
    assert session.iterations == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and "b.png" in lines[-1]


def test_picture_that_cannot_be_written_is_named(scene, tmp_path, use, capsys):
    use(FakeSession(on_iteration=lambda number: None if number else (tmp_path / "a.png").mkdir()))
    assert render(scene, "-o", tmp_path / "a.exr") == 3
    error = capsys.readouterr().err
    assert "cannot write " + str(tmp_path / "a.png") in error and "a.exr is written" in error
    assert read(tmp_path / "a.exr")[0]["iterations"] == 5


# --- Ctrl-C -------------------------------------------------------------------


def test_interrupt_writes_what_there_is(scene, tmp_path, use, capsys):
    def interrupt(iterations):
        if iterations == 2:
            signal.raise_signal(signal.SIGINT)

    use(FakeSession(on_iteration=interrupt))
    assert render(scene, "-o", tmp_path / "a.exr") == 130
    header, channels = read(tmp_path / "a.exr")
    assert header["iterations"] == 3
    np.testing.assert_array_equal(channels["R"], 2)
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{tmp_path / 'a.exr'} and {tmp_path / 'a.png'}; only a render with --check" in said


def test_interrupt_says_how_to_go_on(scene, tmp_path, capsys, monkeypatch):
    """In the line that says what was saved; what it says works."""

    class Interrupted(MitsubaSession):
        def iterate(self, iteration=None):
            super().iterate(iteration)
            if self.iterations > 1:
                signal.raise_signal(signal.SIGINT)

    arguments = scene, "-o", tmp_path / "a.exr", "--target-error", 1e-6, "--spp", 64
    kept = tmp_path / "a.checkpoint"
    with monkeypatch.context() as patch:
        patch.setattr("mis_integrators.core.session.MitsubaSession", Interrupted)
        for resume, how in (
            (["--checkpoint", 99], "command with --resume"),
            (["--resume"], "command"),
        ):
            assert render(*arguments, *resume) == 130
            said = capsys.readouterr().err
            assert said.endswith(f"a.png; to go on from {kept}, give the same {how}\n")
    assert render(*arguments, "--resume") == 0


def test_second_interrupt_names_the_earlier_checkpoint(scene, tmp_path, capsys, monkeypatch):
    class Interrupted(MitsubaSession):
        def iterate(self, iteration=None):
            super().iterate(iteration)
            if self.iterations == 2:
                signal.raise_signal(signal.SIGINT)
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("mis_integrators.core.session.MitsubaSession", Interrupted)
    arguments = "--spp", 64, "--target-error", 1e-6, "--checkpoint", 1e-6
    assert render(scene, "-o", tmp_path / "a.exr", *arguments) == 130
    assert not (tmp_path / "a.exr").exists()
    assert capsys.readouterr().err == (
        f"mis-render: interrupted, nothing written; {tmp_path / 'a.checkpoint'} holds what was "
        "rendered earlier, for --resume\n"
    )


def test_second_interrupt_names_the_preview(scene, tmp_path, use, capsys):
    """One that this render has written, and no other."""

    def interrupt(iterations):
        if iterations == 2:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    preview = tmp_path / "a.preview.exr"
    arguments = "-o", tmp_path / "a.exr", "--quiet", "--preview"
    for seconds, left in (1e-6, f"only the preview {preview}"), (1e6, "nothing"):
        use(FakeSession(on_iteration=interrupt))
        assert render(scene, *arguments, seconds) == 130
        assert capsys.readouterr().err == f"mis-render: interrupted, {left} written\n"
        assert preview.exists() and not (tmp_path / "a.exr").exists()


def test_interrupt_before_the_first_iteration_writes_nothing(scene, tmp_path, use, capsys):
    use(FakeSession(on_iteration=lambda _: signal.raise_signal(signal.SIGINT)))
    assert render(scene, "-o", tmp_path / "a.exr") == 130
    assert not (tmp_path / "a.exr").exists()
    assert "nothing written" in capsys.readouterr().err


@pytest.mark.parametrize("error", [RuntimeError, SystemError])
def test_interrupt_that_a_library_turns_into_an_error(scene, tmp_path, use, capsys, error):
    """Dr.Jit's compiler, and constructors of Python plugins, do so while a scene is loaded."""

    def interrupt(_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise error("it could not be compiled") from None

    use(FakeSession(on_iteration=interrupt))
    assert render(scene, "-o", tmp_path / "a.exr") == 130
    assert capsys.readouterr().err == "mis-render: interrupted, nothing written\n"


def test_second_interrupt_stops_at_once(scene, tmp_path, use):
    def interrupt(iterations):
        if iterations == 1:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    use(FakeSession(on_iteration=interrupt))
    assert render(scene, "-o", tmp_path / "a.exr") == 130
    assert not (tmp_path / "a.exr").exists()


def test_interrupted_process(scene, tmp_path):
    """The whole command as a process of its own, and the signal from outside."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "mis_integrators.app.cli",
            scene,
            "-o",
            tmp_path / "a.exr",
            "--time",
            "100",
        ],
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(cli.__file__).parents[2],
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        # the first line of progress: an iteration is done
        assert "iteration" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 130
        assert "interrupted after" in process.stderr.read().splitlines()[-1]
    finally:
        process.kill()
    assert read(tmp_path / "a.exr")[0]["spp"] > 0


def test_help_documents_the_exit_codes(capsys):
    with pytest.raises(SystemExit) as exit:
        cli.main(["--help"])
    assert exit.value.code == 0
    text = capsys.readouterr().out
    codes = [value for name, value in vars(cli).items() if name.startswith("EXIT_")]
    assert len(codes) == 7 and all(f"\n  {code} " in text for code in codes)
