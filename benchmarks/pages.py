"""The self-contained HTML page of a run: summary, pictures, charts; images are embedded, and lie
beside it as PNG."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template

from mis_integrators.analysis import charts
from mis_integrators.analysis.metrics import relative_differences
from mis_integrators.analysis.zooms import telling_windows
from mis_integrators.app.output import write_png

import mitsuba as mi
import numpy as np
from compare import told_apart, too_late, winner
from measuring import Measurement
from methods import Method
from multiview import Race
from reports import Row, machine

TEMPLATE = Path(__file__).with_name("page.html")
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
        about = machine()
        gradient = ", ".join(
            "#%02x%02x%02x" % tuple(int(255 * c) for c in charts.heat(np.array(i / 8)))
            for i in range(9)
        )
        text = "{date} · {processor}, {threads} threads · mis_integrators {mis_integrators} ({commit}), Mitsuba {mitsuba}, Dr.Jit {drjit}"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(
            Template(TEMPLATE.read_text()).substitute(
                title=html.escape(self.title),
                machine=html.escape(text.format(**about)),
                gradient=gradient,
                body="\n".join(self.sections),
            )
        )


def styles_of(labels: Sequence[str]) -> dict[str, charts.Style]:
    """Styles of all methods of a page."""
    return charts.styles(list(dict.fromkeys(labels)))


def chip(label: str, style: charts.Style) -> str:
    """A method's name with its colour."""
    return f'<span class="chip" style="background:{charts.colour_name(style)}"></span>{html.escape(label)}'


# --- Summary ------------------------------------------------------------------


def summary(rows: Sequence[Row], failures: dict[str, dict[str, str]], what: str) -> str:
    """The table on top: for each scene each method's error as a ratio to the base's, the winner
    marked."""
    labels = list(dict.fromkeys(row["method"] for row in rows))
    style = styles_of(labels)
    base = next(row["method"] for row in rows if row["trimmed ratio"] == 1)
    lines, ratios = [], {label: [] for label in labels}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = {row["method"]: row for row in rows if row["scene"] == scene}
        here = list(mine.values())
        best = winner(here)
        cells = []
        for label in labels:
            row = mine.get(label)
            if row is None:
                cells.append(
                    f'<td title="{html.escape(failures.get(scene, {}).get(label, ""))}">cannot</td>'
                )
                continue
            ratios[label].append(row["trimmed ratio"])
            late = too_late(row, here)
            kind = "win" if row is best else "worse" if row["trimmed ratio"] > 3 else ""
            almost = (
                f" in {row['seconds']:.1f} s"
                if late
                else " ≈"
                if row is not best and not told_apart(row, best)
                else ""
            )
            cells.append(
                f'<td class="{kind}" title="{_interval(row, "trimmed ratio")}">{_short(row["trimmed ratio"])}{almost}</td>'
            )
        lines.append(
            f'<tr><td><a href="#{scene}">{scene}</a></td><td class="text">{chip(best["method"], style[best["method"]])}</td>'
            f"<td>{1 / best['trimmed ratio']:.1f} ×</td>{''.join(cells)}</tr>"
        )
    means = [
        np.exp(np.mean(np.log(np.maximum(values, 1e-9)))) if values else None
        for values in ratios.values()
    ]
    total = "".join("<td>-</td>" if mean is None else f"<td>{_short(mean)}</td>" for mean in means)
    head = "".join(f"<th>{chip(label, style[label])}</th>" for label in labels)
    return f"""<p>Error of each method {html.escape(what)}, over that of <b>{base}</b> in the same run: below 1 is better. Relative mean
square error without the worst 0.1 % of the pixels; green: least error; red: more than three times {base}'s; ≈: not told apart from the winner
(95 %, by pairs of seeds). With seconds: one iteration takes longer than that, so it cannot win. Tooltips: 95 % intervals.</p>
<div class="wide"><table><tr><th>scene</th><th class="text">winner</th><th>less error<br>than {base}</th>{head}</tr>
{"".join(lines)}<tr class="total"><td>geometric mean</td><td></td><td></td>{total}</tr></table></div>"""


