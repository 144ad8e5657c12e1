"""Where transport and optimal weights meet: what the weights know of a path's vertices, on both of its halves.

The weights are functions of the joint path alone, one for each colour channel. At each of its vertices they use BSDF values and densities of the
path itself, and a crude picture of the light around it: the vertex's radiance from cached irradiance, and the means over directions from
typical neighbours. Crude weights cost noise, never light: each strategy evaluates the same functions of the same vertices.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.packing import bits_float, float_bits
from ..transport.traits import lookup
from ..weights import recursion
from .surroundings import SHARES

TYPICAL_ALBEDO = 0.5
"""Neighbours of which nothing is known but the light around them are grey Lambertians."""
AMBIENT_SHARE = 0.02
"""Share of the scene's mean irradiance that is taken to reach every vertex, lest one that the cache calls dark be left to a strategy
that hardly ever makes its paths."""
STEEPEST_DRIVE = 30.0
"""Bound on the corrections 1 + G / f_0 and 1 + tau / (1 - theta), which grow without bound where the BSDF falls to zero."""
WEIGHT_KEPT, SELDOM = 0.4, 0.02
"""Strategies of less than this weight are used at random, with a probability in proportion, but no smaller than the second number."""
SMALLEST_COSINE, SMALLEST_LOBE_COSINE = 1e-6, 0.05
SMALLEST_DENSITY = 1e-6


class Node:
    """What is known of a vertex seen from its predecessor.

    `f` (spectrum), `p`: BSDF value and camera density of the joint path there; `direct`, `indirect` (spectra): radiance by direct and other
    light; `lobe_f` (spectrum), `lobe_p`: value and density in a typical direction; `noise`: relative variance of its
    direct light's estimate; `last` (mask): strategies end here, whatever their number.
    """

    def __init__(self, f, p, direct, indirect, lobe_f, lobe_p, noise, last):
        self.f, self.p, self.direct, self.indirect, self.lobe_f, self.lobe_p = f, p, direct, indirect, lobe_f, lobe_p
        self.noise, self.last = noise, last

    def radiance(self, n):
        """L and b / L. b is the lobe's f times the indirect light, and n times the variance of the direct light's estimate: the noise law takes
        direct light for exact, but its noise costs as that of photons does."""
        total = self.direct + self.indirect
        cost = self.lobe_f * self.indirect + n * self.noise * dr.square(self.direct)
        return total, cost / recursion.at_least(total, recursion.SMALLEST)

    def direct_r(self, n, r):
        """r with the cost of the direct light's noise: what takes the place of r where direct light is the last strategy."""
        return r + n * self.noise * self.direct


def typical_node(direct, indirect):
    """A grey Lambertian of the given radiance, at which strategies end."""
    return Node(None, None, direct, indirect, TYPICAL_ALBEDO / dr.pi, 1 / dr.pi, 0, True)


def response(level, strategies, full, n, r, node):
    """Remainder e and carry tau of the node at z_level, 0 < level < strategies (`weights.recursion`; means over directions are those
    of one typical neighbour)."""
    radiance, c = node.radiance(n)
    e_deepest = recursion.remainder(recursion.deepest_response(n, radiance, c, r))
    if level == strategies - 1 or node.last is True:
        return e_deepest, mi.Spectrum(0)
    tau = mi.Spectrum(0)
    gamma = recursion.inner_response(n, node.direct, node.direct_r(n, r), 0, 0, 0, 0)
    if full:
        theta, rest = recursion.kernel_share(r, node.lobe_f), recursion.kernel_rest(r, node.lobe_f)
        next_r = recursion.next_ratio(theta, node.lobe_p)
        incident = node.indirect * node.lobe_p / recursion.at_least(node.lobe_f, recursion.SMALLEST)
        e_next, _ = response(level + 1, strategies, full, n, next_r, typical_node(0.5 * incident, 0.5 * incident))
        first = rest * (1 - e_next)
        tau = dr.select(node.last, 0, recursion.carry(first, e_next))
        photon_sum = incident * rest / node.lobe_p                   # a lobe of projected solid angle 1 / p
        gamma = recursion.inner_response(n, node.direct, node.direct_r(n, r), photon_sum, rest * first, first, tau)
    return dr.select(node.last, e_deepest, recursion.remainder(gamma)), tau


