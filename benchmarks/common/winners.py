"""Which method has the least error in a scene, and which cannot be told apart from it, by the rows
of `compare`."""

from __future__ import annotations

from collections.abc import Sequence

from mis_integrators.analysis.confidence import ratio_interval
from mis_integrators.analysis.stability import CLOSE

import numpy as np

from common.rows import Row

LATE = 1.15
"""Times the usual seconds, beyond which a render is not one of equal time."""


def told_apart(row: Row, better: Row) -> bool:
    """Whether a method's error (relMSE without the worst 0.1 %) is beyond the noise above that of a
    better one: by pairs of seeds, 95 %."""
    mine, other = (
        [float(value) for value in one["trimmed by seed"].split()] for one in (row, better)
    )
    return ratio_interval(mine, other).low > 1


def too_late(row: Row, rows: Sequence[Row]) -> bool:
    """Whether the single iteration of a method took longer than others' renders of the scene: its
    error is not one at equal time."""
    return row["iterations"] <= 1 and row["seconds"] > LATE * float(
        np.median([other["seconds"] for other in rows])
    )


def winner(rows: Sequence[Row]) -> Row:
    """The least error of those of one scene that kept to the time."""
    return min(
        (row for row in rows if not too_late(row, rows)), key=lambda row: row["trimmed ratio"]
    )


def winners(rows: list[Row]) -> list[Row]:
    """One row a scene: its least error, in ratios to the base, and the methods that are about as
    good or cannot be told apart."""
    found: list[Row] = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        best = winner(mine)
        close = [
            row["method"]
            for row in mine
            if row is not best
            and not too_late(row, mine)
            and (row["trimmed ratio"] <= CLOSE * best["trimmed ratio"] or not told_apart(row, best))
        ]
        found.append(
            {
                "scene": scene,
                "best": best["method"],
                "error over path's": best["trimmed ratio"],
                "about as good": ", ".join(close) or "-",
            }
        )
    return found
