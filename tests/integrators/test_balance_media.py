"""The plugin `bdpm_balance` in participating media: its weights are one function of the joint path
whichever strategy makes it, they are Veach's, and its renders are right.

Comparisons of renders: as in `test_bdpm_media`.
"""

from mis_integrators.core.packing import pack_direction, unpack_direction
from mis_integrators.core.random import next_2d, streams
from mis_integrators.core.traits import SceneTraits
from mis_integrators.lights.lights import Lights
from mis_integrators.mis.heuristic import HeuristicWeights
from mis_integrators.paths.media import interaction_at, sample_phase
from mis_integrators.paths.vertex import PhaseOrBSDF
from mis_integrators.photons.beams import LEVEL_SHIFT, LONG, Beams, beam_layout, gather_along
from mis_integrators.photons.gather import QueryVertices, gather_photons
from mis_integrators.photons.grid import build_photon_map
from mis_integrators.photons.photon import new_photons, write_photon
from mis_integrators.photons.queries import LAST_VERTEX, STATE
from mis_integrators.photons.volume import (
    build_volume_map,
    new_volume_photons,
    write_volume_photon,
)
from mis_integrators.weights.heuristics import heuristic_weights

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import PathBatches, assert_same, collect_until
from foggy import view, volpath
from selection import extended, one_in_each_row
from test_bdpm_media import RADIUS, SCENES, SLACK, SmallRadiusBatches
from test_bdpt_media import FOG, hg, homogeneous
from worlds import T, diffuse, lamp_inside

COUNT = 400
NEAR = 1e-4
"""Merge radius: a photon is merged with its own path only."""
DISK_PATHS, CAUSTIC_SHARE, VOLUME_SHARE = 20.0, 0.4, 1.7


def room(light, size=1.0):
    """A closed room of edge 2 times `size` full of fog, with a lamp."""
    lamp, scale = lamp_inside(light, radiance=5.0), T().scale(size)
    if light == "point":
        lamp["position"] = [size * x for x in lamp["position"]]
    else:
        lamp["to_world"] = scale @ lamp["to_world"]
    sensor = view((0, -0.9 * size, -0.3 * size), (0.1 * size, 0, 0), size=8, fov=70.0)
    walls = {"type": "cube", "bsdf": {"type": "twosided", "bsdf": diffuse(0.7)}}
    return mi.load_dict(
        {
            "type": "scene",
            "fog": {**homogeneous(1 / size, 0.9, hg(0.5)), "id": "fog"},
            "walls": {**walls, "to_world": scale},
            "lamp": lamp,
            "sensor": {**sensor, "medium": FOG},
        }
    )


def as_photons_remember(direction):
    return dr.normalize(unpack_direction(pack_direction(direction)))


