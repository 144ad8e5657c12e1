"""Ctrl-C and SIGTERM while ``mis-render`` is still being imported: one line, exit code 130."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import weakref
from pathlib import Path

from mis_integrators.app.render_loop import Interrupt

import pytest

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "cornell_point.xml"
IMPORTED = [sys.executable, "-c", "import sys; from mis_render import main; sys.exit(main())"]
"""What the installed script consists of, with this checkout's module."""
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


def start(command: list, folder: Path) -> subprocess.Popen:
    return subprocess.Popen(
        [*map(str, command), str(SCENE), "-o", str(folder / "a.exr"), "--time", "60"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def wait_for_handlers(process: subprocess.Popen) -> None:
    """Until the process has its handler of SIGTERM, which Python by itself has not."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        caught = re.search(
            r"^SigCgt:\s*(\w+)", Path("/proc", str(process.pid), "status").read_text(), re.MULTILINE
        )
        if int(caught[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.001)
    raise AssertionError("no handler within 30 s")


def check_stopped(process: subprocess.Popen, folder: Path) -> None:
    try:
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (
        (process.returncode, out) == (130, "")
        and err.startswith("mis-render: interrupted")
        and err.count("\n") == 1
    ), err
    assert ("nothing written" in err) == (not (folder / "a.exr").exists())


@linux
@pytest.mark.parametrize("delay", [0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_while_importing(tmp_path, number, delay):
    process = start(IMPORTED, tmp_path)
    wait_for_handlers(process)
    time.sleep(delay)
    process.send_signal(number)
    check_stopped(process, tmp_path)


@linux
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_two_interrupts(tmp_path, number):
    process = start(IMPORTED, tmp_path)
    wait_for_handlers(process)
    process.send_signal(number)
    process.send_signal(number)
    check_stopped(process, tmp_path)


@linux
@pytest.mark.parametrize("delay", [0, 0.2])
def test_installed_script(tmp_path, delay):
    script = Path(sys.executable).with_name("mis-render")
    if not script.exists():
        pytest.skip("mis-render is not installed beside this Python")
    assert "mis_render" in script.read_text(), "an older installation: pip install --editable ."
    process = start([script], tmp_path)
    wait_for_handlers(process)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    check_stopped(process, tmp_path)


@linux
def test_module(tmp_path):
    """``python -m mis_integrators render`` imports the package before its own code runs; from then
    on it is the same."""
    process = start([sys.executable, "-m", "mis_integrators", "render"], tmp_path)
    wait_for_handlers(process)
    process.send_signal(signal.SIGINT)
    check_stopped(process, tmp_path)


def test_nothing_large_is_imported_first():
    """Before the handlers are there."""
    code = (
        "import sys, mis_render\n"
        "assert not {'mitsuba', 'drjit', 'numpy', 'mis_integrators'} & set(sys.modules)"
    )
    subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def test_render_as_before(tmp_path):
    """Image, exit code, and a signal at the very end is of no consequence."""
    scene = shutil.copy(SCENE, tmp_path)
    done = subprocess.run(
        [*IMPORTED, scene, "--spp", "1", "-i", "path", "--quiet"],
        capture_output=True,
        text=True,
        timeout=100,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "") and (
        tmp_path / "cornell_point.exr"
    ).exists()
    wrong = subprocess.run(
        [*IMPORTED, scene, "--nope"],
        capture_output=True,
        text=True,
        timeout=100,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert wrong.returncode == 2


def test_interrupt_that_python_drops_is_remembered_in_silence(capfd, monkeypatch):
    """Python drops what is raised within a weak reference's callback, and says so."""

    class Thing:
        pass

    def interrupted(_):
        signal.raise_signal(signal.SIGINT)

    hook = sys.__unraisablehook__
    monkeypatch.setattr(sys, "unraisablehook", hook)
    with Interrupt() as interrupt:
        thing = Thing()
        reference = weakref.ref(thing, interrupted)
        del thing
        assert reference() is None and interrupt.stopped
    assert sys.unraisablehook is hook and capfd.readouterr().err == ""
