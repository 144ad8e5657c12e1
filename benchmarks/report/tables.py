"""Rows as tables: of HTML, of Markdown."""

from __future__ import annotations

import html
from collections.abc import Sequence

from common.rows import Row


def table(rows: Sequence[Row]) -> str:
    """Rows as a table."""
    if not rows:
        return ""
    head = "".join(f'<th class="text">{html.escape(name)}</th>' for name in rows[0])
    body = "".join(
        "<tr>"
        + "".join(
            f"<td>{value:.3g}</td>"
            if isinstance(value, (int, float))
            else f'<td class="text">{html.escape(str(value))}</td>'
            for value in row.values()
        )
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def as_markdown(rows: Sequence[Row]) -> str:
    """A Markdown table."""
    if not rows:
        return ""
    names = list(rows[0])
    body = [
        "| "
        + " | ".join(
            f"{row[name]:.3g}" if isinstance(row[name], (int, float)) else f"{row[name]}"
            for name in names
        )
        + " |"
        for row in rows
    ]
    return "\n".join(["| " + " | ".join(names) + " |", "|" + "---|" * len(names), *body]) + "\n"
