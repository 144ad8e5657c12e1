"""What an installation consists of, and what is wrong with it: ``python -m mis_integrators
doctor``.

Whatever may abort a process (an LLVM that is too old, a driver) is tried in a process of its own.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .. import llvm

TESTED = ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb")
"""Variants that are tried: those that the package is tested with."""
LEAST_MEMORY = 2.0
"""Gibibytes that a render of a megapixel wants."""
LEAST_CACHE = 0.5
"""Gibibytes that the cache of compiled kernels wants."""

# A closed box of reflectance 1/2 whose walls glow with radiance 1: with all bounces every pixel is
# 1 / (1 - 1/2) = 2.
_PROBE = """
import sys
import mis_integrators, mitsuba as mi, numpy as np
mi.set_variant(sys.argv[1])
scene = mi.load_dict({"type": "scene",
    "sensor": {"type": "perspective",
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb"}},
    "box": {"type": "sphere", "radius": 3.0, "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
            "light": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}}})
integrator = mi.load_dict({"type": sys.argv[2], "rr_depth": 1000, "max_depth": 12})
print("brightness", float(np.mean(np.array(integrator.render(scene, spp=64, seed=1)))))
"""
_EXPECTED = 2 - 2.0**-11
_TOLERANCE = 0.05
"""Of the probe's brightness; its standard deviation is 1 %."""


@dataclass(frozen=True)
class Finding:
    """A line of the report; ``advice`` (what to do) if there is something wrong, and whether that
    keeps the package from working."""

    name: str
    text: str
    advice: str | None = None
    fatal: bool = True


def main() -> int:
    """Print the report; returns 0 if images can be rendered, 1 if not."""
    problems = 0
    for check in CHECKS:
        for finding in check():
            mark = "ok " if finding.advice is None else "BAD" if finding.fatal else "-- "
            print(f"{mark} {finding.name:<10} {finding.text}", flush=True)
            if finding.advice:
                print(f"               {'to do' if finding.fatal else 'hint'}: {finding.advice}")
                problems += finding.fatal
    print(f"{problems} problem{'s' * (problems != 1)}" if problems else "all is well")
    return 1 if problems else 0


