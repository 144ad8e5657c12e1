"""The page of the tuned constants, docs/notes/constants.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from common.tuned import Constant

Figures = Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]
"""By constant, variant (``halved``, ``doubled``) and scene: error over that with the usual value,
without the worst 0.1 % of the pixels, and with them."""

TOP = """# Tuned constants

A tuned constant is a number that could have another value without anything being wrong: a share, a
cost, the size of a table. Limits, tolerances and formats are not among them.
`python benchmarks/run.py constants --page` writes this page from the code, where the docstring of
each constant begins with "Tuned:". A test compares both.

`halved` and `doubled` are error times time with half or twice the value, over that with the value
as it is:

- The error is the relative squared error without the worst 0.1 % of the pixels.
- The time is that of all processors, with set-up and without what compiles.
- The figure is the geometric mean over scenes that nothing here was tuned on, with the standard
  error over the scenes.
- Both renders have the same random numbers and samples, as many as take about a second. Where only
  the clock matters, they have the same time.
- Of a share above one half, what is left to one is halved or doubled.

A figure that is near one, compared with its standard error, says that the value does not matter
much. In such short renders set-up counts for much, and with one seed the luck of a pilot does. An
empty place is not measured yet, or means nothing: tuples, and constants of the multi-view
integrator. The command is

    python benchmarks/run.py constants --processor-time --time 0.7 --width 96

with `--scenes` for the scenes: A and B of the peers' scenes, `veach-bidir`, `living-room`,
`classroom`, and three random scenes of the tests.

"""


def page(constants: Sequence[Constant], figures: Figures, notes: str) -> str:
    """The text of the page; `notes` is its end."""
    lines = [f"There are {len(constants)} of them.", ""]
    for module in dict.fromkeys(constant.module for constant in constants):
        lines += [f"## {module}", "", "| constant | value | what | halved | doubled |"]
        lines += ["|---|---|---|---|---|"]
        for constant in constants:
            if constant.module == module:
                lines.append(_row(constant, figures.get(constant.key, {})))
        lines.append("")
    return TOP + "\n".join(lines) + "\n" + notes


def _row(constant: Constant, figures: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    cells = [f"`{constant.name}`", _value(constant.value), constant.meaning.replace("|", r"\|")]
    cells += [_mean(figures.get(name, {})) for name in ("halved", "doubled")]
    return "| " + " | ".join(cells) + " |"


def _value(value: float | tuple) -> str:
    if isinstance(value, tuple):
        return ", ".join(_value(part) for part in value)
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _mean(of_scenes: Mapping[str, Sequence[float]]) -> str:
    """Geometric mean over the scenes, with its standard error."""
    if not of_scenes:
        return ""
    logs = np.log([figures[0] for figures in of_scenes.values()])
    mean = math.exp(logs.mean())
    if len(logs) < 2:
        return f"{mean:.2f}"
    return f"{mean:.2f} ± {mean * logs.std(ddof=1) / math.sqrt(len(logs)):.2f}"
