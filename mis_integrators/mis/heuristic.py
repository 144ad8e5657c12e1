"""Where transport and Veach's heuristics meet: the balance or power heuristic over the strategies
of `bdpm_balance`.

A joint path has the smooth vertices z_0, z_1, ..., counted from the camera. Strategy i merges a
photon at z_i, for i below the number of strategies; direct light at the last vertex is one more
strategy, if the path is short enough. Densities, per projected solid angle:

    p_i   of the camera path at z_i for the direction to z_{i+1}
    q_i   of the light sub-path at z_{i+1} for the direction to z_i

A merge takes camera and light sub-paths that end in the same disk, so its density is the product of
theirs and of the disk's area pi R^2, and light sub-paths are its samples (Georgiev et al., Light
transport simulation with vertex connection and merging (2012), doi 10.1145/2366145.2366211; pi R^2
N_F there is eta_VM). Between neighbours all but one vertex cancels, the geometric term too:

    merging at z_i : merging at z_{i+1}                        =  q_i / p_i
    merging at z_i : direct light at z_{i+1}                   =  pi R^2 N_F rho_e q_i / p_i
    merging at z_i : merging a caustic photon at z_{i+1}       =  (R / R_caustic)^2 q_i / p_i

rho_e [1/m^2] is the density, as an area density at z_{i+1}, with which light sub-paths start there
over that with which next-event estimation finds the point of the light
(`Lights.emission_over_nee_pdf` times the cosine). Next-event estimation and BSDF sampling count as
one technique, with the density of the former; the camera pass divides the light between them. All
camera paths of a pixel make all strategies, each path once, so their number cancels. That
strategies share their sub-paths Veach's theory does not see: the optimal weights do.

**In media** (docs/bdpm_balance.md derives it) the same ratios hold, per solid angle where a vertex
lies in a medium: there is no cosine. A photon is merged there along the camera's segment, by a disk
across it (Jarosz et al., A comprehensive theory of volumetric radiance estimation using photon
points and beams (2011), doi 10.1145/1899404.1899409), so that the camera path needs no free flight
that ends at the vertex, and the density of a merge has no extinction from the camera's side
(Krivanek et al., Unifying points, beams, and paths in volumetric light transport simulation (2014),
doi 10.1145/2601097.2601219). Where the next strategy's camera path scatters there, it has the
extinction that the light sub-path has in this one. What is left of extinctions is nothing, and of
disks the ratio of their areas, A_i at z_i over that of indirect photons on surfaces:

    merging at z_i : merging at z_{i+1}                        =  A_i q_i / (A_{i+1} p_i)
    merging direct light at z_i : next-event estimation there  =  A_i pi R^2 N_F rho_e

The latter is one more strategy: photons that come straight from a light are merged in media, too.
At the last strategy's vertex no camera path scatters in media, so there it is the only one.
Transmittance is taken for the same in all strategies. It is but for what is computed: that of
next-event estimation, and of the segment along which the last strategy merges.

The weights are functions of the joint path alone, with its own vertices up to the merge radius. Not
in them: Russian roulette, the choices at delta surfaces (alike from both sides), and the defensive
directions of light sub-paths at bump and normal maps. They cost noise, never light.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.records import Layout
from ..paths.light_starts import light_seen_from
from ..paths.vertex import in_medium, per_projected
from ..photons.queries import STATE
from ..weights.heuristics import add_ratio, bounded_power, weight

SMALLEST_DENSITY = 1e-20
"""Stands for zero densities, so that the ratio of two of them is one."""
UNFOUND = 1e18
"""Stands for the expected photons of direct light that next-event estimation cannot make."""


def ratio(a, b):
    return dr.maximum(a, SMALLEST_DENSITY) / dr.maximum(b, SMALLEST_DENSITY)


class HeuristicWeights:
    """Weights of `strategies` merging strategies, the first at camera vertex 0, with Veach's
    exponent `beta`.

    `disk_paths`: pi R^2 N_F of indirect photons [m^2]; `caustic_share`: that over the same of
    caustic photons; `volume_share`: that of volume photons over it (None: a scene without media).
    All of width one. Sums, as of `add_ratio`, are of the strategies on one side of a vertex's own
    merging.
    """

    def __init__(self, lights, disk_paths, caustic_share, strategies, beta, volume_share=None):
        self.lights, self.disk_paths, self.caustic_share = lights, disk_paths, caustic_share
        self.strategies, self.beta, self.volume_share = strategies, beta, volume_share

    weighs_points_of_lights = True

    # ------------------------------------------------------------------ densities

    def per_disk(self, n, density, cosine):
        """A density per solid angle at a vertex with normal `n`, per projected solid angle and unit
        of the disk A there."""
        value = density * per_projected(cosine)
        if self.volume_share is None:
            return value
        return dr.select(in_medium(n), density * dr.rcp(self.volume_share), value)

    def onwards(self, si, bsdf, wo, mask):
        """p_i / A_i of the camera path that arrives from `si.wi` and goes on to `wo`."""
        return self.per_disk(si.n, bsdf.pdf(mi.BSDFContext(), si, wo, mask), wo.z)

    def of_light(self, si, bsdf, wo, mask):
        """q_{i-1} / A_i of the light sub-path that does."""
        pdf = bsdf.pdf(mi.BSDFContext(mi.TransportMode.Importance), si, wo, mask)
        return self.per_disk(si.n, pdf, wo.z)

    def expected_photons(self, ref, ds, mask):
        """A pi R^2 N_F rho_e: light sub-paths that start from the light `ds` into the merge disk at
        `ref`, for each time that next-event estimation finds it."""
        cosine = dr.abs(dr.dot(ref.n, ds.d))
        if self.volume_share is not None:
            cosine = dr.select(in_medium(ref.n), self.volume_share, cosine)
        return self.disk_paths * cosine * self.lights.emission_over_nee_pdf(ref, ds, mask)

    # --- camera paths (`mis.state.MergeState`) ---------------------------------------------------

    def init(self, width):
        """State of a camera path on its way to z_i: the sum of the strategies before z_{i-1}, and
        p_{i-1}. The sum -1 stands for none, not even z_{i-1}: `add_ratio` makes zero of it."""
        return [dr.full(mi.Float, -1, width), dr.ones(mi.Float, width)]

    def propagate(self, state, si, bsdf, vertex, mask):
        return state, mi.Spectrum(1)  # all of it is in next_event_weight

    def scatter(self, state, si, bsdf, bs, vertex, mask):
        """State after a smooth scattering into `bs.wo`."""
        total, p = state
        seen_by_light = mi.SurfaceInteraction3f(si)
        seen_by_light.wi = mi.Vector3f(bs.wo)
        q = self.of_light(seen_by_light, bsdf, si.wi, mask)
        return [
            dr.select(mask, add_ratio(total, ratio(q, p), self.beta), total),
            dr.select(mask, self.onwards(si, bsdf, bs.wo, mask), p),
        ]

    def next_event_weight(self, state, ref, ds, mask):
        """Weight of the direct light that `ds` brings to the vertex `ref`; `state`: after leaving
        `ref` for the light."""
        before, _ = state
        if self.volume_share is not None:
            before = dr.select(in_medium(ref.n), 1 + before, before)
        share = weight(bounded_power(self.expected_photons(ref, ds, mask), self.beta) * before, 0)
        return mi.Spectrum(dr.select(mask, share, 0))

    @staticmethod
    def ends(bsdf, vertex, mask):
        return mi.Bool(False)

    def stored(self, state):
        total, p = state
        return [mi.Spectrum(total), mi.Spectrum(p), mi.Spectrum(0)]  # the last is not needed

    # ------------------------------------------------------------------ photons

    def light_state(self):
        """What light sub-paths carry for these weights; `None` if nothing."""
        return LightState(self) if self.strategies > 1 else None

    def weigher(self, kind, level, vertices, photon_map):
        """Weight of the photons of a map at the vertices of one strategy, `level`, or of all if the
        photons are caustic ones (`weigh` of `gather_photons`)."""
        total, p_before = (vertices[name][0] for name in STATE[:2])

        def weigh(index, landing, scattering, active):
            p = scattering.p
            before = add_ratio(total, ratio(scattering.back(), p_before), self.beta)
            after = mi.Float(0)
            if kind == "caustic":
                before *= bounded_power(self.caustic_share, self.beta)
            elif level < self.strategies - 1:
                q, deeper = self.light_state().read(
                    level,
                    photon_map.mis_words,
                    photon_map.place_of_mis_words(index, active),
                    active,
                )
                after = add_ratio(deeper, ratio(p, q), self.beta)
            return mi.Spectrum(weight(before, after))

        return weigh

    def beam_weigher(self, beams, state, photon_map):
        """Weight of volume photons along beams (`weigh` of `gather_along`), whose paths arrive with
        the weights' `state` (as `stored`)."""
        total, p_before = (values[0] for values in state[:2])
        light_state, ends = self.light_state(), beams.level == self.strategies - 1

        def weigh(index, pdf, active):
            per_disk = pdf * dr.rcp(self.volume_share)
            before = add_ratio(total, ratio(per_disk, p_before), self.beta)
            after = mi.Float(0)
            if light_state is not None:
                place = photon_map.place_of_mis_words(index, active)
                q, sums = light_state.read_all(photon_map.mis_words, place, active)
                deeper = mi.Float(0)
                for level, value in enumerate(sums):
                    deeper = dr.select(beams.level == level, value, deeper)
                merged = add_ratio(deeper, ratio(per_disk, q), self.beta)
                after = dr.select(ends, 0, dr.select(q < 0, self.found(-q), merged))
            return weight(before, after)

        return weigh

    def found(self, expected_photons):
        """Sum of the one strategy after merging direct light in a medium, next-event
        estimation."""
        return bounded_power(dr.rcp(dr.maximum(expected_photons, SMALLEST_DENSITY)), self.beta)


