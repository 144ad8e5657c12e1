"""Write a render as an EXR file, with a PNG beside it to look at: whole files or none."""

import contextlib
import glob
import os
from pathlib import Path
from typing import Iterator, Mapping, Sequence

import mitsuba as mi
import numpy as np
import OpenEXR

# Channels that make a picture, and what Mitsuba calls them.
_PICTURES = ((("R", "G", "B"), "RGB"), (("X", "Y", "Z"), "XYZ"), (("Y",), "Y"))


def make_writable(directory: Path) -> None:
    """Create the directory if needed, and raise ``OSError`` if no file can be written there."""
    directory.mkdir(parents=True, exist_ok=True)
    probe = _temporary(directory / "probe")
    probe.touch()
    probe.unlink()


def write_exr(
    path: Path, image: np.ndarray, channels: Sequence[str], metadata: Mapping[str, str | int | float]
) -> None:
    """Write an image of shape (H, W, C) with named channels as float32, and the metadata as attributes; integers beyond the 32 bits of
    OpenEXR's become text.

    Raises ``OSError`` if it cannot be written; a file that was there before is then still whole.
    """
    attributes = {name: str(value) if isinstance(value, int) and not -(2**31) <= value < 2**31 else value for name, value in metadata.items()}
    header = {**attributes, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {name: np.ascontiguousarray(image[..., i], dtype=np.float32) for i, name in enumerate(channels)}
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, planes).write(str(temporary))
        except RuntimeError as error:
            raise OSError(str(error)) from error


def write_png(path: Path, image: np.ndarray, channels: Sequence[str]) -> bool:
    """Write the colour channels of an image of shape (H, W, C) as sRGB, clipped to [0, 1], without alpha.

    Values that are no numbers become black. Returns ``False``, and writes nothing, if the image has no colour
    channels (a film of spectral bands). Raises ``OSError`` as ``write_exr`` does.
    """
    for names, pixel_format in _PICTURES:
        if set(names) <= set(channels):
            break
    else:
        return False
    picture = np.nan_to_num(image[..., [channels.index(name) for name in names]], posinf=1).astype(np.float32)
    formats = mi.Bitmap.PixelFormat
    bitmap = mi.Bitmap(picture, getattr(formats, pixel_format)).convert(
        formats.Y if pixel_format == "Y" else formats.RGB, mi.Struct.Type.UInt8, srgb_gamma=True
    )
    with replacing(path) as temporary:
        try:
            bitmap.write(str(temporary), mi.Bitmap.FileFormat.PNG)
        except RuntimeError as error:
            raise OSError(str(error)) from error
    return True


def contact_sheet(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images of shape (H, W, C) row by row on one that is about square, black between images that are smaller than the largest."""
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


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it at once when the block ends without an error, and is on the disk by then.

    Raises ``OSError`` if it cannot be written; what was there before is then still there.
    """
    temporary = _temporary(path)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_directory(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove what writers of ``path`` have left that were killed while they wrote."""
    for temporary in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        temporary.unlink(missing_ok=True)


def _sync_directory(directory: Path) -> None:
    """Let a rename in the directory reach the disk, where the system can."""
    if os.name == "posix":
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):  # not every file system can
                os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.part")
