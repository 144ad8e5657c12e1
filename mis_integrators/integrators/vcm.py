"""Plugin `vcm`: vertex connection and merging."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.recording import lanes
from ..core.untrusted import Fields
from ..mis.vertex_merging import ConnectionWeights
from ..paths.subpaths import STATES, read_vertices
from ..photons.vertex_map import state_of
from ..pilot.run import PILOT_INDEX
from .bdpt import BDPT, BDPTSession
from .common import MOST_LIGHT_PATHS
from .merging import automatic_radius, merged_light, merging_of, with_merged
from .purposes import CAMERA
from .schedule import LARGEST_RADIUS, SMALLEST_RADIUS, read_radius, shrunk


class VCM(BDPT):
    r"""
    .. _integrator-vcm:

    Vertex connection and merging (:monosp:`vcm`)
    ---------------------------------------------

    .. pluginparameters::

     * - beta
       - |float|
       - Exponent of the heuristic, from 1 to 8: 1 is Veach's balance heuristic, 2 his power
         heuristic. (Default: 1)
     * - photon_count
       - |int|
       - Light sub-paths an iteration; 0 stands for as many as camera paths. (Default: 0)
     * - initial_radius
       - |float|
       - Merge radius of the first iteration, in scene units; 0 stands for 0.4 % of the spread of
         what the camera sees. (Default: 0)
     * - alpha
       - |float|
       - Radius reduction of progressive photon mapping, in (0, 1]: iteration i uses R_i^2 = R_0^2
         (i + 1)^(alpha - 1). 1 keeps the radius. (Default: 1)
     * - camera_paths, variance, aovs, max_depth, rr_depth, hide_emitters, sampler
       -
       - As of :monosp:`bdpt`.

    The techniques of :monosp:`bdpt`, and merging: at every smooth vertex of a camera path, all
    light sub-paths that end within the radius contribute as photons do. All techniques share a path
    by Veach's heuristic, with the density of merges as Georgiev et al. 2012 have it, which takes
    each light sub-path for a sample of its own.

    The bias of merging vanishes with the radius: consistent where ``alpha`` is below 1. In
    participating media vertices are joined and merged as on surfaces, within balls of four times
    the radius. The phase function ``sggx`` as part of another one, the BSDF ``hair``, polarised
    variants, gradients and the film ``specfilm`` are refused by name.

    .. tabs::
        .. code-tab:: xml

            <integrator type="vcm">
                <float name="alpha" value="0.75"/>
            </integrator>

        .. code-tab:: python

            'type': 'vcm',
            'alpha': 0.75
    """

    def read_parameters(self, parameters):
        self.read_heuristic(parameters)
        self.photon_count = parameters.integer(
            "photon_count", 0, 0, "at least 0 (0: as many as camera paths)", high=MOST_LIGHT_PATHS
        )
        self.initial_radius, self.alpha = read_radius(parameters)

    def settings(self):
        settings = super().settings()
        del settings["techniques"], settings["technique_weights"]
        return {
            **settings,
            "photon_count": self.photon_count,
            "initial_radius": self.initial_radius,
            "alpha": self.alpha,
        }

    def new_session(self, scene, sensor, seed, iterations):
        return VCMSession(self, scene, sensor, seed, iterations)


class VCMSession(BDPTSession):
    """Iterations of `vcm`: those of `bdpt`, and merging. Films that are rendered in parts have
    their light sub-paths in parts, too."""

    shortest = 1
    PASSES = {**BDPTSession.PASSES, "_merge_pass": ("_merge_vertices", ("light", "camera"))}

    def __init__(self, integrator, scene, sensor, seed, iterations):
        self.radius = integrator.initial_radius or None
        super().__init__(integrator, scene, sensor, seed, iterations)

    @property
    def settings(self):
        radius = {} if self.radius is None else {"radius": self.radius}
        return {**super().settings, "photon_count": self.light_path_count, **radius}

    def light_count(self):
        return -(-self.integrator.photon_count // self.chunks) or super().light_count()

    def radius_at(self, iteration):
        """The merge radius."""
        return shrunk(self.radius, self.integrator.alpha, iteration)

    def _spectral(self, iteration):
        spectral = super()._spectral(iteration)
        spectral["radius"] = dr.opaque(mi.Float, self.radius_at(iteration))
        return spectral

    def start(self):
        if self.radius is None:
            self._choose_radius(super()._spectral(0))

    @property
    def learned(self):
        return {} if self.radius is None else {"radius": self.radius}

    def recall(self, learned):
        if learned != {} or self.radius is None:
            fields = Fields(learned, "learned")
            self.radius = fields.number("radius", LARGEST_RADIUS, SMALLEST_RADIUS)
            fields.finish()

    def _choose_radius(self, spectral):
        """That of what the camera sees."""
        self.radius = automatic_radius(self.traits)
        if not self.bidirectional:
            return
        spectral = {**spectral, "radius": dr.opaque(mi.Float, self.radius)}
        while True:
            *_, camera, count, _ = self._camera_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(PILOT_INDEX, CAMERA, self.camera_paths),
                *self.all_over_the_film(),
                spectral,
            )
            if not self._grown("camera", count):
                break
        self.radius = automatic_radius(self.traits, camera, int(count[0]))

    def weights(self, spectral):
        plain = super().weights(spectral)
        merging = merging_of(self.traits, spectral["radius"], self.light_chunk)
        return ConnectionWeights(self.lights, plain.beta, plain.ratio, merging, plain.media)

    def _merge_vertices(self, scene, tables, radiance, camera, count, light, spectral, entries):
        index = lanes(self.capacity["camera"])
        active = index < dr.gather(mi.UInt32, count, 0)
        z = read_vertices(camera, index, active)
        weights = self.weights(spectral)

        def weigher(photon_map):
            def weigh(index, landing, scattering, active):
                state = state_of(photon_map, index, active)
                return weights.merged(z, state, scattering.p, scattering.back())

            return weigh

        parts = merged_light(
            self.traits,
            light,
            self.capacity["light"],
            STATES,
            z,
            active,
            weigher,
            spectral["radius"],
            self.light_chunk,
            self.integrator.max_depth,
            spectral,
        )
        return with_merged(radiance, entries, parts, z, active, self.chunk)

    def _merge(self, radiance, camera, count, light, spectral, entries):
        return self._merge_pass(
            self.scene, self._tables, radiance, camera, count, light, spectral, entries
        )
