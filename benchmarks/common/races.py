"""Renders of many views by several methods in equal time."""

from __future__ import annotations

from dataclasses import dataclass

from mis_integrators.analysis.metrics import RELATIVE_OFFSET

import numpy as np


@dataclass
class Race:
    """What came of renders of all views in equal time: per method and seed the views side by side
    (H, W, 3) and `(seconds, samples a pixel)`."""

    views: int
    images: dict[str, list[np.ndarray]]
    used: dict[str, list[tuple[float, int]]]

    @property
    def mean(self) -> np.ndarray:
        """Mean of the renders by `volpath`."""
        return np.mean(self.images["volpath"], axis=0)

    def noise(self, name: str) -> np.ndarray:
        """Relative variance of one render (H, W, 3)."""
        return np.var(self.images[name], axis=0, ddof=1) / (self.mean**2 + RELATIVE_OFFSET)

    def seconds(self, name: str) -> float:
        """Seconds that a render took: iterations overrun a little."""
        return float(np.mean([s for s, _ in self.used[name]]))

    def samples(self, name: str) -> int:
        """Camera paths a pixel."""
        return round(np.mean([n for _, n in self.used[name]]))

    def cost(self, name: str) -> float:
        """Relative variance x seconds."""
        return self.seconds(name) * float(self.noise(name).mean())
