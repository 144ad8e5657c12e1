"""Records of mixed fields in one array of 32-bit words, read and written a packet at a time:
neighbours in a record are neighbours in memory.

Pointers are words, too. A recorded function that reads them back must have the scene among its
arguments: from words Dr.Jit does not know that objects are called."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

PACKET = 4
"""Words of a packet; records of two words or fewer are packets of two."""


def word_count(dtype):
    """Words of a field: a number, a pointer, a vector, or a structure of these."""
    if hasattr(dtype, "DRJIT_STRUCT"):
        return sum(word_count(member) for member in dtype.DRJIT_STRUCT.values())
    return 1 if dr.depth_v(dtype) == 1 else dr.size_v(dtype)


def to_words(dtype, value):
    """The 32-bit words of a value, a list of arrays."""
    if hasattr(dtype, "DRJIT_STRUCT"):
        return [
            word
            for name, member in dtype.DRJIT_STRUCT.items()
            for word in to_words(member, getattr(value, name))
        ]
    value = dtype(value)
    if dr.depth_v(dtype) > 1:
        return [word for part in value for word in to_words(dr.value_t(dtype), part)]
    if dr.is_mask_v(dtype):
        return [dr.select(value, mi.UInt32(1), mi.UInt32(0))]
    return [value if dtype is mi.UInt32 else dr.reinterpret_array(mi.UInt32, value)]


def from_words(dtype, words):
    """The value of a list of words (inverse of `to_words`)."""
    if hasattr(dtype, "DRJIT_STRUCT"):
        value, words = dtype(), list(words)
        for name, member in dtype.DRJIT_STRUCT.items():
            mine, words = words[: word_count(member)], words[word_count(member) :]
            setattr(value, name, from_words(member, mine))
        return value
    if dr.depth_v(dtype) > 1:
        return dtype(*(from_words(dr.value_t(dtype), [word]) for word in words))
    if dr.is_mask_v(dtype):
        return words[0] != 0
    return words[0] if dtype is mi.UInt32 else dr.reinterpret_array(dtype, words[0])


def packet_type(size):
    """A vector of two or four words."""
    return mi.Vector2u if size == 2 else mi.Vector4u


def write_packets(words, flat, index, active=True):
    """Writes records, given as a list of words (two, or a multiple of four), to the places
    `index`."""
    size = min(len(flat), PACKET)
    packets = len(flat) // size
    for number in range(packets):
        packet = packet_type(size)(*flat[size * number : size * (number + 1)])
        dr.scatter(words, packet, index * packets + number, active)


class Layout:
    """Fields of a record: `fields` maps names to types (numbers, pointers, vectors, structures), in
    the order in which they lie."""

    def __init__(self, fields):
        self.fields, self.places, word = dict(fields), {}, 0
        for name, dtype in self.fields.items():
            size = word_count(dtype)
            self.places[name] = (word, size)
            word += size
        self.used = word
        self.packet = 2 if word <= 2 else PACKET
        self.packets = -(-word // self.packet)

    @property
    def words(self):
        """Words of a record, with what fills up its last packet."""
        return self.packet * self.packets

    def room(self, capacity):
        """An uninitialised array of `capacity` records."""
        return dr.empty(mi.UInt32, self.words * capacity)

    def capacity(self, words):
        """Records that an array has room for."""
        return dr.width(words) // self.words

    def flat(self, values):
        """The words of records, `values` by name: a list of arrays."""
        flat = [
            word for name, dtype in self.fields.items() for word in to_words(dtype, values[name])
        ]
        return flat + [mi.UInt32(0)] * (self.words - len(flat))

    def write(self, words, values, index, active=True):
        """Writes whole records, `values` by name, to the places `index`."""
        write_packets(words, self.flat(values), index, active)

    def read(self, words, index, active=True, only=None):
        """Fields (all, or those named in `only`) of the records at places `index`, by name; zero on
        inactive lanes."""
        packets, result = {}, {}
        for name, dtype in self.fields.items():
            if only is not None and name not in only:
                continue
            first, size = self.places[name]
            parts = []
            for word in range(first, first + size):
                number = word // self.packet
                if number not in packets:
                    packets[number] = self._read_packet(words, index, number, active)
                parts.append(packets[number][word % self.packet])
            result[name] = from_words(dtype, parts)
        return result

    def _read_packet(self, words, index, number, active):
        """Packet `number` of records; of one that holds a single word, only that word."""
        if self.used - self.packet * number == 1:
            return [dr.gather(mi.UInt32, words, index * self.words + self.packet * number, active)]
        return dr.gather(packet_type(self.packet), words, index * self.packets + number, active)

    def move(self, words, index, target, active):
        """Another array of as many records, with those at places `index` copied to places
        `target`."""
        result = dr.empty(mi.UInt32, dr.width(words))
        for number in range(self.packets):
            packet = dr.gather(
                packet_type(self.packet), words, index * self.packets + number, active
            )
            dr.scatter(result, packet, target * self.packets + number, active)
        return result
