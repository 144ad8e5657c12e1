"""Write a render as an EXR file, with a PNG beside it to look at: whole files or none."""

import contextlib
import errno
import fcntl
import glob
import os
import re
import socket
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR

from ..core.untrusted import open_regular

_MAGIC = b"\x76\x2f\x31\x01"
# Channels that make a picture, and what Mitsuba calls them.
_PICTURES = ((("R", "G", "B"), "RGB"), (("X", "Y", "Z"), "XYZ"), (("Y",), "Y"))


LEFT_OVER = 86400.0
"""Seconds after which a temporary file of another machine's process is taken for left over."""


def make_writable(path: Path) -> None:
    """Create the folder of a file if needed, and raise ``OSError`` if the file cannot be written
    there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _temporary(target_of(path)).unlink()


def target_of(path: Path) -> Path:
    """The file that writing ``path`` replaces: what it links to, if it is a link. Raises
    ``OSError`` for what is there and is not a regular file."""
    try:
        target = path.resolve()
    except RuntimeError as error:  # links in a circle, before Python 3.13
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path)) from error
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, "it is a directory", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return target


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """No other process writes ``path`` in this way during the block: a lock file beside it names
    the one that does.

    Raises ``BlockingIOError``, which says who it is, if another process does. The system gives the
    lock up with the process; file systems that know no locks have none.
    """
    lock = target_of(path)
    lock = lock.with_name(f".{lock.name}.lock")
    while True:
        # Not through a link, and without waiting for the writer of a FIFO.
        descriptor = os.open(
            lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666
        )
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 200).decode(errors="replace").strip()
            os.close(descriptor)
            owner = owner if owner.isprintable() and owner else "another process"
            raise BlockingIOError(
                errno.EWOULDBLOCK,
                f"{owner} is rendering it; choose another file, or wait",
                str(path),
            ) from None
        except OSError:
            break  # no locks here
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(lock)):
                break
        os.close(descriptor)  # its owner has removed it meanwhile
    try:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(descriptor)


def write_exr(
    path: Path,
    image: np.ndarray,
    channels: Sequence[str],
    metadata: Mapping[str, str | int | float],
) -> None:
    """Write an image of shape (H, W, C) with named channels as float32, and the metadata as
    attributes; integers beyond the 32 bits of OpenEXR's become text.

    Raises ``OSError`` if it cannot be written; a file that was there before is then still whole.
    """
    attributes = {
        name: str(value) if isinstance(value, int) and not -(2**31) <= value < 2**31 else value
        for name, value in metadata.items()
    }
    header = {**attributes, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {
        name: np.ascontiguousarray(image[..., i], dtype=np.float32)
        for i, name in enumerate(channels)
    }
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except RuntimeError as error:
            raise OSError(str(error)) from error


def picture_channels(channels: Sequence[str]) -> tuple[str, ...] | None:
    """Those of the channels that make a picture; ``None`` if there are none."""
    return next((names for names, _ in _PICTURES if set(names) <= set(channels)), None)


def picture_bitmap(image: np.ndarray, channels: Sequence[str]) -> mi.Bitmap | None:
    """The bytes that ``write_png`` writes; ``None`` without colour channels."""
    names = picture_channels(channels)
    if names is None:
        return None
    pixel_format = dict(_PICTURES)[names]
    picture = np.nan_to_num(image[..., [channels.index(name) for name in names]], posinf=1).astype(
        np.float32
    )
    formats = mi.Bitmap.PixelFormat
    return mi.Bitmap(picture, getattr(formats, pixel_format)).convert(
        formats.Y if pixel_format == "Y" else formats.RGB, mi.Struct.Type.UInt8, srgb_gamma=True
    )


def write_png(path: Path, image: np.ndarray, channels: Sequence[str]) -> bool:
    """Write the colour channels of an image of shape (H, W, C) as sRGB, clipped to [0, 1], without
    alpha.

    Values that are no numbers become black. Returns ``False``, and writes nothing, if the image has
    no colour channels (a film of spectral bands). Raises ``OSError`` as ``write_exr`` does.
    """
    bitmap = picture_bitmap(image, channels)
    if bitmap is None:
        return False
    with replacing(path) as temporary:
        try:
            bitmap.write(str(temporary), mi.Bitmap.FileFormat.PNG)
        except RuntimeError as error:
            raise OSError(str(error)) from error
    return True


def is_exr(path: Path) -> bool:
    """Whether a file begins as EXR files do. Raises ``OSError`` if it cannot be read."""
    with open_regular(path) as file:
        return file.read(len(_MAGIC)) == _MAGIC


def contact_sheet(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images of shape (H, W, C) row by row on one that is about square, black between images that
    are smaller than the largest."""
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    columns = max(1, round((len(images) * height / width) ** 0.5))
    rows = -(-len(images) // columns)
    sheet = np.zeros((rows * height, columns * width, images[0].shape[2]), np.float32)
    for number, image in enumerate(images):
        top, left = height * (number // columns), width * (number % columns)
        sheet[top : top + image.shape[0], left : left + image.shape[1]] = image
    return sheet


def frame_path(path: Path, number: int) -> Path:
    """Where the PNG of a view goes: ``NAME.000.png`` beside ``NAME.exr``."""
    return path.with_suffix(f".{number:03d}.png")


def denoised_path(path: Path) -> Path:
    """Where the denoised image goes: ``NAME.denoised.exr`` beside ``NAME.exr``."""
    return path.with_suffix(".denoised.exr")


def compared_path(path: Path) -> Path:
    """Where the images of ``--compare`` go: ``NAME.compare.png`` beside ``NAME.exr``."""
    return path.with_suffix(".compare.png")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it at once when the block ends without an
    error, and is on the disk by then. Where ``path`` is a link, what it links to is replaced.

    Raises ``OSError`` if it cannot be written, or is not a regular file; what was there before is
    then still there.
    """
    target = target_of(path)
    temporary = _temporary(target)
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fchmod(file.fileno(), _mode(target))
            os.fsync(file.fileno())
        os.replace(temporary, target)
        _sync_directory(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove what writers of ``path`` have left that were killed while they wrote: on this machine
    those whose process is gone, and of other machines what is old. Call it while ``alone``."""
    target = target_of(path)
    for temporary in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
        writer = re.fullmatch(
            r"(?:(\w+)-(\d{1,9})-\w+|\d+)\.part", temporary.name[len(target.name) + 2 :]
        )
        with contextlib.suppress(FileNotFoundError):
            if writer is None:
                continue  # none of ours
            if writer[1] in (None, _host()):  # None: of an earlier version
                gone = writer[1] is None or _is_gone(int(writer[2]))
            else:
                gone = time.time() - temporary.stat().st_mtime > LEFT_OVER
            if gone:
                temporary.unlink()


def _is_gone(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return process == os.getpid()


def _mode(target: Path) -> int:
    """The permissions of a file, or those that a new one would have."""
    try:
        return stat.S_IMODE(target.stat().st_mode)
    except FileNotFoundError:
        mask = os.umask(0o077)
        os.umask(mask)
        return 0o666 & ~mask


def _sync_directory(directory: Path) -> None:
    """Let a rename in the directory reach the disk, where the file system can."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _host() -> str:
    return re.sub(r"\W", "_", socket.gethostname())


def _temporary(path: Path) -> Path:
    """A new file beside ``path``, whose name tells whose it is."""
    descriptor, name = tempfile.mkstemp(
        ".part", f".{path.name}.{_host()}-{os.getpid()}-", path.parent
    )
    os.close(descriptor)
    return Path(name)