# --- Scenes -------------------------------------------------------------------


def pictures(measurement: Measurement, rows: Sequence[Row], folder: Path) -> str:
    """Each method's picture, its error map, two enlarged parts, and its figures; the reference
    first."""
    references, name = measurement.references, measurement.opened.name
    style = styles_of([row["method"] for row in rows])
    white = max(float(np.quantile(references.mean, 0.97)), 1e-9)
    found = [measured.perceived(references) for measured in measurement.methods]
    with_flip = all(found)
    maps = (
        [one[1] for one in found]
        if with_flip
        else [
            np.abs(relative_differences(measured.images[0], references)).mean(axis=-1)
            for measured in measurement.methods
        ]
    )
    windows = telling_windows(maps, ZOOM)
    framed = references.mean / white
    for (y, x), colour in zip(windows, FRAMES):
        framed[y : y + ZOOM, [x, min(x + ZOOM, framed.shape[1]) - 1]] = framed[
            [y, min(y + ZOOM, framed.shape[0]) - 1], x : x + ZOOM
        ] = colour
    best = winner(rows)
    cards = [
        _card(
            "reference",
            "",
            framed,
            None,
            references.mean / white,
            windows,
            folder / f"{name}_reference",
            f"{references.origin}; frames: enlarged parts",
        )
    ]
    for measured, row, error_map in zip(measurement.methods, rows, maps):
        label = row["method"]
        seen = f"FLIP {row['FLIP']:.3f}, " if row["FLIP"] is not None else ""
        bias = f", bias {max(row['bias share'], 0):.0%}" if row["bias share"] is not None else ""
        caption = (
            f"<b>{_interval(row, 'trimmed ratio')} × {measurement.base.method.label}</b>{seen}{row['samples_per_pixel']} spp "
            f"in {row['seconds']:.1f} s, relMSE {row['relMSE']:.3g}{bias}"
        )
        image = measured.images[0] / white
        cards.append(
            _card(
                chip(label, style[label]),
                "best" if row is best else "",
                image,
                error_map,
                image,
                windows,
                folder / f"{name}_{_file_name(label)}",
                caption,
            )
        )
    scale = "HDR-FLIP" if with_flip else "relative error |x - r| / (r + 0.1)"
    failures = "".join(
        f"<p class='soft'>{html.escape(label)} cannot render it: {html.escape(why)}</p>"
        for label, why in measurement.failures.items()
    )
    return (
        f'<p class="soft">Picture, error map ({scale}: 0 <span class="scale"></span> 1), enlarged parts. {measurement.asked} each.</p>'
        f'<div class="pictures">{"".join(cards)}</div>{failures}'
    )


def _card(
    title: str, kind: str, image, error_map, source, windows, path: Path, caption: str
) -> str:
    parts = [f'<img alt="" src="{_embed(image, path.with_suffix(".png"))}">']
    if error_map is not None:
        parts.append(
            f'<img alt="error map" src="{_embed(charts.heat(error_map) ** 2.2, path.with_name(path.name + "_error.png"))}">'
        )
    zooms = "".join(
        f'<img alt="" style="border-bottom:3px solid rgb({",".join(str(int(255 * c)) for c in colour)})" '
        f'src="{_embed(source[y : y + ZOOM, x : x + ZOOM], None)}">'
        for (y, x), colour in zip(windows, FRAMES)
    )
    return f'<figure class="{kind}"><b>{title}</b>{"".join(parts)}<div class="zooms">{zooms}</div><figcaption>{caption}</figcaption></figure>'


def _embed(image: np.ndarray, path: Path | None) -> str:
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


