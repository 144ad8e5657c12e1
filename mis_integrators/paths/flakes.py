"""Media of flakes (`sggx`; Heitz, Dupuy, Crassin and Dachsbacher 2015, The SGGX microflake
distribution).

A medium's flakes are mirrors, whose normals are distributed as those of an ellipsoid. The area that
they show to a direction w is A(w) = sqrt(w' S w), with a symmetric matrix S. Extinction depends on
the direction as A does, and light from w' goes on to w with the density D(h) / (4 A(w')), where h
lies half-way between both. So the phase function is not symmetric, but its product with A is.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def projected_area(here, d, active):
    """A(d), the area of the flakes at `here` (a `MediumInteraction3f`) that is seen from the
    direction `d`, per area of all; 1 in other media."""
    turned = mi.MediumInteraction3f(here)
    turned.wi = d
    return here.medium.phase_function().projected_area(turned, active)


def adjoint_factor(here, to_camera, to_light, active):
    """The phase function of a light sub-path over that of a camera path through the same point, and
    so are their densities: A(to_camera) / A(to_light)."""
    seen, lit = projected_area(here, to_camera, active), projected_area(here, to_light, active)
    return dr.select(active & (lit > 0), seen * dr.rcp(dr.maximum(lit, 1e-30)), 1)


def matrix(here, frame, active):
    """S in the axes of a `frame`, `(xx, yy, zz, xy, xz, yz)`, from the areas that are seen from six
    directions: Mitsuba does not tell it."""

    def squared(d):
        return dr.square(projected_area(here, d, active))

    def mixed(a, b):
        return 0.5 * (squared((a + b) * dr.sqrt(0.5)) - squared((a - b) * dr.sqrt(0.5)))

    x, y, z = frame.s, frame.t, mi.Vector3f(frame.n)
    return squared(x), squared(y), squared(z), mixed(x, y), mixed(x, z), mixed(y, z)


def sample(here, point, active):
    """A direction in which flakes at `here` reflect light from `here.wi`, by a `point` of the unit
    square: `(wo, pdf)`.

    Mitsuba's own sample (3.9.1) has another density than it says, because it transposes the frame
    of `wi`: a volume of flakes under `volpath` is wrong wherever light comes askew. What is drawn
    is a point of the unit sphere's visible half, by its cosine. The map that makes an ellipsoid of
    the sphere makes a visible normal of it (algorithm of the paper's appendix).
    """
    frame = mi.Frame3f(here.wi)
    xx, yy, zz, xy, xz, yz = matrix(here, frame, active)
    determinant = xx * yy * zz - xx * yz * yz - yy * xz * xz - zz * xy * xy + 2 * xy * xz * yz
    root_zz = dr.sqrt(dr.maximum(zz, 1e-20))
    root_minor = dr.sqrt(dr.maximum(yy * zz - yz * yz, 1e-20))
    along_x = mi.Vector3f(dr.safe_sqrt(determinant) / root_minor, 0, 0)
    along_y = mi.Vector3f((xy * zz - xz * yz) / root_minor, root_minor, 0) / root_zz
    along_z = mi.Vector3f(xz, yz, zz) / root_zz
    u = mi.warp.square_to_cosine_hemisphere(point)
    normal = frame.to_world(dr.normalize(u.x * along_x + u.y * along_y + u.z * along_z))
    wo = dr.normalize(2 * dr.dot(normal, here.wi) * normal - here.wi)
    context = mi.PhaseFunctionContext(None)
    return wo, here.medium.phase_function().eval_pdf(context, here, wo, active)[1]
