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
    """Camera paths through a `sensor`: path i is the one of number `index[i]` in the sequence of
    `pixel[i]` (uint32, one a path; a pixel that the film does not have: no path).

    `integrator`: what moves rays on behind emitters that are hidden (None: none are); `sequence`:
    their random numbers (a `SampleSequence`); `wavelength_sample`: in [0, 1), makes the wavelengths
    that all paths share.
    """

    sensor: Any
    integrator: Any
    sequence: Any
    pixel: Array
    index: Array
    wavelength_sample: Array

    @property
    def numbers(self):
        """The paths' random numbers (`PathNumbers`)."""
        return self.sequence.of_members(self.pixel, self.index)
