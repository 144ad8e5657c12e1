"""``--compare``: two renders of equal time side by side, judged against a reference."""

import re
import signal
import sys

from mis_integrators.app import cli, compare, output
from mis_integrators.core.session import MitsubaSession

import lamplit
import mitsuba as mi
import numpy as np
import pytest
from lamplit import write_scene
from selection import extended

pytest.importorskip("matplotlib")

NAMES = "R", "G", "B"


@pytest.fixture
def scene(tmp_path, rgb):
    return write_scene(tmp_path)


def render(scene, *arguments):
    return lamplit.render(scene, "-i", "bdpm", "-o", scene.with_name("a.exr"), *arguments)


def png(path):
    return np.array(mi.Bitmap(str(path)))[..., :3]


def flat(value, shape=(30, 60)):
    return np.full((*shape, 3), value, np.float32)


def test_equal_time_and_both_images(scene, capfd, monkeypatch):
    """With samples given the second one gets the first one's time; with a time both get it."""
    seen, original = [], cli._render

    def spy(session, sensor, options, identity, clock, *rest):
        found = original(session, sensor, options, identity, clock, *rest)
        seen.append((options.time, options.spp, clock.rendering))
        return found

    monkeypatch.setattr(cli, "_render", spy)
    assert render(scene, "--spp", 8, "-P", "bdd=0", "--compare", "path") == 0
    (_, samples, first), (asked, no_samples, second) = seen
    assert (samples, no_samples) == (8, None) and asked == first
    assert second >= 0.8 * first  # an iteration more would be late by more than its half
    said = capfd.readouterr().err.splitlines()
    one, other, where = said[-3:]  # before, progress: more of it where kernels are compiled
    assert one.startswith("bdpm bdd=0: 8 samples per pixel in ") and other.startswith("path: ")
    assert where == f"side by side: {scene.parent}/a.compare.png"
    # 24 pixels of width, enlarged 17 times, and the space between both images
    assert png(scene.with_name("a.compare.png")).shape[:2] == (408 + 60, 2 * 408 + 8)

    seen.clear()
    assert render(scene, "--time", 0.05, "--compare", "path", "--quiet") == 0
    assert [asked for asked, *_ in seen] == [0.05, 0.05]
    assert capfd.readouterr().err == ""


def test_limits_of_paths_hold_for_both(scene, monkeypatch):
    opened = []
    monkeypatch.setattr(compare.Rival, "rows", lambda self, *both: opened.extend(both) or [])
    monkeypatch.setattr(compare, "write_picture", lambda *_: None)
    arguments = "-P", "max_depth=2", "-P", "bdd=0", "--spp", 2
    assert render(scene, *arguments, "--compare", "bdpt", "--quiet") == 0
    assert [one.name for one in opened] == ["bdpm max_depth=2 bdd=0", "bdpt max_depth=2"]
    assert [one.opened.settings["max_depth"] for one in opened] == [2, 2]


def test_picture_has_one_exposure_and_labels(rgb, tmp_path):
    """Known radiance, by the sRGB curve as in the image's own PNG."""
    rows = [
        [compare.Entry("one", "", flat(0.25), ""), compare.Entry("two", "", flat(0.5), "")],
        [compare.Entry("three", "", flat(2), ""), compare.Entry("four", "", flat(0), "")],
    ]
    compare.write_picture(tmp_path / "a.png", rows, NAMES)
    found = png(tmp_path / "a.png")
    height, width = 30 * 7, 60 * 7  # the least factor that makes 400 pixels of 60
    assert found.shape[:2] == (2 * (height + 60), 2 * width + 8)
    for row, column, value in (0, 0, 137), (0, 1, 188), (1, 0, 255), (1, 1, 0):
        top, left = row * (height + 60) + 60, column * (width + 8)
        image = found[top : top + height, left : left + width]
        np.testing.assert_allclose(image.astype(int), value, atol=1)
        label = found[top - 60 : top, left : left + width]
        assert label.min() < 60 and np.median(label) == 255
    assert np.all(found[60 : 60 + height, width : width + 8] == 255)


