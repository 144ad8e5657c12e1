"""Charts of errors, with matplotlib (extra `bench`): a method has the same colour, marker and
dashes in each of them."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from .stability import Point, breaks

FAMILIES = {
    "path": "#222222",
    "ptracer": "#8c6d3f",
    "volpath": "#7f7f7f",
    "bdpm": "#1f77d0",
    "bdpm_balance": "#12a5a0",
    "bdpm_opt": "#8e44ad",
    "bdpm_opt2": "#f08c00",
    "bdpm_opt3": "#d62728",
    "bdpm_auto": "#a3195b",
    "bdpt": "#2e8b3d",
    "vcm": "#d63fb0",
    "pcbpt": "#9aa61c",
    "bdpt_ris": "#66c05a",
    "volpath_multiview": "#5b6fb5",
}
"""Colours of plugins."""
OTHERS = ("#b5651d", "#006d77", "#7b2cbf", "#588157", "#bc4749")
"""Colours of plugins that are not among `FAMILIES`."""
MARKERS, DASHES = "osD^vPX", ("-", "--", ":", "-.")
SETTINGS = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "path",
}


@dataclass(frozen=True)
class Style:
    """How a method is drawn."""

    colour: str | tuple[float, float, float]
    marker: str
    dashes: str


def styles(labels: Sequence[str]) -> dict[str, Style]:
    """A style for each method: the plugin decides the colour, its settings the lightness, marker
    and dashes."""
    found: dict[str, Style] = {}
    plugins: list[str] = []
    for label in labels:
        plugin = label.partition(":")[0]
        number = plugins.count(plugin)
        unknown = sorted({p for p in (*plugins, plugin) if p not in FAMILIES})
        colour = FAMILIES.get(plugin) or OTHERS[unknown.index(plugin) % len(OTHERS)]
        plugins.append(plugin)
        light = min(0.3 * number, 0.6)
        found[label] = Style(
            tuple((1 - light) * c + light for c in to_rgb(colour)),
            MARKERS[number % len(MARKERS)],
            DASHES[number % len(DASHES)],
        )
    return found


def colour_name(style: Style) -> str:
    """The style's colour as CSS knows it."""
    return to_hex(style.colour)


@dataclass(frozen=True)
class Curve:
    """A method's error over time: seconds, errors, the ends of their intervals (NaN: none), and the
    fitted slope in words."""

    seconds: Sequence[float]
    errors: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    slope: str


def error_against_time(curves: Mapping[str, Curve], style: Mapping[str, Style]) -> Figure:
    """relMSE against seconds on logarithmic axes; points that are not positive are left out."""
    figure, axis = _axes(5.6, 4.0)
    for label, curve in curves.items():
        x, y, low, high = (
            np.asarray(values, dtype=float)
            for values in (curve.seconds, curve.errors, curve.low, curve.high)
        )
        good = y > 0
        if good.any():
            look = style[label]
            axis.plot(
                x[good],
                y[good],
                look.dashes,
                color=look.colour,
                marker=look.marker,
                ms=4,
                lw=1.6,
                label=f"{label}  {curve.slope}",
            )
            if np.isfinite(low).any():
                low, high = (
                    np.maximum(low, y / 3),
                    np.minimum(high, 3 * y),
                )  # wider ones would hide the rest
                axis.fill_between(
                    x[good], low[good], high[good], color=look.colour, alpha=0.1, lw=0
                )
    logarithmic(axis, "seconds", "relMSE, mean of the seeds")
    _legend(axis, "method, slope")
    return figure


def front(
    points: Mapping[str, Sequence[tuple[float, float, bool]]], style: Mapping[str, Style]
) -> Figure:
    """Speed and accuracy: each method's (seconds, error, on the front); those on the front are
    filled and joined by a staircase."""
    figure, axis = _axes(5.6, 4.0)
    best = sorted(
        (t, e) for mine in points.values() for t, e, on_front in mine if on_front and e > 0
    )
    if best:
        axis.step(
            *zip(*best),
            where="post",
            color="#999999",
            lw=5,
            alpha=0.35,
            solid_joinstyle="round",
            zorder=0,
        )
    for label, mine in points.items():
        look, labelled = style[label], False
        for filled in (True, False):
            some = [(t, e) for t, e, on_front in mine if on_front == filled and e > 0]
            if some:
                axis.plot(
                    *zip(*some),
                    look.marker,
                    color=look.colour,
                    ms=8 if filled else 4,
                    mfc=look.colour if filled else "none",
                    label=None if labelled else label,
                    alpha=1 if filled else 0.7,
                )
                labelled = True
    logarithmic(axis, "seconds", "relMSE without the worst 0.1 %")
    _legend(axis, "large: on the front")
    return figure


