"""From samples to the film: reconstruction, accumulation over iterations, and the variance of the
pixel means."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from . import segments
from .packing import from_numpy
from .stratified_variance import variance_ratio
from .sums import Sums
from .windows import window_mean


def colour_matrix(wavelengths):
    """Linear sRGB of unit radiance at each of `wavelengths`: the conversion is linear, so an
    iteration that shares its wavelengths shares this matrix (a list of `Color3f`, empty in rgb and
    mono variants)."""
    if not mi.is_spectral:
        return []
    count = dr.size_v(mi.Spectrum)
    units = [mi.Spectrum(*[float(i == j) for j in range(count)]) for i in range(count)]
    return [mi.Color3f(mi.spectrum_to_srgb(unit, wavelengths)) for unit in units]


def shared_wavelengths(sensor, number):
    """The wavelengths that all sub-paths of an iteration share, the sample that makes them (from
    `number`, 32 random bits), and their conversion to colour: a dictionary of opaque arrays
    `sample`, `wavelengths`, `matrix`, and `sensor_matrix`, for light that has no camera ray: the
    weight of one holds the response over the density of its wavelengths, too, and so does
    `sensor_weight`."""
    sample = dr.opaque(mi.Float, number / 2**32)
    wavelengths, weight = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample)
    matrix = colour_matrix(wavelengths)
    spectral = {
        "sample": sample,
        "wavelengths": wavelengths,
        "matrix": matrix,
        "sensor_matrix": [column * weight[i] for i, column in enumerate(matrix)],
        "sensor_weight": mi.Spectrum(weight),
    }
    dr.make_opaque(spectral)
    return spectral


def colour_channels(radiance, matrix):
    """Three display channels of a `Spectrum`, with the `colour_matrix` of its wavelengths (mono:
    grey)."""
    if mi.is_spectral:
        return sum((column * radiance[i] for i, column in enumerate(matrix)), mi.Color3f(0))
    if mi.is_monochromatic:
        return mi.Color3f(radiance.x)
    return radiance


def filter_line(rfilter, steps=512):
    """Places across a reconstruction filter, from its centre, and the integral of one of its two
    factors from each halfway to the next: (steps,) each."""
    radius = float(rfilter.radius())
    x = (np.arange(steps) + 0.5) / steps * 2 * radius - radius
    return x, np.array(rfilter.eval(mi.Float(x.astype(np.float32)))) * (2 * radius / steps)


def filter_share(rfilter):
    """What a film's reconstruction filter leaves of the variance of noise that is independent from
    pixel to pixel: the integral of its square, one for a box of a pixel. (In a corridor `path` has
    with a tent 0.52, with Gaussian weights 0.37 of the variance that it has with a box: 0.44 and
    0.32 here.)"""
    if rfilter.is_box_filter():
        return 1.0
    x, values = filter_line(rfilter)
    across = np.sum(values**2) / np.sum(values) ** 2 / (x[1] - x[0])
    return float(across**2)


def splat_samples(film, position, radiance, alpha, matrix, active, weight=1, classes=()):
    """Reconstructs one pass: an image tensor (height, width, channels), border included, that holds
    sums of filter weight times (R, G, B, [alpha,] [classes,] 1); `matrix` as for `colour_channels`.
    Samples may have a `weight` of their own, in all channels. `classes`: spectra into which the
    radiance is split, three channels each."""
    values = [value * weight for value in colour_channels(radiance, matrix)]
    if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        values.append(alpha * weight)
    for light in classes:
        values += [value * weight for value in colour_channels(light, matrix)]
    return splat_channels(film, position, [*values, mi.Float(weight)], active)


def splat_channels(film, position, channels, active):
    """Image tensor (height, width, channels), border included, of sums of filter weight times the
    values `channels`."""
    block = mi.ImageBlock(
        film.crop_size(),
        film.crop_offset(),
        len(channels),
        film.rfilter(),
        border=True,
        coalesce=False,
    )
    block.put(position, channels, active)
    return block.tensor()


def splat_light(film, position, spectra, matrix, active, more=()):
    """Image tensor, as of `splat_channels`, of light that is joined with the sensor: three channels
    for each of the `spectra` (its whole, and its classes), by a `colour_matrix`, then `more`."""
    colours = [channel for light in spectra for channel in colour_channels(light, matrix)]
    return splat_channels(film, position, [*colours, *more], active)


def expected_weight(film, camera_paths, in_crop=False):
    """Expected sum of filter weights that `camera_paths` samples a pixel leave in each pixel of a
    block, border included: a tensor (height, width, 1). `in_crop`: no samples count that a film may
    take beyond its crop window, where nothing else brings the light that is joined with the sensor.

    What light sub-paths bring to the sensor is divided by this, not by the weights that the
    camera's samples happen to have."""
    rfilter = film.rfilter()
    radius, border = float(rfilter.radius()), rfilter.border_size()
    steps = 4096
    x = (np.arange(steps) + 0.5) * (2 * radius / steps) - radius
    cumulative = np.concatenate(
        [
            [0],
            np.cumsum(np.array(rfilter.eval(mi.Float(x)), dtype=np.float64)) * (2 * radius / steps),
        ]
    )
    spread = border if film.sample_border() and not in_crop else 0

    def along(size):
        middle = np.arange(-border, size + border) + 0.5
        low, high = (np.clip(edge - middle, -radius, radius) for edge in (-spread, size + spread))
        return np.interp(high, np.linspace(-radius, radius, steps + 1), cumulative) - np.interp(
            low, np.linspace(-radius, radius, steps + 1), cumulative
        )

    width, height = film.crop_size()
    weight = camera_paths * np.outer(along(height), along(width))
    return mi.TensorXf(from_numpy(mi.Float, weight.ravel()), (*weight.shape, 1))


