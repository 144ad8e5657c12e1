"""A room in which methods are driven to where they could fail, and what is measured there: noise,
its tail, and means."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from comparing import pictures

SIZE, DEPTH = 40, 7
WORST, KEPT = 1e-4, 2e-3
"""Shares of the largest deviations: those beyond the percentile that is compared, and those that
are looked at for it."""
RESAMPLED, NOISIEST = 200, 0.02
DARK = 0.1
"""Deviations are relative to a pixel's brightness, but at least to this share of the picture's."""
SINGLE = tuple(f"bdpm:{bdd}" for bdd in (0, 1, 2))
MIXED = ("bdpm_opt2", "bdpm_opt3")


class Room:
    """A room of edge 2 times `size`, open towards the camera, with a floor and a back wall of
    metal, a square lamp below the ceiling, a point light at the left wall, and a screen before it
    that ends above the floor. `set` changes numbers only: kernels stay as they are."""

    def __init__(self, size=1.0):
        T, self.scale = mi.ScalarTransform4f, mi.ScalarTransform4f().scale(size)
        self.size = size
        metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.12}}
        places = {
            "floor": T(),
            "ceiling": T().translate([0, 0, 2]).rotate([1, 0, 0], 180),
            "back": T().translate([0, 1, 1]).rotate([1, 0, 0], 90),
            "left": T().translate([-1, 0, 1]).rotate([0, 1, 0], 90),
            "right": T().translate([1, 0, 1]).rotate([0, 1, 0], -90),
        }
        self.scene = mi.load_dict(
            {
                "type": "scene",
                **{
                    name: {
                        "type": "rectangle",
                        "to_world": self.scale @ place,
                        "bsdf": metal if name in ("floor", "back") else self.white(0.6),
                    }
                    for name, place in places.items()
                },
                "screen": {"type": "rectangle", "bsdf": self.white(0.5)},
                "lamp": {
                    "type": "rectangle",
                    "bsdf": self.white(0.0),
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
                },
                "dim": {
                    "type": "point",
                    "position": [-0.95 * size, 0.3 * size, 0.9 * size],
                    "intensity": 1.0,
                },
                "sensor": {
                    "type": "perspective",
                    "fov": 50,
                    "near_clip": 0.01 * size,
                    "far_clip": 100 * size,
                    "to_world": T().look_at(
                        [0, -2.6 * size, 1.2 * size], [0, 0, 0.6 * size], [0, 0, 1]
                    ),
                    "film": {
                        "type": "hdrfilm",
                        "width": SIZE,
                        "height": SIZE,
                        "rfilter": {"type": "box"},
                        "pixel_format": "rgb",
                    },
                },
            }
        )
        self.parameters = mi.traverse(self.scene)

    @staticmethod
    def white(albedo):
        return {
            "type": "twosided",
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}},
        }

    def set(self, alpha=0.12, albedo=0.6, lamp=0.2, dim=0.1, gap=1.0):
        """`alpha`: roughness of the metal; `albedo` of the walls; `lamp`: half its edge, its power
        stays; `dim`: the point light's intensity, where the lamp has one of 4; `gap` between screen
        and floor. Returns the scene."""
        T, own = mi.ScalarTransform4f, self.parameters
        new = {key: mi.Float(alpha) for key in own.keys() if key.endswith("alpha.value")}
        new |= {
            key: mi.Color3f(albedo)
            for key in own.keys()
            if key.endswith("reflectance.value") and not key.startswith(("lamp", "screen"))
        }
        new["lamp.to_world"] = mi.Transform4f(
            self.scale
            @ T().translate([0.2, -0.2, 1.7]).rotate([1, 0, 0], 180).scale([lamp, lamp, 1])
        )
        new["lamp.emitter.radiance.value"] = mi.Color3f(1 / lamp**2)
        new["screen.to_world"] = mi.Transform4f(
            self.scale
            @ T().translate([-0.4, 0, 1 + gap / 2]).rotate([0, 1, 0], 90).scale([1 - gap / 2, 1, 1])
        )
        new["dim.intensity.value"] = mi.Color3f(dim * self.size**2)
        dr.make_opaque(new)
        for key, value in new.items():
            own[key] = value
        own.update()
        return self.scene


def integrator(method, **parameters):
    """A single strategy as it is mixed (its photons are gathered on narrow lobes, too), or full
    weights."""
    plugin, _, bdd = method.partition(":")
    if bdd:
        parameters = {
            name: value
            for name, value in parameters.items()
            if name not in ("frozen_photons", "mix_diffuse")
        }
        single = {"type": plugin, "bdd": int(bdd), "pass_narrow": False}
        return mi.load_dict({**single, "max_depth": DEPTH, **parameters})
    return mi.load_dict(
        {
            "type": plugin,
            "max_depth": DEPTH,
            "weights": "full",
            "frozen_photons": 20000,
            **parameters,
        }
    )


@dataclass(frozen=True)
class Measured:
    """Grey pictures of independent iterations, (iterations, pixels)."""

    pictures: np.ndarray

    @staticmethod
    def of(scene, method, count, seeds=(5,), **parameters):
        """`count` iterations in all, of as many renders as there are `seeds`."""
        sessions = [integrator(method, **parameters).session(scene, seed=seed) for seed in seeds]
        return Measured(
            np.array(
                [
                    picture[..., :3].mean(-1).ravel()
                    for session in sessions
                    for picture in pictures(session, count // len(seeds))
                ]
            )
        )

    @cached_property
    def mean(self):
        """Mean picture."""
        return self.pictures.mean(axis=0)

    def light(self):
        """Mean over the picture, and its standard error."""
        means = self.pictures.mean(axis=1)
        return means.mean(), means.std(ddof=1) / len(means) ** 0.5

    def noise(self, brightness, left_out=NOISIEST):
        """Logarithm of the mean relative variance of an iteration without the noisiest pixels, and
        its standard error (over iterations)."""
        squares = ((self.pictures - self.mean) / brightness) ** 2
        variances = squares.mean(axis=0)
        values = squares[:, variances <= np.quantile(variances, 1 - left_out)].mean(axis=1)
        return math.log(values.mean()), values.std(ddof=1) / values.mean() / len(values) ** 0.5

    def tail(self, brightness):
        """Logarithm of the 99.99th percentile of the relative deviations from the mean, over pixels
        and iterations, and its standard error: iterations, within which pixels may go together, are
        drawn anew (bootstrap)."""
        deviation = np.abs(self.pictures - self.mean) / brightness
        count, total = len(deviation), deviation.size
        assert WORST * total >= 10, "too few values for the percentile"
        kept = np.argpartition(deviation.ravel(), -int(KEPT * total))[-int(KEPT * total) :]
        kept = kept[np.argsort(-deviation.ravel()[kept])]
        drawn = np.random.default_rng(3).multinomial(
            count, np.full(count, 1 / count), size=RESAMPLED
        )
        beyond = np.cumsum(drawn[:, kept // deviation.shape[1]], axis=1) > WORST * total
        logs = np.log(deviation.ravel()[kept[beyond.argmax(axis=1)]])
        return float(np.log(deviation.ravel()[kept[int(WORST * total)]])), float(logs.std(ddof=1))


class Truth:
    """The picture by `path`: `brightness`, what deviations are relative to, (pixels,); mean over
    the picture and its standard error."""

    def __init__(self, scene, batches=8, spp=32):
        path = mi.load_dict({"type": "path", "max_depth": DEPTH})
        pictures = np.array(
            [
                np.array(mi.render(scene, integrator=path, spp=spp, seed=seed))
                .mean(axis=-1)
                .ravel()
                for seed in range(batches)
            ]
        )
        self.mean, self.error = pictures.mean(), pictures.mean(axis=1).std(ddof=1) / batches**0.5
        self.brightness = np.median(pictures, axis=0) + DARK * self.mean
