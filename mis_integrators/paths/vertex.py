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
from .media import (
    adjoint_factor,
    albedo_mean,
    phase_f_and_pdf,
    point_in,
    scattered_share,
)
from .perturbed import smooth_density

SMALLEST_COSINE = 1e-6
ROUGH = -1.0
"""What `VertexBSDF.density` holds where the surface is not Lambertian."""


def in_medium(n):
    """Whether vertices lie in a medium: then they have no normal."""
    return dr.squared_norm(n) < 0.5


def facing(traits, n, d):
    """Cosine (positive) between geometric normals and directions, which turns solid angles into
    projected ones; one at vertices in media."""
    cosine = dr.abs(dr.dot(n, d))
    return dr.select(in_medium(n), 1, cosine) if traits.has_media else cosine


def per_projected(cosine):
    """One over the size of a cosine, bounded: it turns densities per solid angle, and values that
    hold the cosine, into those per projected solid angle."""
    return dr.rcp(dr.maximum(dr.abs(cosine), SMALLEST_COSINE))


def upright(si):
    """The local direction along the shading normal, on the side of `si.wi`."""
    return mi.Vector3f(0, 0, dr.select(mi.Frame3f.cos_theta(si.wi) > 0, mi.Float(1), mi.Float(-1)))


def f_and_p(si, bsdf, wo, active):
    """BSDF without cosine [1/sr] (a spectrum), and density per projected solid angle, of a camera
    path that arrives from `si.wi` and goes on to the local direction `wo`."""
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
    scale = per_projected(wo.z)
    return value * scale, pdf * scale


class Sides:
    """Media on both sides of vertices: `above`, where the geometric normal points to, and `below`;
    of vertices in media both are the medium. `p`: the vertices."""

    def __init__(self, above, below, p, wavelengths):
        self.above, self.below, self.p, self.wavelengths = above, below, p, wavelengths

    @classmethod
    def at(cls, si, medium):
        """Those of interactions that were reached through a `medium`."""
        transition = si.is_medium_transition()
        above = dr.select(transition, si.target_medium(mi.Vector3f(si.n)), medium)
        below = dr.select(transition, si.target_medium(-mi.Vector3f(si.n)), medium)
        return cls(above, below, si.p, si.wavelengths)

    def medium(self, n, d):
        """The medium into which a ray in direction `d` leaves vertices with normals `n`."""
        return dr.select(dr.dot(n, d) > 0, self.above, self.below)


class PhaseOrBSDF:
    """What scatters at vertices, with the methods of a BSDF that weights call: the `bsdf` of the
    surface, or on the lanes `scatters` the phase function of the `medium`."""

    def __init__(self, bsdf, medium, scatters):
        self.bsdf, self.medium, self.scatters = bsdf, medium, scatters

    @classmethod
    def at(cls, at):
        """Where sub-paths have arrived (`CameraArrival`, `LightArrival`); in scenes without media
        the BSDF itself."""
        return at.bsdf if at.scatters is None else cls(at.bsdf, at.medium, at.scatters)

    def _phase(self, si, wo, inside):
        sides = si.to_world(si.wi), si.to_world(wo)
        return phase_f_and_pdf(self.medium, si.p, si.wavelengths, *sides, inside)

    def eval_pdf(self, context, si, wo, active=True):
        """Value (on surfaces times the cosine) and density per solid angle."""
        inside = active & self.scatters
        value, pdf = self.bsdf.eval_pdf(context, si, wo, active & ~self.scatters)
        phase, phase_pdf = self._phase(si, wo, inside)
        return dr.select(inside, phase, value), dr.select(inside, phase_pdf, pdf)

    def coefficients(self, si, active):
        """`(albedo, extinction)` on lanes that scatter in the medium, as of
        `media.scattered_share`."""
        medium = dr.select(active & self.scatters, self.medium, dr.zeros(mi.MediumPtr))
        _, albedo, extinction = scattered_share(medium, si.p, si.wavelengths, active)
        return albedo, extinction

    def phase_lobe(self, si, active):
        """Density of the phase function in a typical direction, by one fixed sample, on lanes that
        scatter in the medium."""
        medium = dr.select(active & self.scatters, self.medium, dr.zeros(mi.MediumPtr))
        mei = point_in(medium, si.p, si.time, si.wavelengths, si.to_world(si.wi))
        fixed = mi.PhaseFunctionContext(None), mei, mi.Float(0.5), mi.Point2f(0.5)
        return medium.phase_function().sample(*fixed, active & self.scatters)[2]

    def pdf(self, context, si, wo, active=True):
        """Density per solid angle."""
        inside = active & self.scatters
        pdf = self.bsdf.pdf(context, si, wo, active & ~self.scatters)
        return dr.select(inside, self._phase(si, wo, inside)[1], pdf)


