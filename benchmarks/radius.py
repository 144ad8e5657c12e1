"""How good the automatic radius is: its equal-time relMSE next to that of a sweep of radii, factor sqrt 2."""

from __future__ import annotations

import argparse

import numpy as np

from mis_integrators.analysis.metrics import References, decompose, mean_errors
from compare import chosen
from methods import Method, SessionMaker
from references import colours, find_references
from reports import Row, save, show, tell
from scene_files import OpenScene, open_scene, scaled_size
from turns import Contender, take_turns

STEP = 2**0.5
AUTOMATIC, CHOSEN = "automatic", "chosen, pilot free"
COLUMNS = ("scene", "bdd", "time", "automatic", "best", "auto / best radius", "auto relMSE", "best relMSE",
           "auto / best relMSE", "choice / best relMSE", "first", "iterations", "best iterations", "note")


def run(options: argparse.Namespace) -> None:
    """The sub-command ``radius``."""
    sweeps: list[Row] = []
    summary: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        references = find_references(opened, options, tell)
        for bdd in options.bdd:
            for seconds in options.time:
                rows = sweep(opened, references, bdd, seconds, options.radii, options.seeds)
                if rows:
                    sweeps += rows
                    summary.append(judge(rows))
                    show("Automatic radius against the best of a sweep", summary, COLUMNS)
                    save(options.out, "radius", summary, vars(options))
                    save(options.out, "radius_sweep", sweeps, vars(options))


def sweep(
    opened: OpenScene, references: References, bdd: int, seconds: float, radii: int, seeds: int
) -> list[Row]:
    """A row for the automatic radius, one for each of ``radii`` radii around it, and one for the automatic
    choice without the time of its pilot; none if nothing is gathered."""
    automatic = SessionMaker(Method(AUTOMATIC, "bdpm", {"bdd": bdd}), opened, seconds)
    fixed: list[SessionMaker] = []
    runs: list[list[Contender]] = []
    for seed in range(seeds):
        first = Contender.begin(AUTOMATIC, automatic.make, seed)
        first.iterate()
        fixed = fixed or sweep_around(central_radius(first.session.settings), radii, bdd, opened, seconds)
        if not fixed:
            return []
        others = [Contender.begin(maker.method.label, maker.make, seed) for maker in fixed]
        free = Contender.begin(CHOSEN, automatic.make, seed)
        adopt_choice(free.session, first.session)
        take_turns([first, *others, free], seconds, tell)
        runs.append([first, *others, free])

    rows: list[Row] = []
    for mine in zip(*runs):
        renders = [colours(contender.session) for contender in mine]
        mean, parts = mean_errors(renders, references), decompose(renders, references)
        rows.append({
            "scene": opened.name,
            "size": "{}x{}".format(*opened.size),
            "bdd": bdd,
            "time": seconds,
            "seeds": seeds,
            "radius": mine[0].label,
            "value": central_radius(mine[-1].session.settings),
            "iterations": round(np.mean([c.session.iterations for c in mine])),
            "seconds": float(np.mean([c.rendering for c in mine])),
            "first": float(np.mean([c.first for c in mine])),
            "relMSE": mean.relmse,
            "relMSE trimmed": mean.relmse_trimmed,
            "MSE": mean.mse,
            "bias share": parts and parts.bias_share,
            "settings": chosen(mine[-1].session.settings),
            "references": references.origin,
        })
    return rows


def sweep_around(
    centre: float | None, radii: int, bdd: int, opened: OpenScene, seconds: float
) -> list[SessionMaker]:
    """Sessions with ``radii`` radii around one, factor sqrt 2; none around ``None``."""
    if centre is None:
        return []
    around = centre * STEP ** (np.arange(radii) - (radii - 1) // 2)
    return [
        SessionMaker(Method(f"{radius:.4g}", "bdpm", {"bdd": bdd, "initial_radius": radius}), opened, seconds)
        for radius in around.tolist()
    ]


def central_radius(settings: dict) -> float | None:
    """Geometric mean of the radii that a session chose; ``None`` if it needs none."""
    radii = [value for name, value in settings.items() if name.startswith("radius.")]
    return float(np.exp(np.mean(np.log(radii)))) if radii else None


def adopt_choice(session, pilot) -> None:
    """Give a session the radii that another one chose, so that it needs no pilot of its own."""
    session.radii, session.corrected = dict(pilot.radii), dict(pilot.corrected)


def judge(rows: list[Row]) -> Row:
    """The automatic radius' row, and that of its choice made for free, against the best row of the sweep."""
    automatic, *others, chosen_for_free = rows
    best = min(others, key=lambda row: row["relMSE"])
    at_end = best in (others[0], others[-1])
    return {
        **{name: automatic[name] for name in ("scene", "size", "bdd", "time", "seeds")},
        "automatic": automatic["settings"],
        "best": best["value"],
        "auto / best radius": automatic["value"] / best["value"],
        "auto relMSE": automatic["relMSE"],
        "best relMSE": best["relMSE"],
        "auto / best relMSE": automatic["relMSE"] / best["relMSE"],
        "choice / best relMSE": chosen_for_free["relMSE"] / best["relMSE"],
        "first": automatic["first"],
        "iterations": automatic["iterations"],
        "best iterations": best["iterations"],
        "auto bias share": automatic["bias share"],
        "note": "best at the sweep's end" if at_end else "",
        "references": automatic["references"],
    }