def sweep(title: str, sweeps: Mapping[str, Sequence[Point]], style: Mapping[str, Style]) -> Figure:
    """Error against the parameter for each method; a ring and a cross mark where it breaks."""
    figure, axis = _axes(5.6, 3.6)
    for label, points in sweeps.items():
        look = style[label]
        x, y = [point.value for point in points], [point.error for point in points]
        axis.plot(
            x, y, look.dashes, color=look.colour, marker=look.marker, ms=4, lw=1.6, label=label
        )
        broken = [
            (point.value, point.error)
            for point, breaks_here in zip(points, breaks(points))
            if breaks_here and np.isfinite(point.error)
        ]
        if broken:
            axis.plot(*zip(*broken), "o", ms=12, mfc="none", mec=look.colour, mew=1.8)
            axis.plot(*zip(*broken), "x", ms=7, color=look.colour, mew=2)
    logarithmic(axis, title, "relMSE without the worst 0.1 %")
    _legend(axis, "ringed: breaks")
    return figure


def cost_by_count(
    curves: Mapping[str, Sequence[tuple[int, float]]], style: Mapping[str, Style], base: str
) -> Figure:
    """Each method's (number of views, variance x time over that of `base`); the base itself is the
    line at one."""
    figure, axis = _axes(4.6, 3.4)
    axis.axhline(1, color=style[base].colour, lw=2, alpha=0.6, label=base)
    for label, points in curves.items():
        look = style[label]
        axis.plot(
            *zip(*points),
            look.dashes,
            color=look.colour,
            marker=look.marker,
            ms=5,
            lw=1.6,
            label=label,
        )
    logarithmic(axis, "views", f"variance x time, {base} = 1")
    counts = sorted({count for points in curves.values() for count, _ in points})
    axis.xaxis.set_major_locator(FixedLocator(counts))
    axis.set_ylim(min(axis.get_ylim()[0], 0.7), max(axis.get_ylim()[1], 1.4))
    _legend(axis, "method")
    return figure


def by_share(curves: Mapping[str, Sequence[tuple[float, float]]]) -> Figure:
    """Variances of estimators, relative to that of the first, against the share of the weights that
    other views bring."""
    figure, axis = _axes(5.0, 3.4)
    for number, (label, points) in enumerate(curves.items()):
        colour, marker, dashes = (kind[number % len(kind)] for kind in (OTHERS, MARKERS, DASHES))
        axis.plot(*zip(*points), dashes, marker=marker, ms=5, lw=1.6, color=colour, label=label)
    axis.set(
        xlabel="share of other views in the pixel's weights",
        ylabel=f"variance, {next(iter(curves))} = 1",
        ylim=(0, None),
    )
    _legend(axis, "estimator")
    return figure


@dataclass(frozen=True)
class Line:
    """Ratios over a parameter's values, and the ends of their intervals (NaN: none)."""

    values: Sequence[float]
    ratios: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]


def ratios(
    rows: Sequence[str],
    columns: Sequence[str],
    panels: Sequence[Sequence[Mapping[str, Line]]],
    style: Mapping[str, Style],
    base: str,
) -> Figure:
    """A panel for each measure (`rows`, titles) and parameter (`columns`), lines by method, on
    logarithmic axes; grey: 1, what ratios are to (`base`)."""
    with rc_context(SETTINGS):
        figure = Figure(
            figsize=(2.7 * len(columns) + 1.9, 1.9 * len(rows) + 0.4), layout="constrained"
        )
        axes = figure.subplots(len(rows), len(columns), squeeze=False, sharex="col", sharey="row")
        for title, of_measure, across in zip(rows, panels, axes):
            for name, drawn, axis in zip(columns, of_measure, across):
                axis.axhline(1, color="#999999", lw=4, alpha=0.4, zorder=0)
                for label, line in drawn.items():
                    look = style[label]
                    axis.plot(
                        line.values,
                        line.ratios,
                        look.dashes,
                        color=look.colour,
                        marker=look.marker,
                        ms=4,
                        lw=1.6,
                        label=label,
                    )
                    if np.isfinite(line.low).any():
                        y = np.asarray(line.ratios)
                        axis.fill_between(
                            line.values,
                            np.maximum(line.low, y / 2),
                            np.minimum(line.high, 2 * y),
                            color=look.colour,
                            alpha=0.1,
                            lw=0,
                        )
                logarithmic(axis, name, title)
                axis.label_outer()
        _legend(axes[0, -1], f"grey: {base}")
    return figure


