"""Equal time for several renderings in one process: they take turns in short slices, so that what
else the machine does hits all alike."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mis_integrators.core.clock import compile_seconds, watched_kernels
from mis_integrators.core.session import Session

import drjit as dr
import numpy as np

from common.references import COLOURS

SLICE_SECONDS = 0.5


@dataclass(frozen=True)
class Snapshot:
    """The picture after some rendering time."""

    seconds: float
    iterations: int
    samples_per_pixel: int
    whole: np.ndarray
    """All channels, (H, W, C)."""
    channels: list[str]
    """Their names."""

    @functools.cached_property
    def image(self) -> np.ndarray:
        """Colours, (H, W, 3)."""
        return self.whole[..., [self.channels.index(name) for name in COLOURS]]


@dataclass
class Contender:
    """One rendering in progress, and the time that it has used; compiling kernels is counted
    apart."""

    label: str
    session: Session
    seconds: list[float] = field(default_factory=list)
    """Rendering seconds of each iteration."""
    setting_up: float = 0.0
    """Seconds that went before the first iteration."""
    compiling: float = 0.0
    usual: float | None = None
    """Seconds of an iteration, if known before: the first one of this rendering, with its pilots,
    does not tell."""
    observe: Callable[[list[dict], float], None] | None = None
    """Called after each iteration with its kernels (as in Dr.Jit's kernel history) and its
    seconds."""
    marks: list[float] = field(default_factory=list)
    """Rendering seconds, ascending, after which a snapshot is wanted."""
    snapshots: list[Snapshot] = field(default_factory=list)

    @classmethod
    def begin(
        cls,
        label: str,
        make: Callable[[int], Session],
        seed: int,
        marks: Sequence[float] = (),
        usual: float | None = None,
    ) -> Contender:
        """Make a session; the time that it takes counts, but for what compiles."""
        session, seconds, compiling, _ = timed(lambda: make(seed))
        return cls(
            label,
            session,
            setting_up=seconds - compiling,
            compiling=compiling,
            usual=usual,
            marks=list(marks),
        )

    @property
    def rendering(self) -> float:
        """Seconds used so far."""
        return self.setting_up + sum(self.seconds)

    @property
    def first(self) -> float:
        """Seconds until the first iteration was done: preparation, a pilot, recording, the
        iteration."""
        return self.setting_up + self.seconds[0]

    def iterate(self) -> None:
        """Run one iteration against this rendering's own clock."""
        _, seconds, compiling, kernels = timed(self.session.iterate)
        self.compiling += compiling
        self.seconds.append(seconds - compiling)
        if self.observe:
            self.observe(kernels, seconds)
        if self.marks and self.rendering >= self.marks[0]:
            self.marks = [mark for mark in self.marks if mark > self.rendering]
            self.take_snapshot()

    def take_snapshot(self) -> None:
        """Keep the picture as it is now; the time that it takes does not count."""
        session = self.session
        samples = session.iterations * session.camera_paths
        self.snapshots.append(
            Snapshot(self.rendering, session.iterations, samples, session.image(), session.channels)
        )

    def wants(self, seconds: float, spp: int | None = None) -> bool:
        """Whether one more iteration brings the time used closer to ``seconds``, or is needed for
        ``spp`` samples per pixel."""
        if spp:
            return self.session.iterations * self.session.camera_paths < spp
        if not self.seconds:
            return True
        next_one = (
            self.usual if len(self.seconds) == 1 and self.usual is not None else self.seconds[-1]
        )
        return self.rendering + 0.5 * next_one < seconds


def timed(work: Callable[[], Any]) -> tuple[Any, float, float, list[dict]]:
    """What `work` returns, its seconds, those of them that went into compiling, and its kernels (as
    in Dr.Jit's kernel history)."""
    with watched_kernels() as kernels:
        start = time.perf_counter()
        result = work()
        seconds = time.perf_counter() - start
    return result, seconds, min(seconds, compile_seconds(kernels)), kernels


def take_turns(
    contenders: Sequence[Contender],
    seconds: float,
    tell: Callable[[str], None] = lambda text: None,
    spp: int | None = None,
) -> None:
    """Let each contender use ``seconds`` of rendering time, or take ``spp`` samples per pixel, in
    slices, in an order that rotates."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        turn = 0
        while unfinished := [c for c in contenders if c.wants(seconds, spp)]:
            turn += 1
            shift = turn % len(unfinished)
            for contender in unfinished[shift:] + unfinished[:shift]:
                end = contender.rendering + SLICE_SECONDS
                while contender.rendering < end and contender.wants(seconds, spp):
                    contender.iterate()
            tell(f"{min(c.rendering for c in contenders):.1f} of {seconds:g} s each")


def processor_seconds(
    sessions: Mapping[str, Session], iterations: int, skipped: int
) -> dict[str, float]:
    """Median processor time of an iteration of each session, without the first ``skipped`` of so
    many, for which kernels may be compiled. The sessions take turns."""
    seconds: dict[str, list[float]] = {label: [] for label in sessions}
    for _ in range(iterations):
        for label, session in sessions.items():
            start = time.process_time()
            session.iterate()
            seconds[label].append(time.process_time() - start)
    return {label: float(np.median(times[skipped:])) for label, times in seconds.items()}
