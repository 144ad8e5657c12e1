"""What a sweep of one parameter found."""

from __future__ import annotations

from dataclasses import dataclass

from mis_integrators.analysis.stability import Point

Points = dict[str, list[Point]]
"""A method's points, by its label, at the sweep's values."""


@dataclass(frozen=True)
class Swept:
    """A sweep's name, what it varies in words, and the points of each method."""

    name: str
    what: str
    points: Points
