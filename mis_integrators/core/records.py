"""Records of mixed fields in one array of 32-bit words, read and written four words at a time:
neighbours in a record are neighbours in memory."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

PACKET = 4


class Layout:
    """Fields of a record: `fields` maps names to types (`mi.Float`, `mi.UInt32`, or vectors of
    floats), in the order in which they lie."""

    def __init__(self, fields):
        self.fields, self.places, word = dict(fields), {}, 0
        for name, dtype in self.fields.items():
            size = 1 if dr.depth_v(dtype) == 1 else dr.size_v(dtype)
            self.places[name] = (word, size)
            word += size
        self.packets = -(-word // PACKET)

    def room(self, capacity):
        """An uninitialised array of `capacity` records."""
        return dr.empty(mi.UInt32, PACKET * self.packets * capacity)

    def write(self, words, values, index, active):
        """Writes whole records, `values` by name, to the places `index`."""
        flat = []
        for name, dtype in self.fields.items():
            value = dtype(values[name])
            parts = [value] if dr.depth_v(dtype) == 1 else list(value)
            flat += [
                part
                if dr.type_v(dtype) == dr.VarType.UInt32
                else dr.reinterpret_array(mi.UInt32, mi.Float(part))
                for part in parts
            ]
        flat += [mi.UInt32(0)] * (-len(flat) % PACKET)
        for packet in range(self.packets):
            dr.scatter(
                words,
                mi.Vector4u(*flat[PACKET * packet : PACKET * packet + PACKET]),
                index * self.packets + packet,
                active,
            )

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
                number = word // PACKET
                if number not in packets:
                    packets[number] = dr.gather(
                        mi.Vector4u, words, index * self.packets + number, active
                    )
                part = packets[number][word % PACKET]
                parts.append(
                    part
                    if dr.type_v(dtype) == dr.VarType.UInt32
                    else dr.reinterpret_array(mi.Float, part)
                )
            result[name] = parts[0] if dr.depth_v(dtype) == 1 else dtype(*parts)
        return result
