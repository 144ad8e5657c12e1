"""Photons near vertices, over flat arrays: sums of any function of them, and lists of pairs.

A sum visits the photons of each vertex and keeps a few numbers (`sum_photons`). Where what is to be
known of one photon and one vertex needs a gather of its own, the pairs are written out first
(`photon_pairs`), and that gather is made once for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.spectra import channel_mean
from .gather import Scattering, landing_cosine, same_side, same_surface, within_disk
from .grid import for_each_photon
from .photon import read_landing, read_power

PAIRS_AT_ONCE = 1 << 19
"""Pairs that are evaluated together (bounds memory)."""


MISSING = (1 << 32) - 1
"""Stands for a pair that has been counted and is not found again."""


def parts(count: int):
    """Numbers 0, 1, ..., count - 1 in parts of `PAIRS_AT_ONCE` at most."""
    for first in range(0, count, PAIRS_AT_ONCE):
        yield dr.arange(mi.UInt32, min(PAIRS_AT_ONCE, count - first)) + dr.opaque(mi.UInt32, first)


def take(value, index):
    """`dr.gather` for numbers, vectors, structures."""
    return dr.gather(type(value), value, index)


@dataclass
class Meeting:
    """One photon at one vertex, a pair an element.

    `landing`: where the photon landed; `scattering`: how the vertex scatters its light; `flux` (a
    spectrum) of one light sub-path; `cosines`: shading cosine at the vertex over geometric cosine
    where the photon landed; `lit`: the vertex scatters its light at all.
    """

    landing: object
    scattering: Scattering
    flux: mi.Spectrum
    cosines: mi.Float
    lit: mi.Bool

    @property
    def f(self):
        """BSDF, mean over the channels [1/sr]."""
        return channel_mean(self.scattering.f)

    @property
    def p(self):
        """Density of the camera path's direction, per projected solid angle [1/sr]."""
        return mi.Float(self.scattering.p)


def meet(photon_map, vertices, index, landing, active):
    """The `Meeting` of photons `index` with vertices (a `QueryVertices`)."""
    flux, towards = read_power(photon_map.power, index, active)
    active = active & same_side(landing, vertices.n, towards)
    scattering = vertices.scatter(towards, True, active)
    cosines = scattering.shading * dr.rcp(landing_cosine(landing.n, scattering, vertices.plane))
    lit = active & (dr.max(scattering.value) > 0)
    return Meeting(landing, scattering, flux, cosines, lit)


def _within(vertices, landing, offset, squared, radius, longest, hit):
    """Which photons merge with a vertex (as in `gather_photons`); `longest`: segments of a photon
    at most (negative: unlimited)."""
    hit = hit & same_surface(landing, vertices.n) & within_disk(offset, squared, vertices.n, radius)
    return hit & (landing.depth <= longest) if longest >= 0 else hit


def sum_photons(photon_map, vertices, radius, light_path_count, longest: int, count: int, terms):
    """Photon sums 1 / (pi R^2 N_F) x sum of term x flux, at each vertex: estimates of the integral
    of term x incident radiance over projected solid angle.

    `vertices`: a `QueryVertices`; `terms(index, meeting)`: `count` numbers a photon, a tuple;
    `longest`: as of `_within`. Flux is the mean over the channels.
    """

    def visit(index, landing, offset, squared, hit, totals):
        hit = _within(vertices, landing, offset, squared, radius, longest, hit)
        meeting = meet(photon_map, vertices, index, landing, hit)
        carried = channel_mean(meeting.flux) * meeting.cosines
        return tuple(
            total + dr.select(meeting.lit, term * carried, 0)
            for total, term in zip(totals, terms(index, meeting))
        )

    zeros = tuple(mi.Float(0) for _ in range(count))
    totals = for_each_photon(photon_map, vertices.p, radius, vertices.active, visit, zeros)
    scale = dr.rcp(dr.pi * dr.square(radius) * light_path_count)
    totals = [dr.select(vertices.active, total * scale, 0) for total in totals]
    dr.eval(totals)
    return totals


def photon_pairs(photon_map, vertices, radius, longest: int):
    """All pairs of a vertex and a photon that merges with it: `(vertex, photon)`, numbers of both
    (uint32, sorted by vertex). Reads how many there are."""

    def visit(index, landing, offset, squared, hit, state):
        hit = _within(vertices, landing, offset, squared, radius, longest, hit)
        return (state[0] + dr.select(hit, mi.UInt32(1), mi.UInt32(0)),)

    (counts,) = for_each_photon(
        photon_map, vertices.p, radius, vertices.active, visit, (mi.UInt32(0),)
    )
    counts = counts + dr.zeros(mi.UInt32, dr.width(vertices.p))
    first = dr.prefix_sum(counts)
    dr.eval(counts, first)
    total = int(dr.sum(counts)[0])
    vertex, photon = (dr.full(mi.UInt32, MISSING, max(total, 1)) for _ in range(2))
    dr.eval(vertex, photon)
    number, end = dr.arange(mi.UInt32, dr.width(counts)), first + counts

    def write(index, landing, offset, squared, hit, state):
        hit = _within(vertices, landing, offset, squared, radius, longest, hit)
        hit &= state[0] < end  # rounding may differ from that of the kernel that counts
        dr.scatter(vertex, number, state[0], hit)
        dr.scatter(photon, index, state[0], hit)
        return (state[0] + dr.select(hit, mi.UInt32(1), mi.UInt32(0)),)

    for_each_photon(photon_map, vertices.p, radius, vertices.active, write, (mi.UInt32(first),))
    dr.eval(vertex, photon)
    there = dr.compress(photon != MISSING)
    return dr.gather(mi.UInt32, vertex, there), dr.gather(mi.UInt32, photon, there)


def meeting_of(photon_map, vertices, photon):
    """The `Meeting` of pairs: vertices (a `QueryVertices`), and a photon for each."""
    landing = read_landing(photon_map.surface, photon)
    return meet(photon_map, vertices, photon, landing, vertices.active)
