"""The tables of docs/results.md, written from docs/results.json between markers of the page."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence

from common.rows import Row

Entry = Mapping
"""What a part found in a scene: ``command``, ``machine`` and ``rows``."""
Figures = Mapping[str, Mapping[str, Entry]]
"""Entries by part and scene."""

TITLES = {
    "cbox_glass_mirror_ceiling": "SmallVCM's Cornell box, glass and mirror spheres, area light",
    "cbox_empty_point": "SmallVCM's Cornell box, diffuse, point light",
}
"""Names for scenes that are not in this repository."""
NOT_YET = "Not measured yet: `make figures` does it."
PLAIN, STRATIFIED = "path", "path:sampler=multijitter"
IN_MEDIA = "volpath", "volpath:sampler=multijitter"
"""The same in scenes with media."""


def page(text: str, figures: Figures) -> str:
    """The page's text with the tables that follow from the figures, each between the markers
    ``<!-- NAME -->`` and ``<!-- end of NAME -->``."""
    for name, table in TABLES.items():
        begin, end = markers(name)
        found = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
        if len(found.findall(text)) != 1:
            raise ValueError(f"the page has no place for {name}, or more than one: {begin}")
        entries = figures.get(name, {})
        inside = f"{table(entries)}\n\n{stamps(entries)}" if entries else NOT_YET
        replacement = f"{begin}\n\n{inside}\n\n{end}"
        text = found.sub(lambda _, new=replacement: new, text)
    return text


def markers(name: str) -> tuple[str, str]:
    """What stands before and behind a table of the page."""
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def stamps(entries: Mapping[str, Entry]) -> str:
    """The command that found the figures, and where: a paragraph each, with its scenes where there
    are several."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for scene, entry in entries.items():
        machine = entry["machine"]
        key = (
            entry["command"],
            str(machine["commit"]),
            str(machine["date"])[:10],
            f"{machine['threads']} threads of {machine['processor']}",
        )
        groups.setdefault(key, []).append(scene)
    paragraphs = []
    for (command, commit, date, where), scenes in groups.items():
        which = f"{_names(scenes)}: commit" if len(groups) > 1 else "Commit"
        paragraphs += [f"    python benchmarks/run.py {command}"]
        paragraphs += [f"{which} `{commit}`, {date}, {where}."]
    return "\n\n".join(paragraphs)


def short(value: float | None) -> str:
    """A figure of two digits, or of more before the point."""
    if value is None or not math.isfinite(value):
        return "-"
    if value <= 0:
        return f"{value:.2g}"
    return f"{value:.{min(max(1 - math.floor(math.log10(value)), 0), 9) if value < 1 else 2}f}"


def ten_seconds(entries: Mapping[str, Entry]) -> str:
    """relMSE and MSE over those of the better `path`, and their geometric means."""
    return _over_path(entries, "relMSE / best path", "MSE / best path", "10 s")


def denoised(entries: Mapping[str, Entry]) -> str:
    """relMSE and FLIP of denoised images over those of the better `path`, denoised, too."""
    columns = "denoised relMSE / best path", "denoised FLIP / best path"
    return _over_path(entries, *columns, "10 s, denoised")


def in_media(entries: Mapping[str, Entry]) -> str:
    """relMSE and MSE over those of the better `volpath`."""
    columns = "relMSE / best path", "MSE / best path"
    return _over_path(entries, *columns, "20 s, in media", IN_MEDIA)


def _over_path(
    entries: Mapping[str, Entry],
    first: str,
    second: str,
    corner: str,
    path: tuple[str, str] = (PLAIN, STRATIFIED),
) -> str:
    """A row a scene: the `path` with the stratified sampler over the plain one, then each method's
    two ratios."""
    plain, stratified = path
    labels = [label for label in _labels(entries) if label not in path]
    lines, pairs = [], {}
    for scene, entry in sorted(entries.items()):
        rows = _by_method(entry)
        cells = []
        for label in (stratified, *labels):
            if label not in rows:
                cells.append("-")
                continue
            base = rows[plain] if label == stratified else {first: 1.0, second: 1.0}
            pair = [_ratio(rows[label][name], base[name]) for name in (first, second)]
            pairs.setdefault(label, []).append(pair)
            cells.append(_two(pair))
        lines.append([title(scene), *cells])
    means = [
        _two([geometric_mean(column) for column in zip(*pairs[label])])
        for label in (stratified, *labels)
    ]
    head = [corner, "`multijitter` over `independent`", *map(method_title, labels)]
    return markdown(head, [*lines, [f"geometric mean of {len(lines)}", *means]])


