"""Plugins `pcbpt` and `bdpt_ris`: bidirectional path tracing with resampled connections."""

from __future__ import annotations

from .resampled import ResampledIntegrator


class PCBPT(ResampledIntegrator):
    """docs"""

    aware = False


class BDPTRIS(ResampledIntegrator):
    """docs"""
