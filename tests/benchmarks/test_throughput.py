"""How `throughput` sorts the kernels of an iteration."""

from types import SimpleNamespace

import drjit as dr
import pytest


def kernel(size, milliseconds, type=dr.KernelType.JIT):
    return {"size": size, "execution_time": milliseconds, "type": type}


def test_kernels_are_sorted(rgb):
    """A kernel that only numbers camera paths is not the camera pass."""
    from experiments.throughput import Parts

    parts = Parts.__new__(Parts)
    parts._session, parts.rows = SimpleNamespace(chunk=100), []
    parts._kernels = {
        "light": [kernel(50, 4.0)],
        "grid": [kernel(60, 1.0)],
        "rest": [
            kernel(100, 0.1),
            kernel(400, 0.2, dr.KernelType.Memset),
            kernel(100, 2.0),
            kernel(200, 5.0),
            kernel(100, 0.5),
        ],
    }
    parts.observe([kernel(30, 1.2)], 0.02)
    found = {part: parts[part] for part in ("light", "grid", "camera", "gather", "direct", "idle")}
    assert found == pytest.approx(
        {"light": 4.0, "grid": 1.0, "camera": 2.3, "gather": 5.5, "direct": 1.2, "idle": 0.3}
    )
