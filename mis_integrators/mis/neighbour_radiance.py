"""What a cell of the irradiance cache sees around it: the distribution over directions of its
neighbours' radiance."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy, gather_words
from ..core.random import next_2d, streams
from ..core.spectra import channel_mean
from ..photons.irradiance_cache import colours

RAYS, SECTORS = 32, 8
"""Tuned: rays of a cell to its neighbours, and sectors of azimuth by which they are stratified."""
HALVES = 2
"""Neighbours are sorted by radiance and averaged in two halves, the dark one first: a mean over
directions of 1 / (1 + gamma) is not that of the mean radiance."""
DELTA_STEPS = 3
"""Tuned: delta surfaces that such a ray goes through."""
OWN_STREAM = 0x6E656172


class NeighbourRadiance:
    """For each cell `HALVES` typical neighbours, each with its radiance by direct and by other
    light (spectra).

    Attributes: `table` (float32), `albedo` of a typical neighbour (width one).
    """

    def __init__(self, scene, weights, wavelengths):
        """`weights`: `OptimalWeights`, whose nodes tell the neighbours' radiance; `wavelengths`:
        those at which its cache was made."""
        cache = weights.cache
        cells = dr.width(cache.center)
        channels = colours()
        self.words = 2 * channels * HALVES
        if cells == 0:
            self.table, self.albedo = dr.zeros(mi.Float, self.words), dr.opaque(mi.Float, 0)
            return
        si, bsdf, active = self._neighbours(scene, cache, cells, wavelengths)
        node = weights.node(si, bsdf, active)
        albedo = dr.sum(dr.select(active, node.kernel / node.lobe_p, 0)) / dr.maximum(
            dr.count(active), 1
        )
        self.albedo = dr.opaque(mi.Float, min(float(albedo[0]), 1.0))
        grey = np.array(dr.select(active, channel_mean(node.direct + node.indirect), 0)).reshape(
            cells, RAYS
        )
        order = np.argsort(grey, axis=1)
        table = np.zeros((cells + 1, HALVES, 2, channels), dtype=np.float32)
        for number, spectrum in enumerate((node.direct, node.indirect)):
            for channel in range(channels):
                value = channel_mean(spectrum) if channels == 1 else spectrum[channel]
                value = np.array(dr.select(active, value, 0)).reshape(cells, RAYS)
                value = np.take_along_axis(value, order, axis=1)
                halves = value.reshape(cells, HALVES, RAYS // HALVES)
                table[1:, :, number, channel] = halves.mean(axis=2)
        self.table = from_numpy(mi.Float, table.ravel())

    @staticmethod
    def _neighbours(scene, cache, cells, wavelengths):
        """The surfaces that smoothly scatter, met by `RAYS` rays a cell, distributed by cosine,
        behind delta surfaces too."""
        number = dr.arange(mi.UInt32, cells * RAYS)
        cell, stratum = number // RAYS, number % RAYS
        rng = streams(number, mi.UInt32(OWN_STREAM))
        jitter = next_2d(rng)
        sample = mi.Point2f(
            (mi.Float(stratum // SECTORS) + jitter.x) * (SECTORS / RAYS),
            (mi.Float(stratum % SECTORS) + jitter.y) / SECTORS,
        )
        frame = mi.Frame3f(dr.gather(mi.Vector3f, cache.facing, cell))
        start = dr.zeros(mi.SurfaceInteraction3f, cells * RAYS)
        start.p, start.n = dr.gather(mi.Point3f, cache.center, cell), mi.Normal3f(frame.n)
        start.wavelengths = wavelengths
        ray = start.spawn_ray(frame.to_world(mi.warp.square_to_cosine_hemisphere(sample)))
        active = mi.Bool(True)
        for step in range(DELTA_STEPS + 1):
            si = scene.ray_intersect(ray, active)
            bsdf = si.bsdf(ray)
            active = active & si.is_valid()
            through = active & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            if step == DELTA_STEPS or not dr.any(through):
                break
            bs, _ = bsdf.sample(
                mi.BSDFContext(), si, rng.next_float32(through), next_2d(rng, through), through
            )
            onwards = si.spawn_ray(si.to_world(bs.wo))
            ray = mi.Ray3f(
                dr.select(through, onwards.o, ray.o),
                dr.select(through, onwards.d, ray.d),
                0,
                wavelengths,
            )
            dr.eval(ray, rng, active)
        return si, bsdf, active & ~through

    def lookup(self, slot, active=True):
        """Pairs (radiance by direct light, by other light) of the typical neighbours of cell
        `slot`, the darker one first."""
        words = gather_words(self.table, self.words, slot, active)
        channels = colours()
        spectra = [
            mi.Spectrum(words[i]) if channels == 1 else mi.Spectrum(words[i : i + channels])
            for i in range(0, len(words), channels)
        ]
        return list(zip(spectra[::2], spectra[1::2]))
