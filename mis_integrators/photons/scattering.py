"""What a photon's light becomes at the vertex that it is merged with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Scattering:
    """How vertices scatter the light of one photon each.

    `towards`: direction to where the photon came from; `shading`: its shading cosine; `value`: BSDF
    times that cosine, without what is in the vertices' `factor`; `f`: the BSDF [1/sr] (of kept
    vertices `value` over the geometric cosine, as densities are); `p`: density
    per projected solid angle with which a camera path goes on there; `back()`: the same of a light
    sub-path that goes on to the vertex before.
    """

    towards: mi.Vector3f
    shading: mi.Float
    value: mi.Spectrum
    f: mi.Spectrum
    p: mi.Float
    back: Callable[[], mi.Float]
