"""What ``mis-render --explain`` tells: which integrator rendered an image and why, and what it
found out about the scene."""

from __future__ import annotations

from collections.abc import Mapping

import rich.table

CHOICE, BECAUSE = "choice", "choice.because."
MEASURES = {"relmse": "relMSE", "mse": "MSE"}
"""Of predicted errors: names in the settings of a session, and those for people."""


def explanation(settings: Mapping[str, object], given: Mapping[str, object]) -> list:
    """What to print, tables and lines for rich: the predicted errors of the candidates, if one of
    several was chosen, its reasons, and what else the ``settings`` of a session tell beyond those
    ``given``."""
    parts: list = []
    predicted = _predicted(settings)
    if predicted:
        table = rich.table.Table("candidate", *(f"predicted {m}" for m in MEASURES.values()), "")
        for candidate, errors in predicted.items():
            chosen = "renders" if candidate == settings.get(CHOICE) else ""
            table.add_row(candidate, *(_number(errors.get(m)) for m in MEASURES), chosen)
        parts.append(table)
    parts += [str(value) for name, value in settings.items() if name.startswith(BECAUSE)]
    found = {
        name: value
        for name, value in settings.items()
        if not name.startswith(CHOICE) and given.get(name) != value
    }
    if found:
        table = rich.table.Table("setting", "value")
        for name, value in found.items():
            table.add_row(name, _number(value))
        parts.append(table)
    return parts


def _predicted(settings: Mapping[str, object]) -> dict[str, dict[str, object]]:
    """By candidate, then by measure."""
    errors: dict[str, dict[str, object]] = {}
    for name, value in settings.items():
        start, _, rest = name.partition(".")
        measure, _, candidate = rest.partition(".")
        if start == CHOICE and measure in MEASURES:
            errors.setdefault(candidate, {})[measure] = value
    return errors


def _number(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else "" if value is None else str(value)
