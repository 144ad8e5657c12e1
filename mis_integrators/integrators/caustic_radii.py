"""How a session finds the radii of its caustic photons: by the light around, which passes of their
own tell."""

from __future__ import annotations

from ..photons.grid import read_photons
from ..photons.light_around import LightAround
from ..photons.light_cells import flux_of, quantum_of
from ..photons.photon import power_layout
from .purposes import CAUSTIC_RADII

PASS_SHARE = 1 / 16
"""Tuned: light passes that tell of the light around, for each iteration of the render."""
MOST_PASSES = 16
"""Light passes at most; there is one at least."""
WIDEST_SHARE = 1 / 4
"""Tuned: the largest radius, in units of the scene's extent over the square root of three: what of
a disk lies beyond the surfaces is lost."""
MOST_ITERATIONS = 1e15
"""Iterations that a render may be planned for."""


class CausticRadii:
    """Radii of the caustic photons of a `BDPMSession`. `iterations`: planned for the render when
    they were asked for; 0 where all photons have the same radius."""

    def __init__(self, session):
        self.session, self.iterations, self._around = session, 0.0, None

    @property
    def kind(self):
        """Of the photons whose radii differ."""
        return "caustic" if self.session.cones is None else "seen_caustic"

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
            surface, power, count = session.trace_photons(number, CAUSTIC_RADII)[:3]
            if around is None:
                around = LightAround.empty(
                    session.radii[self.kind],
                    quantum_of(power, count),
                    self.iterations / passes,
                    session.light_path_count * passes,
                    WIDEST_SHARE * session.traits.extent / 3**0.5,
                )
            record, active = read_photons(surface, count, power_layout().capacity(power))
            around.cells.add(record["p"], flux_of(power, active), active)
        return around
