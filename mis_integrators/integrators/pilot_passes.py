"""What a pilot needs of a photon mapper: its passes on a subset of the pixels, gathered at several
radii."""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import with_reserve
from ..core.recording import lanes
from ..core.spectra import channel_mean
from ..paths.camera import film_sample_count, pixel_at
from ..paths.setting import CameraPass
from ..photons.disk_walls import DiskWalls
from ..photons.queries import read_queries
from ..pilot.radius import middle_index


class SubsetPasses:
    """The passes of a `BDPMSession` on the pixels of its pilot (`pilot.run.PilotPasses`).
    `purpose`: that of the random seeds of camera paths."""

    def __init__(self, session, setting, pixels, purpose):
        self.session, self.setting, self.pixels, self.purpose = session, setting, pixels, purpose
        self.density = session.volume_density()
        room = session._vertex_room(pixels.paths) * (1 if session.one_vertex else 4)
        self._record_camera(room, 4 * session._beam_room(pixels.paths))
        self._record_gather()
        self._coverage = session.recorded(session._coverage)
        self._join = session.recorded(self._joined_light)

    def _record_camera(self, capacity, beams):
        session, pixels = self.session, self.pixels
        self.capacity, self.beam_capacity = capacity, beams

        def trace(scene, sensor, tables, sequence, spectral):
            pixel, index = pixels.places(lanes(pixels.paths))
            pixel += index * pixels.groups // pixels.camera_paths * pixels.apart
            wavelength = spectral["sample"]
            camera_pass = CameraPass(sensor, session.integrator, sequence, pixel, index, wavelength)
            *found, _ = session._trace_camera(camera_pass, capacity, spectral, 0.0, beams=beams)
            return found

        self._camera = session.recorded(trace)

    def seen(self):
        """As of `pilot.run.PilotPasses`: what the paths for direct light see."""
        pixels = self.pixels
        return self.session.direct_light.measured().mean[np.arange(pixels.count) * pixels.stride]

    def _record_gather(self):
        session = self.session
        self.photon_capacity = session.photon_capacity, session.volume_capacity

        def gather(scene, tables, photons, density, vertices, radii, walls, spectral):
            gathered, moment = {}, None
            for kind, ladder in radii.items():
                photon_map = session._map(photons, kind, ladder[-1], density)
                if kind in walls:
                    gathered[kind] = session._gather_indirect(
                        scene, photon_map, vertices, walls[kind], ladder, spectral, grey=True
                    )
                else:
                    gathered[kind] = session._gather(
                        photon_map, vertices, kind, ladder, spectral, grey=True
                    )
                if kind == "caustic" and session.judges_chance:
                    radius = ladder[middle_index(ladder)]
                    moment = session.moment_of_chance(photon_map, vertices, radius, spectral)
            return gathered, moment

        self._gather = session.recorded(gather)

    def _joined_light(self, scene, sensor, tables, in_media, seed, spectral):
        """Light of volume photons joined with the sensor, mean over the channels, one a pixel."""
        light = self.session._join_sensor(sensor, in_media, seed, spectral)
        total = dr.zeros(mi.Float, film_sample_count(sensor))
        dr.scatter_reduce(
            dr.ReduceOp.Add,
            total,
            channel_mean(light.value * spectral["sensor_weight"]),
            pixel_at(sensor, light.film),
            light.active,
        )
        return total

    def trace(self, number):
        session = self.session
        spectral = session._spectral(number)
        photons = session._photons(number, spectral)
        if self.photon_capacity != (session.photon_capacity, session.volume_capacity):
            self._record_gather()
        sequence = session._sequence(number, self.purpose, self.pixels.camera_paths)
        radiance, vertices = self._trace_camera(sequence, spectral)
        seed = sequence.own_seed()
        return SubsetIteration(self, number, photons, vertices, radiance, seed, spectral)

    def _trace_camera(self, sequence, spectral):
        """Radiance and vertices of the camera paths. Where the vertices overflow their buffer, it
        grows and the pass runs again."""
        session = self.session
        while True:
            radiance, _, _, vertices, count = self._camera(
                session.scene, session.sensor, session._tables, sequence, spectral
            )
            counts = {"vertices": count, "beams": vertices.get("beam_count")}
            found, beams = session._wanted(counts)
            session.expect(found, beams, self.pixels.paths)
            if found <= self.capacity and beams <= self.beam_capacity:
                return radiance, vertices
            found, beams = with_reserve(found), with_reserve(beams)
            self._record_camera(max(self.capacity, found), max(self.beam_capacity, beams))

    def gather(self, photons, vertices, radii, seed, spectral):
        """As of `pilot.run.PilotIteration`."""
        session, estimates = self.session, {}
        radii = {
            kind: [dr.opaque(mi.Float, float(radius)) for radius in ladder]
            for kind, ladder in radii.items()
        }
        walls, shares = {}, {}
        for kind, ladder in radii.items():
            if self.setting.corrects(kind):
                found = [
                    self._coverage(session.scene, session._tables, vertices, radius, seed)
                    for radius in ladder
                ]
                shares[kind] = [share for share, _ in found]
                walls[kind] = [DiskWalls(**around) for _, around in found]
        gathered, moment = self._gather(
            session.scene, session._tables, photons, self.density, vertices, radii, walls, spectral
        )
        if moment is not None:
            moment = self.by_pixel(
                session._per_path(moment, vertices, "caustic", self.pixels.paths)
            )
        for kind, values in gathered.items():
            if kind in shares:
                values = [value * dr.rcp(share) for value, share in zip(values, shares[kind])]
            estimates[kind] = np.array(
                [
                    self.by_pixel(session._per_path(value, vertices, kind, self.pixels.paths))
                    for value in values
                ]
            )
        return estimates, moment

    def mean_photon_count(self, photons, vertices, kind, radius, spectral):
        """As of `BDPMSession.mean_count`; `spectral`: that of the vertices' paths."""
        radius = dr.opaque(mi.Float, radius)
        photon_map = self.session._map(photons, kind, radius, self.density)
        paths = self.pixels.paths
        return self.session.mean_count(photon_map, vertices, kind, radius, paths, spectral)

    def joined(self, number, photons, spectral):
        """Light of the photons that are joined with the sensor: (groups, pixels)."""
        session, pixels = self.session, self.pixels
        seed = session.sensor_seed(number)
        light = self._join(
            session.scene, session.sensor, session._tables, photons[-1], seed, spectral
        )
        first = np.arange(pixels.count) * pixels.stride
        group = np.arange(pixels.groups)[:, None]
        return np.array(light)[first + group * pixels.apart]

    def by_pixel(self, values):
        """Means (groups, pixels) of values of the camera paths; those that are not finite count as
        none."""
        pixels = self.pixels
        values = np.broadcast_to(np.array(values), pixels.paths)
        values = np.where(np.isfinite(values), values, 0)
        return values.reshape(pixels.groups, -1, pixels.count).mean(axis=1)


class SubsetIteration(NamedTuple):
    """Photons and camera paths of one iteration of `SubsetPasses` (`pilot.run.PilotIteration`)."""

    passes: SubsetPasses
    number: int
    photons: tuple
    vertices: dict
    radiance: mi.Spectrum
    seed: mi.UInt32
    spectral: dict

    def points(self):
        vertices = read_queries(self.vertices)
        points = vertices["ray_o"] + vertices["ray_d"] * vertices["hit"].t
        return np.array(points), np.array(dr.max(vertices["throughput"]))

    def pixel_widths(self):
        widths = np.array(self.vertices["pixel"])
        return widths[widths > 0]

    def mean_photon_count(self, kind, radius):
        return self.passes.mean_photon_count(
            self.photons, self.vertices, kind, radius, self.spectral
        )

    def gather(self, radii):
        return self.passes.gather(self.photons, self.vertices, radii, self.seed, self.spectral)

    def joined(self):
        return self.passes.joined(self.number, self.photons, self.spectral)

    def direct(self):
        return self.passes.by_pixel(channel_mean(self.radiance))
