"""The light of an image, split by the paths that bring it.

A path scatters at vertices between an emitter and the sensor, at each smoothly or by a delta
function (mirrors, glass, and what lets light pass straight on). Its class is a function of that
alone, whoever has made it:

- `direct`: no vertex is smooth (emitters that are seen), or a single one is, next to the emitter;
- `caustic`: some vertex is smooth, and the one next to the emitter is not;
- `indirect`: two or more are smooth, the one next to the emitter among them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

CLASSES = DIRECT, INDIRECT, CAUSTIC = "direct", "indirect", "caustic"


def class_of(smooth, delta_at_light):
    """The place in `CLASSES` of paths that scatter smoothly at so many vertices (two stand for
    more), and by a delta function or not at the one next to the emitter."""
    direct, indirect, caustic = (mi.UInt32(place) for place in range(3))
    scattered = dr.select(delta_at_light, caustic, dr.select(smooth == 1, direct, indirect))
    return dr.select(smooth == 0, direct, scattered)


def by_class(number, value):
    """Values apart by class (as of `class_of`), a list: each is zero in all lists but one."""
    return [dr.select(number == place, value, 0) for place in range(len(CLASSES))]


def by_class_of_photons(value, depth, first, delta_at_light):
    """`by_class` of what photons of that `depth` in segments bring to camera vertices, `first`
    where nothing has scattered smoothly before."""
    alone = (depth == 1) & first
    smooth = dr.select(alone, mi.UInt32(1), mi.UInt32(2))
    return by_class(class_of(smooth, delta_at_light), value)


def start_of_camera_path():
    """What a camera sub-path carries for `class_of`: vertices that have scattered smoothly (two
    stand for more), and whether the last one scattered by a delta function."""
    return [mi.UInt32(0), mi.Bool(False)]


def scattered_history(history, delta, active):
    """What it carries after another vertex."""
    smooth, was_delta = history
    smooth = dr.select(active & ~delta, dr.minimum(smooth + 1, 2), smooth)
    return [smooth, dr.select(active, delta, was_delta)]


class LightClasses:
    """Radiance of `paths` camera paths by class: `entries`, an array of the spectra of each path's
    classes, path by path, by the name of what finds it. `new`: names of entries that are to be
    filled, empty unless they are there. (A plain object, as `core.packing.Store`.)"""

    def __init__(self, paths, entries, new=()):
        self.paths = paths
        zeros = {name: dr.zeros(mi.Spectrum, len(CLASSES) * paths) for name in map(_key, new)}
        self.entries = {**zeros, **(entries or {})}

    def add(self, name, path, number, value, mask):
        """Adds to the radiance of paths; `number` as of `class_of`."""
        dr.scatter_reduce(
            dr.ReduceOp.Add,
            self.entries[_key(name)],
            value,
            path * len(CLASSES) + number,
            mask,
            dr.ReduceMode.Direct,
        )

    def radiance(self):
        """Of each path: a list of three spectra."""
        path = dr.arange(mi.UInt32, self.paths)
        mine = [entry for name, entry in self.entries.items() if name.startswith(_key(""))]
        return [
            sum(
                (dr.gather(mi.Spectrum, entry, path * len(CLASSES) + place) for entry in mine),
                mi.Spectrum(0),
            )
            for place in range(len(CLASSES))
        ]


def _key(name):
    return f"class.{name}"
