"""Rows of a test that the default run leaves out, and `make test-all` runs."""

import pytest


def extended(*rows):
    """Values, or tuples of values, for ``parametrize``, marked as ``extended``: a list."""
    return [
        pytest.param(*(row if isinstance(row, tuple) else (row,)), marks=pytest.mark.extended)
        for row in rows
    ]
