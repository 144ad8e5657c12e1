"""What all tests share."""

import mis_integrators  # noqa: F401  before mitsuba: it chooses the LLVM

import mitsuba as mi
import pytest

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb")


@pytest.fixture(params=VARIANTS)
def variant(request) -> str:
    """Every variant in turn, active during the test; a variant that this machine cannot run is skipped."""
    return _activate(request.param)


@pytest.fixture
def rgb() -> str:
    """The variant ``llvm_ad_rgb``, active during the test."""
    return _activate("llvm_ad_rgb")


def _activate(variant: str) -> str:
    if variant.startswith("cuda_"):
        try:
            mi.set_variant(variant)
        except ImportError as error:
            pytest.skip(f"no CUDA here: {error}")
    mi.set_variant(variant)
    return variant


def pytest_addoption(parser):
    parser.addoption("--vectors", metavar="DIR", help="folder with test vectors (optimal_weights.json, shifts.json), used instead of generated worlds")


def pytest_configure(config):
    config.addinivalue_line("markers", "strategies(*K): the numbers of strategies of the discrete worlds that a test is for")
    config.addinivalue_line("markers", "full: the full product of cases, hours of it; left out unless asked for with -m full")


def pytest_collection_modifyitems(config, items):
    if config.option.markexpr:
        return
    left_out = [item for item in items if item.get_closest_marker("full")]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if not item.get_closest_marker("full")]
