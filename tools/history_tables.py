#!/usr/bin/env python3
"""Write the tables of docs/*.md that show recorded figures, from benchmarks/history/papers: between
``<!-- rows: FILE.json: COLUMN, COLUMN, ... -->`` and ``<!-- end -->``.

A column with ``~`` behind its name is shown with its interval (``NAME low``, ``NAME high``); what
follows ``=`` is its heading. Rows without a figure in the last column are left out.

``<!-- scenes: FILE.json: COLUMN -->`` makes a table of one figure instead: a row a method, a column
a scene, and the geometric mean over the scenes. Methods of ``bdpm`` alone, the single strategies,
share a row with the least of each scene.
``history_tables.py --check`` changes nothing, and exits with status 1 where a table is not what the
file says.
"""

from __future__ import annotations

import json
import math
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HISTORY = ROOT / "benchmarks" / "history" / "papers"
PLACE = re.compile(r"(<!-- (rows|scenes): ([\w.]+): ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)
SINGLE = "bdpm:"
"""How the names of methods of a single strategy begin."""


def figure(value: object) -> str:
    """A cell: three digits of a number, names of methods as code."""
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"`{value}`" if isinstance(value, str) and "=" in value else str(value)


def cell(row: dict, name: str) -> str:
    """The figure of a column, with its interval if its name ends with ``~``."""
    bare = name.rstrip("~")
    text = figure(row[bare])
    if name.endswith("~"):
        low, high = row[f"{bare} low"], row[f"{bare} high"]
        if low is not None and low != high:
            text += f" ({figure(low)} to {figure(high)})"
    return text


def rows_table(rows: list[dict], columns: str) -> list[list[str]]:
    """Heading and lines of the table with the rows of a file."""
    names, headings = [], []
    for column in columns.split(","):
        name, _, heading = (part.strip() for part in column.partition("="))
        names.append(name)
        headings.append(heading or name.rstrip("~"))
    rows = [row for row in rows if row[names[-1].rstrip("~")] is not None]
    return [headings, *([cell(row, name) for name in names] for row in rows)]


def scenes_table(rows: list[dict], column: str) -> list[list[str]]:
    """Heading and lines of the table with one figure of each method in each scene."""
    figures: dict[str, dict[str, float]] = {}
    for row in rows:
        single = row["method"].startswith(SINGLE)
        of_method = figures.setdefault(
            "best single strategy" if single else f"`{row['method']}`", {}
        )
        of_method[row["scene"]] = min(row[column], of_method.get(row["scene"], row[column]))
    scenes = sorted({row["scene"] for row in rows})
    lines = [["method", *scenes, "geometric mean"]]
    for method, of_method in figures.items():
        values = [of_method[scene] for scene in scenes]
        mean = math.exp(math.fsum(map(math.log, values)) / len(values))
        lines.append([method, *map(two_digits, [*values, mean])])
    return lines


def two_digits(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"


TABLES = {"rows": rows_table, "scenes": scenes_table}


def table(kind: str, file: str, columns: str) -> str:
    """The Markdown table of a file."""
    rows = json.loads((HISTORY / file).read_text())["rows"]
    heading, *lines = TABLES[kind](rows, columns.strip())
    lines = [heading, ["---"] * len(heading), *lines]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def main(arguments: list[str]) -> int:
    stale = 0
    for page in sorted((ROOT / "docs").rglob("*.md")):
        before = page.read_text()
        after = PLACE.sub(lambda m: m[1] + "\n" + table(m[2], m[3], m[4]) + "\n" + m[5], before)
        if after != before:
            stale += 1
            print(f"{'stale' if '--check' in arguments else 'updated'}: {page.name}")
            if "--check" not in arguments:
                page.write_text(after)
    return int(bool(stale) and "--check" in arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
