"""Integrators as the command line names them (``bdpm:bdd=0,alpha=0.8``), and the sessions that run them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import mitsuba as mi

from mis_integrators import loading
from mis_integrators.session import MitsubaSession, Session
from scene_files import OpenScene

PASS_SECONDS = 0.2
"""What one pass of one of Mitsuba's own integrators should take: short, but long beside its start."""


@dataclass(frozen=True)
class Method:
    """A plugin with parameters, and the text that named it."""

    label: str
    plugin: str
    parameters: dict[str, loading.Value] = field(default_factory=dict, hash=False)

    def integrator(self, opened: OpenScene) -> mi.Integrator:
        return mi.load_dict({"type": self.plugin, **opened.inherited, **self.parameters})


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


class SessionMaker:
    """Makes sessions of one integrator on one scene, after having compiled what they need."""

    def __init__(self, method: Method, opened: OpenScene, seconds: float):
        """``seconds``: what each session will be given; a session may plan with it."""
        self.method, self.opened, self.seconds = method, opened, seconds
        self._integrator = method.integrator(opened)
        self._spp = 0
        if not hasattr(self._integrator, "session"):
            self._spp = self._samples_per_pass()
        start = time.perf_counter()
        throw_away = self.make(seed=2**31)
        for _ in range(3):
            throw_away.iterate()
        self.warm_up_seconds = time.perf_counter() - start

    def make(self, seed: int) -> Session:
        """A session that renders until it is stopped."""
        if self._spp:
            return MitsubaSession(self._integrator, self.opened.scene, self.opened.sensor, seed, self._spp)
        session = self._integrator.session(self.opened.scene, self.opened.sensor, seed=seed, spp=0)
        if hasattr(session, "plan_time"):
            session.plan_time(self.seconds)
        return session

    def _samples_per_pass(self) -> int:
        """Samples per pixel that one of Mitsuba's own integrators takes in about ``PASS_SECONDS``."""
        spp = 4
        session = MitsubaSession(self._integrator, self.opened.scene, self.opened.sensor, 0, spp)
        session.iterate()
        start = time.perf_counter()
        session.iterate()
        seconds = time.perf_counter() - start
        while spp > 1 and seconds > 1.5 * PASS_SECONDS:
            spp, seconds = spp // 2, seconds / 2
        while seconds < PASS_SECONDS / 1.5 and spp * self.opened.pixels < 1 << 20:
            spp, seconds = spp * 2, seconds * 2
        return spp
