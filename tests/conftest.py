"""What all tests share."""

import ctypes
import importlib
import sys
from collections import Counter
from pathlib import Path

import mis_integrators  # noqa: F401  before mitsuba: it chooses the LLVM

import drjit
import mitsuba as mi
import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
LEFT_OUT = "extended", "long", "full"
"""Markers of what the default run leaves out."""
MOST_LANES = 4
"""Numbers that a kernel computes at once, in tests: the fewest that Embree has."""
VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb")


@pytest.fixture(params=VARIANTS)
def variant(request) -> str:
    """Every variant in turn, active during the test; a variant that this machine cannot run is
    skipped."""
    return _activate(request.param)


@pytest.fixture
def rgb() -> str:
    """The variant ``llvm_ad_rgb``, active during the test."""
    return _activate("llvm_ad_rgb")


@pytest.fixture
def module(monkeypatch, rgb):
    """Imports a module of the benchmarks."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if str(BENCHMARKS) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def _activate(variant: str) -> str:
    if variant.startswith("cuda_"):
        try:
            mi.set_variant(variant)
        except ImportError as error:
            pytest.skip(f"no CUDA here: {error}")
    mi.set_variant(variant)
    return variant


@pytest.fixture(scope="session", autouse=True)
def narrow_vectors():
    """Kernels are at most `MOST_LANES` wide: where there are wider vectors, they compile in less
    time then (0.6 of that of eight), and small images take little more. (Nothing happens without
    LLVM, or where a version of Dr.Jit does not have these functions of its C interface.) Returns
    the width of this machine, and a function that sets another."""
    try:
        mi.set_variant("llvm_ad_rgb")
        library = ctypes.CDLL(str(next(Path(drjit.__file__).parent.glob("libdrjit-core.*"))))
        width, cpu, features, set_target = (
            getattr(library, name)
            for name in (
                "_Z21jit_llvm_vector_widthv",
                "_Z19jit_llvm_target_cpuv",
                "_Z24jit_llvm_target_featuresv",
                "_Z19jit_llvm_set_targetPKcS0_j",
            )
        )
    except (ImportError, OSError, AttributeError, StopIteration):
        return MOST_LANES, lambda lanes: None
    cpu.restype = features.restype = ctypes.c_char_p
    usual = width()

    def narrow(lanes):
        if usual > MOST_LANES:
            set_target(cpu(), features(), lanes)

    narrow(MOST_LANES)
    return usual, narrow


@pytest.fixture(scope="module")
def usual_vectors(narrow_vectors):
    """Kernels are as wide as those of other processes, with whose images a module compares its own:
    else rounding would send a path in a thousand elsewhere."""
    usual, narrow = narrow_vectors
    narrow(usual)
    yield
    narrow(MOST_LANES)


def pytest_addoption(parser):
    parser.addoption(
        "--vectors",
        metavar="DIR",
        help="folder with test vectors (optimal_weights.json, shifts.json, resampling.json), "
        "used instead of generated worlds",
    )
    parser.addoption(
        "--maps",
        metavar="DIR",
        default="out/ci",
        help="where variance maps are left (default: out/ci)",
    )
    parser.addoption(
        "--record-variances",
        action="store_true",
        help="take the variances found for those to be kept (variance_guard.json)",
    )


def pytest_configure(config):
    config.addinivalue_line(
        "markers",
        "strategies(*K): the numbers of strategies of the discrete worlds that a test is for",
    )
    config.addinivalue_line(
        "markers",
        "thinned(inner, n, m=n): of a product of parameters, the last of which has `inner` values, "
        "every n-th case in diagonals; the rest is full. Where m is given, a multiple of n, only "
        "every m-th diagonal is in the default run, and the others are extended",
    )
    config.addinivalue_line(
        "markers",
        "extended: more cases of the same kind, an hour of them; left out unless asked for, as "
        "`make test-all` does (-m 'not full')",
    )
    config.addinivalue_line(
        "markers",
        "long: takes ten seconds and more with no kernel in the cache; left out unless asked for, "
        "as `make test-long` does (-m 'long and not extended and not full')",
    )
    config.addinivalue_line(
        "markers",
        "full: the full product of cases, hours of it; left out unless asked for with -m full",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    places = Counter()
    for item in items:
        thinned = item.get_closest_marker("thinned")
        if thinned:
            inner, keep, *by_default = thinned.args
            row, column = divmod(places[item.function], inner)
            places[item.function] += 1
            if (row + column) % keep:
                item.add_marker("full")
            elif by_default and (row + column) % by_default[0]:
                item.add_marker("extended")
    if config.option.markexpr:
        return
    left_out = [item for item in items if any(map(item.get_closest_marker, LEFT_OUT))]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if not any(map(item.get_closest_marker, LEFT_OUT))]
