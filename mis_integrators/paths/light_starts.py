"""Where light sub-paths start: light sub-paths of length one, which camera vertices can be joined
with, and what a second vertex sees of them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def sample_light_starts(lights, sequence, count: int, wavelengths, time):
    """`count` starts of light sub-paths, from a `SampleSequence`: a dictionary of arrays `emitter`,
    `p` (of environments, the unit vector towards it), `n`, `uv`, as `Lights.emitted` takes them."""
    rng = sequence.of_paths(dr.arange(mi.UInt32, count)).at(0)
    ray, _, _, source = lights.sample_emission(rng, time, wavelengths)
    p = source.p + dr.zeros(mi.Point3f, count)
    if "environment" in lights.kinds:
        infinite = mi.has_flag(source.emitter.flags(), mi.EmitterFlags.Infinite)
        p = dr.select(infinite, mi.Point3f(-ray.d), p)
    return {
        "emitter": dr.select(
            dr.full(mi.Bool, True, count), source.emitter, dr.zeros(mi.EmitterPtr)
        ),
        "p": p,
        "n": source.n + dr.zeros(mi.Normal3f, count),
        "uv": source.uv + dr.zeros(mi.Point2f, count),
    }


def read_starts(starts, index, active):
    """The starts at places `index`; zero (a null pointer) on inactive lanes."""
    return {name: dr.gather(type(values), values, index, active) for name, values in starts.items()}


def light_seen_from(si, source, active):
    """The point of a light where a sub-path starts, as `sample_emission` tells of it, as a
    direction sample at the sub-path's first vertex `si`."""
    ds = dr.copy(source)
    ds.d = ds.p - si.p
    ds.dist = dr.norm(ds.d)
    ds.d = dr.select(active, ds.d * dr.rcp(ds.dist), mi.Vector3f(0, 0, 1))
    return ds
