"""Unit vectors and small integers in 32 bits, so that a photon's position and what its distance
test needs next to it share one 16-byte record; sizes and targets of buffers; and arrays that come
from NumPy or go there."""

import drjit as dr
import mitsuba as mi
import numpy as np

DEPTH_BITS = 9
MAX_DEPTH = (1 << DEPTH_BITS) - 1
_SURFACE_NORMAL_BITS = 11


def float_bits(x):
    """The bits of a float32 array as a uint32 array."""
    return dr.reinterpret_array(mi.UInt32, x)


def bits_float(u):
    """The float32 array whose bits are `u` (inverse of `float_bits`)."""
    return dr.reinterpret_array(mi.Float, u)


def _octahedral(v):
    """Maps unit vectors to [-1, 1]^2 (Meyer et al. 2010, octahedron unfolded to a square)."""
    scale = dr.rcp(dr.abs(v.x) + dr.abs(v.y) + dr.abs(v.z))
    x, y = v.x * scale, v.y * scale
    lower = v.z < 0
    return (
        dr.select(lower, dr.mulsign(1 - dr.abs(y), x), x),
        dr.select(lower, dr.mulsign(1 - dr.abs(x), y), y),
    )


def _inverse_octahedral(x, y):
    z = 1 - dr.abs(x) - dr.abs(y)
    fold = dr.maximum(-z, 0)
    return mi.Vector3f(x - dr.mulsign(fold, x), y - dr.mulsign(fold, y), z)


def _quantise(x, bits):
    half = 0.5 * ((1 << bits) - 1)
    return mi.UInt32(dr.fma(x, half, half + 0.5))


def _dequantise(u, bits):
    half = 0.5 * ((1 << bits) - 1)
    return dr.fma(mi.Float(u), 1 / half, -1)


def pack_direction(v):
    """Unit vector to uint32, 16 bits an axis (error below 1e-4 radians)."""
    x, y = _octahedral(v)
    return _quantise(x, 16) | (_quantise(y, 16) << 16)


def unpack_direction(u):
    """Inverse of `pack_direction`, not normalised (length between 0.57 and 1)."""
    return _inverse_octahedral(_dequantise(u & 0xFFFF, 16), _dequantise(u >> 16, 16))


def pack_surface(normal, depth, caustic):
    """A surface normal (11 bits an axis, error below 0.0025 radians), a path depth (9 bits,
    saturated at `MAX_DEPTH`) and the photon's kind (1 bit: caustic or not) in one uint32."""
    bits = _SURFACE_NORMAL_BITS
    x, y = _octahedral(normal)
    word = _quantise(x, bits) | (_quantise(y, bits) << bits)
    word |= dr.minimum(depth, MAX_DEPTH) << (2 * bits)
    return word | dr.select(caustic, mi.UInt32(1 << 31), mi.UInt32(0))


def unpack_normal(word):
    """The normal stored by `pack_surface`, not normalised (length between 0.57 and 1)."""
    bits = _SURFACE_NORMAL_BITS
    mask = (1 << bits) - 1
    return _inverse_octahedral(
        _dequantise(word & mask, bits), _dequantise((word >> bits) & mask, bits)
    )


def unpack_depth(word):
    """The depth stored by `pack_surface`."""
    return (word >> (2 * _SURFACE_NORMAL_BITS)) & MAX_DEPTH


def unpack_caustic(word):
    """The kind stored by `pack_surface`: true for caustic photons."""
    return (word >> 31) != 0


def gather_words(table, count, index, active):
    """Row `index` of a table of floats with `count` of them a row, a multiple of four: a list of
    arrays."""
    return [
        word
        for part in range(count // 4)
        for word in dr.gather(mi.Vector4f, table, count // 4 * index + part, active)
    ]


def rounded_up(count):
    """The next of 4, 5, 6, 7, 8, 10, 12, ...: few different buffer sizes, for they are literals of
    cached kernels."""
    step = 1 << max(count.bit_length() - 3, 0)
    return -(-count // step) * step


def with_reserve(count):
    """The size of a buffer for what was so many: an eighth more, `rounded_up`."""
    return rounded_up(count + count // 8)


ALIGNMENT = 64
"""Bytes."""


def from_numpy(dtype, values):
    """The numbers `values` (NumPy, flat) as a Dr.Jit array of type `dtype` in memory of its own.
    Without the copy Dr.Jit goes on using NumPy's memory, and kernels that read it are compiled anew
    whenever that happens to be aligned in another way; so is the one that copies."""
    values = np.asarray(values, np.float32 if dr.is_float_v(dtype) else np.uint32)
    array = dtype(_aligned(values))
    array = array + dr.opaque(dtype, 0)  # (a gather of all would be the array itself)
    dr.eval(array)
    return array


def _aligned(values):
    """A copy (flat) that begins at a multiple of `ALIGNMENT` bytes."""
    room = np.empty(values.nbytes + ALIGNMENT, np.uint8)
    first = -room.ctypes.data % ALIGNMENT
    copy = room[first : first + values.nbytes].view(values.dtype)
    copy[:] = values.ravel()
    return copy


def to_numpy(vectors):
    """Dr.Jit vectors as a NumPy array, one row a component. (`np.array` would write their number
    into a kernel, to be compiled anew for each.)"""
    return np.stack([np.array(component) for component in vectors])


SIGN = 1 << 31
"""The bit of a float that holds its sign."""


def with_mark(value, mark):
    """A spectrum that is nowhere negative, with a bit in the sign of its first channel."""
    value = mi.Spectrum(value)
    bits = float_bits(value[0]) & (SIGN - 1)
    value[0] = bits_float(bits | dr.select(mark, mi.UInt32(SIGN), mi.UInt32(0)))
    return value


def read_mark(value):
    """The spectrum and the bit that `with_mark` has put together."""
    value = mi.Spectrum(value)
    bits = float_bits(value[0])
    value[0] = bits_float(bits & (SIGN - 1))
    return value, bits >= SIGN


class Store:
    """Arrays that a symbolic loop scatters into. A plain object, so that Dr.Jit does not take them
    for the loop's state."""

    def __init__(self, **arrays):
        self.__dict__.update(arrays)
