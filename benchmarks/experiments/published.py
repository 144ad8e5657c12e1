"""The experiments of Nabata et al. with `weights` = `published` of `bdpt_ris` and `pcbpt`: M, N,
N_c and both targets; MAPE over time; how well Q is estimated; and what each change of the bounded
form brings over the published one."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from mis_integrators.analysis.confidence import ratio_interval
from mis_integrators.analysis.metrics import References, errors
from mis_integrators.mis.published_resampling import PublishedWeights
from mis_integrators.mis.resampling import LEAST_GAIN, MOST_GAIN, ResampledWeights

import drjit as dr
import numpy as np

from common.methods import Method, SessionMaker, parse_method
from common.references import colours
from common.rows import Row, save, show, tell
from common.scene_files import OpenScene
from common.tuned import changed
from common.turns import Contender, take_turns
from report.figures import draw_mape_over_time

BASE = "bdpt:camera_paths=4"
PAPER = (
    BASE,
    "pcbpt:weights=published,resamples=1,light_paths=100",
    "bdpt_ris:weights=published,resamples=1",
    "bdpt_ris:weights=published,resamples=1,target=f_y_f_yz",
    "pcbpt:resamples=1",
    "bdpt_ris:resamples=1",
)
"""What is compared over time: the paper's three, PCBPT with M = 100 and the others with M = 200,
the other target, and the package's own forms. All have the paper's N = 1. Ratios are to the
first."""
METHODS = (
    BASE,
    "pcbpt:weights=published,resamples=1",
    "pcbpt:weights=published,resamples=1,target=f_y_f_yz",
    "bdpt_ris:weights=published,resamples=1",
    "bdpt_ris:weights=published,resamples=1,target=f_y_f_yz",
)
"""What is swept."""
SNAPSHOTS = 6
"""Pictures of MAPE over time, each after half the time of the next."""
NO_BOUND = 1e30
BLIND = {"resampling.proposals.BLIND_SHARE": 0.0}
UNIFORM = {"resampling.proposals.UNIFORM_SHARE": (0.25, 0.25)}
LEAST = {"mis.resampling.LEAST_GAIN": 0.0}
MOST = {"mis.resampling.MOST_GAIN": NO_BOUND}


class Unsoftened(ResampledWeights):
    """Bounded weights whose geometric term has its pole."""

    def softened(self, geometry, squared):
        return geometry


class WithoutLengths(PublishedWeights):
    """Published weights with Q in place of Q_s, as in the authors' program."""

    @staticmethod
    def share_of_length(shares, place, active):
        return 1.0


class WithBounds(PublishedWeights):
    """Published weights whose gains have the bounds of the bounded form."""

    def gains(self, r, row, s, active=True):
        gains = super().gains(r, row, s, active)
        total = sum(gains)
        bounded = dr.clip(total, LEAST_GAIN * (1 - 1 / self.M), MOST_GAIN * self.N)
        return [gain * bounded * dr.rcp(dr.maximum(total, 1e-20)) for gain in gains]


def no_guess(traits, z, joined, eta=0.0):
    """In place of `guessed_weight`: one."""
    return 1.0


PUBLISHED, WEIGHTS = (
    "bdpt_ris:weights=published,resamples=1",
    "mis.published_resampling.PublishedWeights",
)
BOUNDED = "bdpt_ris:resamples=1"
GUESS: Mapping[str, object] = {"mis.resampling.guessed_weight": no_guess}
POLE: Mapping[str, object] = {"mis.resampling.ResampledWeights": Unsoftened}
LADDER: dict[str, tuple[str, Mapping[str, object]]] = {
    "published": (PUBLISHED, {}),
    "published, Q in place of Q_s": (PUBLISHED, {WEIGHTS: WithoutLengths}),
    "published, with the bounds of gains": (PUBLISHED, {WEIGHTS: WithBounds}),
    "bounded": (BOUNDED, {}),
    "bounded, without blind shares": (BOUNDED, BLIND),
    "bounded, uniform share 1/(N_c + 1)": (BOUNDED, UNIFORM),
    "bounded, without the guessed weight in pmfs": (BOUNDED, GUESS),
    "bounded, G with its pole": (BOUNDED, POLE),
    "bounded, without least gain": (BOUNDED, LEAST),
    "bounded, without most gain": (BOUNDED, MOST),
    "bounded, without any of these": (
        BOUNDED,
        {**BLIND, **UNIFORM, **GUESS, **POLE, **LEAST, **MOST},
    ),
    "published pmfs, path densities": ("pcbpt:weights=published,resamples=1", {}),
    "bounded pmfs, path densities": ("pcbpt:resamples=1", {}),
}
"""What the bounded form changes, one at a time: method and constants. Q_s, q* at the cache point
and techniques of single cache points are in the published form alone."""
LEARNT = 12
"""Iterations from which the spread of the estimates of Q is taken."""


def over_time(opened: OpenScene, references: References, options: argparse.Namespace) -> list[Row]:
    """MAPE of the `PAPER`'s methods at several times, geometric mean over the seeds, first
    iterations included; last the ratio to the first method's."""
    makers = _makers(PAPER, opened, options.published_time)
    marks = [options.published_time / 2**power for power in range(SNAPSHOTS - 1, 0, -1)]
    found: dict[str, list[list[tuple[float, float]]]] = {label: [] for label in makers}
    for seed in range(options.draw_seeds):
        contenders = [
            Contender.begin(label, maker.make, seed, marks=marks) for label, maker in makers.items()
        ]
        take_turns(contenders, options.published_time, lambda text: tell(f"{opened.name}: {text}"))
        for contender in contenders:
            contender.take_snapshot()
            found[contender.label].append(
                [(s.seconds, errors(s.image, references).mape) for s in contender.snapshots]
            )
    rows: list[Row] = []
    for label, runs in found.items():
        # A slow start may leave out the first mark: renders are paired from the end.
        common = min(len(run) for run in runs)
        for number in range(-common, 0):
            at = [run[number] for run in runs]
            last = number == -1
            ratio = ratio_interval(
                [run[-1][1] for run in runs], [run[-1][1] for run in found[BASE]]
            )
            rows.append(
                {
                    "scene": opened.name,
                    "method": label,
                    "seconds": float(np.mean([seconds for seconds, _ in at])),
                    "MAPE": float(np.exp(np.mean(np.log([mape for _, mape in at])))),
                    "ratio at the end": ratio.value if last else None,
                    "ratio at the end low": ratio.low if last else None,
                    "ratio at the end high": ratio.high if last else None,
                }
            )
    return rows


