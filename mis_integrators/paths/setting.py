"""What every pass of a render is given: the scene, how far paths go, and which paths a pass traces.

Passes are recorded (`core.recording`). `World` and `Limits` are made once by a session and stay as
they are; `LightPass` and `CameraPass` hold arrays that change, and are made inside the recorded
function from its arguments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Array = Any


@dataclass(frozen=True)
class World:
    """A `scene`, its `lights` (a `Lights`), and what it needs, `traits` (a `SceneTraits`)."""

    scene: Any
    lights: Any
    traits: Any


@dataclass(frozen=True)
class Limits:
    """How far paths go, and what they show.

    `max_depth`: segments of a whole path (negative: unlimited; 0: nothing is seen); `rr_depth`:
    segments from which Russian roulette may end a sub-path; `hide_emitters`: emitters met directly
    are left out.
    """

    max_depth: int
    rr_depth: int
    hide_emitters: bool = False


@dataclass(frozen=True)
class LightPass:
    """`count` light sub-paths, numbers `first`, `first` + 1, ... of an iteration.

    `sequence`: their random numbers (a `SampleSequence`); `wavelengths` that they share (empty in
    rgb and mono variants); `shutter_open`, `shutter_time`: when the shutter opens, and for how
    long; `first`: uint32 of width one.
    """

    sequence: Any
    count: int
    wavelengths: Array
    shutter_open: float = 0.0
    shutter_time: float = 0.0
    first: Array = 0


@dataclass(frozen=True)
class CameraPass:
    """`count` camera paths through a `sensor`: numbers `first`, `first + stride`, ... of
    `camera.film_samples`, where each pixel has `camera_paths`.

    `integrator`: what moves rays on behind emitters that are hidden (None: none are);
    `sequence`: their random numbers (a `SampleSequence`); `first`: uint32
    of width one, or one a path (see `camera.with_gaps`); `wavelength_sample`: in
    [0, 1), makes the wavelengths that all paths share.
    """

    sensor: Any
    integrator: Any
    sequence: Any
    first: Array
    count: int
    camera_paths: int
    wavelength_sample: Array
    stride: int = 1

    def pixels_and_numbers(self, path):
        """The pixel of each path, and its random numbers (`PathNumbers`)."""
        number = path * self.stride + self.first
        return number // self.camera_paths, self.sequence.of_paths(number)


@dataclass(frozen=True)
class ListedPass:
    """`count` camera paths through any pixels: path i is the one of number `index[i]` in the
    sequence of `pixel[i]` (uint32; a pixel that the film does not have: no path). All else as in
    `CameraPass`."""

    sensor: Any
    integrator: Any
    sequence: Any
    pixel: Array
    index: Array
    count: int
    wavelength_sample: Array

    def pixels_and_numbers(self, path):
        """As of `CameraPass`; the paths are those of all lanes."""
        return self.pixel, self.sequence.of_members(self.pixel, self.index)
