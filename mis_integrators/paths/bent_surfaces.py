"""How surfaces are bent: the second fundamental form, and the curvatures."""

import drjit as dr
import mitsuba as mi

from ..core.traits import is_specular, used_shapes

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

    return any(
        shape.bsdf() is not None and is_specular(shape.bsdf()) and not is_flat(shape)
        for shape in used_shapes(scene)
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


def second_form(si, frame):
    """The second fundamental form (ss, st, tt) in a `frame` whose normal is that of the surface, or
    its opposite: positive where the surface bends away from the side that the frame's normal points
    to. `si` knows how normals turn (`FLAGS`); zero where its parameters are degenerate (do Carmo,
    Differential Geometry of Curves and Surfaces, sections 3.2 and 3.3)."""
    (dp_du, dn_du), (dp_dv, dn_dv) = derivatives(si)
    uu, uv, vv = dr.squared_norm(dp_du), dr.dot(dp_du, dp_dv), dr.squared_norm(dp_dv)
    determinant = uu * vv - dr.square(uv)
    scale = dr.select(determinant > 0, dr.rcp(determinant), 0)

    def turn(tangent):
        u, v = dr.dot(tangent, dp_du), dr.dot(tangent, dp_dv)
        return ((vv * u - uv * v) * dn_du + (uu * v - uv * u) * dn_dv) * scale

    by_s, by_t = turn(frame.s), turn(frame.t)
    forms = (
        dr.dot(frame.s, by_s),
        0.5 * (dr.dot(frame.s, by_t) + dr.dot(frame.t, by_s)),
        dr.dot(frame.t, by_t),
    )
    side = dr.dot(frame.n, si.sh_frame.n)  # derivatives are those of the shading normal
    return [dr.mulsign(form, side) for form in forms]


def curvatures(si, towards):
    """Both principal curvatures, positive where the surface is convex as seen from `towards`;
    `si` as of `second_form`."""
    n = dr.mulsign(si.n, dr.dot(si.n, towards))
    ss, st, tt = second_form(si, mi.Frame3f(n))
    mean, apart = 0.5 * (ss + tt), dr.sqrt(dr.square(0.5 * (ss - tt)) + dr.square(st))
    return mean + apart, mean - apart