def convergence(
    measurement: Measurement, points: Sequence[Row], fitted: Sequence[Row], folder: Path
) -> str:
    """Error against time with slopes, and the Pareto front, of one scene."""
    name = measurement.opened.name
    labels = [row["method"] for row in fitted]
    style = styles_of(labels)
    curves, clouds = {}, {}
    for label, fit in zip(labels, fitted):
        mine = [row for row in points if row["method"] == label]
        curves[label] = charts.Curve(
            *(
                [row[key] for row in mine]
                for key in ("seconds", "relMSE", "relMSE low", "relMSE high")
            ),
            _slope(fit),
        )
        clouds[label] = [
            (row["seconds"], row["relMSE trimmed"], row["on the front"]) for row in mine
        ]
    time_chart = charts.save(charts.error_against_time(curves, style), folder / f"{name}_time.png")
    front_chart = charts.save(charts.front(clouds, style), folder / f"{name}_front.png")
    return f"""<h3>{name}: error against time, and the front of speed and accuracy</h3><div class="charts">
<figure><img alt="error against time" src="{time_chart}"><figcaption>Lower is better. Slope: relMSE is proportional to the samples, that is to time
without the pilot before the first, to that power (-1: noise alone; flatter: bias), ± half the 95 % interval over seeds.</figcaption></figure>
<figure><img alt="front" src="{front_chart}"><figcaption>Nothing is both faster and more accurate than
the points on the grey staircase.</figcaption></figure></div>"""


def _slope(fit: Row) -> str:
    if not np.isfinite(fit["slope"]):
        return ""
    half = 0.5 * (fit["slope high"] - fit["slope low"])
    return f"{fit['slope']:.2f}" + (f" ± {half:.2f}" if np.isfinite(half) else "")


def variance(name: str, picture: Path) -> str:
    """The variance maps of one scene, from the PNG that holds them."""
    uri = charts.data_uri(picture.read_bytes(), "image/png")
    return (
        f'<h3>{name}: variance of one iteration at equal merge radius</h3><figure class="chart"><img alt="variance maps" src="{uri}">'
        "<figcaption>Below each picture the relative variance of its pixels, all on one scale; in the title its mean over that of the "
        "best single strategy.</figcaption></figure>"
    )


# --- Several views ------------------------------------------------------------


def view_counts(rows: Sequence[Row], races: Mapping[str, Race], folder: Path) -> str:
    """Cost against the number of views, scene by scene; pictures of the first, the middle and the
    last view of the largest number; the table."""
    labels = ["volpath", *dict.fromkeys(row["method"] for row in rows)]
    style = styles_of(labels)
    parts = []
    for scene, race in races.items():
        mine = [row for row in rows if row["scene"] == scene]
        curves = {
            label: [(row["views"], row["ratio"]) for row in mine if row["method"] == label]
            for label in labels[1:]
        }
        chart = charts.save(
            charts.cost_by_count(curves, style, "volpath"), folder / f"views_{scene}.png"
        )
        parts.append(
            f'<h3>{scene}</h3><div class="charts"><figure><img alt="cost by number of views" src="{chart}"></figure></div>'
            f'<div class="pictures">{_view_cards(scene, race, labels, style, folder)}</div>'
        )
    densities = charts.data_uri((folder / "multiview_densities.png").read_bytes(), "image/png")
    return f"""<h2 id="views">Many views at once</h2>
<p>The first 2, 4, 8, ... views of a scene, rendered together by <b>volpath_multiview</b>, and by <b>volpath</b> one by one.
The charts show relative variance times seconds over that of volpath: below 1 is better. Variances are those between renders under
different seeds. Pictures: some views of the largest number, after equal time, with relative errors |x - r| / (r + 0.1), r the mean of all
other seeds of both.</p>
{"".join(parts)}{table(rows)}
<h3>Shifted null interactions</h3><figure class="chart"><img alt="densities" src="{densities}"><figcaption>A segment of 9 m whose null interactions
move to one of 3 m: their densities there by each stretch, next to the target's own of tentative, null and real interactions.</figcaption></figure>"""


