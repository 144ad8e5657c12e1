"""How far a session spreads its caustic photons: by the light around, which passes of their own
tell."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..photons.photon import power_layout
from ..photons.spread import QUANTA, LightAround, flux_of

PASS_SHARE = 1 / 16
"""Tuned: light passes that tell of the light around, for each iteration of the render (one at
least)."""
PURPOSE = 5
"""Of the random seed, see `bdpm`."""
MOST_PASSES = 1024
"""More of them would tell little more."""
MOST_ITERATIONS_SPREAD = 1e15
"""Iterations that a render may be planned for."""


class CausticSpread:
    """How far a `BDPMSession` spreads its caustic photons. `iterations`: planned for the render
    when that was decided; 0 where photons are not spread."""

    def __init__(self, session):
        self.session, self.iterations, self._around = session, 0.0, None

    def plan(self, iterations):
        """Spreads photons in a render of so many iterations. What is kept of it stays right."""
        if self.session.spreads_caustics and self.session.has_caustics and not self.session.kept:
            self.recall(min(max(float(iterations), 1.0), MOST_ITERATIONS_SPREAD))
            self._find()

    def recall(self, iterations):
        """Takes over what another session of the same render has planned."""
        self.iterations, self._around = iterations, None

    @property
    def around(self):
        """The `LightAround`; None where photons are not spread."""
        if self.iterations and self._around is None:
            self._find()
        return self._around

    def _find(self):
        session = self.session
        passes = min(max(round(PASS_SHARE * self.iterations), 1), MOST_PASSES)
        for number in range(passes):
            surface, power, count = session.trace_photons(number, PURPOSE)[:3]
            if self._around is None:
                self._around = LightAround.none(
                    session.radii["caustic"],
                    mean_flux(power, count) / QUANTA,
                    self.iterations / passes,
                    session.photon_capacity,
                )
            self._around.add(surface, power, count)


def mean_flux(power, count):
    """Of photons (as of `trace_light_paths`), to the next lower power of two: a sum of floats
    depends on their order a little. 1 where there are none."""
    layout = power_layout()
    index = dr.arange(mi.UInt32, layout.capacity(power))
    total = float(dr.sum(flux_of(layout.read(power, index, index < count)))[0])
    mean = total / max(int(count[0]), 1)
    return 2.0 ** math.floor(math.log2(mean)) if 0 < mean < math.inf else 1.0
