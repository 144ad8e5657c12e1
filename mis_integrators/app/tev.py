"""``--tev HOST:PORT``: the image so far in the viewer tev (https://github.com/Tom94/tev), by its
protocol.

A packet is its own length in bytes (uint32), its kind (one byte), and what belongs to the kind, all
little-endian; texts end with a zero byte. An image is created by its name, its size and its
channels, and then updated, a rectangle of it at a time. Nothing comes back.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import time
from collections.abc import Iterator, Sequence

import numpy as np

CREATE_IMAGE, UPDATE_IMAGE = 4, 5
"""Kinds of packets; the latter is tev's second format, of several channels, one after the other."""
PATIENCE = 2.0
"""Seconds that the viewer has to take a connection, or some of the data."""
ABSENCE = 10.0
"""Seconds between two attempts to reach a viewer that is not there: the render shall not wait for
it each time."""
LARGEST_PACKET = 1 << 22
"""Bytes of pixels in a packet at most, if a row has no more."""


class Viewer:
    """An image in tev. A viewer that was not there, or has gone, is sought again after a while."""

    def __init__(self, address: tuple[str, int], name: str):
        """``address``: host and port; ``name``: of the image, in the viewer's list."""
        self.address = "{}:{}".format(*address)
        self._address, self._name = address, name
        self._connection: socket.socket | None = None
        self._shape: tuple[int, ...] | None = None
        self._absent_until = 0.0
        self._failure: OSError | None = None

    def connect(self) -> None:
        """Reach the viewer. Raises ``OSError`` if that is not possible, and then the same again,
        without an attempt, for a while."""
        if self._connection:
            return
        if self._failure and time.monotonic() < self._absent_until:
            raise self._failure
        with self._failures():
            self._connection = socket.create_connection(self._address, timeout=PATIENCE)

    def show(self, image: np.ndarray, channels: Sequence[str]) -> None:
        """Show an image of shape (H, W, C) with named channels; raises ``OSError`` as `connect`
        does."""
        self.connect()
        with self._failures():
            assert self._connection
            height, width = image.shape[:2]
            if self._shape != image.shape:
                self._connection.sendall(create_image(self._name, width, height, channels))
                self._shape = image.shape
            rows = max(1, LARGEST_PACKET // (4 * width * len(channels)))
            for top in range(0, height, rows):
                part = image[top : top + rows]
                self._connection.sendall(update_image(self._name, part, channels, top))

    def close(self) -> None:
        """Leave the viewer, which keeps the image."""
        if self._connection:
            with contextlib.suppress(OSError):
                self._connection.close()
        self._connection = self._shape = None

    @contextlib.contextmanager
    def _failures(self) -> Iterator[None]:
        """What goes wrong within ends the connection."""
        try:
            yield
        except (OSError, UnicodeError) as error:  # the latter of names that no host can have
            self.close()
            reason = getattr(error, "strerror", None) or error
            if isinstance(error, ConnectionRefusedError):
                reason = "nobody listens there"
            self._absent_until = time.monotonic() + ABSENCE
            self._failure = OSError(errno.EIO, f"{reason}; the render goes on")
            raise self._failure from error


def create_image(name: str, width: int, height: int, channels: Sequence[str]) -> bytes:
    """The packet that makes a black image, and brings it to the front."""
    return _packet(
        CREATE_IMAGE,
        b"\1",
        _text(name),
        struct.pack("<iii", width, height, len(channels)),
        *map(_text, channels),
    )


def update_image(name: str, rows: np.ndarray, channels: Sequence[str], top: int) -> bytes:
    """The packet with some whole rows of an image, (H, W, C), the first of which is row ``top``."""
    height, width = rows.shape[:2]
    return _packet(
        UPDATE_IMAGE,
        b"\0",
        _text(name),
        struct.pack("<i", len(channels)),
        *map(_text, channels),
        struct.pack("<iiii", 0, top, width, height),
        np.ascontiguousarray(np.moveaxis(rows, 2, 0), dtype="<f4").tobytes(),
    )


def _packet(kind: int, *parts: bytes) -> bytes:
    content = bytes([kind]) + b"".join(parts)
    return struct.pack("<I", 4 + len(content)) + content


def _text(text: str) -> bytes:
    return text.encode(errors="replace").replace(b"\0", b"") + b"\0"
