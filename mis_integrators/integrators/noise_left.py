"""What counts of the noise of camera paths."""

from __future__ import annotations

from ..core.film import filter_share
from ..pilot.denoiser import share_left


def noise_left(integrator, sensor):
    """Share of the variance of noise that is independent from pixel to pixel, as that of camera
    paths is: what the film's reconstruction filter leaves, and a denoiser where the image will see
    one."""
    return share_left(integrator.denoised) * filter_share(sensor.film().rfilter())
