"""Sessions whose merge radii a pilot chooses."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..core.clock import now
from ..core.untrusted import Fields
from ..pilot.result import Choice
from ..pilot.run import PILOT_TIME_SHARE, run_pilot
from ..pilot.setting import LIGHT_SHARES, pilot_pixels
from .ahead import SessionAhead
from .schedule import LARGEST_RADIUS, SMALLEST_RADIUS, shrunk

TOO_SLOW = 1.5
"""Tuned: an iteration that takes so many times the guess is not believed to be typical."""

OVERTIME = 2.0
"""Tuned: what the last iteration may take, over one without paths for direct light alone, however
little time is left: where it is the only one, lamps have ragged edges without these paths."""


class PilotedSession(SessionAhead):
    """Runs a pilot, chooses from it, and renders with what was chosen.

    A subclass says which photon maps there are (`kinds`), what the pilot must know of the render
    (`pilot_setting`), how it estimates pixels (`pilot_passes`), and renders an iteration
    (`_iteration`). In a render of a given time, the choice is made twice: the first iterations are
    rendered with the first choice, to measure what they take, and are kept unless the second choice
    is another.
    """

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.seconds = None  # what rendering may take
        self.radii = None  # by kind of photons, once they are known
        self.light_share = 1.0  # of the light sub-paths, those that an iteration has
        self.prediction = None  # a `Prediction`, where a pilot has chosen
        self.expected_seconds = math.inf  # what one will take, by the pilot
        self._end = math.inf  # on the clock, of the time for rendering
        self.gathering_seconds = math.inf  # of that, what paths for direct light alone do not take
        self._untimed = None  # arguments of `_choose_by_clock`, until it is called

    def kinds(self):
        """Photon maps that the scene needs."""
        raise TypeError(f"{type(self).__name__} does not define kinds")

    def pilot_setting(self):
        """The `PilotSetting` of this render."""
        raise TypeError(f"{type(self).__name__} does not define pilot_setting")

    def pilot_passes(self, setting, pixels):
        """The `PilotPasses` of this setting on these pixels."""
        raise TypeError(f"{type(self).__name__} does not define pilot_passes")

    def _use_light_share(self):
        """Traces the `light_share` in each iteration from now on."""
        raise TypeError(f"{type(self).__name__} does not define _use_light_share")

    def plan_time(self, seconds):
        """Rendering will last `seconds`, from `start` or `predict` on: the automatic radius is
        chosen for as many iterations as fit."""
        self.seconds = seconds

    @property
    def settings(self):
        radii = {f"radius.{kind}": radius for kind, radius in (self.radii or {}).items()}
        return {**super().settings, **radii}

    @property
    def learned(self):
        if self.radii is None:
            return {}
        return {
            "radii": {kind: float(radius) for kind, radius in self.radii.items()},
            "light_share": self.light_share,
        }

    def recall(self, learned):
        if learned == {} and (self.radii is not None or not self.kinds()):
            return
        fields = Fields(learned, "learned")
        radii = fields.object("radii")
        self.radii = {
            kind: radii.number(kind, LARGEST_RADIUS, SMALLEST_RADIUS) for kind in self.kinds()
        }
        self.light_share = fields.number("light_share", 1.0, LIGHT_SHARES[-1])
        self._use_light_share()
        self.recall_more(fields)
        radii.finish()
        fields.finish()

    def recall_more(self, fields):
        """Takes over what a subclass has `learned` besides."""

    def radii_at(self, iteration):
        """Merge radius of each kind of photon."""
        return {
            kind: dr.opaque(mi.Float, shrunk(radius, self.integrator.alpha, iteration))
            for kind, radius in self.radii.items()
        }

    # ------------------------------------------------------------------ choice

    def start(self):
        if self.prediction is None:
            self.predict()
        if self._untimed is not None:
            untimed, self._untimed = self._untimed, None
            self._choose_by_clock(*untimed)

    def predict(self, settled=None):
        """Runs the pilot, if one is needed, and makes the first choice: enough for a `prediction`.
        `start` does this, too, and times an iteration where there is a time limit. `settled`: asked
        once there is a prediction by the pilot's fewest iterations, whether that will do."""
        self._end = now() + (math.inf if self.seconds is None else self.seconds)

        def enough(pilot):
            self._choose_by(pilot, self._foresee)
            return settled()

        pilot = self._run_pilot(settled and enough)
        if pilot is None:
            self.radii = self.radii or {}
        else:
            self._choose_by(pilot, self._take)

    def _choose_by(self, pilot, take):
        """Makes the first choice, which `take` is given."""
        if self.seconds is None:
            take(pilot.choose(pilot.setting.planned_iterations))
            return
        guess = pilot.seconds * pilot.setting.light_paths
        first = pilot.choose(self._left(guess) / guess)
        self.gathering_seconds = guess * pilot.cost(first)
        take(first)
        self.expected_seconds = self.gathering_seconds * self.direct_cost()
        if self.prediction is not None:
            count = self.prediction.iterations / self.direct_cost()
            self.prediction = self.prediction._replace(iterations=count)
        self._untimed = pilot, first, guess

    @property
    def needs_pilot(self):
        """Radii are not known, and there are photons to gather."""
        return self.radii is None and bool(self.kinds())

    def _run_pilot(self, settled=None):
        """The `PilotResult`; None where no pilot is needed. `settled`: as of `run_pilot`."""
        if not self.needs_pilot:
            return None
        setting = self.pilot_setting()
        pixels = pilot_pixels(setting)
        return run_pilot(setting, pixels, self.pilot_passes(setting, pixels), now, settled)

    def _left(self, least):
        """Seconds that are left of the render, `least` at least."""
        return max(self._end - now(), least)

    @property
    def seconds_left(self):
        """Seconds that are left of a render of a given time: of an iteration at least."""
        return self._left(self.iteration_seconds)

    def _choose_by_clock(self, pilot, first, guess):
        """Measures what an iteration takes with the `first` choice, which was made for a `guess` of
        that, and chooses again."""
        self._prepare()
        left = self._left(guess)
        seconds, spent = self._time_first_iterations(self.expected_seconds, left)
        count = max(left / seconds * pilot.cost(first), 1)
        second = pilot.choose(count, first, reluctance=min(spent / left, 1))
        usual = seconds / self.direct_cost() / pilot.cost(first)
        self.gathering_seconds = usual * pilot.cost(second)
        self._take(second)
        self.iteration_seconds = self.gathering_seconds * self.direct_cost()

    def _take(self, choice: Choice):
        """Renders with this choice from now on. What was rendered with another is no longer
        kept."""
        if (choice.radii, choice.light_share) != (self.radii, self.light_share):
            self.kept.clear()
        self.radii = dict(choice.radii)
        self._foresee(choice)
        self._use_light_share()

    def _foresee(self, choice: Choice):
        """Finds the `prediction` for this choice."""
        self.prediction, self.light_share = choice.prediction, choice.light_share

    @property
    def most_cost(self):
        """What an iteration may take, in seconds of one without paths for direct light alone: all
        that is left, and `OVERTIME` at least."""
        if self.seconds is None:
            return math.inf
        return self._left(OVERTIME * self.gathering_seconds) / self.gathering_seconds

    def direct_cost(self):
        """What an iteration takes, over one without paths for direct light alone."""
        return 1.0

    def _prepare(self):
        """Finds what all iterations need, before the first is timed."""

    def _time_first_iterations(self, guess, left):
        """Renders the first iteration, which is recorded, and the second unless the first took a
        good share of the seconds that are `left`: for most of them, where it took longer than it
        should have (it may have had to be compiled). Keeps both. Returns the seconds of the last
        one, and those of all."""
        spent = 0.0
        for number in range(2):
            seconds = self.render_ahead(number)
            spent += seconds
            share = PILOT_TIME_SHARE if seconds < TOO_SLOW * guess else 0.5
            if spent > share * left:
                break
        return seconds, spent
