"""What a scene needs, found once before rendering: nothing that it lacks is traced, stored or
gathered."""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi
import numpy as np

from .untrusted import shown


class UnsupportedScene(ValueError):
    """A scene that an integrator cannot render; the message names the integrator and the reason."""


def children(parent, kind):
    """Objects of a class that `parent` holds itself, in its order."""

    class Collector(mi.TraversalCallback):  # of the active variant
        def __init__(self):
            super().__init__()
            self.found = []  # not of the class, which lives on until garbage is collected

        def put(self, name, value, *flags):
            if isinstance(value, kind):
                self.found.append(value)

    collector = Collector()
    parent.traverse(collector)
    return collector.found


def scene_objects(root):
    """Every Mitsuba object below `root` (shapes, nested BSDFs, emitters, media, films, ...), each
    once."""
    pending, seen = [root], {}
    while pending:
        for child in children(pending.pop(), mi.Object):
            if child.ptr not in seen:
                seen[child.ptr] = child
                pending.append(child)
    return list(seen.values())


def is_specular(bsdf):
    """Whether a BSDF reflects or refracts into single directions. (What only lets light pass does
    not.)"""
    flag = mi.BSDFFlags
    return bool(int(bsdf.flags()) & (int(flag.DeltaReflection) | int(flag.DeltaTransmission)))


def used_shapes(scene):
    """Every shape of a scene, those of shape groups and what Mitsuba's loader has merged them into
    among them, each once."""
    shapes = [o for o in scene_objects(scene) if isinstance(o, mi.Shape)] + list(scene.shapes())
    return list({shape.ptr: shape for shape in shapes}.values())


def used_bsdfs(scene):
    """Every BSDF that some shape (of a shape group, too) carries, nested ones included, each
    once."""
    shapes = used_shapes(scene)
    below = {o.ptr: o for shape in shapes for o in scene_objects(shape) if isinstance(o, mi.BSDF)}
    own = {shape.bsdf().ptr: shape.bsdf() for shape in shapes if shape.bsdf() is not None}
    return list({**below, **own}.values())


def registry_table(objects, pointer_type, values, dtype):
    """A table indexed by Dr.Jit's registry number of `objects`, holding `values`; entry 0 (null
    pointer) is zero."""
    numbers = [int(dr.reinterpret_array(mi.UInt32, pointer_type(o))[0]) for o in objects]
    table = np.zeros(max(numbers, default=0) + 1)
    table[numbers] = values
    return dtype(table != 0) if dtype is mi.Bool else dtype(table)


def lookup(table, pointer, dtype, active=True):
    """Reads a `registry_table` at an array of pointers."""
    return dr.gather(dtype, table, dr.reinterpret_array(mi.UInt32, pointer), active)


def is_lambertian(bsdf):
    """Whether the BSDF's smooth part is constant (one value on each side of the surface) in the
    unperturbed frame."""
    name = bsdf.class_name()
    if name == "SmoothDiffuse":
        return True
    if name in ("TwoSidedBRDF", "MaskBSDF", "BlendBSDF"):
        return all(
            is_lambertian(child) or not (child.flags() & mi.BSDFFlags.Smooth)
            for child in scene_objects(bsdf)
            if isinstance(child, mi.BSDF)
        )
    return False


def scene_bounds(scene):
    """Bounding box of the scene's shapes (`mi.ScalarBoundingBox3f`).

    Not `scene.bbox()`: Mitsuba's loader merges shapes into meshes whose boxes it forgets to
    compute.
    """
    box = mi.ScalarBoundingBox3f()
    for shape in scene.shapes():
        if isinstance(shape, mi.Mesh):
            points = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
            if len(points):
                box.expand(mi.ScalarPoint3f([float(x) for x in points.min(axis=0)]))
                box.expand(mi.ScalarPoint3f([float(x) for x in points.max(axis=0)]))
        else:
            box.expand(shape.bbox())
    if not box.valid():
        box.expand(mi.ScalarPoint3f(-1, -1, -1))
        box.expand(mi.ScalarPoint3f(1, 1, 1))
    return box


