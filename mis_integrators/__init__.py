"""Integrators for Mitsuba 3 built on multiple importance sampling.

Importing this package makes a usable LLVM known to Dr.Jit and registers every plugin for the active
Mitsuba variant and for each variant set later; it warns if Mitsuba or Dr.Jit is newer than those
tested, and does nothing else. `render_views` renders several views of a scene together, `denoise`
takes the noise out of an image.
"""

from typing import Any

from . import llvm

llvm.make_known()  # before anything imports Dr.Jit, which loads its LLVM once and for all

import drjit as _drjit  # noqa: E402
import mitsuba as _mitsuba  # noqa: E402

from . import _plugins, _tested  # noqa: E402

__version__ = "0.1.0"

_tested.warn_of_newer({"mitsuba": _mitsuba.__version__, "drjit": _drjit.__version__})
_plugins.follow_variants()


def render_views(scene: Any, integrator: Any = None, spp: int = 0, seed: int = 0) -> list[Any]:
    """Renders all views of a scene together; see
    `mis_integrators.integrators.volpath_multiview.render_views`."""
    from .integrators import volpath_multiview

    return volpath_multiview.render_views(scene, integrator, spp, seed)


def denoise(
    image: Any, scene: Any = None, sensor: Any = 0, channels: Any = (), hide_emitters: bool = False
) -> Any:
    """A denoised copy of a rendered image; see `mis_integrators.app.denoising.denoise`."""
    from .app import denoising

    return denoising.denoise(image, scene, sensor, channels, hide_emitters)
