"""Renders that are stopped, killed, resumed, or run until they are good enough: nothing that was
rendered is lost, and nothing is summed twice."""

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

from mis_integrators.app import checkpoint, cli, fingerprint, loading, output
from mis_integrators.app import target_error as stopping
from mis_integrators.app.checkpoint import Checkpoint, CheckpointError
from mis_integrators.core.session import make_session
from mis_integrators.core.sums import Iterations, Sums

import mitsuba as mi
import numpy as np
import pytest
from lamplit import LAMP, ROOT, SCENE, command, read, render, run, same, write_scene
from pilots import learned
from selection import extended
from test_auto import set_price_of_path


@pytest.fixture
def scene(tmp_path, rgb) -> Path:
    return write_scene(tmp_path)


# --- Sums and iterations ------------------------------------------------------


def test_iterations_are_a_set():
    done = Iterations()
    for number in (0, 3, 1, 6):
        done.add(number)
    assert (len(done), done.below, done.first_missing, done.even()) == (4, 2, 2, 2)
    assert 3 in done and 2 not in done and Iterations(*done.as_json()) == done
    done.add(2)
    assert done.as_json() == [4, [6]] and done.even() == 3
    with pytest.raises(ValueError):
        done.add(3)
    with pytest.raises(ValueError):
        done.update(Iterations(0, (8, 6)))


def test_sums_keep_what_single_precision_would_lose(rgb):
    """A million iterations of value one and a third: float32 sums stop growing well before."""
    sums = Sums(mi.TensorXd)
    one = mi.TensorXf(np.full((1, 1, 1), 4 / 3, np.float32))
    sums.merge({"total": np.full((1, 1, 1), 2.0**25 * 4 / 3)}, Iterations(2**25))
    for number in range(100):
        sums.add("total", one)
        sums.done.add(2**25 + number)
    total = sums.arrays()["total"].item()
    assert total / len(sums.done) == pytest.approx(4 / 3, rel=1e-7)
    assert total - 2.0**25 * 4 / 3 == pytest.approx(100 * 4 / 3, rel=1e-4)


def test_sums_are_merged_once():
    sums = Sums()
    sums.merge({"total": np.ones((2, 2))}, Iterations(0, (1,)))
    sums.merge({"total": np.ones((2, 2))}, Iterations(1))
    np.testing.assert_array_equal(sums["total"], 2)
    for arrays, done in (
        ({"total": np.ones((2, 2))}, Iterations(1)),
        ({"total": np.ones((3, 2))}, Iterations(0, (5,))),
    ):
        with pytest.raises(ValueError):
            sums.merge(arrays, done)
    np.testing.assert_array_equal(sums["total"], 2)


# --- What a scene consists of -------------------------------------------------


@pytest.mark.parametrize("comment", ["<!-- one -->", "<!-- a -- b, value='none.ply' -->"])
def test_scene_that_only_mitsuba_takes_has_its_digests(tmp_path, rgb, comment):
    """Values too long for the name of a file, and comments that XML forbids but Mitsuba's parser
    does not."""
    spectrum = ", ".join(f"{wavelength}:0.5" for wavelength in range(400, 700, 2))
    (tmp_path / "it's & co.bmp").write_bytes(b"picture")
    (tmp_path / "none.ply").write_bytes(b"commented out")
    file = tmp_path / "scene.xml"
    file.write_text(f"""<scene version="3.0.0">{comment}<default name="picture" value="co"/>
        <bsdf type="diffuse"><spectrum name="reflectance" value="{spectrum}"/></bsdf>
        <bsdf type="diffuse"><texture type="bitmap" name="reflectance"
            ><string name = "filename" value='{tmp_path}/it&apos;s &amp; $picture.bmp'/></texture>
        </bsdf></scene>""")
    mi.file_resolver().prepend(str(tmp_path))
    digests = fingerprint.scene_digests(file, {})
    assert sorted(digests) == sorted([f"{tmp_path}/it's & co.bmp", "scene.xml"])