class JointPaths:
    """Random paths from the camera through smooth vertices, in the medium (`M`) or on surfaces
    (`S`) as `kinds` says, to a point of a light, with the weights that each strategy's own code
    gives them."""

    def __init__(self, scene, kinds):
        self.scene, self.kinds = scene, kinds
        self.traits, self.lights = SceneTraits(scene, scene.sensors()[0]), Lights(scene)
        self.medium = mi.MediumPtr(scene.sensors()[0].get_medium())
        rng = streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(5))
        ray, _ = scene.sensors()[0].sample_ray(0, 0.5, next_2d(rng), mi.Point2f(0.5))
        ray = mi.Ray3f(ray)
        self.vertices, self.valid = [], dr.full(mi.Bool, True, COUNT)
        for number, kind in enumerate(kinds):
            inside = mi.Bool(kind == "M")
            hit = scene.ray_intersect_preliminary(ray)
            self.valid &= hit.is_valid()
            hit.t = dr.select(inside, hit.t * (0.2 + 0.6 * rng.next_float32()), hit.t)
            hit.shape = dr.select(inside, dr.zeros(mi.ShapePtr), hit.shape)
            si = interaction_at(hit, ray, inside, True)
            bsdf = si.bsdf()
            choice, point = rng.next_float32(), next_2d(rng)
            bs, weight = bsdf.sample(mi.BSDFContext(), si, choice, point, ~inside)
            bs, _ = sample_phase(self.traits, self.medium, si, choice, point, bs, weight, inside)
            self.valid &= bs.pdf > 0
            if number == len(kinds) - 1:
                self.light, value, _ = self.lights.sample_direct(si, rng, self.valid)
                self.valid &= dr.max(value) > 0
                bs.wo = si.to_local(self.light.d)
            else:
                bs.wo = si.to_local(as_photons_remember(si.to_world(bs.wo)))
            dr.eval(ray, hit, si, bs, rng, self.valid)
            self.vertices.append((ray, hit, si, PhaseOrBSDF(bsdf, self.medium, inside), bs))
            ray = si.spawn_ray(si.to_world(bs.wo))
        dr.eval(self.light)

    def camera(self, weights):
        """What a camera path stores before each vertex, and its states after leaving them."""
        state, stored, left = weights.init(COUNT), [], []
        for number, (_, _, si, scattering, bs) in enumerate(self.vertices):
            stored.append(weights.stored(state))
            vertex = dr.full(mi.UInt32, number, COUNT)
            state = weights.scatter(state, si, scattering, bs, vertex, self.valid)
            dr.eval(state, stored)
            left.append(state)
        return stored, left

    def direct(self, weights, left):
        """Weight of next-event estimation at the last vertex."""
        _, _, si, _, _ = self.vertices[-1]
        return weights.next_event_weight(left[-1], si, self.light, self.valid)[0]

    def state_at(self, weights, level, straight):
        """State of the light sub-path that arrives at a vertex; `straight`: it came to the last
        vertex straight from the light."""
        light_state = weights.light_state()
        state = light_state.init()
        source = dr.zeros(mi.DirectionSample3f, COUNT)
        source.p, source.n, source.emitter = self.light.p, self.light.n, self.light.emitter
        last = len(self.vertices) - 1
        for number in reversed(range(level, last + 1)):
            _, _, si, scattering, _ = self.vertices[number]
            view = mi.SurfaceInteraction3f(si)
            view.wi = si.to_local(self.towards(number))
            here = self.valid & straight & (number == last)
            state = light_state.first_vertex(state, view, source, here)
            if number > level:
                state = light_state.scatter(state, view, scattering, si.wi, self.valid)
            dr.eval(state)
        return state

    def towards(self, number):
        """Where the light sub-path comes from."""
        _, _, si, _, bs = self.vertices[number]
        direction = si.to_world(bs.wo)
        last = number == len(self.vertices) - 1
        return direction if last else as_photons_remember(direction)

    def merged(self, weights, stored, level, straight):
        """Weight of a photon at vertex `level`: what a gather of just this photon brings, over what
        it would bring without weights."""
        gather = self._along if self.kinds[level] == "M" else self._on_surface
        weighed, plain = (gather(weights, stored, level, straight, w) for w in (True, False))
        self.valid &= plain > 0
        return weighed / plain

    def _words(self, light_state, level, straight):
        state = self.state_at(light_state.weights, level, straight)
        name = "volume_words" if self.kinds[level] == "M" else "words"
        words = getattr(light_state, name)(state)
        records = light_state.layout.room(COUNT)
        index = dr.arange(mi.UInt32, COUNT)
        for place, word in enumerate(words):
            dr.scatter(records, word + dr.zeros(mi.UInt32, COUNT), len(words) * index + place)
        return records

    def _photon(self, level):
        _, _, si, _, _ = self.vertices[level]
        towards = self.towards(level)
        photon = {"p": si.p, "n": si.n, "towards": towards, "flux": mi.Spectrum(1)}
        return {**photon, "depth": mi.UInt32(2), "medium": self.medium}

    def _along(self, weights, stored, level, straight, weighed):
        ray, hit, _, _, _ = self.vertices[level]
        place, power = new_volume_photons(COUNT)
        index = dr.arange(mi.UInt32, COUNT)
        caustic = mi.Bool(level == len(self.kinds) - 1 and not straight)
        write_volume_photon(place, power, index, {**self._photon(level), "caustic": caustic}, True)
        light_state = weights.light_state()
        words = self._words(light_state, level, straight) if light_state else None
        radius = dr.opaque(mi.Float, NEAR)
        photon_map = build_volume_map(place, power, mi.UInt32([COUNT]), radius, COUNT, words)
        beam = {
            "o": ray.o,
            "d": ray.d,
            "path": index,
            "depth": dr.full(mi.UInt32, LONG | (level << LEVEL_SHIFT) | level + 1, COUNT),
            "throughput": dr.select(self.valid, mi.Spectrum(1), 0),
            "length": 1.1 * hit.t,
            "medium": self.medium,
            "normal_behind": pack_direction(mi.Vector3f(0, 0, 1)),
            "behind": mi.Float(dr.inf),
            "normal_ahead": pack_direction(mi.Vector3f(0, 0, 1)),
            "ahead": mi.Float(dr.inf),
        }
        buffer = beam_layout().room(COUNT)
        beam_layout().write(buffer, beam, index)
        beams = Beams.read(buffer, [], self.traits)
        weigh = weights.beam_weigher(beams, stored[level], photon_map) if weighed else None
        (radiance,) = gather_along(photon_map, beams, [radius], 1, -1, weigh=weigh)
        dr.eval(radiance)
        return dr.mean(radiance)

    def _on_surface(self, weights, stored, level, straight, weighed):
        ray, hit, _, _, _ = self.vertices[level]
        kind = "indirect" if level < len(self.kinds) - 1 else "caustic"
        vertices = {
            "ray_o": ray.o,
            "ray_d": ray.d,
            "hit": hit,
            "path": dr.arange(mi.UInt32, COUNT),
            "throughput": dr.select(self.valid, mi.Spectrum(1), 0),
            "depth": dr.full(mi.UInt32, LAST_VERTEX | (level + 1), COUNT),
            **dict(zip(STATE, stored[level])),
        }
        surface, power = new_photons(COUNT)
        photon = {**self._photon(level), "caustic": mi.Bool(kind == "caustic")}
        write_photon(surface, power, dr.arange(mi.UInt32, COUNT), photon, True)
        light_state = weights.light_state()
        words = self._words(light_state, level, straight) if light_state else None
        box, cell = self.traits.bounds, mi.Float(0.01)
        count = mi.UInt32([COUNT])
        photon_map = build_photon_map(surface, power, count, box, cell, COUNT, "all", words)
        weigh = weights.weigher(kind, level, vertices, photon_map) if weighed else None
        (radiance,) = gather_photons(
            photon_map,
            QueryVertices(self.traits, vertices, [], True),
            [dr.opaque(mi.Float, NEAR)],
            1,
            -1,
            weigh=weigh,
        )
        dr.eval(radiance)
        return dr.mean(radiance)


