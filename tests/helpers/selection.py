"""Rows of a test that the default run leaves out, and `make test-all` runs."""

import pytest


def extended(*rows):
    """Values, or tuples of values, for ``parametrize``, marked as ``extended``: a list."""
    return [
        pytest.param(*(row if isinstance(row, tuple) else (row,)), marks=pytest.mark.extended)
        for row in rows
    ]


def one_in_each_row(rows, columns, usual=()):
    """All pairs for ``parametrize``: `usual` ones as they are; of each row besides one in the next
    column, as ``extended``; the others as ``full``."""
    pairs = []
    for number, row in enumerate(rows):
        for place, column in enumerate(columns):
            mark = pytest.mark.full if (place - number) % len(columns) else pytest.mark.extended
            pairs.append(pytest.param(row, column, marks=[] if (row, column) in usual else [mark]))
    return pairs


LIKE_OTHERS = "disk", "cylinder", "cube", "constant", "envmap"
"""Emitters (of `worlds.EMITTERS`) of kinds that others there have, too."""


def one_of_each_kind(emitters):
    """Emitters, those that are like others marked as ``extended``."""
    emitters = list(emitters)
    return [
        *(emitter for emitter in emitters if emitter not in LIKE_OTHERS),
        *extended(*(emitter for emitter in emitters if emitter in LIKE_OTHERS)),
    ]
