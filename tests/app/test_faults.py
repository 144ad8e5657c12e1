"""What goes wrong in the middle of a render costs what went wrong, and nothing else: values that
are not finite, errors, two jobs with one output."""

import multiprocessing
import os
import stat
import subprocess
import sys
import time

from mis_integrators import _plugins
from mis_integrators.app import checkpoint, fingerprint, loading, output
from mis_integrators.app import target_error as stopping
from mis_integrators.core.session import MitsubaSession, make_session
from mis_integrators.core.sums import Iterations, Sums

import mitsuba as mi
import numpy as np
import pytest
from lamplit import ROOT, command, read, render, run, same, write_scene
from selection import extended
from worlds import lit_ball


@pytest.fixture
def scene(tmp_path, rgb):
    return write_scene(tmp_path)


# --- Values that are not finite -----------------------------------------------


@pytest.fixture
def spotted(scene, tmp_path):
    """A floor one of whose texels is not a number, under a lamp that is all right."""
    pixels = np.full((16, 16, 3), 0.5, np.float32)
    pixels[8, 8] = np.nan
    mi.Bitmap(pixels).write(str(tmp_path / "nan.exr"))
    return scene


FEW = "bdpm", "volpath_multiview", "path"
"""Plugins whose sessions and films differ most."""


@pytest.mark.parametrize(
    "plugin", [*FEW, *extended(*(plugin for plugin in _plugins.PLUGINS if plugin not in FEW))]
)
def test_texel_that_is_no_number(spotted, tmp_path, capsys, plugin):
    """The image is there, finite, and as bright as it should be; the texture is named. Both
    renders' means have a standard deviation of about 2 %."""
    options = ["-D", "size=32", "-i", plugin, "--spp", 16, "--seed", 1]
    assert (
        render(
            spotted,
            *options,
            "-D",
            "picture=nan.exr",
            "-o",
            tmp_path / "nan.exr.exr",
            "--target-error",
            0.001,
        )
        == 0
    )
    error = capsys.readouterr().err
    header, image = read(tmp_path / "nan.exr.exr")
    assert "reflectance.data of BitmapTexture" in error and error.count("not finite") <= 2, error
    assert (
        np.isfinite(image).all()
        and np.isfinite(header["relativeError"])
        and header["relativeError"] > 0.001
    )
    mi.Bitmap(np.full((16, 16, 3), 0.5, np.float32)).write(str(tmp_path / "grey.exr"))
    assert (
        render(
            spotted, *options, "-D", "picture=grey.exr", "-o", tmp_path / "grey.exr.exr", "--quiet"
        )
        == 0
    )
    assert image.mean() == pytest.approx(read(tmp_path / "grey.exr.exr")[1].mean(), rel=0.12)


def poison(monkeypatch, kind, value, iterations):
    """Spoils one pixel of some iterations' images, in the middle."""
    if kind == "mitsuba":
        plain = MitsubaSession.iterate

        def iterate(self, iteration=None):
            number = self.sums.done.first_missing
            film = self._sensor.film()
            develop = type(film).bitmap

            def bitmap(film, *arguments):
                image = np.array(develop(film, *arguments))
                if number in iterations:
                    image[12, 7] = value
                return image

            monkeypatch.setattr(type(film), "bitmap", bitmap)
            try:
                plain(self, iteration)
            finally:
                monkeypatch.setattr(type(film), "bitmap", develop)

        monkeypatch.setattr(MitsubaSession, "iterate", iterate)
        return
    from mis_integrators.core.film import Accumulator

    add = Accumulator.add

    def spoiled(self, block, iteration, techniques=None):
        if iteration in iterations:
            border = self.film.rfilter().border_size()
            array = np.array(block)
            array[12 + border, 7 + border, 1] = value
            block = mi.TensorXf(array)
        add(self, block, iteration, techniques)

    monkeypatch.setattr(Accumulator, "add", spoiled)