def ladder(opened: OpenScene, references: References, options: argparse.Namespace) -> list[Row]:
    """Noise and cost of an iteration, and their product, as ratios to the published form's. The
    contenders keep their constants while they record and render, so they do not take turns."""
    figures: dict[str, list[dict[str, float]]] = {label: [] for label in LADDER}
    for seed in range(options.draw_seeds):
        for label, (method, values) in LADDER.items():
            with changed(values), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                maker = SessionMaker(parse_method(method), opened, options.draw_time, warm_up=False)
                contender = Contender.begin(label, maker.make, seed)
                for _ in range(2):  # compiles, and makes what is made once
                    contender.iterate()
                contender.seconds, contender.setting_up = [], 0.0
                while contender.rendering < options.draw_time:
                    contender.iterate()
                dr.kernel_history_clear()
            figures[label].append(_judged(contender, references))
            tell(f"{opened.name}: {label}, seed {seed}")
    base, rows = figures["published"], []
    for label, mine in figures.items():
        row: dict[str, str | float | None] = {"scene": opened.name, "form": label}
        for name in ("noise", "cost", "noise x cost", "common noise"):
            ratio = ratio_interval([one[name] for one in mine], [one[name] for one in base])
            row |= {name: ratio.value, f"{name} low": ratio.low, f"{name} high": ratio.high}
        rows.append(row)
    return rows


def _judged(contender: Contender, references: References) -> dict[str, float]:
    """`noise`: relMSE without the worst pixels that one iteration would have; `common noise`: the
    same of the mean of blocks of pixels, where what they have in common shows; `cost`: seconds."""
    session = contender.session
    image = colours(session)
    noise = errors(image, references).relmse_trimmed * session.iterations
    cost = float(np.median(contender.seconds))
    pair = (_blocks(reference) for reference in (references.first, references.second))
    blocks = errors(_blocks(image), References(*pair, "", False))
    return {
        "noise": noise,
        "cost": cost,
        "noise x cost": noise * cost,
        "common noise": max(blocks.relmse, 1e-12) * session.iterations,
    }


def _blocks(image: np.ndarray, edge: int = 8) -> np.ndarray:
    """Means of blocks of `edge` x `edge` pixels; what does not fill one is left out."""
    height, width = (size // edge * edge for size in image.shape[:2])
    parts = image[:height, :width].reshape(height // edge, edge, width // edge, edge, -1)
    return parts.mean(axis=(1, 3))


def estimates_of_Q(opened: OpenScene, counts: tuple[int, ...]) -> list[Row]:
    """How much the estimates of Q at the cache points differ from iteration to iteration, for both
    targets: standard deviation over mean, median and mean over the cache points."""
    rows: list[Row] = []
    for target in ("f_y_rho_g_v", "f_y_f_yz"):
        for M in counts:
            method = parse_method(
                f"bdpt_ris:weights=published,resamples=1,target={target},light_paths={M}"
            )
            session = SessionMaker(method, opened, 1.0, warm_up=False).make(0)
            session.start()
            found = []
            for iteration in range(LEARNT):
                session._take_weights(iteration)
                found.append(np.array(session.published_tables[0]))
            values = np.stack(found)
            mean = values.mean(axis=0)
            spread = values.std(axis=0, ddof=1)[mean > 0] / mean[mean > 0]
            rows.append(
                {
                    "scene": opened.name,
                    "target": target,
                    "M": M,
                    "median deviation of Q": float(np.median(spread)),
                    "mean deviation of Q": float(np.mean(spread)),
                    "cache points without light": float(np.mean(mean <= 0)),
                }
            )
            tell(f"{opened.name}: Q of {target} with M = {M}")
    return rows


def run_scene(opened: OpenScene, references: References, options: argparse.Namespace) -> None:
    """All experiments but the sweeps on a scene; tables, CSV, JSON, and the chart over time."""
    if "time" in options.published_parts:
        rows = over_time(opened, references, options)
        show(f"{opened.name}: MAPE over time", rows)
        save(options.out, f"published_time_{opened.name}", rows, vars(options))
        draw_mape_over_time(options.out / f"published_time_{opened.name}.png", rows)
    if "Q" in options.published_parts:
        rows = estimates_of_Q(opened, (50, 100, 200, 400, 800))
        show(f"{opened.name}: estimates of Q", rows)
        save(options.out, f"published_Q_{opened.name}", rows, vars(options))
    if "ladder" in options.published_parts:
        rows = ladder(opened, references, options)
        show(f"{opened.name}: ratios to the published form", rows)
        save(options.out, f"published_ladder_{opened.name}", rows, vars(options))


def _makers(labels, opened: OpenScene, seconds: float) -> dict[str, SessionMaker]:
    methods: list[Method] = [parse_method(label) for label in labels]
    makers = {}
    for method in methods:
        tell(f"{opened.name}: compiling {method.label}")
        makers[method.label] = SessionMaker(method, opened, seconds)
    return makers
