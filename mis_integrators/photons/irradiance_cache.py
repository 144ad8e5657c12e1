"""Irradiance on the scene's surfaces, or fluence in its media, kept in cells: a crude,
deterministic picture of where light is.

Made once from the photons of a dense light pass. Each cell of a grid keeps what lands around the
mean position of its photons; what asks for the irradiance of a point reads the point's cell and no
photons. In media it is the fluence, times the albedo there; normals are zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import (
    bits_float,
    float_bits,
    gather_words,
    rounded_up,
)
from ..core.random import streams
from ..core.spectra import channel_mean
from ..paths.media import SHADOW_SALT, transmittance
from ..paths.vertex import in_medium
from .frozen import FrozenPhotons

PHOTONS_A_CELL = 32
"""Tuned: photons of a cell, on average over those that hold any."""
GATHER_RADIUS = 2.0
"""Tuned: radius within which photons count for a cell, in units of its edge: noise of the cells
costs more than their blur does."""
TRIAL_SHARE = 1 / 64
"""Edge of the first, trial cells as a share of the scene's diagonal."""
LARGEST_SHARE = 0.2
"""Tuned: largest edge of the cells, in the same unit."""
INDEX_BITS = 23
MOST_LIGHTS = 64
"""Tuned: emitters tried as the strongest of a cell."""
MOST_EMITTERS = 127 << 7
"""Numbers of emitters that `_pack_light` has room for."""
DIRECT_SAMPLES = 32
"""Tuned: samples of next-event estimation at a cell, by which its noise is estimated."""
UNSEEN_NOISE = 200.0
"""Tuned: relative variance of next-event estimation that is assumed where none of the samples meets
light."""
OWN_STREAM = 0x64697265


@dataclass
class Irradiance:
    """What a cell knows."""

    direct: mi.Spectrum
    """Irradiance by direct light and caustics."""
    second: mi.Spectrum
    """By light scattered once."""
    later: mi.Spectrum
    """By light scattered more often."""
    direction: mi.Vector3f
    """Mean direction from which the direct part comes."""
    light: mi.UInt32
    """Number of the emitter that brings most of the direct part."""
    visible_share: mi.Float
    """How much of that emitter's unoccluded light the direct part is; 0: none is known."""
    noise: mi.Float
    """Relative variance of next-event estimation with one sample."""
    caustic_share: mi.Float
    """Share of caustics in the direct part."""

    def replaced(self, other, mask):
        """The same, and on the lanes `mask` what the `other` cell knows."""
        pairs = ((getattr(other, name), value) for name, value in vars(self).items())
        return Irradiance(*(dr.select(mask, theirs, own) for theirs, own in pairs))


def colours():
    """Channels that are kept apart: those of rgb; in spectral variants, whose wavelengths change,
    the mean stands for all."""
    return 1 if mi.is_spectral else dr.size_v(mi.Spectrum)