@pytest.mark.parametrize("value", [np.nan, *extended(np.inf, -np.inf)], ids=str)
@pytest.mark.parametrize(
    "kind, plugin, parameters",
    [
        ("ours", "bdpt", {"sampler": "independent"}),
        ("ours", "bdpt", {"sampler": "sobol"}),
        ("mitsuba", "path", {}),
    ],
)
def test_bad_pixel_costs_its_iterations_only(scene, monkeypatch, value, kind, plugin, parameters):
    """The pixel is the mean over the iterations in which it is finite, and so is its variance; all
    others are as they were, but that variances of iterations which share sequences hang on pixels
    nearby."""

    def session():
        loaded = loading.load(scene, {"size": "16"}, plugin, parameters)
        made = make_session(
            loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 3, 64, fine=True
        )
        made.keep_variance()
        return made

    images = []
    clean = session()
    for _ in range(6):
        before = clean.image() * clean.iterations if clean.iterations else 0
        clean.iterate()
        images.append(clean.image() * clean.iterations - before)
    assert clean.unfinite_pixels() == 0
    poison(monkeypatch, kind, value, (1, 4))
    spoiled = session()
    for _ in range(6):
        spoiled.iterate()
    image, (mean, variance) = spoiled.image(), spoiled.estimate()
    others = np.ones(image.shape[:2], bool)
    others[12, 7] = False
    assert spoiled.unfinite_pixels() == 1 and spoiled.sums.done == Iterations(6)
    np.testing.assert_allclose(image[others], clean.image()[others], rtol=1e-4, atol=1e-6)
    clean_mean, clean_variance = clean.estimate()
    np.testing.assert_allclose(mean[others], clean_mean[others], rtol=1e-3, atol=1e-7)
    # Groups of pixels that the variance is pooled over gain or lose one of 16.
    close = 0.5 if parameters == {"sampler": "sobol"} else 1e-3
    np.testing.assert_allclose(variance[others], clean_variance[others], rtol=close, atol=1e-7)
    assert variance[others].sum() == pytest.approx(clean_variance[others].sum(), rel=0.1 * close)
    if plugin == "path":
        left = np.array([images[number][12, 7, :3] for number in (0, 2, 3, 5)])
        np.testing.assert_allclose(image[12, 7, :3], left.mean(axis=0), rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(
            variance[12, 7], left.var(axis=0, ddof=1) / 4, rtol=1e-2, atol=1e-7
        )
    assert np.isfinite(image).all() and np.isfinite(variance).all() and (image[12, 7, :3] > 0).any()
    assert np.isfinite(stopping.relative_error(mean, variance))


@pytest.mark.parametrize("value", [np.nan, np.inf], ids=str)
def test_bad_pixel_is_counted_and_said_once(scene, tmp_path, monkeypatch, capsys, value):
    poison(monkeypatch, "mitsuba", value, (0, 1, 2))
    assert (
        render(
            scene,
            "-D",
            "size=16",
            "-o",
            tmp_path / "a.exr",
            "--spp",
            320,
            "--target-error",
            0.01,
            "--quiet",
        )
        == 0
    )
    error = capsys.readouterr().err
    header, image = read(tmp_path / "a.exr")
    assert error.count("not finite") == 1 and "1 pixels" in error and header["unfinitePixels"] == 1
    assert np.isfinite(image).all() and 0.001 < header["relativeError"] < 1


def test_bad_pixels_of_many_views(scene, rgb):
    """Views share paths: an iteration that is left out at a pixel must not make it darker."""
    from mis_integrators.volume.films import ViewAccumulator

    loaded = loading.load(scene, {"size": "16"}, "volpath_multiview", {})

    def session():
        return make_session(loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 3, 64)

    clean, spoiled = session(), session()
    add = ViewAccumulator.add

    def poisoned(self, shared, own, iteration):
        array = np.array(shared)
        if iteration in (1, 2, 4):
            array[11:14, 3:9] = np.nan
        add(self, mi.TensorXf(array), own, iteration)

    for _ in range(8):
        clean.iterate()
    ViewAccumulator.add = poisoned
    try:
        for _ in range(8):
            spoiled.iterate()
    finally:
        ViewAccumulator.add = add
    one, other = clean.image(), spoiled.image()
    changed = ~np.isclose(one, other, rtol=1e-4, atol=1e-6).all(axis=2)
    assert 0 < spoiled.unfinite_pixels() <= 18 and changed.sum() <= 18 and np.isfinite(other).all()
    # Five of eight iterations of the same eight paths a pixel, over 18 pixels: a standard deviation
    # of about 3 %.
    assert other[changed].mean() == pytest.approx(one[changed].mean(), rel=0.2)


def test_black_image_is_said(scene, tmp_path, capsys):
    assert (
        render(
            scene,
            "-i",
            "bdpm",
            "-P",
            "max_depth=0",
            "-o",
            tmp_path / "a.exr",
            "--target-error",
            0.1,
            "--quiet",
        )
        == 0
    )
    error = capsys.readouterr().err
    assert (
        "the image is black" in error and error.count("\n") == 1 and (tmp_path / "a.exr").exists()
    )


def test_one_pixel_that_is_brighter_than_all_others_together():
    """Its brightness once made all other errors small."""
    random = np.random.default_rng(1)
    mean, variance = 1 + 0.1 * random.random((64, 64, 3)), np.full((64, 64, 3), 0.01)
    error = stopping.relative_error(mean, variance)
    mean[3, 4] = 1e30
    assert stopping.relative_error(mean, variance) == pytest.approx(error, rel=0.02)


# --- Errors in the middle -----------------------------------------------------


def failing(monkeypatch, plugin, error, at):
    from mis_integrators.integrators.common import IterativeSession  # of the active variant

    kind = MitsubaSession if plugin == "path" else IterativeSession
    plain = kind.iterate

    def iterate(self, iteration=None):
        if self.iterations == at:
            raise error
        plain(self, iteration)

    monkeypatch.setattr(kind, "iterate", iterate)


@pytest.mark.parametrize(
    "plugin, error, message",
    [
        ("bdpt", RuntimeError("the device is gone"), "the device is gone"),
        ("path", MemoryError(), "not enough memory"),
        ("volpath_multiview", TypeError("a defect"), "TypeError: a defect"),
    ],
)
def test_error_in_the_middle_keeps_what_is_done(
    scene, tmp_path, monkeypatch, capsys, plugin, error, message
):
    """Image and checkpoint hold the iterations before it, and a resumed render is that of an
    undisturbed one."""
    options = ["-i", plugin, "-D", "size=16", "--spp", 64, "--checkpoint", 100, "--seed", 2]
    if plugin != "path":
        options += ["-P", "camera_paths=8"]
    with monkeypatch.context() as patched:
        failing(patched, plugin, error, 5)
        patched.setattr("mis_integrators.core.session.PATHS_PER_PASS", 16 * 16 * 8)
        assert render(scene, *options, "-o", tmp_path / "a.exr") == 1
        said = capsys.readouterr().err.splitlines()[-1]
        assert message in said and "what was rendered before is written" in said and "a.exr" in said
        assert (
            read(tmp_path / "a.exr")[0]["iterations"]
            == 5
            == len(checkpoint.read(tmp_path / "a.checkpoint").done)
        )
    monkeypatch.setattr("mis_integrators.core.session.PATHS_PER_PASS", 16 * 16 * 8)
    assert render(scene, *options, "-o", tmp_path / "a.exr", "--resume", "--quiet") == 0
    assert render(scene, *options, "-o", tmp_path / "b.exr", "--quiet") == 0
    (header, image), (_, whole) = (read(tmp_path / f"{name}.exr") for name in "ab")
    assert header["iterations"] == 8 and same(image, whole)


def test_error_in_the_first_iteration_leaves_nothing(scene, tmp_path, monkeypatch, capsys):
    failing(monkeypatch, "path", RuntimeError("at once"), 0)
    assert render(scene, "-o", tmp_path / "a.exr", "--checkpoint", 100) == 1
    error = capsys.readouterr().err
    assert (
        "at once" in error
        and error.count("\n") == 1
        and not (tmp_path / "a.exr").exists()
        and not (tmp_path / "a.checkpoint").exists()
    )


@pytest.mark.parametrize("plugin", ["bdpm", "path"])
def test_error_while_summing_sums_nothing(scene, plugin, monkeypatch):
    """An iteration of which the half is summed when memory runs out."""
    loaded = loading.load(scene, {"size": "16"}, plugin, {})
    session = make_session(
        loaded.integrator, loaded.scene, loaded.scene.sensors()[0], 3, 64, fine=True
    )
    session.keep_variance()
    session.iterate()
    before = session.image()
    add = Sums.add

    def short_of_memory(self, name, value):
        if name == "square":
            raise MemoryError
        add(self, name, value)

    with monkeypatch.context() as patched:
        patched.setattr(Sums, "add", short_of_memory)
        with pytest.raises(MemoryError):
            session.iterate()
    assert session.iterations == 1 and np.array_equal(before, session.image())
    session.iterate()
    assert session.iterations == 2


# --- Two jobs, one output -----------------------------------------------------


def test_second_job_is_refused_and_the_first_goes_on(scene, tmp_path):
    """Also while it resumes; the lock of a job that was killed is nobody's."""
    arguments = command(scene, "-o", tmp_path / "a.exr", "--time", 100, "--checkpoint", 0.1)
    first = subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / "a.checkpoint").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        for extra in ([], ["--resume"]):
            second = run(command(scene, "-o", tmp_path / "a.exr", "--spp", 1, *extra))
            assert (
                second.returncode == 3
                and f"process {first.pid} on " in second.stderr
                and second.stderr.count("\n") == 1
            ), second.stderr
        (tmp_path / "link.exr").symlink_to(tmp_path / "a.exr")
        assert run(command(scene, "-o", tmp_path / "link.exr", "--spp", 1)).returncode == 3
        assert first.poll() is None
    finally:
        first.kill()
        first.wait()
    assert (tmp_path / ".a.exr.lock").exists()
    assert render(scene, "-o", tmp_path / "a.exr", "--time", 0.01, "--resume", "--quiet") == 0
    assert not list(tmp_path.glob(".*"))


