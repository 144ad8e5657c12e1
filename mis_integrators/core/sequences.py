"""Random numbers, low-discrepancy or independent: Sobol' points of up to four dimensions, scrambled
as Owen does it.

A *group* of paths (those of a pixel, or all light sub-paths) shares one sequence; the number of a
path in it, over all iterations, is its index. Every draw at every vertex is a point of a sequence
of its own: the same points in another order, scrambled otherwise (*padding*). So each draw is
stratified over the paths of the group, and draws are independent of each other.

Sources: Sobol' points, Sobol' 1967, with the direction numbers of Joe and Kuo 2008; nested uniform
scrambling, Owen 1995; by hashing, Laine and Karras 2011, and Burley, "Practical Hash-based Owen
Scrambling", 2020; the constants of `_scramble_reversed` are Vegdahl's of 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

Array = Any

PRIMITIVE = {2: (2, 1, (1, 3)), 3: (3, 1, (1, 3, 1))}
"""By dimension, counted from 0: degree and inner coefficients of its primitive polynomial, and the
first odd direction numbers (Joe and Kuo 2008)."""
BLOCK_BITS = 16
"""Points of more than two dimensions are nets of 2^16 points each, which are scrambled apart: with
more, coordinates from the third on are no longer stratified with those before. (Half the
instructions.)"""

ALONE = 0x6F776E21
"""Tells the hash by which a path has a sequence of its own from all others."""


def hash_bits(x):
    """A bijection of 32-bit words in which each bit in decides all bits out (the finaliser of
    MurmurHash3)."""
    x = (x ^ (x >> 16)) * mi.UInt32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * mi.UInt32(0xC2B2AE35)
    return x ^ (x >> 16)


def _scramble_reversed(x, seed):
    """Nested uniform scrambling of words whose lowest bit counts most: each bit is flipped or not
    by a hash of the bits below it."""
    x = ((x ^ (x * mi.UInt32(0x3D20ADEA))) + seed) * ((seed >> 16) | 1)
    x = x ^ (x * mi.UInt32(0x05526C56))
    return x ^ (x * mi.UInt32(0x53A22864))


def scramble(x, seed):
    """Nested uniform scrambling (Owen 1995): each bit of `x` is flipped or not by a hash of the
    bits above it and of the `seed`."""
    return dr.brev(_scramble_reversed(dr.brev(x), seed))


def _pascal(x):
    """The second Sobol' dimension from the first: the Pascal triangle modulo 2 as a matrix."""
    for shift, mask in (
        (16, 0xFFFFFFFF),
        (8, 0x00FF00FF),
        (4, 0x0F0F0F0F),
        (2, 0x33333333),
        (1, 0x55555555),
    ):
        x = x ^ ((x & mi.UInt32(mask)) << shift)
    return x


def direction_numbers(dimension: int) -> list[int]:
    """The 32 direction numbers of a Sobol' dimension from 2 on, as integers of 32 bits: column k
    is what bit k of the index flips (Joe and Kuo 2008, equation 2)."""
    degree, inner, first = PRIMITIVE[dimension]
    m = list(first)
    for k in range(degree, 32):
        new = m[k - degree] ^ (m[k - degree] << degree)
        for j in range(1, degree):
            if (inner >> (degree - 1 - j)) & 1:
                new ^= m[k - j] << j
        m.append(new)
    return [number << (31 - k) for k, number in enumerate(m)]


def _coordinate(order, reversed_order, dimension: int):
    """A coordinate, as 32 bits after the binary point, of the Sobol' points of these numbers; from
    dimension 2 on, of their lowest `BLOCK_BITS` bits."""
    if dimension == 0:
        return reversed_order
    if dimension == 1:
        return _pascal(reversed_order)
    total = mi.UInt32(0)
    for bit, column in enumerate(direction_numbers(dimension)[:BLOCK_BITS]):
        total ^= dr.select((order >> bit) & 1 == 1, mi.UInt32(column), 0)
    return total