def choice(entries: Mapping[str, Entry]) -> str:
    """How far `bdpm_auto` is behind the better `path`, and how often, by rendering time."""
    return _behind(entries, "")


def choice_denoised(entries: Mapping[str, Entry]) -> str:
    """The same of denoised images."""
    return _behind(entries, "denoised ")


BEHIND = 1.05
"""From which ratio on a row counts as behind."""


def _behind(entries: Mapping[str, Entry], kind: str) -> str:
    """A row for each rendering time: geometric mean, largest, and how many are behind."""
    measures = "relMSE", "MSE"
    found = [row for entry in entries.values() for row in entry["rows"]]
    lines = []
    for seconds in sorted({row["seconds"] for row in found}):
        rows = [row for row in found if row["seconds"] == seconds]
        cells = [f"{seconds:g} s", str(sum(row["chosen"] != "path" for row in rows))]
        for measure in measures:
            ratios = [row[f"{kind}{measure} / best path"] for row in rows]
            behind = sum(ratio > BEHIND for ratio in ratios)
            cells += [short(geometric_mean(ratios)), short(max(ratios)), f"{behind} of {len(rows)}"]
        lines.append(cells)
    head = [f"{kind or 'raw '}images after", "photons chosen"]
    for measure in measures:
        head += [f"{measure}, geometric mean", "largest", f"above {BEHIND:g}"]
    return markdown(head, lines)


def short_renders(entries: Mapping[str, Entry]) -> str:
    """relMSE without the worst pixels over that of the better `path`, and the least of all."""
    labels = [label for label in _labels(entries) if label not in (PLAIN, STRATIFIED)]
    lines = []
    for scene, entry in sorted(entries.items()):
        rows, least = _by_method(entry), entry["least"]
        better = min(rows[label]["trimmed ratio"] for label in (PLAIN, STRATIFIED))
        cells = [
            short(_ratio(rows[label]["trimmed ratio"], better)) if label in rows else "-"
            for label in labels
        ]
        lines.append([title(scene), *cells, _list(least["best"]), _list(least["about as good"])])
    head = ["1.5 s", *map(method_title, labels), "least error", "about as good"]
    return markdown(head, lines)


def charts(entries: Mapping[str, Entry]) -> str:
    """Which methods are on the front of speed and accuracy."""
    lines = []
    for scene, entry in sorted(entries.items()):
        front = sorted((r for r in entry["rows"] if r["on the front"]), key=lambda r: r["seconds"])
        steps = [f"`{row['method']}` at {row['seconds']:.2f} s" for row in front]
        lines.append([title(scene), ", ".join(steps)])
    return markdown(["scene", "on the front: nothing is both faster and more accurate"], lines)


def stability(entries: Mapping[str, Entry]) -> str:
    """Ranges of the floor's roughness with the same best method."""
    head = ["roughness of the floor", "least error", "about as good", "breaks"]
    lines = [
        [
            short(row["from"]) if row["from"] == row["to"] else f"{row['from']:g} to {row['to']:g}",
            *(_list(row[name]) for name in ("best", "about as good", "breaks")),
        ]
        for entry in entries.values()
        for row in entry["rows"]
    ]
    return markdown(head, lines)


def variance(entries: Mapping[str, Entry]) -> str:
    """Variance and time of one iteration over those of the better single strategy."""
    names = "ratio to best single", "time ratio", "equal-time ratio"
    head = [
        "`cornell_glossy`, one iteration",
        "variance over that of the better single strategy",
        "time",
        "variance x time",
    ]
    lines = [
        [method_title(row["method"]), *(short(row[name]) for name in names)]
        for entry in entries.values()
        for row in entry["rows"]
    ]
    return markdown(head, lines)


