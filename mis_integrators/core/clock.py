"""Time without what compiles kernels, by which a render is planned: its first minute would else
look like all that follow.

Dr.Jit keeps a history of kernels where ``JitFlag.KernelHistory`` is set, and empties it when it is
read. So it is read here only.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr

Kernels = list[dict[str, Any]]

_compiled = 0.0
_watching: list[Kernels] = []


def compile_seconds(kernels: Sequence[dict[str, Any]]) -> float:
    """Seconds that kernels of the history took to compile; next to none for those found in a
    cache."""
    return (
        sum(kernel.get("codegen_time", 0) + kernel.get("backend_time", 0) for kernel in kernels)
        / 1000
    )


def compiled_seconds() -> float:
    """Seconds that compiling has taken of the process so far, while the flag was set."""
    global _compiled
    found = dr.kernel_history()
    _compiled += compile_seconds(found)
    for kernels in _watching:
        kernels.extend(found)
    return _compiled


@contextmanager
def watched_kernels() -> Iterator[Kernels]:
    """All kernels that are launched within, once that has ended, if the flag is set."""
    compiled_seconds()
    _watching.append([])
    try:
        yield _watching[-1]
        compiled_seconds()
    finally:
        _watching.pop()


def now() -> float:
    """A clock [s] that stands still while kernels are compiled; without the flag it is
    `time.perf_counter`."""
    return time.perf_counter() - compiled_seconds()
