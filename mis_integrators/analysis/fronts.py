"""The Pareto front of speed and accuracy."""

from __future__ import annotations

from collections.abc import Sequence


def pareto_front(seconds: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which points no other one beats: none is at least as fast and as accurate, and better in one
    of both."""
    points = list(zip(seconds, errors))
    return [not any(s <= t and e <= f and (s, e) != (t, f) for s, e in points) for t, f in points]