THROUGHPUT = {
    "light pass": "light ms",
    "grid": "grid ms",
    "camera pass": "camera ms",
    "gather": "gather ms",
    "direct light": "direct ms",
}
"""Parts of an iteration, and the columns of their milliseconds."""


def throughput(entries: Mapping[str, Entry]) -> str:
    """Time of an iteration in samples of `path`, and the shares of its parts."""
    head = ["scene", "samples of `path` (with edge probes)", *THROUGHPUT, "no kernel"]
    lines = []
    for scene, entry in sorted(entries.items()):
        for row in entry["rows"]:
            shares = [row[name] / row["iteration ms"] for name in THROUGHPUT.values()]
            lines.append(
                [
                    title(scene),
                    f"{row['ratio']:.1f} ({row['ratio with probes']:.1f})",
                    *(f"{100 * share:.0f} %" for share in (*shares, row["no kernel share"])),
                ]
            )
    return markdown(head, lines)


def parsimony(entries: Mapping[str, Entry]) -> str:
    """What a scene has no use for, and how much longer an iteration takes with a part of it."""
    parts = sorted({row["left out"] for e in entries.values() for row in e["rows"]} - {None})
    lines = []
    for scene, entry in sorted(entries.items()):
        found = {row["left out"]: row["iteration with it / without"] for row in entry["rows"]}
        cells = [short(found[part]) if part in found else "needed" for part in parts]
        lines.append([title(scene), entry["rows"][0]["all left out"] or "nothing", *cells])
    return markdown(["scene", "left out", *(f"with {part}" for part in parts)], lines)


def multiview(entries: Mapping[str, Entry]) -> str:
    """Variance times time of several views together over that of each alone."""
    head = ["scene", "views", "variance x time over that of `volpath`", "best view", "worst view"]
    lines = [
        [title(scene), str(row["views"]), *(short(row[n]) for n in ("ratio", "best view"))]
        + [short(row["worst view"])]
        for scene, entry in sorted(entries.items())
        for row in entry["rows"]
    ]
    return markdown(head, lines)


TABLES: dict[str, Callable[[Mapping[str, Entry]], str]] = {
    "compare10": ten_seconds,
    "denoised10": denoised,
    "choice": choice,
    "choice_denoised": choice_denoised,
    "compare1.5": short_renders,
    "charts": charts,
    "stability": stability,
    "variance": variance,
    "throughput": throughput,
    "parsimony": parsimony,
    "media20": in_media,
    "media_charts": charts,
    "multiview": multiview,
}
"""What makes each table, by the part that it is of."""


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table of Markdown."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def title(scene: str) -> str:
    """What the page calls a scene."""
    return TITLES.get(scene, f"`{scene}`")


def method_title(label: str) -> str:
    """What heads a method's column: `bdpm`, `bdd=0`."""
    plugin, _, parameters = label.partition(":")
    return ", ".join(f"`{part}`" for part in (plugin, *filter(None, parameters.split(","))))


def _list(labels: str) -> str:
    """Methods as the command line names them, of a list with commas; "-" is an empty one."""
    return ", ".join(f"`{label}`" for label in labels.split(", ") if label != "-") or "none"


def geometric_mean(values: Iterable[float | None]) -> float | None:
    """Of those above zero that there are. (Errors are products with noisy references, and can be
    below zero.)"""
    logs = [math.log(value) for value in values if value is not None and value > 0]
    return math.exp(sum(logs) / len(logs)) if logs else None


def _ratio(value: float | None, base: float | None) -> float | None:
    return None if value is None or not base else value / base


def _two(pair: Sequence[float | None]) -> str:
    return f"{short(pair[0])} ({short(pair[1])})"


def _names(scenes: Sequence[str]) -> str:
    return ", ".join(title(scene) for scene in sorted(scenes))


def _by_method(entry: Entry) -> dict[str, Row]:
    return {row["method"]: row for row in entry["rows"]}


def _labels(entries: Mapping[str, Entry]) -> list[str]:
    """All methods, in their order."""
    return list(dict.fromkeys(row["method"] for e in entries.values() for row in e["rows"]))