def weights_of(paths, strategies, beta):
    numbers = (dr.opaque(mi.Float, x) for x in (DISK_PATHS, CAUSTIC_SHARE, VOLUME_SHARE))
    disk, caustic, volume = numbers
    return HeuristicWeights(paths.lights, disk, caustic, strategies, beta, volume)


def weights_found(paths, strategies, beta, straight):
    """Weights of all strategies that can make the paths, by the code of each; rows as `merging at
    z_0, z_1, ..., next-event estimation`."""
    weights, last = weights_of(paths, strategies, beta), len(paths.kinds) - 1
    stored, left = paths.camera(weights)
    merges_last = paths.kinds[last] == "M" or not straight
    levels = range(min(last + merges_last, strategies))
    found = [paths.merged(weights, stored, level, straight) for level in levels]
    finds = last < strategies - 1 or (last == strategies - 1 and paths.kinds[last] == "S")
    if straight and finds:
        found.append(paths.direct(weights, left))
    valid = np.array(paths.valid)
    assert valid.sum() > 100
    return np.array([np.array(weight)[valid] for weight in found]), valid


@pytest.mark.parametrize(
    "kinds, strategies, beta, light",
    [
        ("M", 2, 1, "area"),
        ("SM", 3, 2, "area"),
        ("MSMM", 3, 1, "point"),
        *extended(
            ("MM", 2, 1, "point"),
            ("MMMM", 3, 1, "area"),
            ("MMS", 3, 1, "area"),
            ("MM", 3, 1, "area"),
            ("MS", 2, 2, "area"),
            ("SMM", 2, 1, "area"),
            ("MMM", 3, 2, "point"),
            ("SSM", 4, 1, "area"),
            ("MMMM", 4, 1, "area"),
            ("M", 1, 1, "area"),
        ),
    ],
)
def test_weights_of_a_path_sum_to_one(rgb, kinds, strategies, beta, light):
    paths = JointPaths(room(light), kinds)
    for straight in (True, False):
        found, _ = weights_found(paths, strategies, beta, straight)
        assert (found >= 0).all()
        assert np.allclose(found.sum(axis=0), 1, atol=2e-4)
        assert len(found) == 1 or found.mean(axis=1).max() < 0.999