class OptimalWeights:
    """Weights of `strategies` merging strategies, the first at camera vertex `first`.

    `full`: keep the recursion's integrals, else drop them (local weights). `cache`: an `IrradianceCache`; `surroundings`: a `Surroundings`
    of its cells (full weights only). `n`: photons per unit of irradiance in the merge disk (a spectrum of width one). `mix_diffuse`: whether
    strategies go on beyond Lambertian vertices; else the first of these is a path's last strategy.
    """

    def __init__(self, lights, traits, cache, surroundings, n, strategies, first, camera_paths, full, mix_diffuse):
        self.lights, self.traits, self.cache, self.surroundings, self.n = lights, traits, cache, surroundings, n
        self.strategies, self.first, self.full, self.mix_diffuse = strategies, first, full, mix_diffuse
        self.camera_paths = camera_paths if first == 0 else 1
        self.context = mi.BSDFContext()
        self.smooth = mi.BSDFContext()
        self.smooth.type_mask = mi.BSDFFlags.Smooth

    # ------------------------------------------------------------------ vertices

    def scattering(self, si, bsdf, wo, mask):
        """BSDF value without cosine and density per projected solid angle of the camera path that goes on to `wo`."""
        value, pdf = bsdf.eval_pdf(self.context, si, wo, mask)
        scale = dr.rcp(dr.maximum(dr.abs(wo.z), SMALLEST_COSINE))
        return value * scale, pdf * scale

    def lobe(self, si, bsdf, mask):
        """Value and density of the scattering in a typical direction, by one fixed sample of the BSDF."""
        upright = mi.Vector3f(0, 0, dr.select(mi.Frame3f.cos_theta(si.wi) > 0, mi.Float(1), mi.Float(-1)))
        if not self.traits.has_rough:
            f, p = self.scattering(si, bsdf, upright, mask)
            return f, dr.maximum(p, SMALLEST_DENSITY)
        lambertian = lookup(self.traits.lambertian, bsdf, mi.Bool, mask)
        f, p = self.scattering(si, bsdf, upright, mask & lambertian)
        bs, weight = bsdf.sample(self.smooth, si, mi.Float(0.5), mi.Point2f(0.5), mask & ~lambertian)
        valid = mask & ~lambertian & (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        density = dr.select(valid, bs.pdf, dr.inv_pi) * dr.rcp(dr.maximum(dr.abs(dr.select(valid, bs.wo.z, 1)), SMALLEST_LOBE_COSINE))
        f = dr.select(lambertian, f, dr.select(valid, weight, 0) * density)
        return f, dr.maximum(dr.select(lambertian, p, density), SMALLEST_DENSITY)

    def is_last(self, bsdf, mask):
        """Whether strategies end at a vertex of this BSDF: photons merged there are little noisier than what a path further on would bring."""
        if self.mix_diffuse or not self.traits.has_lambertian:
            return mi.Bool(False)
        return lookup(self.traits.lambertian, bsdf, mi.Bool, mask) if self.traits.has_rough else mi.Bool(True)

    def side(self, si):
        """The geometric normal on the side of `si.wi`."""
        return mi.Vector3f(dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi))))

    def node(self, si, bsdf, mask, f=None, p=None):
        """The `Node` of a vertex with its predecessor in direction `si.wi`."""
        known = self.cache.lookup(si.p, self.side(si), mask)
        lobe_f, lobe_p = self.lobe(si, bsdf, mask)
        # The strongest light as if nothing stood between, scaled to what the cell has of it: sharper than the cell.
        sharp = mask & (known.visible_share > 0)
        ds, unoccluded = self.lights.unoccluded(si, dr.select(sharp, known.light, 0), sharp)
        wo = si.to_local(dr.select(sharp, ds.d, known.direction))
        scale = dr.select(sharp, unoccluded * known.visible_share * dr.abs(wo.z) / recursion.at_least(dr.mean(known.direct), recursion.SMALLEST), 1)
        value = lobe_f
        if self.traits.has_rough:
            lit = mask & (dr.max(known.direct) > 0) & ~lookup(self.traits.lambertian, bsdf, mi.Bool, mask)
            towards_light = bsdf.eval(self.context, si, wo, lit) * dr.rcp(dr.maximum(dr.abs(wo.z), SMALLEST_LOBE_COSINE))
            value = dr.select(lit, towards_light, lobe_f)
        ambient = AMBIENT_SHARE * self.cache.mean * lobe_f / (lobe_p * dr.pi)
        indirect = (known.second + known.later) * dr.inv_pi * lobe_f / lobe_p
        return Node(f, p, value * known.direct * scale + ambient, indirect, lobe_f, lobe_p, known.noise, self.is_last(bsdf, mask))

    def last_weight(self, drive, e, r, node):
        """Weight of direct light at an inner vertex."""
        return recursion.direct_weight(drive, e) * r / recursion.at_least(node.direct_r(self.n, r), recursion.SMALLEST)

    def offset(self, si, bsdf, mask):
        """G = n F / N_B at the first strategy's vertex, its means those of the typical neighbours of its cell."""
        f, p = self.lobe(si, bsdf, mask)
        r = recursion.first_ratio(p, self.camera_paths)
        around = self.surroundings.lookup(self.cache.slot(si.p, self.side(si), mask), mask)
        e = sum(share * response(1, self.strategies, True, self.n, r, typical_node(*radiance))[0] for share, radiance in zip(SHARES, around))
        return recursion.root_offset(f * (1 - e), e)

    # ------------------------------------------------------------------ camera paths (hooks of `trace_camera_paths`)

    def begin(self, width):
        """State of a camera path: drive and r of the vertex it arrives at; after arrival u = e drive and tau, or the offset G in the place of u
        at the first strategy's vertex."""
        return [mi.Spectrum(dr.full(mi.Float, value, width)) for value in (1, 1, 0, 0)]

    def arrived(self, state, si, bsdf, vertex, mask):
        """State at a smooth vertex, and the weight of the direct light there."""
        drive, r, u, tau = state
        share = mi.Spectrum(1)
        if self.strategies > 1:
            at_root = mask & (vertex == self.first)
            u = dr.select(at_root, self.offset(si, bsdf, at_root) if self.full else mi.Spectrum(0), u)
            node = self.node(si, bsdf, mask & (vertex > self.first))
            c = node.radiance(self.n)[1]
            deepest = node.last | (vertex == self.first + self.strategies - 1)
            for level in range(1, self.strategies):
                here = mask & (vertex == self.first + level)
                e, carried = response(level, self.strategies, self.full, self.n, r, node)
                u = dr.select(here, recursion.direct_weight(drive, e), u)
                tau = dr.select(here, carried, tau)
                weight = dr.select(deepest, recursion.deepest_weight(drive, e, r, c), self.last_weight(drive, e, r, node))
                share = dr.select(here, weight, share)
        return [drive, r, u, tau], share

    def leaving(self, state, si, bsdf, bs, vertex, mask):
        """State after a smooth scattering into `bs.wo`."""
        drive, r, u, tau = state
        mask = mask & (vertex >= self.first)
        f, p = self.scattering(si, bsdf, bs.wo, mask)
        at_root = mask & (vertex == self.first)
        root_drive, root_r = self.root_step(u, f, p)
        inner_drive, inner_r = self.step(u, tau, r, f, p)
        drive = dr.select(at_root, root_drive, dr.select(mask, inner_drive, drive))
        r = dr.select(at_root, root_r, dr.select(mask, inner_r, r))
        return [drive, r, u, tau]

    def root_step(self, offset, f, p):
        """Drive and r of the vertex after the first strategy's, which scattered with value f and density p."""
        r = mi.Spectrum(recursion.first_ratio(p, self.camera_paths))
        return recursion.bounded_drive(dr.minimum(recursion.first_drive(offset, f), STEEPEST_DRIVE), r), r

    @staticmethod
    def step(u, tau, r, f, p):
        """Drive and r of the next vertex, after an inner one that scattered with value f and density p."""
        next_r = recursion.next_ratio(recursion.kernel_share(r, f), p)
        drive = dr.minimum(recursion.next_drive(1, u, tau, recursion.kernel_rest(r, f)), STEEPEST_DRIVE * dr.abs(u))
        return recursion.bounded_drive(drive, next_r), next_r

    def ends(self, bsdf, vertex, mask):
        """Whether the vertex is the path's last strategy though there are more."""
        return (vertex >= self.first) & self.is_last(bsdf, mask)

    def worth_merging(self, state, share, vertex, last):
        """Probability with which photons are gathered: where the weights are small, seldom."""
        _, _, u, _ = state
        weight = dr.max(dr.abs(dr.select(last, share, u)))
        return dr.select(vertex > self.first, dr.clip(weight / WEIGHT_KEPT, SELDOM, 1), 1)

    def worth_going_on(self, state, vertex):
        """Probability with which the path goes on from an inner vertex: the deeper weights are at most about the drive."""
        drive, _, _, _ = state
        return dr.select(vertex > self.first, dr.clip(dr.max(drive) / WEIGHT_KEPT, SELDOM, 1), 1)

    def stored(self, state):
        """What the photons merged at a vertex need of its state: u (or the offset), tau, r."""
        _, r, u, tau = state
        return [u, tau, r]

    # ------------------------------------------------------------------ photons

    def notebook(self):
        """What light sub-paths note down for these weights; `None` if nothing."""
        return Notebook(self) if self.strategies > 1 else None

    def merging(self, level, stored, f, p, passed):
        """Weight w_{l, level} of a photon that has passed the nodes `passed` (nearest first, see `Notebook.read`), merged at a camera
        vertex with the state `stored`, scattered there with value f and density p."""
        u, tau, r = stored
        if level == 0:
            return 1 - self.deeper_sum(1, *self.root_step(u, f, p), passed)
        return recursion.inner_weight(u, 1, recursion.kernel_share(r, f), self.deeper_sum(level + 1, *self.step(u, tau, r, f, p), passed))

    def deeper_sum(self, level, drive, r, passed):
        """Sum of the weights of the strategies at z_level and beyond."""
        (node, _), beyond = passed[0], passed[1:]
        e, tau = response(level, self.strategies, self.full, self.n, r, node)
        deepest = recursion.deepest_weight(drive, e, r, node.radiance(self.n)[1])
        if level == self.strategies - 1:
            return deepest
        u = recursion.direct_weight(drive, e)
        deeper = self.deeper_sum(level + 1, *self.step(u, tau, r, node.f, node.p), beyond)
        here = recursion.inner_weight(drive, e, recursion.kernel_share(r, node.f), deeper)
        return dr.select(node.last, deepest, dr.select(beyond[0][1], here + deeper, self.last_weight(drive, e, r, node)))


