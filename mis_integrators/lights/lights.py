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
from ..core.random import next_1d_and_2d, next_2d, next_floats, streams
from ..core.spectra import channel_mean
from ..core.traits import UnsupportedScene, lookup, registry_table
from .emitter_media import media_at_emitters, media_beyond_boundaries
from .environment_guide import AIMED_SHARE, EnvironmentGuide, direction_cell, infinite_emitters
from .nearby import NearbyChoice

POWER_SAMPLES = 4096
"""Tuned: rays by which the power of a textured emitter is estimated."""
LEAST_POWER = 1e-6
"""Of a textured emitter of which no sample has met light, as a share of the others' power: its
texture may have small bright spots all the same. (By `UNIFORM_SHARE` it is chosen more often.)"""
UNIFORM_SHARE = 0.1
"""Tuned: share of the choices among emitters that ignores power, so that a dim but near emitter is
not starved."""
NEVER_MET = 1e30
"""Density per etendue of light that no camera path can meet."""


def mis_power(pdf_a, pdf_b):
    """Power heuristic weight (beta = 2) of the strategy with density `pdf_a`; zero where both
    vanish (Veach 1997, eq. 9.13)."""
    ratio = dr.minimum(pdf_b / pdf_a, 1e18)  # in ratios: squared densities overflow
    return dr.select(pdf_a > 0, dr.rcp(1 + dr.square(ratio)), 0)


class EmitterSelection:
    """A discrete choice among emitters; free of random numbers and tables where there is one
    emitter only."""

    def __init__(self, weights):
        weights = np.asarray(weights, dtype=np.float64)
        self.count = len(weights)
        total = weights.sum()
        self.pmf = weights / total if total > 0 else np.zeros_like(weights)
        if self.count > 1:
            self._pmf = from_numpy(mi.Float, self.pmf)
            self._cdf = from_numpy(mi.Float, np.cumsum(self.pmf)[:-1])

    def sample(self, u):
        """Index of the chosen emitter and its probability, from uniform numbers `u`."""
        if self.count == 1:
            return mi.UInt32(0), mi.Float(1)
        index = dr.binary_search(
            0, self.count - 1, lambda i: dr.gather(mi.Float, self._cdf, i) <= u
        )
        return index, dr.gather(mi.Float, self._pmf, index)

    def probability(self, index):
        """Probability of `index`."""
        return mi.Float(1) if self.count == 1 else dr.gather(mi.Float, self._pmf, index)


def _is_textured_area(emitter):
    flags = emitter.flags()
    return bool(flags & mi.EmitterFlags.Surface) and bool(flags & mi.EmitterFlags.SpatiallyVarying)


def _mean_power(emitter):
    """Estimated emitted power (channel mean, deterministic), from Mitsuba's own light rays."""
    rng = streams(dr.arange(mi.UInt32, POWER_SAMPLES), mi.UInt32(0x70776572))
    _, weight = emitter.sample_ray(0, rng.next_float32(), next_2d(rng), next_2d(rng))
    value = dr.mean(channel_mean(weight))[0]
    return float(value) if np.isfinite(value) and value > 0 else 0.0


def _may_be_missed(emitter, kind):
    """Whether Mitsuba's light rays may not meet small bright spots of the emitter's texture: they
    start anywhere, or (on rotated spheres, cylinders) not where the texture has told them to."""
    return kind in ("area", "directionalarea", "spot") and bool(
        emitter.flags() & mi.EmitterFlags.SpatiallyVarying
    )


