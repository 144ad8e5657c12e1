"""What an iteration costs, by its merge disks and camera paths. The unit is one iteration with one
camera path a pixel whose disks hold `USUAL_PHOTONS`."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Gathered = TypeVar("Gathered", float, np.ndarray)

GATHER_COST = 0.013
"""Tuned: cost of one gathered photon a vertex, in units of an iteration's light and camera passes
(0.006 to 0.018 on the bundled scenes)."""
PROBE_COST = 0.15
"""Tuned: cost of the probe rays of corrected estimates, in the same units (0.03 to 0.25)."""
CAMERA_SHARE = 0.35
"""Tuned: share of the same units that each camera path of a pixel takes (0.1 to 0.5 on the bundled
scenes)."""
USUAL_PHOTONS = 10
"""Tuned: photons a gather at which an iteration counts as one planned iteration: larger gathers
must pay for themselves."""


def iteration_cost(gathered: Gathered, corrected: bool, camera_paths: int) -> Gathered:
    """Cost of an iteration that gathers so many photons a vertex, of plain or corrected estimates,
    with so many camera paths a pixel: 1 + g + (N_B - 1) (s + g), s the `CAMERA_SHARE`."""
    gather = GATHER_COST * gathered + PROBE_COST * corrected
    return (1 + gather + (camera_paths - 1) * (CAMERA_SHARE + gather)) / (
        1 + GATHER_COST * USUAL_PHOTONS
    )
