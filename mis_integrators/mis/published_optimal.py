"""Where transport and the published optimal weights meet: MIS-2 and MIS-3 as they are printed.

The weights of Ershov, Kopylov and Voloboy for two and three strategies (`weights.mis2`,
`weights.mis3`) need the luminance L of a vertex, its second photon sum b, and integrals over
directions. All of them are photon sums in one frozen photon map, gathered at the vertices of both
halves of a path. They are made once, and are the same functions of the path for every strategy:
the weights of a path sum to one, whatever the frozen map holds.

Every number is a scalar: the mean over the channels stands for the luminance. Densities need not be
f / albedo, as the papers have it: E1 stands for f0 / p0 and E2 for E1 f1 / p1, the throughput of
the camera path that goes that way.

Nothing is kept from being singular. Only what could divide zero by zero has a bound: BSDF values
and densities are at least `SMALLEST_VALUE`; L in b/L, alpha and det A at least `SMALLEST_DIVISOR`.
The denominators 1 - n B2, det B and that of F are left as they come out, of either sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..core.spectra import channel_mean
from ..photons.chains import NONE
from ..photons.gather import QueryVertices
from ..photons.grid import build_photon_map
from ..photons.pairs import meeting_of, parts, photon_pairs, sum_photons, take
from ..photons.photon import read_landing, read_power, surface_layout
from ..weights import mis2, mis3

SMALLEST_VALUE = 1e-8
"""Stands for zero BSDF values and densities [1/sr]: 0/0 in p/f, E1 = f0/p0 and E2."""
SMALLEST_DIVISOR = 1e-30
"""Stands for zero in other divisors: L where no photon is near, alpha and det A."""


def positive(value):
    """A BSDF value or a density, not zero."""
    return dr.maximum(value, SMALLEST_VALUE)


def light_layout():
    """What is known of the light of a vertex: `L0` (luminance under direct light, caustics among
    it), `L` (under all light), `b` (photon sum of f^2 over other than direct light)."""
    return Layout({"L0": mi.Float, "L": mi.Float, "b": mi.Float})


@dataclass(frozen=True)
class PhotonLengths:
    """How long photons may be, in segments (negative: unlimited), that are gathered at z0, z1, ...:
    longer ones would make paths beyond `max_depth`. z_0 is the camera vertex `first`."""

    max_depth: int
    first: int

    def at(self, level):
        if self.max_depth < 0:
            return -1
        return max(self.max_depth - (self.first + level + 1), 0)


class FrozenMap:
    """A light pass of `paths` sub-paths that is kept for the whole render, and used only for
    weights.

    `chains`: its photons (`PhotonChains`, direct light's among them), in a map of radius `radius`;
    `light`: what is known of where each photon comes from (records of `light_layout`).
    """

    def __init__(self, traits, chains, paths, radius, wavelengths, limits, strategies):
        capacity = surface_layout().capacity(chains.surface)
        self.traits, self.chains, self.radius, self.wavelengths = (
            traits,
            chains,
            radius,
            wavelengths,
        )
        self.paths = dr.opaque(mi.Float, paths)
        self.limits, self.strategies = limits, strategies
        self.photon_map = build_photon_map(
            chains.surface,
            chains.power,
            chains.count,
            traits.bounds,
            radius,
            capacity,
            "all",
            chains.words,
        )
        self.light = self.appraise(chains)

    def vertices(self, record):
        """`QueryVertices` of records of `queries.query_layout`."""
        return QueryVertices(self.traits, record, self.wavelengths)

    def sums(self, vertices, level, count, terms):
        """Photon sums (`sum_photons`) at vertices z_level; `terms(place, meeting)`: `place` is that
        of the photon among the `chains`."""

        def with_place(index, meeting):
            return terms(self.photon_map.place_of_mis_words(index, meeting.lit), meeting)

        longest = self.limits.at(level)
        return sum_photons(
            self.photon_map, vertices, self.radius, self.paths, longest, count, with_place
        )

    def light_at(self, vertices, level):
        """L0, L and b of vertices z_level: (36) and (37) of the two-strategies preprint, L = photon
        sum of f, b = photon sum of f^2 over other than direct light."""

        def terms(place, meeting):
            direct = meeting.landing.caustic
            f = meeting.f
            return dr.select(direct, f, 0), f, dr.select(direct, 0, dr.square(f))

        return self.sums(vertices, level, 3, terms)

    def appraise(self, chains):
        """Records of `light_layout` of where photons come from, seen from where they landed. Of L
        and b those at the last vertex at which photons merge, of L0 that of z_1."""
        capacity = surface_layout().capacity(chains.surface)
        place = dr.arange(mi.UInt32, capacity)
        vertices = self.vertices(chains.record(place, place < chains.count))
        L0, L, b = self.light_at(vertices, self.strategies - 1)
        if self.strategies > 2:
            L0, _, _ = self.light_at(vertices, 1)
        words = light_layout().room(capacity)
        light_layout().write(words, {"L0": L0, "L": L, "b": b}, place)
        dr.eval(words)
        return words

    @staticmethod
    def light_of(words, place, active):
        """L0, L and b of where photons come from; zero for those that do not exist."""
        record = light_layout().read(words, place, active)
        return record["L0"], record["L"], record["b"]


def typical_flux(chains):
    """Flux of a typical photon that has scattered smoothly: the mean over photons, weighted by
    itself. (The papers' photons all carry the same.)"""
    place = dr.arange(mi.UInt32, surface_layout().capacity(chains.surface))
    stored = place < chains.count
    flux, _ = read_power(chains.power, place, stored)
    scattered = stored & ~read_landing(chains.surface, place, stored).caustic
    flux = dr.select(scattered, channel_mean(flux), 0)
    total, square = float(dr.sum(flux)[0]), float(dr.sum(dr.square(flux))[0])
    return square / total if total > 0 else 0.0


class TwoStrategies:
    """MIS-2: photons at z_0 have the weight w0; photons and direct light at z_1 have w1.

    `n`: photons per unit of irradiance in the merge disk (width one); `camera_paths`: N_B."""

    def __init__(self, frozen, n, camera_paths):
        self.frozen, self.n, self.camera_paths = frozen, n, camera_paths

    def local(self, f, p, L, b):
        """f and p, not zero, alpha and W1 of directions from z_0."""
        f, p, L = positive(f), positive(p), dr.maximum(L, SMALLEST_DIVISOR)
        g = mis2.shared_density(p, self.camera_paths, self.frozen.limits.first)
        alpha = dr.maximum(mis2.denominator(g, self.n, b, L), SMALLEST_DIVISOR)
        return f, p, alpha, mis2.local_weight(g, self.n, alpha)

    def roots(self, record):
        """A2 and n B2 of vertices z_0: (38) and (39) of the two-strategies preprint, photon sums of
        W1 f and of p / alpha over light that has scattered (direct light at z_0 is not shared)."""
        frozen = self.frozen

        def terms(place, meeting):
            scattered = meeting.lit & ~meeting.landing.caustic
            _, L, b = frozen.light_of(frozen.light, place, scattered)
            f, p, alpha, W1 = self.local(meeting.f, meeting.p, L, b)
            integrands = mis2.light_integrand(W1, f, 1), mis2.loss_integrand(p, 1, alpha)
            return tuple(dr.select(scattered, value, 0) for value in integrands)

        return frozen.sums(frozen.vertices(record), 0, 2, terms)

    def deeper(self, f, p, L, b, root):
        """w1 of directions from vertices z_0, whose `root` is A2 and n B2; w0 = 1 - w1."""
        f, p, alpha, W1 = self.local(f, p, L, b)
        return mis2.deeper_weight(W1, p, f, alpha, *root)

    def of_photons(self, meeting, chains, light, place, root):
        """w0 of photons that are merged at z_0; `place`: among the `chains`."""
        _, L, b = self.frozen.light_of(light, place, meeting.lit)
        return 1 - self.deeper(meeting.f, meeting.p, L, b, root)

    def of_last(self, record, link, root):
        """w1 of vertices z_1 that a camera path has made: of direct light and photons there."""
        _, L, b = self.frozen.light_at(self.frozen.vertices(record), 1)
        return self.deeper(link["f"], link["p"], L, b, root)


class Middle:
    """Vertices z_1 and the directions to them, in MIS-3: q, E1 (the throughput f0/p0), W20, W21, D,
    and `h`, h1 and h2. `known`: f0, p0, L0, h1, h2, of which all else is made; `F`: of z_0."""

    def __init__(self, n, camera_paths, f0, p0, L0, F, h=None):
        self.n, self.camera_paths, self.F, self.h = n, camera_paths, F, h
        self.given = f0, p0, L0
        self.f0, self.E1 = positive(f0), positive(f0) / positive(p0)
        self.q = mis3.first_cost(self.f0, camera_paths)
        self.W20, self.W21, self.D = mis3.local_direct(self.q, n, self.E1, L0)

    def at(self, index, active=True):
        """The vertices of these numbers."""
        arrays = [dr.gather(mi.Float, x, index, active) for x in (*self.given, self.F, *self.h)]
        return Middle(self.n, self.camera_paths, *arrays[:4], h=arrays[4:])

    def matrix_A(self, f1, p1, L, b):
        """A11, A12, A22 and their determinant, of directions from z_1."""
        f1, p1, L = positive(f1), positive(p1), dr.maximum(L, SMALLEST_DIVISOR)
        E2, c = self.E1 * f1 / p1, mis3.deepest_cost(b, L, self.n)
        A11, A12, A22, det = mis3.matrix_A(self.q, self.E1, f1, E2, c)
        return A11, A12, A22, dr.maximum(det, SMALLEST_DIVISOR)

    def gather(self, frozen, vertices):
        """Script A11, A12, A22 by a gather in the frozen map at the vertices z_1, and from them the
        matrix B and h."""

        def terms(place, meeting):
            scattered = meeting.lit & ~meeting.landing.caustic
            _, L, b = frozen.light_of(frozen.light, place, scattered)
            *A, det = self.matrix_A(meeting.f, meeting.p, L, b)
            integrands = (mis3.script_integrand(a, det, 1, meeting.f) for a in A)
            return tuple(dr.select(scattered, value, 0) for value in integrands)

        script = frozen.sums(vertices, 1, 3, terms)
        self.B = mis3.matrix_B(self.n, self.E1, self.W20, self.W21, *script)
        self.h = mis3.solve_h(*self.B, *script)
        dr.eval(self.h)
        return self

    def gathered(self):
        """G1 and G2."""
        return tuple(mis3.gathered(self.q, self.n, self.F, self.W21, h) for h in self.h)

    def direct_weight(self):
        """w20; w21 = 1 - w20."""
        G1, G2 = self.gathered()
        return mis3.direct_weight(self.W20, self.n, self.E1, G1, G2, self.F, self.D)

    def longest_weights(self, f1, p1, L, b):
        """w31 and w32 of directions from z_1; w30 = 1 - w31 - w32."""
        A, known = self.matrix_A(f1, p1, L, b), (self.E1, self.W20, self.W21, self.F)
        return mis3.longest_weights(*A, self.q, self.n, *known, *self.gathered())


class ThreeStrategies:
    """MIS-3: photons at z_0 have the weights w20 (of two segments) and w30, those at z_1 w31,
    direct light there w21, photons and direct light at z_2 w32. Arguments as of
    `TwoStrategies`."""

    def __init__(self, frozen, n, camera_paths):
        self.frozen, self.n = frozen, n
        self.camera_paths = camera_paths if frozen.limits.first == 0 else 1

    def middle(self, f0, p0, L0, F, record):
        """The `Middle` of vertices z_1, its h from a gather there."""
        middle = Middle(self.n, self.camera_paths, f0, p0, L0, F)
        return middle.gather(self.frozen, self.frozen.vertices(record))

    def middle_of_photons(self, meeting, chains, light, place, F):
        """The `Middle` of the vertices z_1 from which photons come that are merged at z_0."""
        L0, _, _ = self.frozen.light_of(light, place, meeting.lit)
        return self.middle(meeting.f, meeting.p, L0, F, chains.record(place, meeting.lit))

    def beyond(self, chains, light, place, active):
        """Whether photons have passed a vertex z_2 before their z_1, and there `f1`, `p1`, L, b."""
        link = chains.link(place, active)
        longer = active & (link["before"] != NONE)
        _, L, b = self.frozen.light_of(light, dr.select(longer, link["before"], 0), longer)
        return longer, (link["f"], link["p"], L, b)

    def flux_terms(self, meeting, place):
        """What photons of the frozen map, merged at z_0, add to the four photon sums of F: to the
        integrals of W21 L0 f0, of W21^2 h f0^2, of L0 f0 / D and of W21^2 h f0."""
        frozen, zero = self.frozen, mi.Float(0)
        middle = self.middle_of_photons(meeting, frozen.chains, frozen.light, place, zero)
        longer, deepest = self.beyond(frozen.chains, frozen.light, place, meeting.lit)
        *A, det = middle.matrix_A(*deepest)
        h = sum(mis3.solve_h(*middle.B, *(mis3.script_integrand(a, det, 1, 1) for a in A)))
        f0, W21 = middle.f0, middle.W21
        direct, _, _, _ = mis3.flux_integrands(W21, 1, f0, 0)
        _, second, _, h_first = mis3.flux_integrands(W21, 0, f0, h)
        carried = channel_mean(meeting.flux) * meeting.cosines
        shorter = meeting.lit & ~longer & ~meeting.landing.caustic
        longer &= ~meeting.landing.caustic
        return [
            carried * dr.select(mask, term, 0)
            for mask, term in (
                (shorter, direct),
                (longer, second),
                (shorter, f0 / middle.D),
                (longer, h_first),
            )
        ]

    def roots(self, record):
        """F of vertices z_0: photon sums in the frozen map, over pairs, for each of which script A
        is gathered at the photon's z_1."""
        frozen = self.frozen
        vertices = frozen.vertices(record)
        photon_map, longest = frozen.photon_map, frozen.limits.at(0)
        vertex, photon = photon_pairs(photon_map, vertices, frozen.radius, longest)
        sums = [dr.zeros(mi.Float, dr.width(vertices.p)) for _ in range(4)]
        for some in parts(dr.width(vertex)):
            number, index = (dr.gather(mi.UInt32, x, some) for x in (vertex, photon))
            there = {name: take(value, number) for name, value in record.items()}
            meeting = meeting_of(photon_map, frozen.vertices(there), index)
            place = photon_map.place_of_mis_words(index, meeting.lit)
            for total, term in zip(sums, self.flux_terms(meeting, place)):
                dr.scatter_add(total, term, number)
            dr.eval(sums)
        scale = dr.rcp(dr.pi * dr.square(frozen.radius) * frozen.paths)
        direct, second, losses, h_first = (total * scale for total in sums)
        # (1 / E1) x the integral of W21 f0 is 1 - n x that of L0 f0 / D
        F = mis3.flux(direct, second, 1 - self.n * losses, h_first, self.n, 1, self.camera_paths)
        dr.eval(F)
        return [F]

    def of_photons(self, meeting, chains, light, place, root):
        """w20 or w30 of photons that are merged at z_0; `place`: among the `chains`."""
        middle = self.middle_of_photons(meeting, chains, light, place, *root)
        longer, deepest = self.beyond(chains, light, place, meeting.lit)
        w31, w32 = middle.longest_weights(*deepest)
        return dr.select(longer, 1 - w31 - w32, middle.direct_weight())

    def of_inner(self, record, link, root):
        """The `Middle` of vertices z_1 that a camera path has made."""
        L0, _, _ = self.frozen.light_at(self.frozen.vertices(record), 1)
        return self.middle(link["f"], link["p"], L0, *root, record)

    def of_inner_photons(self, meeting, light, place, middle):
        """w31 of photons that are merged at z_1."""
        _, L, b = self.frozen.light_of(light, place, meeting.lit)
        return middle.longest_weights(meeting.f, meeting.p, L, b)[0]

    def of_last(self, record, link, middle):
        """w32 of vertices z_2 that a camera path has made: of direct light and photons there."""
        _, L, b = self.frozen.light_at(self.frozen.vertices(record), 2)
        return middle.longest_weights(link["f"], link["p"], L, b)[1]
