"""Emitters seen from both sides: points chosen on them for direct light, and light sub-paths
started from them.

Emitters are chosen by power for light sub-paths, and for direct light by what they bring to the
place (`nearby`). Positional and directional emission densities are ours throughout,
because Mitsuba's `sample_ray` returns a ray's weight without its density, draws its own
wavelengths, and starts the rays of a rotated `envmap` from the wrong disk; textured area lights are
sampled by surface area (by their texture, `path`'s way, they come out wrong where texture
coordinates overlap).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.packing import from_numpy
from ..core.random import next_1d_and_2d, next_2d, next_floats
from ..core.spectra import channel_mean
from ..core.traits import lookup, registry_table
from .emitter_choice import UNIFORM_SHARE, EmitterSelection, powers
from .emitter_media import media_at_emitters, media_beyond_boundaries
from .environment_guide import EnvironmentGuide, infinite_emitters
from .kinds import KINDS, NUMBERS, Samples, is_textured_area, kind_of, textured_mask
from .nearby import NearbyChoice
from .surfaces import LightSurfaces

NEVER_MET = 1e30
"""Density per etendue of light that no camera path can meet."""


def _invariant_key(emitter):
    shape = emitter.get_shape()
    return emitter.class_name(), str(emitter), str(shape.bbox()) if shape is not None else ""


class Lights:
    """All emitters of a scene.

    Parameters: `scene`; `guide`, an `EnvironmentGuide` or None (needed for light sub-paths exactly
    if the scene has infinite emitters); `by_power`: choose emitters by power, or else evenly, as
    Mitsuba does (without a guide the power of infinite emitters says little); `sensor`: around
    whose view emitters are told apart by what they bring (or None: everywhere).
    """

    def __init__(self, scene, plugin="bdpm", guide=None, by_power=True, sensor=None):
        self.scene = scene
        # Mitsuba loads a scene's objects in parallel, in no fixed order; random numbers must not
        # depend on it.
        emitters = list(scene.emitters())
        order = sorted(range(len(emitters)), key=lambda i: _invariant_key(emitters[i]))
        self.emitters = [emitters[i] for i in order]
        self.order = mi.UInt32(order)
        self.guide = guide
        self.has_textured = any(is_textured_area(e) for e in self.emitters)
        self.kinds = [kind_of(e, plugin) for e in self.emitters]
        power = powers(self.emitters, self.kinds, order, guide)
        self.total_power = float(power.sum())
        self._media = None
        if not self.emitters:
            return
        uniform = UNIFORM_SHARE * power.sum() / max(np.count_nonzero(power), 1)
        weights = (1 - UNIFORM_SHARE) * power + uniform * (power > 0) if by_power else power > 0
        self.choice = EmitterSelection(weights)
        self.nearby = None  # how emitters are chosen for direct light, where not as `choice` does
        self.numbers = registry_table(
            self.emitters, mi.EmitterPtr, range(len(self.emitters)), mi.UInt32
        )
        self.kind_table = mi.UInt32([NUMBERS[kind] for kind in self.kinds])
        self.surfaces = LightSurfaces(
            [
                e.get_shape() if kind in ("area", "directionalarea") else None
                for e, kind in zip(self.emitters, self.kinds)
            ]
        )
        known = self.emitters, self.order, self.surfaces, guide
        self._present = {name: kind(*known) for name, kind in KINDS.items() if name in self.kinds}
        if by_power and self.choice.count > 1 and not self.dark:
            self.nearby = NearbyChoice(self, power > 0, sensor)

    @classmethod
    def seen_by(cls, scene, sensor, plugin, guided=True):
        """The lights of a scene; its environments, if any, send their light sub-paths where
        `sensor` will see something of them, unless they are not to be `guided`."""
        seer = sensor if guided else None
        guide = EnvironmentGuide(scene, seer) if infinite_emitters(scene) else None
        return cls(scene, plugin, guide, sensor=sensor)

    def find_media(self, sensor, plugin):
        """Finds the media in which emitters stand, for `medium_at`."""
        beyond = media_beyond_boundaries(self.scene, sensor, plugin)
        found = media_at_emitters(self, beyond, plugin)
        self._media = from_numpy(mi.UInt32, found or [0])

    def medium_at(self, emitter):
        """The medium around emitters, after `find_media`."""
        index = lookup(self.numbers, emitter, mi.UInt32)
        return dr.reinterpret_array(mi.MediumPtr, dr.gather(mi.UInt32, self._media, index))

    @property
    def dark(self):
        """True where no emitter emits anything."""
        return not self.emitters or self.total_power == 0

    def tables(self):
        """Every evaluated array that the sampling routines read, for `dr.freeze` to track."""
        if not self.emitters:
            return []  # an empty array among a recording's arguments aborts the process
        arrays = [self.order, self.numbers, self.kind_table, *self.surfaces.tables()]
        for kind in self._present.values():
            arrays += kind.tables()
        if self._media is not None:
            arrays.append(self._media)
        if self.choice.count > 1:
            arrays += [self.choice._pmf, self.choice._cdf]
        if self.nearby is not None:
            arrays += self.nearby.tables()
        return arrays + (self.guide.tables() if self.guide is not None else [])

    def pointer(self, index):
        """Emitter pointers for an index array (a literal, so that calls need no dispatch, if there
        is one emitter)."""
        if len(self.emitters) == 1:
            return mi.EmitterPtr(self.emitters[0])
        place = dr.gather(mi.UInt32, self.order, index)
        return dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), place)

    # ------------------------------------------------------------------ direct light

    def propose_direct(self, ref, rng, active):
        """Chooses a point on an emitter as seen from interaction `ref`, whatever stands between.

        Returns `(ds, weight, pdf)`: a `DirectionSample3f`, radiance over density (zero where
        nothing can be sampled), and the density per solid angle with the emitter's choice included;
        `ds.delta` marks emitters that no ray can meet.
        """
        if self.choice.count > 1:
            choice, sample = next_1d_and_2d(rng, active)
        else:
            choice, sample = mi.Float(0), next_2d(rng, active)
        if self.nearby is not None:
            index, probability = self.nearby.sample(ref.p, choice)
        else:
            index, probability = self.choice.sample(choice)
        emitter = self.pointer(index)
        textured = active & textured_mask(emitter) if self.has_textured else mi.Bool(False)
        ds, weight = self.sample_emitter(ref, emitter, index, sample, active & ~textured)
        if self.has_textured:
            ds_t, weight_t = self._sample_by_area(ref, emitter, index, sample, textured)
            ds = dr.select(textured, ds_t, ds)
            weight = dr.select(textured, weight_t, weight)
        valid = active & (ds.pdf > 0) & dr.any(weight != 0)
        valid &= dr.isfinite(ds.pdf)
        return ds, dr.select(valid, weight * dr.rcp(probability), 0), ds.pdf * probability

    @property
    def _turns(self):
        """Whether direct light of an environment comes from others than its own sampler, too."""
        return self.guide is not None and self.guide.turns

    def sample_emitter(self, ref, emitter, index, sample, active):
        """`(ds, weight)` of `propose_direct` for an `emitter` and its `index`, from pairs of
        uniform numbers, without the emitter's choice; not for textured area lights."""
        if not self._turns:
            return emitter.sample_direction(ref, sample, active)
        there = active & self._of_kind(index, "environment", active=active)
        counted, turned, towards, good, sample = self.guide.turn(ref.p, sample, there)
        ds, weight = emitter.sample_direction(ref, sample, active)
        ds.d = dr.select(turned, towards, ds.d)
        ds.n = dr.select(turned, mi.Normal3f(-towards), ds.n)
        ds.p = dr.select(turned, ref.p + towards * (2 * self.guide.radius), ds.p)
        ds.dist = dr.select(turned, 2 * self.guide.radius, ds.dist)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ref.p))
        si.wi, si.time, si.wavelengths = -ds.d, ref.time, ref.wavelengths
        own = ds.emitter.pdf_direction(ref, ds, counted)
        ds.pdf = dr.select(counted, self.guide.direct_density(own, ref.p, ds.d, counted), ds.pdf)
        light = ds.emitter.eval(si, counted) * dr.select(
            (good | ~turned) & (ds.pdf > 0), dr.rcp(ds.pdf), 0
        )
        return ds, dr.select(counted, light, weight)

    @staticmethod
    def shadow_ray(ref, ds, infinite):
        """The ray from `ref` to the light of `ds`. Where emitters may be `infinite`, their `ds.p`
        may lie on too small a sphere (see `scene_bounds`), so their ray does not end."""
        shadow = ref.spawn_ray_to(ds.p)
        if infinite:
            far, open_ray = (
                mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite),
                ref.spawn_ray(ds.d),
            )
            shadow = mi.Ray3f(
                dr.select(far, open_ray.o, shadow.o),
                dr.select(far, open_ray.d, shadow.d),
                dr.select(far, open_ray.maxt, shadow.maxt),
                shadow.time,
                shadow.wavelengths,
            )
        return shadow

    def sample_direct(self, ref, rng, active):
        """`propose_direct` with visibility included in the weight (zero where blocked)."""
        ds, weight, pdf = self.propose_direct(ref, rng, active)
        valid = active & dr.any(weight != 0)
        visible = valid & ~self.scene.ray_test(
            self.shadow_ray(ref, ds, self.guide is not None), valid
        )
        return ds, dr.select(visible, weight, 0), pdf

    def unoccluded(self, ref, index, active):
        """Light that emitter `index` would bring to `ref` if nothing stood between, from one fixed
        point on it: `(ds, irradiance)`, a `DirectionSample3f` of that point and the irradiance at a
        surface that faces it, channel mean."""
        ds, weight = self.pointer(index).sample_direction(ref, mi.Point2f(0.5), active)
        value = channel_mean(weight)
        return ds, dr.select(active & dr.isfinite(value), value, 0)

    def pdf_direct(self, ref, ds, active):
        """Density per solid angle with which `sample_direct` finds the emitter point of `ds` from
        `ref`."""
        pdf = self._pdf_of_emitter(ref, ds, active)
        if len(self.emitters) > 1:
            pdf *= self._direct_choice(ref, lookup(self.numbers, ds.emitter, mi.UInt32, active))
        return dr.select(active, pdf, 0)

    def _direct_choice(self, ref, index):
        """Probability of emitter `index` for direct light at `ref`."""
        if self.nearby is not None:
            return self.nearby.probability(ref.p, index)
        return self.choice.probability(index)

    def _pdf_of_emitter(self, ref, ds, active):
        """`pdf_direct` without the emitter's choice."""
        pdf = own = ds.emitter.pdf_direction(ref, ds, active)
        if self.has_textured or self._turns:
            index = lookup(self.numbers, ds.emitter, mi.UInt32, active)
            for kind, chosen in self._lanes_by_kind(index, active):
                pdf = dr.select(chosen, kind.direct(own, ref, ds, index, chosen), pdf)
        return pdf

    def _sample_by_area(self, ref, emitter, index, sample, active):
        ps = self.surfaces.sample(index, ref.time, sample, active)
        ds = mi.DirectionSample3f(ps)
        ds.d = ds.p - ref.p
        distance_squared = dr.squared_norm(ds.d)
        ds.dist = dr.sqrt(distance_squared)
        ds.d *= dr.rcp(ds.dist)
        ds.emitter = emitter
        cosine = -dr.dot(ds.d, ds.n)
        ds.pdf = dr.select(active & (cosine > 0), ps.pdf * distance_squared / cosine, 0)
        si = mi.SurfaceInteraction3f(ps, ref.wavelengths)
        si.wi = si.to_local(-ds.d)
        radiance = emitter.eval(si, active)
        return ds, dr.select(ds.pdf > 0, radiance * dr.rcp(ds.pdf), 0)

    # ------------------------------------------------------------------ light sub-paths

    def sample_emission(self, rng, time, wavelengths):
        """Starts a light sub-path.

        Returns `(ray, flux, unreachable, source)`: the ray, the flux it carries (emitted radiance
        times cosine over all densities, so that its mean over sub-paths is the power that leaves
        the emitters), whether next-event estimation cannot make the light of this ray's first
        vertex, and a `DirectionSample3f` of which the emitter, the point, and the normal and
        texture coordinates there are set.
        """
        index, probability = self.choice.sample(
            rng.next_float32() if self.choice.count > 1 else mi.Float(0)
        )
        emitter = self.pointer(index)
        a, b, c, d = next_floats(rng, 4)
        extra = rng.next_float32() if self.guide is not None else mi.Float(0)
        samples = Samples(mi.Point2f(a, b), mi.Point2f(c, d), extra)
        ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.Float(time), wavelengths)
        flux = mi.Spectrum(0)
        unreachable = mi.Bool(False)
        source = dr.zeros(mi.DirectionSample3f)
        source.emitter = emitter
        for kind, chosen in self._lanes_by_kind(index):
            start = kind.emit(emitter, index, samples, time, wavelengths, chosen)
            ray.o = dr.select(chosen, start.o, ray.o)
            ray.d = dr.select(chosen, start.d, ray.d)
            source.p = dr.select(chosen, start.p, source.p)
            source.n = dr.select(chosen, start.n, source.n)
            source.uv = dr.select(chosen, start.uv, source.uv)
            flux = dr.select(chosen, start.flux, flux)
            if not kind.by_direct_light:
                unreachable |= chosen
        flux *= dr.rcp(probability)
        return ray, dr.select(dr.isfinite(channel_mean(flux)), flux, 0), unreachable, source

    def emission_over_nee_pdf(self, ref, ds, active):
        """How likely a light sub-path brings the light of `ds` to `ref`, over how likely next-event
        estimation does: density of `sample_emission` per unit area across the ray at `ref` times
        its density of the light's point or direction, over the latter's density of `sample_direct`
        [1/m^2]. The choice among emitters is the same for both and cancels. Zero for what
        next-event estimation cannot make."""
        ratio = mi.Float(0)
        index = lookup(self.numbers, ds.emitter, mi.UInt32, active)
        own = self._own_density(ref, ds, active)
        for kind, chosen in self._lanes_by_kind(index, active):
            ratio = dr.select(chosen, kind.over_direct(own, ref, ds, index, chosen), ratio)
        if self.nearby is not None:
            chosen = self.nearby.probability(ref.p, index)
            ratio *= dr.select(chosen > 0, self.choice.probability(index) / chosen, 0)
        return ratio

    # --- starts of light sub-paths, apart from what follows --------------------------------------

    def pdf_emission_origin(self, ref, ds, active):
        """Density with which light sub-paths start from the light's point or direction in `ds`,
        emitter's choice included: per solid angle at `ref` (points of area lights have one per
        area; the geometric term turns it); a probability for lights that no ray can meet."""
        index = lookup(self.numbers, ds.emitter, mi.UInt32, active)
        density, own = mi.Float(1), self._own_density(ref, ds, active)
        for kind, chosen in self._lanes_by_kind(index, active):
            density = dr.select(chosen, kind.origin(own, ds, index, chosen), density)
        return dr.select(active, density * self.choice.probability(index), 0)

    def pdf_emission_area(self, ref, ds, active):
        """Density per unit area across the ray [1/m^2] at `ref` of light sub-paths that have
        started from the point or direction in `ds`."""
        index = lookup(self.numbers, ds.emitter, mi.UInt32, active)
        density = mi.Float(0)
        for kind, chosen in self._lanes_by_kind(index, active):
            density = dr.select(chosen, kind.across(ref, ds, index, chosen), density)
        return density

    def start_density(self, ref, ds, active):
        """Density per etendue [1/(m^2 sr)] with which light sub-paths start from the light's point
        or direction in `ds` towards `ref`: `NEVER_MET` for lights that no ray can meet."""
        met = self.can_be_met(ds.emitter, active)
        density = self.pdf_emission_origin(ref, ds, met) * self.pdf_emission_area(ref, ds, met)
        return dr.select(met, density, NEVER_MET)

    def can_be_met(self, emitter, active):
        """Whether a ray can meet the emitter and see light there."""
        met = [name for name, kind in KINDS.items() if kind.met]
        index = lookup(self.numbers, emitter, mi.UInt32, active)
        return active & self._of_kind(index, *met, active=active)

    def has_unknown_pdf(self, emitter, active):
        """Emitters whose light rays Mitsuba samples without telling their density;
        `pdf_emission_area` is made up."""
        return active & self._of_kind(
            lookup(self.numbers, emitter, mi.UInt32, active), "ray", active=active
        )

    def emitted(self, ref, emitter, p, n, uv, active):
        """Light that reaches `ref` from the start of a light sub-path: the point `p` of an emitter
        (its normal, texture coordinates), or, of an environment, the unit vector `p` towards it;
        unoccluded.

        Returns `(ds, light)`: a `DirectionSample3f` (of infinite emitters `dist` is infinite), and
        radiance, or what lights without extent send per area across the ray.
        """
        index = lookup(self.numbers, emitter, mi.UInt32, active)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(ref.p))
        ds.emitter, ds.p, ds.n, ds.uv = emitter, p, n, uv
        offset = p - ref.p
        ds.dist = dr.sqrt(dr.maximum(dr.squared_norm(offset), 1e-20))
        ds.d = offset * dr.rcp(ds.dist)
        light = mi.Spectrum(0)
        for kind, chosen in self._lanes_by_kind(index, active):
            d, dist, value = kind.arriving(ref, ds, chosen)
            light = dr.select(chosen, value, light)
            ds.d, ds.dist = dr.select(chosen, d, ds.d), dr.select(chosen, dist, ds.dist)
        if self.guide is not None:
            ds.dist = dr.select(
                self._of_kind(index, "environment", "directional", active=active), dr.inf, ds.dist
            )
        return ds, dr.select(dr.isfinite(channel_mean(light)), light, 0)

    def _of_kind(self, index, *names, active=True):
        kind = dr.gather(mi.UInt32, self.kind_table, index, active)
        result = mi.Bool(False)
        for name in names:
            result |= kind == NUMBERS[name]
        return result

    def _own_density(self, ref, ds, active):
        """What emitters themselves tell of the density of `ds`, per solid angle; not asked where no
        ray can meet any."""
        if not any(kind.met for kind in self._present.values()):
            return mi.Float(0)
        return ds.emitter.pdf_direction(ref, ds, active)

    def _lanes_by_kind(self, index, active=True):
        """Each `Kind` that the scene has, with the lanes whose emitter `index` is of it."""
        if len(self._present) == 1:
            (kind,) = self._present.values()
            yield kind, mi.Bool(active)
            return
        kinds = dr.gather(mi.UInt32, self.kind_table, index, active)
        for name, kind in self._present.items():
            yield kind, active & (kinds == NUMBERS[name])