class VertexBSDF:
    """A vertex, seen from one side of it. In a medium (without a normal, see `in_medium`) the phase
    function is the BSDF, and there is no cosine.

    Attributes: `n`, `ns` geometric and shading normal; `value` (a spectrum, BSDF without cosine)
    and `density` (per projected solid angle) of Lambertian surfaces on the side from which they
    were described (in media, where photons merge, `density` is the extinction [1/m]); `si`, `bsdf`
    where there are others; `sides` (`Sides`) in scenes with media.
    """

    def __init__(self, traits, n, ns, value, density, si=None, bsdf=None, sides=None):
        self.traits, self.n, self.ns, self.value, self.density, self.si, self.bsdf = (
            traits,
            n,
            ns,
            value,
            density,
            si,
            bsdf,
        )
        self.sides = sides

    @classmethod
    def at(cls, traits, si, bsdf, active, medium=None, merges=False):
        """The vertex at an interaction, described from the side of `si.wi`; `medium`: the one
        through which it was reached, in scenes with media; `merges`: photons are merged there."""
        sides = None
        if traits.has_media:
            sides = Sides.at(si, medium)
            inside = in_medium(si.n)
            active = active & ~inside
        value, density = mi.Spectrum(0), mi.Float(ROUGH)
        if traits.has_lambertian:
            lambertian = (
                active & lookup(traits.lambertian, bsdf, mi.Bool, active)
                if traits.has_rough
                else active
            )
            value, density = bsdf.eval_pdf(mi.BSDFContext(), si, upright(si), lambertian)
            density = dr.select(lambertian, density, ROUGH)
        if traits.has_media:
            extinction = mi.Float(0)
            if merges:
                within = dr.select(inside, medium, dr.zeros(mi.MediumPtr))
                extinction = scattered_share(within, si.p, si.wavelengths, inside)[-1]
            density = dr.select(inside, extinction, density)
        n, ns = mi.Vector3f(si.n), mi.Vector3f(si.sh_frame.n)
        return cls(traits, n, ns, value, density, si, bsdf, sides)

    def f_and_pdfs(self, to_camera, to_light, active=True):
        """`(value, p_camera, p_light)`: radiance towards the camera per radiance from the light and
        unit of solid angle (shading cosine included, as Mitsuba's `eval`), and the densities per
        projected solid angle with which a camera path goes on to the light's side, and a light
        sub-path to the camera's. Geometric normals project."""
        traits = self.traits
        shading_camera, shading_light = dr.dot(self.ns, to_camera), dr.dot(self.ns, to_light)
        geometric_camera, geometric_light = dr.dot(self.n, to_camera), dr.dot(self.n, to_light)
        per_camera, per_light = per_projected(geometric_camera), per_projected(geometric_light)
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
        p_camera, p_light = p_camera * per_light, dr.select(agreed, p_light * per_camera, 0)
        if traits.has_media:
            inside = active & in_medium(self.n)
            sides = self.sides
            where = sides.above, sides.p, sides.wavelengths, to_camera, to_light, inside
            phase, pdf = phase_f_and_pdf(*where)
            value = dr.select(inside, phase, value)
            p_camera = dr.select(inside, pdf, p_camera)
            p_light = dr.select(inside, pdf * adjoint_factor(traits, *where), p_light)
        return value, p_camera, p_light

    def adjoint(self, to_camera, to_light, active=True):
        """What the `value` of `f_and_pdfs`, that of camera paths, is multiplied with where a light
        sub-path has arrived (`media.adjoint_factor`); 1 on surfaces."""
        if not self.traits.has_media:
            return 1
        inside, sides = active & in_medium(self.n), self.sides
        return adjoint_factor(
            self.traits, sides.above, sides.p, sides.wavelengths, to_camera, to_light, inside
        )

    def scattered_mean(self, value, to_light, active=True):
        """Mean over the channels of the BSDF [1/sr], where `value` is that of `f_and_pdfs`: what
        geometric cosines turn into the light that goes on. In media that is the phase function
        times the albedo."""
        cosine = dr.maximum(facing(self.traits, self.n, to_light), SMALLEST_COSINE)
        mean = channel_mean(value) * dr.rcp(cosine)
        if not self.traits.has_media:
            return mean
        inside = active & in_medium(self.n)
        return dr.select(inside, mean * albedo_mean(self.sides, inside), mean)
