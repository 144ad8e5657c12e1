"""Denoised pictures, by Open Image Denoise (the package `mitsuba-oidn`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..paths.guides import albedo_and_normal
from .output import picture_channels

MISSING = "denoising needs mitsuba-oidn: pip install 'mis-integrators[denoise]'"


def require() -> Any:
    """The module `mitsuba_oidn`; raises ``ImportError`` with a line that says what to install."""
    try:
        import mitsuba_oidn
    except ImportError as error:
        found = isinstance(error, ModuleNotFoundError) and error.name == "mitsuba_oidn"
        raise ImportError(MISSING if found else f"{MISSING} ({error})") from None
    return mitsuba_oidn


def version() -> str:
    """What denoises, and its version."""
    return f"Open Image Denoise {'.'.join(map(str, require().oidn_version()))}"


def denoise(image: Any, scene: mi.Scene | None = None, sensor: int | mi.Sensor = 0) -> np.ndarray:
    """A denoised copy of a rendered image.

    Images should be rendered with a box filter (``<rfilter type="box"/>``): wider ones make the
    noise of neighbouring pixels alike, and a denoiser then takes it for detail.

    Parameters
    ----------
    image : (height, width) or (height, width, channels), array or tensor
        Linear radiance. Three channels or more: the first three are the colour; fewer: the first
        one is. All others stay as they are. Values that are negative or not finite count as zero.
    scene, sensor
        What the image shows: albedo and normals of what the camera sees are then made from it, and
        keep edges and textures sharp. `sensor`: one of the scene's, or its number.

    Returns
    -------
    np.ndarray
        float32, of the image's shape.

    Raises
    ------
    ImportError
        Without the package ``mitsuba-oidn``.
    ValueError
        If the image has another shape, or another size than the sensor's film.
    """
    oidn = require()
    pixels = np.array(image, dtype=np.float32)
    if pixels.ndim not in (2, 3) or 0 in pixels.shape:
        raise ValueError(f"an image of shape (height, width, channels), not {pixels.shape}")
    guides: tuple[np.ndarray, ...] = ()
    if scene is not None:
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        size = tuple(int(edge) for edge in sensor.film().crop_size())
        if size != pixels.shape[1::-1]:
            raise ValueError(
                f"the image has {pixels.shape[1]} x {pixels.shape[0]} pixels, the sensor's film "
                f"{size[0]} x {size[1]}"
            )
        guides = albedo_and_normal(scene, sensor)
    planes = pixels[..., None] if pixels.ndim == 2 else pixels
    colours = planes[..., : 3 if planes.shape[2] >= 3 else 1]
    clean = np.maximum(np.nan_to_num(colours, nan=0, posinf=0, neginf=0), 0)
    clean = np.ascontiguousarray(np.broadcast_to(clean, (*clean.shape[:2], 3)))
    found = oidn.denoise(clean, *guides, hdr=True)
    colours[...] = np.asarray(found)[..., : colours.shape[2]]
    return pixels


def denoised_picture(
    image: np.ndarray, channels: Sequence[str], scene: mi.Scene, sensor: mi.Sensor
) -> tuple[np.ndarray, list[str]]:
    """A scene's image with its colour channels denoised and first, all others as they are: the
    image and the channels' names.

    Raises ``ValueError`` if it has no colour channels (a film of spectral bands)."""
    names = picture_channels(channels)
    if names is None:
        raise ValueError("--denoise: the film has no colours, and so there is nothing to denoise")
    order = [*names, *(name for name in channels if name not in names)]
    return denoise(image[..., [channels.index(name) for name in order]], scene, sensor), order
