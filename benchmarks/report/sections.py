"""The sections of a page: summary, pictures, charts."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from mis_integrators.analysis import charts
from mis_integrators.analysis.metrics import relative_differences
from mis_integrators.analysis.zooms import telling_windows

import numpy as np

from common.measuring import Measurement
from common.methods import Method
from common.races import Race
from common.rows import Row
from common.swept import Swept
from common.winners import told_apart, too_late, winner
from report.page import FRAMES, ZOOM, card, chip, file_name, interval, short, styles_of
from report.tables import table

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
                f'<td class="{kind}" title="{interval(row, "trimmed ratio")}">'
                f"{short(row['trimmed ratio'])}{almost}</td>"
            )
        lines.append(
            f'<tr><td><a href="#{scene}">{scene}</a></td>'
            f'<td class="text">{chip(best["method"], style[best["method"]])}</td>'
            f"<td>{1 / best['trimmed ratio']:.1f} ×</td>{''.join(cells)}</tr>"
        )
    total = _geometric_means(ratios)
    head = "".join(f"<th>{chip(label, style[label])}</th>" for label in labels)
    return f"""<p>Error of each method {html.escape(what)}, over that of <b>{base}</b>
in the same run: below 1 is better. Relative mean square error without the worst 0.1 % of the
pixels; green: least error; red: more than three times {base}'s; ≈: not told apart from the winner
(95 %, by pairs of seeds). With seconds: one iteration takes longer than that, so it cannot win.
Tooltips: 95 % intervals.</p>
<div class="wide"><table><tr><th>scene</th><th class="text">winner</th>
<th>less error<br>than {base}</th>{head}</tr>
{"".join(lines)}
<tr class="total"><td>geometric mean</td><td></td><td></td>{total}</tr></table></div>"""


def _geometric_means(ratios: dict[str, list[float]]) -> str:
    """A cell a method. (A ratio can be below zero, where errors are products with noisy
    references.)"""
    means = [
        np.exp(np.mean(np.log(np.maximum(values, 1e-9)))) if values else None
        for values in ratios.values()
    ]
    return "".join("<td>-</td>" if mean is None else f"<td>{short(mean)}</td>" for mean in means)


def denoised(rows: Sequence[Row]) -> str:
    """Errors of the denoised images over those of the better `path`; empty where none were."""
    name, perceived = "denoised relMSE / best path", "denoised FLIP / best path"
    if not any(name in row for row in rows):
        return ""
    labels = list(dict.fromkeys(row["method"] for row in rows))
    style = styles_of(labels)
    lines, ratios = [], {label: [] for label in labels}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = {row["method"]: row for row in rows if row["scene"] == scene}
        cells = []
        for label in labels:
            row = mine.get(label)
            if row is not None:
                ratios[label].append(row[name])
            cells.append(
                "<td>cannot</td>"
                if row is None
                else f"<td>{short(row[name])} ({short(row[perceived])})</td>"
            )
        lines.append(f'<tr><td><a href="#{scene}">{scene}</a></td>{"".join(cells)}</tr>')
    means = _geometric_means(ratios)
    head = "".join(f"<th>{chip(label, style[label])}</th>" for label in labels)
    return f"""<p>The same images denoised, all with the same denoiser: relative mean square error
(and FLIP), over that of the better <b>path</b> denoised. Below 1 is better.</p>
<div class="wide"><table><tr><th>scene</th>{head}</tr>
{"".join(lines)}
<tr class="total"><td>geometric mean</td>{means}</tr></table></div>"""


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
        card(
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
            f"<b>{interval(row, 'trimmed ratio')} × {measurement.base.method.label}</b>"
            f"{seen}{row['samples_per_pixel']} spp in {row['seconds']:.1f} s, "
            f"relMSE {row['relMSE']:.3g}{bias}"
        )
        image = measured.images[0] / white
        cards.append(
            card(
                chip(label, style[label]),
                "best" if row is best else "",
                image,
                error_map,
                image,
                windows,
                folder / f"{name}_{file_name(label)}",
                caption,
            )
        )
    scale = "HDR-FLIP" if with_flip else "relative error |x - r| / (r + 0.1)"
    failures = "".join(
        f"<p class='soft'>{html.escape(label)} cannot render it: {html.escape(why)}</p>"
        for label, why in measurement.failures.items()
    )
    return (
        f'<p class="soft">Picture, error map ({scale}: 0 <span class="scale"></span> 1), '
        f"enlarged parts. {measurement.asked} each.</p>"
        f'<div class="pictures">{"".join(cards)}</div>{failures}'
    )


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
    return f"""<h3>{name}: error against time, and the front of speed and accuracy</h3>