def convergence_of_samplers(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Variance of images (full lines) and relative variance (dashed) against iterations, a panel
    for each scene and method, a colour for each sampler.

    `rows`: mappings with ``scene``, ``method``, ``sampler``, ``iterations``, ``variance``,
    ``relative variance trimmed``."""
    panels = list(dict.fromkeys((row["scene"], row["method"]) for row in rows))
    samplers = list(dict.fromkeys(row["sampler"] for row in rows))
    with rc_context(SETTINGS):
        figure = Figure(figsize=(3.3 * len(panels), 3.4), layout="constrained")
        for axis, (scene, method) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels):
            for sampler, colour in zip(samplers, ("#1f77d0", "#222222")):
                mine = [
                    row
                    for row in rows
                    if (row["scene"], row["method"], row["sampler"]) == (scene, method, sampler)
                ]
                for name, dashes in (("variance", "-"), ("relative variance trimmed", "--")):
                    axis.plot(
                        [row["iterations"] for row in mine],
                        [row[name] for row in mine],
                        dashes,
                        color=colour,
                        marker="o",
                        markersize=3,
                        label=f"{sampler}, {name.removesuffix(' trimmed')}",
                    )
            axis.set_title(f"{scene}, {method}")
            logarithmic(axis, "iterations", "variance of the image")
        figure.axes[-1].legend(fontsize=7)
    return figure


def variance_maps(
    labels: Sequence[str],
    images: Sequence[np.ndarray],
    maps: Sequence[np.ndarray],
    notes: Sequence[str],
) -> Figure:
    """Pictures, (H, W, 3), above; maps of relative variance, (H, W), on one logarithmic scale
    below; a note under each label."""
    height, width = maps[0].shape
    with rc_context({"font.size": 9}):
        figure = Figure(
            figsize=(2.0 * len(maps) + 0.7, 4.0 * height / width + 1.0), layout="constrained"
        )
        axes = figure.subplots(2, len(maps), squeeze=False)
        logs = [np.log10(np.maximum(m, 1e-9)) for m in maps]
        seen = np.concatenate(
            [log[m > 0] for log, m in zip(logs, maps)]
        )  # where nothing varies, a lamp perhaps, is off the scale
        low, high = np.percentile(seen, [1, 99.5]) if seen.size else (-9, 0)
        white = np.quantile(images[0], 0.98)
        for column, (label, image, log, note) in enumerate(zip(labels, images, logs, notes)):
            axes[0, column].imshow(np.clip(image / white, 0, 1) ** (1 / 2.2))
            axes[0, column].set_title(label.replace(":", "\n").replace(",", "\n"))
            shown = axes[1, column].imshow(log, vmin=low, vmax=high, cmap="magma")
            axes[1, column].set_title(note)
        for axis in axes.flat:
            axis.set_axis_off()
        figure.colorbar(
            shown, ax=axes.ravel().tolist(), label="log10 relative variance", shrink=0.6, pad=0.01
        )
    return figure


def heat(values: np.ndarray, high: float = 1.0) -> np.ndarray:
    """An error map, (H, W), as colours: black for 0, through red to pale yellow for `high`."""
    return np.asarray(colormaps["magma"](np.clip(values / high, 0, 1)))[..., :3]


def save(figure: Figure, path: Path) -> str:
    """Write a PNG, and return the figure as SVG in a data URI, or as PNG where it holds images."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    if any(axis.images for axis in figure.axes):
        return data_uri(path.read_bytes(), "image/png")
    buffer = io.BytesIO()
    with rc_context(SETTINGS):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return data_uri(buffer.getvalue(), "image/svg+xml")


def data_uri(content: bytes, kind: str) -> str:
    """A file as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _axes(width: float, height: float) -> tuple[Figure, Any]:
    with rc_context(SETTINGS):
        figure = Figure(figsize=(width + 1.9, height), layout="constrained")
        axis = figure.subplots()
        axis.grid(True, which="major")
    return figure, axis


def logarithmic(axis: Any, x: str, y: str) -> None:
    """Logarithmic axes with plain numbers at 1, 2 and 5 times powers of ten, at powers alone where
    these are many."""
    axis.set(xscale="log", yscale="log", xlabel=f"{x} (log)", ylabel=f"{y} (log)")
    for one, (low, high) in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
        decades = np.log10(high / low)
        one.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 2.5 else (1,), numticks=12))
        one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        one.set_minor_locator(NullLocator())
        one.set_minor_formatter(NullFormatter())


def _legend(axis: Any, title: str) -> None:
    axis.legend(
        title=title,
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        frameon=False,
        fontsize=8,
        title_fontsize=8,
        alignment="left",
    )
