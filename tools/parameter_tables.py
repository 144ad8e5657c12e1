#!/usr/bin/env python3
"""Write the parameter tables of docs/*.md from the plugins' docstrings: between ``<!-- parameters:
PLUGIN -->`` and ``<!-- end -->``.

``parameter_tables.py --check`` changes nothing, and exits with status 1 where a table is not what
the docstring says.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import mis_integrators  # noqa: F401  (makes LLVM known, registers the plugins)

import mitsuba as mi

DOCS = Path(__file__).parent.parent / "docs"
PLACE = re.compile(r"(<!-- parameters: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def parameters(docstring: str) -> list[tuple[str, str, str]]:
    """Name, type and text of each row of a docstring's ``pluginparameters``."""
    block = re.split(r"\n    (?=\S)", docstring.partition(".. pluginparameters::")[2])[0]
    rows = []
    for row in re.split(r"^\s*\* - ", block, flags=re.MULTILINE)[1:]:
        cells = [
            " ".join(cell.split()) for cell in re.split(r"^\s+-(?: |$)", row, flags=re.MULTILINE)
        ]
        rows.append((cells[0], cells[1].strip("|"), _markdown(cells[2])))
    return rows


def table(docstring: str) -> str:
    """The rows as a Markdown table."""
    lines = ["| parameter | type | |", "|---|---|---|"]
    lines += [
        f"| {', '.join(f'`{one}`' for one in name.split(', '))} | {kind} | {text} |"
        for name, kind, text in parameters(docstring)
    ]
    return "\n".join(lines) + "\n"


def _markdown(text: str) -> str:
    text = re.sub(r":monosp:`(\w+)`", r"[`\1`](\1.md)", text)
    text = re.sub(r"``(.*?)``", r"`\1`", text)
    text = re.sub(r":cite:`\w+`", "", text)
    return re.sub(r"\|(true|false)\|", r"`\1`", text).replace("|", r"\|")


def updated(page: str) -> str:
    """A page with its tables as the docstrings have them."""

    def fresh(match: re.Match) -> str:
        return match[1] + table(type(mi.load_dict({"type": match[2]})).__doc__) + match[3]

    return PLACE.sub(fresh, page)


def main(arguments: list[str]) -> int:
    mi.set_variant("llvm_ad_rgb")
    stale = []
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text()
        if (new := updated(text)) != text:
            stale.append(page.name)
            if "--check" not in arguments:
                page.write_text(new)
    if stale:
        print(("stale: " if "--check" in arguments else "updated: ") + ", ".join(stale))
    return 1 if stale and "--check" in arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
