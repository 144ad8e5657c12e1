"""What counts of the noise of camera paths."""

from __future__ import annotations

from ..core.film import filter_share
from ..pilot.denoiser import LEFT


def noise_left(integrator, sensor):
    """Share of the variance of noise that is independent from pixel to pixel, as that of camera
    paths is: what a denoiser leaves where the image will see one, else what the film's
    reconstruction filter leaves. (A denoiser takes what the filter makes alike in near pixels for
    detail. In spectral variants all paths of an iteration share their wavelengths: of the noise
    that these make neither takes anything, though the share says so.)"""
    if integrator.denoised:
        return LEFT
    return filter_share(sensor.film().rfilter())
