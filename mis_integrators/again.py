"""What an image must tell to be rendered again: the options that it was rendered with, and what was found out meanwhile."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import OpenEXR

from .options import versions
from .session import Session

ATTRIBUTE = "again"
_MAGIC = b"\x76\x2f\x31\x01"
_OPTIONS = ("plugin", "variables", "parameters", "variant", "sensor", "all_views", "seed")


def note(options: argparse.Namespace, session: Session, learned: dict[str, Any]) -> str:
    """The attribute of an image that `follow` reads, in JSON. What depended on the clock is in it as what it came to: samples, camera paths of an
    iteration, and what the session had ``learned``."""
    told = {name: getattr(options, name) for name in _OPTIONS}
    if "camera_paths" in session.settings:
        told["parameters"] = [*(pair for pair in told["parameters"] if pair[0] != "camera_paths"),
                              ("camera_paths", str(session.samples_per_iteration))]
    return json.dumps({"options": {**told, "spp": session.iterations * session.samples_per_iteration}, "learned": learned, "versions": versions()})


def follow(image: Path, options: argparse.Namespace) -> tuple[dict[str, Any], str | None]:
    """Sets the options to those that ``image`` was rendered with; returns what its session had learned, and what may be different now, in words.

    Raises ``ValueError`` if it is not an image of this command.
    """
    try:
        with open(image, "rb") as file:
            is_exr = file.read(len(_MAGIC)) == _MAGIC
        header = OpenEXR.File(str(image), header_only=True).header() if is_exr else {}
    except (OSError, RuntimeError) as error:
        raise ValueError(f"--like {image}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if ATTRIBUTE not in header:
        raise ValueError(f"--like {image}: not an image of mis-render, or of an earlier version")
    told = json.loads(header[ATTRIBUTE])
    for name, value in told["options"].items():
        setattr(options, name, value)
    return told["learned"], None if told["versions"] == versions() else f"{image} was rendered by {told['versions']}"
