"""Kinds of emitters: how light sub-paths start on each, and with which densities.

A kind is a class, which `KINDS` names. `Lights` asks each kind that the scene has for the lanes
whose emitter is of that kind.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.traits import UnsupportedScene
from .environment_guide import direction_cell


class Start(NamedTuple):
    """Where a light sub-path starts. On emitters without a surface `n` and `uv` are zero."""

    o: mi.Point3f
    d: mi.Vector3f
    flux: mi.Spectrum
    """Emitted radiance times cosine over all densities but that of the choice among emitters."""
    p: mi.Point3f
    n: mi.Normal3f
    uv: mi.Point2f


class Samples(NamedTuple):
    """The uniform numbers of a start."""

    a: mi.Point2f
    b: mi.Point2f
    extra: mi.Float
    """Zero where no emitter is infinitely far away."""


def _from_no_surface(o, d, flux):
    return Start(o, d, flux, o, mi.Normal3f(0), mi.Point2f(0))


class Kind:
    """What is common to all kinds.

    Of the scene: its `emitters`, those of all kinds, and their places in its own list, `order`; the
    `LightSurfaces` of area lights; the `EnvironmentGuide`, or None. In the methods `index` is each
    lane's emitter, `ref` is where light arrives, `ds` the direction to the light's point, or to the
    light, from there, and `own` the density of `ds` that the emitter itself tells, per solid angle.
    """

    met = False
    """Whether a ray can meet such emitters and see light there."""
    by_direct_light = True
    """Whether next-event estimation finds their light."""

    def __init__(self, emitters, order, surfaces, guide):
        self.emitters, self.order, self.surfaces, self.guide = emitters, order, surfaces, guide

    def _row(self, index):
        """The guide's row of an infinite emitter."""
        return self.guide.row_of_emitter(dr.gather(mi.UInt32, self.order, index))

    def tables(self):
        """The evaluated arrays that are read here."""
        return []

    def emit(self, emitter, index, samples, time, wavelengths, active):
        """A `Start`, by `Samples`."""
        raise TypeError(f"{type(self).__name__} does not define emit")

    def direct(self, own, ref, ds, index, active):
        """Density of next-event estimation per solid angle at `ref`."""
        return own

    def across(self, ref, ds, index, active):
        """Density of light sub-paths per unit area across the ray at `ref` [1/m^2], once the
        light's point or direction is given."""
        raise TypeError(f"{type(self).__name__} does not define across")

    def origin(self, own, ds, index, active):
        """Density with which `emit` chooses the light's point or direction, per solid angle at
        `ref`; a probability for lights that no ray can meet."""
        return mi.Float(1)

    def over_direct(self, own, ref, ds, index, active):
        """`across` times `origin` over `direct` [1/m^2] (over one where no ray can meet the
        light)."""
        return self.across(ref, ds, index, active)

    def arriving(self, ref, ds, active):
        """Light that reaches `ref` from the start `ds` if nothing stands between: its direction,
        the light's distance, and radiance, or what lights without extent send per area across the
        ray."""
        sampled, light = ds.emitter.sample_direction(ref, mi.Point2f(0.5), active)
        return sampled.d, sampled.dist, light


class Point(Kind):
    """Shines around from a point."""

    def emit(self, emitter, index, samples, time, wavelengths, active):
        position = _position(emitter, time, wavelengths, active)
        d = mi.warp.square_to_uniform_sphere(samples.a)
        flux = _intensity(emitter, position, d, time, wavelengths, active) * (4 * dr.pi)
        return _from_no_surface(position, d, flux)

    def across(self, ref, ds, index, active):
        return dr.rcp(4 * dr.pi * dr.square(ds.dist))


class Spot(Kind):
    """Shines into a cone from a point."""

    def __init__(self, emitters, *others):
        super().__init__(emitters, *others)
        axes, cosines = [], []
        for emitter in emitters:
            axis, cosine = [0, 0, 1], -1.0
            if _BY_CLASS.get(emitter.class_name()) == "spot":
                params = mi.traverse(emitter)
                matrix = np.array(params["to_world"].matrix).reshape(4, 4)
                axis = matrix[:3, :3] @ np.array([0, 0, 1.0])
                axis = axis / np.linalg.norm(axis)
                cosine = np.cos(np.radians(float(np.array(params["cutoff_angle"]).ravel()[0])))
            axes.append(axis)
            cosines.append(cosine)
        self._axis = from_numpy(mi.Float, np.ravel(axes))
        self._cosine = mi.Float(cosines)

    def tables(self):
        return [self._axis, self._cosine]

    def _per_solid_angle(self, index, active):
        cosine = dr.gather(mi.Float, self._cosine, index, active)
        return mi.warp.square_to_uniform_cone_pdf(mi.Vector3f(0, 0, 1), cosine)

    def emit(self, emitter, index, samples, time, wavelengths, active):
        axis = dr.gather(mi.Vector3f, self._axis, index, active)
        cosine = dr.gather(mi.Float, self._cosine, index, active)
        position = _position(emitter, time, wavelengths, active)
        d = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(samples.a, cosine))
        flux = _intensity(emitter, position, d, time, wavelengths, active)
        return _from_no_surface(position, d, flux * dr.rcp(self._per_solid_angle(index, active)))

    def across(self, ref, ds, index, active):
        return self._per_solid_angle(index, active) * dr.rcp(dr.square(ds.dist))


