"""Iterations that are rendered before it is known whether their session will make the image."""

from __future__ import annotations

import math

import drjit as dr

from ..core.clock import now
from .common import IterativeSession


class SessionAhead(IterativeSession):
    """Keeps iterations that tell of the render, and adds them to its sums when these are asked
    for."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.kept = {}  # the blocks of these iterations, by number
        self.iteration_seconds = math.inf  # what one takes, where that is measured

    def render_ahead(self, iteration):
        """Renders an iteration and keeps it. Returns the seconds it took."""
        start = now()
        block = self._iteration(iteration)
        dr.eval(block)
        dr.sync_thread()
        self.kept[iteration] = block
        return now() - start

    @property
    def seconds_of_next(self):
        """As of `core.session.Session`."""
        return 0.0 if self.iterations in self.kept else self.iteration_seconds

    def _run(self, iteration):
        block = self.kept.pop(iteration, None)
        self.accumulator.add(self._iteration(iteration) if block is None else block, iteration)
