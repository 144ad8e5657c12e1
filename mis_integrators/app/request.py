"""A render as plain data, from which any process opens the same session."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from .. import llvm
from ..core.session import Session, make_session
from . import fingerprint, loading
from .options import versions


@dataclass(frozen=True)
class Request:
    """What to render: the scene's file and ``$variables``, the integrator that replaces the scene's
    (or ``None``) and its parameters, the sensor's index, or all views; ``spp`` (0: no planned end,
    ``None``: what the sensor asks for), ``fine`` as for ``make_session``.
    """

    scene: str
    variables: dict[str, str]
    plugin: str | None
    parameters: dict[str, loading.Value]
    variant: str
    sensor: int
    all_views: bool
    seed: int
    spp: int | None
    fine: bool
    denoise: bool = False

    def open(self, needs_views: str | None = None) -> Opened:
        """Load the scene and make the session. ``needs_views`` is an option that only integrators
        of several views have.

        Sets the variant. Raises one of ``loading.SCENE_ERRORS``.
        """
        if self.variant.startswith("llvm_"):
            llvm.require()
        try:
            mi.set_variant(self.variant)
        except (ImportError, RuntimeError):
            if not self.variant.startswith("cuda_") or dr.has_backend(dr.JitBackend.CUDA):
                raise
            raise RuntimeError(
                f"{self.variant} needs an NVIDIA GPU and its driver, and Dr.Jit finds none; use "
                "--variant llvm_ad_rgb"
            ) from None
        loaded = loading.load(
            Path(self.scene),
            self.variables,
            self.plugin,
            self.parameters,
            denoise=self.denoise,
        )
        sensor = _sensor(loaded.scene, self.sensor)
        spp = sensor.sampler().sample_count() if self.spp is None else self.spp
        if self.spp is None and not spp:
            raise ValueError('the sampler\'s "sample_count" is 0; ask for samples with --spp')
        if needs_views and not hasattr(loaded.integrator, "views_session"):
            raise ValueError(
                f'{needs_views}: "{loaded.plugin}" renders one view at a time; use -i '
                "volpath_multiview"
            )
        if self.all_views:
            session = loaded.integrator.views_session(loaded.scene, seed=self.seed, spp=spp)
        else:
            session = make_session(
                loaded.integrator, loaded.scene, sensor, self.seed, spp, self.fine
            )
        return Opened(self, loaded, sensor, session, {**loaded.parameters, **session.settings})


@dataclass(frozen=True)
class Opened:
    """A request, what was loaded for it, the session, and its settings before it learns any
    more."""

    request: Request
    loaded: loading.LoadedScene
    sensor: mi.Sensor
    session: Session
    settings: dict[str, Any]

    def identity(self) -> dict[str, Any]:
        """What the session's sums are of, in JSON's types: see ``checkpoint.difference``."""
        given = asdict(self.request)
        box = {"reconstruction filter": "box"} if given["denoise"] else {}
        return {
            **box,
            "plugin": self.loaded.plugin,
            "variant": given["variant"],
            "sensor": "all" if given["all_views"] else given["sensor"],
            "seed": given["seed"],
            "versions": versions(),
            "files": fingerprint.scene_digests(Path(given["scene"]), given["variables"]),
            "variables": given["variables"],
            "settings": self.settings,
        }


def _sensor(scene: mi.Scene, index: int) -> mi.Sensor:
    sensors = scene.sensors()
    if not 0 <= index < len(sensors):
        raise ValueError(
            f"--sensor {index}: the scene's sensors are numbered 0 to {len(sensors) - 1}"
            if sensors
            else "the scene has no sensor"
        )
    return sensors[index]