<div class="charts">
<figure><img alt="error against time" src="{time_chart}"><figcaption>Lower is better. Slope: relMSE
is proportional to the samples, that is to time without the pilot before the first, to that power
(-1: noise alone; flatter: bias), ± half the 95 % interval over seeds.</figcaption></figure>
<figure><img alt="front" src="{front_chart}"><figcaption>Nothing is both faster and more accurate
than the points on the grey staircase.</figcaption></figure></div>"""


def _slope(fit: Row) -> str:
    if not np.isfinite(fit["slope"]):
        return ""
    half = 0.5 * (fit["slope high"] - fit["slope low"])
    return f"{fit['slope']:.2f}" + (f" ± {half:.2f}" if np.isfinite(half) else "")


def variance(name: str, picture: Path) -> str:
    """The variance maps of one scene, from the PNG that holds them."""
    uri = charts.data_uri(picture.read_bytes(), "image/png")
    return (
        f"<h3>{name}: variance of one iteration at equal merge radius</h3>"
        f'<figure class="chart"><img alt="variance maps" src="{uri}">'
        "<figcaption>Below each picture the relative variance of its pixels, all on one scale; in "
        "the title its mean over that of the best single strategy.</figcaption></figure>"
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
            f'<h3>{scene}</h3><div class="charts"><figure>'
            f'<img alt="cost by number of views" src="{chart}"></figure></div>'
            f'<div class="pictures">{_view_cards(scene, race, labels, style, folder)}</div>'
        )
    densities = charts.data_uri((folder / "multiview_densities.png").read_bytes(), "image/png")
    return f"""<h2 id="views">Many views at once</h2>
<p>The first 2, 4, 8, ... views of a scene, rendered together by <b>volpath_multiview</b>, and by
<b>volpath</b> one by one. The charts show relative variance times seconds over that of volpath:
below 1 is better. Variances are those between renders under different seeds. Pictures: some views
of the largest number, after equal time, with relative errors |x - r| / (r + 0.1), r the mean of all
other seeds of both.</p>
{"".join(parts)}{table(rows)}
<h3>Shifted null interactions</h3><figure class="chart"><img alt="densities" src="{densities}">
<figcaption>A segment of 9 m whose null interactions move to one of 3 m: their densities there by
each stretch, next to the target's own of tentative, null and real interactions.</figcaption>
</figure>"""


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
            caption = (
                f"view {view + 1} of {race.views}, {race.samples(label)} spp "
                f"in {race.seconds(label):.1f} s, mean error {error.mean():.3f}"
            )
            cards.append(
                card(
                    chip(label, style[label]),
                    "",
                    image / white,
                    error,
                    image,
                    [],
                    folder / f"views_{scene}_{view}_{file_name(label)}",
                    caption,
                )
            )
    return "".join(cards)


# --- Stability ----------------------------------------------------------------


def choices(rows: Sequence[Row]) -> str:
    """The best method of each scene, as a table."""
    return f"<h3>Which method for which scene</h3>{table(rows)}"


def stability(
    results: Sequence[Swept], choices: Sequence[Row], folder: Path, methods: Sequence[Method]
) -> str:
    """The sweeps' charts, and the table of choices that follows from them."""
    style = styles_of(
        [
            *(method.label for method in methods),
            *(label for swept in results for label in swept.points),
        ]
    )
    figures = []
    for swept in results:
        if swept.points:
            uri = charts.save(
                charts.sweep(swept.what, swept.points, style),
                folder / f"stability_{swept.name}.png",
            )
            figures.append(f'<figure><img alt="{swept.name}" src="{uri}"></figure>')
    return f"""<h2 id="stability">Where methods break</h2>
<p>Error in a small room, or in four views of smoke, against one parameter, the others fixed; the
first iteration of each (pilots, compiling) is free. A method breaks, ringed and crossed, where its
error exceeds three times its own median over the sweep, or its mean is off by more than 5 % and
four standard errors.</p>
<div class="charts">{"".join(figures)}</div>
<h3>Which method where</h3>{table(choices)}"""


def resampling(
    rows: Sequence[Row],
    methods: Sequence[str],
    measures: Mapping[str, str],
    parameters: Mapping[str, str],
    folder: Path,
) -> str:
    """Charts of the sweeps of `resampling`, one a scene.

    Ratios are to the first of the `methods`; `measures`: what is drawn, columns of the rows with
    their titles; `parameters`: what each sweep varies, in words.
    """
    base, *others = methods
    style, figures = styles_of(methods), []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        swept = [name for name in parameters if any(row["sweep"] == name for row in mine)]
        panels = [[lines(mine, others, name, measure) for name in swept] for measure in measures]
        figure = charts.ratios(
            list(measures.values()), [parameters[name] for name in swept], panels, style, base
        )
        uri = charts.save(figure, folder / f"resampling_{scene}.png")
        figures.append(
            f'<h3>{scene}</h3><figure class="chart">'
            f'<img alt="resampling on {scene}" src="{uri}"></figure>'
        )
    return f"""<h2 id="resampling">Resampled connections</h2>
<p>Ratios to {base}, below 1 is better: error after equal time; noise (relMSE without the worst
pixels) of one iteration; seconds of one iteration, noise times cost being what equal time leaves.
First iterations, with their pilots, are free. The other parameters keep their defaults. Shaded:
95 % over seeds.</p>
{"".join(figures)}"""


def lines(
    rows: Sequence[Row], methods: Sequence[str], sweep: str, measure: str
) -> dict[str, charts.Line]:
    """A line for each method, from the rows of one scene."""
    found = {}
    for label in methods:
        mine = [r for r in rows if r["sweep"] == sweep and r["method"] == label]
        if mine:
            found[label] = charts.Line(
                *(
                    [r[key] for r in mine]
                    for key in ("value", measure, f"{measure} low", f"{measure} high")
                )
            )
    return found
