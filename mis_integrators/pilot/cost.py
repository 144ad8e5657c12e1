"""What an iteration costs, by its merge disks and camera paths. The unit is one iteration with one
camera path a pixel, and all light sub-paths, whose disks hold `USUAL_PHOTONS`."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Gathered = TypeVar("Gathered", float, np.ndarray)

GATHER_COST = 0.013
"""Tuned: cost of one gathered photon a vertex, in units of an iteration's light and camera passes
(0.006 to 0.018 on the bundled scenes)."""
PROBE_COST = 0.15
"""Tuned: cost of the probe rays of corrected estimates, in the same units (0.03 to 0.25)."""
CAMERA_SHARE = 0.45
"""Tuned: share of the same units that each camera path of a pixel takes, where there are as many
light sub-paths as pixels (`bdd=1`, seven bundled scenes and one from elsewhere: 0.32 to 0.56)."""
USUAL_PHOTONS = 10
"""Tuned: photons a gather at which an iteration counts as one planned iteration: larger gathers
must pay for themselves."""


def iteration_cost(
    gathered: Gathered, corrected: bool, camera_paths: int, light_share: float = 1.0
) -> Gathered:
    """Cost of an iteration that gathers so many photons a vertex, of plain or corrected estimates,
    with so many camera paths a pixel, and that share of the light sub-paths:
    (1 - s) share + N_B (s + g), s the `CAMERA_SHARE`."""
    gather = GATHER_COST * gathered + PROBE_COST * corrected
    passes = (1 - CAMERA_SHARE) * light_share + camera_paths * (CAMERA_SHARE + gather)
    return passes / (1 + GATHER_COST * USUAL_PHOTONS)
