"""Whether photons that arrive at a surface are of use there: how narrow the lobes of its BSDF are,
and whether it is a curve, narrower itself than the disks in which photons are merged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
SAMPLES = 64
"""Directions sampled of each BSDF under each angle."""


@dataclass(frozen=True)
class NarrowSurfaces:
    """Surfaces at which photons are of no use: the registry tables `narrow_bsdfs` and, of each
    shape, whether it is a curve; each may be ``None`` where there is none."""

    bsdfs: Any
    curves: Any

    @classmethod
    def of(cls, scene):
        """Those of a scene; ``None`` where there are none."""
        found = cls(narrow_bsdfs(scene), curves(scene))
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


def curves(scene):
    """A registry table: of each shape of the scene, whether it is a curve. None where none is."""
    shapes = used_shapes(scene)
    found = [shape.class_name() in CURVES for shape in shapes]
    return registry_table(shapes, mi.ShapePtr, found, mi.Bool) if any(found) else None


def narrow_bsdfs(scene):
    """A registry table: of each BSDF of the scene a bit for each of the `COSINES`, whether its
    `concentration` is above `NARROW` there. None where there is no such BSDF."""
    bsdfs = used_bsdfs(scene)  # all have a place in the table: any may be asked for
    smooth = [b for b in bsdfs if mi.has_flag(b.flags(), mi.BSDFFlags.Smooth)]
    rough = [b for b in smooth if int(b.flags()) & ~_EVEN]
    if not rough:
        return None
    narrow = concentration(rough) > NARROW
    bits = dict(zip((b.ptr for b in rough), narrow @ (1 << np.arange(len(COSINES)))))
    values = [bits.get(b.ptr, 0) for b in bsdfs]
    return registry_table(bsdfs, mi.BSDFPtr, values, mi.UInt32) if narrow.any() else None


_EVEN = int(
    mi.BSDFFlags.DiffuseReflection
    | mi.BSDFFlags.DiffuseTransmission
    | mi.BSDFFlags.FrontSide
    | mi.BSDFFlags.BackSide
    | mi.BSDFFlags.SpatiallyVarying
    | mi.BSDFFlags.Null
)
"""Flags of BSDFs without lobes."""


def concentration(bsdfs):
    """How unevenly each of the BSDFs f weighs photons that arrive from everywhere alike, at some
    points of its textures: an array (BSDFs, angles) of

        pi I[f^2] / I[f]^2,    I[g] = integral of g |cos| over directions,

    which is 1 for a diffuse BSDF. So many photons tell as much as one at a diffuse surface. By
    samples of the BSDF, with p their density and w = f |cos| / p: I[f] = E[w], I[f^2] = E[w f]."""
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
    context = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.Smooth))
    bs, weight = bsdf.sample(context, si, choice, mi.Point2f(u, v))
    value = channel_mean(bsdf.eval(context, si, bs.wo))
    weight, f = channel_mean(weight), value / dr.maximum(dr.abs(bs.wo.z), 0.05)
    dr.eval(weight, f)
    first, second = (
        np.array(x, np.float64).reshape(len(bsdfs), len(COSINES), SAMPLES).mean(axis=2)
        for x in (weight, weight * f)
    )
    return np.pi * second / np.maximum(first, 1e-12) ** 2
