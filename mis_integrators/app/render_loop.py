"""The loop of a render: iterations until it is enough, and what is done between them."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ..core.clock import compiled_seconds
from ..core.session import Session
from .progress import Progress
from .target_error import TargetError


class Interrupt:
    """Ctrl-C, or SIGTERM: the first asks to stop after the current iteration; a second one, or one
    before any result, stops at once.
    """

    def __init__(self) -> None:
        self.requested = False
        self.have_result = False
        """Whether there are iterations enough for an image."""
        self.stopped = False
        """Whether an interrupt has stopped what was being done."""
        self.preview: Path | None = None
        """The latest preview that this render has written."""

    def __enter__(self) -> Interrupt:
        self._previous = {
            number: signal.signal(number, self._handle)
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        sys.unraisablehook = self._hook

    def _unraisable(self, dropped: sys.UnraisableHookArgs) -> None:
        """Says nothing of an interrupt that Python has to drop, within a callback of its own
        imports: ``stopped`` remembers it."""
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            self._hook(dropped)

    def _handle(self, *_: object) -> None:
        if self.requested or not self.have_result:
            self.stopped = True
            raise KeyboardInterrupt
        self.requested = True


class Clock:
    """Seconds spent on iterations, those on compiling kernels counted apart.

    Use it as a context, once an iteration, with ``JitFlag.KernelHistory`` set.
    """

    def __init__(self, rendering: float = 0.0, compiling: float = 0.0):
        self.rendering = rendering
        self.compiling = compiling

    def __enter__(self) -> None:
        self._compiled = compiled_seconds()
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        seconds = time.perf_counter() - self._start
        compiling = compiled_seconds() - self._compiled
        self.compiling += min(compiling, seconds)
        self.rendering += max(0.0, seconds - compiling)


class Chore:
    """Something to do every so many seconds between iterations. Where it fails with ``OSError``,
    the render goes on: the failure is said once, and it is tried again when its time comes.
    """

    def __init__(
        self, what: str, seconds: float, action: Callable[[], None], complain: Callable[[str], None]
    ):
        """``what``: what it does, as in "write FILE"."""
        self._what, self._seconds, self._action, self._complain = what, seconds, action, complain
        self._last = time.monotonic()
        self.failure: str | None = None
        """What went wrong the last time, or ``None``."""

    def when_due(self) -> None:
        """Do it if it is time."""
        if time.monotonic() - self._last >= self._seconds:
            self.now()

    def now(self) -> None:
        """Do it."""
        try:
            self._action()
            self.failure = None
        except OSError as error:
            failure = f"cannot {self._what}: {error.strerror or error}"
            if failure != self.failure:
                self._complain(failure)
            self.failure = failure
        self._last = time.monotonic()


def fewest_iterations(session: Session) -> int:
    """How many iterations the session's image needs: one, unless it shows their variance."""
    return getattr(session, "fewest_iterations", 1)


def seconds_of_next(session: Session, clock: Clock) -> float:
    """What the next iteration of a session that has some will take: what it has measured, but no
    more than the mean of those done, with all that went before them. If it has measured nothing,
    what went before counts as one more iteration."""
    measured = getattr(session, "seconds_of_next", math.inf)
    if measured == math.inf:
        return clock.rendering / (session.iterations + 1)
    return min(measured, clock.rendering / session.iterations)


def iterate(
    session: Session,
    planned: int | None,
    seconds: float | None,
    target: TargetError | None,
    clock: Clock,
    chores: Sequence[Chore],
    progress: Progress,
    interrupt: Interrupt,
) -> None:
    """Iterate until there are as many iterations as ``planned``, ``seconds`` of rendering have
    passed, or the error reaches its target, whichever is first of those that are given, or the user
    interrupts; but at least as many as an image needs. An iteration of which more than half would
    lie beyond the ``seconds``, by ``seconds_of_next``, is not begun. A session that has enough
    already is left as it is. Its remarks, if it has some, are said once. A session that only waits
    for others may return from ``iterate`` with nothing new.
    """

    def late(limit: float) -> bool:
        next_takes = seconds_of_next(session, clock)
        return next_takes > 0 and clock.rendering + next_takes / 2 >= limit

    def enough() -> bool:
        return (
            (planned is not None and session.iterations >= planned)
            or (seconds is not None and late(seconds))
            or (target is not None and target.reached(session))
        )

    remarked = False
    interrupt.have_result = session.iterations > 0
    while session.iterations < fewest_iterations(session) or not (enough() or interrupt.requested):
        with clock:
            session.iterate()
        interrupt.have_result = (
            session.iterations > 0
        )  # before a chore shows that there is something
        if interrupt.stopped:
            raise KeyboardInterrupt  # a library has dropped it
        if not session.iterations:
            continue
        if not remarked:
            remarked = True
            for remark in getattr(session, "remarks", []):
                progress.say(remark)
        progress.update(
            session.iterations,
            clock.rendering,
            target.share_done() if target else None,
            target.error if target else math.inf,
        )
        for chore in chores:
            chore.when_due()
