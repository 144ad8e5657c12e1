"""Least noise of two strategies in a closed sphere of rough metal, by quadrature.

Light and camera are at the centre. z_0 is seen along its normal, and from there on all is even: a
vertex z_1 is known by one angle, that of the segment z_0 z_1 with both normals. Radiance, second
photon sums and fluxes of photons are functions of that angle, integrals over directions sums on a
grid. Paths have four segments at most.
"""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

ANGLES, AZIMUTHS = 96, 64


def scattering(bsdf, theta_in, theta_out, phi):
    """BSDF value f (no cosine; first channel) and density of the outgoing direction per projected
    solid angle, for arrays of angles with the normal and of the azimuth between."""
    theta_in, theta_out, phi = (np.ravel(a) for a in np.broadcast_arrays(theta_in, theta_out, phi))
    si = mi.SurfaceInteraction3f()
    zero = np.zeros_like(theta_in)
    si.wi = mi.Vector3f(np.sin(theta_in), zero, np.cos(theta_in))
    sine = np.sin(theta_out)
    wo = mi.Vector3f(sine * np.cos(phi), sine * np.sin(phi), np.cos(theta_out))
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo)
    cosine = np.cos(theta_out)
    return np.array(value)[0] / cosine, np.array(pdf) / cosine


@dataclass
class GlossySphere:
    """Functions of the angle, on a grid with the weights `measure` (projected solid angle):

    `f`, `p`: BSDF and camera density at z_0; `L`: luminance of z_1; `at_first`, `at_second`: second
    photon sums, flux included, of what merges at z_0 from z_1 and at z_1 [W^2/...]: what a photon
    of the typical flux would make of radiance."""

    measure: np.ndarray
    f: np.ndarray
    p: np.ndarray
    L: np.ndarray
    at_first: np.ndarray
    at_second: np.ndarray

    def noise(self, w, disk, light_paths):
        """Variance of an iteration's pixel, w the weight at z_1, `disk` the merge area, N_B = 1."""
        per_photon = 1 / (disk * light_paths)
        f, p, L, dmu = self.f, self.p, self.L, self.measure
        photons = np.sum((1 - w) ** 2 * f**2 * self.at_first * dmu)
        photons += np.sum(w**2 * f**2 / p * self.at_second * dmu)
        camera = np.sum(w**2 * f**2 / p * L**2 * dmu) - np.sum(w * f * L * dmu) ** 2
        return per_photon * photons + camera - np.sum(f * L * dmu) ** 2 / light_paths

    def best(self, disk, light_paths):
        """The weights of least noise: where its gradient is zero."""
        per_photon = 1 / (disk * light_paths)
        f, p, L, dmu = self.f, self.p, self.L, self.measure
        first = per_photon * f**2 * self.at_first * dmu
        diagonal = first + f**2 / p * (per_photon * self.at_second + L**2) * dmu
        mean = f * L * dmu
        return np.linalg.solve(np.diag(diagonal) - np.outer(mean, mean), first)


def glossy_sphere(bsdf, intensity):
    """The world of a sphere of radius one with a point light of that intensity."""
    edges = np.linspace(0, np.pi / 2, ANGLES + 1)
    theta = (edges[1:] + edges[:-1]) / 2
    measure = np.pi * (np.sin(edges[1:]) ** 2 - np.sin(edges[:-1]) ** 2)
    azimuth = (np.arange(AZIMUTHS) + 0.5) * 2 * np.pi / AZIMUTHS
    f, p = scattering(bsdf, 0 * theta, theta, 0 * theta)
    flux = 4 * np.pi * intensity
    once, carried = f * intensity, flux * f / p  # radiance under direct light; flux of a photon
    # Light from angle i to angle o at any vertex: (i, o, azimuth).
    grid = theta[:, None, None], theta[None, :, None], azimuth[None, None, :]
    shape = ANGLES, ANGLES, AZIMUTHS
    seen, _ = (a.reshape(shape) for a in scattering(bsdf, grid[1], grid[0], grid[2]))
    _, sampled = (a.reshape(shape) for a in scattering(bsdf, grid[0], grid[1], grid[2]))
    incident = (once * measure)[:, None]
    twice = np.sum(incident * seen.mean(axis=2), axis=0)
    squares = incident * carried[:, None]
    twice_carried = np.sum(squares * (seen**2 / sampled).mean(axis=2), axis=0)
    second = np.sum(squares * (seen**2).mean(axis=2), axis=0)
    return GlossySphere(measure, f, p, once + twice, once * carried + twice_carried, second)