# --- Resuming -----------------------------------------------------------------

PLUGINS = {
    "bdpm_opt3": {"mix_diffuse": True, "variance": True},
    "bdpt_ris": {"light_paths": 20},
    "volpath_multiview": {},
    "path": {},
}
MORE = {"bdpt": {"techniques": 2}, "vcm": {"alpha": 0.7}}
REST = {
    "bdpm": {"bdd": 0},
    "bdpm_opt2": {"initial_radius": 0.1},
    "bdpm_opt": {"weights": "full"},
    "bdpm_balance": {},
    "pcbpt": {"light_paths": 20},
    "ptracer": {},
}


@pytest.mark.parametrize(
    "plugin",
    [*PLUGINS, *extended(*MORE), *(pytest.param(p, marks=pytest.mark.full) for p in REST)],
)
def test_resumed_session_goes_on_as_if_nothing_had_been(scene, plugin):
    """Iterations 0 to 4 in one session; the same, of which the first two pass through a checkpoint,
    and 4 comes before 2 and 3."""
    loaded = loading.load(scene, {"size": "16"}, plugin, {**PLUGINS, **MORE, **REST}[plugin])
    file = scene.with_name("a.checkpoint")

    def session():
        made = make_session(
            loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 3, 10, fine=True
        )
        made.keep_variance()
        return made

    whole = session()
    for _ in range(5):
        whole.iterate()
    first = session()
    first.iterate()
    first.iterate()
    half = first.image()
    assert all(np.array(tensor).dtype == np.float64 for tensor in first.sums.tensors.values())
    checkpoint.write(
        file, Checkpoint({}, first.learned, first.sums.done, 1.5, 0.5, first.sums.arrays())
    )
    found = checkpoint.read(file)
    assert (found.seconds, found.compiling, found.done.below) == (1.5, 0.5, 2)
    second = session()
    second.recall(dict(found.learned))
    second.sums.merge(found.arrays, found.done)
    assert same(half, second.image())
    second.iterate(4)
    second.iterate()
    second.iterate()
    assert second.iterations == 5 and second.sums.done.below == 5
    assert same(whole.image(), second.image())
    assert not np.allclose(whole.image(), half, rtol=1e-2)
    assert [key for key in second.settings if key.startswith("radius")] == [
        key for key in whole.settings if key.startswith("radius")
    ]
    for one, other in zip(whole.estimate(), second.estimate()):
        np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-4 * one.mean())


def test_learned_radii_are_not_learned_again(scene):
    """With a time limit the pilot hangs on the clock, so a resumed render must not have another."""
    loaded = loading.load(scene, {"size": "16"}, "bdpm", {"bdd": 0})
    session = make_session(loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 3, 0)
    told = learned(session, 0.123, light_share=0.25)
    session.recall(told)
    assert session.light_path_count == 64
    session.plan_time(5.0)
    session.iterate()
    assert session.learned == told and len(told["radii"]) == 2


