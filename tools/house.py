"""Draws `docs/images/house.svg`: the packages of `mis_integrators`, and which imports which.

    python tools/house.py            # draws it
    python tools/house.py --check    # says whether it is what would be drawn; exit code 1 if not

Rows, order and arrows come from the code's own imports, the text from the packages' docstrings.
"""

from __future__ import annotations

import ast
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from itertools import pairwise, permutations, product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HOUSE = ROOT / "mis_integrators"
PICTURE = ROOT / "docs" / "images" / "house.svg"
COMMAND = "app"
"""The package that `__main__` counts with: it is the command, too."""

BOX, GAP, ROOM, LINE = 236, 36, 46, 15
"""Width of a box, gaps between boxes and between rows, and height of a line of text, in pixels."""
COLUMNS = 35
"""Characters of a line."""

Graph = Mapping[str, set[str]]


# --- What imports what --------------------------------------------------------


def modules(folder: Path = HOUSE) -> dict[str, Path]:
    """The modules of a package by name: `mis_integrators.weights.recursion`."""
    found = {}
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(path.relative_to(folder.parent).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = path
    return found


def imports(name: str, path: Path, known: Mapping[str, Path]) -> set[str]:
    """Names of what a module imports, within functions too: a module where it is a known one, else
    what the statement says."""
    inner = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = inner.split(".")
            base = ".".join(parts[: len(parts) + 1 - node.level] if node.level else [])
            base = ".".join(filter(None, (base, node.module)))
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                found.add(whole if whole in known else base)
    return found


def statements() -> Iterator[tuple[str, str]]:
    """All pairs of a module of the house and what it imports."""
    known = modules()
    for name, path in known.items():
        for other in sorted(imports(name, path, known)):
            yield name, other


def package_of(name: str) -> str | None:
    """The package of a module; those at the top are one, `mis_integrators`."""
    first, *rest = name.split(".")
    if first != HOUSE.name:
        return None
    if rest == ["__main__"]:
        return COMMAND
    return rest[0] if rest and (HOUSE / rest[0]).is_dir() else first


def packages() -> dict[str, set[str]]:
    """The other packages that each package imports."""
    found: dict[str, set[str]] = {package_of(name): set() for name in modules()}
    for name, other in statements():
        if package_of(other) not in (None, package_of(name)):
            found[package_of(name)].add(package_of(other))
    return found


def docstring(package: str) -> str:
    """The first sentence of a package's docstring."""
    folder = HOUSE if package == HOUSE.name else HOUSE / package
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    return " ".join(text.split()).replace("``", "").replace("`", "").partition(". ")[0].rstrip(".")


# --- Where it stands ----------------------------------------------------------


def reachable(graph: Graph, start: str) -> set[str]:
    """Everything that `start` imports, directly or not."""
    found: set[str] = set()
    new = set(graph[start])
    while new:
        found |= new
        new = set().union(*(graph[name] for name in new)) - found
    return found


def rows_of(graph: Graph) -> dict[str, int]:
    """The row of each box, from below: above all that it imports. Packages that import each other
    share one; one that imports nothing stands as high as its importers allow."""
    below = {name: reachable(graph, name) for name in graph}
    row: dict[str, int] = {}

    def place(name: str) -> int:
        if name not in row:
            mates = {other for other in below[name] if name in below[other]}
            lower = set().union(*(graph[mate] for mate in mates | {name})) - mates - {name}
            row[name] = 1 + max((place(other) for other in lower), default=-1)
        return row[name]

    for name in graph:
        place(name)
    for name in graph:
        above = [row[other] for other in graph if name in graph[other]]
        if not graph[name] and above:
            row[name] = min(above) - 1
    return row


def arrows_of(graph: Graph) -> list[tuple[str, str]]:
    """The imports, without those that follow from others."""
    below = {name: reachable(graph, name) for name in graph}

    def follows(name: str, other: str) -> bool:
        return any(
            other in below[between] and name not in below[between] and between not in below[other]
            for between in graph[name]
        )

    return [
        (name, other) for name in graph for other in sorted(graph[name]) if not follows(name, other)
    ]


def order_of(
    row: Mapping[str, int], arrows: Sequence[tuple[str, str]]
) -> tuple[list[list[str]], dict[tuple[str, str], list[str]]]:
    """The boxes of each row from left to right, and the way of each arrow: through places that are
    kept free for it in the rows that it passes. Few arrows cross."""
    rows: list[list[str]] = [
        sorted(name for name in row if row[name] == y) for y in range(max(row.values()) + 1)
    ]
    ways = {}
    for name, other in arrows:
        passed = [f"{name} {other} {y}" for y in range(row[name] - 1, row[other], -1)]
        for place, y in zip(passed, range(row[name] - 1, row[other], -1)):
            rows[y].append(place)
        ways[name, other] = [name, *passed, other]
    steps = [step for way in ways.values() for step in pairwise(way)]
    for y in [*range(len(rows)), *reversed(range(len(rows)))] * 3:
        rows[y] = min(
            (list(one) for one in permutations(rows[y])),
            key=lambda one: cost([*rows[:y], one, *rows[y + 1 :]], steps),
        )
    return rows, ways


def places(rows: Sequence[Sequence[str]]) -> dict[str, tuple[float, int]]:
    """Middle of each box or free place, in widths of a box, each row centred; and its row."""
    return {
        name: (x - 0.5 * (len(row) - 1), y)
        for y, row in enumerate(rows)
        for x, name in enumerate(row)
    }


def cost(rows: Sequence[Sequence[str]], steps: Sequence[tuple[str, str]]) -> float:
    """Crossings of arrows, and a bit of their slant."""
    at = places(rows)
    ends = [(at[a][0], at[b][0], at[a][1]) for a, b in steps if at[a][1] != at[b][1]]
    crossings = sum(
        (a[0] - b[0]) * (a[1] - b[1]) < 0 for a, b in product(ends, ends) if a[2] == b[2]
    )
    return crossings + 0.1 * sum(abs(at[a][0] - at[b][0]) for a, b in steps)


# --- What is drawn ------------------------------------------------------------


def picture() -> str:
    """The SVG file's text."""
    graph = packages()
    row, arrows = rows_of(graph), arrows_of(graph)
    rows, ways = order_of(row, arrows)
    at = places(rows)
    texts = {name: textwrap.wrap(docstring(name), COLUMNS) for name in graph}
    heights = [34 + LINE * max(len(texts.get(name, ())) for name in one) for one in rows]
    tops = [GAP + sum(heights[y + 1 :]) + ROOM * (len(rows) - 1 - y) for y in range(len(rows))]
    width = max(len(one) for one in rows) * (BOX + GAP) + GAP
    whole = tops[0] + heights[0] + 2 * GAP

    def edges(name: str) -> tuple[float, float, float]:
        """Middle, upper and lower edge of a box or free place."""
        x, y = at[name]
        return width / 2 + x * (BOX + GAP), tops[y], tops[y] + heights[y]

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {whole}" width="{width}" '
        f'height="{whole}" font-family="Helvetica, Arial, sans-serif">',
        '<defs><marker id="head" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        'markerHeight="8" orient="auto-start-reverse"><path d="M0 0 8 4 0 8z" fill="#555"/>'
        "</marker></defs>",
        f'<rect width="{width}" height="{whole}" fill="#fff"/>',
    ]
    for (name, other), way in ways.items():
        if row[name] == row[other]:
            if (other, name) in ways and name > other:
                continue
            parts.append(_beside(edges(name), edges(other), (other, name) in ways))
        else:
            parts.append(_down([edges(place) for place in way]))
    for name, text in texts.items():
        x, top, bottom = edges(name)
        parts.append(
            f'<rect x="{x - BOX / 2:g}" y="{top:g}" width="{BOX}" height="{bottom - top:g}" rx="5" '
            'fill="#f4f6f8" stroke="#34506b"/>'
            f'<text x="{x:g}" y="{top + 20:g}" text-anchor="middle" font-size="15" '
            f'font-weight="bold" fill="#1b1f24">{name}</text>'
        )
        parts += [
            f'<text x="{x:g}" y="{top + 38 + LINE * number:g}" text-anchor="middle" '
            f'font-size="11.5" fill="#333">{escape(line)}</text>'
            for number, line in enumerate(text)
        ]
    parts.append(
        f'<text x="{width / 2:g}" y="{whole - 14}" text-anchor="middle" font-size="12" '
        'fill="#333">An arrow points to what a package imports; '
        "arrows that follow from others are left out.</text>"
    )
    return "\n".join([*parts, "</svg>"]) + "\n"


