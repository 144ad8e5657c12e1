"""The program ``mis-render``: a module of its own, so that signals are heeded before anything large
is imported.

Importing the package imports Mitsuba and Dr.Jit, which takes half a second or more; a Ctrl-C
meanwhile would be a traceback of theirs.
"""

from __future__ import annotations

import os
import signal

SIGNALS = signal.SIGINT, signal.SIGTERM
EXIT_INTERRUPTED = 130
"""As of ``mis_integrators.app.cli``."""


def main(arguments: list[str] | None = None) -> int:
    """Run ``mis-render`` with the arguments (default: those of the process) and return its exit
    code."""
    for number in SIGNALS:
        signal.signal(number, _stop)
    from mis_integrators.app import cli

    try:
        return cli.main(arguments)
    finally:
        # All is done and said; what is left is the end of the process.
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _stop(*_: object) -> None:
    """End the process at once, from wherever it is: there is nothing to save yet."""
    os.write(2, b"mis-render: interrupted, nothing written\n")
    os._exit(EXIT_INTERRUPTED)