@pytest.mark.parametrize("plugin", ["path", *extended("bdpm")])
def test_killed_process_resumes(scene, tmp_path, plugin):
    """Killed twice, the first time right after a checkpoint, the second time at some moment: the
    image is that of the undisturbed process."""
    options = [
        "-i",
        plugin,
        *{
            "bdpm": ["--spp", 256, "-D", "size=32"],
            "path": ["--spp", 2048, "-D", "size=64", "--target-error", 1e-9],
        }[plugin],
        "--seed",
        5,
    ]
    assert (
        run(command(scene, *options, "--checkpoint", 1000, "-o", tmp_path / "whole.exr")).returncode
        == 0
    )
    arguments = command(
        scene, *options, "-o", tmp_path / "killed.exr", "--checkpoint", 0.001, "--resume"
    )
    file = tmp_path / "killed.checkpoint"
    counts = []
    for extra in (0.0, 0.13):
        before = file.stat().st_mtime_ns if file.exists() else 0
        process = subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.DEVNULL)
        try:
            deadline = time.monotonic() + 100
            while process.poll() is None and not (
                file.exists() and file.stat().st_mtime_ns > before
            ):
                assert time.monotonic() < deadline
                time.sleep(0.001)
            time.sleep(extra)
        finally:
            process.kill()
        process.wait()
        counts.append(len(checkpoint.read(file).done))
    assert 0 < counts[0] <= counts[1]
    assert process.returncode == -signal.SIGKILL and not (tmp_path / "killed.exr").exists(), (
        "it was over before it was killed"
    )
    # what writers leave that were killed, of this version and of an earlier one
    leftover = output._temporary(file)
    leftover.rename(leftover.with_name(leftover.name.replace(f"-{os.getpid()}-", "-999999999-")))
    (tmp_path / ".killed.checkpoint.123.part").touch()
    final = run(arguments)
    assert final.returncode == 0, final.stderr
    (header, image), (expected_header, expected) = (
        read(tmp_path / "killed.exr"),
        read(tmp_path / "whole.exr"),
    )
    assert header["iterations"] == expected_header["iterations"] > counts[1]
    assert same(expected, image)
    assert not list(tmp_path.glob(".*.part"))


def test_finished_render_is_extended(scene, tmp_path, capsys):
    """A render of four samples that goes on to eight is one of eight; one that has enough is
    written as it is."""
    out = ["-i", "bdpt", "-o", tmp_path / "a.exr"]
    assert render(scene, *out, "--spp", 4, "--checkpoint", 100) == 0
    assert render(scene, *out, "--spp", 8, "--resume", "--quiet") == 0
    assert render(scene, "-i", "bdpt", "-o", tmp_path / "b.exr", "--spp", 8) == 0
    header, image = read(tmp_path / "a.exr")
    assert header["iterations"] == 8 and same(read(tmp_path / "b.exr")[1], image)
    seconds = header["renderTime"]
    assert render(scene, *out, "--spp", 8, "--resume") == 0
    assert read(tmp_path / "a.exr")[0]["renderTime"] == seconds
    capsys.readouterr()
    assert render(scene, *out, "--spp", 8, "--checkpoint", 100) == 4
    assert "--resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, price",
    [
        (["-i", "bdpm", "-P", "bdd=0", "-D", "size=16"], None),
        (["-i", "bdpm_auto", "-P", "max_depth=4"], 1e-6),
        (["-i", "path"], None),
        *extended(
            (["-i", "bdpm_auto", "-P", "max_depth=4"], 1e6),
            (["-i", "bdpm_opt2", "-P", "mix_diffuse=true"], None),
            (["-i", "volpath_multiview"], None),
        ),
    ],
)
def test_image_is_rendered_again_from_itself(scene, tmp_path, monkeypatch, arguments, price):
    """Whatever the clock decided: radii, the method, the number of iterations."""
    if price:
        set_price_of_path(monkeypatch, price)
    one, other = tmp_path / "a.exr", tmp_path / "b.exr"
    assert render(scene, *arguments, "--time", 0.2, "--seed", 7, "-o", one) == 0
    monkeypatch.undo()
    assert render(scene, "--like", one, "-o", other) == 0
    (told, image), (again, same_image) = read(one), read(other)
    told, again = (
        {
            name: value
            for name, value in header.items()
            if isinstance(value, (int, float, str)) and not name.endswith("Time")
        }
        for header in (told, again)
    )
    del told["again"], again["again"]
    assert told == again
    assert same(image, same_image) and told["seed"] == 7


