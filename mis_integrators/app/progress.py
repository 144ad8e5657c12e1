"""Show the progress of a render: a bar on a terminal, now and then a line elsewhere."""

import contextlib
import math
import os
import sys
import time
from collections.abc import Callable, Iterator

import rich.console
import rich.progress

SECONDS_BETWEEN_LINES = 5.0


class Progress:
    """Progress on standard error as a context: iterations, camera paths a second, time left.

    ``paths`` tells the camera paths of one iteration, which the first one may decide. ``planned``
    iterations or ``seconds`` of rendering, whichever is given, are the whole; with neither, only
    what ``update`` is told. Nothing is shown if ``quiet``.
    """

    def __init__(
        self, paths: Callable[[], int], planned: int | None, seconds: float | None, quiet: bool
    ):
        self._paths, self._planned, self._seconds, self._quiet = paths, planned, seconds, quiet
        self._last_line = time.monotonic()
        self._console = rich.console.Console(file=sys.stderr, quiet=quiet, highlight=False)
        self._bar = rich.progress.Progress(
            rich.progress.BarColumn(),
            rich.progress.TextColumn("{task.description}"),
            console=self._console,
            disable=quiet or not self._console.is_terminal,
        )

    def __enter__(self) -> "Progress":
        with _nobody_may_listen():
            self._bar.start()
        self._task = self._bar.add_task("first iteration, compiling", total=1.0)
        return self

    def __exit__(self, *_: object) -> None:
        with _nobody_may_listen():
            self._bar.stop()

    def say(self, text: str) -> None:
        """Print one line."""
        with _nobody_may_listen():
            self._console.print(text, soft_wrap=True, markup=False)

    def warn(self, text: str) -> None:
        """Print one line, even if all else is to be quiet."""
        complain(text)

    def update(
        self,
        iterations: int,
        rendering: float,
        share: float | None = None,
        error: float = math.inf,
    ) -> None:
        """Show that so many iterations are done, after so many seconds of rendering; ``share`` of
        the work, if that is known better than by those, is done. ``error``: the estimated relative
        error, infinite where there is no estimate."""
        done = max(
            rendering / self._seconds if self._seconds else 0.0,
            iterations / self._planned if self._planned else 0.0,
            share or 0.0,
        )
        left = (
            f"{_duration(max(0.0, rendering / done - rendering))} left"
            if done
            else "time left unknown"
        )
        speed = iterations * self._paths() / max(rendering, 1e-9) / 1e6
        of = "" if self._seconds or not self._planned else f"/{self._planned}"
        noise = f"relative error {error:.3g}, " if math.isfinite(error) else ""
        text = f"iteration {iterations}{of}, {speed:.2f} M samples/s, {noise}{left}"
        with _nobody_may_listen():
            self._bar.update(self._task, completed=min(done, 1.0), description=text)
        now = time.monotonic()
        if self._bar.disable and not self._quiet and now - self._last_line >= SECONDS_BETWEEN_LINES:
            self._last_line = now
            self.say(text)


def complain(text: str, who: str = "mis-render: ") -> None:
    """Print one line on standard error, if anybody reads it."""
    with _nobody_may_listen():
        print(f"{who}{text}", file=sys.stderr, flush=True)


def tell(*parts: object) -> None:
    """Print lines, or tables of rich, on standard error, if anybody reads them."""
    with _nobody_may_listen():
        console = rich.console.Console(file=sys.stderr, highlight=False)
        for part in parts:
            console.print(part, markup=False, soft_wrap=isinstance(part, str))


@contextlib.contextmanager
def _nobody_may_listen() -> Iterator[None]:
    """Standard error may be closed, or a pipe whose reader has gone (which ends the process, if
    rich has its way): a render goes on, without it."""
    try:
        yield
    except BlockingIOError:  # a slow reader
        pass
    except (OSError, ValueError, SystemExit):
        # What is still in Python's buffer would fail again at the end, with exit code 120.
        silent = contextlib.suppress(OSError, ValueError, AttributeError)  # none, or no file
        with silent, open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stderr.fileno())


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}"
