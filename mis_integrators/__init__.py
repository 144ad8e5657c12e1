"""Integrators for Mitsuba 3 built on multiple importance sampling.

Importing this package makes a usable LLVM known to Dr.Jit and registers every plugin for the active Mitsuba
variant and for each variant set later; it does nothing else.
"""

from . import llvm

llvm.make_known()  # before anything imports Dr.Jit, which loads its LLVM once and for all

from . import _plugins  # noqa: E402

__version__ = "0.1.0"

_plugins.follow_variants()
