"""How good the automatic radius is: its equal-time relMSE next to that of a sweep of radii, factor sqrt 2.

Iterations are independent and the radius does not change from one to the next, so the error after n of them is bias^2 + V / n. Each radius
renders for a few seconds, in turns with the others; bias^2, the variance V of an iteration, and the seconds of an iteration and of what goes
before the first then give the error at any time.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from compare import chosen
from errors import References, errors
from methods import Method, SessionMaker
from references import colours, find_references
from reports import Row, save, show, tell
from scene_files import OpenScene, open_scene, scaled_size
from turns import Contender, take_turns

STEP = 2**0.5
COLUMNS = ("scene", "bdd", "time", "automatic", "best", "auto / best radius", "auto relMSE", "best relMSE",
           "auto / best relMSE", "choice / best relMSE", "set-up", "bias share", "note")


def run(options: argparse.Namespace) -> None:
    """The sub-command ``radius``."""
    sweeps: list[Row] = []
    summary: list[Row] = []
    for path in options.scenes:
        opened = open_scene(path, scaled_size(path, options.scale))
        references = find_references(opened, options, tell)
        for bdd in options.bdd:
            automatic, fixed = sweep(opened, references, bdd, options.time, options.rendering, options.radii)
            place = {"scene": opened.name, "size": "{}x{}".format(*opened.size), "bdd": bdd, "references": references.origin}
            sweeps += [{**place, **vars(law)} for law in fixed + automatic]
            if fixed:
                summary += [{**place, **judge(seconds, law, fixed)} for seconds, law in zip(options.time, automatic)]
                show("Automatic radius against the best of a sweep", summary, COLUMNS)
                save(options.out, "radius", summary, vars(options))
                save(options.out, "radius_sweep", sweeps, vars(options))


@dataclass(frozen=True)
class ErrorLaw:
    """How the relMSE of one radius falls with time."""

    radius: float
    settings: str
    squared_bias: float
    variance: float
    """Of one iteration."""
    seconds: float
    """Of one iteration."""
    set_up: float
    """Seconds until iterations run: preparation, a pilot, recording."""

    def at(self, seconds: float, set_up: float | None = None) -> float:
        """relMSE after `seconds`."""
        rendering = seconds - (self.set_up if set_up is None else set_up)
        return self.squared_bias + self.variance * self.seconds / max(rendering, self.seconds)


def sweep(opened: OpenScene, references: References, bdd: int, times: list[float], rendering: float,
          radii: int) -> tuple[list[ErrorLaw], list[ErrorLaw]]:
    """Laws of the automatic radius, one for each of the `times` it is to plan for, and of ``radii`` radii around them; none if nothing
    is gathered. Each renders for `rendering` seconds."""
    automatic = []
    for seconds in times:
        maker = SessionMaker(Method("automatic", "bdpm", {"bdd": bdd, "variance": True}), opened, seconds)
        automatic.append(Contender.begin(f"automatic for {seconds:g} s", maker.make, seed=0))
        automatic[-1].iterate()
    centres = [central_radius(contender.session.settings) for contender in automatic]
    if None in centres:
        return [], []
    makers = sweep_around(float(np.exp(np.mean(np.log(centres)))), radii, bdd, opened, rendering)
    fixed = [Contender.begin(maker.method.label, maker.make, seed=0) for maker in makers]
    take_turns([*automatic, *fixed], rendering, tell)
    return [law(one, references) for one in automatic], [law(one, references) for one in fixed]


def law(contender: Contender, references: References) -> ErrorLaw:
    """What a rendering tells about its error at other times."""
    session = contender.session
    image = session.image()
    noise = image[..., [session.channels.index(name) for name in ("var.R", "var.G", "var.B")]] / references.divisor()
    seconds = float(np.mean(contender.seconds[1:]))
    return ErrorLaw(
        central_radius(session.settings), chosen(session.settings), errors(colours(session), references).relmse - float(noise.mean()),
        float(noise.mean()) * session.iterations, seconds, contender.first - seconds,
    )


def sweep_around(
    centre: float | None, radii: int, bdd: int, opened: OpenScene, seconds: float
) -> list[SessionMaker]:
    """Sessions with ``radii`` radii around one, factor sqrt 2; none around ``None``."""
    if centre is None:
        return []
    around = centre * STEP ** (np.arange(radii) - (radii - 1) // 2)
    return [
        SessionMaker(Method(f"{radius:.4g}", "bdpm", {"bdd": bdd, "initial_radius": radius, "variance": True}), opened, seconds)
        for radius in around.tolist()
    ]


def central_radius(settings: dict) -> float | None:
    """Geometric mean of the radii that a session chose; ``None`` if it needs none."""
    radii = [value for name, value in settings.items() if name.startswith("radius.")]
    return float(np.exp(np.mean(np.log(radii)))) if radii else None


def judge(seconds: float, automatic: ErrorLaw, fixed: list[ErrorLaw]) -> Row:
    """The automatic radius after `seconds`, and its choice made for free, against the best of the sweep."""
    best = min(fixed, key=lambda law: law.at(seconds))
    error, least = automatic.at(seconds), best.at(seconds)
    return {
        "time": seconds,
        "automatic": automatic.settings,
        "best": best.radius,
        "auto / best radius": automatic.radius / best.radius,
        "auto relMSE": error,
        "best relMSE": least,
        "auto / best relMSE": error / least,
        "choice / best relMSE": automatic.at(seconds, best.set_up) / least,
        "set-up": automatic.set_up,
        "bias share": automatic.squared_bias / error,
        "note": "best at the sweep's end" if best in (fixed[0], fixed[-1]) else "",
    }
