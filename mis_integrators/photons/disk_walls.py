"""Walls that stand in merge disks, and the photons behind them.

Where a floor goes on behind a wall, the photons out there lie on the same plane as those in here,
and may be a thousand times as bright. A photon behind a wall counts only if it is seen from where
the probes of the disk start (`coverage`), as the covered share counts only surface that is. One of
those behind a vertex' walls is tested in place of all, drawn in proportion to what they bring: the
mean over the channels is expected to be that of a shadow ray to each. (Its channels, and classes of
light, share the one test.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ..core.recording import lanes
from ..core.records import Layout
from ..core.spectra import channel_mean

BEHIND = 1 + 1e-3
"""Distance of photons that are behind a wall, over that of the wall."""
SHADOW_END = 1 - 1e-3
"""Share of the way to a photon at which shadow rays end."""
CLOSEST = 1e-4
"""Least distance of walls, in radii of the disk."""
ALIKE = 0.7
"""Tuned: cosine between walls, more of which makes them one."""


@dataclass
class DiskWalls:
    """The two nearest walls of merge disks that do not face alike.

    `near`, `far`: minus the wall's normal over the distance to its plane, so that offsets from the
    vertex whose product with it is above one are behind; zero: none. `height`: of the place above
    the vertex from which photons must be seen.
    """

    near: mi.Vector3f
    far: mi.Vector3f
    height: mi.Float

    def behind(self, offset):
        """Whether places, `offset` from the vertices, are behind a wall."""
        furthest = dr.maximum(dr.dot(offset, self.near), dr.dot(offset, self.far))
        return furthest > BEHIND


class Coverage(NamedTuple):
    """Of merge disks: the covered `share`, by which estimates are divided, and the `DiskWalls`."""

    share: mi.Float
    walls: DiskWalls


def coverage_layout():
    """Fields of a vertex' coverage: the `bare` share of its disk, and the walls. Zero: none."""
    return Layout({"near": mi.Vector3f, "bare": mi.Float, "far": mi.Vector3f, "height": mi.Float})


def read_coverage(words):
    """The `Coverage` of all vertices of a buffer."""
    layout = coverage_layout()
    record = layout.read(words, lanes(layout.capacity(words)))
    walls = DiskWalls(record["near"], record["far"], record["height"])
    return Coverage(1 - record["bare"], walls)


def with_wall(near, far, p, hit, start, radius, active):
    """The two nearest walls (as of `DiskWalls`) around vertices at `p` with disks of a `radius`:
    `near` and `far`, and what a ray from `start` has `hit` where it is `active`."""
    normal = dr.mulsign(hit.n, dr.dot(hit.n, start - hit.p))
    distance = dr.dot(normal, p - hit.p)
    active = active & (distance > -CLOSEST * radius)
    wall = -normal / dr.maximum(distance, CLOSEST * radius)
    nearness = dr.norm(wall)
    alike = dr.dot(normal, near) < -ALIKE * dr.norm(near)
    first = active & (nearness > dr.norm(near))
    second = active & ~first & ~alike & (nearness > dr.norm(far))
    far = dr.select(first & ~alike, near, dr.select(second, wall, far))
    return dr.select(first, wall, near), far


@dataclass
class Hidden:
    """Photons within one radius that must be seen: the one that is tested in place of all, at an
    `offset` from the vertex, has the least `key` of them. They are independent exponential numbers
    whose rates are what the photons bring (Efraimidis and Spirakis 2006, Weighted random sampling
    with a reservoir): whatever the order, each has the least one in proportion to that. Infinite:
    there are none."""

    key: mi.Float
    offset: mi.Vector3f

    @staticmethod
    def none():
        """Before the first of them."""
        return Hidden(mi.Float(dr.inf), mi.Vector3f(0))

    def add(self, p, path, value, offset, active):
        """These with the `value` of a photon at `p` more; `path`: the number of the camera path."""
        key = -dr.log(1 - _uniform(p, path)) / channel_mean(value)
        least = active & (key < self.key)
        return Hidden(dr.select(least, key, self.key), dr.select(least, offset, self.offset))

    def seen(self, scene, vertices, walls):
        """Whether the one is seen."""
        start = vertices.p + dr.mulsign(vertices.n, vertices.side) * walls.height
        towards = vertices.p + self.offset - start
        distance = dr.norm(towards)
        ray = mi.Ray3f(start, towards / dr.maximum(distance, 1e-30))
        ray.maxt = distance * SHADOW_END
        return ~scene.ray_test(ray, coherent=False, active=vertices.active & (self.key < dr.inf))


def _uniform(p, path):
    """A number in [0, 1) for each camera path and photon at `p`, not for its place in a map, which
    chance decides."""
    x, y, z = (dr.reinterpret_array(mi.UInt32, place) for place in p)
    word = (x * 0x9E3779B1) ^ (y * 0x85EBCA77) ^ (z * 0xC2B2AE3D) ^ (path * 0x27D4EB2F)
    word = (word ^ (word >> 15)) * 0x2C1B3C6D
    word = (word ^ (word >> 12)) * 0x297A2D39
    return mi.Float((word ^ (word >> 15)) >> 8) * 2**-24
