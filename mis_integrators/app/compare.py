"""``--compare``: two renders of equal time side by side, and their errors against a reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import OpenEXR

from ..analysis.metrics import References, errors, flip
from ..core.untrusted import shown
from . import loading, output
from .request import Opened

MISSING = "pictures side by side need matplotlib: pip install 'mis-integrators[bench]'"
DOTS = 100
"""Pixels an inch of the picture: how large its letters are beside the images."""
LABEL, GAP, LETTERS = 60, 8, 9
"""Height of a label and width between the images, in pixels, and size of the letters, in points;
larger for images wider than `SMALLEST_WIDTH`, so that they can be read when all is scaled down."""
SMALLEST_WIDTH = 400
"""Images that are narrower are enlarged until their labels fit."""


@dataclass(frozen=True)
class Rendered:
    """One of the two renders."""

    opened: Opened
    image: np.ndarray
    """Radiance, (H, W, C), of the session's channels."""
    clean: np.ndarray | None
    """The channels that make the picture, denoised, and perhaps more; ``None``: not denoised."""
    seconds: float
    """Rendering time, without what compiled."""

    @property
    def name(self) -> str:
        """The integrator, and the parameters that it was given on the command line."""
        given = self.opened.request.parameters
        return " ".join(
            [self.opened.loaded.plugin, *(f"{name}={value}" for name, value in given.items())]
        )


@dataclass(frozen=True)
class Entry:
    """A picture and what is said of it."""

    name: str
    effort: str
    """How many samples in how many seconds; nothing where another entry has it."""
    picture: np.ndarray
    """Radiance, (H, W, C), of the channels that make the picture."""
    quality: str
    """Errors in words; nothing without a reference."""

    @property
    def line(self) -> str:
        """All but the picture."""
        return f"{self.name}: {', '.join(filter(None, [self.effort, self.quality]))}"


@dataclass(frozen=True)
class Rival:
    """The second render, ready to begin, and what both are compared with."""

    opened: Opened
    names: tuple[str, ...]
    """Those channels of both images that make the picture."""
    reference: np.ndarray | None
    """Radiance, (H, W, C), of these channels; ``None`` if there is none."""

    def rows(self, *both: Rendered) -> list[list[Entry]]:
        """Their pictures, and in a second row the denoised ones, if there are any."""
        rows = [[self._entry(one) for one in both]]
        if both[0].clean is not None:
            rows.append([self._clean_entry(one) for one in both])
        return rows

    def _entry(self, one: Rendered) -> Entry:
        session = one.opened.session
        picture = one.image[..., [session.channels.index(name) for name in self.names]]
        samples = session.iterations * session.camera_paths
        effort = f"{samples} samples per pixel in {one.seconds:.1f} s"
        return Entry(one.name, effort, picture, quality(picture, self.reference))

    def _clean_entry(self, one: Rendered) -> Entry:
        assert one.clean is not None
        picture = one.clean[..., : len(self.names)]
        return Entry(f"{one.name}, denoised", "", picture, quality(picture, self.reference))


