"""Random numbers: seeds, independent streams, and draws from streams and sequences alike."""

import mitsuba as mi

from .sequences import VertexNumbers


def mix(*words):
    """Hashes non-negative integers to one of 32 bits (splitmix64 finaliser applied word by
    word)."""
    state = 0x9E3779B97F4A7C15
    for word in words:
        state = (state ^ (int(word) & 0xFFFFFFFFFFFFFFFF)) & 0xFFFFFFFFFFFFFFFF
        state = (state * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 27
        state = (state * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        state ^= state >> 31
    return state & 0xFFFFFFFF


def reversed_bits(number):
    """The lowest 32 bits of an integer in reverse order: over 2^32, the van der Corput sequence."""
    return int(f"{number % 2**32:032b}"[::-1], 2)


def streams(index, seed):
    """A PCG32 generator for every path `index` (uint32 array) under `seed` (uint32, opaque to keep
    kernels cached)."""
    low, high = mi.sample_tea_32(index, seed)
    return mi.PCG32(initstate=mi.UInt64(low) | (mi.UInt64(high) << 32), initseq=mi.UInt64(index))


def vertex_streams(path, number, seed):
    """A generator for every kept vertex `number` of sub-path `path`: not for its place in a buffer,
    which chance decides."""
    return streams(path, seed + number * mi.UInt32(0x9E3779B9))


def own_stream(draws, salt):
    """A generator of its own for each path at the vertex of `draws` (a `VertexNumbers`), for what
    takes a number of draws that is not known; `salt`: an integer, one for each purpose."""
    return streams(*draws.words(salt))


def next_floats(rng, dimensions, active=True):
    """So many uniform numbers in [0, 1); of a `VertexNumbers`, stratified together."""
    if isinstance(rng, VertexNumbers):
        return rng.next_floats(dimensions)
    return [rng.next_float32(active) for _ in range(dimensions)]


def next_1d_and_2d(rng, active=True):
    """A uniform number and a point, stratified together: for a choice, and a point or direction of
    what is chosen."""
    choice, x, y = next_floats(rng, 3, active)
    return choice, mi.Point2f(x, y)


def next_2d(rng, active=True):
    """Two uniform numbers in [0, 1) as a point; advances `rng`."""
    return mi.Point2f(*next_floats(rng, 2, active))
