"""Plugins `bdpm_opt`, `bdpm_opt2`, `bdpm_opt3`: merging at several camera vertices, under optimal
weights."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..mis.neighbour_radiance import NeighbourRadiance
from ..mis.optimal import OptimalWeights
from ..photons.frozen import SurfacePhotons, VolumePhotons
from ..photons.irradiance_cache import IrradianceCache
from ..photons.kernel_sums import ball_volume
from ..photons.trace import trace_light_paths
from .common import MOST_LIGHT_PATHS
from .noise_left import noise_left
from .parameters import ParameterError
from .published_optimal import (
    PHOTONS_A_PATH,
    STRATEGIES,
    USUAL_FROZEN_PATHS,
    PublishedSession,
)
from .purposes import FROZEN
from .weighted import WeightedBDPM, WeightedSession

USUAL_PHOTONS = 10
"""Tuned: photons a merge disk of the radius for which the weights of a pilot are made."""
SMALLEST_USUAL_RADIUS = 1e-5
"""That radius at least, in units of the scene's diagonal."""


class BDPMOpt(WeightedBDPM):
    r"""
    .. _integrator-bdpm_opt:

    Bidirectional ray tracing with photon maps, optimal weights (:monosp:`bdpm_opt`)
    --------------------------------------------------------------------------------

    .. pluginparameters::

     * - strategies
       - |int|
       - How many strategies are mixed: photons are merged at the camera vertices ``first_vertex``,
         ``first_vertex`` + 1, ... (vertices that scatter smoothly, counted from 0). From 1 to 6;
         ``bdpm_opt2`` and ``bdpm_opt3`` have 2 and 3. (Default: 3)
     * - first_vertex
       - |int|
       - The first camera vertex at which photons are merged, from 0 to 16. (Default: 0)
     * - weights
       - |string|
       - ``full`` keeps the means over directions in the optimal weights, estimated from typical
         neighbours; ``local`` drops them, which is cheaper and on diffuse scenes as good.
         ``published`` is the reference: the weights as the papers print them, from gathers in a
         frozen photon map; for two or three strategies, slow. (Default: ``local``)
     * - mix_diffuse
       - |bool|
       - Whether strategies go on beyond vertices that scatter as Lambertians do; else a path's
         first Lambertian vertex is its last strategy. It makes iterations less noisy and
         longer. Images that will be ``denoised`` have it unless it is given, and published weights
         always have it. (Default: no, i.e. |false|)
     * - frozen_photons
       - |int|
       - Light sub-paths of the pass from which the weights learn where light is; they do not
         contribute to the image. 0 stands for
         65536. (Default: 0)
     * - photon_count, initial_radius, alpha, direct_paths, denoised, camera_paths, variance, aovs,
         max_depth, rr_depth, hide_emitters, sampler
       -
       - As of :monosp:`bdpm`.

    Each light path that several strategies can make, because its photon may be merged at one camera
    vertex or the next, is shared among them with weights that minimise the noise of the pixel
    (Ershov, Kopylov and Voloboy 2021, here for any number of strategies by a scalar recursion).
    What the weights must know of the light around a path comes from a cache of irradiance; an
    inexact cache costs noise, but leaves the mean as it is. Weights may be negative or exceed one;
    those of a path sum to one.

    ``bdpm_opt2`` and ``bdpm_opt3`` are the same with ``strategies`` fixed to 2 and 3.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpm_opt">
                <integer name="strategies" value="2"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpm_opt',
            'strategies': 2
    """

    fixed_strategies = None

    def read_parameters(self, parameters):
        self.read_photon_parameters(parameters)
        self.strategies = self.fixed_strategies or parameters.integer(
            "strategies", 3, 1, "from 1 to 6", high=6
        )
        self.first_vertex = self.bdd = parameters.integer(
            "first_vertex", 0, 0, "from 0 to 16", high=16
        )
        self.weights = parameters.choice("weights", "local", ("full", "local", "published"))
        published = self.weights == "published"
        self.mix_diffuse = parameters.boolean("mix_diffuse", self.denoised or published)
        if published:
            self.check_published()
        self.frozen_photons = parameters.integer(
            "frozen_photons", 0, 0, "at least 0 (0: 65536)", high=MOST_LIGHT_PATHS
        )

    def check_published(self):
        """Refuses what the published weights do not have."""
        if self.strategies not in STRATEGIES:
            raise ParameterError(
                f'{self.plugin}: parameter "weights" = "published" allows "strategies" 2 or 3, for '
                f"which weights are printed; got {self.strategies}"
            )
        if not self.mix_diffuse:
            raise ParameterError(
                f'{self.plugin}: parameter "weights" = "published" allows no "mix_diffuse" = '
                "false: the papers mix strategies at all surfaces"
            )
        if self.denoised:
            raise ParameterError(
                f'{self.plugin}: parameter "weights" = "published" allows no "denoised": the '
                "papers know of no denoiser"
            )
        if self.splits_light:
            raise ParameterError(
                f'{self.plugin}: parameter "weights" = "published" allows no layers "direct", '
                '"indirect" or "caustic" among the "aovs"'
            )

    def settings(self):
        return {
            **super().settings(),
            "first_vertex": self.first_vertex,
            "weights": self.weights,
            "mix_diffuse": self.mix_diffuse,
            "frozen_photons": self.frozen_photons,
        }

    def refused_in_media(self):
        return [] if self.weights == "local" else [(f'"weights" = {self.weights}', '"local"')]

    def new_session(self, scene, sensor, seed, iterations):
        session = PublishedSession if self.weights == "published" else BDPMOptSession
        return session(self, scene, sensor, seed, iterations)


