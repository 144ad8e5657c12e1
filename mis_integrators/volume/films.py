"""Pictures of several views: samples splatted into one common image, sums over iterations, and each
view's own film at the end.

A sample comes with a weight: one for a path that its own view traces alone, and for paths that
views share the share that each view has in them. The weights' expected sum at a pixel, W, is known;
their actual sum D fluctuates with the number of samples that happen to arrive, and so does the sum
Y of the weighted values. What both have in common is taken away without bias: the even iterations'
m = Y/D is independent of the odd iterations' sums, so Y + m (W - D) has the expectation of Y, and
the noise of Y - m D. (Or Y/D itself: MWIS.)
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.film import (
    add_squares,
    colour_channels,
    filter_line,
    spread,
    unfinite_pixels,
    zero_where,
)
from ..core.sums import Sums

SHARED = 4
"""Channels of what all paths bring: colour, weight."""
OWN = 5
"""Channels of what a view's own paths bring besides: colour of emitters seen directly where the
path is shared, alpha, filter weight."""


def splat(views, block, channels, active):
    """Adds samples `[(view, position, list of values)]` to a common image of so many channels;
    returns it as a tensor (height, width, channels)."""
    size = mi.ScalarVector2u(*views.atlas_size)
    image = mi.ImageBlock(
        size,
        mi.ScalarPoint2i(0),
        channels,
        views.rfilter,
        border=False,
        normalize=False,
        coalesce=False,
    )
    for (view, position, values), mask in zip(block, active):
        image.put(views.place(view, position, mask), values, mask)
    return image.tensor()


def own_values(radiance, visible, value, weight, alone, matrix):
    """The channels of a camera path, `SHARED` and then `OWN`: `radiance` is what it saw on the way
    to its pivot, `value` what it brings from there, and `weight` its share, one if its view is
    `alone`."""
    brought = colour_channels(dr.select(alone, radiance + value, value * weight), matrix)
    seen = colour_channels(dr.select(alone, 0, radiance), matrix)
    return [*brought, dr.select(alone, 1, weight), *seen, visible, mi.Float(1)]


def expected_weights(views):
    """Expected sum of filter weights at each pixel of the common image, for one camera path a
    pixel."""
    image = np.ones((views.atlas_size[1], views.atlas_size[0], 1), dtype=np.float32)
    for (width, height), top, border in zip(views.sizes, views.tops, views.borders):
        across = [_line_weights(views.rfilter, n, border) for n in (width, height)]
        image[top : top + height, views.margin : views.margin + width, 0] = (
            across[1][:, None] * across[0][None, :]
        )
    return mi.TensorXf(image)


def _line_weights(rfilter, size, border):
    """Integral over the sampled interval [-border, size + border] of the filter centred on each of
    `size` pixels."""
    if rfilter.is_box_filter():
        return np.ones(size, dtype=np.float32)
    x, values = filter_line(rfilter)
    centres = np.arange(size)[:, None] + 0.5
    inside = (centres + x >= -border) & (centres + x <= size + border)
    return (values * inside).sum(axis=1).astype(np.float32)


class ViewAccumulator:
    """Sums of the iterations' common images and, for the variance, of their squares. Its size does
    not grow with iterations. A pixel lacks the iterations in which a value of it is not finite;
    `left_out0` and `left_out1` count the even and the odd ones of those.

    `ratio`: pictures are Y/D (MWIS).
    """

    def __init__(self, views, with_variance, ratio):
        self.views, self.with_variance, self.ratio = views, with_variance, ratio
        self.expected = expected_weights(views) * views.camera_paths
        self.sums = Sums(mi.TensorXd)

    @property
    def iterations(self):
        """Iterations summed."""
        return len(self.sums.done)

    @property
    def shared(self):
        """Sums of what all paths bring, of the even and of the odd iterations."""
        return [self.sums["shared0"], self.sums["shared1"]]

    def add(self, shared, own, iteration):
        """Adds the layers of an iteration, tensors (height, width, `SHARED`) and (height, width,
        `OWN`)."""
        left_out = dr.maximum(unfinite_pixels(shared), unfinite_pixels(own))
        shared = zero_where(left_out, shared)
        self.sums.add("own", zero_where(left_out, own))
        same, other = ((iteration + step) % 2 for step in range(2))
        for name, value in (("shared", shared), ("left_out", left_out)):
            self.sums.add(f"{name}{same}", value)
            if f"{name}{other}" not in self.sums.tensors:
                self.sums.add(f"{name}{other}", dr.zeros(mi.TensorXd, value.shape))
        if self.with_variance:
            add_squares(self.sums, shared[:, :, :3], shared[:, :, 3:])
        self.sums.done.add(iteration)
        dr.schedule(self.sums.tensors)

    def shapes(self):
        """The shapes that the sums will have after an iteration, by name."""
        width, height = self.views.atlas_size
        channels = {
            "own": OWN,
            **{
                f"{name}{parity}": count
                for name, count in (("shared", SHARED), ("left_out", 1))
                for parity in range(2)
            },
        }
        if self.with_variance:
            channels |= {"square": 3, "cross": 3, "weight_square": 1}
        return {name: (height, width, count) for name, count in channels.items()}

    def unfinite_pixels(self):
        """How many pixels of all views had values that are not finite in some iteration."""
        left_out = np.array(self.sums["left_out0"] + self.sums["left_out1"])
        return sum(int(np.count_nonzero(window)) for window in self._windows(left_out))

    def _counts(self):
        """How many iterations each pixel has, even ones and odd ones."""
        evens = self.sums.done.even()
        return evens - self.sums["left_out0"], self.iterations - evens - self.sums["left_out1"]

    def _mean(self, shared):
        """Y/D, zero where nothing arrived."""
        weight = shared[:, :, 3:]
        return dr.select(
            weight > 0.01 * self.expected, shared[:, :, :3] / dr.select(weight > 0, weight, 1), 0
        )

    def _colour(self):
        even, odd = self.shared
        if self.ratio:
            return self._mean(even + odd)
        total = even[:, :, :3] + odd[:, :, :3]
        evens, odds = self._counts()
        for mine, other, count in ((even, odd, evens), (odd, even, odds)):
            total += self._mean(other) * (self.expected * count - mine[:, :, 3:])
        return total / (self.expected * dr.maximum(evens + odds, 1))

    def picture(self):
        """The common image so far (height, width, 5): colour, alpha, 1."""
        own = self.sums["own"]
        weight = own[:, :, 4:]
        weight = dr.select(weight > 0, weight, 1)
        return dr.concat(
            [
                self._colour() + own[:, :, :3] / weight,
                own[:, :, 3:4] / weight,
                dr.ones(mi.TensorXd, own.shape[:2] + (1,)),
            ],
            axis=2,
        )

    def variance(self):
        """Estimated variance of each pixel's mean (height, width, 3) from the iterations: that of Y
        - m D over W, or over the mean of D (delta method). The noise of emitters seen directly, if
        any, is not in it. Too large where iterations share low-discrepancy sequences."""
        n, total = dr.maximum(sum(self._counts()), 2), self.sums["shared0"] + self.sums["shared1"]
        mean = self._mean(total)
        rest = total[:, :, :3] - mean * total[:, :, 3:]
        divisor = total[:, :, 3:] / n if self.ratio else self.expected
        return dr.maximum(spread(self.sums, mean) - rest * rest / n, 0) / (
            n * (n - 1) * dr.square(dr.select(divisor > 0, divisor, 1))
        )

    def pictures(self, variance):
        """Each view's picture (height, width, channels): colour, alpha, weight one, then those of
        the `variance` if asked for."""
        image = self.picture()
        if variance:
            channels = self.variance()
            image = dr.concat(
                [image, channels[:, :, :1] if mi.is_monochromatic else channels], axis=2
            )
        return [mi.TensorXf(window) for window in self._windows(image)]

    def _windows(self, image):
        left = self.views.margin
        return [
            image[top : top + height, left : left + width, :]
            for (width, height), top in zip(self.views.sizes, self.views.tops)
        ]

    def estimate(self):
        """Mean colour and its estimated variance, the pixels of all views in one row: float64 (1,
        pixels, 3) each."""
        return tuple(
            np.concatenate(
                [window.reshape(1, -1, 3) for window in self._windows(np.array(image))], axis=1
            )
            for image in (self.picture()[:, :, :3], self.variance())
        )


def write_film(film, picture):
    """Writes a picture of the film's cropped size into the film, which has been prepared with
    matching AOVs."""
    if not mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        picture = dr.concat([picture[:, :, :3], picture[:, :, 4:]], axis=2)
    film.put_block(mi.ImageBlock(picture, film.crop_offset(), film.rfilter(), border=False))