class Directional(Kind):
    """Shines from one direction, infinitely far away."""

    def emit(self, emitter, index, samples, time, wavelengths, active):
        it = _reference(self.guide.center, time, wavelengths)
        ds, irradiance = emitter.sample_direction(it, mi.Point2f(0.5), active)
        o, pdf = self.guide.sample_position(
            ds.d, self._row(index), samples.a, samples.b, samples.extra, active
        )
        return _from_no_surface(o, -ds.d, irradiance * dr.rcp(pdf))

    def across(self, ref, ds, index, active):
        return self.guide.position_density(ds.d, self._row(index), ref.p, active)


class Area(Kind):
    """Shines from a surface, all around."""

    met = True

    def emit(self, emitter, index, samples, time, wavelengths, active):
        ps = self.surfaces.sample(index, time, samples.a, active)
        si = mi.SurfaceInteraction3f(ps, wavelengths)
        si.wi = mi.warp.square_to_cosine_hemisphere(samples.b)
        radiance = emitter.eval(si, active)
        ray = si.spawn_ray(si.to_world(si.wi))
        flux = radiance * dr.select(ps.pdf > 0, dr.pi * dr.rcp(ps.pdf), 0)
        return Start(ray.o, ray.d, flux, ps.p, ps.n, ps.uv)

    def __init__(self, emitters, *others):
        super().__init__(emitters, *others)
        self.has_textured = any(is_textured_area(emitter) for emitter in emitters)

    def direct(self, own, ref, ds, index, active):
        """By surface area for textured ones (`Lights.propose_direct`)."""
        if not self.has_textured:
            return own
        textured = active & textured_mask(ds.emitter)
        area = self.surfaces.area(index, textured)
        by_area = dr.square(ds.dist) / (dr.abs_dot(ds.d, ds.n) * area)
        return dr.select(textured, dr.select(dr.dot(ds.d, ds.n) < 0, by_area, 0), own)

    def across(self, ref, ds, index, active):
        return dr.maximum(-dr.dot(ds.d, ds.n), 0) * dr.rcp(dr.pi * dr.square(ds.dist))

    def origin(self, own, ds, index, active):
        area = dr.select(active, self.surfaces.area(index, active), 1)
        cosine = dr.maximum(-dr.dot(ds.d, ds.n), 1e-6)
        return dr.square(ds.dist) * dr.rcp(area * cosine)

    def over_direct(self, own, ref, ds, index, active):
        """The cosine and the distance cancel."""
        area = self.surfaces.area(index, active)
        pdf = self.direct(own, ref, ds, index, active) * (dr.pi * area)
        return dr.select(pdf > 0, dr.rcp(pdf), 0)

    def arriving(self, ref, ds, active):
        si = _seen(ref, ds)
        si.wi = si.to_local(-ds.d)
        return ds.d, ds.dist, ds.emitter.eval(si, active)


class DirectionalArea(Area):
    """Shines from a surface, along its normals only: light sub-paths alone find that."""

    met = by_direct_light = False

    def emit(self, emitter, index, samples, time, wavelengths, active):
        return _emit_by_mitsuba(emitter, samples, time, active)

    def across(self, ref, ds, index, active):
        return mi.Float(0)

    def over_direct(self, own, ref, ds, index, active):
        return mi.Float(0)

    def arriving(self, ref, ds, active):
        return ds.d, ds.dist, mi.Spectrum(0)