Edges = tuple[float, float, float]


def _beside(one: Edges, other: Edges, both: bool) -> str:
    """An arrow between two boxes of a row."""
    height = 0.5 * (one[1] + one[2])
    away = BOX / 2 if other[0] > one[0] else -BOX / 2
    return _line([(one[0] + away, height), (other[0] - away, height)], both)


def _down(way: Sequence[Edges]) -> str:
    """An arrow from the lower edge of a box to the upper edge of one below, at both ends towards
    where it goes; straight down where it passes a row."""

    def towards(x: float, goal: float) -> float:
        return x + 0.4 * BOX * (goal - x) / (abs(goal - x) + BOX)

    (x, _, lower), (goal, upper, _) = way[0], way[-1]
    points = [(towards(x, way[1][0]), lower)]
    for middle, top, bottom in way[1:-1]:
        points += [(middle, top), (middle, bottom)]
    return _line([*points, (towards(goal, way[-2][0]), upper)], False)


def _line(points: Sequence[tuple[float, float]], both: bool) -> str:
    start = ' marker-start="url(#head)"' if both else ""
    return (
        f'<polyline points="{" ".join(f"{x:g},{y:g}" for x, y in points)}" fill="none" '
        f'stroke="#555" stroke-width="1.4" marker-end="url(#head)"{start}/>'
    )


def main(arguments: Sequence[str]) -> int:
    text = picture()
    if "--check" in arguments:
        if PICTURE.exists() and PICTURE.read_text() == text:
            return 0
        print(f"{PICTURE.relative_to(ROOT)} is not what the code says: run tools/house.py")
        return 1
    PICTURE.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