class IrradianceCache:
    """Irradiance by cell.

    Attributes: `cell` (edge of the cells, width one), `photon_flux` (flux of a typical photon that
    is merged, for one light sub-path, a list of one number a channel; `caustic_flux` that of
    caustic ones, `typical_flux` its mean over channels), `mean` (irradiance of a typical lit point;
    `level` is the same as an array of width one: numbers would be literals of kernels, compiled
    anew for each scene and seed), `center` and `facing` (mean position and normal of the photons of
    each cell, from cell number 1 on).
    """

    def __init__(
        self,
        scene,
        lights,
        photons: FrozenPhotons,
        light_path_count,
        traits,
        wavelengths,
    ):
        """`photons`: those of a light pass, direct light's included; `light_path_count`: how many
        sub-paths made them, all of the same `wavelengths` (empty in rgb and mono variants);
        `traits`: the scene's `SceneTraits`."""
        self.traits, bounds = traits, traits.bounds
        self.origin, self.wavelengths = mi.Point3f(bounds.min), wavelengths
        self.words = 12 if colours() == 1 else 16
        all_photons = photons.all()
        stored, normal = all_photons.stored, all_photons.normal
        flux_of = {
            kind: [
                _typical(dr.select(stored & mask, value, 0))
                for value in self._channels(all_photons.flux)
            ]
            for kind, mask in (
                ("indirect", ~all_photons.straight),
                ("caustic", all_photons.caustic),
            )
        }
        self.photon_flux = flux_of["indirect"] if any(flux_of["indirect"]) else flux_of["caustic"]
        self.caustic_flux = flux_of["caustic"]
        self.typical_flux = sum(self.photon_flux) / len(self.photon_flux)
        place = self._choose_cells(all_photons.p, normal, stored, photons, bounds)
        self._sum_cells(all_photons.p, normal, place, stored)
        self.table = dr.zeros(mi.Float, self.words * (dr.width(self.center) + 1))
        self.mean, self.level = 0.0, dr.opaque(mi.Float, 0)
        if dr.width(self.center):
            self._gather(scene, lights, photons, light_path_count)

    @staticmethod
    def _channels(flux):
        return [channel_mean(flux)] if colours() == 1 else [flux[i] for i in range(colours())]

    def _choose_cells(self, position, normal, stored, photons, bounds):
        """Sets the cells' size so that those which hold photons hold `PHOTONS_A_CELL` on average;
        returns each photon's place."""
        diagonal = max(float(dr.norm(bounds.extents())), 1e-30)
        volume = np.prod([float(bounds.max[i] - bounds.min[i]) + 0.01 * diagonal for i in range(3)])
        smallest = (6 * volume / (1 << INDEX_BITS)) ** (
            1 / 3
        )  # smaller cells would share entries of the index
        cell = TRIAL_SHARE * diagonal
        for _ in range(3):
            cell = min(max(cell, smallest), LARGEST_SHARE * diagonal)
            self.cell = dr.opaque(mi.Float, cell)
            self.columns, self.lines = (
                dr.opaque(mi.UInt32, int((bounds.max[i] - bounds.min[i]) / cell) + 3 | 1)
                for i in (0, 1)
            )
            place = self._place(position, normal)
            counts = dr.zeros(mi.UInt32, 1 << INDEX_BITS)
            dr.scatter_inc(counts, place, stored)
            self._occupied = dr.compress(counts > 0)
            wanted = PHOTONS_A_CELL * dr.width(self._occupied) / max(photons.count, 1)
            cell *= wanted ** (1 / photons.dimensions)
        return place

    def _sum_cells(self, position, normal, place, stored):
        cells = dr.width(self._occupied)
        self.center, self.facing, self.index = (
            dr.zeros(mi.Point3f, cells),
            dr.zeros(mi.Vector3f, cells),
            dr.zeros(mi.UInt32, 1 << INDEX_BITS),
        )
        if cells == 0:
            return
        number = dr.arange(mi.UInt32, cells) + 1  # cell 0 is the empty one
        dr.scatter(self.index, number, self._occupied)
        del self._occupied
        slot = dr.gather(mi.UInt32, self.index, place, stored)
        sums = dr.zeros(mi.Float, rounded_up(8 * (cells + 1)))
        for offset, value in enumerate((1, *position, *normal)):
            dr.scatter_add(sums, mi.Float(value), 8 * slot + offset, stored)
        dr.eval(sums)
        scale = dr.rcp(dr.gather(mi.Float, sums, 8 * number))
        self.center = mi.Point3f(
            *[dr.gather(mi.Float, sums, 8 * number + i) * scale for i in (1, 2, 3)]
        )
        facing = mi.Vector3f(*[dr.gather(mi.Float, sums, 8 * number + i) for i in (4, 5, 6)])
        nowhere = dr.select(in_medium(facing), facing, mi.Vector3f(0, 0, 1))
        self.facing = dr.select(dr.squared_norm(facing) > 0, dr.normalize(facing), nowhere)
        dr.eval(self.center, self.facing)

    def _gather(self, scene, lights, photons, light_path_count):
        """Fills the table: density estimates at the cells' centers."""
        channels, reach = colours(), GATHER_RADIUS * self.cell

        def visit(photon, hit, totals):
            straight = hit & photon.straight
            soon = hit & ~straight & (photon.depth <= 2)
            added = [
                dr.select(kind, value, 0)
                for kind in (straight, soon, hit & ~straight & ~soon)
                for value in self._channels(photon.flux)
            ]
            mean = channel_mean(photon.flux)
            added += [dr.select(straight, mean * x, 0) for x in photon.towards]
            added += [dr.select(hit & photon.caustic, mean, 0)]
            return tuple(old + new for old, new in zip(totals, added))

        zeros = tuple(mi.Float(0) for _ in range(3 * channels + 4))
        totals = photons.around(self.center, self.facing, reach, visit, zeros)
        area = dr.rcp(photons.measure(reach) * light_path_count)
        irradiance = [total * area for total in totals[: 3 * channels]]
        direction = mi.Vector3f(*totals[3 * channels : -1])
        direction *= dr.rsqrt(dr.maximum(dr.squared_norm(direction), 1e-30))
        straight = sum(irradiance[:channels]) / channels
        caustic_share = dr.select(
            straight > 0, dr.minimum(totals[-1] * area / dr.maximum(straight, 1e-30), 1), 0
        )
        dr.eval(irradiance, direction, caustic_share)
        light, visible_share = self._strongest_light(scene, lights, straight)
        number = dr.arange(mi.UInt32, dr.width(self.center)) + 1
        for offset, value in enumerate(
            (
                *irradiance,
                *direction,
                _pack_light(light, visible_share),
                self._direct_noise(scene, lights),
                caustic_share,
            )
        ):
            dr.scatter(self.table, mi.Float(value), self.words * number + offset)
        # A cell that no photon met: dark, or hardly touched by a surface, which is worse to get
        # wrong. As bright as others are.
        dr.scatter(
            self.table,
            mi.Float([_mean(value) for value in irradiance]),
            dr.arange(mi.UInt32, 3 * channels),
        )
        dr.eval(self.table)
        self.mean = _mean(sum(irradiance)) / channels
        self.level = dr.opaque(mi.Float, self.mean)

    def _facing_surface(self, p, n):
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        si.p, si.n, si.wavelengths = p, mi.Normal3f(n), self.wavelengths
        return si

    def _strongest_light(self, scene, lights, direct):
        """The emitter that brings most direct light to each cell's center, and the share of its
        unoccluded light that the cell has."""
        best, light = mi.Float(0), mi.UInt32(0)
        near = [
            i
            for i, kind in enumerate(lights.kinds)
            if kind in ("point", "spot", "area", "directional") and i < MOST_EMITTERS
        ]
        si = self._facing_surface(self.center, self.facing)
        near.sort(key=lambda index: -lights.choice.pmf[index])
        for index in near[:MOST_LIGHTS]:
            number = dr.opaque(mi.UInt32, index)  # one kernel for all
            ds, value = lights.unoccluded(si, number, mi.Bool(True))
            value *= _cosine(ds.d, self.facing)
            value *= self._let_through(scene, si.spawn_ray_to(ds.p), value > 0)
            light = dr.select(value > best, number, light)
            best = dr.maximum(best, value)
            dr.eval(best, light)
        return light, dr.select(best > 0, dr.minimum(direct / dr.maximum(best, 1e-30), 2), 0)

    def _let_through(self, scene, shadow, active):
        """Share of light on shadow rays, which the boundaries of media do not block. What lies
        before the first boundary is not known, and taken to be empty."""
        if not self.traits.has_media:
            return dr.select(active & ~scene.ray_test(shadow, active), mi.Float(1), 0)
        nowhere = dr.zeros(mi.MediumPtr, dr.width(shadow.o))
        number = dr.arange(mi.UInt32, dr.width(shadow.o))
        rng = streams(number, mi.UInt32(OWN_STREAM ^ SHADOW_SALT))
        kept, _ = transmittance(scene, self.traits, shadow, nowhere, rng, active)
        return channel_mean(kept)

    def _direct_noise(self, scene, lights):
        """Relative variance of next-event estimation at each cell's center, from `DIRECT_SAMPLES`
        samples."""
        cells = dr.width(self.center)
        number = dr.arange(mi.UInt32, cells * DIRECT_SAMPLES)
        facing = dr.gather(mi.Vector3f, self.facing, number // DIRECT_SAMPLES)
        si = self._facing_surface(
            dr.gather(mi.Point3f, self.center, number // DIRECT_SAMPLES), facing
        )
        ds, weight, _ = lights.propose_direct(
            si, streams(number, mi.UInt32(OWN_STREAM)), mi.Bool(True)
        )
        value = channel_mean(weight) * _cosine(ds.d, facing)
        shadow = lights.shadow_ray(si, ds, lights.guide is not None)
        value *= self._let_through(scene, shadow, value > 0)
        mean, square = (
            dr.block_sum(value, DIRECT_SAMPLES) / DIRECT_SAMPLES,
            dr.block_sum(dr.square(value), DIRECT_SAMPLES) / DIRECT_SAMPLES,
        )
        noise = (square / dr.maximum(dr.square(mean), 1e-30) - 1) * (
            DIRECT_SAMPLES / (DIRECT_SAMPLES - 1)
        )
        return dr.select(mean > 0, dr.maximum(noise, 0), UNSEEN_NOISE)

    def tables(self):
        """Every evaluated array that `lookup` reads, for `dr.freeze` to track."""
        return [self.index, self.table, self.cell, self.columns, self.lines, self.level]

    def _place(self, p, n):
        """Entry of the index for point `p` on a surface with unit normal `n`: cells along x, y, z
        times six directions."""
        q = mi.Vector3u(mi.Vector3i(dr.floor((p - self.origin) / self.cell)) + 1)
        axis = dr.select(
            (dr.abs(n.x) > dr.abs(n.y)) & (dr.abs(n.x) > dr.abs(n.z)),
            mi.UInt32(0),
            dr.select(dr.abs(n.y) > dr.abs(n.z), mi.UInt32(1), mi.UInt32(2)),
        )
        along = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z))
        side = 2 * axis + dr.select(along > 0, mi.UInt32(0), mi.UInt32(1))
        return (((q.z * self.lines + q.y) * self.columns + q.x) * 6 + side) & (
            (1 << INDEX_BITS) - 1
        )

    def slot(self, p, n, active=True):
        """Number of the cell of point `p` on the side to which the unit normal `n` points; 0 if
        nothing is known of it."""
        return dr.gather(mi.UInt32, self.index, self._place(p, n), active)

    def lookup(self, p, n, active=True):
        """The `Irradiance` at point `p` on the side to which the unit normal `n` points."""
        slot = self.slot(p, n, active)
        words = gather_words(self.table, self.words, slot, active)
        channels = colours()
        spectra = [
            mi.Spectrum(words[i * channels])
            if channels == 1
            else mi.Spectrum(words[i * channels : (i + 1) * channels])
            for i in range(3)
        ]
        rest = words[3 * channels :]
        light, visible_share = _unpack_light(rest[3])
        return Irradiance(*spectra, mi.Vector3f(*rest[:3]), light, visible_share, *rest[4:6])


def _cosine(d, facing):
    """Of light from `d` on what faces that way; one in media."""
    return dr.select(in_medium(facing), 1, dr.maximum(dr.dot(d, facing), 0))


def _mean(values):
    """Mean of an array, whose width no kernel is to know."""
    return float(dr.sum(values)[0]) / dr.width(values)


def _typical(flux):
    """Mean of a photon's flux, weighted by itself: what the variance of a sum of photons over their
    sum is."""
    flux = np.array(flux, dtype=np.float64)
    total = flux.sum()
    return float((flux**2).sum() / total) if total > 0 else 0.0


def _pack_light(light, visible_share):
    """An emitter's number (below `MOST_EMITTERS`) and a number in [0, 2] in the bits of an ordinary
    float32."""
    return bits_float(
        mi.UInt32(1 << 30) | (light << 16) | mi.UInt32(dr.round(visible_share * 32767))
    )


def _unpack_light(word):
    bits = float_bits(word)
    return (bits >> 16) & 0x3FFF, mi.Float(bits & 0xFFFF) / 32767
