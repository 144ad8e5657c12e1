"""A self-contained HTML page, and what it is made of: methods' names in colour, pictures, numbers.
Images are embedded, and lie beside it as PNG."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from string import Template

from mis_integrators.analysis import charts
from mis_integrators.app.output import write_png

import mitsuba as mi
import numpy as np

from common.rows import Row, machine

TEMPLATE = Path(__file__).with_name("page.html")
ABOUT = (
    "{date} · {processor}, {threads} threads · "
    "mis_integrators {mis_integrators} ({commit}), Mitsuba {mitsuba}, Dr.Jit {drjit}"
)
"""On what machine, and of which versions, figures are."""
ZOOM = 40
"""Edge of what is shown enlarged, in pixels."""
FRAMES = ((1.0, 0.75, 0.0), (0.0, 0.75, 1.0))
"""Colours of the frames that show in the reference where the enlarged parts are."""


class Page:
    """Sections, and the file that they are written to."""

    def __init__(self, title: str, path: Path):
        self.title, self.path, self.sections = title, path, []

    @property
    def folder(self) -> Path:
        """Where PNG files go."""
        return self.path.parent

    def add(self, section: str) -> None:
        self.sections.append(section)

    def write(self) -> None:
        colours = [charts.heat(np.array(i / 8)) for i in range(9)]
        gradient = ", ".join(
            "#" + "".join(f"{int(255 * c):02x}" for c in colour) for colour in colours
        )
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(
            Template(TEMPLATE.read_text()).substitute(
                title=html.escape(self.title),
                machine=html.escape(ABOUT.format(**machine())),
                gradient=gradient,
                body="\n".join(self.sections),
            )
        )


def styles_of(labels: Sequence[str]) -> dict[str, charts.Style]:
    """Styles of all methods of a page."""
    return charts.styles(list(dict.fromkeys(labels)))


def chip(label: str, style: charts.Style) -> str:
    """A method's name with its colour."""
    colour = charts.colour_name(style)
    return f'<span class="chip" style="background:{colour}"></span>{html.escape(label)}'


def card(title: str, kind: str, image, error_map, source, windows, path: Path, caption: str) -> str:
    """A picture, its error map if there is one, and the `windows` of `source` enlarged."""
    parts = [f'<img alt="" src="{embed(image, path.with_suffix(".png"))}">']
    if error_map is not None:
        uri = embed(charts.heat(error_map) ** 2.2, path.with_name(path.name + "_error.png"))
        parts.append(f'<img alt="error map" src="{uri}">')
    zooms = []
    for (y, x), colour in zip(windows, FRAMES):
        frame = ",".join(str(int(255 * c)) for c in colour)
        uri = embed(source[y : y + ZOOM, x : x + ZOOM], None)
        zooms.append(f'<img alt="" style="border-bottom:3px solid rgb({frame})" src="{uri}">')
    return (
        f'<figure class="{kind}"><b>{title}</b>{"".join(parts)}'
        f'<div class="zooms">{"".join(zooms)}</div><figcaption>{caption}</figcaption></figure>'
    )


def embed(image: np.ndarray, path: Path | None) -> str:
    """A linear image as a JPEG in a data URI; as PNG at `path`, too, if there is one."""
    image = np.ascontiguousarray(np.nan_to_num(image, posinf=1), dtype=np.float32)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, image, ("R", "G", "B"))
    stream = mi.MemoryStream()
    mi.Bitmap(image, mi.Bitmap.PixelFormat.RGB).convert(
        mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True
    ).write(stream, mi.Bitmap.FileFormat.JPEG, 90)
    return charts.data_uri(stream.raw_buffer(), "image/jpeg")


def interval(row: Row, name: str) -> str:
    """A ratio with its confidence interval, if it has one."""
    if not np.isfinite(row[f"{name} low"]) or row[f"{name} low"] == row[f"{name} high"]:
        return short(row[name])
    return f"{short(row[name])} ({short(row[f'{name} low'])} to {short(row[f'{name} high'])})"


def short(value: float) -> str:
    """A ratio with two or three digits."""
    return (
        f"{value:.3f}"
        if value < 0.095
        else f"{value:.2f}"
        if value < 9.95
        else f"{value:.0f}"
        if value < 1e4
        else f"{value:.0e}"
    )


def file_name(label: str) -> str:
    """A method's name as part of a file's."""
    return "".join(c if c.isalnum() else "_" for c in label)