def test_labels_grow_with_wide_images(rgb, tmp_path):
    """Twice as wide as the narrowest that is not enlarged: labels and letters are twice as high."""
    heights = []
    for width in 400, 800:
        rows = [[compare.Entry("one", "", flat(0.5, (50, width)), "")] * 2]
        compare.write_picture(tmp_path / "a.png", rows, NAMES)
        found = png(tmp_path / "a.png")
        label = 60 * width // 400
        assert found.shape[:2] == (50 + label, 2 * width + 8 * width // 400)
        heights.append(np.ptp(np.nonzero(found[:label].min(axis=(1, 2)) < 128)[0]))
    assert heights[1] == pytest.approx(2 * heights[0], abs=3)


def test_errors_are_those_of_the_metrics(rgb):
    pytest.importorskip("flip_evaluator")
    words = compare.quality(flat(0.6), flat(0.5))
    assert words.startswith(f"relMSE {0.01 / 0.26:.3g}, MSE 0.01, FLIP 0.")
    assert compare.quality(flat(0.5)[..., :1], flat(0.5)[..., :1]) == "relMSE 0, MSE 0, FLIP 0"
    assert compare.quality(flat(0.5), None) == ""


def test_errors_without_flip(rgb, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert compare.quality(flat(0.5), flat(0.5)) == "relMSE 0, MSE 0"


@pytest.mark.parametrize("variant_name", ["llvm_ad_rgb", *extended("llvm_ad_mono")])
def test_reference(scene, tmp_path, capfd, variant_name):
    """The image itself as reference: it has no error, and the other one has."""
    reference = tmp_path / "reference.exr"
    common = "--spp", 8, "--variant", variant_name
    assert lamplit.render(scene, "-i", "bdpm", "-o", reference, *common) == 0
    capfd.readouterr()
    assert render(scene, *common, "--compare", "path", "--reference", reference) == 0
    said = capfd.readouterr().err
    first, second = re.findall(r"^\w+: .* s, relMSE ([\d.e-]+), MSE ([\d.e-]+)", said, re.M)
    # The same up to the order of sums.
    assert all(float(value) < 1e-6 for value in first)
    assert all(float(value) > 1e-6 for value in second)


def test_denoised_ones_have_a_row_of_their_own(scene, tmp_path, capfd):
    pytest.importorskip("mitsuba_oidn")
    reference = tmp_path / "reference.exr"
    assert lamplit.render(scene, "-i", "path", "--spp", 256, "-o", reference, "--denoise") == 0
    capfd.readouterr()
    arguments = "--spp", 4, "--compare", "path", "--reference", reference, "--denoise"
    assert render(scene, *arguments) == 0
    said = capfd.readouterr().err
    assert len(re.findall(r"^(bdpm|path)(, denoised)?: .*relMSE .*, MSE ", said, re.M)) == 4
    assert png(tmp_path / "a.compare.png").shape[0] == 2 * (408 + 60)


def test_nothing_is_said_of_denoised_ones_without_a_reference(scene, capfd):
    pytest.importorskip("mitsuba_oidn")
    assert render(scene, "--spp", 1, "--compare", "path", "--denoise") == 0
    said = capfd.readouterr().err
    assert "path: " in said and "denoised: " not in said


# --- What is refused -----------------------------------------------------------------------------


@pytest.fixture
def references(scene, tmp_path):
    image = np.full((24, 24, 3), 0.5, np.float32)
    output.write_exr(tmp_path / "small.exr", image[:12], NAMES, {})
    output.write_exr(tmp_path / "grey.exr", image[..., :1], "Y", {})
    image[3, 3] = np.nan
    output.write_exr(tmp_path / "nan.exr", image, NAMES, {})
    (tmp_path / "cut.exr").write_bytes((tmp_path / "nan.exr").read_bytes()[:200])
    (tmp_path / "text.exr").write_text("no image")
    return tmp_path


@pytest.mark.parametrize(
    "name, message",
    [
        ("none.exr", "--reference {}: No such file or directory"),
        ("text.exr", "--reference {}: it is not an EXR file"),
        ("cut.exr", "--reference {}: "),
        ("small.exr", "--reference {} has 24 x 12 pixels, the image 24 x 24"),
        ("grey.exr", "--reference {} has no channel R, G, B, which the image has"),
        ("nan.exr", "--reference {} has values that are not finite"),
    ],
)
def test_references_that_are_refused(scene, references, capfd, name, message):
    """In one line, before anything is rendered."""
    path = references / name
    found = render(scene, "--spp", 4, "--compare", "path", "--reference", path)
    said = capfd.readouterr().err
    assert found == cli.EXIT_SCENE and said.count("\n") == 1, said
    assert said.startswith("mis-render: " + message.format(path))
    assert not (references / "a.exr").exists()


@pytest.mark.parametrize(
    "plugin, message",
    [
        ("nonsense", 'Plugin "nonsense" not found'),
        ("../evil", "is not the name of a plugin"),
        ("bdpm", "that is what the image is rendered with already"),
    ],
)
def test_integrators_that_are_refused(scene, tmp_path, capfd, plugin, message):
    assert render(scene, "--spp", 4, "--compare", plugin) == cli.EXIT_SCENE
    said = capfd.readouterr().err
    assert said.startswith(f"mis-render: --compare {plugin}: ") and message in said
    assert said.count("\n") == 1 and not (tmp_path / "a.exr").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("--compare", "path", "--all-views"),
        ("--compare", "path", "--frames"),
        ("--compare", "path", "--resume"),
        ("--compare", "path", "--checkpoint", 60),
        ("--compare", "path", "--preview", 60),
        ("--compare", "path", "--workers", 2),
        ("--compare", "path", "--scheduler", "tcp://nowhere:1"),
        ("--reference", "a.exr"),
    ],
)
def test_options_of_one_render_are_refused(scene, capfd, arguments):
    with pytest.raises(SystemExit) as exit:
        render(scene, *arguments)
    assert exit.value.code == cli.EXIT_USAGE
    said = capfd.readouterr().err.splitlines()[-1]
    assert "argument --compare" in said and arguments[2 if len(arguments) > 2 else 0] in said


