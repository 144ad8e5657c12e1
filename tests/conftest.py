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
