"""Renders in several Python threads take turns, iteration by iteration: an iteration keeps all
processors busy by itself, and films, recordings and Python's garbage collector are shared by all
threads.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import drjit as dr

_LOCK = threading.RLock()


@contextlib.contextmanager
def render_lock() -> Iterator[None]:
    """Who sets up, renders or develops holds it: nothing of a session may touch Dr.Jit without.

    A call of a recorded function holds Dr.Jit's lock while it runs Python; a thread that got
    Python's lock meanwhile and asked for an array would wait for ever. And kernels wait for those
    of their own thread alone, so those of a thread are done before the next has its turn: it may
    read or reuse their memory.
    """
    with _LOCK:
        try:
            yield
        finally:
            dr.sync_thread()


Method = TypeVar("Method", bound=Callable[..., Any])


def under_render_lock(method: Method) -> Method:
    """The function, run by one thread at a time among all those that are so decorated."""

    @functools.wraps(method)
    def alone(*arguments: Any, **options: Any) -> Any:
        with render_lock():
            return method(*arguments, **options)

    return alone  # type: ignore[return-value]
