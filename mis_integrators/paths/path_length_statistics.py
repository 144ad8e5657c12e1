"""How long camera paths are in a scene: what an integrator's time is made of, counted instead of
clocked."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import Store
from ..core.random import next_2d
from ..core.sequences import SampleSequence
from .camera import start_camera_paths
from .roulette import russian_roulette
from .setting import CameraPass

SMOOTH_VERTICES = 4
"""Smooth vertices that are told apart; later ones count with the last."""


@dr.syntax
def count_segments(scene, sensor, seed, stride: int, paths: int, max_depth: int, rr_depth: int):
    """Segments of BSDF-sampled camera paths that end as those of Mitsuba's `path` do: an array
    (`SMOOTH_VERTICES` + 1,), mean over `paths` paths, one through each of the pixels 0, `stride`,
    ...; entry k counts the segments that follow k smooth vertices (the last entry: or more)."""
    sequence = SampleSequence(seed, mi.UInt32(0), 1, False)
    pixel = dr.arange(mi.UInt32, paths) * stride
    camera_pass = CameraPass(sensor, None, sequence, pixel, mi.UInt32(0), mi.Float(0.5))
    _, active, numbers, ray, weight, _, _ = start_camera_paths(camera_pass)
    throughput = mi.Spectrum(weight)
    eta = mi.Float(1)
    depth, vertex = mi.UInt32(0), mi.UInt32(0)
    context = mi.BSDFContext()
    store = Store(counts=dr.zeros(mi.UInt32, SMOOTH_VERTICES + 1))
    if dr.hint(max_depth == 0, mode="scalar"):
        active &= False
    while dr.hint(active, label="census"):
        si = scene.ray_intersect(ray, active)
        dr.scatter_inc(store.counts, dr.minimum(vertex, SMOOTH_VERTICES), active)
        depth += 1
        rng = numbers.at(depth)
        active &= si.is_valid()
        if dr.hint(max_depth > 0, mode="scalar"):
            active &= depth < max_depth
        bs, value = si.bsdf(ray).sample(
            context, si, rng.next_float32(active), next_2d(rng, active), active
        )
        throughput *= value
        eta *= bs.eta
        vertex += dr.select(
            mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), mi.UInt32(0), mi.UInt32(1)
        )
        ray = si.spawn_ray(si.to_world(bs.wo))
        throughput, active = russian_roulette(
            rng, throughput, dr.max(throughput), eta, depth >= rr_depth, active
        )
    return store.counts


def mean_segments(scene, sensor, seed, stride, paths, max_depth, rr_depth):
    """`count_segments` over the number of paths: a NumPy array."""
    return (
        np.array(
            count_segments(
                scene, sensor, dr.opaque(mi.UInt32, seed), stride, paths, max_depth, rr_depth
            ),
            dtype=float,
        )
        / paths
    )
