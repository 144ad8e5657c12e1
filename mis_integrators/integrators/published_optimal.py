"""Iterations of `bdpm_opt` under the weights as Ershov, Kopylov and Voloboy print them.

No theory of weights is evaluated in a path loop. The passes of an iteration leave flat arrays:
photons with the vertices that they come from, and camera vertices with the light found there.
Weights are gathered at these vertices in the frozen map, then each strategy's light is summed.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..core.film import splat_samples
from ..core.packing import rounded_up, with_reserve
from ..core.recording import no_garbage_collection
from ..mis.published_optimal import (
    FrozenMap,
    PhotonLengths,
    ThreeStrategies,
    TwoStrategies,
    typical_flux,
)
from ..photons.chains import NONE, PhotonChains, trace_camera_chains, trace_photon_chains
from ..photons.grid import build_photon_map
from ..photons.pairs import meeting_of, parts, photon_pairs, take
from ..photons.photon import surface_layout
from ..photons.queries import DEPTH
from .purposes import CAMERA, FROZEN, LIGHT
from .weighted import UnderWeights

STRATEGIES = {2: TwoStrategies, 3: ThreeStrategies}
"""Numbers of strategies for which there are printed weights."""
USUAL_FROZEN_PATHS = 1 << 16
"""Tuned: light sub-paths of the frozen pass, of all weights, unless the parameter says
otherwise."""
CHAIN_CHUNK = 1 << 18
"""Camera paths traced at once at most (bounds memory)."""
PHOTONS_A_PATH = 5
"""Room for photons of a pass; it grows where that is not enough."""


class PublishedSession(UnderWeights):
    """Iterations of `bdpm_opt` with `weights` = `published`.

    The pilot of an automatic radius merges at the first strategy's vertex, unweighted.
    """

    widens_caustics = False

    def __init__(self, integrator, scene, sensor, seed, iterations):
        super().__init__(integrator, scene, sensor, seed, iterations)
        self.split_paths(CHAIN_CHUNK)
        self.frozen = None
        self._flux = 0.0
        self._chain_capacity = rounded_up(PHOTONS_A_PATH * self.light_path_count)

    # ------------------------------------------------------------------ light

    def _trace_chains(self, seed_of, paths, spectral, keep_direct=False, capacity=None):
        """`PhotonChains` of a light pass, with as much room as they need."""
        capacity = capacity or rounded_up(PHOTONS_A_PATH * paths)
        while True:
            light_pass = self.describe_light_pass(
                self.sensor, self._sequence(*seed_of, paths), paths, spectral
            )
            chains = trace_photon_chains(self.world, self.limits, light_pass, capacity, keep_direct)
            dr.eval(chains)
            found = int(chains.count[0])
            if found <= capacity:
                return chains
            capacity = with_reserve(found)

    def _learn(self):
        """One light pass, frozen, the first time that it is asked for: for the weights only. Its
        radius is that of the first iteration."""
        if self.frozen is not None:
            return
        integrator, spectral = self.integrator, self._spectral(0)
        paths = integrator.frozen_photons or USUAL_FROZEN_PATHS
        chains = self._trace_chains((0, FROZEN), paths, spectral, keep_direct=True)
        radii = self.radii_at(0)
        self._flux = typical_flux(chains)
        self.frozen = FrozenMap(
            self.traits,
            chains,
            paths,
            radii.get("indirect", radii.get("caustic")),
            spectral["wavelengths"],
            PhotonLengths(integrator.max_depth, integrator.first_vertex),
            integrator.strategies,
        )

    def photons_per_irradiance(self, radius):
        """n: merge area times light sub-paths over the flux of a photon."""
        per_area = self.light_path_count / self._flux if self._flux > 0 else 0.0
        return dr.pi * dr.square(radius) * dr.opaque(mi.Float, per_area)

    def theory(self, radius):
        """The weights of an iteration of that radius."""
        integrator = self.integrator
        strategies = STRATEGIES[integrator.strategies]
        return strategies(self.frozen, self.photons_per_irradiance(radius), self.camera_paths)

    # ------------------------------------------------------------------ iterations

    def _iteration(self, iteration):
        radii = self.radii_at(iteration)
        if not radii:
            return super()._iteration(iteration)
        with no_garbage_collection():  # as where passes are recorded: these are not
            return self._render_weighted(iteration, radii)

    def _render_weighted(self, iteration, radii):
        self._learn()
        spectral = self._spectral(iteration)
        chains = self._trace_chains(
            (iteration, LIGHT), self.light_path_count, spectral, capacity=self._chain_capacity
        )
        self._chain_capacity = surface_layout().capacity(chains.surface)
        light = LightOfIteration(self, chains, radii, spectral)
        sequence = self._sequence(iteration, CAMERA, self.camera_paths)
        (block,) = self.sum_of_chunks(
            lambda chunk, first: (self._render_part(light, sequence, first, spectral),)
        )
        return self.direct_light.add_to(block, iteration, spectral)

    def _render_part(self, light, sequence, first, spectral):
        """The image of the camera paths from number `first` on."""
        integrator = self.integrator
        path = self.part_of_paths(first)
        there = path < self.path_count
        camera_pass = self.describe_camera_pass(self.sensor, sequence, path, spectral)
        beyond = self.direct_light.beyond
        if beyond is not None:
            beyond = dr.gather(mi.Float, beyond, camera_pass.pixel, there)
        last = integrator.first_vertex + integrator.strategies - 1
        capacity = self.chunk
        while True:
            radiance, alpha, position, chains = trace_camera_chains(
                self.world,
                self.limits,
                camera_pass,
                integrator.first_vertex,
                last,
                capacity,
                beyond,
            )
            dr.eval(radiance, alpha, position, chains)
            wanted = int(dr.max(chains.count)[0])
            if wanted <= capacity:
                break
            capacity = with_reserve(wanted)
        gathered, direct = light.gather(chains, self.chunk, sequence.own_seed())
        radiance += direct + (gathered if beyond is None else gathered * beyond)
        if integrator.hide_emitters:
            radiance = dr.select(alpha > 0, radiance, 0)
        weight = 1 if beyond is None else dr.rcp(beyond)
        return splat_samples(
            self.sensor.film(), position, radiance, alpha, spectral["matrix"], there, weight
        )


class LightOfIteration:
    """An iteration's photons under the weights: maps by kind, and what is known of the vertices
    that photons come from."""

    def __init__(self, session, chains: PhotonChains, radii, spectral):
        self.session, self.chains, self.radii, self.spectral = session, chains, radii, spectral
        self.maps = {kind: self._map(kind, radius) for kind, radius in radii.items()}
        radius = radii.get("indirect", radii.get("caustic"))
        self.theory = session.theory(radius)
        self.known = session.frozen.appraise(chains)

    def _map(self, kind, radius):
        chains, traits = self.chains, self.session.traits
        capacity = surface_layout().capacity(chains.surface)
        return build_photon_map(
            chains.surface,
            chains.power,
            chains.count,
            traits.bounds,
            radius,
            capacity,
            kind,
            chains.words,
        )

    # ------------------------------------------------------------------ sums

    def gather(self, camera, paths, seed):
        """Weighted radiance of photons at the vertices of camera paths, and of direct light beyond
        the first strategy's vertex: two spectra for each of `paths` paths."""
        self.camera, self.seed = camera, seed
        self.photons, self.direct = dr.zeros(mi.Spectrum, paths), dr.zeros(mi.Spectrum, paths)
        first = self.session.integrator.first_vertex
        for number in range(first):  # before all strategies: only caustics are merged
            self._add("caustic", number, 1)
        self._add("caustic", first, 1)
        root_record = camera.record(camera.section(first))
        root = self.theory.roots(root_record)
        self._add_pairs(
            root_record,
            lambda meeting, place, vertex: self.theory.of_photons(
                meeting, self.chains, self.known, place, [take(x, vertex) for x in root]
            ),
        )
        if self.session.integrator.strategies == 2:
            self._finish(first + 1, root)
        else:
            self._finish(first + 2, self._inner(first + 1, root))
        return self.photons, self.direct

    def _inner(self, number, root):
        """Light at vertices z_1 of three strategies: their `Middle`, for those beyond."""
        theory, camera = self.theory, self.camera
        place = camera.section(number)
        record, link = camera.record(place), camera.link(place)
        middle = theory.of_inner(record, link, self._before(record, link, number, root))
        weight = 1 - middle.direct_weight()
        self._add_direct(number, record, weight)
        self._add("caustic", number, weight)
        self._add_pairs(
            record,
            lambda meeting, place, vertex: theory.of_inner_photons(
                meeting, self.known, place, middle.at(vertex)
            ),
        )
        return middle

    def _finish(self, number, before):
        """Light at the last vertices: photons and direct light under one weight."""
        camera = self.camera
        place = camera.section(number)
        record, link = camera.record(place), camera.link(place)
        if self.session.integrator.strategies == 2:
            known = self._before(record, link, number, before)
        else:
            known = before.at(*self._place_before(record, link, number))
        weight = self.theory.of_last(record, link, known)
        dr.eval(weight)
        self._add_direct(number, record, weight)
        for kind in self.maps:
            self._add(kind, number, weight)

    def _place_before(self, record, link, number):
        """Numbers, in their section, of the vertices before those with this number, and whether
        there are any."""
        there = (dr.max(record["throughput"]) > 0) & (link["before"] != NONE)
        index = link["before"] - (number - 1) * self.camera.capacity
        # What is not there may hold any number, and Dr.Jit reads records on masked lanes, too.
        return dr.select(there, index, 0), there

    def _before(self, record, link, number, arrays):
        """What is known of the vertices before."""
        index, there = self._place_before(record, link, number)
        return [dr.gather(mi.Float, array, index, there) for array in arrays]

    # ------------------------------------------------------------------ parts of the sum

    @staticmethod
    def _to_paths(total, record, values):
        """Adds values of vertices to those of their paths."""
        used = dr.max(record["throughput"]) > 0
        dr.scatter_reduce(
            dr.ReduceOp.Add, total, values, record["path"], used, dr.ReduceMode.Direct
        )
        dr.eval(total)

    def _add_direct(self, number, record, weight):
        place = self.camera.section(number)
        self._to_paths(self.direct, record, self.camera.light(place) * weight)

    def _correction(self, kind, record, radius):
        session = self.session
        if not session.corrects(kind):
            return 1
        return dr.rcp(session.coverage(session.scene, record, radius, self.seed).share)

    def _add(self, kind, number, weight):
        """Photons of a kind at vertices with a number, all of a vertex under one weight."""
        if kind not in self.maps:
            return
        record, radius = self.camera.record(self.camera.section(number)), self.radii[kind]
        used = dr.max(record["throughput"]) > 0
        scale = dr.select(used, mi.Spectrum(weight), 0)
        (values,) = self.session._merge(
            self.maps[kind], record, kind, [radius], self.spectral, scale=scale
        )
        self._to_paths(self.photons, record, values * self._correction(kind, record, radius))

    def _add_pairs(self, record, weight_of):
        """Indirect photons at vertices, each under a weight of its own,
        `weight_of(meeting, place of the photon, number of the vertex)`."""
        if "indirect" not in self.maps:
            return
        session, photon_map, radius = self.session, self.maps["indirect"], self.radii["indirect"]
        vertices = session.frozen.vertices(record)
        values = dr.zeros(mi.Spectrum, dr.width(vertices.p))
        vertex, photon = photon_pairs(photon_map, vertices, radius, -1)
        depth, max_depth = record["depth"] & DEPTH, session.limits.max_depth
        for some in parts(dr.width(vertex)):
            index, mine = (dr.gather(mi.UInt32, x, some) for x in (photon, vertex))
            there = session.frozen.vertices({name: take(x, mine) for name, x in record.items()})
            meeting = meeting_of(photon_map, there, index)
            if max_depth > 0:
                meeting.lit &= meeting.landing.depth + take(depth, mine) <= max_depth
            place = photon_map.place_of_mis_words(index, meeting.lit)
            weight = weight_of(meeting, place, mine)
            light = there.factor * meeting.scattering.value * meeting.flux
            light *= weight * meeting.cosines / dr.maximum(meeting.scattering.shading, 1e-6)
            dr.scatter_reduce(
                dr.ReduceOp.Add, values, light, mine, meeting.lit, dr.ReduceMode.Direct
            )
            dr.eval(values)
        values *= dr.rcp(dr.pi * dr.square(radius) * session.light_path_count)
        self._to_paths(self.photons, record, values * self._correction("indirect", record, radius))