def unfinite_data(scene):
    """Descriptions, a line each, of data of the scene that hold values which are not finite: of
    emitters, textures, BSDFs, media, volumes and shapes. Each says where the data are (as
    `mi.traverse` names them, from the id on, or from the class where there is none), whose they
    are, and how many such values there are."""
    kinds = mi.Emitter, mi.Texture, mi.BSDF, mi.Medium, mi.Volume, mi.PhaseFunction, mi.Shape
    parameters = mi.traverse(scene)
    data = {
        name: (owner, value)
        for name, (_, _, owner, _) in parameters.properties.items()
        if isinstance(owner, kinds) and (value := _value(parameters, name)) is not None
    }
    dr.eval([value for _, value in data.values()])  # at once: each by itself would be a kernel
    found = []
    for name, (owner, value) in data.items():
        values = np.array(value)
        if values.dtype.kind == "f" and (
            count := values.size - np.count_nonzero(np.isfinite(values))
        ):
            outermost = owner
            while parameters.hierarchy[outermost][1] > 1:
                outermost = parameters.hierarchy[outermost][0]
            place = re.sub(
                r"^object_\d+", outermost.class_name(), name
            )  # an address, where there is no id
            found.append(
                f"{shown(place)} of {owner.class_name()} has {count} of {values.size} values "
                "that are not finite"
            )
    return found


def _value(parameters, name):
    """A scene parameter; ``None`` where it was not given, as `sigma_a` of the BSDF ``hair``. (There
    Mitsuba's own access raises.)"""
    try:
        return parameters[name]
    except TypeError:
        return None


class SceneTraits:
    """What a scene is made of.

    Attributes: `bounds` (bounding box), `extent` (its diagonal), `has_delta` (perfectly specular or
    null scattering somewhere; in scenes with media as of `MediaTraits`), `has_mixed` (BSDFs with
    both a smooth and a delta part), `has_rough` (smooth scattering that is not Lambertian),
    `has_lambertian`, `has_perturbed` (bump or normal maps), `has_light_surfaces` (emitters that a
    ray can meet: area lights, environments), `has_unmet_lights` (emitters that no ray can meet:
    points, spots, directions), `has_unsampled_lights` (emitters whose light no connection can make
    either: `directionalarea`), `lambertian`, `perturbed` (registry tables for BSDF pointers),
    `has_media`, and with media those of `MediaTraits`.
    """

    def __init__(self, scene, sensor=None):
        self.bounds = scene_bounds(scene)
        self.extent = float(dr.norm(self.bounds.extents()))
        flag = mi.BSDFFlags
        bsdfs = used_bsdfs(scene)
        flags = [b.flags() for b in bsdfs]
        lambertian = [is_lambertian(b) for b in bsdfs]
        self.has_delta = any(f & flag.Delta for f in flags)
        self.has_mixed = any((f & flag.Delta) and (f & flag.Smooth) for f in flags)
        self.has_lambertian = any(lambertian)
        perturbed = [
            any(b.class_name() in ("BumpMap", "NormalMap") for b in (bsdf, *scene_objects(bsdf)))
            for bsdf in bsdfs
        ]
        self.has_perturbed = any(perturbed)
        self.perturbed = registry_table(bsdfs, mi.BSDFPtr, perturbed, mi.Bool)
        # Nested BSDFs count on their own, so a perturbed (bump- or normal-mapped) Lambertian shows
        # through its wrapper.
        self.has_rough = any(
            (f & flag.Smooth) and not simple for f, simple in zip(flags, lambertian)
        )
        self.lambertian = registry_table(bsdfs, mi.BSDFPtr, lambertian, mi.Bool)
        delta = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
        lights = [e.flags() for e in scene.emitters()]
        unmet = [bool(f & delta) for f in lights]
        self.has_light_surfaces, self.has_unmet_lights = not all(unmet), any(unmet)
        self.has_unsampled_lights = any(
            f & mi.EmitterFlags.Surface and f & mi.EmitterFlags.DeltaDirection for f in lights
        )
        self.has_media = has_media(scene, sensor)
        if self.has_media:
            self.__dict__.update(MediaTraits(scene, [sensor] if sensor else []).__dict__)


class MediaTraits:
    """What a scene with media needs besides.

    Attributes: `media` (a list of all), `has_grids` (media that are not homogeneous),
    `has_delta` (specular scattering somewhere: boundaries that let light pass are none),
    `has_null_media` (media in which collisions may be null: grids, and media whose extinction
    depends on the channel), `has_flakes` (media whose extinction depends on the direction, and
    whose phase functions are not symmetric), `has_null_vertices` (BSDFs that scatter and let part
    of the light pass straight on), `boundary_flags` (what must be known of surfaces that only let
    light pass).
    """

    def __init__(self, scene, sensors):
        flag = mi.BSDFFlags
        others = (int(flag.Delta) | int(flag.Smooth)) & ~int(flag.Null)
        bsdfs = used_bsdfs(scene)
        flags = [int(bsdf.flags()) for bsdf in bsdfs]
        self.has_null_vertices = any(f & int(flag.Null) and f & others for f in flags)
        # Where all boundaries are plain, neither textures nor shading frames matter there.
        self.boundary_flags = mi.RayFlags.All if self.has_null_vertices else mi.RayFlags.Minimal
        self.has_delta = any(map(is_specular, bsdfs))
        self.media = all_media(scene, sensors)
        self.has_grids = any(not m.is_homogeneous() for m in self.media)
        self.has_null_media = self.has_grids or any(_is_coloured(m) for m in self.media)
        self.has_flakes = any(
            m.phase_function().flags() & mi.PhaseFunctionFlags.Microflake for m in self.media
        )


