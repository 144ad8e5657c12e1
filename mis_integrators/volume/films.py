"""Pictures of several views: samples splatted into one common image, sums over iterations, and each view's own film at the end.

A sample comes with a weight: one for a path that its own view traces alone, and for paths that views share the share that each view has in them. The
weights' expected sum at a pixel, W, is known; their actual sum D fluctuates with the number of samples that happen to arrive, and so does the sum
Y of the weighted values. What both have in common is taken away without bias: the even iterations' m = Y/D is independent of the odd iterations'
sums, so Y + m (W - D) has the expectation of Y, and the noise of Y - m D. (Or Y/D itself: MWIS.)
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.film import colour_channels

SHARED = 4
"""Channels of what all paths bring: colour, weight."""
OWN = 5
"""Channels of what a view's own paths bring besides: colour of emitters seen directly where the path is shared, alpha, filter weight."""


def splat(views, block, channels, active):
    """Adds samples `[(view, position, list of values)]` to a common image of so many channels; returns it as a tensor (height, width, channels)."""
    size = mi.ScalarVector2u(*views.atlas_size)
    image = mi.ImageBlock(size, mi.ScalarPoint2i(0), channels, views.rfilter, border=False, normalize=False, coalesce=False)
    for (view, position, values), mask in zip(block, active):
        image.put(views.place(view, position, mask), values, mask)
    return image.tensor()


def own_values(radiance, visible, value, weight, alone, matrix):
    """The channels of a camera path, `SHARED` and then `OWN`: `radiance` is what it saw on the way to its pivot, `value` what it brings from
    there, and `weight` its share, one if its view is `alone`."""
    brought = colour_channels(dr.select(alone, radiance + value, value * weight), matrix)
    seen = colour_channels(dr.select(alone, 0, radiance), matrix)
    return [*brought, dr.select(alone, 1, weight), *seen, visible, mi.Float(1)]


def expected_weights(views):
    """Expected sum of filter weights at each pixel of the common image, for one camera path a pixel."""
    image = np.ones((views.atlas_size[1], views.atlas_size[0], 1), dtype=np.float32)
    for (width, height), top, border in zip(views.sizes, views.tops, views.borders):
        across = [_line_weights(views.rfilter, n, border) for n in (width, height)]
        image[top:top + height, views.margin:views.margin + width, 0] = across[1][:, None] * across[0][None, :]
    return mi.TensorXf(image)


def _line_weights(rfilter, size, border, steps=512):
    """Integral over the sampled interval [-border, size + border] of the filter centred on each of `size` pixels."""
    if rfilter.is_box_filter():
        return np.ones(size, dtype=np.float32)
    radius = float(rfilter.radius())
    x = (np.arange(steps) + 0.5) / steps * 2 * radius - radius
    values = np.array(rfilter.eval(mi.Float(x.astype(np.float32)))) * (2 * radius / steps)
    centres = np.arange(size)[:, None] + 0.5
    inside = (centres + x >= -border) & (centres + x <= size + border)
    return (values * inside).sum(axis=1).astype(np.float32)


class ViewAccumulator:
    """Sums of the iterations' common images and, for the variance, of their squares. Its size does not grow with iterations.

    `ratio`: pictures are Y/D (MWIS).
    """

    def __init__(self, views, with_variance, ratio):
        self.views, self.with_variance, self.ratio = views, with_variance, ratio
        self.expected = expected_weights(views) * views.camera_paths
        self.iterations = 0
        self.shared = self.own = self.square = self.cross = self.weight_square = None

    def add(self, shared, own):
        """Adds one iteration's layers, tensors (height, width, `SHARED`) and (height, width, `OWN`)."""
        if self.iterations == 0:
            height, width, _ = own.shape
            self.own = dr.zeros(mi.TensorXf, own.shape)
            self.shared = [dr.zeros(mi.TensorXf, shared.shape) for _ in range(2)]
            if self.with_variance:
                self.square, self.cross = (dr.zeros(mi.TensorXf, (height, width, 3)) for _ in range(2))
                self.weight_square = dr.zeros(mi.TensorXf, (height, width, 1))
        self.own += own
        self.shared[self.iterations % 2] += shared
        if self.with_variance:
            colour, weight = shared[:, :, :3], shared[:, :, 3:]
            self.square += colour * colour
            self.cross += colour * weight
            self.weight_square += weight * weight
        self.iterations += 1
        dr.schedule(self.own, self.shared, self.square, self.cross, self.weight_square)

    def _mean(self, shared):
        """Y/D, zero where nothing arrived."""
        weight = shared[:, :, 3:]
        return dr.select(weight > 0.01 * self.expected, shared[:, :, :3] / dr.select(weight > 0, weight, 1), 0)

    def _colour(self):
        even, odd = self.shared
        n = self.iterations
        if self.ratio:
            return self._mean(even + odd)
        total = even[:, :, :3] + odd[:, :, :3]
        for mine, other, count in ((even, odd, (n + 1) // 2), (odd, even, n // 2)):
            total += self._mean(other) * (self.expected * count - mine[:, :, 3:])
        return total / (self.expected * n)

    def picture(self):
        """The common image so far (height, width, 5): colour, alpha, 1."""
        weight = self.own[:, :, 4:]
        weight = dr.select(weight > 0, weight, 1)
        return dr.concat([self._colour() + self.own[:, :, :3] / weight, self.own[:, :, 3:4] / weight,
                          dr.ones(mi.TensorXf, self.own.shape[:2] + (1,))], axis=2)

    def variance(self):
        """Estimated variance of each pixel's mean (height, width, 3) from the iterations: that of Y - m D over W, or over the mean of D (delta
        method). The noise of emitters seen directly, if any, is not in it."""
        n, total = self.iterations, self.shared[0] + self.shared[1]
        mean = self._mean(total)
        rest = total[:, :, :3] - mean * total[:, :, 3:]
        spread = self.square - 2 * mean * self.cross + mean * mean * self.weight_square - rest * rest / n
        divisor = total[:, :, 3:] / n if self.ratio else self.expected
        return dr.maximum(spread, 0) / (n * (n - 1) * dr.square(dr.select(divisor > 0, divisor, 1)))

    def pictures(self):
        """Each view's picture (height, width, channels): colour, alpha, weight one, then variances where kept."""
        image = self.picture()
        if self.with_variance:
            variance = self.variance()
            image = dr.concat([image, variance[:, :, :1] if mi.is_monochromatic else variance], axis=2)
        left = self.views.margin
        return [image[top:top + height, left:left + width, :] for (width, height), top in zip(self.views.sizes, self.views.tops)]


def write_film(film, picture):
    """Writes a picture of the film's cropped size into the film, which has been prepared with matching AOVs."""
    if not mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        picture = dr.concat([picture[:, :, :3], picture[:, :, 4:]], axis=2)
    film.put_block(mi.ImageBlock(picture, film.crop_offset(), film.rfilter(), border=False))
