"""How much surface a merge disk really covers.

Near a wall, or where a floor ends, part of the disk around a vertex holds no surface on which
photons could land, and density estimation over the whole disk comes out dark: a bias that falls
only in proportion to the radius, while that of curvature falls with its square. A few short probe
rays estimate the covered share of the disk, by which the estimate is divided. Surfaces that stop a
probe on its way are walls, behind which photons must be seen (`disk_walls`).
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ..core.random import vertex_streams
from ..paths.bent_surfaces import FLAGS
from .curvature import LEAST_LEFT, bend, bounded
from .disk_walls import Coverage, DiskWalls, with_wall
from .gather import SAME_SURFACE_COSINE, within_disk

PROBES = 8
"""Tuned: probe rays of a merge disk."""
HEIGHT = 0.25
"""Tuned: probes start this share of the radius above the vertex, or halfway to what is closer."""
SMALLEST_SHARE = 0.4
"""Tuned: right at a wall half of the disk is left. Smaller estimates come from clutter that the
probes meet as often as from corners, and would brighten more than they mend. (With 0.25 pilots
expect next to no blur, and take disks twice as wide.)"""
FURTHEST = 3.0
"""Distance of what a probe hits from the vertex, in radii, beyond which it stands for nothing."""
SLACK = 1.01
"""Radius of probes over that of the disk: they may end right at its rim."""
SOONER = 0.999
"""Share of the way to its place, before which a probe that has hit something else was stopped."""
OWN_STREAM = 0x70726F62
"""Keeps the probes' random numbers apart from those of the camera paths, which share their seed."""
LITTLE = 0.3
"""Tuned: share of a merge disk, less of which is little: two probes of eight."""


class Edges(NamedTuple):
    """What tells camera paths where merge disks are of no use: at legs, leaves, rims and corners.

    `radius`: of the disks, which are smaller where surfaces are bent; 0: they are of use
    everywhere. `seed`: of the probes' random numbers.
    """

    radius: mi.Float
    seed: mi.UInt32

    def at(self, scene, arrival, active):
        """The `Coverage` where camera paths have arrived (a `CameraArrival`), the whole elsewhere;
        and whether that is little, or the surface more bent than any disk."""
        active = active & (self.radius > 0)
        si = arrival.hit.compute_surface_interaction(arrival.ray, FLAGS, active)
        radius = bounded(si, self.radius)
        too_bent = active & (radius <= LEAST_LEFT * self.radius)
        vertices = {"ray_d": arrival.ray.d, "path": arrival.path, "depth": arrival.depth}
        share, walls = probed(scene, vertices, si, radius, self.seed, active)
        return usable(share, walls, active), too_bent | (active & (share < LITTLE))


def coverage(scene, vertices, si, radius, seed, active):
    """The `Coverage` of merge disks: what is `probed`, made `usable`."""
    return usable(*probed(scene, vertices, si, radius, seed, active), active)


def usable(share, walls, active):
    """The `Coverage` by which estimates can be divided: shares are `SMALLEST_SHARE` at least, and
    one elsewhere."""
    return Coverage(dr.select(active, dr.maximum(share, SMALLEST_SHARE), 1), walls)


@dr.syntax
def probed(scene, vertices, si, radius, seed, active):
    """Estimated share of the disk of `radius` around each vertex that lies on surface seen from
    just above the vertex and like its own (same tests as for photons), and the `DiskWalls` there.
    Where the surface is curved, so is the disk. `vertices` as of `read_queries`, `si` their surface
    interactions, found with `bent_surfaces.FLAGS`; width as theirs.

    A probe that slips past its place in the disk lands further out, on a step down, say, whose
    photons count. So it stands for the point of that height right above or below its place."""
    normal = mi.Vector3f(dr.mulsign(si.n, -dr.dot(si.n, vertices["ray_d"])))
    bent = bend(si, mi.Frame3f(normal))
    rng = vertex_streams(vertices["path"], vertices["depth"], seed ^ OWN_STREAM)
    turn, shift = rng.next_float32() * dr.two_pi, rng.next_float32()
    above = mi.Ray3f(si.spawn_ray(normal))
    above.maxt = 2 * HEIGHT * radius
    height = 0.5 * dr.minimum(
        scene.ray_intersect_preliminary(above, coherent=False, active=active).t, above.maxt
    )
    start = si.p + normal * height
    # Probes of the outer half of the disk come first, a quarter turn apart: where they all find
    # surface there is no edge, and the others are not made.
    outer = PROBES // 2
    covered, probe = mi.UInt32(0), mi.UInt32(0)
    near, far = mi.Vector3f(0), mi.Vector3f(0)
    while dr.hint(active & (probe < PROBES), label="coverage probes"):
        distance = radius * dr.sqrt((mi.Float(PROBES - 1 - probe) + shift) * (1 / PROBES))
        sine, cosine = dr.sincos(
            turn + dr.two_pi / outer * (mi.Float(probe) + dr.select(probe < outer, 0, 0.5))
        )
        place = bent.along(cosine, sine, distance)
        towards = place - height * normal
        hit = scene.ray_intersect(
            mi.Ray3f(start, dr.normalize(towards)),
            mi.RayFlags.Minimal,
            coherent=False,
            reorder=False,
            active=active,
        )
        offset = hit.p - si.p
        place += normal * dr.dot(offset - place, normal)
        same = (
            hit.is_valid()
            & (dr.squared_norm(offset) < dr.square(FURTHEST * radius))
            & (dr.dot(hit.n, si.n) > SAME_SURFACE_COSINE)
            & within_disk(place, dr.squared_norm(place), normal, radius * SLACK)
        )
        covered += dr.select(same, 1, 0)
        stopped = hit.is_valid() & ~same & (hit.t < SOONER * dr.norm(towards))
        near, far = with_wall(near, far, si.p, hit, start, radius, stopped)
        probe += 1
        if (probe == outer) & (covered == outer):
            covered = mi.UInt32(PROBES)
            probe = mi.UInt32(PROBES)
    return mi.Float(covered) * (1 / PROBES), DiskWalls(near, far, height)
