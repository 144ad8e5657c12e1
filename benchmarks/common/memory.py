"""Peak memory of this process and of Dr.Jit, from a moment on where the system allows it."""

from __future__ import annotations

import gc
import resource
from pathlib import Path

import drjit as dr

_MIB = 1 << 20


class PeakMemory:
    """Peak memory since this object was made.

    The process' own peak starts afresh on Linux only; elsewhere it is the peak since the process
    began.
    """

    def __init__(self) -> None:
        gc.collect()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        try:
            Path("/proc/self/clear_refs").write_text("5")
        except OSError:
            pass

    @property
    def process(self) -> float:
        """Peak resident memory in MiB."""
        try:
            lines = Path("/proc/self/status").read_text().splitlines()
        except OSError:
            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))

    @property
    def arrays(self) -> float:
        """Peak of Dr.Jit's arrays in MiB."""
        return dr.detail.malloc_watermark(dr.JitBackend.LLVM) / _MIB
