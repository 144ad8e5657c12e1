"""Scenes for comparisons: a tray of nine spheres, one BSDF each, under any emitter, seen by any
sensor.

The spheres float over a large floor, each in the middle of one of the 3 x 3 blocks of the image.
Light bounces between spheres and floor, so every BSDF is met by camera and light sub-paths, by
photons, and by light that other BSDFs have scattered. Kernel estimates are nearly unbiased here:
the disk of a merge radius cuts exactly its own area out of a sphere, the floor's edges lie far
outside the image, and no two surfaces touch.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

SIZE = 48
RADIUS = 0.04


def T():
    return mi.ScalarTransform4f()


def look(origin, target, up=(0, 1, 0)):
    return T().look_at(origin=list(origin), target=list(target), up=list(up))


def grey(value):
    return {
        "type": "spectrum" if mi.is_spectral else "rgb",
        "value": value if mi.is_spectral else [value] * 3,
    }


def colour(r, g, b):
    return {"type": "rgb", "value": [r, g, b]}


def bitmap(array, raw=True, **extra):
    array = np.asarray(array, dtype=np.float32)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(array[:, :, None] if array.ndim == 2 else array),
        "raw": raw,
        **extra,
    }


def waves(kx, ky, n=32):
    y, x = np.mgrid[0:n, 0:n] * (2 * np.pi / n)
    return np.sin(kx * x) * np.cos(ky * y)


def bump_bsdf():
    return {
        "type": "bumpmap",
        "texture": bitmap(0.5 + 0.5 * waves(3, 2)),
        "scale": 0.15,
        "bsdf": {"type": "diffuse", "reflectance": grey(0.7)},
    }


def normal_bsdf():
    x, y = 0.35 * waves(3, 2), 0.35 * waves(2, 3)
    z = np.sqrt(1 - x * x - y * y)
    return {
        "type": "normalmap",
        "normalmap": bitmap(np.stack([x, y, z], axis=-1) * 0.5 + 0.5),
        "bsdf": {"type": "diffuse", "reflectance": grey(0.7)},
    }


def diffuse(value=0.6):
    return {"type": "diffuse", "reflectance": grey(value)}


def _checker():
    return {
        "type": "checkerboard",
        "color0": colour(0.2, 0.5, 0.7),
        "color1": colour(0.8, 0.6, 0.3),
        "to_uv": T().scale([6, 3, 1]),
    }


# Families of BSDFs, each a list of nine: name -> dictionary. What a family has in common decides
# which passes a scene needs.
FAMILIES = {
    "lambertian": {
        "diffuse": lambda: diffuse(0.8),
        "textured": lambda: {"type": "diffuse", "reflectance": _checker()},
        "twosided": lambda: {"type": "twosided", "bsdf": diffuse(0.5)},
        "twosided2": lambda: {"type": "twosided", "a": diffuse(0.7), "b": diffuse(0.2)},
        "blend": lambda: {"type": "blendbsdf", "weight": 0.3, "a": diffuse(0.2), "b": diffuse(0.9)},
        "blend textured": lambda: {
            "type": "blendbsdf",
            "weight": bitmap(0.5 + 0.4 * waves(2, 1)),
            "a": diffuse(0.2),
            "b": diffuse(0.9),
        },
        "twosided blend": lambda: {
            "type": "twosided",
            "bsdf": {"type": "blendbsdf", "weight": 0.5, "a": diffuse(0.3), "b": diffuse(0.8)},
        },
        "coloured": lambda: {"type": "diffuse", "reflectance": colour(0.7, 0.4, 0.2)},
        "dark": lambda: diffuse(0.1),
    },
    "rough": {
        "roughconductor": lambda: {"type": "roughconductor", "alpha": 0.3},
        "roughplastic": lambda: {
            "type": "roughplastic",
            "alpha": 0.3,
            "diffuse_reflectance": grey(0.5),
        },
        "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.9, "int_ior": 1.6},
        "bumpmap": bump_bsdf,
        "normalmap": normal_bsdf,
        "principled": lambda: {
            "type": "principled",
            "base_color": grey(0.6),
            "roughness": 0.5,
            "metallic": 0.3,
            "specular": 0.5,
            "clearcoat": 0.5,
            "clearcoat_gloss": 0.2,
            "sheen": 0.3,
        },
        "principledthin": lambda: {
            "type": "principledthin",
            "base_color": grey(0.6),
            "roughness": 0.5,
            "diff_trans": 0.8,
            "spec_trans": 0.3,
            "eta": 1.5,
        },
        "blend rough": lambda: {
            "type": "blendbsdf",
            "weight": 0.5,
            "a": diffuse(0.7),
            "b": {"type": "roughconductor", "alpha": 0.4, "distribution": "ggx"},
        },
        "twosided rough": lambda: {
            "type": "twosided",
            "bsdf": {"type": "roughconductor", "alpha_u": 0.2, "alpha_v": 0.5},
        },
    },
    "delta": {
        "dielectric": lambda: {"type": "dielectric", "int_ior": 1.5},
        "thindielectric": lambda: {"type": "thindielectric", "int_ior": 1.5},
        "conductor": lambda: {"type": "conductor"},
        "plastic": lambda: {"type": "plastic", "diffuse_reflectance": grey(0.6)},
        "mask": lambda: {"type": "mask", "opacity": 0.6, "bsdf": diffuse(0.7)},
        "null": lambda: {"type": "null"},
        "blend delta": lambda: {
            "type": "blendbsdf",
            "weight": 0.4,
            "a": diffuse(0.7),
            "b": {"type": "conductor"},
        },
        "twosided plastic": lambda: {
            "type": "twosided",
            "bsdf": {"type": "plastic", "diffuse_reflectance": grey(0.4)},
        },
        "principled glass": lambda: {
            "type": "principled",
            "base_color": grey(0.8),
            "roughness": 0.4,
            "spec_trans": 0.7,
            "eta": 1.5,
        },
    },
}


def has_delta(family):
    return family == "delta" or family.startswith("mixed")


LAMP = ((2.8, 1.6, 3.6), (0, 0, 0.3))


def _lamp(shape, scale, **extra):
    """A large dim lamp: its mirror images are no fireflies."""
    return {
        "type": shape,
        "to_world": look(*LAMP) @ T().scale(2.4 * scale),
        "emitter": {"type": "area", "radiance": grey(1.0), **extra},
    }


def _sky_image(width=64):
    v, u = np.mgrid[0 : width // 2, 0:width]
    up = 1 - v / (width // 2)
    image = np.stack([0.3 + up, 0.4 + up**2, 0.5 + 0.5 * up], axis=-1)
    return image + 6 * np.exp(-((u - 20) ** 2 + (v - 8) ** 2) / 18)[:, :, None] * [1, 0.8, 0.5]


def _envmap(to_world):
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(_sky_image().astype(np.float32)),
        "to_world": to_world,
    }


Z_UP = ([1, 0, 0], 90)

# Emitters: name -> function of the family's name, giving scene entries.
EMITTERS = {
    "point": lambda f: {"e": {"type": "point", "position": list(LAMP[0]), "intensity": grey(12.0)}},
    "spot": lambda f: {
        "e": {
            "type": "spot",
            "to_world": look(*LAMP),
            "intensity": grey(20.0),
            "cutoff_angle": 55,
            "beam_width": 35,
        }
    },
    "directional": lambda f: {
        "e": {"type": "directional", "direction": [-0.5, -0.3, -1], "irradiance": grey(2.0)}
    },
    "rectangle": lambda f: {"e": _lamp("rectangle", 0.9)},
    "sphere": lambda f: {"e": _lamp("sphere", 0.6)},
    "disk": lambda f: {"e": _lamp("disk", 1.0)},
    "cylinder": lambda f: {
        "e": {
            "type": "cylinder",
            "p0": [2.6, 0.2, 3.0],
            "p1": [2.4, 2.4, 3.3],
            "radius": 1.0,
            "emitter": {"type": "area", "radiance": grey(1.5)},
        }
    },
    "cube": lambda f: {"e": _lamp("cube", 0.6)},
    "textured": lambda f: {
        "e": _lamp(
            "rectangle",
            0.9,
            radiance=bitmap(
                np.stack(
                    [1 + 0.8 * waves(1, 1), 1 + 0.5 * waves(2, 1), 0.5 + 0 * waves(1, 1)], axis=-1
                ),
                raw=not mi.is_spectral,
            ),
        )
    },
    "constant": lambda f: {"e": {"type": "constant", "radiance": grey(1.0)}},
    "envmap": lambda f: {"e": _envmap(T().rotate(*Z_UP))},
    "envmap rotated": lambda f: {"e": _envmap(T().rotate([0, 0.6, 0.8], 70).rotate(*Z_UP))},
    # Without its disk of the sun where mirrors and glass would make caustics of it, which `path`
    # finds by luck alone.
    "sunsky": lambda f: {
        "e": {
            "type": "sunsky",
            "turbidity": 4.0,
            "sun_direction": [0.5, 0.3, 0.8],
            "sun_scale": 0.0 if has_delta(f) else 0.1,
            "sky_scale": 10.0,
        }
    },
    # Mitsuba's own sampler misses most of the light of a sun so wide.
    "wide sun": lambda f: {
        "e": {
            "type": "sunsky",
            "turbidity": 4.0,
            "sun_direction": [0.5, 0.3, 0.8],
            "sun_aperture": 12.0,
            "sun_scale": 2.0,
            "sky_scale": 10.0,
        }
    },
    "several": lambda f: {
        "e1": _lamp("rectangle", 0.7),
        "e2": {"type": "constant", "radiance": grey(0.4)},
        **(
            {}
            if has_delta(f)
            else {
                "e3": {"type": "point", "position": [-3, 0, 3], "intensity": grey(3.0)},
                "e4": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": grey(0.5)},
            }
        ),
    },
    "projector": lambda f: {
        "e": {
            "type": "projector",
            "to_world": look(*LAMP),
            "fov": 70,
            "irradiance": bitmap(np.stack([12 + 8 * waves(1, 2)] * 3, axis=-1)),
        }
    },
    "directionalarea": lambda f: {
        "e": {
            "type": "rectangle",
            "to_world": look((0.8, 0.4, 8.0), (0, 0, 0)) @ T().scale(2.2),
            "emitter": {"type": "directionalarea", "radiance": grey(3.0)},
        }
    },
}

# Mixed trays: three BSDFs of each family at a time, so that three trays hold all.
for _number in range(3):
    FAMILIES[f"mixed{_number}"] = {
        name: bsdf
        for family in ("lambertian", "rough", "delta")
        for name, bsdf in list(FAMILIES[family].items())[_number::3]
    }
    FAMILIES[f"smooth{_number}"] = {
        name: bsdf
        for family in ("lambertian", "rough")
        for name, bsdf in (list(FAMILIES[family].items()) * 2)[_number * 2 :][
            : 5 - (family == "rough")
        ]
    }

POINT_LIKE = ("point", "spot", "directional", "projector", "directionalarea")
"""Emitters that no ray can meet: `path` does not see what mirrors and glass make of them."""


def lamp_inside(kind, **area):
    """A `point` or `area` lamp within the cube from -1 to 1; `area`: parameters of the latter's
    emitter."""
    if kind == "point":
        return {"type": "point", "position": [0.3, 0.2, 0.7], "intensity": 1.0}
    return {
        "type": "rectangle",
        "to_world": look((0.2, -0.1, 0.8), (0, 0, 0)) @ T().scale(0.3),
        "emitter": {"type": "area", **area},
    }


def floor_in_a_beam(seen_from, floor=10, **cover):
    """A diffuse floor of albedo 0.6 and half the edge `floor` in a beam of irradiance one from
    above, seen from the height `seen_from`; `cover`: what is between."""
    return mi.load_dict(
        {
            "type": "scene",
            "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0},
            "floor": {"type": "rectangle", "to_world": T().scale(floor), "bsdf": diffuse(0.6)},
            **cover,
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, seen_from), (0, 0, 0)) @ T().scale([0.5, 0.5, 1]),
                "film": film(16),
            },
        }
    )


def index_matched_pane(height):
    """A pane without refraction above a floor."""
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, height]).rotate([1, 0, 0], 180).scale(10),
        "bsdf": {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0},
    }


def film(size=SIZE, rfilter="box", **extra):
    return {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "rfilter": {"type": rfilter},
        "pixel_format": "rgb",
        **extra,
    }


def sensor(kind="perspective", **film_options):
    pose = look((0, -1.5, 6), (0, 0, 0.4), (0, 1, 0))
    result = {"type": kind, "film": film(**film_options), "sampler": {"type": "multijitter"}}
    if kind == "orthographic":
        result["to_world"] = pose @ T().scale([1.65, 1.65, 1])
    else:
        result.update(to_world=pose, fov=32.0)
    if kind == "thinlens":
        result.update(aperture_radius=0.1, focus_distance=5.8)
    if mi.is_spectral:
        # One iteration has one set of wavelengths; a narrow response takes their noise away, and
        # nothing else.
        result["srf"] = {"type": "spectrum", "value": [(554, 0.0), (555, 1.0), (556, 0.0)]}
    return result


def under_a_lamp(height, **objects):
    """A floor under a wide lamp, seen from the side and from so high: the dictionary of a scene of
    `objects` that stand there."""
    return {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": T().scale(1.5)},
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 3]).rotate([1, 0, 0], 180),
            "emitter": {"type": "area", "radiance": 3.0},
        },
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": look((0, -3, height), (0, 0, 0.2), (0, 0, 1)),
            "film": film(32),
        },
        **objects,
    }


def tray(family, emitter, sensor_kind="perspective", only=None, **film_options):
    """The scene: spheres of a family (or one BSDF of it, `only`, on all nine), lit by an emitter of
    the table."""
    bsdfs = list(FAMILIES[family].values()) if only is None else [FAMILIES[family][only]] * 9
    scene = {
        "type": "scene",
        "sensor": sensor(sensor_kind, **film_options),
        "floor": {"type": "rectangle", "to_world": T().scale(4), "bsdf": diffuse(0.55)},
    }
    for number, bsdf in enumerate(bsdfs):
        x, y = 1.1 * (number % 3 - 1), 1.1 * (1 - number // 3)
        # Poles of the texture coordinates to the sides, where neither sensor nor lamp looks first.
        scene[f"sphere{number}"] = {
            "type": "sphere",
            "bsdf": bsdf(),
            "to_world": T().translate([x, y, 0.5]).rotate([1, 0, 0], 90).scale(0.4),
        }
    scene.update(EMITTERS[emitter](family))
    return mi.load_dict(scene)


def lit_ball(width, height, **sensor_options):
    """A ball under an even sky, on a film of so many pixels."""
    return mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "constant"},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
            "sensor": {
                "type": "perspective",
                "to_world": T().translate([0, 0, -4]),
                "film": film(width, height=height),
                **sensor_options,
            },
        }
    )


def bdpm(**parameters):
    return mi.load_dict(
        {
            "type": "bdpm",
            "initial_radius": RADIUS,
            "max_depth": 4,
            "photon_count": 20000,
            "camera_paths": 8,
            **parameters,
        }
    )


def path(**parameters):
    return mi.load_dict({"type": "path", "max_depth": 4, **parameters})


def ptracer(**parameters):
    return mi.load_dict({"type": "ptracer", "max_depth": 4, **parameters})
