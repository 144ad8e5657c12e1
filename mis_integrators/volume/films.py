"""Pictures of several views: samples splatted into one common image, sums over iterations, and each view's own film at the end.

A picture has two layers. What a view's own paths bring alone is divided by the sum of its own filter weights, as everywhere in Mitsuba. What views share
arrives anywhere on the film; it is divided by the expected sum of filter weights, or (MWIS) by the sum of the weights of what arrived.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.film import colour_channels

OWN = 5
"""Channels of the own layer: colour, alpha, weight."""
SHARED = 4
"""Channels of the shared layer: colour, weight."""


def splat(views, block, channels, active):
    """Adds samples `[(view, position, list of values)]` to a common image of so many channels; returns it as a tensor (height, width, channels)."""
    image = mi.ImageBlock(mi.ScalarVector2u(*views.atlas_size), mi.ScalarPoint2i(0), channels, views.rfilter, border=False, normalize=False, coalesce=False)
    for (view, position, values), mask in zip(block, active):
        image.put(views.place(view, position, mask), values, mask)
    return image.tensor()


def own_values(radiance, visible, value, weight, alone, matrix):
    """Channels of a camera path: own layer, then its part of the shared layer. `value` is what the path brings by its suffix, `weight` its weight there."""
    lonely = colour_channels(radiance + dr.select(alone, value, 0), matrix)
    joint = colour_channels(dr.select(alone, 0, value * weight), matrix)
    return [*lonely, visible, mi.Float(1), *joint, dr.select(alone, 1, weight)]


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

    `ratio`: the shared layer is divided by the sum of its own weights (MWIS) instead of their expectation.
    """

    def __init__(self, views, with_variance, ratio):
        self.views, self.with_variance, self.ratio = views, with_variance, ratio
        self.expected = expected_weights(views) * views.camera_paths
        self.iterations = 0
        self.own = self.shared = self.square = self.cross = self.weight_square = self.sum = None

    def add(self, own, shared):
        """Adds one iteration's layers, tensors (height, width, `OWN`) and (height, width, `SHARED`)."""
        if self.iterations == 0:
            self.own, self.shared = dr.zeros(mi.TensorXf, own.shape), dr.zeros(mi.TensorXf, shared.shape)
            height, width, _ = own.shape
            if self.with_variance:
                self.sum, self.square, self.cross = (dr.zeros(mi.TensorXf, (height, width, 3)) for _ in range(3))
                self.weight_square = dr.zeros(mi.TensorXf, (height, width, 1))
        self.own += own
        self.shared += shared
        if self.with_variance:
            colour, weight = own[:, :, :3] * self._scale(own[:, :, 4:], 1) + shared[:, :, :3], shared[:, :, 3:]
            self.sum += colour
            self.square += colour * colour
            self.cross += colour * weight
            self.weight_square += weight * weight
        self.iterations += 1
        dr.schedule(self.own, self.shared, self.sum, self.square, self.cross, self.weight_square)

    def _scale(self, weight, iterations):
        """What turns sums over a view's own paths into sums of the expected weight."""
        expected = self.expected * iterations
        return dr.select(weight > 0.05 * expected, expected / weight, 1)

    def _divisor(self):
        """What the shared layer is divided by, over the number of iterations."""
        if not self.ratio:
            return self.expected
        weight = self.shared[:, :, 3:] / self.iterations
        return dr.select(weight > 0, weight, 1)

    def picture(self):
        """The common image so far (height, width, 5): colour, alpha, 1."""
        n = self.iterations
        scale = self._scale(self.own[:, :, 4:], n) / (self.expected * n)
        colour = self.own[:, :, :3] * scale + self.shared[:, :, :3] / (self._divisor() * n)
        return dr.concat([colour, self.own[:, :, 3:4] * scale, dr.ones(mi.TensorXf, (*colour.shape[:2], 1))], axis=2)

    def variance(self):
        """Estimated variance of each pixel's mean (height, width, 3) from the iterations. With a ratio, by the delta method: of colour - m weight, m the
        mean of the shared layer."""
        n, divisor = self.iterations, self._divisor()
        if not self.ratio:
            spread = self.square - self.sum * self.sum / n
        else:
            mean = self.shared[:, :, :3] / (divisor * n)
            rest = self.sum - mean * self.shared[:, :, 3:]
            spread = self.square - 2 * mean * self.cross + mean * mean * self.weight_square - rest * rest / n
        return dr.maximum(spread, 0) / (n * (n - 1) * divisor * divisor)

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