class BDPMOpt2(BDPMOpt):
    r"""``bdpm_opt`` with two strategies; see there."""

    fixed_strategies = 2


class BDPMOpt3(BDPMOpt):
    r"""``bdpm_opt`` with three strategies; see there."""

    fixed_strategies = 3


class BDPMOptSession(WeightedSession):
    """Iterations of `bdpm_opt`."""

    weighted_pilot = True

    def usual_radii(self):
        """Radii at which a typical lit point has `USUAL_PHOTONS` photons within its merge disk, or
        within its merge ball."""

        def measure(cache):
            share = cache.typical_flux / (self.light_path_count * max(cache.mean, 1e-30))
            return USUAL_PHOTONS * share

        radii = {"indirect": math.sqrt(measure(self.cache) / math.pi)}
        if self.fluence is not None:
            radii["volume"] = (measure(self.fluence) / (4 / 3 * math.pi)) ** (1 / 3)
        least = SMALLEST_USUAL_RADIUS * self.traits.extent  # where no light meets any
        return {kind: dr.opaque(mi.Float, max(radius, least)) for kind, radius in radii.items()}

    def __init__(self, integrator, scene, sensor, seed, iterations):
        self.cache = self.neighbour_radiance = self.fluence = None
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.noise_left = noise_left(integrator, sensor)

    @property
    def points(self):
        return self._weighted and self.has_volume

    def _take(self, choice):
        """Balls are no wider than the disks of surfaces, where these gather, too: the pilot renders
        under weights for one radius, which let direct light's photons make too much noise in the
        smaller balls that it tries, and takes too wide ones."""
        disks = [radius for kind, radius in choice.radii.items() if kind != "volume"]
        if self.points and disks:
            volume = min(choice.radii["volume"], max(disks))
            choice = replace(choice, radii={**choice.radii, "volume": volume})
        super()._take(choice)

    def mixes(self):
        if not (self.traits.has_rough or self.integrator.mix_diffuse):
            return False
        self._learn()
        # Where light meets nothing there is nothing to learn, nor to mix.
        caches = [cache for cache in (self.cache, self.fluence) if cache is not None]
        return any(dr.width(cache.center) > 0 for cache in caches)

    def prepare(self, spectral):
        if self.integrator.weights == "full":
            self.neighbour_radiance = NeighbourRadiance(
                self.scene,
                self.weights({"n": mi.Spectrum(0), "caustic_cost": mi.Float(0)}),
                spectral["wavelengths"],
            )

    def _learn(self):
        """One dense light pass, frozen, the first time that it is asked for: for the weights
        only."""
        if self.cache is not None:
            return
        integrator, spectral = self.integrator, self._spectral(0)
        paths = integrator.frozen_photons or USUAL_FROZEN_PATHS
        media = self.traits.has_media
        capacity, found = 0, PHOTONS_A_PATH * paths
        while found > capacity:
            capacity = found
            light_pass = self.describe_light_pass(
                self.sensor, self._sequence(0, FROZEN, paths), paths, spectral
            )
            surface, power, count, *in_media = trace_light_paths(
                self.world,
                self.limits,
                light_pass,
                capacity,
                keep_direct=True,
                volume_capacity=capacity if media else 0,
            )
            dr.eval(surface, power, count, in_media)
            found = max(int(number[0]) for number in (count, *(kept[2] for kept in in_media)))

        def cache(photons):
            return IrradianceCache(
                self.scene,
                self.lights,
                photons,
                paths,
                self.traits,
                spectral["wavelengths"],
            )

        self.cache = cache(SurfacePhotons(surface, power, count, self.traits.bounds))
        if media:
            self.fluence = cache(VolumePhotons(*in_media[0], spectral["wavelengths"]))

    def _freeze(self):
        super()._freeze()
        if self._weighted:
            self._tables += self.cache.tables()
            if self.neighbour_radiance:
                self._tables += [self.neighbour_radiance.table, self.neighbour_radiance.albedo]
            if self.fluence is not None:
                self._tables += self.fluence.tables()

    def weights(self, merge_settings):
        integrator = self.integrator
        return OptimalWeights(
            self.lights,
            self.traits,
            self.cache,
            self.neighbour_radiance,
            n=merge_settings["n"],
            caustic_cost=merge_settings["caustic_cost"],
            strategies=integrator.strategies,
            first=integrator.first_vertex,
            camera_paths=self.camera_paths / self.noise_left,
            full=integrator.weights == "full",
            mix_diffuse=integrator.mix_diffuse,
            fluence=self.fluence,
            disk_per_ball=merge_settings.get("disk_per_ball"),
            ball_paths=merge_settings.get("ball_paths"),
        )

    def merge_settings(self, radii):
        cache = self.cache if any(self.cache.photon_flux) else self.fluence or self.cache
        inverse = [
            dr.opaque(mi.Float, self.light_path_count / flux if flux > 0 else 0.0)
            for flux in cache.photon_flux
        ]  # no kernel's literals
        radius = radii.get("indirect", radii.get("caustic", radii.get("volume")))
        of_media = {}
        if self.fluence is not None:
            ball = ball_volume(radii.get("volume", radius))
            of_media["disk_per_ball"] = dr.pi * dr.square(radius) / ball
            of_media["ball_paths"] = ball * self.light_path_count
        dearer = dr.opaque(mi.Float, sum(cache.caustic_flux) / max(sum(cache.photon_flux), 1e-30))
        return {
            "n": dr.pi
            * dr.square(radius)
            * mi.Spectrum(inverse if len(inverse) > 1 else inverse[0]),
            "caustic_cost": dearer * dr.square(radius / radii.get("caustic", radius)),
            **of_media,
        }
