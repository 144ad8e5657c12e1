"""What an image is made of, by content: the scene's file, those it includes, every file that any of
them names, and this package's own sources."""

from __future__ import annotations

import functools
import hashlib
import html
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi


def scene_digests(path: Path, variables: Mapping[str, str]) -> dict[str, str]:
    """SHA-256 of the scene file and of all files that it refers to, by the name under which it
    does; ``variables`` are the values of its ``$variables``. Call it after the scene was loaded:
    the folders in which Mitsuba looks for files are those that it then knows.
    """
    state = mi.parser.parse_file(mi.parser.ParserConfig(mi.variant()), str(path), **variables)
    sources = [Path(str(file)) for file in state.files]
    elements = [element for file in sources for element in _elements(file)]
    values = {
        given.get("name", ""): given.get("value", "") for tag, given in elements if tag == "default"
    }
    values.update(variables)
    resolver = mi.file_resolver()
    named = {}
    for _, given in elements:
        for attribute in (given.get("value"), given.get("filename")):
            name = _substituted(attribute or "", values)
            file = str(resolver.resolve(name)) if name else ""
            if os.path.isfile(
                file
            ):  # false, too, for spectra and matrices that are no possible names
                named[name] = Path(file)
    named.update({_name(file, path): file for file in sources})
    return {name: _digest(file) for name, file in sorted(named.items())}


@functools.cache
def of_package() -> str:
    """The first 12 digits of the SHA-256 of all source files of this package: two states of it may
    make two images."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    files = (file for pattern in ("*.py", "*.json") for file in root.rglob(pattern))
    for file in sorted(file for file in files if file.is_file()):
        digest.update(f"{file.relative_to(root).as_posix()}\n{_digest(file)}\n".encode())
    return digest.hexdigest()[:12]


def changes(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What differs between two results of ``scene_digests``, a phrase each."""
    return [
        f"{name} "
        f"{'is new' if name not in then else 'is gone' if name not in now else 'has changed'}"
        for name in sorted({*then, *now})
        if then.get(name) != now.get(name)
    ]


def _elements(file: Path) -> list[tuple[str, Mapping[str, str]]]:
    """Tags and attributes of an XML file; as in Mitsuba's parser, it need not be well-formed
    (``--`` in comments)."""
    try:
        return [(element.tag, element.attrib) for element in ElementTree.parse(file).iter()]
    except ElementTree.ParseError:
        text = re.sub(
            r"<!--.*?-->", "", file.read_text(encoding="utf-8", errors="replace"), flags=re.DOTALL
        )
        elements = re.findall(rf"<(\w+)((?:\s+{_ATTRIBUTE})*)", text)
        assignments = [
            (tag, [given.partition("=") for given in re.findall(_ATTRIBUTE, rest)])
            for tag, rest in elements
        ]
        return [
            (tag, {name.strip(): html.unescape(value.strip()[1:-1]) for name, _, value in given})
            for tag, given in assignments
        ]


_ATTRIBUTE = r"""[\w:.-]+\s*=\s*(?:"[^"]*"|'[^']*')"""


def _name(file: Path, scene: Path) -> str:
    folder = scene.resolve().parent
    return (
        str(file.resolve().relative_to(folder))
        if file.resolve().is_relative_to(folder)
        else str(file)
    )


def _substituted(text: str, values: Mapping[str, str]) -> str:
    for name in sorted(values, key=len, reverse=True):
        if name:
            text = text.replace(f"${name}", values[name])
    return text


def _digest(file: Path) -> str:
    digest = hashlib.sha256()
    with open(file, "rb") as stream:
        while part := stream.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
