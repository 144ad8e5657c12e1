"""What an iteration of photon maps computes, pass by pass: photons, their maps, camera paths, what
these gather, and light that volume photons bring to the sensor."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.film import splat_light, splat_samples
from ..core.packing import with_reserve
from ..mis.chance import ChanceWeights, StartDensity, second_moment
from ..paths.bent_surfaces import FLAGS
from ..paths.light_classes import LightClasses, by_class_of_photons
from ..paths.sensor import Lens
from ..photons.beams import Beams, gather_along, mean_count_along, read_beams
from ..photons.coverage import Edges, coverage
from ..photons.curvature import bounded
from ..photons.disk_walls import read_coverage
from ..photons.gather import (
    QueryVertices,
    gather_photons,
    gather_seen,
    mean_photon_count,
)
from ..photons.grid import PhotonMap, build_photon_map
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
from .piloted import PilotedSession
from .purposes import LIGHT, SENSOR

SPARE_PHOTONS = 1 << 20
"""Unused room beyond half of a photon buffer that is worth the time to record the passes anew."""


class PhotonPasses(PilotedSession):
    """The passes of a `BDPMSession`, which says what the scene needs, and the room that they have
    for photons, vertices and beams. Passes are recorded with the room that they have, and anew
    where that grows."""

    judges_chance = False
    """Whether the pilot asks photons how noisy camera paths are that meet their light by chance
    (`moment_of_chance`)."""
    follows_curvature = True
    """Whether merge disks of indirect light are smaller where surfaces are bent, if their radius is
    automatic. (Weights know one radius for all.)"""
    leaves_out_hidden = True
    """Whether estimates that are corrected at edges leave out photons that `DiskWalls` hide.
    (Weights gather all.)"""
    passes_edges = False
    """Whether camera paths go on where merge disks are of no use (`Edges`)."""
    points = False
    """Whether volume photons are gathered at vertices in media, and not along beams."""

    def judge_chance(self):
        """Before a pilot: asks it for the noise of camera paths that meet caustics by chance."""
        self.judges_chance = self.by_chance

    # ------------------------------------------------------------------ room

    def _make_room_for_photons(self):
        """By the last light pass; before the first one, for three photons a path."""
        self._sized = self.photons_a_path > 0
        on_surfaces, in_media = self._left_by_a_path if self._sized else (3.0, 3.0)
        self.photon_capacity = self._photon_room(on_surfaces)
        self.volume_capacity = self._photon_room(in_media) if self.traits.has_media else 0

    def _use_light_paths(self, count):
        """Traces so many in each light pass from now on."""
        if count != self.light_path_count:
            self.light_path_count = count
            self._make_room_for_photons()
            self._freeze()

    def _photon_room(self, a_path):
        """Room for so many photons `a_path`, with an eighth and some more."""
        return with_reserve(math.ceil(a_path * self.light_path_count) + 1024)

    @property
    def photons_a_path(self):
        """Those that a light sub-path left, in the last light pass."""
        return sum(self._left_by_a_path)

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

    def _wanted(self, counts):
        """How many vertices and beams a camera pass would have kept."""
        vertices = 0 if self.one_vertex else int(dr.max(counts["vertices"])[0])
        return vertices, 0 if counts["beams"] is None else int(counts["beams"][0])

    def _had_room(self, counts):
        """Whether a camera pass had room for all its vertices and beams; else there is from now
        on."""
        vertices, beams = self._wanted(counts)
        if vertices <= self.vertex_capacity and beams <= self.beam_capacity:
            return True
        if vertices > self.vertex_capacity:
            self.vertex_capacity = with_reserve(vertices)
        if beams > self.beam_capacity:
            self.beam_capacity = with_reserve(beams)
        self._freeze()
        return False

    # ------------------------------------------------------------------ passes

    def _freeze(self):
        """Records the passes anew; from the second iteration on, their kernels run without their
        Python."""
        self._list_tables()
        self._light_pass = self.recorded(self._trace_light)
        self._map_pass = self.recorded(self._build_maps)
        self._sensor_pass = self.recorded(self._splat_photons)
        self._camera_pass = self.recorded(self._render_chunk)

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
            self._tables += self.narrow.tables()
        if self.lobe_widths is not None:
            self._tables.append(self.lobe_widths.table)
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
        self, camera_pass, capacity, spectral, first=1.0, beyond=None, beams=0, edge_radius=None
    ):
        """What `trace_camera_paths` returns, and the radiance by class (a list; empty where none is
        kept), with room for so many vertices and beams; `first`, `beyond`: as there;
        `edge_radius`: that of `Edges` (None: zero). All is evaluated, and what differs between
        pilots and renders is evaluated before: they share the kernel, which takes long to
        compile."""
        paths, kept, classes = dr.width(camera_pass.pixel), self.integrator.kept_classes, None
        first = dr.opaque(mi.Float, first)
        beyond = dr.full(mi.Float, 1, paths) if beyond is None else beyond
        dr.make_opaque(camera_pass.pixel, camera_pass.index, beyond)
        if kept:
            classes = LightClasses(paths, None, ("met", "next_event"))
        queries = Queries(
            bdd=self.last_vertex,
            capacity=capacity,
            has_caustics=self.has_caustics,
            has_indirect=self.has_indirect,
            one_vertex=self.one_vertex,
            beams=0 if self.points else beams,
            narrow=self.narrow,
            points=self.points,
            cones=self.cones,
            near_zone=self.near_zone,
            meets_lights=self.by_chance,
        )
        if self.passes_edges:
            radius = dr.opaque(mi.Float, 0.0) if edge_radius is None else edge_radius
            queries = replace(queries, edges=Edges(radius, camera_pass.sequence.own_seed()))
        merge_state = self._merge_state(spectral)
        found = trace_camera_paths(
            self.world, self.limits, camera_pass, queries, merge_state, first, beyond, classes
        )
        dr.eval(found, classes and classes.entries)
        return *found, classes.radiance()[:kept] if classes else []

    def _join_sensor(self, sensor, in_media, seed, spectral):
        """The `SensorLight` of an iteration's volume photons: its values are radiance."""
        light = join_photons(
            self.world,
            self.limits,
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
                Beams.read(vertices["beams"], spectral["wavelengths"], self.traits),
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
        vertices, radii = self._asking(record, kind, radii, spectral, scale)
        light_paths, max_depth = self._light_paths, self.integrator.max_depth
        marked, chance = self.integrator.splits_light, None
        if self.by_chance and kind != "indirect":
            chance = ChanceWeights(self.lights, light_paths, vertices, record["hits"])
        if isinstance(photon_map, TieredMap):
            first, weigher = radii[0], chance and chance.weigher
            found = gather_tiers(
                photon_map, vertices, first, light_paths, max_depth, weigher, marked
            )
            if chance is not None:
                flux, left = chance.hits["flux"], self._tiers_left
                width = vertices.lobe_width
                active = vertices.active & (flux > 0)
                radii = [photon_map.radii_of(vertices.p, flux, first, width, left, active)]
        else:
            if chance is not None:
                weigh = chance.weigher(photon_map, radii)
            found = gather_photons(
                photon_map, vertices, radii, light_paths, max_depth, weigh, grey, marked
            )
        return found if chance is None else chance.with_hits(found, radii, grey)

    def _gather_indirect(self, scene, photon_map, vertices, walls, radii, spectral, grey=False):
        """`_gather` of indirect photons; those that the `DiskWalls` of each radius hide are left
        out, if `leaves_out_hidden`."""
        if not self.leaves_out_hidden:
            return self._gather(photon_map, vertices, "indirect", radii, spectral, grey)
        asking, radii = self._asking(read_queries(vertices), "indirect", radii, spectral)
        depth, marked = self.integrator.max_depth, self.integrator.splits_light
        return gather_seen(
            scene, photon_map, asking, walls, radii, self._light_paths, depth, grey, marked
        )

    def _asking(self, record, kind, radii, spectral, scale=1):
        """The `QueryVertices` that gather photons of a kind, and the radii of their disks."""
        takes = takes_photons(record, kind)
        parted = kind == "indirect" and self.parted
        widths = None if kind == "indirect" else self.lobe_widths
        vertices = QueryVertices(
            self.traits, record, spectral["wavelengths"], takes, scale, parted, widths
        )
        if kind == "seen_caustic":
            radii = [dr.minimum(radius, pixel_disk(record)) for radius in radii]
        elif kind == "caustic":
            radii = [radius * vertices.lobe_width for radius in radii]
        elif kind == "indirect" and self._bounds_disks:
            radii = [bounded(vertices.si, radius) for radius in radii]
        return vertices, radii

    @property
    def _bounds_disks(self):
        """Whether `follows_curvature` is of use in this render."""
        return self.follows_curvature and not self.integrator.initial_radius

    def moment_of_chance(self, photon_map, vertices, radius, spectral):
        """The second moment of one camera path that goes on from a vertex and meets the light of
        caustic photons by chance, by those within `radius`."""
        record = read_queries(vertices)
        takes = takes_photons(record, "caustic")
        if self.cones is not None:  # wide disks tell it better than those of a pixel's size
            takes |= takes_photons(record, "seen_caustic")
        wavelengths, widths = spectral["wavelengths"], self.lobe_widths
        asking = QueryVertices(self.traits, record, wavelengths, takes, lobe_widths=widths)
        return gather_photons(
            photon_map,
            asking,
            [radius * asking.lobe_width],
            self._light_paths,
            self.integrator.max_depth,
            second_moment(self.lights, photon_map, asking),
            grey=True,
        )[0]

    @property
    def _tiers_left(self):
        """The last tier whose photons have the radius of the first, see `build_tiered_map`."""
        return LEFT_TO_DENOISER if self.cones is not None else 0

    def _coverage(self, scene, tables, vertices, radius, seed):
        """`coverage` of the vertices of a buffer, its share and what makes its walls (recorded:
        `tables` are what it reads; of named tuples replays would return the first one again)."""
        share, walls = self.coverage(scene, read_queries(vertices), radius, seed)
        return share, vars(walls)

    def coverage(self, scene, record, radius, seed):
        """The `Coverage` of each vertex' merge disk. `record` as of `read_queries`."""
        probed = dr.max(record["throughput"]) > 0
        ray = mi.Ray3f(record["ray_o"], record["ray_d"])
        si = record["hit"].compute_surface_interaction(ray, FLAGS, probed)
        if self._bounds_disks:
            radius = bounded(si, radius)
        return coverage(scene, record, si, radius, seed, probed)

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
            beams = Beams.read(vertices["beams"], spectral["wavelengths"], self.traits)
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
        weighted = (kind == "indirect") != self.by_chance
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
        path = self.part_of_paths(first)
        camera_pass = self.describe_camera_pass(sensor, sequence, path, spectral)
        there = path < self.path_count
        if beyond is not None:
            beyond = dr.gather(mi.Float, beyond, camera_pass.pixel, there)
        radiance, alpha, position, vertices, count, classes = self._trace_camera(
            camera_pass,
            self.vertex_capacity,
            spectral,
            1.0,
            beyond,
            self.beam_capacity,
            radii.get("indirect"),
        )
        for kind, radius in radii.items():
            photon_map = self._map_again(maps[kind], kind, radius)
            if not self.corrects(kind):
                parts = self._gather(photon_map, vertices, kind, [radius], spectral)
            else:
                if "coverage" in vertices:
                    covered = read_coverage(vertices["coverage"])
                else:
                    seed = sequence.own_seed()
                    covered = self.coverage(scene, read_queries(vertices), radius, seed)
                found = self._gather_indirect(
                    scene, photon_map, vertices, [covered.walls], [radius], spectral
                )
                parts = [gathered * dr.rcp(covered.share) for gathered in found]
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
            classes = [dr.select(alpha > 0, light, 0) for light in classes]
        return splat_samples(
            sensor.film(),
            position,
            radiance,
            alpha,
            spectral["matrix"],
            there,
            1 if beyond is None else dr.rcp(beyond),
            classes,
        ), {"vertices": count, "beams": vertices.get("beam_count")}

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

    def trace_photons(self, iteration, purpose):
        """The photons of a light pass, as those of an iteration, but for another purpose."""
        return self._photons(iteration, self._spectral(iteration), purpose)
