"""What became slower or noisier since an earlier run, beyond the noise of both: ratios to `path` of
the same run are compared."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from mis_integrators.analysis.confidence import t_quantile, t_two_sided

from common.rows import Row, console, document, show

HISTORY = Path(__file__).resolve().parents[1] / "history"
FALSE_ALARM = 0.05
"""Expected share of false ones among the changes named; for two runs of one program, the
probability that any is named."""
JUDGED = {
    "cost ratio": "slower",
    "relMSE ratio": "noisier",
    "trimmed ratio": "noisier without outliers",
}
"""Ratios to `path` that are compared, and what it is called when they grow: seconds a sample per
pixel, relMSE after equal time."""
SAME = ("scene", "size", "method")
"""What makes rows of two runs comparable, besides the time or samples that each method had."""


def record(rows: Sequence[Row], settings: Mapping) -> Path:
    """Keep the figures of a run in `benchmarks/history`, named by version and commit."""
    kept = document(rows, settings)
    commit = (kept["machine"]["commit"] or "unknown").replace("+", "-")
    HISTORY.mkdir(exist_ok=True)
    path = HISTORY / f"{kept['machine']['mis_integrators']}-{commit}.json"
    path.write_text(json.dumps(kept, indent=1, default=str) + "\n")
    console.print(f"figures kept in {path}")
    return path


def report(rows: Sequence[Row], baseline: Path) -> list[Row]:
    """Print what changed against the figures of an earlier run (`compare.json`, or an entry of the
    history)."""
    kept = json.loads(baseline.read_text())
    changes, compared = find_changes(rows, kept["rows"])
    machine = kept["machine"]
    console.print(
        f"baseline: {machine['mis_integrators']} at {machine.get('commit')}, "
        f"{machine['processor']}, {machine['threads']} threads"
    )
    if not compared:
        console.print(
            "no figures in common (scene, size, method, time, several seeds): nothing compared"
        )
    elif changes:
        how = f"{compared} figures compared, false discovery rate {FALSE_ALARM:g}"
        show(f"Changed beyond the noise ({how})", changes)
    else:
        console.print(f"nothing changed beyond the noise ({compared} figures compared)")
    return changes


def find_changes(rows: Sequence[Row], before: Sequence[Row]) -> tuple[list[Row], int]:
    """Figures that grew or shrank significantly, and how many were compared.

    Logarithms of ratios are compared by Welch's t test, and changes named by the procedure of
    Benjamini and Hochberg at the false discovery rate `FALSE_ALARM`. Of each figure both runs need
    a standard error, that is several seeds (five or more see much more than two); the base's own
    ratios are one by definition and left out.
    """
    earlier = {_key(row): row for row in before}
    tests = sorted(
        (
            _test(row, earlier[_key(row)], name)
            for row in rows
            for name in JUDGED
            if _key(row) in earlier and all(_judgeable(r, name) for r in (row, earlier[_key(row)]))
        ),
        key=lambda test: test[0],
    )
    named = max(
        (rank for rank, test in enumerate(tests, 1) if test[0] <= FALSE_ALARM * rank / len(tests)),
        default=0,
    )
    changes = [_in_words(*test[1:]) for test in tests[:named]]
    return sorted(changes, key=lambda change: -change["change"]), len(tests)


def _change(row: Row, old: Row, name: str) -> tuple[float, float, float]:
    """Logarithm of the change of one figure, its standard error, and Welch's degrees of freedom."""
    new2, old2 = row[f"{name} error"] ** 2, old[f"{name} error"] ** 2
    freedom = (new2 + old2) ** 2 / (new2**2 / (row["seeds"] - 1) + old2**2 / (old["seeds"] - 1))
    return math.log(row[name] / old[name]), math.sqrt(new2 + old2), freedom


def _test(row: Row, old: Row, name: str) -> tuple[float, Row, Row, str]:
    """Probability of so large a change of one figure by chance, and what was compared."""
    change, error, freedom = _change(row, old, name)
    return t_two_sided(abs(change) / error, freedom), row, old, name


def _in_words(row: Row, old: Row, name: str) -> Row:
    change, error, freedom = _change(row, old, name)
    half = t_quantile(0.05, freedom) * error
    words = JUDGED[name] if change > 0 else f"less so: {JUDGED[name]}"
    return {
        **{key: row[key] for key in SAME},
        "what": words,
        "figure": name,
        "before": old[name],
        "now": row[name],
        "change": math.exp(change),
        "from": math.exp(change - half),
        "to": math.exp(change + half),
    }


def _key(row: Row) -> tuple:
    return (*(row[name] for name in SAME), row["asked"])


def _judgeable(row: Row, name: str) -> bool:
    ratio, error = row[name], row[f"{name} error"]
    return ratio is not None and error is not None and ratio > 0 and error > 0
