"""Plugin `bdpm`: bidirectional ray tracing with photon maps, one strategy."""

from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi

from ..core.film import splat_samples
from ..core.packing import rounded_up
from ..core.recording import recorder
from ..core.traits import SceneTraits, lookup
from ..core.untrusted import Fields
from ..lights.lights import Lights
from ..paths.camera import film_sample_count
from ..paths.setting import World
from ..photons.coverage import covered_share
from ..photons.gather import QueryVertices, gather_photons
from ..photons.grid import PhotonMap, build_photon_map, smallest_cell
from ..photons.queries import Queries, read_queries, trace_camera_paths
from ..photons.trace import trace_light_paths
from ..pilot.run import choose_radii
from .common import MOST_LIGHT_PATHS, IterativeIntegrator, IterativeSession
from .schedule import LARGEST_RADIUS, SMALLEST_RADIUS, read_radius, shrunk

SPARE_PHOTONS = 1 << 20
"""Unused room beyond half of a photon buffer that is worth the time to record the passes anew."""
CAMERA_CHUNK = 1 << 21
"""Camera paths traced at once at most; larger films are traced in parts (bounds memory)."""


class BDPM(IterativeIntegrator):
    r"""
    .. _integrator-bdpm:

    Bidirectional ray tracing with photon maps (:monosp:`bdpm`)
    -----------------------------------------------------------

    .. pluginparameters::

     * - bdd
       - |int|
       - Backward diffuse depth: the camera vertex at which photons are gathered, counted over
         vertices that scatter smoothly, from
         0. Direct light is estimated at every vertex up to it. (Default: 1)
     * - photon_count
       - |int|
       - Light sub-paths an iteration; 0 stands for as many as the cropped film has pixels.
         (Default: 0)
     * - initial_radius
       - |float|
       - Merge radius of the first iteration, in scene units; 0 balances noise against blur in a
         short pilot, apart for caustic and for other photons, and corrects the estimate near edges
         where that pays. (Default: 0)
     * - alpha
       - |float|
       - Radius reduction of progressive photon mapping, in (0, 1]: iteration i uses R_i^2 = R_0^2
         (i + 1)^(alpha - 1). 1 keeps the radius. (Default: 1)
     * - camera_paths
       - |int|
       - Camera paths per pixel and iteration. 0 stands for one; in a render of a given time whose
         radius is automatic, for as many of 1, 2, 4 and 8 as make the least error. (Default: 0)
     * - variance
       - |bool|
       - Adds the channels ``var.R``, ``var.G``, ``var.B`` (mono: ``var.Y``): the estimated variance
         of the pixel mean over the iterations, of which there must be two at least. (Default: no,
         i.e. |false|)
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

    Each iteration traces light sub-paths, stores them as photons in a grid, traces camera paths,
    and estimates the light that photons bring to the camera paths' vertices from their density.
    Direct light comes from next-event estimation combined with BSDF sampling; photons carry all
    light of two or more segments, and caustics, which next-event estimation cannot make. The number
    of iterations is the number of samples per pixel over ``camera_paths``.

    The estimate is consistent: its bias vanishes with the radius. Participating media, polarised
    variants, gradients and the film ``specfilm`` are refused by name.

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

    CAMERA_PATHS = 0, 0, "at least 0 (0: automatic)"

    survey = None
    """Traits and lights of the scene, where another session knows them already."""

    def read_parameters(self, parameters):
        self.read_photon_parameters(parameters)
        self.bdd = parameters.integer("bdd", 1, 0, "at least 0")

    def read_photon_parameters(self, parameters):
        """Reads what concerns the photon map."""
        self.photon_count = parameters.integer(
            "photon_count", 0, 0, "at least 0 (0: as many as pixels)", high=MOST_LIGHT_PATHS
        )
        self.initial_radius, self.alpha = read_radius(parameters)

    def settings(self):
        return {
            **super().settings(),
            "photon_count": self.photon_count,
            "initial_radius": self.initial_radius,
            "alpha": self.alpha,
            "bdd": self.bdd,
        }

    def new_session(self, scene, sensor, seed, iterations):
        return BDPMSession(self, scene, sensor, seed, iterations)


class BDPMSession(IterativeSession):
    """Iterations of `bdpm`: light pass, photon maps, camera pass, gather."""

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.traits, self.lights = integrator.survey or (
            SceneTraits(scene),
            Lights.seen_by(scene, sensor, integrator.plugin),
        )
        self.world = World(scene, self.lights, self.traits)
        self.split_paths(CAMERA_CHUNK)
        self.light_path_count = integrator.photon_count or min(
            film_sample_count(sensor), MOST_LIGHT_PATHS
        )
        depth = integrator.max_depth
        unreachable = self.lights.needs_photons_for_direct_light()
        self.has_caustics = not self.lights.dark and (
            (unreachable and (depth < 0 or depth >= 2))
            or (self.traits.has_delta and (depth < 0 or depth >= 3))
        )
        self.has_indirect = not self.lights.dark and (depth < 0 or depth >= integrator.bdd + 3)
        self.one_vertex = not self.traits.has_mixed and (
            integrator.bdd == 0 or not self.has_caustics
        )
        self.photon_capacity = rounded_up(3 * self.light_path_count)
        self.vertex_capacity = self._vertex_room(self.chunk)
        self.radii = (
            dict.fromkeys(self.kinds(), integrator.initial_radius)
            if integrator.initial_radius
            else None
        )
        self.corrected = dict.fromkeys(self.kinds(), False)
        self.seconds = self.begun = None  # what rendering may take, and when it began
        self.forecast = self.judged_by = (
            # what the pilot expects, and the image (of its pixels) that errors are relative to
            None
        )
        self.rehearsed = {}  # iterations that the pilot has rendered already, by number
        self.photons_found = 0  # by the last light pass
        self._sized = False
        self.recorded = recorder()
        self._freeze()

    def plan_time(self, seconds):
        """Rendering will last `seconds`: the automatic radius is chosen for as many iterations as
        fit."""
        self.seconds = seconds

    @property
    def settings(self):
        radii = {f"radius.{kind}": radius for kind, radius in (self.radii or {}).items()}
        corrected = {f"edge_correction.{kind}": flag for kind, flag in self.corrected.items()}
        return {**super().settings, "photon_count": self.light_path_count, **radii, **corrected}

    @property
    def last_vertex(self):
        """The smooth camera vertex, counted from 0, beyond which no camera path is shaded."""
        return self.integrator.bdd

    def kinds(self):
        """Photon maps that the scene needs."""
        return [
            kind
            for kind, needed in (("caustic", self.has_caustics), ("indirect", self.has_indirect))
            if needed
        ]

    def send(self, camera_paths):
        """Sends so many camera paths through each pixel from the next iteration on."""
        self.resize(camera_paths)
        self.rehearsed.clear()
        self.split_paths(CAMERA_CHUNK)
        self.vertex_capacity = self._vertex_room(self.chunk)
        self._camera_pass = self.recorded(self._render_chunk)

    def radii_at(self, iteration):
        """Merge radius of each kind of photon."""
        return {
            kind: dr.opaque(mi.Float, shrunk(radius, self.integrator.alpha, iteration))
            for kind, radius in self.radii.items()
        }

    def _vertex_room(self, paths):
        if not self.kinds():
            return 0
        return paths if self.one_vertex else 2 * paths

    # ------------------------------------------------------------------ passes

    def _freeze(self):
        """Records the passes anew; from the second iteration on, their kernels run without their
        Python."""
        self._tables = [self.traits.lambertian, self.traits.perturbed, *self.lights.tables()]
        self._light_pass = self.recorded(self._trace_light)
        self._map_pass = self.recorded(self._build_maps)
        self._camera_pass = self.recorded(self._render_chunk)

    def _trace_light(self, scene, sensor, tables, seed, spectral):
        return trace_light_paths(
            self.world,
            self.limits,
            self.describe_light_pass(sensor, seed, self.light_path_count, spectral),
            self.photon_capacity,
            light_state=self._light_state(spectral),
        )

    def _light_state(self, spectral):
        """What photons carry for the weights; None where there are none."""
        return None

    def _merge_state(self, spectral):
        """The weights of camera paths (a `mis.state.MergeState`); None where there are none."""
        return None

    def _trace_camera(self, camera_pass, capacity, spectral):
        """Traces the paths of a `CameraPass`, with room for so many vertices."""
        queries = Queries(
            self.last_vertex, capacity, self.has_caustics, self.has_indirect, self.one_vertex
        )
        return trace_camera_paths(
            self.world, self.limits, camera_pass, queries, self._merge_state(spectral)
        )

    def _gather(self, photon_map, vertices, kind, radii, spectral, grey=False):
        """What photons of one kind bring to each vertex, for each radius."""
        return self._merge(photon_map, read_queries(vertices), kind, radii, spectral, grey)

    def _merge(self, photon_map, record, kind, radii, spectral, grey=False, weigh=None, scale=1):
        """`gather_photons` of one kind at vertices as of `read_queries`."""
        vertices = QueryVertices(
            self.traits, record, spectral["wavelengths"], kind == "indirect", scale
        )
        return gather_photons(
            photon_map,
            vertices,
            radii,
            self.light_path_count,
            self.integrator.max_depth,
            weigh,
            grey,
        )

    def _covered(self, scene, tables, vertices, radius, seed):
        """Share of each vertex' merge disk that holds surface; one where the surface is not
        Lambertian: in a highlight the noise of dividing by an estimate would outweigh what it
        mends."""
        vertices = read_queries(vertices)
        probed = dr.max(vertices["throughput"]) > 0
        if self.traits.has_rough:
            bsdf = vertices["hit"].shape.bsdf()
            probed &= lookup(self.traits.lambertian, bsdf, mi.Bool, probed)
        return dr.select(probed, covered_share(scene, vertices, radius, seed, probed), 1)

    def _per_path(self, values, vertices, paths):
        """Sums values of the vertices for each of `paths` camera paths."""
        if self.one_vertex:
            return values
        vertices, total = read_queries(vertices), dr.zeros(type(values), paths)
        dr.scatter_reduce(
            dr.ReduceOp.Add,
            total,
            values,
            vertices["path"],
            dr.max(vertices["throughput"]) > 0,
            dr.ReduceMode.Direct,
        )
        return total

    def _map(self, photons, kind, radius):
        mis_words = photons[3] if kind == "indirect" and len(photons) > 3 else None
        return build_photon_map(
            *photons[:3],
            self.traits.bounds,
            self._cell(radius),
            self.photon_capacity,
            kind,
            mis_words,
        )

    def _cell(self, radius):
        return dr.maximum(radius, smallest_cell(self.traits.bounds, self.photon_capacity))

    def _build_maps(self, photons, radii):
        return {kind: self._map(photons, kind, radius).arrays() for kind, radius in radii.items()}

    def _render_chunk(self, scene, sensor, tables, maps, seed, first, spectral, radii):
        radiance, alpha, position, vertices, count = self._trace_camera(
            self.describe_camera_pass(sensor, seed, first, spectral),
            self.vertex_capacity,
            spectral,
        )
        if radii:
            dr.eval(radiance, alpha, position, vertices, count)
        for kind, radius in radii.items():
            photon_map = PhotonMap.with_grid(
                maps[kind], self.traits.bounds, self._cell(radius), self.photon_capacity
            )
            (gathered,) = self._gather(photon_map, vertices, kind, [radius], spectral)
            if self.corrected[kind]:
                gathered *= dr.rcp(self._covered(scene, tables, vertices, radius, seed))
            radiance += self._per_path(gathered, vertices, self.chunk)
        if self.integrator.hide_emitters:
            radiance = dr.select(
                alpha > 0, radiance, 0
            )  # as `path` does: what is behind nothing but null surfaces is hidden
        return splat_samples(
            sensor.film(), position, radiance, alpha, spectral["matrix"], self.in_chunk(first)
        ), count

    # ------------------------------------------------------------------ iterations

    def _photons(self, iteration, spectral):
        """An iteration's photons. Where they overflow the buffers, these grow and the pass runs
        again; after a first pass that needs less than half of them, they shrink to what was needed,
        with some room."""
        while True:
            photons = self._light_pass(
                self.scene, self.sensor, self._tables, self._seed(iteration, LIGHT), spectral
            )
            dr.eval(photons)
            found = self.photons_found = int(photons[2][0])
            room = rounded_up(found + found // 8 + 1024)
            spare = self.photon_capacity - 2 * room
            if found <= self.photon_capacity and (self._sized or spare < SPARE_PHOTONS):
                return photons
            self._sized = True
            self.photon_capacity = room
            self._freeze()

    def start(self):
        self.begun = self.begun or time.perf_counter()
        self.set_up()

    def set_up(self):
        """What `start` does when it has looked at the clock: chooses the radii, unless they are
        known."""
        if self.radii is None:
            self.forecast = choose_radii(self)

    @property
    def learned(self):
        if self.radii is None:
            return {}
        return {
            "radii": {kind: float(radius) for kind, radius in self.radii.items()},
            "corrected": {kind: bool(flag) for kind, flag in self.corrected.items()},
            "camera_paths": self.camera_paths,
        }

    def recall(self, learned):
        if learned == {} and (self.radii is not None or not self.kinds()):
            return
        fields = Fields(learned, "learned")
        radii, corrected = fields.object("radii"), fields.object("corrected")
        self.radii = {
            kind: radii.number(kind, LARGEST_RADIUS, SMALLEST_RADIUS) for kind in self.kinds()
        }
        self.corrected = {kind: corrected.boolean(kind) for kind in self.kinds()}
        self.send(fields.integer("camera_paths", 1, self.most_camera_paths()))
        for each in (radii, corrected, fields):
            each.finish()

    def _iteration(self, iteration):
        self.start()
        if iteration in self.rehearsed:
            return self.rehearsed.pop(iteration)
        radii = self.radii_at(iteration)
        spectral = self._spectral(iteration)
        photons = (
            self._photons(iteration, spectral) if radii else None
        )  # before any pass is looked up: they may have to be recorded anew
        maps = self._map_pass(photons, radii) if radii else None

        def render(chunk, first):
            while True:
                block, count = self._camera_pass(
                    self.scene,
                    self.sensor,
                    self._tables,
                    maps,
                    self._seed(iteration, CAMERA),
                    first,
                    spectral,
                    radii,
                )
                wanted = 0 if self.one_vertex else int(dr.max(count)[0])
                if wanted <= self.vertex_capacity or not radii:
                    return (block,)
                self.vertex_capacity = rounded_up(wanted + wanted // 8)
                self._freeze()

        (block,) = self.sum_of_chunks(render)
        return block


LIGHT, CAMERA = range(2)
"""Purposes of an iteration's random seeds, besides `IterativeSession.WAVELENGTH`."""
