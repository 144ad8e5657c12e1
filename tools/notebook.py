#!/usr/bin/env python3
"""Make notebooks/tutorial.ipynb from docs/tutorial.md: text becomes Markdown cells, blocks of
Python become code cells.

``notebook.py --check`` changes nothing, and exits with status 1 if the notebook is another one.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE, NOTEBOOK = ROOT / "docs" / "tutorial.md", ROOT / "notebooks" / "tutorial.ipynb"


def notebook(page: str) -> dict:
    """The notebook of a page, in nbformat 4.5."""
    cells = []
    for number, part in enumerate(
        re.split(r"^```python\n(.*?)^```\n", page, flags=re.MULTILINE | re.DOTALL)
    ):
        kind = "code" if number % 2 else "markdown"
        if not part.strip():
            continue
        if kind == "markdown":  # links are relative to docs/
            part = re.sub(r"\]\((?!https?:|\.\./)([\w/]+\.md)", r"](../docs/\1", part)
        cell = {
            "cell_type": kind,
            "id": f"cell-{len(cells)}",
            "metadata": {},
            "source": part.strip("\n").splitlines(keepends=True),
        }
        cells.append({**cell, "execution_count": None, "outputs": []} if kind == "code" else cell)
    metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def main(arguments: list[str]) -> int:
    text = json.dumps(notebook(PAGE.read_text()), indent=1, ensure_ascii=False) + "\n"
    if NOTEBOOK.exists() and NOTEBOOK.read_text() == text:
        return 0
    if "--check" in arguments:
        files = f"{NOTEBOOK.relative_to(ROOT)} is not what {PAGE.relative_to(ROOT)} says"
        print(f"{files}: run tools/notebook.py")
        return 1
    NOTEBOOK.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
