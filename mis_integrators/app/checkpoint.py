"""The checkpoint of a render: its sums, the iterations in them, and of what they are, in one file
that is whole or not there at all.

The file is the line ``MAGIC``, the SHA-256 of all that follows, the length of the header (8 bytes,
little-endian), the header (JSON, UTF-8) and the arrays' bytes one after the other, as the header
lists them.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.sums import Iterations
from ..core.untrusted import Fields, Malformed, is_text, open_regular, parse, shown
from . import fingerprint, output

MAGIC = b"mis-render checkpoint 1\n"
_DIGEST_BYTES, _LENGTH_BYTES = 32, 8
FASTEST = 1e-6
"""Seconds that an iteration takes at least, however many machines there are: a checkpoint that
claims more iterations is none."""


class CheckpointError(Exception):
    """A checkpoint that cannot be used; the message says why, in one line."""


@dataclass(frozen=True)
class Checkpoint:
    """What goes on when a render does.

    ``identity`` is what the sums are of (see ``difference``), ``learned`` what the session had
    found out before its first iteration; both in JSON's types. ``arrays`` (float64) are the sums
    over the iterations ``done``, which took so many ``seconds`` and so many of ``compiling``.
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
    """Replace the checkpoint in one step. Raises ``OSError`` if it cannot be written; the one
    before is then still there."""
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
    body: list[Any] = [
        len(header).to_bytes(_LENGTH_BYTES, "little"),
        header,
        *(array.data for array in arrays.values() if array.size),
    ]
    digest = hashlib.sha256()
    for part in body:
        digest.update(part)
    with output.replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(MAGIC + digest.digest())
        for part in body:
            file.write(part)


def read(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises ``CheckpointError`` if it is damaged or none, ``OSError`` if it
    cannot be read."""
    with open_regular(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise CheckpointError(
                f"{path} is damaged, or no checkpoint of this version: it does not start as one"
            )
        digest, body = file.read(_DIGEST_BYTES), memoryview(file.read())
    if hashlib.sha256(body).digest() != digest:
        raise CheckpointError(f"{path} is damaged: its content does not have its checksum")
    try:
        return _of_body(body)
    except Malformed as error:
        raise CheckpointError(f"{path} is no checkpoint of mis-render: {error}") from None


def _of_body(body: memoryview) -> Checkpoint:
    """The checkpoint of a file that has its checksum; whoever wrote it may have had other things in
    mind. Raises ``Malformed``."""
    end = _LENGTH_BYTES + int.from_bytes(body[:_LENGTH_BYTES], "little")
    if end > len(body):
        raise Malformed("its header is longer than the file")
    fields = Fields(
        parse(bytes(body[_LENGTH_BYTES:end]).decode(errors="replace"), "its header"), "its header"
    )
    arrays = {}
    for name, shape in _shapes(fields).items():
        start, end = end, end + 8 * math.prod(shape)
        if end > len(body):
            raise Malformed(f"its sums {shown(name)} are longer than the file")
        arrays[name] = np.frombuffer(body[start:end], "<f8").reshape(shape)
        if not np.isfinite(arrays[name]).all():
            raise Malformed(f"its sums {shown(name)} have values that are not finite")
    if end != len(body):
        raise Malformed(f"{len(body) - end} bytes follow its sums")
    seconds = fields.number("seconds")
    done = _iterations(fields, seconds + fields.number("compiling"))
    identity, learned = fields.any("identity"), fields.any("learned")
    for name, value in (("identity", identity), ("learned", learned)):
        if not isinstance(value, dict):
            raise fields.refuse(name, "an object")
    checkpoint = Checkpoint(identity, learned, done, seconds, fields.number("compiling"), arrays)
    fields.finish()
    return checkpoint


def _shapes(fields: Fields) -> dict[str, tuple[int, ...]]:
    given = fields.any("arrays")
    if not isinstance(given, dict) or not all(
        is_text(name)
        and isinstance(shape, list)
        and len(shape) <= 3
        and all(type(n) is int and 0 < n < 2**32 for n in shape)
        for name, shape in given.items()
    ):
        raise fields.refuse("arrays", "the shapes of sums")
    return {name: tuple(shape) for name, shape in given.items()}


def _iterations(fields: Fields, seconds: float) -> Iterations:
    value = fields.any("done")
    allowed = "[n, [numbers beyond n]], as many iterations as fit into the time that they took"
    if not (isinstance(value, list) and len(value) == 2 and isinstance(value[1], list)):
        raise fields.refuse("done", allowed)
    below, beyond = value
    if (
        not all(type(n) is int and 0 <= n < 2**53 for n in (below, *beyond))
        or below + len(beyond) > seconds / FASTEST
    ):
        raise fields.refuse("done", allowed)
    try:
        return Iterations(below, tuple(beyond))
    except ValueError:
        raise fields.refuse("done", allowed) from None


def difference(then: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """What differs between the render that a checkpoint is of and this one, or ``None``.

    An identity has the names ``variant``, ``plugin``, ``files`` (of ``fingerprint.scene_digests``),
    ``variables``, ``settings`` (dictionaries), and others that are compared as they are.
    """
    now = json.loads(json.dumps(now))
    if missing := [
        group
        for group in ("files", "variables", "settings")
        if not isinstance(then.get(group), dict)
    ]:
        return f"it does not tell the {missing[0]}"
    if changed := fingerprint.changes(then["files"], now["files"]):
        return f"the scene has changed: {', '.join(map(shown, changed))}"
    for name in then.keys() | now.keys():
        if name not in ("files", "variables", "settings") and then.get(name) != now.get(name):
            return f"it was made with {shown(name)} {shown(then.get(name))}, not {now.get(name)}"
    for group, sign in (("variables", "-D "), ("settings", "")):
        before, after = then[group], now[group]
        for name in sorted(before.keys() | after.keys()):
            if before.get(name) != after.get(name):
                return (
                    f"it was made with {sign}{shown(name)} = "
                    f"{shown(before.get(name, '(default)'))}, not "
                    f"{after.get(name, '(default)')}"
                )
    return None
