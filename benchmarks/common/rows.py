"""What a benchmark leaves: a table in the terminal, and the rows as CSV and JSON with the
machine."""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import mis_integrators

import drjit as dr
import mitsuba as mi
from rich.console import Console
from rich.table import Table

Row = Mapping[str, str | int | float | None]

console = Console(highlight=False)
if not console.is_terminal:
    console = Console(highlight=False, width=200)


def show(title: str, rows: Sequence[Row], columns: Sequence[str] | None = None) -> None:
    """Print rows as a table; ``columns`` picks some (default: all)."""
    if not rows:
        return
    names = list(columns or rows[0])
    table = Table(title=title, title_justify="left")
    for name in names:
        table.add_column(name, justify="left" if isinstance(rows[0][name], str) else "right")
    for row in rows:
        table.add_row(*(_text(row[name]) for name in names))
    console.print(table)


def save(directory: Path, name: str, rows: Sequence[Row], settings: Mapping) -> None:
    """Write ``NAME.csv`` and ``NAME.json``, the latter with the settings and the machine."""
    directory.mkdir(parents=True, exist_ok=True)
    with open(directory / f"{name}.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)
    (directory / f"{name}.json").write_text(
        json.dumps(document(rows, settings), indent=1, default=str) + "\n"
    )


def document(rows: Sequence[Row], settings: Mapping) -> dict:
    """What JSON files hold: the rows, how they were asked for, and the class of machine; figures
    that are no numbers become null."""
    kept = {name: value for name, value in settings.items() if not callable(value)}
    kept = {
        name: [_plain(one) for one in value] if isinstance(value, list) else _plain(value)
        for name, value in kept.items()
    }
    numbers = [
        {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in row.items()
        }
        for row in rows
    ]
    return {"settings": kept, "machine": machine(), "rows": numbers}


def commit() -> str | None:
    """The commit of this checkout, with a "+" if files other than documentation differ from it;
    ``None`` outside a repository."""

    def git(*arguments):
        return subprocess.run(
            ["git", *arguments],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    try:
        return git("rev-parse", "--short=12", "HEAD") + (
            "+"
            if git("status", "--porcelain", "--untracked-files=no", ":/", ":(top,exclude)docs")
            else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return None


def machine() -> dict[str, str | int | None]:
    """What the figures depend on: the code and the class of machine, not its name."""
    return {
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "processor": _processor(),
        "threads": dr.thread_count(),
        "cores": os.cpu_count() or 0,
        "python": platform.python_version(),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "variant": mi.variant(),
        "mis_integrators": mis_integrators.__version__,
        "commit": commit(),
    }


def tell(text: str) -> None:
    """Show progress: over the last line on a terminal, nothing elsewhere."""
    if console.is_terminal:
        console.print(f"{text:<100}", end="\r")


def _plain(value):
    """A setting without the folders of this machine: a method's label, a file's name."""
    if isinstance(value, Path):
        return value.name
    return getattr(value, "label", value)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), ""
    )


def _text(value: str | int | float | None) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)
