"""The random numbers of paths: how independent they are of each other."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

GROUPS, PATHS = 20000, 32


def numbers(low_discrepancy, dimensions, vertices=4):
    """Numbers of `PATHS` paths a group, as Float64: (vertices * dimensions, GROUPS, PATHS)."""
    from mis_integrators.core.sequences import SampleSequence

    sequence = SampleSequence(
        dr.opaque(mi.UInt32, 2027), dr.opaque(mi.UInt32, 3 * PATHS), PATHS, low_discrepancy
    )
    path = dr.arange(mi.UInt32, GROUPS * PATHS)
    paths = sequence.of_paths(path)
    draws = [
        np.array(number, dtype=np.float64)
        for vertex in range(vertices)
        for number in paths.at(vertex).next_floats(dimensions)
    ]
    return np.reshape(draws, (-1, GROUPS, PATHS))


def variance_of_means(values):
    """Variance of the mean over a group times its size over the variance of one value: expected
    to be 1 if the paths of a group are independent."""
    return values.mean(axis=-1).var(axis=-1) * PATHS / values.var(axis=(-2, -1))


@pytest.mark.parametrize("dimensions", (1, 2, 3))
def test_independent_numbers_are_independent_within_a_group(rgb, dimensions):
    """The relative standard deviation of a variance found from `GROUPS` means is (2 / GROUPS)^(1/2)
    = 0.01; 6 of them, in 90 comparisons at most a case, are 2e-7 false alarms a case."""
    u = numbers(False, dimensions)
    values = [u, (u < 0.1).astype(float)]
    values.append(
        np.array([a * b for i, a in enumerate(u < 0.5) for b in u[:i] < 0.5], dtype=float)
    )
    for value in values:
        assert np.abs(variance_of_means(value) - 1).max() < 0.06


@pytest.mark.parametrize("dimensions", (1, 2, 3))
def test_sobol_numbers_are_stratified_within_a_group(rgb, dimensions):
    """A group's paths fill an aligned block of `PATHS` points: each dimension has one in each of
    `PATHS` intervals. No chance is involved."""
    u = numbers(True, dimensions)
    assert (np.sort((u * PATHS).astype(int), axis=-1) == np.arange(PATHS)).all()
