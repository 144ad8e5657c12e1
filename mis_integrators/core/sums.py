"""Sums over iterations: all of a render in progress that a checkpoint, or the process that gathers
the work of others, needs to know."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from . import segments


class Iterations:
    """A set of iteration numbers that is nearly 0, 1, ..., n - 1: those below a number, and some
    beyond it."""

    def __init__(self, below: int = 0, beyond: tuple[int, ...] = ()):
        self.below = below
        self.beyond: set[int] = set()
        for iteration in beyond:
            self.add(iteration)

    def __len__(self) -> int:
        return self.below + len(self.beyond)

    def __contains__(self, iteration: int) -> bool:
        return iteration < self.below or iteration in self.beyond

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Iterations) and (self.below, self.beyond) == (
            other.below,
            other.beyond,
        )

    @property
    def first_missing(self) -> int:
        """The least number that is not in the set."""
        return self.below

    @property
    def end(self) -> int:
        """The least number that all in the set are below."""
        return max(self.beyond, default=self.below - 1) + 1

    def even(self) -> int:
        """How many of the numbers are even."""
        return (self.below + 1) // 2 + sum(1 for iteration in self.beyond if iteration % 2 == 0)

    def add(self, iteration: int) -> None:
        """Add a number; raises ``ValueError`` if it is in the set, for nothing may be summed
        twice."""
        if iteration in self or iteration < 0:
            raise ValueError(f"iteration {iteration} is among those summed already, or negative")
        self.beyond.add(iteration)
        while self.below in self.beyond:
            self.beyond.remove(self.below)
            self.below += 1

    def copy(self) -> Iterations:
        """The same set, which changes by itself."""
        return Iterations(self.below, tuple(self.beyond))

    def update(self, other: Iterations) -> None:
        """Add all numbers of a disjoint set."""
        if not len(self):
            self.below, self.beyond = other.below, set(other.beyond)
            return
        for iteration in (*range(other.below), *sorted(other.beyond)):
            self.add(iteration)

    def as_json(self) -> list:
        """The set in JSON's types; ``Iterations(*value)`` makes it again."""
        return [self.below, sorted(self.beyond)]


class Sums:
    """Named sums over iterations, in double precision, and which iterations are in them. Their size
    does not grow with iterations.

    ``tensor`` converts what is added to the type of the sums: ``mi.TensorXd``, or that of NumPy.
    """

    def __init__(self, tensor: Callable[[Any], Any] = lambda value: np.array(value, np.float64)):
        self._tensor = tensor
        self.tensors: dict[str, Any] = {}
        self.done = Iterations()

    def __getitem__(self, name: str) -> Any:
        return self.tensors[name]

    def add(self, name: str, value: Any) -> None:
        """Add to the sum of that name."""
        value = self._tensor(value)
        self.tensors[name] = self.tensors[name] + value if name in self.tensors else value

    def add_to_segment(self, iteration: int, value: Any) -> None:
        """Add to the sum of the segment that an iteration is in, before it is among those
        ``done``."""
        end = max(self.done.end, iteration + 1)
        self._make_room(end)
        value = self._tensor(value)
        if segments.NAMES[0] not in self.tensors:
            self.tensors |= {name: segments.zeros_like(value) for name in segments.NAMES}
        self.add(segments.NAMES[iteration >> segments.level(end)], value)

    def _make_room(self, end: int) -> None:
        """Make segments long enough for iterations below a number."""
        levels = segments.level(end) - segments.level(self.done.end)
        self.tensors = segments.coarser(self.tensors, levels)

    @contextlib.contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Where the block ends with an error, the sums are what they were before it."""
        tensors, done = dict(self.tensors), self.done.copy()
        try:
            yield
        except BaseException:
            self.tensors, self.done = tensors, done
            raise

    def arrays(self) -> dict[str, np.ndarray]:
        """The sums as float64 arrays."""
        return {name: np.array(tensor, np.float64) for name, tensor in self.tensors.items()}

    def merge(self, arrays: Mapping[str, np.ndarray], done: Iterations) -> None:
        """Add the sums of other iterations. Raises ``ValueError`` if one of these is in the sums
        already, or if others are summed."""
        shapes = {name: tuple(array.shape) for name, array in arrays.items()}
        mine = {name: tuple(tensor.shape) for name, tensor in self.tensors.items()}
        if self.tensors and shapes != mine:
            raise ValueError(f"sums do not match: {shapes} and {mine}")
        end = max(self.done.end, done.end)
        both = self.done.copy()
        both.update(done)
        self._make_room(end)
        self.done = both
        levels = segments.level(end) - segments.level(done.end)
        for name, array in segments.coarser(arrays, levels).items():
            self.add(name, array)

    def take(self) -> tuple[dict[str, np.ndarray], Iterations]:
        """The sums and their iterations; then nothing is summed any more."""
        arrays, done = self.arrays(), self.done
        self.tensors, self.done = {}, Iterations()
        return arrays, done
