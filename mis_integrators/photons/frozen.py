"""The photons of a light pass that is kept for what it tells of where light is: on surfaces or in
media, alike to what reads them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ..paths.media import scattered_share
from .gather import SAME_SURFACE_COSINE
from .grid import build_photon_map, for_each_photon, visit_hits
from .kernel_sums import ball_volume
from .photon import read_landing, read_power, surface_layout
from .points import BallQuery
from .volume import build_volume_map, place_layout, read_place


@dataclass
class FrozenPhoton:
    """Photons, one a lane: position, normal (zero in media), `flux` (in media over the extinction),
    unit vector `towards` where they came from, `depth` in segments; those that have scattered
    smoothly nowhere (`straight`), and of these the ones that next-event estimation does not find
    (`caustic`)."""

    p: mi.Point3f
    normal: mi.Vector3f
    flux: mi.Spectrum
    towards: mi.Vector3f
    depth: mi.UInt32
    straight: mi.Bool
    caustic: mi.Bool
    stored: mi.Bool


class FrozenPhotons(Protocol):
    """Photons of a light pass."""

    dimensions: int
    """Of what they lie on: two of surfaces, three of media."""
    count: int
    """How many there are."""

    def all(self) -> FrozenPhoton:
        """Each in its place; those that are `stored` count."""

    def measure(self, radius):
        """Area or volume within the radius of a point."""

    def around(self, center, facing, radius, visit, totals):
        """Calls `visit(photon, hit, totals) -> totals` for those within the radius of points
        `center` on surfaces with normals `facing`; a photon counts where `hit`."""


class SurfacePhotons:
    """Those that `trace_light_paths` with `keep_direct` leaves on surfaces, within `bounds`."""

    dimensions = 2

    def __init__(self, surface, power, count, bounds):
        self.surface, self.power, self.bounds = surface, power, bounds
        self.width, self.count = count, int(count[0])

    def all(self):
        index = dr.arange(mi.UInt32, surface_layout().capacity(self.surface))
        stored = index < self.width
        return self._photon(self.power, index, read_landing(self.surface, index, stored), stored)

    @staticmethod
    def _photon(power, index, landing, active):
        flux, towards = read_power(power, index, active)
        normal = mi.Normal3f(dr.normalize(dr.mulsign(landing.n, dr.dot(landing.n, towards))))
        straight = landing.caustic
        caustic = straight & (landing.depth > 1)
        towards = dr.normalize(towards)
        return FrozenPhoton(
            landing.p, normal, flux, towards, landing.depth, straight, caustic, active
        )

    @staticmethod
    def measure(radius):
        return dr.pi * dr.square(radius)

    def around(self, center, facing, radius, visit, totals):
        capacity = surface_layout().capacity(self.surface)
        photon_map = build_photon_map(
            self.surface, self.power, self.width, self.bounds, radius, capacity, "all"
        )

        def visit_landing(index, landing, offset, distance_squared, hit, totals):
            photon = self._photon(photon_map.power, index, landing, hit)
            hit &= dr.dot(photon.towards, facing) > 0
            hit &= dr.dot(photon.normal, facing) > SAME_SURFACE_COSINE  # both on the lit side
            return visit(photon, hit, totals)

        return for_each_photon(photon_map, center, radius, mi.Bool(True), visit_landing, totals)


class VolumePhotons:
    """Those that it leaves in media, under some wavelengths."""

    dimensions = 3

    def __init__(self, place, power, count, wavelengths):
        self.place, self.power, self.wavelengths = place, power, wavelengths
        self.width, self.count = count, int(count[0])

    def all(self):
        index = dr.arange(mi.UInt32, place_layout().capacity(self.place))
        stored = index < self.width
        return self._photon(self.power, index, read_place(self.place, index, stored), stored)

    def _photon(self, power, index, landing, active):
        flux, towards = read_power(power, index, active)
        number = dr.select(active, landing.medium, 0)
        medium = dr.reinterpret_array(mi.MediumPtr, number)
        _, _, extinction = scattered_share(medium, landing.p, self.wavelengths, active)
        flux = dr.select(extinction > 0, flux * dr.rcp(dr.maximum(extinction, 1e-30)), 0)
        straight = landing.caustic | (landing.depth == 1)
        return FrozenPhoton(
            landing.p,
            mi.Normal3f(0),
            flux,
            dr.normalize(towards),
            landing.depth,
            straight,
            landing.caustic,
            active,
        )

    @staticmethod
    def measure(radius):
        return ball_volume(radius)

    def around(self, center, facing, radius, visit, totals):
        capacity = place_layout().capacity(self.place)
        photon_map = build_volume_map(self.place, self.power, self.width, radius, capacity)

        def visit_landing(index, landing, offset, distance_squared, hit, totals):
            return visit(self._photon(photon_map.power, index, landing, hit), hit, totals)

        query = BallQuery(photon_map, center, radius, mi.Bool(True))
        return visit_hits(query, visit_landing, totals)