@pytest.mark.parametrize(
    "plugin, given, price, paths",
    [
        ("bdpm", ["-P", "camera_paths=3"], None, 3),
        ("bdpm_auto", ["-P", "camera_paths=3"], 1e6, 3),
        ("bdpm_auto", [], 1e-6, 4),
    ],
)
def test_samples_asked_for_are_made_whatever_was_learned(
    scene, tmp_path, monkeypatch, plugin, given, price, paths
):
    """A timed render that takes several camera paths an iteration goes on to a number of
    samples."""
    film = loading.load(scene, {}, plugin, {}).scene.sensors()[0].film()
    monkeypatch.setattr(
        "mis_integrators.integrators.unidirectional.BUSY", 4 * int(np.prod(film.size()))
    )
    if price:
        set_price_of_path(monkeypatch, price)
    out = ["-i", plugin, *given, "-o", tmp_path / "a.exr"]
    assert render(scene, *out, "--time", 0.01, "--checkpoint", 100) == 0
    header, _ = read(tmp_path / "a.exr")
    assert header["camera_paths"] == paths and header["spp"] == paths * header["iterations"]
    assert render(scene, *out, "--spp", header["spp"] + 3 * paths, "--resume") == 0
    longer, _ = read(tmp_path / "a.exr")
    assert (
        longer["spp"] - header["spp"] == 3 * paths
        and longer["iterations"] == header["iterations"] + 3
    )


@pytest.mark.parametrize(
    "image, arguments, code, message",
    [
        ("picture.exr", [], 1, "not an image of mis-render"),
        ("scene.xml", [], 1, "not an image"),
        ("none.exr", [], 1, "cannot be read"),
        ("picture.exr", ["--seed", 3], 2, "argument --seed: not allowed with argument --like"),
        ("picture.exr", ["--seed", 0], 2, "argument --seed: not allowed"),
        ("a.exr", [], 2, "is the image of --like"),
    ],
)
def test_what_cannot_be_rendered_again(scene, tmp_path, capsys, image, arguments, code, message):
    mi.Bitmap(np.zeros((4, 4, 3), np.float32)).write(str(tmp_path / "picture.exr"))
    try:
        found = render(scene, "--like", tmp_path / image, "-o", tmp_path / "a.exr", *arguments)
    except SystemExit as exit:
        found = exit.code
    error = capsys.readouterr().err
    assert found == code and message in error and (code == 2 or error.count("\n") == 1)


def test_sigterm_is_like_ctrl_c(scene, tmp_path):
    process = subprocess.Popen(
        command(scene, "-o", tmp_path / "a.exr", "--time", 100, "--checkpoint", 0.1),
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / "a.checkpoint").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        process.terminate()
        assert process.wait(timeout=60) == 130
        assert "interrupted after" in process.stderr.read()
    finally:
        process.kill()
    assert read(tmp_path / "a.exr")[0]["iterations"] == len(
        checkpoint.read(tmp_path / "a.checkpoint").done
    )


# --- What is refused ----------------------------------------------------------


@pytest.fixture
def kept(scene, tmp_path) -> Path:
    """The checkpoint of a finished render, of `bdpm`."""
    assert (
        render(
            scene,
            "-i",
            "bdpm",
            "-o",
            tmp_path / "a.exr",
            "--spp",
            2,
            "--checkpoint",
            100,
            "--quiet",
        )
        == 0
    )
    return tmp_path / "a.checkpoint"


def test_other_renders_are_refused(scene, kept, tmp_path, capsys):
    """One line that names what differs, for everything that may."""

    def refused(*arguments):
        plugin = [] if "-i" in arguments else ["-i", "bdpm"]
        code = render(scene, *plugin, "-o", tmp_path / "a.exr", "--spp", 4, "--resume", *arguments)
        error = capsys.readouterr().err
        assert code == 4 and error.count("\n") == 1, error
        return error

    content = kept.read_bytes()
    assert "bdd = 1, not 0" in refused("-P", "bdd=0")
    assert "plugin bdpm, not vcm" in refused("-i", "vcm")
    assert "seed 0, not 1" in refused("--seed", "1")
    assert "llvm_ad_mono" in refused("--variant", "llvm_ad_mono")
    assert "other.png is new" in refused("-D", "picture=other.png")
    assert "-D size = (default), not 12" in refused("-D", "size=12")
    for name, change in (
        ("scene.xml", SCENE.replace("0.6", "0.61")),
        ("lamp.xml", LAMP.replace("5, 4", "5, 5")),
        ("lamp.spd", "400 0.5\n700 0.7\n"),
    ):
        before = (tmp_path / name).read_text()
        (tmp_path / name).write_text(change)
        assert f"{name} has changed" in refused()
        (tmp_path / name).write_text(before)
    mi.set_variant("llvm_ad_rgb")
    wall = (tmp_path / "wall.png").read_bytes()
    mi.Bitmap(np.zeros((2, 2, 3), np.uint8)).write(str(tmp_path / "wall.png"))
    assert "wall.png has changed" in refused()
    (tmp_path / "wall.png").write_bytes(wall)
    assert kept.read_bytes() == content
    assert render(scene, "-i", "bdpm", "-o", tmp_path / "a.exr", "--spp", 3, "--resume") == 0


