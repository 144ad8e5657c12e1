"""Which plugins there are, and their registration for a variant.

A plugin class belongs to the variant in which it was defined, so the modules that define plugin
classes are loaded anew each time a variant is set.
"""

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import NoReturn

import mitsuba as mi

from . import llvm

_PACKAGE = "mis_integrators.integrators"

# Modules to load anew for a variant, those that others import first.
MODULES: tuple[str, ...] = (
    "common",
    "ahead",
    "piloted",
    "photon_passes",
    "bdpm",
    "weighted",
    "bdpm_balance",
    "published_optimal",
    "bdpm_opt",
    "subpath_session",
    "bdpt",
    "vcm",
    "resampled_passes",
    "resampled",
    "bdpt_ris",
    "volpath_multiview",
    "unidirectional",
    "choice",
    "media_choice",
    "bdpm_auto",
)

# Plugin name -> (module, class)
PLUGINS: dict[str, tuple[str, str]] = {
    "bdpm": ("bdpm", "BDPM"),
    "bdpm_auto": ("bdpm_auto", "BDPMAuto"),
    "bdpm_balance": ("bdpm_balance", "BDPMBalance"),
    "bdpm_opt": ("bdpm_opt", "BDPMOpt"),
    "bdpm_opt2": ("bdpm_opt", "BDPMOpt2"),
    "bdpm_opt3": ("bdpm_opt", "BDPMOpt3"),
    "bdpt": ("bdpt", "BDPT"),
    "bdpt_ris": ("bdpt_ris", "BDPTRIS"),
    "pcbpt": ("bdpt_ris", "PCBPT"),
    "vcm": ("vcm", "VCM"),
    "volpath_multiview": ("volpath_multiview", "VolpathMultiview"),
}


def follow_variants() -> None:
    """Register the plugins for the active variant, if there is one, and for each variant set from
    now on."""
    mi.detail.remove_variant_callback(_variant_changed)  # no second one if the package is reloaded
    mi.detail.add_variant_callback(_variant_changed)
    if mi.variant():
        register()


def register() -> None:
    """Register every plugin for the active variant.

    In a variant without Dr.Jit (``scalar_*``) a plugin of that name only says that it needs another
    variant. Raises ``llvm.LLVMError`` if the active variant needs LLVM and there is no working one.
    """
    variant = mi.variant()
    if variant.startswith("scalar_"):
        for plugin in PLUGINS:
            mi.register_integrator(plugin, _refusal(plugin, variant))
        return
    if variant.startswith("llvm_"):
        llvm.require()
    modules = {name: _load_anew(f"{_PACKAGE}.{name}") for name in MODULES}
    for plugin, (module, cls) in PLUGINS.items():
        mi.register_integrator(plugin, getattr(modules[module], cls))


def _variant_changed(old: str | None, new: str) -> None:
    register()


def _load_anew(name: str) -> ModuleType:
    loaded = sys.modules.get(name)
    return importlib.reload(loaded) if loaded else importlib.import_module(name)


def _refusal(plugin: str, variant: str) -> Callable[[mi.Properties], NoReturn]:
    def refuse(props: mi.Properties) -> NoReturn:
        raise RuntimeError(
            f'"{plugin}" needs a variant that runs on Dr.Jit (llvm_ad_* or cuda_ad_*), '
            f'but the active one is "{variant}"'
        )

    return refuse