def require() -> None:
    """Raises ``ImportError``, with a line that says what to install, where there is no
    matplotlib."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(MISSING) from error


def prepare(plugin: str, reference: Path | None, first: Opened) -> Rival:
    """Open the scene of ``first`` for the integrator ``plugin``, without a planned end, and read
    the reference.

    Parameters of `loading.INHERITED` that were given for the first integrator, such as
    ``max_depth``, hold for both. Raises one of ``loading.SCENE_ERRORS``.
    """
    names = output.picture_channels(first.session.channels)
    if names is None:
        raise ValueError("--compare: the film has no colours, and so there is nothing to look at")
    width, height = first.sensor.film().crop_size()
    truth = read_reference(reference, names, (height, width)) if reference else None
    given = first.request.parameters
    common = {name: given[name] for name in loading.INHERITED if name in given}
    try:
        rival = replace(first.request, plugin=plugin, parameters=common, spp=0).open()
    except loading.SCENE_ERRORS as error:
        raise ValueError(f"--compare {plugin}: {loading.one_line(error)}") from None
    if (rival.loaded.plugin, rival.settings) == (first.loaded.plugin, first.settings):
        raise ValueError(f"--compare {plugin}: that is what the image is rendered with already")
    return Rival(rival, names, truth)


def read_reference(path: Path, names: Sequence[str], shape: tuple[int, int]) -> np.ndarray:
    """The channels ``names`` of an EXR file, float32 of shape ``(*shape, len(names))``.

    Raises ``ValueError`` if it is no such file, or has other channels or another size.
    """
    try:
        if not output.is_exr(path):
            raise ValueError("it is not an EXR file")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # OpenEXR raises errors of many kinds for files that are damaged
        reason = getattr(error, "strerror", None) or loading.one_line(error)
        raise ValueError(f"--reference {path}: {shown(reason)}") from None
    if missing := [name for name in names if name not in channels]:
        raise ValueError(
            f"--reference {path} has no channel {', '.join(missing)}, which the image has"
        )
    planes = [channels[name].astype(np.float32) for name in names]
    if any(plane.shape != shape for plane in planes):
        height, width = planes[0].shape
        raise ValueError(
            f"--reference {path} has {width} x {height} pixels, the image {shape[1]} x {shape[0]}"
        )
    if not all(np.isfinite(plane).all() for plane in planes):
        raise ValueError(f"--reference {path} has values that are not finite (NaN or infinite)")
    return np.stack(planes, axis=-1)


def quality(picture: np.ndarray, reference: np.ndarray | None) -> str:
    """relMSE, MSE and FLIP of a picture (H, W, C), in words; nothing without a reference, and no
    FLIP without its package. They include the noise of the reference."""
    if reference is None:
        return ""
    # Grey pictures as colours, which FLIP needs.
    picture, truth = (np.repeat(one, 3 // one.shape[2], axis=2) for one in (picture, reference))
    references = References(truth, truth, origin="--reference", noisy=False)
    found, judged = errors(picture, references), flip(picture, references)
    words = f"relMSE {found.relmse:.3g}, MSE {found.mse:.3g}"
    return f"{words}, FLIP {judged[0]:.3g}" if judged else words


def write_picture(path: Path, rows: Sequence[Sequence[Entry]], names: Sequence[str]) -> None:
    """Write the entries as a PNG file, row by row, each under its label; all have one size and one
    exposure.

    Raises ``OSError`` as ``output.write_png`` does.
    """
    from matplotlib.figure import Figure

    height, width = rows[0][0].picture.shape[:2]
    zoom, scale = math.ceil(SMALLEST_WIDTH / width), max(1.0, width / SMALLEST_WIDTH)
    height, width, columns = height * zoom, width * zoom, len(rows[0])
    label_height, gap = (round(size * scale) for size in (LABEL, GAP))
    whole = np.array([columns * width + (columns - 1) * gap, len(rows) * (height + label_height)])
    figure = Figure(figsize=tuple(whole / DOTS), dpi=DOTS, facecolor="white")
    for row, entries in enumerate(rows):
        for column, entry in enumerate(entries):
            left, bottom = column * (width + gap), whole[1] - (row + 1) * (height + label_height)
            axes = figure.add_axes(
                (left / whole[0], bottom / whole[1], width / whole[0], height / whole[1])
            )
            axes.imshow(_srgb(entry.picture, names), interpolation="nearest", aspect="auto")
            axes.axis("off")
            label = "\n".join(filter(None, [entry.name, entry.effort, entry.quality]))
            middle = (left + width / 2) / whole[0], (bottom + height + label_height / 2) / whole[1]
            figure.text(*middle, label, ha="center", va="center", fontsize=LETTERS * scale)
    with output.replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DOTS)


def _srgb(picture: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """The picture as ``output.write_png`` shows it: uint8, (H, W, 3)."""
    bytes_ = np.array(output.picture_bitmap(picture, names))
    return np.broadcast_to(bytes_.reshape(*picture.shape[:2], -1), (*picture.shape[:2], 3))