def sobol(index, seed, dimensions: int = 1) -> list[Array]:
    """Scrambled Sobol' points in [0, 1)^dimensions, in an order of their own: the points of numbers
    a 2^k to (a + 1) 2^k - 1 stay together for all a, k. `index`, `seed`: uint32 arrays."""
    reversed_order = _scramble_reversed(dr.brev(mi.UInt32(index)), hash_bits(mi.UInt32(seed)))
    order = block = mi.UInt32(0)
    if dimensions > 2:
        order = dr.brev(reversed_order)
        block = (order >> BLOCK_BITS) * mi.UInt32(0x9E3779B9)
    found = []
    for k in range(dimensions):
        own = seed + mi.UInt32(k + 1)
        coordinate = _coordinate(order, reversed_order, k)
        found.append(unit(scramble(coordinate, hash_bits(own if k < 2 else own + block))))
    return found


def unit(bits):
    """Words as numbers in [0, 1), by their highest 24 bits."""
    return mi.Float(bits >> 8) * 2.0**-24


@dataclass
class SampleSequence:
    """The random numbers of a pass, whose paths form groups of `group_size`. `seed`: of a render's
    low-discrepancy numbers, or of this pass alone; `first`: the index of each group's first path,
    modulo 2^32; both uint32 arrays. With `low_discrepancy` numbers a group shares a sequence; else
    each path has one of its own, and all numbers are independent. An integer and a flag: both
    become arrays, so that one kernel serves all."""

    seed: Array
    first: Array
    group_size: Array
    low_discrepancy: Array

    def __post_init__(self):
        self.group_size, self.low_discrepancy = (
            dr.opaque(mi.UInt32, int(value)) if isinstance(value, int) else value
            for value in (self.group_size, self.low_discrepancy)
        )

    def of_paths(self, number) -> PathNumbers:
        """Those of the paths `number` of the pass (a uint32 array)."""
        group = mi.UInt32(number) // self.group_size
        return self.of_members(group, number - group * self.group_size)

    def of_members(self, group, member) -> PathNumbers:
        """Those of the paths that come `member`-th in their `group` (uint32 arrays)."""
        index = self.first + member
        own = dr.select(self.low_discrepancy != 0, mi.UInt32(0), hash_bits(index + ALONE))
        return PathNumbers(index, hash_bits(hash_bits(group) + self.seed + own))

    def own_seed(self):
        """A seed of this pass alone."""
        return hash_bits(self.seed + self.first)


class PathNumbers:
    """The random numbers of paths: the `index` of each in its sequence, and the sequence's `key`.
    (No dataclass, which Dr.Jit's loops would carry with them.)"""

    def __init__(self, index, key):
        self.index, self.key = index, key

    def at(self, vertex) -> VertexNumbers:
        """Those of one vertex (an integer, or an array)."""
        return VertexNumbers(self, vertex)


class VertexNumbers:
    """Random numbers of paths at a vertex, drawn like those of a generator. Which draw it is, is
    counted when the code is traced: so a branch that is not taken shifts nothing, and nothing is
    carried from vertex to vertex."""

    def __init__(self, path: PathNumbers, vertex):
        self._path = path
        self._key = path.key + mi.UInt32(vertex) * mi.UInt32(0x9E3779B9)
        self._draws = 0

    def next_floats(self, dimensions: int) -> list[Array]:
        """`dimensions` numbers in [0, 1), stratified together."""
        self._draws += 1
        seed = hash_bits(self._key + mi.UInt32(self._draws * 0x632BE5AB % 2**32))
        return sobol(self._path.index, seed, dimensions)

    def next_float32(self, active=True):
        """One number; `active` changes nothing (the interface of `mi.PCG32`)."""
        return self.next_floats(1)[0]

    def words(self, salt):
        """Two words that no other path at no other vertex has, and no other `salt` there."""
        return self._path.index, hash_bits(self._key + mi.UInt32(salt))
