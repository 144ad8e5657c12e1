"""Where transport and optimal weights meet: what the weights know of a path's vertices, on both of
its halves.

The weights are functions of the joint path alone, one for each colour channel. At each of its
vertices they use BSDF values and densities of the path itself, and a crude picture of the light
around it: the vertex's radiance from cached irradiance, and the means over directions from typical
neighbours. Crude weights cost noise, never light: each strategy evaluates the same functions of the
same vertices.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..core.spectra import channel_mean
from ..core.traits import lookup
from ..paths.light_starts import light_seen_from
from ..paths.vertex import f_and_p, in_medium, per_projected, upright
from ..weights import recursion
from .neighbour_radiance import HALVES

LARGEST_SHARE = 2.0
"""Tuned: bound on e drive, the weights that are left for a vertex and those beyond. Right ones
exceed one where the surroundings are brighter; far larger ones mean that the cache does not know
the vertex."""
TRUSTED_PHOTONS = 128
"""Tuned: photons in a disk up to which the radiance of typical neighbours is known well enough for
the means over directions."""
SMALLEST_LOBE_COSINE = 0.05
SMALLEST_DENSITY = 1e-6
SMALLEST_EXTINCTION = 1e-6
"""[1/m]: where a medium is thinner no photon is left."""
SMALLEST_RATIO, LARGEST_ODDS = 1e-30, 1e30
"""[1/m^2], and without a unit: bounds that float32 needs where weights of direct light are stored
and divided."""


class Node:
    """What is known of a vertex seen from its predecessor.

    `f` (spectrum), `p`: BSDF value and camera density of the joint path there; `direct`, `indirect`
    (spectra): radiance by direct and other light; `kernel`: mean BSDF value, what merging a photon
    there costs where the photon's own is not known; `lobe_f` (spectrum), `lobe_p`: value and
    density in a typical direction; `noise`: what the noise of its direct light costs, in the units
    of `kernel`; `last` (mask): strategies end here, whatever their number; `indirectly` (mask):
    other than direct light is what the path brings.
    """

    def __init__(
        self, f, p, direct, indirect, kernel, lobe_f, lobe_p, noise, last, indirectly=None
    ):
        self.f, self.p, self.direct, self.indirect, self.kernel = f, p, direct, indirect, kernel
        self.lobe_f, self.lobe_p, self.noise, self.last, self.indirectly = (
            lobe_f,
            lobe_p,
            noise,
            last,
            indirectly,
        )

    def final_response(self, n, r):
        """gamma where no strategy goes on: as at an inner vertex beyond which nothing is merged, so
        that direct light and photons have weights of their own (the papers give both the same)."""
        photons = self.indirect / recursion.at_least(
            r + self.kernel, recursion.SMALLEST_DENOMINATOR
        )
        return recursion.inner_response(n, self.direct, r + self.noise, photons, 0, 0, 0)


def typical_node(direct, indirect, albedo):
    """A grey Lambertian of the given radiance, at which strategies end."""
    f = albedo / dr.pi
    return Node(None, None, direct, indirect, f, f, 1 / dr.pi, 0, True)


def response(level, strategies, n, r, node, albedo=None):
    """Remainder e and carry tau of the node at z_level, 0 < level < strategies
    (`weights.recursion`). Means over directions are those of one typical neighbour of that
    `albedo`; without it they are left out (local weights)."""
    e_final = recursion.remainder(node.final_response(n, r))
    if level == strategies - 1 or node.last is True:
        return e_final, mi.Spectrum(0)
    tau = mi.Spectrum(0)
    gamma = recursion.inner_response(n, node.direct, r + node.noise, 0, 0, 0, 0)
    if albedo is not None:
        theta, rest = recursion.kernel_share(r, node.lobe_f), recursion.kernel_rest(r, node.lobe_f)
        next_r = recursion.next_ratio(theta, node.lobe_p)
        incident = (
            node.indirect
            * node.lobe_p
            / recursion.at_least(node.lobe_f, recursion.SMALLEST_DENOMINATOR)
        )
        e_next, _ = response(
            level + 1,
            strategies,
            n,
            next_r,
            typical_node(0.5 * incident, 0.5 * incident, albedo),
            albedo,
        )
        first = rest * (1 - e_next)
        tau = dr.select(node.last, 0, recursion.carry(first, e_next))
        photon_sum = incident * rest / node.lobe_p  # a lobe of projected solid angle 1 / p
        gamma = recursion.inner_response(
            n, node.direct, r + node.noise, photon_sum, rest * first, first, tau
        )
    return dr.select(node.last, e_final, recursion.remainder(gamma)), tau


class OptimalWeights:
    """Weights of `strategies` merging strategies, the first at camera vertex `first`.

    `full`: keep the recursion's integrals, else drop them (local weights). `cache`: an
    `IrradianceCache`; `neighbour_radiance`: a `NeighbourRadiance` of its cells (full weights only).
    `n`: photons per unit of irradiance in the merge disk (a spectrum of width one). `caustic_cost`:
    what merging a caustic photon costs in units of merging another one (width one). `camera_paths`:
    N_B; where noise counts that a denoiser or the film's filter leaves, F + d B in place of
    F + B, it is N_B / d.
    `mix_diffuse`:
    whether strategies go on beyond Lambertian vertices; else the first of these is a path's last
    strategy. In scenes with media, which have local weights only, `fluence` is the
    `IrradianceCache` of these, `disk_per_ball` [1/m] the area of a merge disk over the volume of a
    merge ball, and `ball_paths` [m^3] that volume times the light sub-paths (both of width one).

    **Vertices in media.** A ball of volume V there finds as many photons as a disk of the area V
    sigma, sigma being the extinction. So merging costs the BSDF f times A / (V sigma), where A is
    the disk of surfaces, and with densities p scaled alike the recursion stays as it is (docs/
    bdpm_opt.md derives it). The BSDF is the phase function times the albedo.

    Next-event estimation is very noisy close to a lamp in a medium, where nothing keeps vertices
    away from it. So direct light has two techniques there, that and merging the photons that come
    straight from the light, and these share what is direct light's by the balance heuristic.
    """

    def __init__(
        self,
        lights,
        traits,
        cache,
        neighbour_radiance,
        n,
        caustic_cost,
        strategies,
        first,
        camera_paths,
        full,
        mix_diffuse,
        fluence=None,
        disk_per_ball=None,
        ball_paths=None,
    ):
        self.fluence, self.disk_per_ball, self.ball_paths = fluence, disk_per_ball, ball_paths
        self.weighs_points_of_lights = fluence is not None and strategies > 1
        self.lights, self.traits, self.cache, self.neighbour_radiance, self.n, self.caustic_cost = (
            lights,
            traits,
            cache,
            neighbour_radiance,
            n,
            caustic_cost,
        )
        self.strategies, self.first, self.full, self.mix_diffuse = (
            strategies,
            first,
            full,
            mix_diffuse,
        )
        self.albedo = neighbour_radiance.albedo if neighbour_radiance else None
        self.camera_paths = camera_paths if first == 0 else 1
        self.has_caustics = traits.has_delta or traits.has_unsampled_lights
        self.context = mi.BSDFContext()
        self.smooth = mi.BSDFContext()
        self.smooth.type_mask = mi.BSDFFlags.Smooth

    # ------------------------------------------------------------------ vertices

    def scattering(self, si, bsdf, wo, mask):
        """BSDF value without cosine and density per projected solid angle of the camera path that
        goes on to `wo`; in media scaled (see above)."""
        if self.fluence is None:
            return f_and_p(si, bsdf, wo, mask)
        value, pdf = bsdf.eval_pdf(self.context, si, wo, mask)
        scale = per_projected(wo.z)
        return self.per_disk(si, bsdf, mask, value * scale, pdf * scale, value, pdf)

    def per_disk(self, si, bsdf, mask, f, p, phase, phase_pdf):
        """`f` and `p` on surfaces, and in media those of the phase function, scaled."""
        inside = mask & in_medium(si.n)
        albedo, extinction = bsdf.coefficients(si, inside)
        scale = self.ball_cost(extinction)
        f = dr.select(inside, phase * albedo * scale, f)
        return f, dr.select(inside, phase_pdf * scale, p)

    def ball_cost(self, extinction):
        """A / (V sigma): what merging a photon in a ball costs in units of merging it in a disk of
        surfaces."""
        return self.disk_per_ball * dr.rcp(dr.maximum(extinction, SMALLEST_EXTINCTION))

    def lobe(self, si, bsdf, mask):
        """Value and density of the scattering in a typical direction, by one fixed sample of the
        BSDF."""
        if self.fluence is None:
            return self.surface_lobe(si, bsdf, mask)
        f, p = self.surface_lobe(si, bsdf.bsdf, mask & ~in_medium(si.n))
        pdf = bsdf.phase_lobe(si, mask)
        f, p = self.per_disk(si, bsdf, mask, f, p, pdf, pdf)
        return f, dr.maximum(p, SMALLEST_DENSITY)

    def surface_lobe(self, si, bsdf, mask):
        """The same of a BSDF."""
        if not self.traits.has_rough:
            f, p = f_and_p(si, bsdf, upright(si), mask)
            return f, dr.maximum(p, SMALLEST_DENSITY)
        lambertian = lookup(self.traits.lambertian, bsdf, mi.Bool, mask)
        f, p = f_and_p(si, bsdf, upright(si), mask & lambertian)
        bs, weight = bsdf.sample(
            self.smooth, si, mi.Float(0.5), mi.Point2f(0.5), mask & ~lambertian
        )
        valid = (
            mask & ~lambertian & (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        )
        density = dr.select(valid, bs.pdf, dr.inv_pi) * dr.rcp(
            dr.maximum(dr.abs(dr.select(valid, bs.wo.z, 1)), SMALLEST_LOBE_COSINE)
        )
        f = dr.select(lambertian, f, dr.select(valid, weight, 0) * density)
        return f, dr.maximum(dr.select(lambertian, p, density), SMALLEST_DENSITY)

    def is_last(self, bsdf, mask):
        """Whether strategies end at a vertex of this BSDF: photons merged there are little noisier
        than what a path further on would bring."""
        if self.mix_diffuse or not self.traits.has_lambertian:
            return mi.Bool(False)
        on_surfaces = mi.Bool(True)
        if self.fluence is not None:
            on_surfaces, bsdf = ~bsdf.scatters, bsdf.bsdf
        if not self.traits.has_rough:
            return on_surfaces
        return on_surfaces & lookup(self.traits.lambertian, bsdf, mi.Bool, mask & on_surfaces)

    def side(self, si):
        """The geometric normal on the side of `si.wi`."""
        return mi.Vector3f(dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi))))

    def node(self, si, bsdf, mask, f=None, p=None):
        """The `Node` of a vertex with its predecessor in direction `si.wi`."""
        known = self.cache.lookup(si.p, self.side(si), mask)
        if self.fluence is not None:
            inside = mask & bsdf.scatters
            known = known.replaced(self.fluence.lookup(si.p, mi.Normal3f(0), inside), inside)
        lobe_f, lobe_p = self.lobe(si, bsdf, mask)
        # The strongest light as if nothing stood between, scaled to what the cell has of it:
        # sharper than the cell.
        sharp = mask & (known.visible_share > 0)
        ds, unoccluded = self.lights.unoccluded(si, dr.select(sharp, known.light, 0), sharp)
        wo = si.to_local(dr.select(sharp, ds.d, known.direction))
        cosine = dr.abs(wo.z)
        if self.fluence is not None:
            cosine = dr.select(inside, 1, cosine)
        scale = dr.select(
            sharp,
            unoccluded
            * known.visible_share
            * cosine
            / recursion.at_least(channel_mean(known.direct), recursion.SMALLEST_DENOMINATOR),
            1,
        )
        indirect = known.second + known.later
        if self.fluence is None:
            value = self.towards_light(si, bsdf, wo, known, lobe_f, mask)
            indirect *= dr.inv_pi * lobe_f / lobe_p
        else:  # what the cells of media know has the albedo
            value = self.towards_light(si, bsdf.bsdf, wo, known, lobe_f, mask & ~inside)
            phase, _ = bsdf.eval_pdf(self.context, si, wo, inside)
            value = dr.select(inside, phase, value)
            indirect *= dr.select(inside, dr.inv_four_pi, dr.inv_pi * lobe_f / lobe_p)
        direct, kernel = value * known.direct * scale, channel_mean(lobe_f)
        # The noise law takes direct light for exact. Its noise costs as that of photons does: n
        # times the variance over the radiance.
        noise = channel_mean(self.n * direct) * known.noise * dr.square(1 - known.caustic_share)
        if self.has_caustics:
            noise += self.caustic_cost * known.caustic_share * kernel
        return Node(f, p, direct, indirect, kernel, lobe_f, lobe_p, noise, self.is_last(bsdf, mask))

    def towards_light(self, si, bsdf, wo, known, lobe_f, mask):
        """The BSDF for the direct light that a cell knows: that of a typical direction where it is
        the same for all."""
        if not self.traits.has_rough:
            return lobe_f
        lit = mask & (dr.max(known.direct) > 0)
        lit &= ~lookup(self.traits.lambertian, bsdf, mi.Bool, mask)
        value = bsdf.eval(self.context, si, wo, lit)
        value *= dr.rcp(dr.maximum(dr.abs(wo.z), SMALLEST_LOBE_COSINE))
        return dr.select(lit, value, lobe_f)

    @staticmethod
    def left(drive, e):
        """u: what the vertex and those beyond it share in, before the cost of each."""
        return dr.minimum(recursion.direct_weight(drive, e), LARGEST_SHARE)

    @staticmethod
    def direct_weight(u, r, node):
        """Weight of direct light at a vertex, the last strategy of its paths."""
        return u * r / recursion.at_least(r + node.noise, recursion.SMALLEST_DENOMINATOR)

    @staticmethod
    def final_weight(u, r, node):
        """Weight of photons merged where no strategy goes on."""
        return recursion.inner_weight(u, 1, recursion.kernel_share(r, node.kernel), 0)

    def offset(self, si, bsdf, mask):
        """G = n F / N_B at the first strategy's vertex, its means those of the typical neighbours
        of its cell.

        It is drawn towards that of local weights, zero, the more, the more photons a disk holds.
        Without noise of photons, deeper strategies may have any weight that makes their
        contribution the same in all directions; but then what the cells know wrongly is all the
        noise that there is.
        """
        f, p = self.lobe(si, bsdf, mask)
        r = recursion.first_ratio(p, self.camera_paths)
        around = self.neighbour_radiance.lookup(self.cache.slot(si.p, self.side(si), mask), mask)
        e = sum(
            response(
                1, self.strategies, self.n, r, typical_node(*radiance, self.albedo), self.albedo
            )[0]
            for radiance in around
        ) * (1 / HALVES)
        photons = channel_mean(self.n) * self.cache.level
        return recursion.root_offset(f * (1 - e), e) * dr.rcp(
            1 + dr.square(photons / TRUSTED_PHOTONS)
        )

    # --- camera paths (`mis.state.MergeState`) ---------------------------------------------------

    def init(self, width):
        """State of a camera path: drive and r of the vertex it arrives at; after arrival tau, and
        u: e drive, or the offset G at the first strategy's vertex, or the photons' weight where
        strategies end. With media also N_F V sigma of that vertex [m^2], zero on surfaces."""
        state = [mi.Spectrum(dr.full(mi.Float, value, width)) for value in (1, 1, 0, 0)]
        return state + ([dr.zeros(mi.Float, width)] if self.weighs_points_of_lights else [])

    def found_photons(self, si, bsdf, mask):
        """N_F V sigma [m^2]: times a density of light sub-paths per area across them, the photons
        that a ball finds; zero on surfaces."""
        inside = mask & bsdf.scatters
        _, extinction = bsdf.coefficients(si, inside)
        return dr.select(inside, self.ball_paths * extinction, 0)

    def next_event_weight(self, state, ref, ds, mask):
        """The balance heuristic between next-event estimation for `ds` and merging its photons."""
        ratio = self.lights.emission_over_nee_pdf(ref, ds, mask)
        return mi.Spectrum(1 - self.share_of_photons(state[-1], ratio))

    @staticmethod
    def share_of_photons(found, ratio):
        """Share of direct light's photons in its weight, with `found` and `ratio` as of
        `found_photons` and `Lights.emission_over_nee_pdf`."""
        odds = dr.minimum(found * ratio, LARGEST_ODDS)
        return odds * dr.rcp(1 + odds)

    def propagate(self, state, si, bsdf, vertex, mask):
        """State at a smooth vertex, and the weight of the direct light there."""
        drive, r, u, tau, *found = state
        share = mi.Spectrum(1)
        at_root = mask & (vertex == self.first)
        if self.strategies == 1:
            return [drive, r, dr.select(at_root, 1, u), tau], share
        merged = mask & (vertex >= self.first)
        found = [self.found_photons(si, bsdf, merged) for _ in found]
        u = dr.select(at_root, self.offset(si, bsdf, at_root) if self.full else mi.Spectrum(0), u)
        u = dr.select(at_root & self.is_last(bsdf, at_root), 1, u)
        node = self.node(si, bsdf, mask & (vertex > self.first))
        final = node.last | (vertex == self.first + self.strategies - 1)
        for level in range(1, self.strategies):
            here = mask & (vertex == self.first + level)
            e, carried = response(level, self.strategies, self.n, r, node, self.albedo)
            remaining = self.left(drive, e)
            u = dr.select(
                here, dr.select(final, self.final_weight(remaining, r, node), remaining), u
            )
            tau = dr.select(here, carried, tau)
            share = dr.select(here, self.direct_weight(remaining, r, node), share)
        return [drive, r, u, tau, *found], share

    def scatter(self, state, si, bsdf, bs, vertex, mask):
        """State after a smooth scattering into `bs.wo`."""
        drive, r, u, tau, *found = state
        mask = mask & (vertex >= self.first)
        f, p = self.scattering(si, bsdf, bs.wo, mask)
        at_root = mask & (vertex == self.first)
        root_drive, root_r = self.root_step(u, f, p)
        inner_drive, inner_r = self.step(u, tau, r, f, p)
        drive = dr.select(at_root, root_drive, dr.select(mask, inner_drive, drive))
        r = dr.select(at_root, root_r, dr.select(mask, inner_r, r))
        return [drive, r, u, tau, *found]

    def root_step(self, offset, f, p):
        """Drive and r of the vertex after the first strategy's, which scattered with value f and
        density p."""
        r = mi.Spectrum(recursion.first_ratio(p, self.camera_paths))
        return recursion.bounded_drive(recursion.first_drive(offset, f), r), r

    @staticmethod
    def step(u, tau, r, f, p):
        """Drive and r of the next vertex, after an inner one that scattered with value f and
        density p."""
        next_r = recursion.next_ratio(recursion.kernel_share(r, f), p)
        drive = recursion.next_drive(1, u, tau, recursion.kernel_rest(r, f))
        return recursion.bounded_drive(drive, next_r), next_r

    def ends(self, bsdf, vertex, mask):
        """Whether the vertex is the path's last strategy though there are more."""
        return (vertex >= self.first) & self.is_last(bsdf, mask)

    def stored(self, state):
        """What the photons merged at a vertex need of its state: u (or the offset), tau, r."""
        _, r, u, tau = state[:4]
        return [u, tau, r]

    # ------------------------------------------------------------------ photons

    def light_state(self):
        """What light sub-paths note down for these weights; `None` if nothing."""
        return LightState(self) if self.strategies > 1 else None

    def merge_weight(self, level, stored, f, p, passed):
        """Weight w_{l, level} of a photon that has passed the nodes `passed` (nearest first, see
        `LightState.read`), merged at a camera vertex with the state `stored`, scattered there with
        value f and density p."""
        u, tau, r = stored
        if level == 0:
            return 1 - self.deeper_sum(1, *self.root_step(u, f, p), passed)
        return recursion.inner_weight(
            u,
            1,
            recursion.kernel_share(r, f),
            self.deeper_sum(level + 1, *self.step(u, tau, r, f, p), passed),
        )

    def deeper_sum(self, level, drive, r, passed):
        """Sum of the weights of the strategies at z_level and beyond."""
        node, beyond = passed[0], passed[1:]
        e, tau = response(level, self.strategies, self.n, r, node, self.albedo)
        u = self.left(drive, e)
        direct, final = self.direct_weight(u, r, node), self.final_weight(u, r, node)
        if level == self.strategies - 1:
            return dr.select(node.indirectly, final, direct)
        deeper = self.deeper_sum(level + 1, *self.step(u, tau, r, node.f, node.p), beyond)
        here = recursion.inner_weight(u, 1, recursion.kernel_share(r, node.f), deeper)
        return dr.select(node.indirectly, dr.select(node.last, final, here + deeper), direct)