class NotedNode(Node):
    """A node read from a photon's notes. Of a path's deepest vertex only the radiance and b / L are noted, and nothing else is asked."""

    def __init__(self, radiance, c, direct=None, f=None, p=None, noise=None, lobe_f=None, lobe_p=None):
        last = True if noise is None else noise < 0
        indirect = None if direct is None else radiance - direct
        super().__init__(f, p, direct, indirect, lobe_f, lobe_p, None if noise is None else dr.select(last, -1 - noise, noise), last)
        self._known = radiance, c

    def radiance(self, n):
        return self._known


class Notebook:
    """Notes of light sub-paths: what is known of the last `strategies - 1` vertices that scattered smoothly, nearest first (hooks of
    `trace_light_paths`). All of them but the farthest, which only ever is the deepest vertex of a joint path, as whole nodes."""

    def __init__(self, weights):
        self.weights = weights
        self.whole = weights.strategies - 2

    def _fields(self, node):
        radiance, c = node.radiance(self.weights.n)
        fields = [mi.Spectrum(radiance), mi.Spectrum(c)]
        if self.whole:
            fields += [node.direct, node.f, node.p, dr.select(node.last, -1 - node.noise, node.noise)]     # negative: the last
            if self.weights.full:
                fields += [node.lobe_f, node.lobe_p]
        return fields

    def begin(self):
        none, zero = mi.Spectrum(-1), mi.Spectrum(0)              # a vertex that does not exist has negative radiance
        node = Node(mi.Spectrum(0), mi.Float(0), mi.Spectrum(0), mi.Spectrum(0), mi.Spectrum(0), mi.Float(1), mi.Float(0), mi.Bool(False))
        return [[mi.Spectrum(none), *[type(x)(x) for x in self._fields(node)[1:]]] for _ in range(self.whole)] + [[none, zero]]

    def scattered(self, state, si, bsdf, wo, mask):
        view = mi.SurfaceInteraction3f(si)
        view.wi = mi.Vector3f(wo)
        f, p = self.weights.scattering(view, bsdf, si.wi, mask) if self.whole else (None, None)
        new = self._fields(self.weights.node(view, bsdf, mask, f, p))
        result = []
        for old in state:
            result.append([dr.select(mask, a, b) for a, b in zip(new, old)])
            new = old
        return result

    def words(self, state):
        words = []
        for fields in state:
            for field in fields:
                words += [float_bits(x) for x in (field if dr.depth_v(field) > 1 else [field])]
        return words + [mi.UInt32(0)] * ((2 - len(words)) if len(words) <= 2 else -len(words) % 4)

    def read(self, level, notes, index, active):
        """The vertices that photon `index`, merged at z_level, has passed: a list of (`Node`, whether it exists), nearest first, as
        many as there are strategies beyond that level; the last one is the deepest vertex."""
        template = self.begin()
        count = len(self.words(template))
        template = template[:self.whole + 1 - level]
        template[-1] = template[-1][:2]
        needed = len(self.words(template))
        words = []
        for part in range(-(-needed // 4)):
            words += list(dr.gather(mi.Vector2u if count == 2 else mi.Vector4u, notes, max(count // 4, 1) * index + part, active))
        passed = []
        for fields in template:
            values = []
            for field in fields:
                size = dr.size_v(mi.Spectrum) if dr.depth_v(field) > 1 else 1
                mine, words = words[:size], words[size:]
                values.append(mi.Spectrum([bits_float(w) for w in mine]) if dr.depth_v(field) > 1 else bits_float(mine[0]))
            passed.append((NotedNode(*values), dr.max(values[0]) >= 0))
        return passed
