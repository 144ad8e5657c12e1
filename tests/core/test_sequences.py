"""Low-discrepancy numbers: stratified in a group, independent between draws, vertices and groups.

Chi-square tests pass with a chance of 1 - `ALARM` each if all is right, and the seeds are fixed.
"""

import itertools
import math

import mis_integrators  # noqa: F401 (prepares Dr.Jit)
from mis_integrators.core.random import mix, reversed_bits
from mis_integrators.core.sequences import (
    SampleSequence,
    scramble,
    sobol,
    unit,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

MOST_DIMENSIONS = 4
ALARM = 1e-6
"""Chance that a test of a right program fails, if its seed were new."""

# Starts and lengths of aligned blocks of indices: short, long, and at the very end of 32 bits.
BLOCKS = [(0, 16), (48, 16), (0, 256), (5 * 256, 256), (2**32 - 64, 64)]


def points(first, count, seed, dimensions):
    index = mi.UInt32(first) + dr.arange(mi.UInt32, count)
    return np.stack([np.array(x) for x in sobol(index, mi.UInt32(seed), dimensions)], axis=1)


def sequence(seed=1, first=0, group_size=1, low_discrepancy=True):
    return SampleSequence(mi.UInt32(seed), mi.UInt32(first), group_size, low_discrepancy)


def chi_square_bound(freedom):
    """What a chi-square variable of so many degrees of freedom exceeds with chance `ALARM`, or less
    (Wilson and Hilferty's approximation, with 4.9 standard deviations for 4.75)."""
    return freedom * (1 - 2 / (9 * freedom) + 4.9 * math.sqrt(2 / (9 * freedom))) ** 3


def assert_uniform(cells, count):
    """Cell numbers below `count` are equally frequent."""
    found = np.bincount(cells, minlength=count)
    expected = len(cells) / count
    assert expected > 10 and len(found) == count
    assert np.sum((found - expected) ** 2) / expected < chi_square_bound(count - 1)


def cells_of(*coordinates, per_side=16):
    cell = 0
    for x in coordinates:
        cell = cell * per_side + np.floor(np.array(x) * per_side).astype(int)
    return cell


@pytest.mark.parametrize("first, count", BLOCKS)
@pytest.mark.parametrize("seed", [0, 77, 2**32 - 1])
def test_elementary_intervals_of_each_coordinate(variant, first, count, seed):
    for x in points(first, count, seed, MOST_DIMENSIONS).T:
        assert sorted(np.floor(x * count).astype(int)) == list(range(count))


@pytest.mark.parametrize("first, count", BLOCKS)
def test_elementary_intervals_of_pairs(rgb, first, count):
    """One point in each box of area 1/count, whatever its shape: the first two dimensions. Pairs
    with the others may have two (their quality t is one)."""
    found = points(first, count, 5, MOST_DIMENSIONS)
    bits = count.bit_length() - 1
    for (i, x), (j, y) in itertools.combinations(enumerate(found.T), 2):
        for k in range(bits + 1):
            cells = np.floor(x * 2**k).astype(int) * 2 ** (bits - k)
            cells += np.floor(y * 2 ** (bits - k)).astype(int)
            assert np.bincount(cells).max() <= (1 if (i, j) == (0, 1) else 2)


def test_four_dimensions_are_a_net(rgb):
    """Sobol' points of four dimensions have t = 3: 2^m points, 8 in each box of volume 2^(3-m)."""
    found = points(0, 1024, 9, 4)
    for sides in itertools.product(range(8), repeat=4):
        if sum(sides) == 7:
            cell = np.zeros(1024, int)
            for x, bits in zip(found.T, sides):
                cell = cell * 2**bits + np.floor(x * 2**bits).astype(int)
            assert (np.bincount(cell, minlength=128) == 8).all()


def test_scrambling_is_nested(rgb):
    """Words that share their first k bits still share k, and the next one differs as before."""
    words = np.random.default_rng(3).integers(0, 2**32, 4096, dtype=np.uint64)
    bit = np.random.default_rng(4).integers(0, 32, 4096).astype(np.uint64)
    other = words ^ (np.uint64(1) << bit)
    a, b = (
        np.array(scramble(mi.UInt32(x.astype(np.uint32)), mi.UInt32(8))) for x in (words, other)
    )
    highest = np.floor(np.log2((a ^ b).astype(np.float64))).astype(int)
    assert (highest == bit).all()


def test_scrambling_is_a_bijection(rgb):
    index = dr.arange(mi.UInt32, 1 << 16)
    assert len(np.unique(np.array(scramble(index, mi.UInt32(3))))) == 1 << 16


def test_numbers_lie_below_one(rgb):
    assert float(unit(mi.UInt32(2**32 - 1))[0]) < 1


def test_each_point_is_uniform_over_seeds(rgb):
    """Of any index, over seeds: so estimates are unbiased."""
    seed = dr.arange(mi.UInt32, 1 << 17)
    for index in (0, 1, 5, 2**32 - 1):
        x, y, z, w = sobol(mi.UInt32(index), seed, 4)
        assert_uniform(cells_of(x, y), 256)
        assert_uniform(cells_of(z, w), 256)
        assert_uniform(cells_of(x, z), 256)


def test_draws_are_independent_of_each_other(rgb):
    """Draws of a vertex, of successive vertices, and of neighbouring groups."""
    numbers = sequence().of_paths(dr.arange(mi.UInt32, 1 << 17))
    at = numbers.at(2)
    (a,), (b,), (c, d) = at.next_floats(1), at.next_floats(1), at.next_floats(2)
    (later,) = numbers.at(3).next_floats(1)
    for x, y in ((a, b), (a, c), (b, d), (a, later)):
        assert_uniform(cells_of(x, y), 256)
    neighbour = np.roll(np.array(a), 1)
    assert_uniform(cells_of(a, neighbour)[1::2], 256)


def test_draws_of_one_sequence_are_independent_of_each_other(rgb):
    """Within a group, over its indices, two draws are not in step: both are stratified, and the
    pair is as uniform as if they were drawn at random (padding)."""
    numbers = sequence(seed=6, group_size=1 << 17).of_paths(dr.arange(mi.UInt32, 1 << 17))
    at = numbers.at(1)
    (a,), (b,) = at.next_floats(1), at.next_floats(1)
    assert_uniform(cells_of(a, b), 256)


def test_groups_are_stratified_over_passes(rgb):
    """Four passes of four paths a group are sixteen points of the group's sequence."""
    found = []
    for number in range(4):
        numbers = sequence(first=4 * number, group_size=4).of_paths(dr.arange(mi.UInt32, 40))
        found.append(np.array(numbers.at(1).next_floats(1)[0]).reshape(10, 4))
    for group in np.concatenate(found, axis=1):
        assert sorted(np.floor(group * 16).astype(int)) == list(range(16))


def test_a_draw_left_out_shifts_nothing(rgb):
    """What a vertex draws does not depend on how much was drawn at others."""
    numbers = sequence().of_paths(dr.arange(mi.UInt32, 8))
    plain = np.array(numbers.at(2).next_float32())
    busy = numbers.at(1)
    for _ in range(5):
        busy.next_float32()
    assert (np.array(numbers.at(2).next_float32()) == plain).all()


@pytest.mark.parametrize("group_size", [1, 8, 1 << 17])
def test_independent_numbers(rgb, group_size):
    """Uniform, pairwise independent over draws, paths and passes, however the paths form groups:
    those of a group are no more even than by chance (as the Poisson distribution has it, within 5
    standard errors: false alarms below 1e-6)."""
    paths = dr.arange(mi.UInt32, 1 << 17)

    def vertex(**given):
        given = {"low_discrepancy": False, "group_size": group_size, **given}
        return sequence(**given).of_paths(paths).at(1)

    at = vertex()
    a, b, c = at.next_floats(3)
    (d,) = at.next_floats(1)
    (other,), (later,) = (
        vertex(**given).next_floats(1) for given in ({"seed": 2}, {"first": group_size})
    )
    near, far = (np.roll(np.array(a), shift) for shift in (1, 4))
    for x, y in ((a, b), (b, c), (c, d), (a, other), (a, later), (a, near), (a, far)):
        assert_uniform(cells_of(x, y), 256)
    counts = np.bincount((np.array(a) * (1 << 14)).astype(int), minlength=1 << 14)
    assert abs(counts.var() / counts.mean() - 1) < 5 * math.sqrt(2 / (1 << 14))


def test_variance_falls_faster(rgb):
    """The integral of a smooth function of two numbers with 64 points: variance at least 30 times
    below that of independent ones (about 200 times; estimated from 4000 groups, so within 10 %),
    and means that are right: within 5 standard errors, false alarms below 1e-6."""
    spread = {}
    for low_discrepancy in (True, False):
        numbers = sequence(seed=11, group_size=64, low_discrepancy=low_discrepancy).of_paths(
            dr.arange(mi.UInt32, 64 * 4000)
        )
        x, y = numbers.at(1).next_floats(2)
        values = np.array(dr.sin(dr.pi * x) * dr.exp(y), float).reshape(4000, 64).mean(axis=1)
        error = abs(values.mean() - 2 / math.pi * (math.e - 1))
        assert error < 5 * values.std() / math.sqrt(4000)
        spread[low_discrepancy] = values.var()
    assert spread[True] < spread[False] / 30


def test_reversed_bits():
    numbers = [reversed_bits(i) / 2**32 for i in range(8)]
    assert numbers == [0, 0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875]
    assert reversed_bits(2**32 + 1) == reversed_bits(1)
    assert mix(1) != mix(2)