def _view_cards(scene: str, race: Race, labels: Sequence[str], style, folder: Path) -> str:
    """Each chosen view by each method, under the first seed."""
    reference = np.mean([image for label in labels for image in race.images[label][1:]], axis=0)
    white = max(float(np.quantile(reference, 0.97)), 1e-9)
    cards = []
    for view in sorted({0, race.views // 2, race.views - 1}):
        truth = np.array_split(reference, race.views, axis=1)[view]
        for label in labels:
            image = np.array_split(race.images[label][0], race.views, axis=1)[view]
            error = (np.abs(image - truth) / (truth + 0.1)).mean(axis=-1)
            caption = f"view {view + 1} of {race.views}, {race.samples(label)} spp in {race.seconds(label):.1f} s, mean error {error.mean():.3f}"
            cards.append(
                _card(
                    chip(label, style[label]),
                    "",
                    image / white,
                    error,
                    image,
                    [],
                    folder / f"views_{scene}_{view}_{_file_name(label)}",
                    caption,
                )
            )
    return "".join(cards)


# --- Stability ----------------------------------------------------------------


def choices(rows: Sequence[Row]) -> str:
    """The best method of each scene, as a table."""
    return f"<h3>Which method for which scene</h3>{table(rows)}"


def stability(results, folder: Path, methods: Sequence[Method]) -> str:
    """The sweeps' charts, and the table of choices that follows from them."""
    from stability import choice_rows

    style = styles_of(
        [
            *(method.label for method in methods),
            *(label for _, points in results for label in points),
        ]
    )
    figures, rows = [], []
    for sweep, points in results:
        if points:
            uri = charts.save(
                charts.sweep(sweep.what, points, style), folder / f"stability_{sweep.name}.png"
            )
            figures.append(f'<figure><img alt="{sweep.name}" src="{uri}"></figure>')
            rows += choice_rows(sweep, points)
    return f"""<h2 id="stability">Where methods break</h2>
<p>Error in a small room, or in four views of smoke, against one parameter, the others fixed; the first iteration of each (pilots, compiling) is
free. A method breaks, ringed and
crossed, where its error exceeds three times its own median over the sweep, or its mean is off by more than 5 % and four standard errors.</p>
<div class="charts">{"".join(figures)}</div>
<h3>Which method where</h3>{table(rows)}"""


def resampling(rows: Sequence[Row], folder: Path) -> str:
    """Charts of the sweeps of `resampling`, one a scene."""
    from resampling import BASE, MEASURES, METHODS, SWEEPS, lines

    style, figures = styles_of(METHODS), []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        swept = [sweep for sweep in SWEEPS if any(row["sweep"] == sweep.name for row in mine)]
        panels = [[lines(mine, sweep, measure) for sweep in swept] for measure in MEASURES]
        figure = charts.ratios(
            list(MEASURES.values()), [sweep.what for sweep in swept], panels, style, BASE
        )
        uri = charts.save(figure, folder / f"resampling_{scene}.png")
        figures.append(
            f'<h3>{scene}</h3><figure class="chart"><img alt="resampling on {scene}" src="{uri}"></figure>'
        )
    return f"""<h2 id="resampling">Resampled connections</h2>
<p>Ratios to {BASE}, below 1 is better: error after equal time; noise (relMSE without the worst pixels) of one iteration; seconds of one iteration, noise times cost
being what equal time leaves. First iterations, with their pilots, are free. The other parameters keep their defaults. Shaded: 95 % over seeds.</p>
{"".join(figures)}"""


def table(rows: Sequence[Row]) -> str:
    """Rows as a table."""
    if not rows:
        return ""
    head = "".join(f'<th class="text">{html.escape(name)}</th>' for name in rows[0])
    body = "".join(
        "<tr>"
        + "".join(
            f"<td>{value:.3g}</td>"
            if isinstance(value, (int, float))
            else f'<td class="text">{html.escape(str(value))}</td>'
            for value in row.values()
        )
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def _interval(row: Row, name: str) -> str:
    if not np.isfinite(row[f"{name} low"]) or row[f"{name} low"] == row[f"{name} high"]:
        return _short(row[name])
    return f"{_short(row[name])} ({_short(row[f'{name} low'])} to {_short(row[f'{name} high'])})"


def _short(value: float) -> str:
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


def _file_name(label: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in label)
