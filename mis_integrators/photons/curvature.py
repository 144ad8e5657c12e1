"""Merge disks on curved surfaces.

A disk as wide as the ball that it touches finds few photons: most of the surface is bent away from
its plane, and beyond the ball there is none. The estimate is too dark then, by any share. So the
radius of a disk is bounded by the surface's radius of curvature.
"""

from __future__ import annotations

import math

import drjit as dr

from .gather import SAME_SURFACE_COSINE

LEAST_LEFT = 0.25
"""Tuned: share of its radius that a disk keeps, however bent the surface is: smaller ones would
find hardly a photon."""


def most_bent():
    """Radius of a disk over the radius of curvature, at most. On a ball all normals within this
    distance are like those of the disk's centre, and the area there is exactly that of the disk."""
    return math.sqrt(2 * (1 - SAME_SURFACE_COSINE))


def bounded(si, radius):
    """The radius of a merge disk around surface interactions that know how their normals turn
    (`gather.FLAGS`): no more than `most_bent` radii of curvature, the least of those along the
    surface's parameters."""
    bent = [
        dr.squared_norm(dn) * dr.rcp(dr.maximum(dr.squared_norm(dp), 1e-30))
        for dn, dp in ((si.dn_du, si.dp_du), (si.dn_dv, si.dp_dv))
    ]
    curvature = dr.sqrt(dr.maximum(*bent))
    most = most_bent()
    share = most * dr.rcp(dr.maximum(curvature * radius, most))
    return radius * dr.maximum(share, LEAST_LEFT)
