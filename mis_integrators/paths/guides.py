"""What denoisers want to know of a picture besides its colours: albedo and normal of what the
camera sees, through glass and in mirrors too."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.random import next_1d_and_2d, reversed_bits
from ..core.sequences import SampleSequence
from ..core.spectra import channel_mean
from .camera import border_size, film_sample_count, film_size, start_camera_paths
from .setting import CameraPass

SAMPLES = 16
"""Camera paths a pixel: both guides change little from one to another."""
MOST_DELTA_SURFACES = 16
"""Delta surfaces that a camera path goes through or is mirrored by."""


@dr.syntax
def first_smooth_surface(scene, camera_pass, hide_emitters=False):
    """Follows the camera paths of a pass to the first surface that does not scatter by delta
    functions only; with `hide_emitters`, through emitters' shapes that they meet before all else.

    Returns `(albedo, normal)`, zero where there is none: the share of light that it scatters, by
    one sample of its BSDF, times that of the delta surfaces before; and the shading normal.
    """
    _, active, numbers, ray, *_ = start_camera_paths(camera_pass)
    throughput, albedo = mi.UnpolarizedSpectrum(1), mi.UnpolarizedSpectrum(0)
    normal = mi.Normal3f(0)
    depth = mi.UInt32(0)
    unseen = mi.Bool(hide_emitters)
    while dr.hint(active, label="to the first smooth surface"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        depth += 1
        bsdf = si.bsdf(ray)
        rng = numbers.at(depth)
        bs, weight = bsdf.sample(mi.BSDFContext(), si, *next_1d_and_2d(rng, active), active)
        arriving = mi.UnpolarizedSpectrum(throughput)
        throughput *= mi.unpolarized_spectrum(weight)
        null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)  # a hole of a mask, or all of a pane
        smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & ~null
        d = si.to_world(bs.wo)
        if dr.hint(hide_emitters, mode="scalar"):
            passes = active & unseen & si.shape.is_emitter()
            d = dr.select(passes, ray.d, d)
            throughput = dr.select(passes, arriving, throughput)
            smooth &= ~passes
            unseen &= passes | null
        albedo = dr.select(smooth, throughput, albedo)
        normal = dr.select(smooth, mi.Normal3f(si.sh_frame.n), normal)
        ray = si.spawn_ray(d)
        active &= ~smooth & (depth <= MOST_DELTA_SURFACES)
    return albedo, normal


def camera_passes(sensor, samples: int, seed=0):
    """Passes of one camera path a pixel each, `samples` of them: parts of one sequence, each with
    wavelengths of its own. `seed`: an integer."""
    pixels = dr.arange(mi.UInt32, film_sample_count(sensor))
    for number in range(samples):
        sequence = SampleSequence(
            dr.opaque(mi.UInt32, seed), dr.opaque(mi.UInt32, number), 1, low_discrepancy=True
        )
        wavelength = dr.opaque(mi.Float, reversed_bits(number) / 2**32)
        yield CameraPass(sensor, None, sequence, pixels, mi.UInt32(0), wavelength)


def displayed_albedo(albedo):
    """Three channels of an albedo, grey in mono and spectral variants."""
    if mi.is_spectral or mi.is_monochromatic:
        return mi.Color3f(channel_mean(albedo))
    return albedo


def albedo_and_normal(
    scene, sensor, samples: int = SAMPLES, hide_emitters: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Guides for a denoiser: the means over camera paths of `first_smooth_surface`, under a box
    filter.

    Returns two float32 arrays (height, width, 3) of the film's crop window: albedo in [0, 1] (grey
    in mono and spectral variants), and normal in world space.
    """
    total = np.zeros((6, film_sample_count(sensor)))
    for camera_pass in camera_passes(sensor, samples):
        albedo, normal = first_smooth_surface(scene, camera_pass, hide_emitters)
        albedo = displayed_albedo(albedo)
        dr.eval(albedo, normal)
        found = np.concatenate([np.array(albedo), np.array(normal)])
        total += np.where(np.isfinite(found), found, 0)
    width, height = film_size(sensor)
    border = border_size(sensor.film())
    means = (total / samples).reshape(6, height, width)
    means = means[:, border : height - border, border : width - border].astype(np.float32)
    albedo, normal = np.moveaxis(means[:3], 0, -1), np.moveaxis(means[3:], 0, -1)
    return np.ascontiguousarray(np.clip(albedo, 0, 1)), np.ascontiguousarray(normal)
