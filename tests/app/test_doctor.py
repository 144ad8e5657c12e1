"""``python -m mis_integrators doctor``: what it finds, and what it says is to be done."""

import os
import subprocess
import sys
from pathlib import Path

from mis_integrators import llvm
from mis_integrators.app import doctor

import pytest

ROOT = Path(doctor.__file__).parents[2]


def consult(**environment: str) -> subprocess.CompletedProcess:
    inherited = {name: value for name, value in os.environ.items() if name != llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-m", "mis_integrators", "doctor"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=300,
        env={**inherited, **environment},
    )


def test_healthy_installation():
    report = consult()
    assert report.returncode == 0, report.stdout
    lines = report.stdout.splitlines()
    for name in (
        "python",
        "mitsuba",
        "drjit",
        "threads",
        "memory",
        "llvm_ad_rgb",
        "llvm_ad_mono",
        "llvm_ad_spectral",
    ):
        assert any(line.startswith(f"ok  {name}") for line in lines), name
    assert any("LLVM" in line and "newest on this system" in line for line in lines)
    assert "brightness 2.0" in report.stdout and lines[-1] == "all is well"


def test_library_that_does_not_exist(tmp_path):
    report = consult(DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"))
    assert report.returncode == 1
    assert (
        "does not exist; correct or unset it" in report.stdout
        and "BAD llvm_ad_rgb" in report.stdout
    )
    assert (
        "Traceback" not in report.stdout + report.stderr
        and report.stdout.splitlines()[-1] == "4 problems"
    )


@pytest.mark.parametrize(
    "code, text, advice",
    [
        ("import os; os.abort()", "ended by SIGABRT", llvm.VARIABLE),
        ("print('brightness', 1.7)", "but 2.000 is right", "report"),
        ("raise ValueError('no such thing')", "cannot be rendered", "ValueError: no such thing"),
        ("print('brightness', 1.98)", "brightness 1.980", None),
        (r"print('brightness', 1.98, '\n\x1b[0m')", "brightness 1.980", None),
    ],
)
def test_what_a_render_may_come_to(monkeypatch, code, text, advice):
    monkeypatch.setattr(doctor, "_PROBE", code)
    found, said = doctor.probe("llvm_ad_rgb", "bdpm")
    assert text in found and (said is None if advice is None else advice in said)


def test_report_counts_what_is_wrong(monkeypatch, capsys):
    findings = [
        doctor.Finding("a", "fine"),
        doctor.Finding("b", "odd", "ignore it", fatal=False),
        doctor.Finding("c", "broken", "mend it"),
    ]
    monkeypatch.setattr(doctor, "CHECKS", (lambda: findings,))
    assert doctor.main() == 1
    assert capsys.readouterr().out.splitlines()[-1] == "1 problem"
    monkeypatch.setattr(doctor, "CHECKS", (lambda: findings[:2],))
    assert doctor.main() == 0


@pytest.mark.parametrize(
    "version, ranges, good",
    [
        ("3.9.1", ">=3.9.1,<3.10", True),
        ("3.10.0", ">=3.9.1,<3.10", False),
        ("3.9", ">=3.9.1,<3.10", False),
        ("15.0", ">=13,<16", True),
        ("1.5.0.post1", ">=1.5.0,<1.6", True),
        ("16.0", ">=13,<16", False),
    ],
)
def test_versions_are_compared_as_numbers(version, ranges, good):
    assert doctor._satisfies(version, ranges) is good


def test_wrong_versions_are_named(monkeypatch):
    monkeypatch.setattr(
        doctor, "_requirements", lambda: ["numpy>=1,<1.2", "no-such-distribution>=3"]
    )
    advice = {finding.name: finding.advice for finding in doctor.versions()}
    assert (
        advice["numpy"] == "pip install 'numpy>=1,<1.2'"
        and "no-such-distribution>=3" in advice["no-such-distribution"]
    )


def test_usage():
    wrong = subprocess.run(
        [sys.executable, "-m", "mis_integrators", "cure"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=100,
    )
    assert wrong.returncode == 2 and "doctor" in wrong.stderr
