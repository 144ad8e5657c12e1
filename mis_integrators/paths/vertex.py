"""Smooth vertices as places where a path goes on: what one scatters between two directions, and how
likely either side samples it.

All techniques that make a path ask for the same three numbers at each of its vertices, so they are
computed in one place, with one meaning of their arguments: `to_camera` and `to_light` are unit
vectors in world space towards the path's neighbours on either side.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean
from ..core.traits import lookup
from .perturbed import smooth_density

SMALLEST_COSINE = 1e-6
ROUGH = -1.0
"""What `VertexBSDF.density` holds where the surface is not Lambertian."""


def scattered_mean(value, n, to_light):
    """Mean over the channels of the BSDF [1/sr], where `value` is that of `VertexBSDF.f_and_pdfs`:
    what geometric cosines turn into the light that goes on."""
    return channel_mean(value) * dr.rcp(dr.maximum(dr.abs(dr.dot(n, to_light)), SMALLEST_COSINE))


class VertexBSDF:
    """A vertex, seen from one side of it.

    Attributes: `n`, `ns` geometric and shading normal; `value` (a spectrum, BSDF without cosine)
    and `density` (per projected solid angle) of Lambertian surfaces on the side from which they
    were described; `si`, `bsdf` where there are others.
    """

    def __init__(self, traits, n, ns, value, density, si=None, bsdf=None):
        self.traits, self.n, self.ns, self.value, self.density, self.si, self.bsdf = (
            traits,
            n,
            ns,
            value,
            density,
            si,
            bsdf,
        )

    @classmethod
    def at(cls, traits, si, bsdf, active):
        """The vertex at an interaction, described from the side of `si.wi`."""
        value, density = mi.Spectrum(0), mi.Float(ROUGH)
        if traits.has_lambertian:
            lambertian = (
                active & lookup(traits.lambertian, bsdf, mi.Bool, active)
                if traits.has_rough
                else active
            )
            upright = mi.Vector3f(
                0, 0, dr.select(mi.Frame3f.cos_theta(si.wi) > 0, mi.Float(1), mi.Float(-1))
            )
            value, density = bsdf.eval_pdf(mi.BSDFContext(), si, upright, lambertian)
            density = dr.select(lambertian, density, ROUGH)
        return cls(traits, mi.Vector3f(si.n), mi.Vector3f(si.sh_frame.n), value, density, si, bsdf)

    def f_and_pdfs(self, to_camera, to_light, active=True):
        """`(value, p_camera, p_light)`: radiance towards the camera per radiance from the light and
        unit of solid angle (shading cosine included, as Mitsuba's `eval`), and the densities per
        projected solid angle with which a camera path goes on to the light's side, and a light
        sub-path to the camera's. Geometric normals project."""
        traits = self.traits
        shading_camera, shading_light = dr.dot(self.ns, to_camera), dr.dot(self.ns, to_light)
        geometric_camera, geometric_light = dr.dot(self.n, to_camera), dr.dot(self.n, to_light)
        per_camera = dr.rcp(dr.maximum(dr.abs(geometric_camera), SMALLEST_COSINE))
        per_light = dr.rcp(dr.maximum(dr.abs(geometric_light), SMALLEST_COSINE))
        one_side = shading_camera * shading_light > 0
        value = dr.select(one_side, self.value * dr.abs(shading_light), 0)
        p_camera = dr.select(one_side, self.density * dr.abs(shading_light), 0)
        p_light = dr.select(one_side, self.density * dr.abs(shading_camera), 0)
        if self.si is not None and traits.has_rough:
            rough = active & (self.density < 0)
            seen, lit = mi.SurfaceInteraction3f(self.si), mi.SurfaceInteraction3f(self.si)
            seen.wi, lit.wi = self.si.to_local(to_camera), self.si.to_local(to_light)
            rough_value, rough_camera = self.bsdf.eval_pdf(mi.BSDFContext(), seen, lit.wi, rough)
            rough_light = self.bsdf.pdf(
                mi.BSDFContext(mi.TransportMode.Importance), lit, seen.wi, rough
            )
            if traits.has_perturbed:
                perturbed = rough & lookup(traits.perturbed, self.bsdf, mi.Bool, rough)
                special = smooth_density(self.bsdf, lit, seen.wi, rough_light, perturbed)
                rough_light = dr.select(perturbed, special, rough_light)
            value = dr.select(rough, rough_value, value)
            p_camera, p_light = (
                dr.select(rough, rough_camera, p_camera),
                dr.select(rough, rough_light, p_light),
            )
        # Light sub-paths end where shading and geometric normal disagree about the side.
        agreed = (geometric_camera * shading_camera > 0) & (geometric_light * shading_light > 0)
        return value, p_camera * per_light, dr.select(agreed, p_light * per_camera, 0)
