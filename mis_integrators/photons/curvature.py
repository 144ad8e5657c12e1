"""Merge disks on curved surfaces.

A disk as wide as the ball that it touches finds few photons: most of the surface is bent away from
its plane, and beyond the ball there is none. The estimate is too dark then, by any share. So the
radius of a disk is bounded by the surface's radius of curvature.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ..paths.bent_surfaces import derivatives, second_form
from .gather import SAME_SURFACE_COSINE

LEAST_LEFT = 0.25
"""Tuned: share of its radius that a disk keeps, however bent the surface is: smaller ones would
find hardly a photon."""
BENEATH = 1.1
"""Times as far below the tangent plane as the circle is, so that rays from above meet the surface
where it is no circle."""


def most_bent():
    """Radius of a disk over the radius of curvature, at most. On a ball all normals within this
    distance are like those of the disk's centre, and the area there is exactly that of the disk."""
    return math.sqrt(2 * (1 - SAME_SURFACE_COSINE))


def bounded(si, radius):
    """The radius of a merge disk around surface interactions that know how their normals turn
    (`bent_surfaces.FLAGS`): no more than `most_bent` radii of curvature, the least of those along
    the surface's parameters."""
    bent = [
        dr.squared_norm(dn) * dr.rcp(dr.maximum(dr.squared_norm(dp), 1e-30))
        for dp, dn in derivatives(si)
    ]
    curvature = dr.sqrt(dr.maximum(*bent))
    most = most_bent()
    share = most * dr.rcp(dr.maximum(curvature * radius, most))
    return radius * dr.maximum(share, LEAST_LEFT)


class Bend(NamedTuple):
    """How a surface is bent: its second fundamental form in a `frame`. k(a) = ss cos^2 a +
    2 st cos a sin a + tt sin^2 a is the normal curvature along frame.s cos a + frame.t sin a,
    positive where the surface bends away from the side that frame.n points to."""

    frame: mi.Frame3f
    ss: mi.Float
    st: mi.Float
    tt: mi.Float

    def along(self, cosine, sine, distance):
        """Vectors from the surface's point to where it is so far away in the direction a: on a
        circle of curvature k(a), a chord of length d ends k d^2 / 2 below the tangent plane. They
        end `BENEATH` that."""
        k = dr.square(cosine) * self.ss + 2 * cosine * sine * self.st + dr.square(sine) * self.tt
        below = dr.clip((0.5 * BENEATH) * k * distance, -1, 1)
        tangent = cosine * self.frame.s + sine * self.frame.t
        return distance * (dr.safe_sqrt(1 - dr.square(below)) * tangent - below * self.frame.n)


def bend(si, frame):
    """The `Bend` at surface interactions in a `frame`, both as of `second_form`."""
    return Bend(frame, *second_form(si, frame))
