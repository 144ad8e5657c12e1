"""Denoised pictures, by Open Image Denoise (the package `mitsuba-oidn`).

Images rendered with the parameter `denoised` have their direct light in channels of its own. That
is denoised apart, and only as far as it is noisy: see `shrunk`. The denoiser is told that the
guides of the other light have no noise: see `without_noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.film import WINDOW, direct_channels
from ..core.windows import mean_without_largest, window_max, window_mean
from ..paths.guides import albedo_and_normal
from .output import picture_channels

DOUBT = 4.0
"""Tuned: by what the variance of direct light is multiplied before its noise is judged."""
AROUND = 25
"""Tuned: width in pixels of the windows whose mean the variance of a pixel is not below."""
HIGHLIGHTS = 25
"""Tuned: width in pixels of the windows whose brightest pixel no denoised one is above."""
XYZ = np.array(
    [
        [0.412453, 0.357580, 0.180423],
        [0.212671, 0.715160, 0.072169],
        [0.019334, 0.119193, 0.950227],
    ],
    dtype=np.float32,
)
"""Of linear sRGB (ITU-R BT.709), row by row."""
LUMINANCE = XYZ[1]
"""What images of the format `luminance` have."""
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


def shrunk(raw: np.ndarray, clean: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """An image (H, W, C) moved towards its denoised copy `clean`, as far as it is noisy.

    The squared difference of the two has the expectation v + b^2: the `variance` v (H, W) of `raw`
    (of the mean of its channels, over a window), and the squared bias b of `clean`, which is nearly
    free of noise. The best weight of `raw` in a mean of both is b^2 / (v + b^2), the
    positive-part estimator of James and Stein 1961 with the differences measured over the window.

    Both estimates are noisy, and where a few bright samples make them they differ by chance: raw
    noise would come back as dots, and as dark squares where all bright samples have missed. So the
    variance counts `DOUBT` times, and is not below that of the surroundings. In each window the
    pixel that differs most does not count: it may be all that differs, by one bright sample.
    """
    variance = np.maximum(variance, window_mean(variance, AROUND))
    apart = mean_without_largest(np.square((raw - clean).mean(axis=-1)), WINDOW)
    weight = np.maximum(1 - DOUBT * variance / np.maximum(apart, 1e-30), 0)
    return clean + weight[..., None] * (raw - clean)


def without_noise(
    light: np.ndarray, guides: Sequence[np.ndarray] = (), all_edges: bool = False
) -> np.ndarray:
    """An image (H, W, 1 or 3) without its noise. `guides`: its albedo and normals.

    With `all_edges` all edges of the light are taken to be in the guides, too: the denoiser then
    follows these to the pixel, and smooths the more between them. So it is with light that many
    directions bring, not with highlights and shadows. The guides' own noise is removed before."""
    oidn, colours = require(), np.broadcast_to(light, (*light.shape[:2], 3))
    if guides and all_edges:
        albedo, normal = guides
        albedo = np.clip(np.asarray(oidn.denoise(albedo)), 0, 1)
        normal = 2 * np.asarray(oidn.denoise(0.5 + 0.5 * normal)) - 1
        guides = albedo, normal
    told = {"hdr": True, "clean_aux": bool(guides) and all_edges}
    return np.asarray(oidn.denoise(np.ascontiguousarray(colours), *guides, **told))[
        ..., : light.shape[2]
    ]


def no_brighter(clean: np.ndarray, raw: np.ndarray) -> np.ndarray:
    """A denoised image (H, W, C) where no pixel is brighter, in any channel, than all of the `raw`
    ones (finite numbers) within a window: Open Image Denoise makes some highlights that few samples
    have met several times as bright as any of these."""
    brightest = window_max(np.moveaxis(raw, -1, 0), HIGHLIGHTS)
    return np.minimum(clean, np.moveaxis(brightest, 0, -1))


