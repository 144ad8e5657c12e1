"""Plugin `bdpm`: bidirectional ray tracing with photon maps, one strategy."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..core.film import as_camera_weights, expected_weight, splat_light, splat_samples, with_colour
from ..core.packing import with_reserve
from ..core.recording import recorder
from ..core.traits import SceneTraits, lookup
from ..lights.lights import Lights
from ..mis.chance import ChanceWeights, StartDensity
from ..paths.camera import film_sample_count, film_size
from ..paths.layers import CHANNELS, SPLIT
from ..paths.light_classes import LightClasses, by_class_of_photons
from ..paths.lobes import is_narrow, narrow_bsdfs
from ..paths.ray_cones import cones_of
from ..paths.sensor import Lens
from ..paths.setting import World
from ..photons.beams import Beams, gather_along, mean_count_along, read_beams
from ..photons.coverage import covered_share
from ..photons.gather import QueryVertices, gather_photons, mean_photon_count
from ..photons.grid import PhotonMap, build_photon_map
from ..photons.hits import meets_one_light
from ..photons.near_zone import NearZone
from ..photons.queries import (
    Queries,
    pixel_disk,
    read_queries,
    takes_photons,
    trace_camera_paths,
)
from ..photons.sensor_light import join_photons
from ..photons.tiers import LEFT_TO_DENOISER, TieredMap, build_tiered_map, gather_tiers
from ..photons.trace import trace_light_paths
from ..photons.volume import VolumeMap, build_volume_map
from ..photons.volume_radii import VolumeDensity
from ..pilot.direct_paths import MOST_PATHS
from ..pilot.radius import largest_radius
from ..pilot.run import PILOT_INDEX
from ..pilot.setting import PilotSetting, light_shares, pilot_light_paths
from .caustic_radii import CausticRadii
from .common import MOST_LIGHT_PATHS, IterativeIntegrator
from .direct_light import DirectLight
from .pilot_passes import SubsetPasses
from .piloted import PilotedSession
from .schedule import read_radius

LIGHT, CAMERA, SENSOR = 0, 1, 6
"""Purposes of an iteration's random seeds, besides `IterativeSession.WAVELENGTH`,
`bdpm_opt.FROZEN`, `direct_light.PURPOSE` and `caustic_radii.PURPOSE`."""
SPARE_PHOTONS = 1 << 20
"""Unused room beyond half of a photon buffer that is worth the time to record the passes anew."""
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
       - Whether paths pass surfaces with narrow lobes, as of smooth metal or frosted glass, without
         gathering photons there, but for caustic ones; ``bdd`` does not count them then. (Default:
         yes, i.e. |true|)
     * - photon_count
       - |int|
       - Light sub-paths an iteration; 0 stands for as many as the cropped film has pixels, or with
         an automatic radius for that share of them which pays. (Default: 0)
     * - initial_radius
       - |float|
       - Merge radius of the first iteration, in scene units; 0 balances noise against blur in a
         short pilot, apart for caustic and for other photons, and corrects the estimate near edges
         where that pays. Caustic photons with little light around have larger radii of their own
         then, and volume photons that lie densely have smaller ones. (Default: 0)
     * - alpha
       - |float|
       - Radius reduction of progressive photon mapping, in (0, 1]: iteration i uses R_i^2 = R_0^2
         (i + 1)^(alpha - 1). 1 keeps the radius. (Default: 1)
     * - direct_paths
       - |int|
       - Camera paths per pixel and iteration that see emission and direct light at their first
         smooth vertex, those that gather photons among them. 0 sends more of them through pixels
         where such light is noisy, as a few trials tell. (Default: 0)
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

    The estimate is consistent: its bias vanishes with the radius (but for that of photons very
    close to the sensor). Polarised variants, gradients and the film ``specfilm`` are refused by
    name; in media also phase functions of flakes and ``hide_emitters``.

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
    MEDIA = True

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


class BDPMSession(PilotedSession):
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
    points = False
    """Whether volume photons are gathered at vertices in media, and not along beams."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.traits = SceneTraits(scene, sensor)
        self.lights = Lights.seen_by(scene, sensor, integrator.plugin)
        if self.traits.has_media:
            self.lights.find_media(sensor, integrator.plugin)
        self.world = World(scene, self.lights, self.traits)
        self.iteration_light_paths = self.light_path_count = integrator.photon_count or min(
            film_sample_count(sensor), MOST_LIGHT_PATHS
        )  # the latter are fewer in a pilot, and where so many do not pay
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
        self.narrow = None
        if integrator.pass_narrow and self.has_indirect:
            self.narrow = narrow_bsdfs(scene)
        self.has_caustics_unseen = self.has_caustics and (
            self.cones is None or integrator.bdd > 0 or self.narrow is not None
        )
        self.by_chance = (
            self.cones is not None
            and self.meets_lights
            and self.traits.has_light_surfaces
            and meets_one_light(scene)
        )
        self.one_vertex = not self.traits.has_mixed and (
            (integrator.bdd == 0 and self.narrow is None) or not self.has_caustics
        )
        self.split_paths(CHUNK_IN_MEDIA if self.has_volume else CAMERA_CHUNK)
        self._left_by_a_path = 0.0, 0.0  # photons on surfaces and in media, in the last light pass
        self._make_room_for_photons()
        self.beam_capacity = self._beam_room(self.chunk)
        self.vertex_capacity = self._vertex_room(self.chunk)
        if integrator.initial_radius:
            self.radii = dict.fromkeys(self.kinds(), integrator.initial_radius)
        self.corrected = dict.fromkeys(self.kinds(), False)
        self.recorded = recorder()
        self.direct_light = DirectLight(self)
        self.caustic_radii = CausticRadii(self)
        self._volume_density = None
        self._freeze()

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

    def _make_room_for_photons(self):
        """By the last light pass; before the first one, for three photons a path."""
        self._sized = self.photons_a_path > 0
        on_surfaces, in_media = self._left_by_a_path if self._sized else (3.0, 3.0)
        self.photon_capacity = self._photon_room(on_surfaces)
        self.volume_capacity = self._photon_room(in_media) if self.traits.has_media else 0

    def _photon_room(self, a_path):
        """Room for so many photons `a_path`, with an eighth and some more."""
        return with_reserve(math.ceil(a_path * self.light_path_count) + 1024)

    @property
    def photons_a_path(self):
        """Those that a light sub-path left, in the last light pass."""
        return sum(self._left_by_a_path)

    def _record_camera_pass(self):
        self._camera_pass = self.recorded(self._render_chunk)

    def pilot_setting(self):
        integrator = self.integrator
        return PilotSetting(
            film_size(self.sensor)[0],
            film_sample_count(self.sensor),
            self.traits.extent,
            tuple(self.kinds()),
            integrator.bdd == 0,
            self.narrow is not None,
            self.camera_paths,
            self.iterations_planned,
            self.seconds,
            self.iteration_light_paths / self.light_path_count,
            integrator.denoised,
            light_shares(self.iteration_light_paths)
            if self.chooses_light_paths and not integrator.photon_count
            else (1.0,),
            3 if self.points else 2,
            self.near_zone is not None,
        )

    def pilot_passes(self, setting, pixels):
        return SubsetPasses(self, setting, pixels, CAMERA)

    def _run_pilot(self):
        """With a pilot's light sub-paths."""
        if not self.needs_pilot:
            return super()._run_pilot()
        self._use_light_paths(pilot_light_paths(self.iteration_light_paths))
        pilot = super()._run_pilot()
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

    def trace_photons(self, iteration, purpose):
        """The photons of a light pass, as those of an iteration, but for another purpose."""
        return self._photons(iteration, self._spectral(iteration), purpose)

    def _use_light_paths(self, count):
        """Traces so many in each light pass from now on."""
        if count != self.light_path_count:
            self.light_path_count = count
            self._make_room_for_photons()
            self._freeze()

    def _use_light_share(self):
        self._use_light_paths(max(round(self.light_share * self.iteration_light_paths), 1))

    def start(self):
        super().start()
        if self.direct_light.mean_paths is None:
            self.direct_light.choose_paths()

    def _take(self, choice):
        super()._take(choice)
        if choice.prediction is not None and not self.kept:  # those that are kept have their radii
            self.caustic_radii.plan(max(choice.prediction.iterations, 1))
        if self.prediction is None:
            self.direct_light.choose_paths()
        else:
            self.prediction = self.direct_light.beside(self.prediction, anew=not self.kept)

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

    def _vertex_room(self, paths):
        if not self.kinds():
            return 0
        return paths if self.one_vertex else 2 * paths

    def _beam_room(self, paths):
        return 2 * paths if self.has_volume else 0

    def expect(self, vertices, beams, paths):
        """Makes room for the vertices and beams of an iteration, of which so many `paths` had so
        many: an iteration that has to make it traces its camera paths twice."""
        self.vertex_capacity = max(self.vertex_capacity, self._room_for(vertices, paths))
        self.beam_capacity = max(self.beam_capacity, self._room_for(beams, paths))

    def _room_for(self, found, paths):
        """Room in a chunk for what so many `paths` had, and an eighth more."""
        return with_reserve(math.ceil(found / paths * self.chunk))

    # ------------------------------------------------------------------ passes

    def _freeze(self):
        """Records the passes anew; from the second iteration on, their kernels run without their
        Python."""
        self._list_tables()
        self._light_pass = self.recorded(self._trace_light)
        self._map_pass = self.recorded(self._build_maps)
        self._sensor_pass = self.recorded(self._splat_photons)
        self._record_camera_pass()

    def _list_tables(self):
        """Lists what recorded functions read."""
        self._light_paths = dr.opaque(mi.Float, self.light_path_count)  # one kernel for any number
        self._tables = [
            self._light_paths,
            self.traits.lambertian,
            self.traits.perturbed,
            *self.lights.tables(),
        ]
        if self.narrow is not None:
            self._tables.append(self.narrow)
        if self.cones is not None:
            self._tables += self.cones.tables()
        if self.near_zone is not None:
            self._tables += self.near_zone.tables()

    def _trace_light(self, scene, sensor, tables, sequence, spectral):
        return trace_light_paths(
            self.world,
            self.limits,
            self.describe_light_pass(sensor, sequence, self.light_path_count, spectral),
            self.photon_capacity,
            light_state=self._light_state(spectral),
            marked=self.integrator.splits_light,
            volume_capacity=self.volume_capacity,
        )

    def _light_state(self, spectral):
        """What photons carry for the weights; None where there are none."""
        return StartDensity(self.lights) if self.by_chance else None

    def _merge_state(self, spectral):
        """The weights of camera paths (a `mis.state.MergeState`); None where there are none."""
        return None

    def _trace_camera(
        self, camera_pass, capacity, spectral, first=1.0, beyond=None, classes=None, beams=0
    ):
        """Traces the paths of a `CameraPass`, with room for so many vertices and beams; other
        arguments as of `trace_camera_paths`."""
        queries = Queries(
            self.last_vertex,
            capacity,
            self.has_caustics,
            self.has_indirect,
            self.one_vertex,
            0 if self.points else beams,
            self.narrow,
            self.points,
            self.cones,
            self.near_zone,
            self.by_chance,
        )
        return trace_camera_paths(
            self.world,
            self.limits,
            camera_pass,
            queries,
            self._merge_state(spectral),
            first,
            beyond,
            classes,
        )

    def _join_sensor(self, sensor, in_media, seed, spectral):
        """The `SensorLight` of an iteration's volume photons: its values are radiance."""
        light = join_photons(
            self.world,
            Lens(sensor),
            self.near_zone,
            in_media[:3],
            seed,
            spectral["wavelengths"],
            self.integrator.splits_light,
        )
        width, height = sensor.film().crop_size()
        light.value *= width * height * dr.rcp(self._light_paths)
        return light

    def sensor_seed(self, iteration):
        """Of the random numbers of photons that are joined with the sensor."""
        return self._seed(iteration, SENSOR)

    def _splat_photons(self, scene, sensor, tables, in_media, seed, spectral):
        """The block of the light that volume photons bring to the sensor."""
        light = self._join_sensor(sensor, in_media, seed, spectral)
        parts = [light.value * self.camera_paths]
        if self.integrator.kept_classes:
            classes = by_class_of_photons(
                parts[0], light.depth, mi.Bool(True), light.delta_at_light
            )
            parts += classes[: self.integrator.kept_classes]
        matrix = spectral["sensor_matrix"]
        return splat_light(sensor.film(), light.film, parts, matrix, light.active)

    def _gather(self, photon_map, vertices, kind, radii, spectral, grey=False):
        """What photons of one kind bring to each vertex, volume photons to each beam, for each
        radius (and class: see `gather_photons`)."""
        if kind == "volume":
            return gather_along(
                photon_map,
                Beams.read(vertices["beams"], spectral["wavelengths"]),
                radii,
                self._light_paths,
                self.integrator.max_depth,
                grey,
                self.integrator.splits_light,
                near_zone=self.near_zone,
            )
        return self._merge(photon_map, read_queries(vertices), kind, radii, spectral, grey)

    def _merge(self, photon_map, record, kind, radii, spectral, grey=False, weigh=None, scale=1):
        """`gather_photons` of one kind at vertices as of `read_queries`."""
        takes = takes_photons(record, kind)
        vertices = QueryVertices(self.traits, record, spectral["wavelengths"], takes, scale)
        if kind == "seen_caustic":
            radii = [dr.minimum(radius, pixel_disk(record)) for radius in radii]
        light_paths, max_depth = self._light_paths, self.integrator.max_depth
        marked, chance = self.integrator.splits_light, None
        if self.by_chance and kind != "indirect":
            chance = ChanceWeights(self.lights, light_paths, vertices, record["hits"])
        if isinstance(photon_map, TieredMap):
            narrow, first, weigher = mi.Bool(False), radii[0], chance and chance.weigher
            if self.narrow is not None:
                narrow = is_narrow(self.narrow, vertices.bsdf, vertices.si, vertices.active)
            found = gather_tiers(
                photon_map, vertices, first, light_paths, max_depth, weigher, marked, narrow
            )
            if chance is not None:
                flux, left = chance.hits["flux"], self._tiers_left
                active = vertices.active & (flux > 0)
                radii = [photon_map.radii_of(vertices.p, flux, first, narrow, left, active)]
        else:
            if chance is not None:
                weigh = chance.weigher(photon_map, radii)
            found = gather_photons(
                photon_map, vertices, radii, light_paths, max_depth, weigh, grey, marked
            )
        return found if chance is None else chance.with_hits(found, radii, grey)

    @property
    def _tiers_left(self):
        """The last tier whose photons have the radius of the first, see `build_tiered_map`."""
        return LEFT_TO_DENOISER if self.cones is not None else 0

    def _covered(self, scene, tables, vertices, radius, seed):
        """`covered` of the vertices of a buffer (recorded: `tables` are what it reads)."""
        return self.covered(scene, read_queries(vertices), radius, seed)

    def covered(self, scene, record, radius, seed):
        """Share of each vertex' merge disk that holds surface; one where the surface is not
        Lambertian: in a highlight the noise of dividing by an estimate would outweigh what it
        mends. `record` as of `read_queries`."""
        probed = dr.max(record["throughput"]) > 0
        if self.traits.has_rough:
            bsdf = record["hit"].shape.bsdf()
            probed &= lookup(self.traits.lambertian, bsdf, mi.Bool, probed)
        return dr.select(probed, covered_share(scene, record, radius, seed, probed), 1)

    def _records(self, vertices, kind):
        """What gathers photons of a kind, a dictionary of fields: vertices, or beams."""
        return read_beams(vertices["beams"]) if kind == "volume" else read_queries(vertices)

    def _per_path(self, values, vertices, kind, paths):
        """Sums values of what gathers photons of a kind for each of `paths` camera paths."""
        if self.one_vertex and kind != "volume":
            return values
        record, total = self._records(vertices, kind), dr.zeros(type(values), paths)
        dr.scatter_reduce(
            dr.ReduceOp.Add,
            total,
            values,
            record["path"],
            dr.max(record["throughput"]) > 0,
            dr.ReduceMode.Direct,
        )
        return total

    def mean_count(self, photon_map, vertices, kind, radius, paths, spectral):
        """Photons of a kind within `radius` of a vertex, or of a path's beams, on average (a
        number); `vertices` are those of so many `paths`."""
        if kind == "volume":
            beams = Beams.read(vertices["beams"], spectral["wavelengths"])
            return mean_count_along(photon_map, beams, radius, paths, self.near_zone)
        return mean_photon_count(photon_map, read_queries(vertices), radius)

    def _map(self, photons, kind, radius, density=None):
        """The map of photons of a kind; `density`: that of volume photons, by which their radii
        differ."""
        if self.traits.has_media:
            *photons, in_media = photons
            if kind == "volume":
                return build_volume_map(
                    *in_media[:3], radius, self.volume_capacity, *in_media[3:], density=density
                )
        weighted = kind != "indirect" if self.by_chance else kind == "indirect"
        mis_words = photons[3] if weighted and len(photons) > 3 else None
        return build_photon_map(
            *photons[:3],
            self.traits.bounds,
            radius,
            self.photon_capacity,
            "caustic" if kind == "seen_caustic" else kind,
            mis_words,
        )

    def _map_again(self, arrays, kind, radius):
        """The map of the arrays of one."""
        if kind == "volume":
            return VolumeMap.with_grid(arrays, self.volume_capacity)
        if TieredMap.has_made(arrays):
            return TieredMap(arrays, self.traits.bounds, self.photon_capacity)
        return PhotonMap.with_grid(arrays, self.traits.bounds, radius, self.photon_capacity)

    def _build_maps(self, photons, radii, around, density):
        maps = {}
        for kind, radius in radii.items():
            if kind == self.caustic_radii.kind and around is not None:
                photon_map = self._tiered_map(photons, radius, around)
            else:
                photon_map = self._map(photons, kind, radius, density)
            maps[kind] = photon_map.arrays()
        return maps

    def _tiered_map(self, photons, radius, around):
        """The map of caustic photons, with radii by the light around them."""
        return build_tiered_map(
            *photons[:3],
            self.traits.bounds,
            radius,
            self.photon_capacity,
            around,
            self._tiers_left,
            photons[3] if self.by_chance else None,
        )

    def _render_chunk(self, scene, sensor, tables, maps, sequence, first, spectral, radii, beyond):
        camera_pass = self.describe_camera_pass(sensor, sequence, first, spectral)
        there = self.in_chunk(first)
        if beyond is not None:
            pixel = (dr.arange(mi.UInt32, self.chunk) + first) // self.camera_paths
            beyond = dr.gather(mi.Float, beyond, pixel, there)
        classes, kept = None, self.integrator.kept_classes
        if kept:
            classes = LightClasses(self.chunk, None, ("met", "next_event"))
        radiance, alpha, position, vertices, count = self._trace_camera(
            camera_pass,
            self.vertex_capacity,
            spectral,
            1.0,
            beyond,
            classes,
            self.beam_capacity,
        )
        if classes is not None:
            dr.eval(radiance, alpha, position, vertices, count, classes.entries)
            classes = classes.radiance()[:kept]
        elif radii:
            dr.eval(radiance, alpha, position, vertices, count)
        for kind, radius in radii.items():
            photon_map = self._map_again(maps[kind], kind, radius)
            parts = self._gather(photon_map, vertices, kind, [radius], spectral)
            if self.corrected[kind]:
                correction = dr.rcp(
                    self._covered(scene, tables, vertices, radius, sequence.own_seed())
                )
                parts = [gathered * correction for gathered in parts]
            for number, gathered in enumerate(parts):
                gathered = self._per_path(gathered, vertices, kind, self.chunk)
                gathered = gathered if beyond is None else gathered * beyond
                radiance += gathered
                if self.integrator.splits_light:
                    classes[number] += gathered
        if self.integrator.hide_emitters:
            radiance = dr.select(
                alpha > 0, radiance, 0
            )  # as `path` does: what is behind nothing but null surfaces is hidden
            classes = classes and [dr.select(alpha > 0, light, 0) for light in classes]
        return splat_samples(
            sensor.film(),
            position,
            radiance,
            alpha,
            spectral["matrix"],
            there,
            1 if beyond is None else dr.rcp(beyond),
            classes or (),
        ), {"vertices": count, "beams": vertices.get("beam_count")}

    # ------------------------------------------------------------------ iterations

    def _photons(self, iteration, spectral, purpose=LIGHT):
        """An iteration's photons. Where they overflow the buffers, these grow and the pass runs
        again; after a first pass that needs less than half of them, they shrink to what was needed,
        with some room."""
        while True:
            photons = self._light_pass(
                self.scene,
                self.sensor,
                self._tables,
                self._sequence(iteration, purpose, self.light_path_count),
                spectral,
            )
            dr.eval(photons)
            found = int(photons[2][0])
            in_media = int(photons[-1][2][0]) if self.traits.has_media else 0
            self._left_by_a_path = found / self.light_path_count, in_media / self.light_path_count
            if in_media > self.volume_capacity:
                self.volume_capacity = self._photon_room(self._left_by_a_path[1])
                self._freeze()
                continue
            room = self._photon_room(self._left_by_a_path[0])
            spare = self.photon_capacity - 2 * room
            if found <= self.photon_capacity and (self._sized or spare < SPARE_PHOTONS):
                return photons
            self._sized = True
            self.photon_capacity = room
            self._freeze()

    def _render(self, iteration):
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
                wanted, beams = self._wanted(wanted)
                if not radii or (wanted <= self.vertex_capacity and beams <= self.beam_capacity):
                    return (block,)
                if wanted > self.vertex_capacity:
                    self.vertex_capacity = with_reserve(wanted)
                if beams > self.beam_capacity:
                    self.beam_capacity = with_reserve(beams)
                self._freeze()

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

    def _wanted(self, counts):
        """How many vertices and beams a camera pass would have kept."""
        vertices = 0 if self.one_vertex else int(dr.max(counts["vertices"])[0])
        return vertices, 0 if counts["beams"] is None else int(counts["beams"][0])