def all_media(scene, sensors=()):
    """The media of a scene and its `sensors`, each once."""
    found = [o for root in (scene, *sensors) for o in scene_objects(root)]
    found += [sensor.get_medium() for sensor in sensors]
    return list({o.ptr: o for o in found if isinstance(o, mi.Medium)}.values())


def _is_coloured(medium):
    """Whether a homogeneous medium's extinction depends on the channel or wavelength."""
    if mi.is_spectral:
        return True
    somewhere = dr.zeros(mi.MediumInteraction3f)
    somewhere.wi = mi.Vector3f(0, 0, 1)
    _, _, sigma_t = medium.get_scattering_coefficients(somewhere)
    return bool((dr.max(sigma_t) > dr.min(sigma_t))[0])


def check_variant(scene, plugin):
    """Raises `UnsupportedScene` if `scene` belongs to another variant than the active one."""
    if not isinstance(scene, mi.Scene):
        raise UnsupportedScene(
            f"{plugin}: the scene was loaded under another variant than the active one "
            f"({mi.variant()}); load it again after mi.set_variant()"
        )


def has_media(scene, sensor=None):
    """Whether there are participating media in the scene, or around the `sensor`."""
    return bool(all_media(scene, [sensor] if sensor else [])) or any(
        s.is_medium_transition() for s in scene.shapes()
    )


def check_media(scene, sensors, plugin):
    """Raises `UnsupportedScene` for phase functions with flakes that are hidden in others: Mitsuba
    (3.9.1) then leaves extinction as if there were none."""
    for medium in all_media(scene, sensors):
        phase = medium.phase_function()
        flakes = phase.flags() & mi.PhaseFunctionFlags.Microflake
        if flakes and phase.class_name() != "SGGXPhaseFunction":
            raise UnsupportedScene(
                f'{plugin}: phase function "sggx" is not supported as part of another '
                f"({phase.class_name()}); use it alone"
            )


def check_film(sensor, plugin):
    """Raises `UnsupportedScene` for a film, or a crop window, without pixels."""
    film = sensor.film()
    width, height = film.crop_size()
    if not (width and height):
        full_width, full_height = film.size()
        raise UnsupportedScene(
            f"{plugin}: nothing can be rendered on a film of {width} x {height} pixels (the crop "
            "window of "
            f"{full_width} x {full_height}); width and height must be at least 1"
        )


def check_scene(scene, sensor, plugin):
    """Raises `UnsupportedScene` for what the surface integrators cannot render, before any
    sampling."""
    check_polarisation(plugin)
    check_emitters(scene, plugin)
    check_bands(sensor.film(), plugin)


def check_bsdfs(scene, plugin):
    """Raises `UnsupportedScene` for BSDFs that scatter unlike in the two directions of a path."""
    if any(bsdf.class_name() == "Hair" for bsdf in used_bsdfs(scene)):
        raise UnsupportedScene(
            f'{plugin}: BSDF "hair" is not supported, for it scatters unlike in the two directions '
            'of a path; use "path"'
        )


def check_polarisation(plugin):
    """Raises `UnsupportedScene` under a polarised variant."""
    if mi.is_polarized:
        raise UnsupportedScene(
            f"{plugin}: polarised variants are not supported (active: {mi.variant()}); use an "
            'unpolarised one such as "llvm_ad_rgb"'
        )


def check_bands(film, plugin):
    """Raises `UnsupportedScene` for a film of spectral bands."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        raise UnsupportedScene(f'{plugin}: film "specfilm" is not supported; use "hdrfilm"')


def check_emitters(scene, plugin):
    """Raises `UnsupportedScene` for emitters on which no points can be sampled."""
    for shape in scene.shapes():
        if shape.is_emitter() and shape.class_name() in _UNSAMPLED_SHAPES:
            raise UnsupportedScene(
                f"{plugin}: Mitsuba cannot sample points on a {shape.class_name()} shape, so it "
                "cannot be an "
                "emitter here; use a mesh, sphere, rectangle, disk or cylinder"
            )


CURVES = frozenset({"BSplineCurve", "LinearCurve", "CatmullRomCurve"})
_UNSAMPLED_SHAPES = CURVES | {"SDFGrid", "Ellipsoids", "EllipsoidsMesh"}