def denoise(
    image: Any,
    scene: mi.Scene | None = None,
    sensor: int | mi.Sensor = 0,
    channels: Sequence[str] = (),
    hide_emitters: bool = False,
) -> np.ndarray:
    """A denoised copy of a rendered image. No pixel of it is brighter than all of the image's near
    ones.

    Images should be rendered with a box filter (``<rfilter type="box"/>``): wider ones make the
    noise of neighbouring pixels alike, and a denoiser then takes it for detail.

    Parameters
    ----------
    image : (height, width) or (height, width, channels), array or tensor
        Linear radiance. The colour is what the `channels` name so; without names, of three channels
        or more the first three, of fewer the first one. All others stay as they are. Values that
        are negative or not finite count as zero.
    scene, sensor
        What the image shows: albedo and normals of what the camera sees are then made from it, and
        keep edges and textures sharp. `sensor`: one of the scene's, or its number.
    channels
        The names of the image's channels. Where there are those of direct light (an integrator
        with the parameter `denoised` makes them), it is denoised apart.
    hide_emitters
        Whether the image was rendered with that parameter: what stands behind emitters' shapes is
        then looked at in place of these.

    Returns
    -------
    np.ndarray
        float32, of the image's shape.

    Raises
    ------
    ImportError
        Without the package ``mitsuba-oidn``.
    ValueError
        If the image has another shape, another size than the sensor's film, or another number of
        channels than are named, or the scene has no such sensor.
    """
    require()  # before anything is traced
    pixels = np.array(image, dtype=np.float32)
    if pixels.ndim not in (2, 3) or 0 in pixels.shape:
        raise ValueError(f"an image of shape (height, width, channels), not {pixels.shape}")
    if channels and len(channels) != (1 if pixels.ndim == 2 else pixels.shape[2]):
        raise ValueError(f"{len(channels)} names of channels for an image of shape {pixels.shape}")
    guides: Sequence[np.ndarray] = ()
    if scene is not None:
        if isinstance(sensor, int):
            sensors = scene.sensors()
            if not 0 <= sensor < len(sensors):
                raise ValueError(
                    f"the scene has {len(sensors)} sensors, and none of number {sensor}"
                )
            sensor = sensors[sensor]
        size = tuple(int(edge) for edge in sensor.film().crop_size())
        if size != pixels.shape[1::-1]:
            raise ValueError(
                f"the image has {pixels.shape[1]} x {pixels.shape[0]} pixels, the sensor's film "
                f"{size[0]} x {size[1]}"
            )
        guides = albedo_and_normal(scene, sensor, hide_emitters=hide_emitters)
    planes = pixels[..., None] if pixels.ndim == 2 else pixels
    where = [channels.index(name) for name in picture_channels(channels) or ()]
    where = where or list(range(3 if planes.shape[2] >= 3 else 1))
    colours = planes[..., where]
    finite = np.maximum(np.nan_to_num(colours, nan=0, posinf=0, neginf=0), 0)
    split = planes[..., :0]
    if set(direct_channels()) <= set(channels):
        split = planes[..., [channels.index(name) for name in direct_channels()]]
    if split.any():  # `volpath_multiview` has these channels, and nothing in them
        *direct, variance = np.moveaxis(split, -1, 0)
        seen = np.stack(direct, axis=-1)
        if len(where) == 1:
            seen = seen @ LUMINANCE[:, None]
        elif channels[where[0]] == "X":
            seen = seen @ XYZ.T
        light = np.clip(seen, 0, finite)
        found = shrunk(light, without_noise(light, guides), variance)
        found += without_noise(finite - light, guides, all_edges=True)
        planes[..., where] = np.maximum(no_brighter(found, finite), 0)
    else:
        planes[..., where] = no_brighter(without_noise(finite, guides), finite)
    return pixels


def check_channels(channels: Sequence[str]) -> tuple[str, ...]:
    """The colour channels of these.

    Raises ``ValueError`` if there are none (a film of spectral bands)."""
    names = picture_channels(channels)
    if names is None:
        raise ValueError("--denoise: the film has no colours, and so there is nothing to denoise")
    return names


def denoised_picture(
    image: np.ndarray,
    channels: Sequence[str],
    scene: mi.Scene,
    sensor: mi.Sensor,
    hide_emitters: bool = False,
) -> tuple[np.ndarray, list[str]]:
    """A scene's image with its colour channels denoised and first, all others as they are: the
    image and the channels' names. `hide_emitters`: as of `denoise`. Raises as `check_channels`."""
    names = check_channels(channels)
    order = [*names, *(name for name in channels if name not in names)]
    image = image[..., [channels.index(name) for name in order]]
    return denoise(image, scene, sensor, order, hide_emitters), order
