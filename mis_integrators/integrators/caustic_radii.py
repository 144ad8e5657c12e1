"""How a session finds the radii of its caustic photons: by the light around, which passes of their
own tell."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..photons.light_around import QUANTA, LightAround, flux_of
from ..photons.photon import power_layout

PASS_SHARE = 1 / 16
"""Tuned: light passes that tell of the light around, for each iteration of the render."""
MOST_PASSES = 16
"""Light passes at most; there is one at least."""
WIDEST_SHARE = 1 / 4
"""Tuned: the largest radius, in units of the scene's extent over the square root of three: what of
a disk lies beyond the surfaces is lost."""
PURPOSE = 5
"""Of the random seed, see `bdpm`."""
MOST_ITERATIONS = 1e15
"""Iterations that a render may be planned for."""


class CausticRadii:
    """Radii of the caustic photons of a `BDPMSession`. `iterations`: planned for the render when
    they were asked for; 0 where all photons have the same radius."""

    def __init__(self, session):
        self.session, self.iterations, self._around = session, 0.0, None

    @property
    def most_iterations(self):
        """The largest value that `iterations` may have: 0 where radii never differ."""
        session = self.session
        differ = session.widens_caustics and session.has_caustics
        return MOST_ITERATIONS if differ and not session.integrator.initial_radius else 0.0

    def plan(self, iterations):
        """Radii may differ, in a render of so many iterations (0: they do not)."""
        self.iterations = min(float(iterations), self.most_iterations)
        self._around = None

    def find(self):
        """The `LightAround`, measured when it is first asked for; None where radii do not
        differ."""
        if self.iterations and self._around is None:
            self._around = self._measure()
        return self._around

    def _measure(self):
        session, around = self.session, None
        passes = min(max(round(PASS_SHARE * self.iterations), 1), MOST_PASSES)
        for number in range(passes):
            surface, power, count = session.trace_photons(number, PURPOSE)[:3]
            if around is None:
                around = LightAround.empty(
                    session.radii["caustic"],
                    mean_flux(power, count) / QUANTA,
                    self.iterations / passes,
                    session.light_path_count * passes,
                    WIDEST_SHARE * session.traits.extent / 3**0.5,
                )
            around.add(surface, power, count)
        return around


def mean_flux(power, count):
    """Of photons (as of `trace_light_paths`), to the next lower power of two: a sum of floats
    depends on their order a little. 1 where there are none."""
    index = dr.arange(mi.UInt32, power_layout().capacity(power))
    total = float(dr.sum(flux_of(power, index < count))[0])
    mean = total / max(int(count[0]), 1)
    return 2.0 ** math.floor(math.log2(mean)) if 0 < mean < math.inf else 1.0