def test_without_matplotlib(scene, tmp_path, capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert render(scene, "--spp", 4, "--compare", "path") == cli.EXIT_USAGE
    said = capfd.readouterr().err
    assert "pip install 'mis-integrators[bench]'" in said and said.count("\n") == 1
    assert not (tmp_path / "a.exr").exists()


# --- What goes wrong after the first image -------------------------------------------------------


def complaints(capfd):
    """Lines of `mis-render`, besides those of progress, of which a busy machine has more."""
    said = capfd.readouterr().err.splitlines()
    return [line for line in said if line.startswith("mis-render:")]


def test_interrupt_of_the_second_render(scene, tmp_path, capfd, monkeypatch):
    """Before there is anything of it: the first image is there, and one line says so."""

    def interrupted(*_):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(MitsubaSession, "iterate", interrupted)
    assert render(scene, "--spp", 4, "--compare", "path") == 130
    expected = f"interrupted, not compared; {tmp_path / 'a.exr'} is written"
    assert complaints(capfd) == [f"mis-render: {expected}"]
    assert (tmp_path / "a.png").exists() and not (tmp_path / "a.compare.png").exists()


def test_later_interrupt_of_the_second_render(scene, tmp_path, capfd, monkeypatch):
    """What there is of it is shown, and one line says that it had less time."""
    original, render_first = MitsubaSession.iterate, cli._render

    def slow(*arguments):
        found = render_first(*arguments)
        arguments[4].rendering += 100  # so long the second one would take
        return found

    def interrupted(session, *rest):
        original(session, *rest)
        if session.iterations == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(cli, "_render", slow)
    monkeypatch.setattr(MitsubaSession, "iterate", interrupted)
    assert render(scene, "--spp", 4, "--compare", "path") == 130
    said = capfd.readouterr().err.splitlines()
    assert said[-1] == "mis-render: interrupted: path had less time"
    assert (tmp_path / "a.compare.png").exists()


def test_error_of_the_second_render(scene, tmp_path, capfd, monkeypatch):
    def broken(*_):
        raise RuntimeError("no more light")

    monkeypatch.setattr(MitsubaSession, "iterate", broken)
    assert render(scene, "--spp", 4, "--compare", "path") == cli.EXIT_SCENE
    expected = f"--compare path: no more light; {tmp_path / 'a.exr'} is written"
    assert complaints(capfd) == [f"mis-render: {expected}"]


def test_picture_that_cannot_be_written(scene, tmp_path, capfd):
    """Is found before anything is rendered."""
    (tmp_path / "a.compare.png").mkdir()
    assert render(scene, "--spp", 4, "--compare", "path") == cli.EXIT_OUTPUT
    said = capfd.readouterr().err
    assert said.startswith(f"mis-render: cannot write {tmp_path / 'a.compare.png'}")
    assert not (tmp_path / "a.exr").exists()
