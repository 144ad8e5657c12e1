"""Plugin `bdpm`: bidirectional ray tracing with photon maps, one strategy."""

from __future__ import annotations

from ..core.film import as_camera_weights, expected_weight, with_colour
from ..core.recording import recorder
from ..paths.bent_surfaces import may_magnify
from ..paths.camera import film_sample_count, film_size
from ..paths.layers import CHANNELS, SPLIT
from ..paths.lobes import LobedBSDFs, LobeWidths, NarrowSurfaces
from ..paths.ray_cones import cones_of
from ..paths.sensor import Lens
from ..photons.hits import meets_one_light
from ..photons.near_zone import NearZone
from ..photons.volume_radii import VolumeDensity
from ..pilot.direct_paths import MOST_PATHS
from ..pilot.radius import largest_radius
from ..pilot.run import PILOT_INDEX
from ..pilot.setting import PilotSetting, corrects, light_shares, pilot_light_paths
from .caustic_radii import CausticRadii
from .common import MOST_LIGHT_PATHS, IterativeIntegrator
from .direct_light import DirectLight
from .noise_left import noise_left
from .photon_passes import PhotonPasses
from .pilot_passes import SubsetPasses
from .purposes import CAMERA, LIGHT
from .schedule import read_radius

CAMERA_CHUNK, CHUNK_IN_MEDIA = 1 << 21, 1 << 19
"""Camera paths traced at once at most, and in scenes with media, where each has beams; larger films
are traced in parts (bounds memory)."""


class BDPM(IterativeIntegrator):
    r"""
    .. _integrator-bdpm:

    Bidirectional ray tracing with photon maps (:monosp:`bdpm`)
    -----------------------------------------------------------

    .. pluginparameters::

     * - bdd
       - |int|
       - Backward diffuse depth: the camera vertex at which photons are gathered, counted from 0
         over vertices that scatter smoothly. Direct light is estimated at every vertex up to it.
         (Default: 1)
     * - pass_narrow
       - |bool|
       - Whether camera paths go on through surfaces with narrow lobes, as of polished metal or
         frosted glass, and curves; with ``bdd`` 0 and an automatic radius through legs, leaves and
         rims, too, that are narrower than merge disks. Only caustic photons are gathered there, and
         ``bdd`` does not count these vertices. Of a coat on a diffuse base, photons make the base's
         light. (Default: yes, i.e. |true|)
     * - photon_count
       - |int|
       - Light sub-paths an iteration; 0 stands for as many as the cropped film has pixels. With an
         automatic radius the pilot may choose fewer, down to a thirty-second. (Default: 0)
     * - initial_radius
       - |float|
       - Merge radius of the first iteration, in scene units; 0 balances noise against blur in a
         short pilot, apart for caustic and for other photons, and with ``bdd`` 0 corrects the
         estimate near edges. Caustic photons with little light around have larger radii of their
         own then, and volume photons that lie densely have smaller ones. (Default: 0)
     * - alpha
       - |float|
       - Radius reduction of progressive photon mapping, in (0, 1]: iteration i uses R_i^2 = R_0^2
         (i + 1)^(alpha - 1). 1 keeps the radius. (Default: 1)
     * - direct_paths
       - |int|
       - Camera paths that see emission and direct light at their first smooth vertex, for each of
         the ``camera_paths`` of a pixel, which are among them; from 0 to 256. 0 chooses the number
         for each pixel by the noise of such light, from a few trials. (Default: 0)
     * - denoised
       - |bool|
       - Whether the image will be denoised: what is chosen automatically then minimises the error
         that a denoiser leaves. ``mis-render --denoise`` sets it. (Default: no, i.e. |false|)
     * - camera_paths
       - |int|
       - Camera paths per pixel and iteration that gather photons. (Default: 1)
     * - variance
       - |bool|
       - Adds the channels ``var.R``, ``var.G``, ``var.B`` (mono: ``var.Y``): the estimated variance
         of the pixel mean over the iterations, of which there must be two at least. (Default: no,
         i.e. |false|)
     * - aovs
       - |string|
       - Adds layers of what the camera sees, ``name:type`` with commas between them, as Mitsuba's
         ``aov``: of the types ``albedo``, ``sh_normal`` (through glass and in mirrors), ``depth``,
         ``position``, ``geo_normal``, ``uv``, ``shape_index``, ``prim_index`` (of the first
         surface); and ``direct``, ``indirect``, ``caustic``, which sum to the image. Channels are
         ``name.R``, ``name.X`` and so on, after all others. (Default: ``none``)
     * - max_depth
       - |int|
       - Longest path in segments, both halves together (-1: unlimited). A value of 1 shows only
         directly visible emitters, 2 adds direct light, and so on. (Default: -1)
     * - rr_depth
       - |int|
       - Depth from which Russian roulette may end a sub-path, in each half. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: no, i.e. |false|)
     * - sampler
       - |string|
       - Random numbers of sub-paths: ``sobol``, scrambled Sobol' sequences, one a pixel over all
         iterations; or ``independent``. The scene's ``<sampler>`` is not used but for its sample
         count. (Default: ``sobol``)

    Each iteration traces light sub-paths, stores them as photons in a grid, traces camera paths,
    and estimates the light that photons bring to the camera paths' vertices from their density.
    Direct light comes from next-event estimation combined with BSDF sampling; photons carry all
    light of two or more segments, and caustics, which next-event estimation cannot make. The number
    of iterations is the number of samples per pixel over ``camera_paths``.

    In participating media light sub-paths scatter, too, and leave volume photons there. Vertices in
    media count for ``bdd``. From its last vertex before the ``bdd``-th on, a camera path goes
    straight on to the next smooth surface, and gathers the volume photons along its way (Jarosz et
    al. 2008, the beam radiance estimate). They carry all light that media scatter there, their
    single scattering included.

    In images that will be ``denoised``, volume photons that the sensor sees are joined with it,
    each for one pixel, but for those very close to it. Camera paths go straight through media to
    the first smooth surface then.

    The bias vanishes with the radius (but for that of photons very close to the sensor): with
    ``alpha`` below 1 the estimate is consistent; with the default the radius stays as it is.
    Polarised variants, gradients, the film ``specfilm``, the BSDF ``hair`` and the phase function
    ``sggx`` as part of another one are refused by name.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpm">
                <integer name="bdd" value="0"/>
                <integer name="max_depth" value="10"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpm',
            'bdd': 0,
            'max_depth': 10
    """

    LAYERS = *CHANNELS, *SPLIT

    def read_parameters(self, parameters):
        self.read_photon_parameters(parameters)
        self.bdd = parameters.integer("bdd", 1, 0, "at least 0")
        self.pass_narrow = parameters.boolean("pass_narrow", True)

    def read_photon_parameters(self, parameters):
        """Reads what concerns the photon map."""
        self.photon_count = parameters.integer(
            "photon_count", 0, 0, "at least 0 (0: automatic)", high=MOST_LIGHT_PATHS
        )
        self.initial_radius, self.alpha = read_radius(parameters)
        self.direct_paths = parameters.integer(
            "direct_paths", 0, 0, "at least 0 (0: automatic)", high=MOST_PATHS
        )
        self.denoised = parameters.boolean("denoised", False)

    def settings(self):
        return {
            **super().settings(),
            "photon_count": self.photon_count,
            "initial_radius": self.initial_radius,
            "alpha": self.alpha,
            "direct_paths": self.direct_paths,
            "denoised": self.denoised,
            "bdd": self.bdd,
            "pass_narrow": self.pass_narrow,
        }

    def new_session(self, scene, sensor, seed, iterations):
        return BDPMSession(self, scene, sensor, seed, iterations)


