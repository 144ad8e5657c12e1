"""Techniques nearer to the camera than the one at hand, summed up along the steps that vertices of
camera sub-paths remember (`paths.camera_vertices`), for weights that know of resampling."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from ..paths.camera_vertices import STEP
from ..paths.subpaths import NO_PARENT, vertex_layout
from ..weights.bidirectional import LARGEST_RATIO, SMALLEST_DENSITY


@dataclass(frozen=True)
class LightEnd:
    """What the light's side of a joint path is at the camera's last vertex, or at the light that it
    met.

    `p_made` [1/m^2]: the density with which the light's side makes that; `strength`: flux, over the
    density of that; `scattered`, `back`: BSDF there, and density per projected solid angle with
    which the light's side goes on to the parent; `segments`: of the joint path; `kernels`: as of
    `kernels_of_vertex` or `kernels_of_light`; `eta` [m^2]: as of `weights.eta_at` (zero at lights).
    """

    p_made: mi.Float
    strength: mi.Float
    scattered: mi.Float
    back: mi.Float
    segments: mi.UInt32
    kernels: list[mi.Float] = field(default_factory=list)
    eta: mi.Float | float = 0.0


@dr.syntax
def sum_before(vertices, step, parent, end: LightEnd, weights, active):
    """Sum over the techniques nearer to the camera than the one at hand, of their samples times
    densities, over the density of the latter.

    `step`, `parent`: those of the vertex, or hit, at the camera's end. `weights.gain(r, row, s,
    active)`: what resampling makes of the technique that joins a light sub-path of s vertices,
    which sends r = q*/p (`weights.sent`), to a vertex of that row. Joining to the sensor (the last
    step, without a parent) has the gain one. With `weights.merging` each vertex may also be merged
    with light sub-paths that end there, `weights.eta_at` [m^2] times as likely as it is made.
    """
    names, merges = (*STEP, *weights.kernels), weights.merging is not None
    count = len(weights.kernels)
    layout = vertex_layout(names)
    d_vcm, geometry, forward, back_there, scattered_there, row = (
        mi.Float(step[name]) for name in STEP
    )
    kernels = [mi.Float(kernel) for kernel in end.kernels]
    kernels_there = [mi.Float(step[name]) for name in weights.kernels]
    parent = mi.UInt32(parent)
    # What the loop reads must be plain variables: Dr.Jit would take a dataclass for its state.
    segments = end.segments
    ratio = mi.Float(end.p_made)
    strength = mi.Float(end.strength)
    scattered, back = mi.Float(end.scattered), mi.Float(end.back)
    active = mi.Bool(active)
    total, eta = mi.Float(0), mi.Float(end.eta)
    while dr.hint(active, label="techniques"):
        joined = parent != NO_PARENT
        depth = layout.read(vertices["words"], parent, active & joined, ("depth",))["depth"]
        sent = weights.sent(strength, scattered * geometry, kernels)
        better = weights.gain(sent, mi.UInt32(row), segments - depth, active & joined)
        here = d_vcm * dr.select(joined, better, 1)
        if dr.hint(merges, mode="scalar"):
            here += eta
        total = dr.select(active, total + ratio * here, total)
        ratio *= back * dr.rcp(dr.maximum(forward, SMALLEST_DENSITY))
        ratio = dr.minimum(ratio, LARGEST_RATIO)
        strength *= scattered * dr.rcp(dr.maximum(back, SMALLEST_DENSITY))
        strength = dr.minimum(strength, LARGEST_RATIO)
        back, scattered = mi.Float(back_there), mi.Float(scattered_there)
        active &= joined & (ratio > 0)
        record = layout.read(vertices["words"], parent, active, names)
        if dr.hint(merges, mode="scalar"):
            there = layout.read(vertices["words"], parent, active, ("n", "density"))
            eta = mi.Float(weights.eta_at(there))
        for number in dr.hint(range(count), mode="scalar"):
            kernels[number] = mi.Float(kernels_there[number])
            kernels_there[number] = record[names[number - count]]
        d_vcm, geometry, forward = record["d_vcm"], record["geometry"], record["forward"]
        back_there, scattered_there, row = record["back"], record["scattered"], record["row"]
        parent = dr.gather(mi.UInt32, vertices["parent"], parent, active)
    return total
