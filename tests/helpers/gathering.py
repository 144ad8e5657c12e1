"""Vertices that gather photons, made by hand."""

import drjit as dr
import mitsuba as mi


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
