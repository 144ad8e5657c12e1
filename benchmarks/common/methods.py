"""Integrators as the command line names them (``bdpm:bdd=0,alpha=0.8``), and the sessions that run
them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from mis_integrators import _plugins
from mis_integrators.app import loading
from mis_integrators.core.session import MitsubaSession, Session

import mitsuba as mi

from common.scene_files import OpenScene

PASS_SECONDS = 0.2
"""What one pass of one of Mitsuba's own integrators should take: short, but long beside its
start."""
STRATIFYING = ("multijitter", "stratified", "ldsampler", "orthogonal")
"""Mitsuba's samplers that do the better the more samples a pass has: one pass should take all the
time that there is."""
TRIAL_SHARE = 0.1
"""Of that time, what a pass takes by which the samples for all of it are found: by a shorter one
they took 0.7 to 1.4 times as long as they should."""
MOST_SAMPLES = 1 << 25
"""Samples of a pass at most (bounds memory)."""

# All defaults: what this package does not register is left out, so a plugin may be named here
# before it exists.
COMPARED = (
    "path",
    "path:sampler=multijitter",
    "ptracer",
    "bdpm:bdd=0",
    "bdpm:bdd=1",
    "bdpm_balance",
    "bdpm_opt2",
    "bdpm_opt3",
    "bdpm_auto",
    "bdpt",
    "vcm",
    "pcbpt",
    "bdpt_ris",
)
"""What is compared unless said otherwise; ratios are to the first."""
VARIED = (
    "bdpm:bdd=0,pass_narrow=false",
    "bdpm:bdd=1,pass_narrow=false",
    "bdpm:bdd=2,pass_narrow=false",
    "bdpm_balance",
    "bdpm_opt3",
    "bdpm_opt2:mix_diffuse=true",
    "bdpm_opt3:mix_diffuse=true",
)
"""What variance maps are made of unless said otherwise: strategies that merge, alone and
together."""
CHOSEN_FROM = (
    "path",
    "path:sampler=multijitter",
    "bdpm:bdd=0",
    "bdpm_opt2",
    "bdpm_opt3",
    "pcbpt",
    "bdpm_auto",
)
"""What `bdpm_auto` is judged by unless said otherwise."""
BASE = "path"
"""What ratios are to, if it is among the methods; else the first of them."""
PATH_TRACERS = "path", "volpath"
"""What a user would pick instead: the plugins whose best sampler's error others are compared to."""
MITSUBAS = ("path", "ptracer", "volpath", "volpathmis", "direct", "prb")
"""Mitsuba's own integrators that defaults may name."""


@dataclass(frozen=True)
class Method:
    """A plugin with parameters, and the text that named it."""

    label: str
    plugin: str
    parameters: dict[str, loading.Value] = field(default_factory=dict, hash=False)

    @property
    def sampler(self) -> str | None:
        """For one of Mitsuba's own integrators, the parameter ``sampler``: the sensor's sampler
        (``None``: the scene's own)."""
        return str(self.parameters["sampler"]) if self._samples_by_sensor else None

    @property
    def _samples_by_sensor(self) -> bool:
        return self.plugin in MITSUBAS and "sampler" in self.parameters

    def integrator(self, opened: OpenScene) -> mi.Integrator:
        own = dict(self.parameters)
        if self._samples_by_sensor:
            del own["sampler"]
        if opened.denoise and loading.knows_of_denoisers(self.plugin, own):
            own.setdefault("denoised", True)
        return mi.load_dict({"type": self.plugin, **opened.inherited, **own})


def parse_method(text: str) -> Method:
    """The method that ``PLUGIN`` or ``PLUGIN:name=value,name=value`` means; else ``ValueError``."""
    plugin, _, rest = text.partition(":")
    parameters = {}
    for assignment in filter(None, rest.split(",")):
        name, equals, value = assignment.partition("=")
        if not (name and equals):
            raise ValueError(f'"{assignment}" in "{text}" is not of the form name=value')
        parameters[name] = loading.parse_value(value)
    if not plugin:
        raise ValueError(f'"{text}" names no integrator')
    return Method(text, plugin, parameters)


def registered(labels: Sequence[str]) -> list[Method]:
    """The methods among these whose plugins exist."""
    methods = [parse_method(label) for label in labels]
    return [
        method
        for method in methods
        if method.plugin in _plugins.PLUGINS or method.plugin in MITSUBAS
    ]


def base_of(methods: Sequence[Method]) -> int:
    """Number of the method that ratios are to."""
    return next((number for number, method in enumerate(methods) if method.label == BASE), 0)


class SessionMaker:
    """Makes sessions of one integrator on one scene, after having compiled what they need."""

    def __init__(
        self,
        method: Method,
        opened: OpenScene,
        seconds: float,
        spp: int | None = None,
        warm_up: bool = True,
    ):
        """``seconds``: what each session will be given; a session may plan with it. ``spp``: or the
        samples per pixel that each will take; a pass of one of Mitsuba's own integrators then
        divides them. ``warm_up``: compile now, with a session to throw away, whose last iteration
        tells ``iteration_seconds``."""
        self.method, self.opened, self.seconds = method, opened, seconds
        self._integrator = method.integrator(opened)
        self._sensor = opened.sensor_with(method.sampler)
        self._spp = 0
        if not hasattr(self._integrator, "session"):
            self._spp = self._samples_per_pass()
            if spp:
                self._spp = max(n for n in range(1, min(self._spp, spp) + 1) if spp % n == 0)
        self.iteration_seconds: float | None = None
        start = time.perf_counter()
        if warm_up:
            throw_away = self.make(seed=2**31)
            for _ in range(3):
                before = time.perf_counter()
                throw_away.iterate()
                self.iteration_seconds = time.perf_counter() - before
        self.warm_up_seconds = time.perf_counter() - start

    def make(self, seed: int) -> Session:
        """A session that renders until it is stopped."""
        if self._spp:
            return MitsubaSession(
                self._integrator, self.opened.scene, self._sensor, seed, self._spp, at_once=True
            )
        session = self._integrator.session(self.opened.scene, self.opened.sensor, seed=seed, spp=0)
        if hasattr(session, "plan_time") and self.seconds:
            session.plan_time(self.seconds)
        return session

    def _samples_per_pass(self) -> int:
        """Samples per pixel that one of Mitsuba's own integrators takes in about ``PASS_SECONDS``;
        under a stratifying sampler, in all of the time."""
        spp, seconds = 4, self._seconds_of_pass(4)
        while spp > 1 and seconds > 1.5 * PASS_SECONDS:
            spp, seconds = spp // 2, seconds / 2
        while seconds < PASS_SECONDS / 1.5 and spp * self.opened.pixels < 1 << 20:
            spp, seconds = spp * 2, seconds * 2
        if self.method.sampler in STRATIFYING and self.seconds:
            most = MOST_SAMPLES // self.opened.pixels
            for seconds in (TRIAL_SHARE * self.seconds, self.seconds):
                wanted = round(spp * seconds / self._seconds_of_pass(spp))
                spp = max(1, min(wanted, most))
        return spp

    def _seconds_of_pass(self, spp: int) -> float:
        """Seconds that the second of two passes takes."""
        session = MitsubaSession(
            self._integrator, self.opened.scene, self._sensor, 0, spp, at_once=True
        )
        session.iterate()
        start = time.perf_counter()
        session.iterate()
        return time.perf_counter() - start