def as_camera_weights(light, block, expected):
    """Sums of filter weight times light that meets the sensor (`splat_channels`), times the camera
    samples' own weights in `block` (`splat_samples`) over the `expected_weight`: then both are
    divided by the same, and the mean over iterations stays unbiased."""
    return light * dr.select(expected > 1e-6, block[:, :, -1:] / dr.maximum(expected, 1e-6), 0)


def with_colour(block, colour):
    """A block of camera samples with `colour` (height, width, 3) added to its own; further channels
    of that are added to those before the block's last one."""
    if colour.shape[2] == 3:
        return dr.concat([block[:, :, :3] + colour, block[:, :, 3:]], axis=2)
    more = colour.shape[2] - 3
    last, first = block.shape[2] - 1, block.shape[2] - 1 - more
    parts = [block[:, :, :3] + colour[:, :, :3], block[:, :, first:last] + colour[:, :, 3:]]
    if first > 3:  # alpha
        parts.insert(1, block[:, :, 3:first])
    return dr.concat([*parts, block[:, :, last:]], axis=2)


def add_squares(sums, colour, weight):
    """Adds to the sums what `spread` needs, from the summed colours A_i and weights W_i of an
    iteration."""
    colour, weight = mi.TensorXd(colour), mi.TensorXd(weight)
    sums.add("square", colour * colour)
    sums.add("weight_square", weight * weight)
    sums.add("cross", colour * weight)  # last: Dr.Jit widens an operand of one element in place


def spread(sums, mean):
    """Sum over the iterations of (A_i - m W_i)^2 for a given `mean` m."""
    return sums["square"] - 2 * mean * sums["cross"] + mean * mean * sums["weight_square"]


def grey_of(colour):
    """The mean of three channels (height, width, 3), as (height, width, 1)."""
    return (colour[:, :, :1] + colour[:, :, 1:2] + colour[:, :, 2:]) / 3


def grey_and_weight(film, blocks):
    """The mean of the weighted colours, and the weights, of block tensors, without their border:
    float64 (blocks, height, width) each; 0 where a block has a value that is not finite."""
    inside = np.array([without_border(film, block) for block in blocks], np.float64)
    inside[~np.isfinite(inside).all(axis=-1)] = 0
    return inside[..., :3].mean(axis=-1), inside[..., -1]


def without_border(film, tensor):
    """A tensor of a block as an array, without the block's border."""
    border = film.rfilter().border_size()
    inside = slice(border, -border) if border else slice(None)
    return np.array(tensor)[inside, inside]


def unfinite_pixels(block):
    """One for each pixel of a block tensor that has a value which is not finite, else zero: shape
    (height, width, 1)."""
    finite = dr.isfinite(block[:, :, :1])
    for channel in range(1, block.shape[2]):
        finite &= dr.isfinite(block[:, :, channel : channel + 1])
    return mi.TensorXf(dr.select(finite.array, mi.Float(0), mi.Float(1)), finite.shape)


def zero_where(left_out, block):
    """A block tensor without the pixels that are `left_out` (as of `unfinite_pixels`)."""
    return dr.select(left_out > 0, 0, block)


DIRECT = "direct_light"
"""What the channels of a render that will be denoised are called: its direct light, and the
variance of that."""
WINDOW = 5
"""Width in pixels of the windows in which the noise of direct light is measured. (3 and 9 leave the
same error within 2 %, in four scenes.)"""