FIELDS_OF_THE_LAST = 4
"""Fields of the farthest vertex: what `Node.final_response` and its weights ask for."""


class LightState:
    """Sums of light sub-paths: what is known of the last `strategies - 1` vertices that scattered
    smoothly, nearest first (hooks of `trace_light_paths`). Of the farthest, at which strategies
    end, only `FIELDS_OF_THE_LAST`. Fields are named by vertex and number."""

    in_media = True

    def __init__(self, weights):
        self.weights = weights
        self.whole = weights.strategies - 2
        self.layout = Layout(
            {
                (node, field): type(value)
                for node, fields in enumerate(self._split(self.init())[0])
                for field, value in enumerate(fields)
            }
        )

    def _fields(self, node):
        """A node's fields, those of the farthest one first. The kernel is negative where strategies
        end, the noise where the path goes on."""
        fields = [
            node.direct,
            node.indirect,
            dr.select(node.last, -1 - node.kernel, node.kernel),
            dr.select(node.indirectly, -1 - node.noise, node.noise),
        ]
        if self.whole:
            fields += [node.f, node.p]
            if self.weights.full:
                fields += [node.lobe_f, node.lobe_p]
        return fields

    @staticmethod
    def _node(direct, indirect, kernel, noise, f=None, p=None, lobe_f=None, lobe_p=None):
        """The node of fields read back."""
        last, indirectly = kernel < 0, noise < 0
        return Node(
            f,
            p,
            direct,
            indirect,
            dr.select(last, -1 - kernel, kernel),
            lobe_f,
            lobe_p,
            dr.select(indirectly, -1 - noise, noise),
            last,
            indirectly,
        )

    def init(self):
        def nothing():  # a vertex that does not exist has negative radiance
            zero = mi.Spectrum(0)
            return self._fields(
                Node(
                    zero,
                    mi.Float(0),
                    mi.Spectrum(-1),
                    mi.Spectrum(0),
                    mi.Float(0),
                    zero,
                    mi.Float(1),
                    mi.Float(0),
                    mi.Bool(False),
                    mi.Bool(False),
                )
            )

        nodes = [[type(x)(x) for x in nothing()] for _ in range(self.whole)]
        nodes.append([type(x)(x) for x in nothing()[:FIELDS_OF_THE_LAST]])
        return nodes + ([[mi.Float(0)]] if self.weights.weighs_points_of_lights else [])

    def _split(self, state):
        """The vertices, and what there is with media only: density of direct light's photons at the
        first vertex, over that of next-event estimation [1/m^2]."""
        return state[: self.whole + 1], state[self.whole + 1 :]

    def first_vertex(self, state, si, source, straight):
        nodes, others = self._split(state)
        if not others:
            return state
        ds = light_seen_from(si, source, straight)
        ratio = self.weights.lights.emission_over_nee_pdf(si, ds, straight)
        return [*nodes, [dr.select(straight, ratio, others[0][0])]]

    def scatter(self, state, si, bsdf, wo, mask):
        view = mi.SurfaceInteraction3f(si)
        view.wi = mi.Vector3f(wo)
        f, p = self.weights.scattering(view, bsdf, si.wi, mask) if self.whole else (None, None)
        node = self.weights.node(view, bsdf, mask, f, p)
        nodes, others = self._split(state)
        node.indirectly = nodes[0][0][0] >= 0
        new = self._fields(node)
        result = []
        for old in nodes:
            result.append([dr.select(mask, a, b) for a, b in zip(new, old)])
            new = old
        return result + others

    def volume_words(self, state):
        """As `words`, of photons in media: those that come straight from a light have what
        `first_vertex` found in the place of a radiance, below zero."""
        nodes, others = self._split(state)
        if not others:
            return self.words(state)
        ((direct, *fields), *farther), ((ratio,),) = nodes, others
        direct = dr.select(direct[0] < 0, -dr.maximum(ratio, SMALLEST_RATIO), direct)
        return self.words([[direct, *fields], *farther])

    def straight_from_light(self, mis_words, index, active):
        """What `first_vertex` found of photons that come straight from a light."""
        first = next(iter(self.layout.fields))
        return -self.layout.read(mis_words, index, active, (first,))[first][0]

    def words(self, state):
        values = [field for fields in self._split(state)[0] for field in fields]
        return self.layout.flat(dict(zip(self.layout.fields, values)))

    def read(self, level, mis_words, index, active):
        """The vertices that photon `index`, merged at z_level, has passed: `Node`s, nearest first,
        as many as there are strategies beyond that level. Those that do not exist come after one
        that direct light ends."""
        last = self.whole - level
        wanted = [
            (node, field)
            for node, field in self.layout.fields
            if node < last or (node == last and field < FIELDS_OF_THE_LAST)
        ]
        record = self.layout.read(mis_words, index, active, wanted)
        return [
            self._node(*(record[place] for place in wanted if place[0] == node))
            for node in range(last + 1)
        ]
