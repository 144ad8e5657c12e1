"""What an image must tell to be rendered again: the options that it was rendered with, and what was
found out meanwhile."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import OpenEXR

from .. import _plugins
from ..core.session import Session
from ..core.untrusted import Fields, Malformed, parse, shown
from . import output
from .options import LARGEST_SEED, MOST_SAMPLES, MOST_SENSORS, versions

ATTRIBUTE = "again"
"""Name of the header's attribute."""
MITSUBA_INTEGRATORS = (
    "aov",
    "depth",
    "direct",
    "moment",
    "path",
    "ptracer",
    "stokes",
    "volpath",
    "volpathmis",
)
"""Mitsuba's own integrators that make images: no other names, nor names of files, are taken from
a header."""


@dataclass(frozen=True)
class Recipe:
    """What the header of an image tells: the options of the command that are set by it, each of the
    type and in the range of the command's own, what the session had ``learned`` (which the session
    checks when it recalls it), and the versions that rendered it."""

    options: dict[str, Any]
    learned: dict[str, Any]
    versions: str

    @property
    def remark(self) -> str | None:
        """What may be different now, in words."""
        return (
            None
            if self.versions == versions()
            else f"was rendered by {self.versions}, this is {versions()}; the image may differ"
        )


def attribute(options: argparse.Namespace, session: Session, learned: dict[str, Any]) -> str:
    """The attribute of an image that ``read`` reads, in JSON. What depended on the clock is in it
    as what it came to: samples, camera paths of an iteration, and what the session had
    ``learned``."""
    given = {name: getattr(options, name) for name in _OPTIONS}
    if "camera_paths" in session.settings:
        given["parameters"] = [
            *(pair for pair in given["parameters"] if pair[0] != "camera_paths"),
            ("camera_paths", str(session.camera_paths)),
        ]
    return json.dumps(
        {
            "options": {**given, "spp": session.iterations * session.camera_paths},
            "learned": learned,
            "versions": versions(),
        }
    )


_OPTIONS = (
    "plugin",
    "variables",
    "parameters",
    "variant",
    "sensor",
    "all_views",
    "seed",
    "denoise",
)


def read(image: Path) -> Recipe:
    """What ``image`` tells. Raises ``Malformed`` if it is not an image of this command, or tells
    anything but that."""
    what = f"--like {image}"
    told = Fields(parse(_attribute_of(image, what), f"{what}: its header"), f"{what}: its header")
    options = told.object("options")
    recipe = Recipe(
        {
            "plugin": options.choice("plugin", [None, *_plugins.PLUGINS, *MITSUBA_INTEGRATORS]),
            "variables": options.assignments("variables", of_variables=True),
            "parameters": options.assignments("parameters"),
            "variant": options.choice("variant", mi.variants()),
            "sensor": options.integer("sensor", 0, MOST_SENSORS),
            "all_views": options.boolean("all_views"),
            "seed": options.integer("seed", 0, LARGEST_SEED),
            "spp": options.integer("spp", 1, MOST_SAMPLES),
            "denoise": "denoise" in options.names() and options.boolean("denoise"),
        },
        told.any("learned"),
        told.text("versions"),
    )
    options.finish()
    told.finish()
    return recipe


def _attribute_of(image: Path, what: str) -> str:
    try:
        header = OpenEXR.File(str(image), header_only=True).header() if output.is_exr(image) else {}
    except Exception as error:  # OpenEXR raises errors of many kinds for files that are damaged
        raise Malformed(
            f"{what}: cannot be read: "
            f"{shown(getattr(error, 'strerror', None) or ' '.join(str(error).split()))}"
        ) from None
    if ATTRIBUTE not in header:
        raise Malformed(f"{what}: not an image of mis-render, or of an earlier version")
    return header[ATTRIBUTE]
