"""Scenes with media for comparisons, and batches of renders of several views."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
from comparing import Estimate, agree, assert_same, collect_until, in_one_thread
from worlds import T, bitmap, film, grey, look, waves

SIZE = 16

THREE_VIEWS = """<scene version="3.0.0">
  <default name="resx" value="48"/><default name="resy" value="16"/>
  <integrator type="volpath_multiview"><integer name="max_depth" value="2"/></integrator>
  <emitter type="constant"/>
  <shape type="sphere"><bsdf type="diffuse"/></shape>
  <sensor type="batch">
    <film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="$resy"/>
      <rfilter type="box"/></film>
    <sensor type="perspective"><transform name="to_world">
      <lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform></sensor>
    <sensor type="perspective"><transform name="to_world">
      <lookat origin="1,0,5" target="0,0,0" up="0,1,0"/></transform></sensor>
    <sensor type="perspective"><transform name="to_world">
      <lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform></sensor>
  </sensor>
</scene>"""
"""A scene file: a sphere seen by the three sensors of a batch."""


def view(origin, target=(0, 0, 0), size=SIZE, fov=36.0, kind="perspective", **extra):
    """A sensor that looks at the origin; its film counts only outside a batch."""
    return {
        "type": kind,
        "fov": fov,
        "to_world": look(origin, target, (0, 1, 0.01)),
        "film": film(size),
        "sampler": {"type": "multijitter"},
        **extra,
    }


def orbit(count, step=0.25, radius=4.5, height=1.2):
    return [
        view((radius * np.sin(step * i), height, radius * np.cos(step * i))) for i in range(count)
    ]


def uneven():
    """Three views that differ in distance, in field of view, and in how much of the medium lies
    before what they see."""
    return [
        view((0, 1.2, 4.5)),
        view((1.6, 0.4, 2.2), (0, 0, -0.4), fov=60.0),
        view((-3.5, 3.2, 4.5), fov=20.0),
    ]


def around():
    """Three views from different sides of the origin: what lies near to one lies far from another,
    and one sees a part closely."""
    return [
        view((0, 0.6, 4.0), fov=15.0),
        view((0.4, 0.2, -3.0), fov=50.0),
        view((2.2, 1.0, 0.3), fov=60.0),
    ]


def sparse(rng, n):
    """A majorant about five times the density."""
    values = rng.uniform(0.05, 0.35, (n, n, n))
    values[0, 0, 0] = 1.0
    return values


def batch(views, size=SIZE, **film_options):
    whole = film(size, **film_options) | {"width": size * len(views)}
    return {
        "type": "batch",
        "film": whole,
        "sampler": {"type": "multijitter"},
        **{f"view{i}": v for i, v in enumerate(views)},
    }


def grid(density, cells=5, seed=1, scale=1.0, albedo=0.8, g=0.0, half=1.0):
    """A heterogeneous medium in the cube [-half, half]^3: `density(rng, cells)` gives its
    values."""
    values = density(np.random.default_rng(seed), cells).astype(np.float32)[..., None]
    return {
        "type": "heterogeneous",
        "scale": scale,
        "albedo": {"type": "constvolume", "value": albedo},
        "sigma_t": {
            "type": "gridvolume",
            "grid": mi.VolumeGrid(values),
            "to_world": T().translate([-half] * 3).scale(2 * half),
        },
        "phase": {"type": "hg", "g": g},
    }


def even(rng, n):
    return rng.uniform(0.3, 1, (n, n, n))


def pockets(rng, n):
    """Empty cells, and one far denser than the rest: the majorant is many times the density."""
    values = rng.uniform(0.05, 0.25, (n, n, n)) * (rng.uniform(size=(n, n, n)) > 0.4)
    values[n // 2, n // 2, 0] = 2.5
    return values


PLAIN = SimpleNamespace(has_grids=False, has_flakes=False)
"""Traits of a scene whose media are homogeneous, and not of flakes."""


def flaky():
    """A phase function of flakes that lie askew."""
    areas = np.float32([0.9, 0.05, 0.3, 0.1, 0, 0.05])  # xx, yy, zz, xy, xz, yz
    cells = mi.VolumeGrid(np.broadcast_to(areas, (2, 2, 2, 6)).copy())
    return {"type": "sggx", "S": {"type": "gridvolume", "grid": cells, "raw": True}}


def container(medium, scale=1.0, at=(0, 0, 0), shape="cube"):
    """A shape with an index-matched boundary around a medium."""
    return {
        "type": shape,
        "to_world": T().translate(list(at)).scale(scale),
        "bsdf": {"type": "null"},
        "interior": medium,
    }


def lamp(at=(1.5, 3, 1.5), size=0.7, radiance=12.0):
    return {
        "type": "rectangle",
        "to_world": look(at, (0, 0, 0)) @ T().scale(size),
        "emitter": {"type": "area", "radiance": grey(radiance)},
    }


def floor():
    return {
        "type": "rectangle",
        "to_world": T().translate([0, -1.1, 0]).rotate([1, 0, 0], -90).scale(4),
        "bsdf": {
            "type": "diffuse",
            "reflectance": bitmap(np.stack([0.5 + 0.3 * waves(2, 2)] * 3, axis=-1), raw=False),
        },
    }


def world(sensor, medium=None, **objects):
    """A medium over a textured floor, a glossy ball inside, lit by a lamp, a dim sky and a point
    light."""
    scene = {
        "type": "scene",
        "sensor": sensor,
        "floor": floor(),
        "lamp": lamp(),
        "sky": {"type": "constant", "radiance": grey(0.3)},
        "point": {"type": "point", "position": [-2, 2.5, 1], "intensity": grey(4.0)},
        "ball": {
            "type": "sphere",
            "radius": 0.35,
            "bsdf": {"type": "roughconductor", "alpha": 0.3},
        },
    }
    if medium is not None:
        scene["medium"] = container(medium)
    scene.update(objects)
    # media that others refer to
    first = {name: scene.pop(name) for name in ("fog",) if name in scene}
    return mi.load_dict(
        {"type": "scene"}
        | first
        | {name: thing for name, thing in scene.items() if thing is not None}
    )


def multiview(**parameters):
    return mi.load_dict(
        {
            "type": "volpath_multiview",
            "max_depth": 8,
            "rr_depth": 50,
            "camera_paths": 16,
            **parameters,
        }
    )


def volpath(plugin="volpath", **parameters):
    return mi.load_dict({"type": plugin, "max_depth": 8, "rr_depth": 50, **parameters})


def oracle_for(max_depth, hide_emitters=False):
    """`volpath`. It passes the fog behind a hidden lamp over (3.9.1): where lamps are hidden,
    `volpath_multiview`, whose way to the first vertex is code of its own."""
    if hide_emitters:
        return multiview(max_depth=max_depth, hide_emitters=True)
    return volpath(max_depth=max_depth)


def agree_with_volpath(integrator, scene, most=600, **visible):
    """An integrator and `oracle_for` its depth have the same mean in the image and in its quarters;
    `visible`: the errors that are seen, as of `comparing.agree`."""
    oracle = oracle_for(integrator.max_depth, integrator.hide_emitters)
    agree(integrator, oracle, scene, blocks=2, spp=512, most=most, **visible)


def regions(images, blocks=2):
    """(1 + views * blocks^2, channels): mean of everything, then of each view's blocks."""
    found = []
    for image in images:
        height, width, channels = image.shape
        tiles = (
            image.astype(np.float64)
            .reshape(blocks, height // blocks, blocks, width // blocks, channels)
            .mean(axis=(1, 3))
        )
        found.append(tiles.reshape(-1, channels))
    found = np.concatenate(found)
    return np.concatenate([found.mean(axis=0)[None], found])


def split(image, count):
    return np.split(image[:, :, :3], count, axis=1)


def arrived(accumulator):
    """What the sum of the weights at each pixel is over what it is expected to be, view by view
    (height, width, 1)."""
    weight = np.array(
        (accumulator.shared[0] + accumulator.shared[1])[:, :, 3:]
        / (accumulator.expected * accumulator.iterations)
    )
    left = accumulator.views.margin
    return [
        weight[top : top + h, left : left + w]
        for (w, h), top in zip(accumulator.views.sizes, accumulator.views.tops)
    ]


class MultiviewBatches:
    """Region means of independent renders of all views, each of so many iterations, by one
    session."""

    def __init__(self, integrator, scene, blocks=2, iterations=2, seed=1, sensor=0):
        self.session = (
            integrator.session(scene, sensor, spp=0)
            if sensor is not None
            else integrator.views_session(scene)
        )
        self.blocks, self.iterations, self.seed, self.batches = blocks, iterations, seed, []
        self.statistics = {"tried": 0, "reached": 0, "lost": 0}
        self.weights = []

    @in_one_thread
    def add(self, count):
        for _ in range(count):
            self.session.restart(1000 * self.seed + len(self.batches))
            for _ in range(self.iterations):
                self.session.iterate()
            self.batches.append(
                regions([np.array(t)[:, :, :3] for t in self.session.view_tensors()], self.blocks)
            )
            self.weights.append(regions(arrived(self.session.accumulator), self.blocks))
            for name, value in self.session.statistics.items():
                self.statistics[name] += value

    def estimate(self):
        return Estimate.of(self.batches)


class OracleBatches:
    """Region means of independent renders of all views by one of Mitsuba's own integrators: side by
    side, or sensor by sensor."""

    def __init__(self, integrator, scene, blocks=2, spp=64, first_seed=1000):
        self.integrator, self.scene, self.blocks, self.spp, self.first_seed, self.batches = (
            integrator,
            scene,
            blocks,
            spp,
            first_seed,
            [],
        )

    @in_one_thread
    def add(self, count):
        for _ in range(count):
            seed = self.first_seed + len(self.batches)
            images = []
            for number in range(len(self.scene.sensors())):
                image = np.array(
                    mi.render(
                        self.scene,
                        integrator=self.integrator,
                        sensor=number,
                        seed=seed * 64 + number,
                        spp=self.spp,
                    )
                )
                image = image if image.ndim == 3 else image[:, :, None]
                images += split(image, image.shape[1] // image.shape[0])
            self.batches.append(regions(images, self.blocks))

    def estimate(self):
        return Estimate.of(self.batches)


def views_agree(
    integrator,
    oracle,
    scene,
    whole=0.015,
    block=0.06,
    iterations=2,
    oracle_spp=128,
    most=600,
    blocks=2,
    seed=1,
):
    """Renders all views together and by an oracle until a difference of `whole` or `block` would be
    seen, and asserts that there is none.

    `oracle` is an integrator or an `Estimate`. Returns the batches of the former and the estimate
    of the latter, which can judge again.
    """
    together = MultiviewBatches(integrator, scene, blocks, iterations, seed, sensor=None)
    apart = (
        oracle if isinstance(oracle, Estimate) else OracleBatches(oracle, scene, blocks, oracle_spp)
    )
    estimates = collect_until(together, apart, whole, block, most=most)
    assert_same(*estimates, whole, block)
    # Weights sum to one on the mean. Pictures say little about that: their means are nearly ratios
    # of two sums that err alike.
    weights = Estimate.of(together.weights)
    assert_same(weights, Estimate.exact(np.ones_like(weights.mean)), whole, block)
    return together, estimates[1]
