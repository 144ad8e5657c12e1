"""How good the automatic radius is: its equal-time relMSE next to that of a sweep of radii, factor
sqrt 2.

Iterations are independent and the radius does not change from one to the next, so the error after n
of them is bias^2 + V / n. Each radius renders for a few seconds, in turns with the others; bias^2,
the variance V of an iteration, and the seconds of an iteration and of what goes before the first
then give the error at any time. The automatic radius is a draw, since a pilot chooses it: several
are judged.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import chain

from mis_integrators.analysis.metrics import TRIMMED_SHARE, References, relative_squared_errors

import numpy as np

from common.methods import Method, SessionMaker
from common.references import colours, find_references
from common.rows import Row, save, show, tell
from common.scene_files import OpenScene, open_scene, scaled_size
from common.turns import Contender, take_turns
from experiments.compare import chosen

STEP = 2**0.5
ONE_PATH = {"variance": True, "camera_paths": 1, "sampler": "independent"}
"""What all renderings have in common: the automatic one must owe nothing to another number of
camera paths, and the noise of low-discrepancy numbers follows another law."""
FEWEST_ITERATIONS = 12
TRIMMED = " trimmed"
COLUMNS = (
    "scene",
    "bdd",
    "time",
    "automatic",
    "best radius trimmed",
    "auto / best trimmed",
    "choice / best trimmed",
    "best radius",
    "auto / best",
    "choice / best",
    "set-up",
    "bias share",
)


def run(options: argparse.Namespace) -> None:
    """The sub-command ``radius``."""
    sweeps: list[Row] = []
    rows: list[Row] = []
    summary: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        references = find_references(opened, options, tell)
        for bdd in options.bdd:
            automatic, fixed = sweep(
                opened,
                references,
                bdd,
                options.time,
                options.rendering,
                options.radii,
                options.pilots,
            )
            place = {
                "scene": opened.name,
                "size": "{}x{}".format(*opened.size),
                "bdd": bdd,
                "references": references.origin,
            }
            every = chain(fixed, *automatic.values())
            sweeps += [{**place, **vars(law)} for law in every]
            if fixed:
                found = [
                    {**place, **judge(seconds, law, fixed)}
                    for seconds, laws in automatic.items()
                    for law in laws
                ]
                rows += found
                summary += [
                    usual_and_worst([row for row in found if row["time"] == seconds])
                    for seconds in options.time
                ]
                show("Automatic radius against the best of a sweep, each pilot", rows, COLUMNS)
                title = "Automatic radius against the best of a sweep"
                show(f"{title}: geometric mean and worst of the pilots", summary)
                for name, table in (
                    ("radius", rows),
                    ("radius_pilots", summary),
                    ("radius_sweep", sweeps),
                ):
                    save(options.out, name, table, vars(options))


@dataclass(frozen=True)
class ErrorLaw:
    """How the relMSE of one radius falls with time; `trimmed`: without the noisiest 0.1 % of the
    pixels, whose rare bright photons decide the mean of all where surfaces are glossy."""

    radius: float
    settings: str
    squared_bias: float
    variance: float
    """Of one iteration."""
    squared_bias_trimmed: float
    variance_trimmed: float
    seconds: float
    """Of one iteration."""
    set_up: float
    """Seconds until iterations run: preparation, a pilot, recording."""

    def at(self, seconds: float, trimmed: bool, set_up: float | None = None) -> float:
        """relMSE after `seconds`."""
        rendering = seconds - (self.set_up if set_up is None else set_up)
        bias, variance = (
            (self.squared_bias_trimmed, self.variance_trimmed)
            if trimmed
            else (self.squared_bias, self.variance)
        )
        return bias + variance * self.seconds / max(rendering, self.seconds)


def sweep(
    opened: OpenScene,
    references: References,
    bdd: int,
    times: list[float],
    rendering: float,
    radii: int,
    pilots: int,
) -> tuple[dict[float, list[ErrorLaw]], list[ErrorLaw]]:
    """Laws of the automatic radius, one for each pilot and each of the `times` it is to plan for,
    and of ``radii`` radii around them; none if nothing is gathered. Each renders for `rendering`
    seconds."""
    tried: dict[float, list[Contender]] = {}
    chosen_for_free: dict[float, list[Contender]] = {}
    for seconds in times:
        maker = SessionMaker(Method("automatic", "bdpm", {**ONE_PATH, "bdd": bdd}), opened, seconds)
        tried[seconds] = [
            Contender.begin(f"automatic for {seconds:g} s", maker.make, seed)
            for seed in range(pilots)
        ]
        for pilot in tried[seconds]:
            take_turns([pilot], 0)
            if central_radius(pilot.session.settings) is None:
                return {}, []
        chosen_for_free[seconds] = [free_choice(pilot, maker) for pilot in tried[seconds]]
    centre = float(
        np.exp(
            np.mean(
                [
                    np.log(central_radius(pilot.session.settings))
                    for group in tried.values()
                    for pilot in group
                ]
            )
        )
    )
    fixed = [
        Contender.begin(maker.method.label, maker.make, seed=0)
        for maker in sweep_around(centre, radii, bdd, opened, rendering)
    ]
    together = [*chain.from_iterable(chosen_for_free.values()), *fixed]
    take_turns(together, rendering, tell)
    take_turns(together, 0, tell, FEWEST_ITERATIONS)
    automatic = {
        seconds: [
            with_set_up(law(free, references), pilot)
            for free, pilot in zip(chosen_for_free[seconds], tried[seconds])
        ]
        for seconds in times
    }
    return automatic, [law(one, references) for one in fixed]


def free_choice(pilot: Contender, maker: SessionMaker) -> Contender:
    """A rendering with what a pilot chose, which needs no pilot of its own."""
    free = Contender.begin(pilot.label, maker.make, seed=0)
    free.session.recall(pilot.session.learned)
    return free


def with_set_up(law: ErrorLaw, pilot: Contender) -> ErrorLaw:
    """The law with the set-up that its pilot took: a pilot keeps the iterations by which it has
    measured time, so that what is left of them after the first is no set-up either."""
    return replace(law, set_up=pilot.first - (1 + len(pilot.session.kept)) * law.seconds)


def law(contender: Contender, references: References) -> ErrorLaw:
    """What a rendering tells about its error at other times."""
    session = contender.session
    variance = session.image()[
        ..., [session.channels.index(name) for name in ("var.R", "var.G", "var.B")]
    ]
    noise = (variance / references.divisor()).mean(axis=-1).ravel()
    bias = relative_squared_errors(colours(session), references).ravel() - noise
    kept = np.argsort(noise)[: round(noise.size * (1 - TRIMMED_SHARE))]
    n, seconds = session.iterations, float(np.median(contender.seconds[1:]))
    return ErrorLaw(
        central_radius(session.settings),
        chosen(session.settings),
        float(bias.mean()),
        float(noise.mean()) * n,
        float(bias[kept].mean()),
        float(noise[kept].mean()) * n,
        seconds,
        contender.rendering - n * seconds,
    )


def sweep_around(
    centre: float, radii: int, bdd: int, opened: OpenScene, seconds: float
) -> list[SessionMaker]:
    """Sessions with ``radii`` radii around one, factor sqrt 2."""
    around = centre * STEP ** (np.arange(radii) - (radii - 1) // 2)
    parameters = [{**ONE_PATH, "bdd": bdd, "initial_radius": radius} for radius in around.tolist()]
    return [
        SessionMaker(Method(f"{given['initial_radius']:.4g}", "bdpm", given), opened, seconds)
        for given in parameters
    ]


def central_radius(settings: dict) -> float | None:
    """Geometric mean of the radii that a session chose; ``None`` if it needs none."""
    radii = [value for name, value in settings.items() if name.startswith("radius.")]
    return float(np.exp(np.mean(np.log(radii)))) if radii else None


def judge(seconds: float, automatic: ErrorLaw, fixed: list[ErrorLaw]) -> Row:
    """The automatic radius after `seconds`, and its choice made for free, against the best of the
    sweep."""
    row: dict = {"time": seconds, "automatic": automatic.settings, "set-up": automatic.set_up}
    for trimmed, suffix in ((True, TRIMMED), (False, "")):
        best = min(fixed, key=lambda law: law.at(seconds, trimmed))
        least = best.at(seconds, trimmed)
        row |= {
            "best radius" + suffix: best.radius,
            "auto relMSE" + suffix: automatic.at(seconds, trimmed),
            "best relMSE" + suffix: least,
            "auto / best" + suffix: automatic.at(seconds, trimmed) / least,
            "choice / best" + suffix: automatic.at(seconds, trimmed, best.set_up) / least,
            "note" + suffix: "best at the sweep's end" if best in (fixed[0], fixed[-1]) else "",
        }
    row["bias share"] = automatic.squared_bias_trimmed / row["auto relMSE trimmed"]
    return row


def usual_and_worst(rows: list[Row]) -> Row:
    """What the pilots of one scene and time have in common, the geometric mean of their ratios, and
    the worst."""
    first = rows[0]
    table: dict = {name: first[name] for name in ("scene", "bdd", "time")} | {"pilots": len(rows)}
    for name in ("auto / best trimmed", "auto / best", "choice / best trimmed"):
        ratios = [row[name] for row in rows]
        table |= {
            name: float(np.exp(np.mean(np.log(ratios)))) if min(ratios) > 0 else float("nan"),
            f"{name}, worst": max(ratios),
        }
    return table