class Environment(Kind):
    """Shines from all directions, infinitely far away. As the start of a light sub-path `ds.p` is
    the unit vector towards it."""

    met = True

    def emit(self, emitter, index, samples, time, wavelengths, active):
        guide, number = self.guide, dr.gather(mi.UInt32, self.order, index)
        it = _reference(guide.center, time, wavelengths)
        towards, pdf_direction, row, extra = guide.sample_direction(
            emitter, number, it, samples.a, samples.extra, active
        )
        o, pdf_position = guide.sample_position(towards, row, samples.b, None, extra, active)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -towards
        si.time = mi.Float(time)
        si.wavelengths = wavelengths
        flux = emitter.eval(si, active) * dr.select(
            pdf_direction > 0, dr.rcp(pdf_direction * pdf_position), 0
        )
        return _from_no_surface(o, -towards, flux)

    def direct(self, own, ref, ds, index, active):
        return self.guide.direct_density(own, ref.p, ds.d, active)

    def across(self, ref, ds, index, active):
        row = self._row(index) + direction_cell(ds.d)
        return self.guide.position_density(ds.d, row, ref.p, active)

    def origin(self, own, ds, index, active):
        return self.guide.direction_density(own, ds.d, active)

    def over_direct(self, own, ref, ds, index, active):
        density = self.origin(own, ds, index, active) * self.across(ref, ds, index, active)
        direct = self.direct(own, ref, ds, index, active)
        return dr.select(direct > 0, density * dr.rcp(direct), 0)

    def arriving(self, ref, ds, active):
        si, d = _seen(ref, ds), mi.Vector3f(ds.p)
        si.wi = -d
        return d, ds.dist, ds.emitter.eval(si, active)


class Ray(Point):
    """All others, whose light rays Mitsuba samples without telling their density: it is made up, as
    if they shone evenly all around."""

    def emit(self, emitter, index, samples, time, wavelengths, active):
        return _emit_by_mitsuba(emitter, samples, time, active)


KINDS = {
    "point": Point,
    "spot": Spot,
    "directional": Directional,
    "area": Area,
    "directionalarea": DirectionalArea,
    "environment": Environment,
    "ray": Ray,
}
NUMBERS = {name: number for number, name in enumerate(KINDS)}
"""By which tables name kinds."""
_BY_CLASS = {
    "PointLight": "point",
    "SpotLight": "spot",
    "DirectionalEmitter": "directional",
    "AreaLight": "area",
    "DirectionalArea": "directionalarea",
}


def kind_of(emitter, plugin):
    """The name of an emitter's kind. Raises `UnsupportedScene` for those that cannot be used in
    this variant."""
    name = emitter.class_name()
    kind = _BY_CLASS.get(name) or ("environment" if emitter.is_environment() else "ray")
    if kind in ("ray", "directionalarea") and mi.is_spectral:
        raise UnsupportedScene(
            f"{plugin}: emitter {name} is not supported in spectral variants (its light rays "
            "choose their own wavelengths); use an rgb or mono variant"
        )
    return kind


def is_textured_area(emitter):
    """Whether the emitter shines from a surface with a texture."""
    flags = emitter.flags()
    return bool(flags & mi.EmitterFlags.Surface) and bool(flags & mi.EmitterFlags.SpatiallyVarying)


def textured_mask(emitter):
    """`is_textured_area` of emitters, an array."""
    flags = emitter.flags()
    return mi.has_flag(flags, mi.EmitterFlags.Surface) & mi.has_flag(
        flags, mi.EmitterFlags.SpatiallyVarying
    )


def _emit_by_mitsuba(emitter, samples, time, active):
    ray, flux = emitter.sample_ray(mi.Float(time), mi.Float(0.5), samples.a, samples.b, active)
    return _from_no_surface(ray.o, ray.d, flux)


def _reference(p, time, wavelengths):
    it = dr.zeros(mi.Interaction3f)
    it.p = p
    it.time = mi.Float(time)
    it.wavelengths = wavelengths
    return it


def _seen(ref, ds):
    """The light's point of `ds`, to be looked at from `ref`."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ref.p))
    si.p, si.n, si.uv, si.time, si.wavelengths = ds.p, ds.n, ds.uv, ref.time, ref.wavelengths
    si.sh_frame = mi.Frame3f(ds.n)
    return si


def _position(emitter, time, wavelengths, active):
    """Of an emitter that is a point."""
    it = _reference(mi.Point3f(0), time, wavelengths)
    return emitter.sample_direction(it, mi.Point2f(0.5), active)[0].p


def _intensity(emitter, position, d, time, wavelengths, active):
    """Radiant intensity of an emitter that is a point into direction `d`: next-event estimation
    from distance one."""
    it = _reference(position + d, time, wavelengths)
    ds, value = emitter.sample_direction(it, mi.Point2f(0.5), active)
    return value * dr.square(ds.dist)
