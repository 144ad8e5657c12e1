"""How surfaces are bent: the derivatives of position and normal, and the curvatures."""

import drjit as dr
import mitsuba as mi

SAME_NORMAL = 1e-4
"""Normals that differ by less are the same, but for rounding."""
FLAGS = mi.RayFlags.All | mi.RayFlags.dNSdUV
"""What is found out about the surface at a vertex: how its normals turn, too."""


def may_magnify(scene):
    """Whether a perfectly specular surface may be bent. Flat are disks, and meshes each triangle of
    which has one normal."""

    def is_flat(shape):
        if not shape.is_mesh():
            return shape.class_name() == "Disk"
        if not shape.has_vertex_normals():
            return True
        corners = shape.face_indices(dr.arange(mi.UInt32, shape.face_count()))
        first, *others = [shape.vertex_normal(corner) for corner in corners]
        return all(dr.all(dr.norm(first - other) < SAME_NORMAL)[0] for other in others)

    def is_specular(shape):
        flags = 0 if shape.bsdf() is None else shape.bsdf().flags()
        return mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) or mi.has_flag(
            flags, mi.BSDFFlags.DeltaTransmission
        )

    return any(
        shape.class_name() == "Instance" or (is_specular(shape) and not is_flat(shape))
        for shape in scene.shapes()
    )


def derivatives(si):
    """Of position and normal, pairs, by each of two parameters of the surface.

    The normals of Mitsuba's meshes are derived by barycentric coordinates, as if they were not
    flipped, and their positions by coordinates of textures: here these are edges of the triangle,
    too. An instance of a mesh counts as flat, for its edges are not known in the world.
    """
    mesh = si.shape.is_mesh() & si.is_valid()
    here = mesh & (si.instance == dr.zeros(mi.ShapePtr))
    triangle = mi.MeshPtr(si.shape)
    corners = [
        triangle.vertex_position(index, here)
        for index in triangle.face_indices(si.prim_index, here)
    ]
    edges = [corner - corners[0] for corner in corners[1:]]
    flipped = here & (dr.dot(dr.cross(*edges), si.n) < 0)
    sign = dr.select(flipped, -1, dr.select(mesh & ~here, 0, 1))
    given = ((si.dp_du, si.dn_du), (si.dp_dv, si.dn_dv))
    return [(dr.select(here, edge, dp), sign * dn) for edge, (dp, dn) in zip(edges, given)]


def curvatures(si, towards):
    """Both principal curvatures of a surface that knows how its normals turn (`RayFlags.dNSdUV`),
    positive where it is convex as seen from `towards`; zero where its parameters are degenerate."""
    (pu, nu), (pv, nv) = derivatives(si)
    uu, uv, vv = dr.dot(pu, pu), dr.dot(pu, pv), dr.dot(pv, pv)
    turn_uu, turn_vv = dr.dot(pu, nu), dr.dot(pv, nv)
    turn_uv = 0.5 * (dr.dot(pu, nv) + dr.dot(pv, nu))
    area = uu * vv - dr.square(uv)
    inverse = dr.select(area > 0, dr.rcp(area), 0)
    mean = 0.5 * inverse * (turn_uu * vv - 2 * turn_uv * uv + turn_vv * uu)
    gaussian = inverse * (turn_uu * turn_vv - dr.square(turn_uv))
    apart = dr.safe_sqrt(dr.square(mean) - gaussian)
    facing = dr.sign(dr.dot(si.n, towards))
    return facing * (mean + apart), facing * (mean - apart)