def _with_doubtful(power, may_be_missed):
    """Estimated powers, those that are zero by chance, perhaps, raised to a little."""
    least = LEAST_POWER * power.sum() or LEAST_POWER
    return np.where((power == 0) & np.array(may_be_missed, dtype=bool), least, power)


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
        order = sorted(
            range(len(scene.emitters())), key=lambda i: _invariant_key(scene.emitters()[i])
        )
        self.emitters = [scene.emitters()[i] for i in order]
        self.order = mi.UInt32(order)
        self.guide = guide
        self.has_textured = any(_is_textured_area(e) for e in self.emitters)
        self.kinds = [self._kind(e, plugin) for e in self.emitters]
        power = np.array([_mean_power(e) for e in self.emitters])
        if guide is not None:
            power = guide.useful_power(power[np.argsort(order)])[order]
        power = _with_doubtful(
            power, [_may_be_missed(e, kind) for e, kind in zip(self.emitters, self.kinds)]
        )
        self.total_power = float(power.sum())
        if not self.emitters:
            return
        uniform = UNIFORM_SHARE * power.sum() / max(np.count_nonzero(power), 1)
        weights = (1 - UNIFORM_SHARE) * power + uniform * (power > 0) if by_power else power > 0
        self.choice = EmitterSelection(weights)
        self.nearby = None  # how emitters are chosen for direct light, where not as `choice` does
        self.numbers = registry_table(
            self.emitters, mi.EmitterPtr, range(len(self.emitters)), mi.UInt32
        )
        self.kind_table = mi.UInt32([_KINDS.index(k) for k in self.kinds])
        self._spot_tables(self.emitters)
        self._surface_tables(self.emitters)
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
        arrays = [
            getattr(self, name)
            for name in (
                "order",
                "numbers",
                "kind_table",
                "_spot_axis",
                "_spot_cosine",
                "_surface_area",
                "_surface_number",
                "_sphere_center",
                "_sphere_sign",
                "_media",
            )
            if hasattr(self, name)
        ]
        if self.choice.count > 1:
            arrays += [self.choice._pmf, self.choice._cdf]
        if self.nearby is not None:
            arrays += self.nearby.tables()
        return arrays + (self.guide.tables() if self.guide is not None else [])

    @staticmethod
    def _kind(emitter, plugin):
        name = emitter.class_name()
        kind = {
            "PointLight": "point",
            "SpotLight": "spot",
            "DirectionalEmitter": "directional",
            "AreaLight": "area",
            "DirectionalArea": "directionalarea",
        }.get(name)
        if kind is None:
            kind = "environment" if emitter.is_environment() else "ray"
        if kind in ("ray", "directionalarea") and mi.is_spectral:
            raise UnsupportedScene(
                f"{plugin}: emitter {name} is not supported in spectral variants (its light rays "
                "choose "
                "their own wavelengths); use an rgb or mono variant"
            )
        return kind

    def _spot_tables(self, emitters):
        axes, cosines = [], []
        for emitter, kind in zip(emitters, self.kinds):
            axis, cosine = [0, 0, 1], -1.0
            if kind == "spot":
                params = mi.traverse(emitter)
                matrix = np.array(params["to_world"].matrix).reshape(4, 4)
                axis = matrix[:3, :3] @ np.array([0, 0, 1.0])
                axis = axis / np.linalg.norm(axis)
                cosine = np.cos(np.radians(float(np.array(params["cutoff_angle"]).ravel()[0])))
            axes.append(axis)
            cosines.append(cosine)
        if "spot" in self.kinds:
            self._spot_axis = from_numpy(mi.Float, np.ravel(axes))
            self._spot_cosine = mi.Float(cosines)

    def _surface_tables(self, emitters):
        shapes = [
            e.get_shape() if kind in ("area", "directionalarea") else None
            for e, kind in zip(emitters, self.kinds)
        ]
        self._surfaces = [s for s in shapes if s is not None]
        if self._surfaces:
            number = np.cumsum([s is not None for s in shapes]) - 1
            self._surface_number = from_numpy(mi.UInt32, np.maximum(number, 0))
            self._surface_area = from_numpy(
                mi.Float,
                [
                    float(np.array(s.surface_area()).ravel()[0]) if s is not None else 1.0
                    for s in shapes
                ],
            )
        spheres = [s is not None and s.class_name() == "Sphere" for s in shapes]
        self._has_spheres = any(spheres)
        if self._has_spheres:
            centers = [
                np.array(s.bbox().center()).ravel() if sphere else np.zeros(3)
                for s, sphere in zip(shapes, spheres)
            ]
            signs = [
                (-1.0 if s.has_flipped_normals() else 1.0) if sphere else 0.0
                for s, sphere in zip(shapes, spheres)
            ]
            self._sphere_center = from_numpy(mi.Float, np.ravel(centers))
            self._sphere_sign = mi.Float(signs)

    def _area(self, index, active):
        """Surface area of area light `index`."""
        return dr.gather(mi.Float, self._surface_area, index, active)

    def _sample_surface(self, index, time, sample, active):
        """A uniformly distributed point on area light `index`. Mitsuba's sampling of a rotated
        sphere forgets to rotate the normal.

        A virtual call would ask every shape of the process, and instances, curves and others have
        no points to give."""

        def sampler(shape):
            return lambda time, sample, active: shape.sample_position(time, sample, active)

        if len(self._surfaces) == 1:
            ps = sampler(self._surfaces[0])(mi.Float(time), sample, active)
        else:
            number = dr.gather(mi.UInt32, self._surface_number, index, active)
            ps = dr.switch(
                number, [sampler(shape) for shape in self._surfaces], mi.Float(time), sample, active
            )
        if self._has_spheres:
            sign = dr.gather(mi.Float, self._sphere_sign, index, active)
            center = dr.gather(mi.Point3f, self._sphere_center, index, active)
            ps.n = dr.select(sign != 0, mi.Normal3f(dr.normalize(ps.p - center) * sign), ps.n)
        return ps

    def _scene_index(self, index):
        return dr.gather(mi.UInt32, self.order, index)

    def pointer(self, index):
        """Emitter pointers for an index array (a literal, so that calls need no dispatch, if there
        is one emitter)."""
        if len(self.emitters) == 1:
            return mi.EmitterPtr(self.emitters[0])
        return dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), self._scene_index(index))

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
        textured = active & self._textured_mask(emitter) if self.has_textured else mi.Bool(False)
        if self._aims:
            aims = (
                active
                & self._of_kind(index, "environment", active=active)
                & self.guide.portals.near(ref.p)
            )
            aimed = aims & (sample.x < AIMED_SHARE)
            left = dr.select(
                aimed, sample.x / AIMED_SHARE, (sample.x - AIMED_SHARE) / (1 - AIMED_SHARE)
            )
            sample.x = dr.select(aims, left, sample.x)
        ds, weight = emitter.sample_direction(ref, sample, active & ~textured)
        if self._aims:
            ds, weight = self._aim(ref, ds, weight, sample, aims, aimed)
        if self.has_textured:
            ds_t, weight_t = self._sample_by_area(ref, emitter, index, sample, textured)
            ds = dr.select(textured, ds_t, ds)
            weight = dr.select(textured, weight_t, weight)
        valid = active & (ds.pdf > 0) & dr.any(weight != 0)
        valid &= dr.isfinite(ds.pdf)
        return ds, dr.select(valid, weight * dr.rcp(probability), 0), ds.pdf * probability

    @property
    def _aims(self):
        """Whether direct light of an environment is looked for where it enters."""
        return self.guide is not None and self.guide.aims

    def _aim(self, ref, ds, weight, sample, aims, aimed):
        """`(ds, weight)` of `propose_direct` with the lanes `aimed` turned towards the entrances,
        and the lanes `aims`, among which they are, counted by the density of both ways together."""
        towards, good = self.guide.portals.sample_direction(ref.p, sample, aimed)
        ds.d = dr.select(aimed, towards, ds.d)
        ds.n = dr.select(aimed, mi.Normal3f(-towards), ds.n)
        ds.p = dr.select(aimed, ref.p + towards * (2 * self.guide.radius), ds.p)
        ds.dist = dr.select(aimed, 2 * self.guide.radius, ds.dist)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ref.p))
        si.wi, si.time, si.wavelengths = -ds.d, ref.time, ref.wavelengths
        ds.pdf = dr.select(
            aims,
            self.guide.direct_density(ds.emitter.pdf_direction(ref, ds, aims), ref.p, ds.d, aims),
            ds.pdf,
        )
        light = ds.emitter.eval(si, aims) * dr.select(
            (good | ~aimed) & (ds.pdf > 0), dr.rcp(ds.pdf), 0
        )
        return ds, dr.select(aims, light, weight)

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
        emitter = ds.emitter
        pdf = emitter.pdf_direction(ref, ds, active)
        if self.has_textured:
            textured = active & self._textured_mask(emitter)
            by_area = dr.square(ds.dist) / (
                dr.abs_dot(ds.d, ds.n)
                * self._area(lookup(self.numbers, emitter, mi.UInt32, textured), textured)
            )
            pdf = dr.select(textured, dr.select(dr.dot(ds.d, ds.n) < 0, by_area, 0), pdf)
        if self._aims:
            sky = active & self._of_kind(
                lookup(self.numbers, emitter, mi.UInt32, active), "environment", active=active
            )
            pdf = dr.select(sky, self.guide.direct_density(pdf, ref.p, ds.d, sky), pdf)
        return pdf

    @staticmethod
    def _textured_mask(emitter):
        flags = emitter.flags()
        return mi.has_flag(flags, mi.EmitterFlags.Surface) & mi.has_flag(
            flags, mi.EmitterFlags.SpatiallyVarying
        )

    def _sample_by_area(self, ref, emitter, index, sample, active):
        ps = self._sample_surface(index, ref.time, sample, active)
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
        sample_a, sample_b = mi.Point2f(a, b), mi.Point2f(c, d)
        extra = rng.next_float32() if self.guide is not None else mi.Float(0)
        kind = (
            mi.UInt32(_KINDS.index(self.kinds[0]))
            if len(self.emitters) == 1
            else dr.gather(mi.UInt32, self.kind_table, index)
        )
        ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1), mi.Float(time), wavelengths)
        flux = mi.Spectrum(0)
        unreachable = mi.Bool(False)
        source = dr.zeros(mi.DirectionSample3f)
        source.emitter = emitter
        for number, name in enumerate(_KINDS):
            if name not in self.kinds:
                continue
            chosen = kind == number
            o, d, value, *surface = getattr(self, "_emit_" + name)(
                emitter, index, sample_a, sample_b, extra, time, wavelengths, chosen
            )
            ray.o = dr.select(chosen, o, ray.o)
            ray.d = dr.select(chosen, d, ray.d)
            p, n, uv = surface or (o, mi.Normal3f(0), mi.Point2f(0))
            source.p, source.n, source.uv = (
                dr.select(chosen, p, source.p),
                dr.select(chosen, n, source.n),
                dr.select(chosen, uv, source.uv),
            )
            flux = dr.select(chosen, value, flux)
            if name == "directionalarea":
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
        kind = dr.gather(mi.UInt32, self.kind_table, index, active)
        for number, name in enumerate(_KINDS):
            if name in self.kinds and name != "directionalarea":
                chosen = active & (kind == number)
                ratio = dr.select(
                    chosen, getattr(self, "_ratio_" + name)(ref, ds, index, chosen), ratio
                )
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
        density = mi.Float(1)
        if "area" in self.kinds or "directionalarea" in self.kinds:
            on_surface = active & self._of_kind(index, "area", "directionalarea", active=active)
            area = dr.select(on_surface, self._area(index, on_surface), 1)
            cosine = dr.maximum(-dr.dot(ds.d, ds.n), 1e-6)
            density = dr.select(on_surface, dr.square(ds.dist) * dr.rcp(area * cosine), density)
        if "environment" in self.kinds:
            sky = active & self._of_kind(index, "environment", active=active)
            own = ds.emitter.pdf_direction(ref, ds, sky)
            density = dr.select(sky, self.guide.direction_density(own, ds.d, sky), density)
        return dr.select(active, density * self.choice.probability(index), 0)

    def pdf_emission_area(self, ref, ds, active):
        """Density per unit area across the ray [1/m^2] at `ref` of light sub-paths that have
        started from the point or direction in `ds`."""
        index = lookup(self.numbers, ds.emitter, mi.UInt32, active)
        density = mi.Float(0)
        for name in set(self.kinds) - {"directionalarea"}:
            chosen = active & self._of_kind(index, name, active=active)
            if name == "area":
                value = dr.maximum(-dr.dot(ds.d, ds.n), 0) * dr.rcp(dr.pi * dr.square(ds.dist))
            elif name == "environment":
                row = self.guide.row_of_emitter(self._scene_index(index)) + direction_cell(ds.d)
                value = self.guide.position_density(ds.d, row, ref.p, chosen)
            else:
                value = getattr(self, "_ratio_" + name)(ref, ds, index, chosen)
            density = dr.select(chosen, value, density)
        return density

    def start_density(self, ref, ds, active):
        """Density per etendue [1/(m^2 sr)] with which light sub-paths start from the light's point
        or direction in `ds` towards `ref`: `NEVER_MET` for lights that no ray can meet."""
        met = self.can_be_met(ds.emitter, active)
        density = self.pdf_emission_origin(ref, ds, met) * self.pdf_emission_area(ref, ds, met)
        return dr.select(met, density, NEVER_MET)

    def can_be_met(self, emitter, active):
        """Whether a ray can meet the emitter and see light there."""
        return active & self._of_kind(
            lookup(self.numbers, emitter, mi.UInt32, active), "area", "environment", active=active
        )

    def has_unknown_pdf(self, emitter, active):
        """Emitters whose light rays Mitsuba samples without telling their density;
        `pdf_emission_area` is made up."""
        return active & self._of_kind(
            lookup(self.numbers, emitter, mi.UInt32, active), "ray", active=active
        )

    def _of_kind(self, index, *names, active=True):
        kind = dr.gather(mi.UInt32, self.kind_table, index, active)
        result = mi.Bool(False)
        for name in names:
            result |= kind == _KINDS.index(name)
        return result

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
        for name in set(self.kinds) - {"directionalarea"}:
            chosen = active & self._of_kind(index, name, active=active)
            if name in ("area", "environment"):
                si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ref.p))
                si.p, si.n, si.uv, si.time, si.wavelengths = p, n, uv, ref.time, ref.wavelengths
                si.sh_frame = mi.Frame3f(n)
                if name == "environment":
                    ds.d = dr.select(chosen, mi.Vector3f(p), ds.d)
                si.wi = si.to_local(-ds.d) if name == "area" else -ds.d
                light = dr.select(chosen, emitter.eval(si, chosen), light)
            else:
                sampled, value = emitter.sample_direction(ref, mi.Point2f(0.5), chosen)
                light = dr.select(chosen, value, light)
                ds.d, ds.dist = (
                    dr.select(chosen, sampled.d, ds.d),
                    dr.select(chosen, sampled.dist, ds.dist),
                )
        if self.guide is not None:
            ds.dist = dr.select(
                self._of_kind(index, "environment", "directional", active=active), dr.inf, ds.dist
            )
        return ds, dr.select(dr.isfinite(channel_mean(light)), light, 0)

    @staticmethod
    def _ratio_point(ref, ds, index, active):
        return dr.rcp(4 * dr.pi * dr.square(ds.dist))

    def _ratio_spot(self, ref, ds, index, active):
        cosine = dr.gather(mi.Float, self._spot_cosine, index, active)
        return mi.warp.square_to_uniform_cone_pdf(mi.Vector3f(0, 0, 1), cosine) * dr.rcp(
            dr.square(ds.dist)
        )

    def _ratio_directional(self, ref, ds, index, active):
        return self.guide.position_density(
            ds.d, self.guide.row_of_emitter(self._scene_index(index)), ref.p, active
        )

    def _ratio_environment(self, ref, ds, index, active):
        own_pdf = ds.emitter.pdf_direction(ref, ds, active)
        row = self.guide.row_of_emitter(self._scene_index(index)) + direction_cell(ds.d)
        density = self.guide.direction_density(own_pdf, ds.d, active) * self.guide.position_density(
            ds.d, row, ref.p, active
        )
        direct = self.guide.direct_density(own_pdf, ref.p, ds.d, active)
        return dr.select(direct > 0, density * dr.rcp(direct), 0)

    def _ratio_area(self, ref, ds, index, active):
        pdf = self._pdf_of_emitter(ref, ds, active) * (dr.pi * self._area(index, active))
        return dr.select(pdf > 0, dr.rcp(pdf), 0)

    def _ratio_ray(self, ref, ds, index, active):
        return self._ratio_point(
            ref, ds, index, active
        )  # Mitsuba does not tell: as if it shone evenly all around

    @staticmethod
    def _reference(p, time, wavelengths):
        it = dr.zeros(mi.Interaction3f)
        it.p = p
        it.time = mi.Float(time)
        it.wavelengths = wavelengths
        return it

    def _intensity(self, emitter, position, d, time, wavelengths, active):
        """Radiant intensity of a positional emitter into direction `d`: next-event estimation from
        distance one."""
        ds, value = emitter.sample_direction(
            self._reference(position + d, time, wavelengths), mi.Point2f(0.5), active
        )
        return value * dr.square(ds.dist)

    def _position(self, emitter, time, wavelengths, active):
        return emitter.sample_direction(
            self._reference(mi.Point3f(0), time, wavelengths), mi.Point2f(0.5), active
        )[0].p

    def _emit_point(self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active):
        position = self._position(emitter, time, wavelengths, active)
        d = mi.warp.square_to_uniform_sphere(sample_a)
        return (
            position,
            d,
            self._intensity(emitter, position, d, time, wavelengths, active) * (4 * dr.pi),
        )

    def _emit_spot(self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active):
        axis = dr.gather(mi.Vector3f, self._spot_axis, index, active)
        cosine = dr.gather(mi.Float, self._spot_cosine, index, active)
        position = self._position(emitter, time, wavelengths, active)
        d = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(sample_a, cosine))
        pdf = mi.warp.square_to_uniform_cone_pdf(mi.Vector3f(0, 0, 1), cosine)
        return (
            position,
            d,
            self._intensity(emitter, position, d, time, wavelengths, active) * dr.rcp(pdf),
        )

    def _emit_directional(
        self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active
    ):
        it = self._reference(self.guide.center, time, wavelengths)
        ds, irradiance = emitter.sample_direction(it, mi.Point2f(0.5), active)
        row = self.guide.row_of_emitter(self._scene_index(index))
        o, pdf = self.guide.sample_position(ds.d, row, sample_a, sample_b, extra, active)
        return o, -ds.d, irradiance * dr.rcp(pdf)

    def _emit_environment(
        self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active
    ):
        it = self._reference(self.guide.center, time, wavelengths)
        towards, pdf_direction, row, extra = self.guide.sample_direction(
            emitter, self._scene_index(index), it, sample_a, extra, active
        )
        o, pdf_position = self.guide.sample_position(towards, row, sample_b, None, extra, active)
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -towards
        si.time = mi.Float(time)
        si.wavelengths = wavelengths
        radiance = emitter.eval(si, active)
        return (
            o,
            -towards,
            radiance * dr.select(pdf_direction > 0, dr.rcp(pdf_direction * pdf_position), 0),
        )

    def _emit_area(self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active):
        ps = self._sample_surface(index, time, sample_a, active)
        si = mi.SurfaceInteraction3f(ps, wavelengths)
        si.wi = mi.warp.square_to_cosine_hemisphere(sample_b)
        radiance = emitter.eval(si, active)
        ray = si.spawn_ray(si.to_world(si.wi))
        return (
            ray.o,
            ray.d,
            radiance * dr.select(ps.pdf > 0, dr.pi * dr.rcp(ps.pdf), 0),
            ps.p,
            ps.n,
            ps.uv,
        )

    def _emit_directionalarea(
        self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active
    ):
        return self._emit_ray(emitter, index, sample_a, sample_b, extra, time, wavelengths, active)

    def _emit_ray(self, emitter, index, sample_a, sample_b, extra, time, wavelengths, active):
        ray, weight = emitter.sample_ray(mi.Float(time), mi.Float(0.5), sample_a, sample_b, active)
        return ray.o, ray.d, weight


_KINDS = ("point", "spot", "directional", "area", "directionalarea", "environment", "ray")
