"""Sums over segments: the same in whatever order, and by whomever, iterations are summed."""

from mis_integrators.core import segments
from mis_integrators.core.sums import Iterations, Sums

import mitsuba as mi
import numpy as np
import pytest


def summed(iterations, tensor=None):
    """Sums of iterations of one pixel, each of which brings two to the power of its number."""
    sums = Sums(tensor) if tensor else Sums()
    for iteration in iterations:
        value = np.full((1, 1, 1), 2.0**iteration)
        sums.add("total", value)
        sums.add_to_segment(iteration, value)
        sums.done.add(iteration)
    return sums


def of_segments(sums):
    return [sums.arrays()[name].item() for name in segments.NAMES]


@pytest.mark.parametrize("end", [1, 2, 8, 9, 16, 17, 40])
def test_segments_are_runs_of_iterations(end):
    length = 2 ** segments.level(end)
    assert segments.SEGMENTS * length >= end and (
        length == 1 or segments.SEGMENTS * length // 2 < end
    )
    expected = [
        sum(2.0**i for i in range(k * length, min((k + 1) * length, end)))
        for k in range(segments.SEGMENTS)
    ]
    assert of_segments(summed(range(end))) == expected


@pytest.mark.parametrize("seed", range(8))
def test_any_order_and_any_parts_make_the_same_segments(rgb, seed):
    """41 iterations in a random order; the same by three workers in random batches, some of which
    pass through arrays; with Dr.Jit's tensors and NumPy's."""
    random = np.random.default_rng(seed)
    expected = summed(range(41))
    shuffled = summed(random.permutation(41).tolist(), mi.TensorXd)
    merged = Sums(mi.TensorXd if seed % 2 else np.array)
    for batch in np.array_split(random.permutation(41), np.sort(random.integers(1, 40, 6))):
        if len(batch):
            merged.merge(*summed(batch.tolist()).take())
    for sums in (shuffled, merged):
        assert sums.done == Iterations(41)
        assert of_segments(sums) == of_segments(expected)


def test_a_refused_merge_changes_nothing():
    sums = summed(range(8))
    before = of_segments(sums)
    other = summed([7, 100])
    with pytest.raises(ValueError):
        sums.merge(other.arrays(), other.done)
    assert of_segments(sums) == before and sums.done == Iterations(8)


@pytest.mark.parametrize(
    "below, beyond, length, complete",
    [
        (8, (), 1, [1] * 8),
        (5, (6,), 1, [1, 1, 1, 1, 1, 0, 1, 0]),
        (9, (), 2, [1, 1, 1, 1, 0, 0, 0, 0]),
        (9, (10, 11, 14), 2, [1, 1, 1, 1, 0, 1, 0, 0]),
        (0, (1, 2, 3), 1, [0, 1, 1, 1, 0, 0, 0, 0]),
        (2**40, (), 2**37, [1] * 8),
    ],
)
def test_complete_segments(below, beyond, length, complete):
    done = Iterations(below, beyond)
    found = segments.complete(done.below, done.beyond, done.end)
    assert found[0] == length and found[1].tolist() == [bool(flag) for flag in complete]