def test_damage_is_found(kept, tmp_path, scene, capsys):
    """Any bit that flips, any byte that is missing or added."""
    content = bytearray(kept.read_bytes())
    places = np.random.default_rng(0).integers(0, 8 * len(content), 300)
    damaged = tmp_path / "b.checkpoint"
    for place in (0, 8 * len(checkpoint.MAGIC) + 1, 8 * len(content) - 1, *places):
        content[place // 8] ^= 1 << place % 8
        damaged.write_bytes(content)
        with pytest.raises(CheckpointError, match="damaged"):
            checkpoint.read(damaged)
        content[place // 8] ^= 1 << place % 8
    for part in (
        b"",
        content[:10],
        content[:40],
        content[: len(content) // 2],
        content[:-1],
        content + b"\0",
    ):
        damaged.write_bytes(part)
        with pytest.raises(CheckpointError, match="damaged"):
            checkpoint.read(damaged)
    kept.write_bytes(content[:-5])
    capsys.readouterr()
    assert render(scene, "-i", "bdpm", "-o", tmp_path / "a.exr", "--spp", 4, "--resume") == 4
    error = capsys.readouterr().err
    assert "damaged" in error and error.count("\n") == 1


# --- Disks that are full ------------------------------------------------------


def test_full_disk_leaves_the_checkpoint_and_the_image_before(scene, tmp_path):
    """Files may not become longer than 1000 bytes, which is what a disk that fills up looks like to
    a writer."""
    options = ["-i", "path", "-o", tmp_path / "a.exr", "-D", "size=48"]
    assert run(command(scene, *options, "--spp", 64, "--checkpoint", 100)).returncode == 0
    files = [tmp_path / f"a.{suffix}" for suffix in ("checkpoint", "exr", "png")]
    before = [file.read_bytes() for file in files]
    assert all(len(content) > 1000 for content in before)
    limited = run(
        command(scene, *options, "--spp", 96, "--checkpoint", 0.001, "--resume"),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
    )
    assert limited.returncode == 3
    complaints = [line for line in limited.stderr.splitlines() if line.startswith("mis-render")]
    # each once: the checkpoint, the image
    assert [line.count("cannot write") for line in complaints] == [1, 1], limited.stderr
    assert "a.checkpoint: File too large" in complaints[0] and "a.exr" in complaints[1]
    assert [file.read_bytes() for file in files] == before
    assert not list(tmp_path.glob(".*.part"))
    after = run(command(scene, *options, "--spp", 96, "--resume"))
    assert after.returncode == 0 and read(files[1])[0]["spp"] == 128


def test_render_goes_on_when_a_checkpoint_fails(scene, tmp_path, monkeypatch, capsys):
    """No space is left for a while: said once, the render goes on, and the checkpoint is written
    when there is room again."""
    fsync, calls = os.fsync, []

    def failing(descriptor):
        calls.append(descriptor)
        if len(calls) <= 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    assert (
        render(
            scene,
            "-i",
            "bdpt",
            "-o",
            tmp_path / "a.exr",
            "--spp",
            6,
            "--checkpoint",
            1e-6,
            "--quiet",
        )
        == 0
    )
    error = capsys.readouterr().err
    assert (
        error.count("No space left on device") == 1
        and error.count("\n") == 1
        and "a.checkpoint" in error
    )
    assert len(checkpoint.read(tmp_path / "a.checkpoint").done) == 6


def test_png_that_is_cut_short_is_an_error(tmp_path, rgb, monkeypatch):
    """Mitsuba's writer does not tell; the file before stays."""
    image = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    assert output.write_png(tmp_path / "a.png", image, ["R", "G", "B"])
    before = (tmp_path / "a.png").read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        with pytest.raises(OSError):
            output.write_png(tmp_path / "a.png", image, ["R", "G", "B"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "a.png").read_bytes() == before


# --- Preview ------------------------------------------------------------------


def test_preview_is_a_whole_picture_at_any_moment(scene, tmp_path, monkeypatch):
    """Read after each iteration; gone when the image is there."""
    seen, iterate = [], cli.iterate

    def watching(session, *rest):
        plain = session.iterate

        def watched():
            if (tmp_path / "a.preview.exr").exists():
                header, image = read(tmp_path / "a.preview.exr")
                # channels are sorted: B, G, R
                assert (
                    same(image[..., ::-1], session.image())
                    and (tmp_path / "a.preview.png").exists()
                )
                seen.append(header["iterations"])
            plain()

        session.iterate = watched
        iterate(session, *rest)

    monkeypatch.setattr(cli, "iterate", watching)
    assert (
        render(
            scene, "-i", "bdpt", "-o", tmp_path / "a.exr", "--spp", 5, "--preview", 1e-6, "--quiet"
        )
        == 0
    )
    assert seen == [1, 2, 3, 4]
    assert sorted(file.name for file in tmp_path.glob("a.*")) == ["a.exr", "a.png"]


# --- Target error -------------------------------------------------------------


def test_relative_error_of_known_noise():
    """Gaussian noise of standard deviation 0.2 on a picture of brightness 1 and 3, 100 iterations;
    then a few pixels that flash."""
    random = np.random.default_rng(1)
    truth = np.where(np.arange(64)[:, None, None] < 32, 1.0, 3.0) * np.ones((64, 64, 3))
    samples = truth + 0.2 * random.standard_normal((100, 64, 64, 3))
    expected = np.sqrt((0.2**2 / 100 / (truth**2 + (0.1 * 2) ** 2)).mean())
    mean, variance = samples.mean(axis=0), samples.var(axis=0, ddof=1) / 100
    error = stopping.relative_error(mean, variance)
    assert error == pytest.approx(expected, rel=0.02)
    assert stopping.relative_error(7 * mean, 49 * variance) == pytest.approx(error)
    for pixel in range(4):
        variance[pixel, pixel] = 1e6
    assert stopping.relative_error(mean, variance) == pytest.approx(error, rel=0.02)
    assert stopping.relative_error(np.zeros((4, 4, 3)), np.zeros((4, 4, 3))) == 0


@pytest.mark.parametrize(
    "plugin, parameters",
    [
        ("bdpm", {"bdd": 0, "initial_radius": 0.3}),
        *extended(("path", {})),
        *(
            pytest.param(plugin, {}, marks=pytest.mark.full)
            for plugin in ("bdpt", "vcm", "volpath_multiview")
        ),
    ],
)
def test_estimated_error_is_the_error(scene, plugin, parameters):
    """Against the mean of 12 other renders. Each render's squared error sums over 1024 pixels,
    those of `bdpm` correlated over some hundred: the mean of three ratios has a standard deviation
    below 7 %."""
    loaded = loading.load(scene, {"size": "32"}, plugin, parameters)
    images, estimates = [], []
    for seed in range(15):
        session = make_session(
            loaded.integrator,
            loaded.scene,
            loaded.scene.sensors()[0],
            seed,
            32 * 16 if plugin == "path" else 16,
            fine=True,
        )
        if seed < 3:
            session.keep_variance()
        for _ in range(16):
            session.iterate()
        images.append(session.image().astype(np.float64)[..., :3])
        if seed < 3:
            estimates.append(stopping.relative_error(*session.estimate()))
    ratios = []
    for seed, estimate in enumerate(estimates):
        others = np.mean(images[3:], axis=0)
        error = (images[seed] - others) ** 2 * 12 / 13
        ratios.append(stopping.relative_error(others, error) / estimate)
    assert abs(np.mean(ratios) - 1) < 0.25, ratios


def test_progress_has_the_estimated_error(scene, tmp_path, capsys, monkeypatch):
    """From the first estimate on; it falls, and the last one is that before the image's own."""
    monkeypatch.setattr("mis_integrators.app.progress.SECONDS_BETWEEN_LINES", 0.0)
    assert render(scene, "-o", tmp_path / "a.exr", "--target-error", 0.02) == 0
    *lines, last = capsys.readouterr().err.splitlines()
    found = [re.search(r"relative error ([\d.]+)", line) for line in (*lines, last)]
    assert found[0] is None and all(found[stopping.FEWEST_ITERATIONS :])
    first, *_, shown, final = (float(match[1]) for match in found if match)
    assert first > shown > final > shown / stopping.LARGEST_STEP


def test_target_error_stops_the_render(scene, tmp_path, capsys):
    """Reached without another bound; not reached within one, which is said."""
    needed = {}
    for sampler in ("independent", "sobol"):
        iterations = []
        for target in (0.1, 0.05):
            options = ["-i", "bdpt", "-P", f"sampler={sampler}", "--target-error", target]
            options += ["-P", "max_depth=2"]  # direct light, where sequences are at their best
            assert render(scene, *options, "-o", tmp_path / "a.exr") == 0
            header, _ = read(tmp_path / "a.exr")
            assert 0.75 * target < header["relativeError"] <= target
            iterations.append(header["iterations"])
            assert "relative error 0.0" in capsys.readouterr().err
        needed[sampler] = iterations
    few, many = needed["independent"]
    assert 3 < many / few < 5.3  # four times as many, but for steps
    few, many = needed["sobol"]
    assert 1.7 < many / few < 5.3  # between twice (error proportional to 1 / n) and four times
    assert many < 0.9 * needed["independent"][1]  # what the estimate has to know
    assert (
        render(scene, "-i", "bdpt", "-o", tmp_path / "a.exr", "--target-error", 0.001, "--spp", 10)
        == 0
    )
    assert read(tmp_path / "a.exr")[0]["iterations"] == 10
    assert "(target 0.001 not reached)" in capsys.readouterr().err
    # path, in passes
    assert render(scene, "-o", tmp_path / "a.exr", "--target-error", 0.2, "--quiet") == 0
    assert read(tmp_path / "a.exr")[0]["relativeError"] <= 0.2


# --- Memory -------------------------------------------------------------------

MEMORY = """
import sys, mis_integrators, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from mis_integrators.app import loading
from mis_integrators.core.session import make_session
from pathlib import Path
loaded = loading.load(Path(sys.argv[1]), {"size": "32"}, sys.argv[2], {})
session = make_session(loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 0, 0, fine=True)
session.keep_variance()
def resident():
    line = next(line for line in open("/proc/self/status") if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024
for count in (30, 130):
    while session.iterations < count:
        session.iterate()
    session.image(), session.estimate(), session.sums.arrays()
    print(resident())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize(
    "plugin",
    [
        "bdpm_opt3",
        *extended("path"),
        *(pytest.param(p, marks=pytest.mark.full) for p in ("bdpt", "vcm", "volpath_multiview")),
    ],
)
def test_memory_does_not_grow(scene, plugin):
    """One hundred iterations more: less than 100 kB each would show as 10 MB."""
    result = run([sys.executable, "-c", MEMORY, str(scene), plugin])
    assert result.returncode == 0, result.stderr
    early, late = map(float, result.stdout.split())
    assert late - early < 8, (early, late)
