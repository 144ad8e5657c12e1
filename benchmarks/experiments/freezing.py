"""Keep the bundled scenes as they are: figures of different versions are about the same scenes."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from common.rows import console
from common.scene_files import bundled, digests

RECORD = Path(__file__).resolve().parents[1] / "history" / "scenes.json"


def freeze(options: argparse.Namespace) -> None:
    """Write the SHA-256 of every file of the bundled scenes."""
    RECORD.parent.mkdir(exist_ok=True)
    RECORD.write_text(json.dumps(current(), indent=1) + "\n")
    console.print(f"{len(current())} files written to {RECORD}")


def check(options: argparse.Namespace) -> None:
    """Compare the bundled scenes with what was frozen; list the changes, if any, and exit with code
    1."""
    frozen, found = json.loads(RECORD.read_text()), current()
    changes = [
        f"{name}: {_change(frozen.get(name), found.get(name))}"
        for name in sorted(frozen.keys() | found.keys())
        if frozen.get(name) != found.get(name)
    ]
    if changes:
        console.print("\n".join(changes))
        sys.exit(1)
    console.print(f"{len(found)} files as frozen")


def current() -> dict[str, str]:
    """SHA-256 of the bundled scenes' files, by name."""
    return dict(sorted(item for path in bundled() for item in digests(path).items()))


def _change(before: str | None, after: str | None) -> str:
    if before is None:
        return "new"
    return "gone" if after is None else "changed"
