"""The checkpoint of a render: its sums, the iterations in them, and of what they are, in one file that is whole or not there at all.

The file is the line ``MAGIC``, the SHA-256 of all that follows, the length of the header (8 bytes, little-endian), the header (JSON, UTF-8) and
the arrays' bytes one after the other, as the header lists them.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Mapping

import numpy as np

from . import fingerprint, output
from .sums import Iterations

MAGIC = b"mis-render checkpoint 1\n"
_DIGEST_BYTES, _LENGTH_BYTES = 32, 8


class CheckpointError(Exception):
    """A checkpoint that cannot be used; the message says why, in one line."""


@dataclass(frozen=True)
class Checkpoint:
    """What goes on when a render does.

    ``identity`` is what the sums are of (see ``difference``), ``learned`` what the session had found out before its first iteration; both in
    JSON's types. ``arrays`` (float64) are the sums over the iterations ``done``, which took so many ``seconds`` and so many of ``compiling``.
    """

    identity: Mapping[str, Any]
    learned: Mapping[str, Any]
    done: Iterations
    seconds: float
    compiling: float
    arrays: Mapping[str, np.ndarray]


def beside(image: Path) -> Path:
    """Where the checkpoint of an image is."""
    return image.with_suffix(".checkpoint")


def write(path: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint in one step. Raises ``OSError`` if it cannot be written; the one before is then still there."""
    arrays = {name: np.ascontiguousarray(array, "<f8") for name, array in checkpoint.arrays.items()}
    header = json.dumps(
        {
            "identity": checkpoint.identity,
            "learned": checkpoint.learned,
            "done": checkpoint.done.as_json(),
            "seconds": checkpoint.seconds,
            "compiling": checkpoint.compiling,
            "arrays": {name: array.shape for name, array in arrays.items()},
        }
    ).encode()
    body: list[Any] = [len(header).to_bytes(_LENGTH_BYTES, "little"), header, *(array.data for array in arrays.values() if array.size)]
    digest = hashlib.sha256()
    for part in body:
        digest.update(part)
    with output.replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(MAGIC + digest.digest())
        for part in body:
            file.write(part)


def read(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises ``CheckpointError`` if it is damaged or none, ``OSError`` if it cannot be read."""
    content = path.read_bytes()
    if not content.startswith(MAGIC):
        raise CheckpointError(f"{path} is damaged, or no checkpoint of this version: it does not start as one")
    start = len(MAGIC) + _DIGEST_BYTES
    body = memoryview(content)[start:]
    if hashlib.sha256(body).digest() != content[len(MAGIC) : start]:
        raise CheckpointError(f"{path} is damaged: its content does not have its checksum")
    end = _LENGTH_BYTES + int.from_bytes(body[:_LENGTH_BYTES], "little")
    header = json.loads(bytes(body[_LENGTH_BYTES:end]))
    arrays = {}
    for name, shape in header["arrays"].items():
        start, end = end, end + 8 * math.prod(shape)
        arrays[name] = np.frombuffer(body[start:end], "<f8").reshape(shape)
    done = Iterations(header["done"][0], tuple(header["done"][1]))
    return Checkpoint(header["identity"], header["learned"], done, header["seconds"], header["compiling"], arrays)


def difference(then: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """What differs between the render that a checkpoint is of and this one, or ``None``.

    An identity has the names ``variant``, ``plugin``, ``files`` (of ``fingerprint.scene_digests``), ``variables``, ``settings`` (dictionaries),
    and others that are compared as they are.
    """
    now = json.loads(json.dumps(now))
    if changed := fingerprint.changes(then["files"], now["files"]):
        return f"the scene has changed: {', '.join(changed)}"
    for name in then.keys() | now.keys():
        if name not in ("files", "variables", "settings") and then.get(name) != now.get(name):
            return f"it was made with {name} {then.get(name)}, not {now.get(name)}"
    for group, sign in (("variables", "-D "), ("settings", "")):
        before, after = then[group], now[group]
        for name in sorted(before.keys() | after.keys()):
            if before.get(name) != after.get(name):
                return f"it was made with {sign}{name} = {before.get(name, '(default)')}, not {after.get(name, '(default)')}"
    return None