class LightState:
    """Sums of a light sub-path that has scattered at z_{i+1} and lands at some z_i: q_i, and for
    each level i, up to two before the last strategy, the sum of the strategies after z_{i+1}.
    Before the last there is one strategy after z_i, and its sum is zero. Right after the first
    scattering direct light is what comes next; then q_i holds its ratio's other factor, too. Where
    that was in a medium, merging the direct light comes next, and next-event estimation last. In
    scenes with media there is one number more: the expected photons of direct light at the first
    vertex, or `UNFOUND`. (Hooks of `trace_light_paths`.)
    """

    in_media = True

    def __init__(self, weights):
        self.weights = weights
        self.levels = weights.strategies - 2
        sums = [f"sum.{level}" for level in range(self.levels)]
        self.layout = Layout(dict.fromkeys(["q", *sums], mi.Float))

    def init(self):
        """That factor, q (zero: has not scattered yet), the sums."""
        expected = [] if self.weights.volume_share is None else [mi.Float(UNFOUND)]
        return [
            mi.Float(self.weights.caustic_share),
            mi.Float(0),
            *[mi.Float(0) for _ in range(self.levels)],
            *expected,
        ]

    def _split(self, state):
        """The sums apart from what there is in media only."""
        return state[: 2 + self.levels], state[2 + self.levels :]

    def first_vertex(self, state, si, source, straight):
        """State at a vertex that the light of `source` reaches on the lanes `straight`: there
        next-event estimation competes, elsewhere caustic photons do."""
        weights = self.weights
        ds = light_seen_from(si, source, straight)
        expected = weights.expected_photons(si, ds, straight)
        state, others = self._split(state)
        return [
            dr.select(straight, expected, weights.caustic_share),
            *state[1:],
            *[dr.select(straight, expected, before) for before in others],
        ]

    def scatter(self, state, si, bsdf, wo, mask):
        """State after a smooth scattering into local direction `wo`."""
        (factor, q_before, *sums), others = self._split(state)
        first = q_before == 0
        start, following = 0, factor
        if others:
            inside = in_medium(si.n)
            start = dr.select(inside, self.weights.found(others[0]), 0)
            following = dr.select(inside, 1, factor)
        seen_by_camera = mi.SurfaceInteraction3f(si)
        seen_by_camera.wi = mi.Vector3f(wo)
        p = self.weights.onwards(seen_by_camera, bsdf, si.wi, mask)
        q = dr.maximum(
            self.weights.of_light(si, bsdf, wo, mask) * dr.select(first, following, 1),
            SMALLEST_DENSITY,
        )
        sums_here = [
            dr.select(first, start, add_ratio(deeper, ratio(p, q_before), self.weights.beta))
            for deeper in (*sums[1:], mi.Float(0))
        ]
        return (
            [factor]
            + [dr.select(mask, new, old) for new, old in zip([q, *sums_here], [q_before, *sums])]
            + others
        )

    def words(self, state):
        return self.layout.flat(dict(zip(self.layout.fields, state[1:])))

    def volume_words(self, state):
        """What is stored with a volume photon: in the place of q, before anything has scattered,
        minus the expected photons."""
        (_, q, *sums), (expected,) = self._split(state)
        return self.words([None, dr.select(q == 0, -expected, q), *sums])

    def read_all(self, mis_words, index, active):
        """q of photon `index` (as of `volume_words`), and the sums of all levels."""
        q, *sums = self.layout.read(mis_words, index, active).values()
        return q, sums

    def read(self, level, mis_words, index, active):
        """q_level of photon `index`, merged at z_level, and the sum of the strategies after
        z_{level + 1}."""
        wanted = ("q",) if level >= self.levels else ("q", f"sum.{level}")
        record = self.layout.read(mis_words, index, active, wanted)
        return record["q"], record.get(f"sum.{level}", mi.Float(0))