@pytest.mark.parametrize("beta", [1, *extended(2)])
def test_weights_are_veachs(rgb, beta):
    """Direct light at a vertex in the medium, after one on a wall, under three strategies: against
    densities made here. Light sub-paths start evenly over the sphere; next-event estimation takes
    the point."""
    paths = JointPaths(room("point"), "SM")
    found, valid = weights_found(paths, 3, beta, True)
    (_, _, a, at_a, to_b), (_, _, b, _, _) = paths.vertices
    p = np.array(at_a.pdf(mi.BSDFContext(), a, to_b.wo)) / np.abs(np.array(to_b.wo.z))
    cosine = np.array(dr.dot(-b.to_world(b.wi), paths.light.d))
    q = 0.75 / (4 * np.pi * (1.25 - cosine) ** 1.5)  # Henyey and Greenstein, g = 1 / 2
    rho = 1 / (4 * np.pi * np.array(paths.light.dist) ** 2)
    disk = DISK_PATHS * VOLUME_SHARE
    expected = heuristic_weights([(q / p / VOLUME_SHARE)[valid], (disk * rho)[valid]], beta)
    for mine, truth in zip(found, expected):
        assert np.allclose(mine, truth, atol=1e-3)


# --- Renders ------------------------------------------------------------------


class SmallRadius(SmallRadiusBatches):
    """As that, of `bdpm_balance`."""

    def __init__(self, scene, strategies, max_depth=6, beta=1.0):
        self.blocks, self.batches = 2, []
        common = {"max_depth": max_depth, "camera_paths": 16, "photon_count": 20000, "beta": beta}
        plugins = (
            {"type": "bdpm_balance", "strategies": strategies, "initial_radius": radius, **common}
            for radius in (RADIUS, RADIUS / 2)
        )
        self.sessions = [mi.load_dict(p).session(scene, seed=1, spp=0) for p in plugins]


@pytest.mark.parametrize("name, strategies", one_in_each_row(sorted(SCENES), (2, 3)))
def test_agrees_with_volpath(rgb, name, strategies):
    scene, visible = SCENES[name](), (0.02, 0.06)
    if name in ("sky", "sun"):
        visible = (0.05, 0.15)
    if name in ("sensor within", "lens within"):
        # All pixels share the photons that are close to the sensor, which have most of the weight.
        visible = (0.1, 0.3)
    mine = SmallRadius(scene, strategies)
    oracle = PathBatches(volpath(max_depth=6), scene, 2, 512)
    assert_same(*collect_until(mine, oracle, *visible, most=600), *visible, slack=SLACK)
