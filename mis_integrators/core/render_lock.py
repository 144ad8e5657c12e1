"""Renders in several Python threads take turns, iteration by iteration: an iteration keeps all
processors busy by itself, and films, recordings and Python's garbage collector are shared by all
threads.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar

RENDER_LOCK = threading.RLock()
"""Whoever renders or develops holds it."""

Method = TypeVar("Method", bound=Callable[..., Any])


def under_render_lock(method: Method) -> Method:
    """The function, run by one thread at a time among all those that are so decorated."""

    @functools.wraps(method)
    def alone(*arguments: Any, **options: Any) -> Any:
        with RENDER_LOCK:
            return method(*arguments, **options)

    return alone  # type: ignore[return-value]
