"""What a pilot must know of a render, and the pixels that it takes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .bias import LEAST_BIAS, LEAST_CORRECTED, LEAST_DEEPER
from .denoiser import GROUPS

PILOT_PATHS = 4096
"""Tuned: camera paths of a pilot's iteration, about."""
PILOT_LIGHT_PATHS = 1 << 17
"""Light sub-paths of a pilot's iteration at most: what more of them would tell follows from
these."""
MOST_CAMERA_PATHS = 16
"""Camera paths of a pixel: more of them change little of an iteration's noise, which is then that
of photons."""
NEIGHBOURS = 16
"""Tuned: pilot pixels that are expected to look alike."""
LIGHT_SHARES = tuple(2.0**-k for k in range(6))
"""Of the light sub-paths, what an iteration may do with. (1/16 and 1/32 differ little in error.)"""
FEWEST_LIGHT_PATHS = 1 << 12
"""Tuned: light sub-paths that a share leaves at least, and a pilot has: fewer take no less
time."""
UNPLANNED_ITERATIONS = 64
"""Tuned: iterations that a render without a planned end is taken to have."""
APART = 2
"""Pixels from one to another that a denoiser averages, and which do not share the photons of disks
as small as a pixel."""


@dataclass(frozen=True)
class PilotSetting:
    """What a pilot must know of the render that it is for."""

    width: int
    """Pixels in a row of the film."""
    pixels: int
    """Of the film."""
    extent: float
    """Diagonal of the scene's bounding box."""
    kinds: tuple[str, ...]
    """Of photons that are gathered apart: `seen_caustic`, `caustic`, `indirect`, `volume`."""
    at_first_vertex: bool
    """Whether photons are gathered at the first smooth vertex, which the camera sees."""
    passes_lobes: bool
    """Whether camera paths pass narrow lobes before that, so that they make noise, too."""
    camera_paths: int
    """Camera paths a pixel and iteration."""
    iterations: int | None
    """Iterations planned, if their number is."""
    seconds: float | None
    """Seconds planned, if those are."""
    light_paths: float = 1.0
    """Light sub-paths of an iteration over those of one of the pilot's."""
    denoised: bool = False
    """Whether the errors that count are those that a denoiser leaves (see `denoiser`)."""
    light_shares: tuple[float, ...] = (1.0,)
    """To choose from: the share of its light sub-paths that an iteration has."""
    volume_dimensions: int = 2
    """Of what volume photons are found in: disks across beams, or balls."""
    joins_sensor: bool = False
    """Whether photons are joined with the sensor, too."""
    filter_share: float = 1.0
    """What the film's reconstruction filter leaves of noise that is independent from pixel to
    pixel, where no denoiser does. (A pilot's pixels are boxes.)"""

    def dimensions(self, kind: str) -> int:
        """Power of the radius with which the number of photons grows."""
        return self.volume_dimensions if kind == "volume" else 2

    @property
    def planned_iterations(self) -> int:
        """A usual number where none is planned."""
        return self.iterations or UNPLANNED_ITERATIONS

    def corrects(self, kind: str) -> bool:
        """Whether the render corrects estimates at edges."""
        return corrects(kind, self.at_first_vertex)

    def least_bias(self, kind: str) -> float:
        """The squared bias that the laws of a kind begin at, see `bias.LEAST_BIAS`."""
        if kind != "indirect":
            return LEAST_BIAS
        return LEAST_CORRECTED if self.at_first_vertex else LEAST_DEEPER


def corrects(kind: str, at_first_vertex: bool) -> bool:
    """Whether estimates from photons of a kind are corrected at edges. Caustics have edges of their
    own; only the smooth indirect light gains from knowing the surfaces' edges, and only where the
    camera sees the vertices: deeper ones are spread over the scene, and their blur averages
    out."""
    return kind == "indirect" and at_first_vertex


def pilot_light_paths(count: int) -> int:
    """Light sub-paths of a pilot's iteration for a render with so many: half of them, if these are
    not too few or too many."""
    return min(max(count // 2, FEWEST_LIGHT_PATHS), PILOT_LIGHT_PATHS, count)


def light_shares(count: int) -> tuple[float, ...]:
    """The `LIGHT_SHARES` of so many light sub-paths that an iteration may do with."""
    return tuple(
        share for share in LIGHT_SHARES if share == 1 or share * count >= FEWEST_LIGHT_PATHS
    )


@dataclass(frozen=True)
class PilotPixels:
    """The pixels that a pilot renders: numbers 0, stride, 2 stride, ... of the film's."""

    stride: int
    count: int
    camera_paths: int
    """Camera paths through each of them, in one iteration of the pilot: in each group as many as in
    the render, up to `MOST_CAMERA_PATHS`."""
    groups: int = 1
    """Of camera paths: more than one where a pilot tells shared noise from other."""
    apart: int = 0
    """How many pixels beyond those of the first group the next one's are."""

    @property
    def paths(self) -> int:
        """Camera paths in one iteration of the pilot."""
        return self.count * self.camera_paths

    def places(self, path: Any) -> tuple[Any, Any]:
        """The pixels of paths (an array of their numbers: one through each pixel, then the second
        ones, ...), and which paths of these they are."""
        index = path // self.count
        return (path - index * self.count) * self.stride, index


def pilot_pixels(setting: PilotSetting) -> PilotPixels:
    """The `PilotPixels`, spread over the film and not in columns."""
    groups = GROUPS if setting.denoised else 1
    camera_paths = min(setting.camera_paths, MOST_CAMERA_PATHS) * groups
    stride = max(setting.pixels * camera_paths // PILOT_PATHS, 1)
    while math.gcd(stride, setting.width) > 1:
        stride += 1
    apart = min(APART, setting.pixels - 1) if groups > 1 else 0
    count = -(-(setting.pixels - apart) // stride)
    return PilotPixels(stride, count, camera_paths, groups, apart)


def neighbourhoods(width: int, pixels: PilotPixels) -> np.ndarray:
    """Numbers of the square cells of a film of this `width`, from 0, in which the pilot's pixels
    lie, `NEIGHBOURS` in each: (pixels,)."""
    side = math.sqrt(NEIGHBOURS * pixels.stride)
    row, column = np.divmod(np.arange(pixels.count) * pixels.stride, width)
    cells = (row // side) * math.ceil(width / side) + column // side
    return np.unique(cells, return_inverse=True)[1]
