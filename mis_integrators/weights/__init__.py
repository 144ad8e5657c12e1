"""Weights of strategies that make the same paths: pure mathematics on NumPy and Dr.Jit arrays
alike.

Nothing here knows a renderer. `recursion` holds the optimal weights of any number of merging
strategies, `mis2` and `mis3` the printed closed forms for two and three of them, `heuristics`
Veach's balance and power heuristic, `bidirectional` the sums by which sub-paths carry it,
`resampling` the weights that know of resampled light sub-paths, `multiview` those of views that
share their paths.
"""

from typing import Any

Array = Any
"""A NumPy or Dr.Jit array of any shape that broadcasts, or a number."""
