"""Veach's pyramid: an image of its own for each technique (s, t), as a debugging picture.

s counts the vertices that a light sub-path makes, t those of the camera path, the sensor's point
among them; delta vertices count. A path of k segments has s + t = k + 1: (0, k + 1) meets the
emitter, (1, k) is next-event estimation, (k, 1) joins the light sub-path with the sensor.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.film import colour_channels


def technique_names(longest):
    """(s, t) of all techniques for paths of up to `longest` segments: the shortest first."""
    return [(s, k + 1 - s) for k in range(1, longest + 1) for s in range(k + 1) if k > 1 or s == 0]


def technique_channels(longest, weighted):
    """Channel names of the pyramid in the active variant. Weighted ones have one image more, of all
    longer paths."""
    letters = "Y" if mi.is_monochromatic else "RGB"
    names = [f"technique.s{s}.t{t}" for s, t in technique_names(longest)] + [
        "technique.rest"
    ] * weighted
    return [f"{name}.{letter}" for name in names for letter in letters]


class Ledger:
    """Contributions of the camera paths by technique, for paths of up to `longest` segments; one
    array of `paths` spectra each.

    `weighted`: with their weights, else as if each technique were the only one. The hooks are those
    of `trace_camera_subpaths`.
    """

    def __init__(self, paths, longest, weighted, entries=None):
        self.paths, self.longest, self.weighted = paths, longest, weighted
        self.entries = entries or {
            name: dr.zeros(mi.Spectrum, paths * count)
            for name, count in (("met", longest), ("direct", longest), ("joined", longest**2))
        }

    def _write(self, name, row, path, value, share, mask):
        value = value * share if self.weighted else value
        place = row * self.paths + path  # a path that passes a mask comes to the same depth again
        dr.scatter_add(self.entries[name], value, place, mask)

    def hit_emitter(self, path, depth, value, share, mask):
        self._write("met", depth - 1, path, value, share, mask & (depth <= self.longest))

    def next_event(self, path, depth, value, share, mask):
        self._write("direct", depth - 1, path, value, share, mask & (depth <= self.longest))

    def connected(self, path, camera_depth, light_depth, value, share, mask):
        """A connection of vertices that are so many segments from the sensor and from the light."""
        row = (camera_depth - 1) * self.longest + light_depth - 1
        self._write(
            "joined",
            row,
            path,
            value,
            share,
            mask & (camera_depth + light_depth + 1 <= self.longest),
        )

    def image(self, s, t):
        """Radiance of each path by technique (s, t), t > 1."""
        name, row = {0: ("met", t - 2), 1: ("direct", t - 1)}.get(
            s, ("joined", (t - 2) * self.longest + s - 2)
        )
        return dr.gather(
            mi.Spectrum, self.entries[name], row * self.paths + dr.arange(mi.UInt32, self.paths)
        )


def film_channels(spectra, matrix):
    """The display channels of all `spectra` in one list, one a spectrum in mono variants."""
    colours = [colour_channels(spectrum, matrix) for spectrum in spectra]
    return [
        channel
        for colour in colours
        for channel in ([colour.x] if mi.is_monochromatic else [colour.x, colour.y, colour.z])
    ]


def camera_images(ledger, matrix):
    """Channels of the techniques that camera paths carry to the film (zero for those that light
    sub-paths do)."""
    zero = dr.zeros(mi.Spectrum, ledger.paths)
    return film_channels(
        [ledger.image(s, t) if t > 1 else zero for s, t in technique_names(ledger.longest)], matrix
    )


def sensor_images(longest, depth, value, matrix):
    """Channels of the techniques (s, 1), from light `value` that met the sensor after `depth`
    segments of a light sub-path."""
    return film_channels(
        [dr.select((t == 1) & (depth + 1 == s), value, 0) for s, t in technique_names(longest)],
        matrix,
    )


def with_rest(techniques, block):
    """The pyramid's tensor with one image more: what `block` (R, G, B, ...) has besides."""
    colour = block[:, :, :1] if mi.is_monochromatic else block[:, :, :3]
    channels = colour.shape[2]
    rest = colour
    for number in range(techniques.shape[2] // channels):
        rest = rest - techniques[:, :, number * channels : (number + 1) * channels]
    return dr.concat([techniques, rest], axis=2)