class BDPMSession(PhotonPasses):
    """Iterations of `bdpm`: light pass, photon maps, camera pass, gather."""

    chooses_light_paths = True
    """Whether the pilot chooses how many light sub-paths an iteration has. (Weights would have to
    know of it before they are made.)"""
    widens_caustics = True
    """Whether caustic photons with little light around have larger radii where the radius is
    automatic."""
    narrows_volume = True
    """Whether volume photons that lie densely have smaller ones. (Weights know one radius for
    all.)"""
    suits_denoisers = True
    """Whether in images that will be denoised near pixels share no photons that the camera sees:
    caustic ones have disks of a pixel's size there, and volume photons are joined with the sensor.
    (Weights know one radius for all, and beams only.)"""
    meets_lights = True
    """Whether camera paths bring caustic light, too, where they meet lights by chance. (Weights
    know of photons alone.)"""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self._find_world()
        self.iteration_light_paths = self.light_path_count = integrator.photon_count or min(
            film_sample_count(sensor), MOST_LIGHT_PATHS
        )  # the latter are fewer in a pilot, and where so many do not pay
        self._find_needs()
        self.split_paths(CHUNK_IN_MEDIA if self.has_volume else CAMERA_CHUNK)
        self._left_by_a_path = 0.0, 0.0  # photons on surfaces and in media, in the last light pass
        self._make_room_for_photons()
        self.beam_capacity = self._beam_room(self.chunk)
        self.vertex_capacity = self._vertex_room(self.chunk)
        if integrator.initial_radius:
            self.radii = dict.fromkeys(self.kinds(), integrator.initial_radius)
        self.recorded = recorder()
        self.direct_light = DirectLight(self)
        self.accumulator.direct_noise = self.direct_light.noise_of_iteration
        self.caustic_radii = CausticRadii(self)
        self._volume_density = None
        self._freeze()

    def _find_needs(self):
        """Which photons and vertices this scene and this render need."""
        integrator, sensor = self.integrator, self.sensor
        depth = integrator.max_depth
        self.has_caustics = not self.lights.dark and (
            (self.traits.has_unsampled_lights and (depth < 0 or depth >= 2))
            or (self.traits.has_delta and (depth < 0 or depth >= 3))
        )
        self.has_indirect = not self.lights.dark and (depth < 0 or depth >= integrator.bdd + 3)
        lit = self.traits.has_media and not self.lights.dark
        for_denoiser = (
            integrator.denoised and not integrator.initial_radius and self.suits_denoisers
        )
        self.near_zone = None  # where volume photons are joined with the sensor, a `NearZone`
        lens = Lens(sensor)
        if for_denoiser and lit and (depth < 0 or depth >= 2) and lens.connects:
            self.near_zone = NearZone(lens)
            self.expected_weight = expected_weight(
                sensor.film(), integrator.camera_paths, in_crop=True
            )
        self.has_volume = self.near_zone is not None or (
            lit and (self.has_caustics or depth < 0 or depth >= integrator.bdd + 2)
        )
        self.cones = None  # where the camera sees caustics in disks of a pixel's size, `RayCones`
        if for_denoiser and self.has_caustics and (lens.connects or not self.has_volume):
            self.cones = cones_of(sensor)
        self.by_chance = (
            self.has_caustics
            and self.traits.has_delta
            and self.meets_lights
            and not integrator.initial_radius
            and self.traits.has_light_surfaces
            and meets_one_light(self.scene)
        )
        passes = self.has_indirect and integrator.pass_narrow
        # Camera paths bring what narrower disks miss, if they meet all lights.
        meets_all = self.by_chance and not self.traits.has_unmet_lights
        lobed = LobedBSDFs.of(self.scene) if passes or meets_all else None
        self.narrow = NarrowSurfaces.of(self.scene, lobed) if passes else None
        self.lobe_widths = LobeWidths.of(lobed) if meets_all else None
        self.has_caustics_unseen = self.has_caustics and (
            self.cones is None
            or integrator.bdd > 0
            or self.narrow is not None
            or may_magnify(self.scene)
        )
        self.parted = self.narrow is not None and self.narrow.parted
        self.passes_edges = (
            integrator.pass_narrow
            and self.has_indirect
            and integrator.bdd == 0
            and not (integrator.denoised or integrator.initial_radius)
        )
        asks_once = integrator.bdd == 0 and self.narrow is None and not self.passes_edges
        self.one_vertex = not self.traits.has_mixed and (
            asks_once or not (self.has_caustics or self.parted)
        )

    @property
    def settings(self):
        return {**super().settings, "photon_count": self.light_path_count}

    @property
    def left_out(self):
        needed = {
            "caustic photons": self.has_caustics,
            "indirect photons": self.has_indirect,
            "media": self.traits.has_media,
            "narrow lobes": self.narrow is not None or not self.integrator.pass_narrow,
            "emission met by chance": self.traits.has_light_surfaces,
        }
        return [part for part, flag in needed.items() if not flag]

    @property
    def last_vertex(self):
        """The smooth camera vertex, counted from 0, beyond which no camera path is shaded."""
        return self.integrator.bdd

    def kinds(self):
        return [
            kind
            for kind, needed in (
                ("seen_caustic", self.cones is not None),
                ("caustic", self.has_caustics_unseen),
                ("indirect", self.has_indirect),
                ("volume", self.has_volume),
            )
            if needed
        ]

    def corrects(self, kind):
        """Whether what photons of a kind bring is corrected at edges."""
        return not self.integrator.initial_radius and corrects(kind, self.integrator.bdd == 0)

    def pilot_setting(self):
        integrator = self.integrator
        chooses = self.chooses_light_paths and not integrator.photon_count
        return PilotSetting(
            width=film_size(self.sensor)[0],
            pixels=film_sample_count(self.sensor),
            extent=self.traits.extent,
            kinds=tuple(self.kinds()),
            at_first_vertex=integrator.bdd == 0,
            passes_lobes=self.narrow is not None,
            camera_paths=self.camera_paths,
            iterations=self.iterations_planned,
            seconds=self.seconds,
            light_paths=self.iteration_light_paths / self.light_path_count,
            denoised=integrator.denoised,
            filter_share=1.0 if integrator.denoised else noise_left(integrator, self.sensor),
            light_shares=light_shares(self.iteration_light_paths) if chooses else (1.0,),
            volume_dimensions=3 if self.points else 2,
            joins_sensor=self.near_zone is not None,
        )

    def pilot_passes(self, setting, pixels):
        return SubsetPasses(self, setting, pixels, CAMERA)

    def _run_pilot(self, settled=None):
        """With a pilot's light sub-paths."""
        if not self.needs_pilot:
            return super()._run_pilot(settled)
        self._use_light_paths(pilot_light_paths(self.iteration_light_paths))
        pilot = super()._run_pilot(settled)
        self._use_light_paths(self.iteration_light_paths)
        return pilot

    def volume_density(self):
        """The `VolumeDensity` of the first light pass of a pilot, measured when it is first asked
        for, and the near zone with it; None where all volume photons have the same radius."""
        differ = self.has_volume and self.narrows_volume and not self.integrator.initial_radius
        if differ and self._volume_density is None:
            count = self.light_path_count
            self._use_light_paths(pilot_light_paths(self.iteration_light_paths))
            in_media = self.trace_photons(PILOT_INDEX, LIGHT)[-1]
            largest = largest_radius(self.traits.extent)
            self._volume_density = VolumeDensity.of(*in_media[:3], largest)
            if self.near_zone is not None:
                self._measure_near_zone(in_media)
            self._use_light_paths(count)
        return self._volume_density

    def _measure_near_zone(self, in_media):
        """Finds the zone's depth by the light of all photons that are joined with the sensor."""
        seed, spectral = self.sensor_seed(PILOT_INDEX), self._spectral(PILOT_INDEX)
        light = self._join_sensor(self.sensor, in_media, seed, spectral)
        self.near_zone.measure(in_media[0], light)
        self._list_tables()

    def photons_of_a_path(self):
        """How many photons a light sub-path leaves, on average: by the light pass of a pilot."""
        self._use_light_paths(pilot_light_paths(self.iteration_light_paths))
        if self.volume_density() is None:  # else it has just been measured, by the same pass
            self.trace_photons(PILOT_INDEX, LIGHT)
        return self.photons_a_path

    def _use_light_share(self):
        self._use_light_paths(self.chosen_light_paths)

    @property
    def chosen_light_paths(self):
        """Light sub-paths of an iteration of the render (a pilot traces others)."""
        return max(round(self.light_share * self.iteration_light_paths), 1)

    def start(self):
        super().start()
        self.direct_light.find_paths()

    def _take(self, choice):
        super()._take(choice)
        if choice.prediction is not None and not self.kept:  # those that are kept have their radii
            self.caustic_radii.plan(max(choice.prediction.iterations, 1))

    def _foresee(self, choice):
        super()._foresee(choice)
        if self.prediction is None:
            self.direct_light.choose_paths()
        else:
            self.prediction = self.direct_light.beside(self.prediction, anew=not self.kept)

    def direct_cost(self):
        return self.direct_light.cost

    def _prepare(self):
        self.caustic_radii.find()

    @property
    def learned(self):
        learned = super().learned
        return learned and {
            **learned,
            "direct_light": self.direct_light.learned,
            "caustic_radii": {"iterations": self.caustic_radii.iterations},
        }

    def recall_more(self, fields):
        of_caustics = fields.object("caustic_radii")
        self.caustic_radii.plan(
            of_caustics.number("iterations", self.caustic_radii.most_iterations)
        )
        of_caustics.finish()
        of_direct_light = fields.object("direct_light")
        self.direct_light.recall(of_direct_light)
        of_direct_light.finish()

    def _iteration(self, iteration):
        radii = self.radii_at(iteration)
        spectral = self._spectral(iteration)
        # Before any pass is looked up: they may have to be recorded anew.
        around, density = self.caustic_radii.find(), self.volume_density()
        photons = self._photons(iteration, spectral) if radii else None
        maps = self._map_pass(photons, radii, around, density) if radii else None

        def render(chunk, first):
            while True:
                block, wanted = self._camera_pass(
                    self.scene,
                    self.sensor,
                    self._tables,
                    maps,
                    self._sequence(iteration, CAMERA, self.camera_paths),
                    first,
                    spectral,
                    radii,
                    self.direct_light.beyond,
                )
                if not radii or self._had_room(wanted):
                    return (block,)

        (block,) = self.sum_of_chunks(render)
        block = self.direct_light.add_to(block, iteration, spectral)
        if self.near_zone is not None:
            block = self._with_sensor_light(block, iteration, photons[-1], spectral)
        return block

    def _with_sensor_light(self, block, iteration, in_media, spectral):
        """The block of all camera paths, with the light of volume photons."""
        seed = self.sensor_seed(iteration)
        light = self._sensor_pass(self.scene, self.sensor, self._tables, in_media, seed, spectral)
        return with_colour(block, as_camera_weights(light, block, self.expected_weight))
