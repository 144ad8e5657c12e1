"""Plugin `bdpm_auto`: decides from the scene and a short pilot whether a photon mapper of this
package or Mitsuba's `path` renders it."""

from __future__ import annotations

import math

from ..core.traits import check_scene, has_media
from ..core.untrusted import Fields
from ..paths.layers import CHANNELS, SPLIT
from ..volume.traits import check_volume_scene
from ..volume.views import Views
from . import choice, media_choice
from .choice import Decision
from .common import IterativeIntegrator, IterativeSession


class BDPMAuto(IterativeIntegrator):
    r"""
    .. _integrator-bdpm_auto:

    Whatever suits the scene (:monosp:`bdpm_auto`)
    ----------------------------------------------

    .. pluginparameters::

     * - camera_paths
       - |int|
       - As of :monosp:`bdpm`; 0 stands for one. Without a number of samples (``--time``), ``path``
         and, in media, ``volpath_multiview`` take as many as keep the machine busy. (Default: 0)
     * - denoised, variance, aovs, max_depth, rr_depth, hide_emitters, sampler
       -
       - As of :monosp:`bdpm`.

    Chooses between ``path`` and a photon mapper: ``bdpm`` with ``bdd`` 0, or 1 in renders that will
    be denoised. The photon mapper runs its pilot; a few samples of ``path`` on the same pixels tell
    what that would bring in the same time. In raw images the first iterations of the render tell
    the noise again, where they tell more. In a render of a given time, the clock tells what an
    iteration costs; of a given number of samples, counted events (segments, photons) do, so that
    the choice is the same on all machines. Where ``path`` cannot see all the light of the scene, it
    is not tried.
    In scenes with media the two are ``volpath_multiview``, with one view, and ``bdpm`` with the
    same ``bdd``. Photons are not tried there where light sub-paths leave few of them, nor in media
    of grids.

    The settings of the image (in the EXR's header) say which integrator was chosen and why, with
    the predictions; ``mis-render`` prints the reasons, too. Without a time limit, the same seed and
    number of samples make the same choice and image again. A photon mapper that is chosen makes the
    same image by itself. ``path`` draws the random numbers of this package, not those of Mitsuba:
    the same mean, other noise.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpm_auto"/>

        .. code-tab:: python

            'type': 'bdpm_auto'
    """

    CAMERA_PATHS = 0, 0, "at least 0 (0: automatic)"

    def read_parameters(self, parameters):
        self.denoised = parameters.boolean("denoised", False)

    def settings(self):
        return {**super().settings(), "denoised": self.denoised}

    LAYERS = *CHANNELS, *SPLIT

    def check(self, scene, sensor):
        if has_media(scene, sensor):
            check_volume_scene(scene, [sensor], self.plugin)
            Views.check_sensor(sensor, self.plugin)
            Views.check_layers([sensor], self.layers, self.plugin)
        else:
            check_scene(scene, sensor, self.plugin)

    def new_session(self, scene, sensor, seed, iterations):
        return AutoSession(self, scene, sensor, seed, iterations)


class AutoSession(IterativeSession):
    """Iterations of the session that is chosen before the first one: it keeps what it renders, and
    this one is its face."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.seconds = self.decision = None
        self._choice = media_choice if has_media(scene, sensor) else choice

    def plan_time(self, seconds):
        """Rendering will last `seconds`: the choice is for as many iterations as fit."""
        self.seconds = seconds

    @property
    def settings(self):
        if self.decision is None:
            return super().settings
        chosen = self.decision.session.settings
        return {
            **chosen,
            "integrator": self.integrator.plugin,
            "choice": self.decision.plugin,
            **{
                f"choice.because.{number}": reason
                for number, reason in enumerate(self.decision.reasons, 1)
            },
            **{f"choice.{name}": error for name, error in self.decision.errors.items()},
        }

    @property
    def remarks(self):
        """Why what renders was chosen, and what else the user should know, line by line."""
        reasons = self.decision.reasons if self.decision else []
        return [*(f"{self.integrator.plugin}: {reason}" for reason in reasons), *super().remarks]

    @property
    def kept(self):
        """Iterations that have been rendered to make the choice, and are not in the sums yet."""
        return getattr(self.decision and self.decision.session, "kept", {})

    @property
    def seconds_of_next(self):
        """As of `core.session.Session`."""
        session = self.decision and self.decision.session
        return getattr(session, "seconds_of_next", math.inf)

    @property
    def _render(self):
        return self.integrator, self.scene, self.sensor, self.seed, self.iterations_planned

    def start(self):
        if self.decision is None:
            self._take(self._choice.choose(*self._render, self.seconds))
        self.decision.session.start()

    def _take(self, decision):
        self.decision, chosen = decision, decision.session
        self.camera_paths, self.iterations_planned = chosen.camera_paths, chosen.iterations_planned
        chosen.accumulator.with_variance |= self.accumulator.with_variance
        self.accumulator = chosen.accumulator

    @property
    def learned(self):
        if self.decision is None:
            return {}
        decision = self.decision
        return {
            "plugin": decision.plugin,
            "reasons": decision.reasons,
            "errors": decision.errors,
            "session": decision.session.learned,
        }

    def recall(self, learned):
        fields = Fields(learned, "learned")
        candidates = list(self._choice.CANDIDATES)
        if self.integrator.splits_light:
            candidates = [self._choice.PHOTONS]
        plugin = fields.choice("plugin", candidates)
        expected = fields.object("errors")
        errors = {name: expected.number(name) for name in expected.names()}
        reasons, inner = fields.texts("reasons"), fields.any("session")
        fields.finish()
        session = self._choice.new_session(plugin, *self._render)
        session.recall(inner)
        self._take(Decision(plugin, session, reasons, errors))

    def _run(self, iteration):
        self.decision.session._run(iteration)

    def fill_film(self):
        (self.decision.session if self.decision else super()).fill_film()

    def _emptied(self, film):
        return (self.decision.session if self.decision else super())._emptied(film)
