"""Photons, and vertices that gather them, made by hand."""

from mis_integrators.core.packing import pack_direction, pack_surface

import drjit as dr
import mitsuba as mi
import numpy as np


def photons_of(points, flux, up=(0, 0, 1), caustic=True):
    """Photons at `points` (n, 3) of a floor, straight from above: `(surface, power, count)`.
    `flux`: (n,), or (n, 3) where it has a colour."""
    from mis_integrators.photons.photon import new_photons, power_layout, surface_layout

    points, flux = (np.asarray(values, np.float32) for values in (points, flux))
    surface, power = new_photons(len(points))
    index, up = dr.arange(mi.UInt32, len(points)), mi.Vector3f(*up)
    p = mi.Point3f(points.T.copy())
    word = dr.zeros(mi.UInt32, len(points)) + pack_surface(up, mi.UInt32(2), mi.Bool(caustic))
    surface_layout().write(surface, {"p": p, "surface": word}, index)
    towards = dr.zeros(mi.UInt32, len(points)) + pack_direction(up)
    flux = mi.Spectrum(flux.T.copy() if flux.ndim > 1 else mi.Float(flux))
    power_layout().write(power, {"flux": flux, "towards": towards}, index)
    return surface, power, mi.UInt32([len(points)])


def vertices_at(scene, ray, count):
    """`QueryVertices` of paths that come along these rays, so many, and carry one."""
    from mis_integrators.core.traits import SceneTraits
    from mis_integrators.photons.gather import QueryVertices

    record = {
        "ray_o": ray.o,
        "ray_d": ray.d,
        "hit": scene.ray_intersect_preliminary(ray),
        "throughput": mi.Spectrum(dr.ones(mi.Float, count)),
        "depth": dr.ones(mi.UInt32, count),
        "path": dr.arange(mi.UInt32, count),
    }
    return QueryVertices(SceneTraits(scene, None), record, [])
