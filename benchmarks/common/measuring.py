"""Renders of several methods under several seeds, taking turns, with snapshots on the way: what
`compare` and `converge` judge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from mis_integrators.analysis.metrics import References, flip
from mis_integrators.app import loading

import numpy as np

from common.methods import Method, SessionMaker, base_of
from common.scene_files import OpenScene
from common.turns import Contender, Snapshot, take_turns


@dataclass
class Run:
    """One render of one method."""

    snapshots: list[Snapshot]
    """Ascending in time; the last is the finished picture."""
    first: float
    """Seconds until the first iteration was done, with what went before it (a pilot)."""
    compiling: float
    settings: dict

    @property
    def last(self) -> Snapshot:
        return self.snapshots[-1]


@dataclass
class Measured:
    """All renders of one method, one a seed."""

    method: Method
    warm_up: float
    """Seconds of the throw-away session that compiled the kernels."""
    runs: list[Run] = field(default_factory=list)
    _perceived: tuple[float, np.ndarray] | None = None

    @property
    def images(self) -> list[np.ndarray]:
        """The finished pictures."""
        return [run.last.image for run in self.runs]

    def at(self, number: int) -> list[Snapshot]:
        """Snapshot ``number`` of each run."""
        return [run.snapshots[number] for run in self.runs]

    def perceived(self, references: References) -> tuple[float, np.ndarray] | None:
        """FLIP of the first seed's picture, worked out once; ``None`` without the package."""
        if self._perceived is None:
            self._perceived = flip(self.images[0], references)
        return self._perceived

    @property
    def common_snapshots(self) -> int:
        """How many snapshots every run has."""
        return min(len(run.snapshots) for run in self.runs)


@dataclass
class Measurement:
    """A scene, its references, and what each method made of it."""

    opened: OpenScene
    references: References
    methods: list[Measured]
    failures: dict[str, str]
    """Why methods could not render the scene, by their labels."""
    asked: str
    """How long each method rendered, in words."""

    @property
    def base(self) -> Measured:
        """What ratios are to."""
        return self.methods[base_of([measured.method for measured in self.methods])]


def measure(
    opened: OpenScene,
    methods: Sequence[Method],
    references: References,
    seconds: float,
    spp: int | None,
    seeds: int,
    marks: Sequence[float],
    tell: Callable[[str], None],
) -> Measurement:
    """Render by every method that can render the scene. ``marks``: seconds at which to take
    snapshots besides the last."""
    makers, failures = [], {}
    for method in methods:
        tell(f"{opened.name}: compiling {method.label}")
        try:
            makers.append(SessionMaker(method, opened, 0 if spp else seconds, spp))
        except loading.SCENE_ERRORS as error:
            failures[method.label] = loading.one_line(error)
    if not makers:
        raise SystemExit(f"{opened.name}: no method can render it: {failures}")
    found = [Measured(maker.method, maker.warm_up_seconds) for maker in makers]
    for seed in range(seeds):
        contenders = [
            Contender.begin(maker.method.label, maker.make, seed, marks, maker.iteration_seconds)
            for maker in makers
        ]
        take_turns(
            contenders,
            seconds,
            lambda text, seed=seed: tell(f"{opened.name}, seed {seed + 1} of {seeds}: {text}"),
            spp,
        )
        for measured, contender in zip(found, contenders):
            if (
                not contender.snapshots
                or contender.snapshots[-1].iterations < contender.session.iterations
            ):
                contender.take_snapshot()
            measured.runs.append(
                Run(
                    contender.snapshots,
                    contender.first,
                    contender.compiling,
                    dict(contender.session.settings),
                )
            )
    return Measurement(
        opened, references, found, failures, f"{spp} spp" if spp else f"{seconds:g} s"
    )
