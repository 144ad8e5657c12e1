"""What a scene with media is made of, found once before rendering."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.traits import (
    MediaTraits,
    check_emitters,
    check_media,
    check_polarisation,
    check_variant,
    is_specular,
    used_bsdfs,
)
from ..lights.environment_guide import infinite_emitters


class VolumeTraits(MediaTraits):
    """Attributes: those of `MediaTraits`, `has_infinite_lights`, `has_mixed` (smooth and specular
    parts in one BSDF), `has_masks` (BSDFs that ignore the component mask), `shares` (see
    `density_share`, by the media's registry numbers)."""

    def __init__(self, scene, sensors):
        super().__init__(scene, sensors)
        bsdfs, smooth = used_bsdfs(scene), int(mi.BSDFFlags.Smooth)
        self.has_mixed = any(is_specular(b) and int(b.flags()) & smooth for b in bsdfs)
        self.has_masks = any(b.class_name() == "MaskBSDF" for b in bsdfs)
        self.has_infinite_lights = bool(infinite_emitters(scene))
        media = self.media
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(m))[0]) for m in media]
        shares = np.zeros(max(numbers, default=0) + 1, dtype=np.float32)
        shares[numbers] = [_mean_over_majorant(m) for m in media]
        self.shares = mi.Float(shares)
        dr.make_opaque(self.shares)

    def density_share(self, medium, active):
        """Roughly, a medium's mean density over its majorant: how many tentative collisions are
        real."""
        return dr.gather(mi.Float, self.shares, dr.reinterpret_array(mi.UInt32, medium), active)


def _mean_over_majorant(medium):
    """Mean extinction over its maximum: of the grid's values where there is a grid, of the channels
    elsewhere. What is unknown counts as thin."""
    parameters = mi.traverse(medium)
    name = next(
        (
            name
            for name in ("sigma_t.data", "sigma_t.value.value", "sigma_t.value")
            if name in parameters
        ),
        None,
    )
    if name is None:
        return 0.0
    values = dr.abs(mi.Float(dr.ravel(parameters[name])))  # on the device: a grid may be large
    mean, most = float(dr.mean(values)[0]), float(dr.max(values)[0])
    return mean / most if most > 0 else 0.0


def check_volume_scene(scene, sensors, plugin):
    """Raises `UnsupportedScene` for what the volumetric integrators cannot render, before any
    sampling."""
    check_variant(scene, plugin)
    check_polarisation(plugin)
    check_emitters(scene, plugin)
    check_media(scene, sensors, plugin)
