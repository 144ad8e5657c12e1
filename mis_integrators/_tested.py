"""The newest Mitsuba and Dr.Jit that the package was tested with, and a warning about newer
ones."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping

NEWEST = {"mitsuba": (3, 9), "drjit": (1, 5)}
"""Major and minor version of each; ``pyproject.toml`` asks for no newer ones either."""


def warn_of_newer(versions: Mapping[str, str]) -> None:
    """Warn, in one line, if the ``versions`` have a newer one than was tested."""
    newer = [
        f"{name} {version}"
        for name, version in versions.items()
        if _major_and_minor(version) > NEWEST[name]
    ]
    if newer:
        tested = " and ".join(f"{name} {major}.{minor}" for name, (major, minor) in NEWEST.items())
        text = f"{' and '.join(newer)} may not work: the newest tested are {tested}"
        # A plain warning would be followed by the line of source that warns.
        warnings.warn_explicit(text, UserWarning, "<mis_integrators>", 1, module="mis_integrators")


def _major_and_minor(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:2])
