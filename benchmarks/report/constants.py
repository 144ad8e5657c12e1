"""The page of the tuned constants, docs/constants.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from common.tuned import Constant

Figures = Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]
"""By constant, variant (``halved``, ``doubled``) and scene: error over that with the usual value,
without the worst 0.1 % of the pixels, and with them."""

TOP = """# Tuned constants

Numbers that could be others without anything being wrong: shares, costs, sizes of tables. Limits,
tolerances and formats are not among them. This page is written from the code, where the docstring
of each begins with "Tuned:", by `python benchmarks/run.py constants --page`; a test compares.

`halved` and `doubled` are error times time over that with the value as it is: relative squared
error without the worst 0.1 % of the pixels, seconds of the processors with set-up and without what
compiles, geometric mean over scenes that nothing here was tuned on, with the standard error over
the scenes. (Of a share above one half, what is left to one is halved or doubled.) Both renders have
the same random numbers and samples, as many as take about a second; where only the clock matters,
the same time. Figures near one, beside their standard error, say that the value does not matter
much; so short a render makes much of set-up, and one seed of the luck of a pilot. An empty place is
not measured yet, or means nothing: tuples, and constants of the multi-view integrator. Measured by
`python benchmarks/run.py constants --processor-time --time 0.7 --width 96`, whose `--scenes` names
the scenes: A and B of the peers' scenes, `veach-bidir`, `living-room`, `classroom`, and three
random scenes of the tests.

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