def direct_channels():
    """Names of the channels of direct light, the last one that of its variance."""
    return [f"{DIRECT}.{name}" for name in ("R", "G", "B", "variance")]


class Accumulator:
    """Sums of the iterations' blocks and, for the variance, of their squares. Its size does not
    grow with iterations.

    The sums are `total`; `left_out`, how many iterations had a value at the pixel that is not
    finite and are left out there, weight and all; with the variance `square` (colour squared),
    `cross` (colour times weight), `weight_square`; `techniques` if there are such images.
    Blocks have `class_channels` before their last one, those of direct light first.

    Where iterations are `stratified` together (low-discrepancy numbers), the variance needs
    `grey_square` and the segments (see `segments`) of grey and weight, too; grey is the mean of the
    colours. Images that will be `denoised` need the segments for direct light: its grey is their
    last channel.

    `direct_noise` may be a function that tells the variance of direct light in one iteration, grey:
    (height, width) without the block's border. It is asked where the iterations are too few to tell
    it.
    """

    def __init__(
        self,
        film,
        with_variance,
        stratified=False,
        class_channels=0,
        denoised=False,
    ):
        self.film, self.with_variance, self.stratified = film, with_variance, stratified
        self.class_channels, self.denoised = class_channels, denoised
        self.technique_channels = 0
        self.direct_noise = None
        self.sums = Sums(mi.TensorXd)

    @property
    def iterations(self):
        """Iterations summed."""
        return len(self.sums.done)

    def shapes(self):
        """The shapes that the sums will have after an iteration, by name."""
        border = 2 * self.film.rfilter().border_size()
        width, height = self.film.crop_size()
        size = height + border, width + border
        channels = {
            "total": (5 if mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha) else 4)
            + self.class_channels,
            "left_out": 1,
        }
        if self.with_variance:
            channels |= {"square": 3, "cross": 3, "weight_square": 1}
            if self.stratified:
                channels["grey_square"] = 1
        if self._segmented:
            channels |= dict.fromkeys(segments.NAMES, 3 if self.denoised else 2)
        if self.technique_channels:
            channels["techniques"] = self.technique_channels
        return {name: (*size, count) for name, count in channels.items()}

    @property
    def _segmented(self):
        """Whether there are segments."""
        return self.denoised or (self.with_variance and self.stratified)

    def add(self, block, iteration, techniques=None):
        """Adds the block tensor of an iteration, and that of its techniques' images."""
        left_out = unfinite_pixels(block)
        if techniques is not None:
            left_out = dr.maximum(left_out, unfinite_pixels(techniques))
            self.sums.add("techniques", zero_where(left_out, techniques))
        block = zero_where(left_out, block)
        self.sums.add("total", block)
        self.sums.add("left_out", left_out)
        if self.with_variance:
            add_squares(self.sums, block[:, :, :3], block[:, :, -1:])
            if self.stratified:
                grey = grey_of(mi.TensorXd(block[:, :, :3]))
                self.sums.add("grey_square", grey * grey)
        if self._segmented:
            wide = mi.TensorXd(block)
            followed = [grey_of(wide[:, :, :3]), wide[:, :, -1:]]
            if self.denoised:
                followed.append(grey_of(self._direct(wide)))
            self.sums.add_to_segment(iteration, dr.concat(followed, axis=2))
        self.sums.done.add(iteration)
        dr.schedule(self.sums.tensors)

    def _direct(self, tensor):
        """The channels of direct light in a tensor of blocks."""
        first = tensor.shape[2] - 1 - self.class_channels
        return tensor[:, :, first : first + 3]

    def mean(self):
        """Mean colour (height, width, 3), and the sums of weights (height, width, 1) by which it
        was divided."""
        total = self.sums["total"]
        weight = total[:, :, -1:]
        weight = dr.select(weight == 0, 1, weight)
        return total[:, :, :3] / mi.TensorXd(weight), weight  # a copy, as in `add_squares`

    def variance_of_mean(self):
        """Estimated variance of each pixel's mean (height, width, 3) from the iterations, by the
        ratio estimator's delta method: sum (A_i - m W_i)^2 / (n (n - 1) mean(W)^2), A_i and W_i the
        weighted colour and weight of iteration i; times the `_variance_ratio` of those that are
        stratified."""
        n = self.iterations
        mean, weight = self.mean()
        variance = dr.maximum(spread(self.sums, mean), 0) * (n / ((n - 1) * weight * weight))
        return variance * mi.TensorXd(self._variance_ratio()) if self.stratified else variance

    def _variance_ratio(self):
        """Variance over that of as many independent iterations, of grey (height, width, 1); one in
        the block's border."""
        n, done = self.iterations, self.sums.done
        mean, weight = (without_border(self.film, tensor) for tensor in self.mean())
        mean = grey_of(mean)
        grey = {
            "square": without_border(self.film, self.sums["grey_square"]),
            "cross": grey_of(without_border(self.film, self.sums["cross"])),
            "weight_square": without_border(self.film, self.sums["weight_square"]),
        }
        naive = np.maximum(spread(grey, mean), 0) * (n / ((n - 1) * weight * weight))
        ratio = variance_ratio(*self._deviations(0, mean), naive[..., 0], done.below, done.beyond)
        border = self.film.rfilter().border_size()
        return np.pad(ratio, border, constant_values=1.0)[..., None]

    def _deviations(self, channel, mean):
        """Of each segment's mean from the `mean` (H, W, 1) of a channel of the segments: (segments,
        H, W); which segments are complete; their length."""
        done, weight = self.sums.done, without_border(self.film, self.sums["total"])[..., -1]
        length, complete = segments.complete(done.below, done.beyond, done.end)
        sums = np.array([without_border(self.film, self.sums[name]) for name in segments.NAMES])
        deviations = sums[..., channel] - mean[..., 0] * sums[..., 1]
        scale = self.iterations / (np.where(weight == 0, 1, weight) * length)
        return deviations * scale, complete, length

    def direct_variance(self):
        """Estimated variance of the mean of direct light, grey, mean over `WINDOW`: (height, width)
        without the block's border. Its square where it is not known.

        Iterations count as independent, though sequences make the mean less noisy than that: a
        rare bright sample is then as large in the variance as it is in the image, whatever is
        around it."""
        total = without_border(self.film, self.sums["total"])
        mean = grey_of(self._direct(total)) / np.where(total[..., -1:] == 0, 1, total[..., -1:])
        deviations, complete, length = self._deviations(2, mean)
        if np.count_nonzero(complete) < 2:
            if self.direct_noise is None:
                return np.square(mean[..., 0])
            return window_mean(self.direct_noise() / self.iterations, WINDOW)
        of_segments = deviations[complete].var(axis=0, ddof=1)
        return window_mean(of_segments * (length / self.iterations), WINDOW)

    def estimate(self):
        """Mean colour and its estimated variance, float64 (height, width, 3) each, without the
        block's border."""
        return tuple(
            without_border(self.film, tensor)
            for tensor in (self.mean()[0], self.variance_of_mean())
        )

    def unfinite_pixels(self):
        """How many pixels of the film had values that are not finite in some iteration."""
        return int(np.count_nonzero(without_border(self.film, self.sums["left_out"])))

    def put(self, film, variance, layers=()):
        """Writes the accumulated image into a film prepared with matching AOVs: with channels of
        the `variance` or not, then those of the techniques, then those of `layers`: each a tensor
        with the block's border, or the number of a class of light."""
        tensor = total = self.sums["total"]
        weight, split = total[:, :, -1:], total.shape[2] - 1 - self.class_channels
        if self.class_channels:
            tensor = dr.concat([total[:, :, :split], weight], axis=2)
        if variance:
            channels = self.variance_of_mean() * weight
            tensor = dr.concat(
                [tensor, channels[:, :, :1] if mi.is_monochromatic else channels], axis=2
            )
        if self.denoised:
            border = self.film.rfilter().border_size()
            noise = mi.TensorXd(np.pad(self.direct_variance(), border)[..., None])
            tensor = dr.concat([tensor, self._direct(total), noise * weight], axis=2)
        if self.technique_channels:
            tensor = dr.concat([tensor, self.sums["techniques"]], axis=2)
        for layer in layers:
            if isinstance(layer, int):
                channels = total[:, :, split + 3 * layer : split + 3 * layer + 3]
            else:
                channels = mi.TensorXd(layer) * weight  # by which the film will divide them
            tensor = dr.concat([tensor, channels], axis=2)
        # Scaled, so that sums fit into single precision; the weights' sums are scaled alike.
        tensor = mi.TensorXf(tensor * 2.0 ** -self.iterations.bit_length())
        film.put_block(mi.ImageBlock(tensor, film.crop_offset(), film.rfilter(), border=True))


def variance_channels():
    """Names of the variance AOVs in the active variant."""
    return ["var.Y"] if mi.is_monochromatic else ["var.R", "var.G", "var.B"]