def test_leftovers_of_the_living_stay(tmp_path):
    """Temporary files: of a process that lives, of one that does not, of another machine just now
    and long ago, and what is none of ours."""
    path = tmp_path / "a.exr"
    mine = output._temporary(path).name
    random = mine.rsplit("-", 1)[1]
    prefix = f".a.exr.{output._host()}-"
    living, dead = f"{prefix}{os.getppid()}-{random}", f"{prefix}999999999-{random}"
    elsewhere, long_ago, other = (
        f".a.exr.elsewhere-5-{random}",
        f".a.exr.elsewhere-6-{random}",
        ".a.exr.of some other program.part",
    )
    for name in (living, dead, elsewhere, long_ago, other):
        (tmp_path / name).touch()
    os.utime(tmp_path / long_ago, (0, 0))
    output.remove_leftovers(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted([living, elsewhere, other])


def _write(path, value, barrier):
    barrier.wait()
    for _ in range(20):
        output.write_exr(path, np.full((64, 64, 1), value, np.float32), ["Y"], {})


def test_writers_do_not_meet(tmp_path):
    """Two processes, which may have the same number in two containers, write one file: it is that
    of one of them."""
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(2)
    writers = [
        context.Process(target=_write, args=(tmp_path / "a.exr", value, barrier))
        for value in (1.0, 2.0)
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(60)
        assert writer.exitcode == 0
    _, image = read(tmp_path / "a.exr")
    assert image.min() == image.max() in (1.0, 2.0) and [
        file.name for file in tmp_path.iterdir()
    ] == ["a.exr"]


def test_names_of_temporary_files_cannot_be_foreseen(tmp_path):
    """A link of the name that a temporary file would have had let it write anywhere."""
    with output.replacing(tmp_path / "a.exr") as one, output.replacing(tmp_path / "a.exr") as other:
        assert one != other
        for temporary in (one, other):
            assert stat.S_IMODE(temporary.stat().st_mode) == 0o600
            temporary.write_bytes(b"whole")
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.exr").stat().st_mode) == 0o666 & ~mask
    (tmp_path / "a.exr").chmod(0o640)
    with output.replacing(tmp_path / "a.exr") as temporary:
        temporary.write_bytes(b"again")
    assert stat.S_IMODE((tmp_path / "a.exr").stat().st_mode) == 0o640


def test_link_is_followed(scene, tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "a.exr").symlink_to(tmp_path / "store" / "real.exr")
    assert render(scene, "-o", tmp_path / "a.exr", "--spp", 1, "--quiet") == 0
    assert (tmp_path / "a.exr").is_symlink() and read(tmp_path / "store" / "real.exr")[0][
        "spp"
    ] == 1
    assert sorted(file.name for file in (tmp_path / "store").iterdir()) == ["real.exr"]


@pytest.mark.parametrize("kind", ["fifo", "device", "fifo.png", "circle", "lock"])
def test_what_is_no_file_is_not_replaced(scene, tmp_path, capsys, kind):
    """Refused before anything is rendered."""
    path = tmp_path / "a.exr"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/null")
    elif kind == "fifo.png":
        os.mkfifo(path.with_suffix(".png"))
    elif kind == "circle":
        path.symlink_to("b.exr")
        (tmp_path / "b.exr").symlink_to("a.exr")
    else:
        (tmp_path / "elsewhere").write_text("precious")
        (tmp_path / ".a.exr.lock").symlink_to("elsewhere")
    assert render(scene, "-o", path, "--spp", 1) == 3
    error = capsys.readouterr().err
    assert "cannot write" in error and error.count("\n") == 1, error
    assert kind != "lock" or (tmp_path / "elsewhere").read_text() == "precious"
    if kind == "device":
        assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


# --- The version that made an image -------------------------------------------


def test_other_sources_are_another_render(scene, tmp_path, monkeypatch, capsys):
    """The version is one for many states of the sources."""
    options = ["-o", tmp_path / "a.exr", "--quiet"]
    assert render(scene, *options, "--spp", 1, "--checkpoint", 100) == 0
    mine = fingerprint.of_package()
    monkeypatch.setattr(fingerprint, "of_package", lambda: "0123456789ab")
    assert render(scene, *options, "--spp", 2, "--resume") == 4
    error = capsys.readouterr().err
    assert mine in error and "0123456789ab" in error and error.count("\n") == 1
    assert render(scene, "--like", tmp_path / "a.exr", "-o", tmp_path / "b.exr") == 0
    assert "may differ" in capsys.readouterr().err


def test_fingerprint_is_of_every_source(tmp_path):
    """It changes with any byte of any module or table, and with a module's name."""
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from mis_integrators.app import fingerprint; print(fingerprint.of_package())"
    )
    import shutil

    def fingerprint_of(folder):
        return run([sys.executable, "-c", program, str(folder)]).stdout

    shutil.copytree(
        ROOT / "mis_integrators",
        tmp_path / "mis_integrators",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    before = fingerprint_of(tmp_path)
    assert before == fingerprint_of(ROOT) and len(before.strip()) == 12
    module = tmp_path / "mis_integrators" / "weights" / "heuristics.py"
    module.write_text(module.read_text() + "\n")
    changed = fingerprint_of(tmp_path)
    module.rename(module.with_name("mis9.py"))
    renamed = fingerprint_of(tmp_path)
    table = next((tmp_path / "mis_integrators").rglob("*.json"))
    table.write_text(table.read_text() + "\n")
    assert len({before, changed, renamed, fingerprint_of(tmp_path)}) == 4


def test_texel_is_named_from_python(spotted, tmp_path, capfd):
    scene = mi.load_file(str(spotted), picture=str(tmp_path / "nan.exr"), size="16")
    image = np.array(mi.load_dict({"type": "bdpt"}).render(scene, spp=4))
    assert np.isfinite(image).all()
    said = "".join(capfd.readouterr())
    assert said.count("bdpt: ") == 1 and "reflectance.data of BitmapTexture" in said


@pytest.mark.parametrize(
    "plugin, size",
    [
        ("bdpm", (1, 1)),
        ("volpath_multiview", (3, 1)),
        ("path", (1, 1)),
        *extended(
            *(("bdpm", size) for size in ((1, 3), (3, 1))),
            *(("bdpt", size) for size in ((1, 1), (1, 3), (3, 1))),
            *(("volpath_multiview", size) for size in ((1, 1), (1, 3))),
            *(("path", size) for size in ((1, 3), (3, 1))),
        ),
    ],
)
def test_films_of_few_pixels(rgb, plugin, size):
    scene = lit_ball(*size)
    session = make_session(mi.load_dict({"type": plugin}), scene, scene.sensors()[0], 0, 2)
    session.keep_variance()
    for number in range(2):
        session.iterate(number)
    assert session.image().shape[:2] == size[::-1] and session.unfinite_pixels() == 0
    assert all(np.isfinite(estimate).all() for estimate in session.estimate())
    assert {name: array.shape for name, array in session.sums.arrays().items()} == {
        name: tuple(shape) for name, shape in session.sum_shapes().items()
    }


@pytest.mark.parametrize("plugin", ["path", "bdpt"])
def test_nobody_reads_standard_error(scene, tmp_path, plugin):
    """A pipe whose reader has gone costs what is said, not what is rendered."""
    reader, writer = os.pipe()
    os.close(reader)
    arguments = ["-D", "size=16", "-i", plugin, "--spp", 8, "--checkpoint", 100]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    process = subprocess.run(
        command(scene, *arguments, "-o", tmp_path / "a.exr"),
        cwd=ROOT,
        env=buffered,
        stderr=writer,
        timeout=100,
    )
    os.close(writer)
    assert process.returncode == 0 and read(tmp_path / "a.exr")[0]["spp"] == 8
    assert checkpoint.read(tmp_path / "a.checkpoint").done.below > 0


def test_first_of_two_needed_iterations_is_kept(scene, tmp_path, monkeypatch):
    """An image that shows its variance needs two; the first one is in the checkpoint."""
    options = ["-i", "bdpm", "-D", "size=16", "-P", "variance=true", "--checkpoint", 100]
    with monkeypatch.context() as patched:
        failing(patched, "bdpm", RuntimeError("gone"), 1)
        assert render(scene, *options, "--spp", 4, "-o", tmp_path / "a.exr") == 1
    assert len(checkpoint.read(tmp_path / "a.checkpoint").done) == 1
    assert not (tmp_path / "a.exr").exists()
    assert render(scene, *options, "--spp", 4, "-o", tmp_path / "a.exr", "--resume") == 0


def test_previews_of_others_stay(scene, tmp_path):
    (tmp_path / "a.preview.exr").write_text("mine")
    (tmp_path / "b.preview.exr").mkdir()
    for name in "ab":
        image = tmp_path / f"{name}.exr"
        assert render(scene, "-D", "size=8", "--spp", 1, "-o", image, "--quiet") == 0
    assert (tmp_path / "a.preview.exr").read_text() == "mine"


@pytest.mark.parametrize("plugin", ["bdpt", "path", *extended("bdpm", "bdpm_auto")])
def test_light_near_the_end_of_single_precision(scene, tmp_path, plugin):
    """Sums over iterations exceed it; the image does not, and it can be resumed and made again."""
    lamp = (tmp_path / "lamp.xml").read_text().replace("5, 4, 3", "1e38, 1e38, 1e38")
    (tmp_path / "lamp.xml").write_text(lamp)
    options = ["-D", "size=8", "-i", plugin, "--checkpoint", 100, "-o", tmp_path / "a.exr"]
    assert render(scene, *options, "--spp", 32) == 0
    assert np.isfinite(read(tmp_path / "a.exr")[1]).all()
    assert render(scene, *options, "--spp", 48, "--resume") == 0
    assert render(scene, "--like", tmp_path / "a.exr", "-o", tmp_path / "b.exr") == 0


def test_scene_that_asks_for_no_samples(scene, tmp_path, capsys):
    assert render(scene, "-D", "spp=0", "-o", tmp_path / "a.exr") == 1
    error = capsys.readouterr().err
    assert '"sample_count" is 0' in error and error.count("\n") == 1


def test_names_that_scenes_give_their_variables(scene, tmp_path):
    text = scene.read_text().replace('"size"', '"res-x"').replace("$size", "$res-x")
    scene.write_text(text)
    assert render(scene, "-D", "res-x=8", "--spp", 1, "-o", tmp_path / "a.exr", "--quiet") == 0
    assert render(scene, "--like", tmp_path / "a.exr", "-o", tmp_path / "b.exr", "--quiet") == 0
