"""Plugin `bdpm_balance`: merging at several camera vertices, under Veach's balance or power
heuristic."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..mis.heuristic import HeuristicWeights
from .weighted import WeightedBDPM, WeightedSession


class BDPMBalance(WeightedBDPM):
    r"""
    .. _integrator-bdpm_balance:

    Bidirectional ray tracing with photon maps, balance heuristic (:monosp:`bdpm_balance`)
    --------------------------------------------------------------------------------------

    .. pluginparameters::

     * - strategies
       - |int|
       - How many strategies are mixed: photons are merged at that many first camera vertices that
         scatter smoothly. From 1 to 6. (Default: 3)
     * - beta
       - |float|
       - Exponent of the heuristic, from 1 to 8: 1 is Veach's balance heuristic, 2 his power
         heuristic. (Default: 1)
     * - photon_count, initial_radius, alpha, direct_paths, denoised, camera_paths, variance, aovs,
         max_depth, rr_depth, hide_emitters, sampler
       -
       - As of :monosp:`bdpm`.

    The same strategies as those of :monosp:`bdpm_opt`, and the weights that are usual elsewhere to
    compare it with: each light path is shared among the strategies that can make it in proportion
    to the densities with which they do (Veach 1997, equations 9.8 and 9.13; densities of merges as
    Georgiev et al. 2012 have them). That camera paths share their photons, whose noise they do not
    average out, is outside that theory. In participating media volume photons are merged along each
    segment of a camera path, as :monosp:`bdpm` does along one.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpm_balance">
                <integer name="strategies" value="2"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpm_balance',
            'strategies': 2
    """

    bdd = 0

    def read_parameters(self, parameters):
        self.read_photon_parameters(parameters)
        self.strategies = parameters.integer("strategies", 3, 1, "from 1 to 6", high=6)
        self.beta = parameters.exponent("beta")

    def settings(self):
        return {**super().settings(), "beta": float(self.beta)}

    def new_session(self, scene, sensor, seed, iterations):
        return BDPMBalanceSession(self, scene, sensor, seed, iterations)


class BDPMBalanceSession(WeightedSession):
    """Iterations of `bdpm_balance`."""

    def weights(self, merge_settings):
        integrator = self.integrator
        return HeuristicWeights(
            self.lights,
            merge_settings["disk_paths"],
            merge_settings["caustic_share"],
            integrator.strategies,
            integrator.beta,
            merge_settings.get("volume_share"),
        )

    def merge_settings(self, radii):
        radius = radii.get("indirect", radii.get("caustic", radii.get("volume")))
        both = {"caustic", "indirect"} <= radii.keys()
        of_volume = {}
        if self.traits.has_media:
            of_volume["volume_share"] = dr.square(radii.get("volume", radius) / radius)
        return {
            "disk_paths": dr.pi * dr.square(radius) * self.light_path_count,
            "caustic_share": dr.square(radius / radii["caustic"]) if both else mi.Float(1),
            **of_volume,
        }

    def beam_weigher(self, weights, beams, state, photon_map):
        return weights.beam_weigher(beams, state, photon_map)

    def weigher(self, weights, kind, level, vertices, photon_map):
        return weights.weigher(kind, level, vertices, photon_map)