def versions() -> list[Finding]:
    """Python, the package, and what it depends on, against the versions that it asks for."""
    findings = [
        Finding(
            "python", f"{platform.python_version()} ({sys.executable}) on {platform.platform()}"
        )
    ]
    for requirement in _requirements():
        name, ranges = re.findall(r"^([\w.-]+)\s*(.*)$", requirement.split(";")[0].strip())[0]
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            findings.append(Finding(name, "is not installed", f"pip install '{name}{ranges}'"))
            continue
        advice = None if _satisfies(version, ranges) else f"pip install '{name}{ranges}'"
        findings.append(
            Finding(
                name, f"{version}{'' if advice is None else f', but {ranges} is needed'}", advice
            )
        )
    for name, extra in (
        ("distributed", "cluster"),
        ("matplotlib", "bench"),
        ("mitsuba-oidn", "denoise"),
    ):
        try:
            findings.append(Finding(name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            findings.append(
                Finding(
                    name,
                    "is not installed",
                    f"pip install 'mis-integrators[{extra}]' where it is wanted",
                    fatal=False,
                )
            )
    return findings


def compiler() -> list[Finding]:
    """Which LLVM, and why that."""
    import drjit as dr

    named = os.environ.get(llvm.VARIABLE)
    tested = f"{llvm.OLDEST_WORKING} to {llvm.NEWEST_TESTED}"
    why = f"named by {llvm.VARIABLE}"
    if llvm.chosen:
        why = (
            f"the newest on this system of those tested ({tested})"
            if llvm.is_tested(llvm.chosen)
            else f"as there is none of those tested ({tested})"
        )
    version = ".".join(map(str, dr.detail.llvm_version()))
    text = f"{version} from {named}, {why}" if named else f"{version}, which Dr.Jit found by itself"
    problem = llvm.problem()
    return [Finding("LLVM", text if problem is None else f"{named or 'none'}", problem)]


def machine() -> list[Finding]:
    """Threads, memory, room for compiled kernels."""
    import drjit as dr

    processors = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    findings = [
        Finding(
            "threads",
            f"{dr.thread_count()} of Dr.Jit, {processors} processors that this process may use",
        )
    ]
    memory = _memory()
    if memory is not None:
        small = memory < LEAST_MEMORY
        findings.append(
            Finding(
                "memory",
                f"{memory:.1f} GiB free",
                "close other programs, or render smaller films" if small else None,
                fatal=False,
            )
        )
    cache = Path.home() / ".drjit"
    room = shutil.disk_usage(cache if cache.exists() else Path.home()).free / 2**30
    writable = os.access(cache if cache.exists() else Path.home(), os.W_OK)
    advice = None
    if not writable or room < LEAST_CACHE:
        advice = (
            f"make {cache} writable, with {LEAST_CACHE} GiB of room; else all kernels are "
            "compiled anew"
        )
    findings.append(
        Finding(
            "cache",
            f"{cache}, {room:.1f} GiB free{'' if writable else ', not writable'}",
            advice,
            fatal=False,
        )
    )
    return findings


def variants() -> list[Finding]:
    """A tiny picture of known brightness in each variant, each in a process of its own."""
    import mitsuba as mi

    findings = []
    for variant in TESTED:
        if variant not in mi.variants():
            findings.append(
                Finding(
                    variant, "is not in this build of Mitsuba", "use another variant", fatal=False
                )
            )
            continue
        if variant.startswith("llvm_") and llvm.problem():
            findings.append(Finding(variant, "is not tried without LLVM", "see LLVM above"))
            continue
        text, advice = probe(variant, "bdpm" if variant == TESTED[0] else "path")
        optional = variant.startswith("cuda_")
        if advice and optional:
            advice = "none is needed; for a GPU install NVIDIA's driver"
        findings.append(Finding(variant, text, advice, fatal=not optional))
    return findings


def probe(variant: str, plugin: str) -> tuple[str, str | None]:
    """What became of the tiny render, and what to do if it is wrong."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, variant, plugin],
            capture_output=True,
            text=True,
            timeout=300,
        )
    except subprocess.TimeoutExpired:
        return (
            "rendering a tiny picture took more than 300 s",
            "look for other programs that keep the machine busy",
        )
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        return (
            f"rendering a tiny picture ended by {name}",
            f"name another LLVM with {llvm.VARIABLE}; its last words: {_last_line(done.stderr)}",
        )
    if done.returncode:
        return "a tiny picture cannot be rendered", _last_line(done.stderr)
    # Libraries may end what they print with an escape sequence for the terminal's colours.
    brightness = float(done.stdout.split("brightness")[1].split()[0])
    text = f"renders: a tiny picture with {plugin} has the brightness {brightness:.3f}"
    if abs(brightness - _EXPECTED) > _TOLERANCE * _EXPECTED:
        return (
            f"{text}, but {_EXPECTED:.3f} is right",
            f"name another LLVM with {llvm.VARIABLE}, and report this",
        )
    return text, None


CHECKS: tuple[Callable[[], list[Finding]], ...] = (versions, compiler, machine, variants)


def _requirements() -> list[str]:
    """What the installed package asks for; of a checkout that is not installed, what its
    ``pyproject.toml`` does."""
    try:
        return [r for r in importlib.metadata.requires("mis-integrators") or [] if "extra" not in r]
    except importlib.metadata.PackageNotFoundError:
        text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
        return re.findall(
            r'"([^"]+)"',
            re.findall(r"^dependencies = \[(.*?)\]", text, re.MULTILINE | re.DOTALL)[0],
        )


def _satisfies(version: str, ranges: str) -> bool:
    """Whether a version is in ranges such as ``>=1.5.0,<1.6``."""

    def key(text: str) -> tuple[int, ...]:
        numbers = [int(part) for part in re.findall(r"^[\d.]*\d", text)[0].split(".")]
        return tuple(numbers + [0] * (4 - len(numbers)))

    tests = {
        ">=": lambda a, b: a >= b,
        "<": lambda a, b: a < b,
        "<=": lambda a, b: a <= b,
        ">": lambda a, b: a > b,
        "==": lambda a, b: a == b,
    }
    return all(
        tests[sign](key(version), key(bound))
        for sign, bound in re.findall(r"(>=|<=|==|<|>)\s*([\d.]+)", ranges)
    )


def _memory() -> float | None:
    """Gibibytes that are free, under the limit of a container if there is one; ``None`` where the
    system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    free = next(float(line.split()[1]) / 2**20 for line in lines if line.startswith("MemAvailable"))
    try:
        limit, used = (
            Path("/sys/fs/cgroup", name).read_text() for name in ("memory.max", "memory.current")
        )
        return min(free, (int(limit) - int(used)) / 2**30)
    except (OSError, ValueError):
        return free


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "none"
