"""Whether photons that arrive at a surface are of use there, and from how far away: how narrow the
lobes of its BSDF are, and whether it is a curve, narrower itself than the disks in which photons
are merged.

Of a BSDF with a narrow lobe that scatters evenly, too, as plastic does, photons bring the light of
an even part, and paths go on for the rest: f = f_e + (f - f_e). The even part f_e is what f has in
a direction off the lobe, but nowhere more than f.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.sequences import sobol
from ..core.spectra import channel_mean
from ..core.traits import CURVES, lookup, registry_table, used_bsdfs, used_shapes

NARROW = 30.0
"""Tuned: concentration from which on photons are gathered one vertex later."""
COSINES = 0.25, 0.5, 0.75, 1.0
"""Of the angles under which BSDFs are looked at."""
SAMPLES = 256
"""Directions sampled of each BSDF under each angle."""
PARTED = 1 << len(COSINES)
"""Bit of a BSDF with an even part."""
EVEN_SHARE = 0.15
"""Tuned: of the light that a BSDF scatters, what its even part has at least."""
LEAST_REST = 1e-3
"""Albedo of what a BSDF has besides its even part, less than which is rounding."""
FINENESS = 8
"""Steps of a factor of two in which concentrations are kept."""
OFF_LOBE = 0.7
"""Cosine of the direction off the lobe."""
EVEN = int(mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.DiffuseTransmission)
"""Types of what scatters evenly."""


@dataclass(frozen=True)
class NarrowSurfaces:
    """Surfaces at which photons are of no use: the registry tables `narrow_bsdfs` and, of each
    shape, whether it is a curve; each may be ``None`` where there is none. `parted`: whether there
    are BSDFs with an even part, of which photons bring the light."""

    bsdfs: Any
    curves: Any
    parted: bool

    @classmethod
    def of(cls, scene, lobed):
        """Those of a scene with these `LobedBSDFs`; ``None`` where there are none."""
        bsdfs = narrow_bsdfs(lobed)
        parted = bsdfs is not None and bool(np.any(np.array(bsdfs) & PARTED))
        found = cls(bsdfs, curves(scene), parted)
        return found if found.tables() else None

    def tables(self):
        """What it reads."""
        return [table for table in (self.bsdfs, self.curves) if table is not None]

    def at(self, bsdf, si, active):
        """Whether a surface with this BSDF is one, as seen from where `si` is: by the nearest of
        the `COSINES`."""
        narrow = mi.Bool(False)
        if self.bsdfs is not None:
            bits = lookup(self.bsdfs, bsdf, mi.UInt32, active)
            place = dr.abs(si.wi.z) * len(COSINES) - 0.5
            nearest = mi.UInt32(dr.clip(place, 0, len(COSINES) - 1))
            narrow |= (bits >> nearest) & 1 != 0
        if self.curves is not None:
            narrow |= lookup(self.curves, si.shape, mi.Bool, active & si.is_valid())
        return narrow

    def has_even_part(self, bsdf, active):
        """Of BSDFs whether photons bring the light of their even part, where they are narrow."""
        return (lookup(self.bsdfs, bsdf, mi.UInt32, active) & PARTED) != 0


def even_bound(bsdf, si, active=True):
    """What the BSDF f has per cosine in a direction off its lobe, at right angles to the plane of
    `si.wi` and the normal: its even part f_e is nowhere more than that, nor than f. It need not be
    all that scatters evenly, for paths go on for the rest."""
    x, y, z = si.wi
    aside = dr.sqrt((1 - OFF_LOBE**2) * dr.rcp(dr.maximum(x * x + y * y, 1e-12)))
    level = dr.squared_norm(mi.Vector2f(x, y)) < 1e-12
    wo = mi.Vector3f(
        dr.select(level, (1 - OFF_LOBE**2) ** 0.5, -y * aside),
        dr.select(level, 0, x * aside),
        dr.mulsign(mi.Float(OFF_LOBE), z),
    )
    return bsdf.eval(mi.BSDFContext(), si, wo, active) * (1 / OFF_LOBE)


def even_part(bound, value, wo):
    """f_e |cos| towards `wo` (local), by its `even_bound` and the `value` f |cos| there."""
    return dr.minimum(value, bound * dr.abs(wo.z))


def curves(scene):
    """A registry table: of each shape of the scene, whether it is a curve. None where none is."""
    shapes = used_shapes(scene)
    found = [shape.class_name() in CURVES for shape in shapes]
    return registry_table(shapes, mi.ShapePtr, found, mi.Bool) if any(found) else None


@dataclass(frozen=True)
class LobedBSDFs:
    """The BSDFs of a scene: `all` of them, those `with_lobes`, and the `Looks` at these (None where
    there are none)."""

    all: list
    with_lobes: list
    looks: Any

    @classmethod
    def of(cls, scene):
        bsdfs = used_bsdfs(scene)
        smooth = [b for b in bsdfs if mi.has_flag(b.flags(), mi.BSDFFlags.Smooth)]
        found = [b for b in smooth if int(b.flags()) & ~_WITHOUT_LOBES]
        return cls(bsdfs, found, look_at(found) if found else None)

    @functools.cached_property
    def parted(self):
        """As of `parted`, of those with lobes."""
        return parted(self.looks)

    def table(self, values):
        """A registry table of unsigned integers, one for each of those with lobes; zero for all
        others, which have a place in it, too: any may be asked for. None where all are zero."""
        if not np.any(values):
            return None
        known = dict(zip((b.ptr for b in self.with_lobes), values))
        found = [known.get(b.ptr, 0) for b in self.all]
        return registry_table(self.all, mi.BSDFPtr, found, mi.UInt32)


def narrow_bsdfs(lobed):
    """A registry table: of each BSDF a bit for each of the `COSINES`, whether the `concentration`
    of what paths would go on for is above `NARROW` there; and where it is so, whether the BSDF is
    one of the `parted` ones. None where there is no narrow BSDF."""
    if lobed.looks is None:
        return None
    narrow = concentration(rest_of(lobed.looks, lobed.parted)) > NARROW
    seen = narrow @ (1 << np.arange(len(COSINES)))
    seen |= np.where(narrow.any(axis=1) & lobed.parted, PARTED, 0)
    return lobed.table(seen)


@dataclass(frozen=True)
class LobeWidths:
    """How wide the lobes of BSDFs are: a registry `table` with a byte for each of the `COSINES`,
    log2 of the `concentration` in units of 1 / `FINENESS`."""

    table: Any

    @classmethod
    def of(cls, lobed):
        """Those of `LobedBSDFs`; ``None`` where all scatter evenly, or have an even part: what this
        scatters needs the light of wide disks."""
        if lobed.looks is None:
            return None
        octaves = np.log2(np.maximum(concentration(lobed.looks), 1))
        octaves = np.where(lobed.parted[:, None], 0, octaves)
        parts = np.clip(np.rint(FINENESS * octaves), 0, 255).astype(np.int64)
        table = lobed.table(parts @ (1 << 8 * np.arange(len(COSINES))))
        return None if table is None else cls(table)

    def at(self, bsdf, si, active):
        """The width of the lobes, 1 where the BSDF scatters evenly or has an even part: the root of
        the solid angle that counts, c^(-1/2) with the `concentration` c, between the two nearest
        `COSINES`."""
        parts = lookup(self.table, bsdf, mi.UInt32, active)
        place = dr.clip(dr.abs(si.wi.z) * len(COSINES) - 1, 0, len(COSINES) - 1)
        low = mi.UInt32(place)
        high = dr.minimum(low + 1, len(COSINES) - 1)
        before, after = (mi.Float(parts >> 8 * number & 255) for number in (low, high))
        return dr.exp2(dr.lerp(before, after, place - mi.Float(low)) * (-0.5 / FINENESS))


_WITHOUT_LOBES = EVEN | int(
    mi.BSDFFlags.FrontSide
    | mi.BSDFFlags.BackSide
    | mi.BSDFFlags.SpatiallyVarying
    | mi.BSDFFlags.Null
)
"""Flags of BSDFs without lobes."""


class Looks(NamedTuple):
    """What samples of the smooth part of BSDFs find: arrays (BSDFs, angles, samples)."""

    value: np.ndarray
    """Of the BSDF with its cosine, mean over the channels."""
    even: np.ndarray
    """That of its even part."""
    weight: np.ndarray
    """Of the sample."""
    cosine: np.ndarray


def concentration(looks):
    """How unevenly each of the BSDFs f weighs photons that arrive from everywhere alike, at some
    points of its textures: an array (BSDFs, angles) of

        pi I[f^2] / I[f]^2,    I[g] = integral of g |cos| over directions,

    which is 1 for a diffuse BSDF. So many photons tell as much as one at a diffuse surface. By
    samples of the BSDF (`Looks`), with p their density and w = f |cos| / p: I[f] = E[w], I[f^2] =
    E[w f]."""
    f = looks.value / np.maximum(looks.cosine, 0.05)
    first, second = (x.mean(axis=2) for x in (looks.weight, looks.weight * f))
    return np.pi * second / np.maximum(first, 1e-12) ** 2


def parted(looks):
    """Which of the BSDFs have an even part that is worth gathering photons for, as seen under some
    of the angles: an array."""
    evenly = (looks.weight * _even_share(looks)).mean(axis=2)
    return np.any(evenly > EVEN_SHARE * looks.weight.mean(axis=2), axis=1)


def rest_of(looks, has_even_part):
    """The `Looks` at what BSDFs have besides their even part: a coat of plastic is as narrow as it
    is alone. BSDFs without one are left whole."""
    rest = np.where(has_even_part[:, None, None], 1 - _even_share(looks), 1)
    rest *= (looks.weight * rest).mean(axis=2, keepdims=True) > LEAST_REST
    return looks._replace(value=looks.value * rest, weight=looks.weight * rest)


def _even_share(looks):
    """Of the light that BSDFs scatter into each of the directions."""
    return np.where(looks.value > 0, looks.even / np.maximum(looks.value, 1e-30), 0)


def look_at(bsdfs):
    """The `Looks` at BSDFs under the angles of the `COSINES`, at some points of their textures. One
    kernel, for with many BSDFs it takes long to compile."""
    count = len(bsdfs) * len(COSINES) * SAMPLES
    index = dr.arange(mi.UInt32, count)
    bsdf = dr.gather(mi.BSDFPtr, mi.BSDFPtr(bsdfs), index // (len(COSINES) * SAMPLES))
    cosine = dr.gather(mi.Float, mi.Float(COSINES), index // SAMPLES % len(COSINES))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(dr.sqrt(1 - cosine * cosine), 0, cosine)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.t = mi.Float(1)
    if mi.is_spectral:
        si.wavelengths = mi.sample_rgb_spectrum(mi.sample_shifted(mi.Float(0.5)))[0]
    choice, u, v, s, t = *sobol(index, mi.UInt32(1), 3), *sobol(index, mi.UInt32(2), 2)
    si.uv = mi.Point2f(s, t)
    of_smooth = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.Smooth))
    bs, weight = bsdf.sample(of_smooth, si, choice, mi.Point2f(u, v))
    value = bsdf.eval(of_smooth, si, bs.wo)
    even = even_part(even_bound(bsdf, si), value, bs.wo)
    found = [*map(channel_mean, (value, even, weight)), dr.abs(bs.wo.z)]
    dr.eval(found)
    shape = len(bsdfs), len(COSINES), SAMPLES
    return Looks(*(np.broadcast_to(np.array(x, np.float64), count).reshape(shape) for x in found))
