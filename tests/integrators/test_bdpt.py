"""The plugin `bdpt`: one weight function whichever technique makes a path, each technique alone,
and the images.

Comparisons of renders as in `test_against_path`: false-alarm rate 1e-6 each, and an error of 1 or 2
% in the image and of 3 or 8 % in a block is seen with a probability of 0.95.
"""

from itertools import pairwise

from mis_integrators.core.random import next_2d, streams
from mis_integrators.core.sequences import SampleSequence
from mis_integrators.core.traits import SceneTraits
from mis_integrators.integrators.pyramid import technique_names
from mis_integrators.lights.environment_guide import EnvironmentGuide
from mis_integrators.lights.lights import Lights
from mis_integrators.mis.vertex_merging import ConnectionWeights, Merging
from mis_integrators.paths.connect import join, join_sensor
from mis_integrators.paths.media import (
    begin_flights,
    interaction_at,
    medium_behind,
    next_hit,
    sample_phase,
)
from mis_integrators.paths.sensor import Lens
from mis_integrators.paths.setting import CameraPass, LightPass, Limits, World
from mis_integrators.paths.subpaths import (
    NO_PARENT,
    STATES,
    read_vertices,
    trace_camera_subpaths,
    trace_light_subpaths,
)
from mis_integrators.paths.vertex import VertexBSDF, facing
from mis_integrators.photons.vertex_map import state_of

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    SessionBatches,
    agree,
    assert_same,
    block_means,
    collect_until,
    differences,
    in_one_thread,
    pictures,
)
from merging import weights_of_merges
from selection import extended
from test_against_path import MONO, RGB, SPECTRAL, caustic_scene
from test_analytic import block_average, floor_from_above, inside_sphere, point_irradiance, series
from test_bdpm import box_scene, glossy_box
from worlds import (
    EMITTERS,
    POINT_LIKE,
    T,
    bitmap,
    bump_bsdf,
    diffuse,
    film,
    has_delta,
    lamp_inside,
    look,
    path,
    ptracer,
    tray,
)


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 4, "camera_paths": 8, **parameters})


# --- One weight function ------------------------------------------------------


def room(bsdf, light, sensor="perspective"):
    """A closed room of one material (open at both ends under a sky), with a lamp."""
    lamps = {
        "spot": {
            "type": "spot",
            "to_world": look((0.3, 0.2, 0.7), (0, 0, -0.5)),
            "cutoff_angle": 80,
            "beam_width": 79,
        },
        "sphere": {
            "type": "sphere",
            "center": [0.2, -0.1, 0.6],
            "radius": 0.2,
            "emitter": {"type": "area"},
        },
        "constant": {"type": "constant"},
    }
    bsdfs = {
        "diffuse": diffuse(0.7),
        "rough": {"type": "roughconductor", "alpha": 0.3},
        "plastic": {"type": "plastic"},
        "bump": bump_bsdf(),
    }
    walls = (
        {"type": "cylinder", "p0": [0, 0, -1], "p1": [0, 0, 1]}
        if light == "constant"
        else {"type": "cube"}
    )
    view = {"to_world": look((0, -0.9, -0.3), (0.1, 0, 0), (0, 0, 1)), "film": film(8)}
    if sensor == "thinlens":
        view.update(aperture_radius=0.05, focus_distance=1.0)
    if sensor == "orthographic":
        view["to_world"] = view["to_world"] @ T().scale([0.5, 0.5, 1])
    else:
        view["fov"] = 70
    return mi.load_dict(
        {
            "type": "scene",
            "walls": {**walls, "bsdf": {"type": "twosided", "bsdf": bsdfs[bsdf]}},
            "lamp": lamps.get(light) or lamp_inside(light),
            "sensor": {"type": sensor, **view},
        }
    )


class JointPaths:
    """Random paths from the sensor through `length` vertices, on surfaces and in media, to a point
    of a light, some of them scattering by delta functions, and the weights that each technique's
    own code gives them."""

    COUNT = 2000

    def __init__(self, scene, length):
        sensor = scene.sensors()[0]
        self.scene, self.traits, self.length = scene, SceneTraits(scene, sensor), length
        guide = EnvironmentGuide(scene, sensor) if scene.environment() is not None else None
        self.lights = Lights(scene, "bdpt", guide)
        flight = begin_flights(self.traits, sensor.get_medium())
        sequence = SampleSequence(mi.UInt32(6), mi.UInt32(0), 1, False)
        numbers = sequence.of_paths(dr.arange(mi.UInt32, self.COUNT))
        self.media = []
        self.lens = Lens(sensor)
        rng = streams(dr.arange(mi.UInt32, self.COUNT), mi.UInt32(5))
        self.aperture = next_2d(rng)
        ray, _ = sensor.sample_ray(0, 0.5, next_2d(rng), self.aperture)
        self.valid = dr.full(mi.Bool, True, self.COUNT)
        self.vertices = []  # (si, bsdf, to_camera, to_light, delta)
        for number in range(length):
            medium, scatters = None, mi.Bool(False)
            if self.traits.has_media:
                hit, ray, flight, _ = next_hit(
                    scene, self.traits, ray, flight, numbers, mi.Spectrum(1), self.valid
                )
                medium, number_of_flight, scatters = flight
            else:
                hit = self.scene.ray_intersect_preliminary(ray, active=self.valid)
            si = interaction_at(hit, ray, scatters, self.valid)
            self.valid &= si.is_valid()
            self.media.append(medium)
            bsdf = si.bsdf()
            choice, point = rng.next_float32(), next_2d(rng)
            bs, weight = bsdf.sample(mi.BSDFContext(), si, choice, point, self.valid & ~scatters)
            if self.traits.has_media:
                bs, _ = sample_phase(
                    self.traits, medium, si, choice, point, bs, weight, self.valid & scatters
                )
                onwards = medium_behind(si, medium, si.to_world(bs.wo), self.valid)
                flight = [onwards, number_of_flight, scatters]
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            wo = si.to_world(bs.wo)
            if number == length - 1:
                self.light, value, self.light_pdf = self.lights.sample_direct(si, rng, self.valid)
                self.valid &= dr.max(value) > 0
                wo, delta = mi.Vector3f(self.light.d), dr.full(mi.Bool, False, self.COUNT)
                self.valid &= scatters | mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            self.valid &= delta | (bs.pdf > 0)
            self.vertices.append((hit, si, bsdf, -ray.d, wo, delta))
            ray = si.spawn_ray(wo)
            dr.eval(ray, self.vertices, rng, self.valid, self.aperture, flight, self.media)
        dr.eval(self.light, self.light_pdf)

    def vertex_bsdf(self, number):
        _, si, bsdf, *_ = self.vertices[number]
        return VertexBSDF.at(self.traits, si, bsdf, self.valid, self.media[number], True)

    def densities(self, number):
        """(p_camera, p_light) at a vertex."""
        *_, to_camera, to_light, _ = self.vertices[number]
        _, p_camera, p_light = self.vertex_bsdf(number).f_and_pdfs(to_camera, to_light, self.valid)
        return p_camera, p_light

    def segment(self, i, j):
        """|cos| at both ends and squared length, from vertex i to j."""
        (_, a, *_), (_, b, *_) = self.vertices[i], self.vertices[j]
        offset = b.p - a.p
        squared = dr.squared_norm(offset)
        d = offset * dr.rsqrt(squared)
        return facing(self.traits, a.n, d), facing(self.traits, b.n, d), squared

    def camera_states(self, weights):
        """Of the camera sub-path at each vertex, and after the last one's scattering."""
        _, si, _, to_camera, *_ = self.vertices[0]
        density = self.lens.density(si.p, si.time, self.aperture, self.valid)
        density *= facing(self.traits, si.n, to_camera)
        states, state = [], weights.init_camera(density, self.valid)
        for number in range(self.length):
            states.append(state)
            p_camera, p_light = self.densities(number)
            delta = self.vertices[number][-1]
            vertex = self.vertex_bsdf(number)
            left = weights.scatter(state, p_camera, p_light, delta, None, vertex)
            if number < self.length - 1:
                near, far, squared = self.segment(number, number + 1)
                state = weights.propagate(
                    left, dr.select(delta, 0, p_camera * near * far / squared)
                )
            dr.eval(state, left)
        return states, left, p_camera, p_light

    def light_states(self, weights):
        last = self.vertices[-1][1]
        source = dr.zeros(mi.DirectionSample3f, self.COUNT)
        source.p, source.n, source.emitter = self.light.p, self.light.n, self.light.emitter
        states = {
            self.length - 1: weights.init_light(
                last, source, dr.full(mi.Bool, True, self.COUNT), self.valid
            )
        }
        for number in range(self.length - 1, 0, -1):
            p_camera, p_light = self.densities(number)
            delta = self.vertices[number][-1]
            vertex = self.vertex_bsdf(number)
            left = weights.scatter(states[number], p_light, p_camera, delta, None, vertex)
            near, far, squared = self.segment(number, number - 1)
            states[number - 1] = weights.propagate(
                left, dr.select(delta, 0, p_light * near * far / squared)
            )
            dr.eval(states[number - 1])
        return states

    def record(self, number, side, state):
        """The vertex as `read_vertices` returns it."""
        hit, si, _, to_camera, to_light, _ = self.vertices[number]
        towards = to_camera if side == "camera" else to_light
        seen = mi.SurfaceInteraction3f(si)
        seen.wi = si.to_local(towards)
        vertex_bsdf = VertexBSDF.at(
            self.traits, seen, si.bsdf(), self.valid, self.media[number], True
        )
        sides = vertex_bsdf.sides
        hit = mi.PreliminaryIntersection3f(hit)
        return {
            "p": si.p,
            "n": vertex_bsdf.n,
            "ns": vertex_bsdf.ns,
            "towards": towards,
            "throughput": mi.Spectrum(1),
            "value": vertex_bsdf.value,
            "density": vertex_bsdf.density,
            "d_vcm": state[0],
            "d_vc": state[1],
            **({"hit": hit} if self.traits.has_rough else {}),
            **({"above": sides.above, "below": sides.below} if sides else {}),
        }

    def weights(self, weights):
        """{s: weight of technique s}, zero where it cannot make the path (numpy)."""
        camera, left, p_camera, p_light = self.camera_states(weights)
        light = self.light_states(weights)
        last = self.vertices[-1][1]
        delta = [np.array(v[-1]) for v in self.vertices]
        cosine = facing(self.traits, last.n, self.light.d)
        emission = self.lights.emission_over_nee_pdf(last, self.light, self.valid)
        result = {}
        met = dr.select(
            self.light.delta,
            0,
            weights.hit_emitter(
                left,
                self.lights.pdf_direct(last, self.light, self.valid),
                emission,
                p_camera * cosine,
            ),
        )
        result[0] = np.array(met)
        result[1] = np.array(
            weights.next_event(
                camera[-1],
                self.light_pdf,
                emission * cosine,
                p_camera * cosine,
                p_light,
                self.light.delta,
                self.vertex_bsdf(self.length - 1),
            )
        )
        for z in range(self.length - 2, -1, -1):
            pair = self.joined(camera, light, z)
            result[self.length - z] = np.array(weights.connected(*pair)) * ~(
                delta[z] | delta[z + 1]
            )
        y = self.record(0, "light", light[0])
        seen = join_sensor(
            World(self.scene, self.lights, self.traits),
            Limits(-1, 5),
            None,
            self.lens,
            y,
            self.aperture,
            [],
            self.valid,
            streams(dr.arange(mi.UInt32, self.COUNT), mi.UInt32(7)),
        )
        self.valid &= seen.active | mi.Bool(delta[0])
        result[self.length + 1] = (
            np.array(weights.seen_by_sensor(seen, y)) * ~delta[0]
            if self.lens.connects
            else 0 * result[0]
        )
        if weights.merging:
            for number in range(self.length):
                result["merge", number] = (
                    self.merged(weights, camera, light, number) * ~delta[number]
                )
        valid = np.array(self.valid)
        return {s: w[valid] for s, w in result.items()}

    def merged(self, weights, camera, light, number):
        """Weight of a merge at a vertex."""
        y, z = (
            self.record(number, "light", light[number]),
            self.record(number, "camera", camera[number]),
        )
        zero = dr.zeros(mi.UInt32, self.COUNT)
        y |= {"path": zero, "depth": zero, "number": zero}
        z["depth"] = zero
        dr.eval(z)

        def weigher(photons):
            def weigh(index, landing, scattering, active):
                state = state_of(photons, index, active)
                return weights.merged(z, state, scattering.p, scattering.back())

            return weigh

        merged, found = weights_of_merges(self.traits, y, z, self.valid, weigher, STATES)
        self.valid &= found
        return merged

    def joined(self, camera, light, z):
        a, b = self.record(z, "camera", camera[z]), self.record(z + 1, "light", light[z + 1])
        return join(self.traits, a, b, [], self.valid), a, b


@pytest.mark.parametrize(
    "bsdf, light, sensor, length, beta, eta",
    [
        ("plastic", "point", "orthographic", 3, 1, 3.0),
        ("bump", "spot", "perspective", 2, 2, 0.0),
        ("rough", "constant", "perspective", 2, 1, 1.0),
        *extended(
            ("diffuse", "area", "perspective", 3, 1, 2.0),
            ("rough", "area", "thinlens", 3, 2, 0.0),
            ("plastic", "sphere", "perspective", 4, 1, 0.0),
        ),
    ],
)
def test_weights_sum_to_one(rgb, bsdf, light, sensor, length, beta, eta):
    """Each technique's weight for the same joint path, from its own code, merges (eta = pi R^2 N)
    among them; some in a thousand lose by rounding at grazing angles."""
    paths = JointPaths(room(bsdf, light, sensor), length)
    merging = Merging(dr.opaque(mi.Float, eta)) if eta else None
    by_technique = paths.weights(ConnectionWeights(paths.lights, beta, 0.7, merging))
    total = sum(by_technique.values())
    assert len(total) > 100
    assert np.mean(np.abs(total - 1) < 2e-3) > 0.995, np.sort(np.abs(total - 1))[-20:]
    smooth = [s for s, w in by_technique.items() if w.max() > 1e-3]
    # each of them counts somewhere
    assert set(smooth) == set(by_technique) - ({0} if light in ("point", "spot") else set())


@pytest.mark.parametrize("kind", ["camera", "light"])
def test_states_of_traced_subpaths(rgb, kind):
    """Kept vertices carry what the hooks of `paths.subpaths` say, recomputed from the vertices
    before them, in a scene without delta functions and with all kinds of junctions."""
    scene, beta = room("rough", "area"), 2
    traits, lights, sensor = SceneTraits(scene), Lights(scene), scene.sensors()[0]
    weights, count, capacity = ConnectionWeights(lights, beta, 1.3), 300, 4000
    world = World(scene, lights, traits)
    sequence = SampleSequence(mi.UInt32(3), mi.UInt32(0), 1, False)
    if kind == "light":
        vertices, found, _ = trace_light_subpaths(
            world, Limits(6, 50), LightPass(sequence, count, []), weights, capacity
        )
    else:
        *_, vertices, found = trace_camera_subpaths(
            world,
            Limits(6, 50),
            CameraPass(sensor, None, sequence, dr.arange(mi.UInt32, 64), mi.UInt32(0), 0.5),
            weights,
            capacity,
        )
    dr.eval(vertices, found)
    found = int(found[0])
    index = dr.arange(mi.UInt32, found)
    here = read_vertices(vertices, index, True)
    later = here["parent"] != NO_PARENT
    before = read_vertices(vertices, here["parent"], later)
    dr.eval(here, before)
    d = -here["towards"]
    si = before["hit"].compute_surface_interaction(
        mi.Ray3f(before["p"] + before["towards"] * before["hit"].t, -before["towards"]),
        mi.RayFlags.All,
        later,
    )
    sides = (before["towards"], d) if kind == "camera" else (d, before["towards"])
    _, p_camera, p_light = VertexBSDF.at(traits, si, si.bsdf(), later).f_and_pdfs(*sides, later)
    forward, back = (p_camera, p_light) if kind == "camera" else (p_light, p_camera)
    state = [before["d_vcm"], before["d_vc"]]
    left = weights.scatter(state, forward, back, mi.Bool(False), None, before)
    geometry = dr.abs(dr.dot(before["n"], d) * dr.dot(here["n"], d)) / dr.squared_norm(
        here["p"] - before["p"]
    )
    near, far = weights.propagate(left, forward * geometry)
    mask = np.array(later) & (np.array(here["depth"]) == np.array(before["depth"]) + 1)
    assert (
        mask.sum() > 100
        and (np.array(here["number"]) == np.array(before["number"]) + 1)[mask].all()
    )
    assert (np.array(here["path"]) == np.array(before["path"]))[mask].all()
    for mine, expected in ((here["d_vcm"], near), (here["d_vc"], far)):
        ratio = np.array(mine)[mask] / np.array(expected)[mask]
        assert np.mean(np.abs(ratio - 1) < 2e-3) > 0.98, np.sort(ratio)


# --- Each technique alone -----------------------------------------------------


@in_one_thread
def technique_estimates(scene, integrator, batches, blocks=1):
    """{(s, t): Estimate} of the block means of each technique's unweighted image."""
    session = integrator.session(scene, 0, seed=1, spp=0)
    images = list(pictures(session, batches))
    channels = session.channels
    result = {}
    for s, t in technique_names(integrator.techniques):
        first = channels.index(f"technique.s{s}.t{t}.R")
        result[s, t] = Estimate.of(
            [block_means(image[:, :, first : first + 3], blocks) for image in images]
        )
    return result


def pyramid(longest, **parameters):
    return bdpt(
        max_depth=longest, techniques=longest, technique_weights=False, rr_depth=50, **parameters
    )


def assert_each(estimates, expected, relative):
    """Each technique agrees with the closed form of its path length, and is measured to `relative`
    (6 standard errors)."""
    for technique, estimate in estimates.items():
        value = np.broadcast_to(np.reshape(expected(technique), (-1, 1)), estimate.mean.shape)
        assert not differences(estimate, Estimate.exact(value), slack=2e-3), technique
        if value.max() > 0:
            assert 6 * np.sqrt(estimate.error2[0].max()) < relative * value[0].max(), technique


def test_each_technique_in_a_sphere(rgb):
    """A point light in the middle: paths of k segments bring rho^(k - 1) I / pi, whichever
    technique makes them, but for meeting the light."""
    rho, intensity = 0.6, 2.0
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": intensity}},
        diffuse(rho),
        size=32,
    )
    estimates = technique_estimates(scene, pyramid(5), 48)
    assert_each(
        estimates,
        lambda st: 0 if st[0] == 0 else rho ** (st[0] + st[1] - 2) * intensity / np.pi,
        0.06,
    )


def test_no_technique_makes_longer_paths(rgb):
    """`max_depth` is exact for each of them, whatever its share."""
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": 2.0}}, diffuse(0.6)
    )
    for max_depth in (2, 3, 4):
        session = bdpt(max_depth=max_depth, techniques=5, technique_weights=False).session(
            scene, 0, 1, 0
        )
        session.iterate()
        image, names = session.image(), session.channels
        for s, t in technique_names(5):
            value = image[:, :, names.index(f"technique.s{s}.t{t}.R")].mean()
            assert (value > 0) == (s > 0 and s + t - 1 <= max_depth), (s, t)


def test_each_technique_in_an_emitting_sphere(rgb):
    """Walls of albedo rho that emit L: rho^(k - 1) L for k segments; techniques that meet the
    light, too."""
    scene = inside_sphere({}, diffuse(0.5), {"type": "area", "radiance": 0.7}, size=32)
    estimates = technique_estimates(scene, pyramid(4), 48)
    assert_each(estimates, lambda st: 0.7 * 0.5 ** (st[0] + st[1] - 2), 0.08)


@pytest.mark.parametrize(
    "kind, rfilter",
    [("thinlens", "gaussian"), *extended(("orthographic", "box"), ("perspective", "tent"))],
)
def test_light_tracing_to_each_sensor(rgb, kind, rfilter):
    """A floor in the even part of a spot light, seen straight from above through a crop window:
    next-event estimation and light tracing alone, by blocks."""
    window = {"crop_offset_x": 8, "crop_offset_y": 16, "crop_width": 16, "crop_height": 8}
    view = {
        "type": kind,
        "film": film(32, rfilter, **window),
        "to_world": look((0, 0, 3), (0, 0, 0)),
    }
    if kind == "orthographic":
        view["to_world"] = view["to_world"] @ T().scale([1, 1, 1])
    else:
        view["fov"] = np.degrees(2 * np.arctan(1 / 3))
    if kind == "thinlens":
        view.update(aperture_radius=0.3, focus_distance=3.0)
    scene = floor_from_above(
        1,
        sensor=view,
        light={
            "type": "spot",
            "to_world": look((0.3, 0.1, 3.5), (0, -0.25, 0)),
            "intensity": 2.0,
            "cutoff_angle": 18,
            "beam_width": 17,
        },
    )
    x, y = np.meshgrid((np.arange(32 * 16) + 0.5) / 256 - 1, (np.arange(32 * 16) + 0.5) / 256 - 1)
    radiance = 0.5 * 2 / np.pi * point_irradiance(3.5, x - 0.3, -y - 0.1)
    picture = radiance.reshape(32, 16, 32, 16).mean(axis=(1, 3))[16:24, 8:24]
    expected = block_means(picture[:, :, None], 4)
    estimates = technique_estimates(scene, pyramid(2, camera_paths=128), 32, 4)
    assert_each({st: e for st, e in estimates.items() if st[0] > 0}, lambda st: expected, 0.04)


def test_light_that_meets_the_sensor_in_spectral_variants():
    """Without a response of its own a sensor's rays weigh wavelengths by one over their density;
    light that is joined with the sensor does, too. (Both techniques have the wavelengths of their
    iteration in common; 3 % are ten standard errors.)"""
    mi.set_variant("llvm_ad_spectral")
    scene = floor_from_above(
        1,
        light={"type": "point", "position": [0, 0, 2], "intensity": 1.0},
        sensor={
            "type": "perspective",
            "fov": 36,
            "film": film(16),
            "to_world": look((0, 0, 3), (0, 0, 0)),
        },
    )
    session = pyramid(2, camera_paths=64).session(scene, 0, 1, 0)
    for _ in range(8):
        session.iterate()
    image, names = session.image(), session.channels
    direct, traced = (
        image[:, :, names.index(f"technique.{name}.G")].mean() for name in ("s1.t2", "s2.t1")
    )
    assert abs(traced / direct - 1) < 0.03, traced / direct


def test_pyramid_adds_up(rgb):
    """Weighted techniques and the rest are the image; mono has one channel each."""
    scene = glossy_box(size=16)
    session = bdpt(techniques=3, max_depth=5).session(scene, 0, 1, 0)
    session.iterate()
    session.iterate()
    image, names = session.image(), session.channels
    for letter, channel in zip("RGB", range(3)):
        total = sum(
            image[:, :, i]
            for i, name in enumerate(names)
            if name.startswith("technique.") and name.endswith("." + letter)
        )
        np.testing.assert_allclose(total, image[:, :, channel], rtol=1e-4, atol=1e-5)
    assert (
        image[:, :, names.index("technique.rest.G")].mean() > 0
        and image[:, :, names.index("technique.s2.t2.G")].mean() > 0
    )
    mi.set_variant("llvm_ad_mono")
    assert bdpt(techniques=1, variance=True).aov_names() == [
        "var.Y",
        "technique.s0.t2.Y",
        "technique.rest.Y",
    ]


# --- Images -------------------------------------------------------------------

# emitter, family, sensor, variant, filter
ROWS = [
    ("rectangle", "lambertian", "perspective", SPECTRAL, "box"),
    *extended(
        ("several", "mixed1", "orthographic", RGB, "box"),
        ("envmap rotated", "mixed2", "thinlens", RGB, "gaussian"),
        ("textured", "smooth0", "perspective", MONO, "tent"),
    ),
]


@pytest.mark.parametrize(
    "emitter, family, sensor, variant_name, rfilter",
    ROWS,
    ids=lambda value: value.replace(" ", "_"),
)
def test_agrees(emitter, family, sensor, variant_name, rfilter):
    mi.set_variant(variant_name)
    agree(
        bdpt(),
        path(rr_depth=50),
        tray(family, emitter, sensor, rfilter=rfilter),
        whole=0.02,
        block=0.08,
        most=600,
    )


@pytest.mark.full
@pytest.mark.parametrize("emitter", EMITTERS)
@pytest.mark.parametrize("family", ["mixed0", "mixed1", "mixed2", "smooth0", "smooth1", "smooth2"])
@pytest.mark.parametrize("sensor", ["perspective", "thinlens", "orthographic"])
def test_agrees_full(rgb, emitter, family, sensor):
    if has_delta(family) and emitter in POINT_LIKE:
        pytest.skip("path is blind there")
    oracle = ptracer if emitter == "directionalarea" else path
    agree(
        bdpt(),
        oracle(rr_depth=50),
        tray(family, emitter, "perspective" if oracle is ptracer else sensor),
        block=0.05,
        most=4096,
    )


@pytest.mark.parametrize(
    "emitter", [pytest.param("point", marks=pytest.mark.full), "directionalarea"]
)
def test_caustics_against_ptracer(rgb, emitter):
    """Light that reaches a floor by mirror and glass: only joining to the sensor makes it."""
    agree(bdpt(), ptracer(rr_depth=50), caustic_scene(emitter), whole=0.02, block=0.08, most=600)


def test_mirror_caustic_in_closed_form(rgb):
    """A mirror above a point light: the image light shines from its far side."""
    height, mirror = 1.0, 1.5
    scene = floor_from_above(
        0.5,
        light={"type": "point", "position": [0, 0, height], "intensity": 2.0},
        mirror={
            "type": "rectangle",
            "to_world": T().translate([0, 0, mirror]).rotate([1, 0, 0], 180).scale(10),
            "bsdf": {"type": "conductor", "material": "none"},
        },
        sensor={
            "type": "orthographic",
            "to_world": look((0, 0, 1.4), (0, 0, 0)) @ T().scale([0.5, 0.5, 1]),
            "film": film(16),
        },
    )
    expected = (
        0.5
        * 2
        / np.pi
        * block_average(
            lambda x, y: (
                point_irradiance(height, x, y) + point_irradiance(2 * mirror - height, x, y)
            ),
            0.5,
            2,
        )
    )
    batches = SessionBatches(bdpt(max_depth=3, camera_paths=32), scene, 2)
    values = np.concatenate([[expected.mean()], expected])[:, None]
    batches.add(2)
    assert_same(
        *collect_until(batches, Estimate.exact(np.repeat(values, 3, axis=1)), 0.01, 0.02),
        0.01,
        0.02,
        1e-4,
    )


@pytest.mark.parametrize("tilt", [-0.5, pytest.param(0.5, marks=pytest.mark.full)])
def test_shading_normals_seen_from_the_light(rgb, tilt):
    """A wall whose normal map tilts all its normals, lit by a narrow spot, lights a floor; Veach
    1997, section 5.3. Each technique alone."""
    normals = np.broadcast_to(
        np.array([0.0, tilt, np.sqrt(1 - tilt * tilt)]) * 0.5 + 0.5, (4, 4, 3)
    )
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse(0.6)},
            "wall": {
                "type": "rectangle",
                "to_world": T().translate([0, 2, 1.5]).rotate([1, 0, 0], 90).scale(1.5),
                "bsdf": {"type": "normalmap", "normalmap": bitmap(normals), "bsdf": diffuse(0.8)},
            },
            "spot": {
                "type": "spot",
                "to_world": look((0, -1.5, 3), (0, 2, 1.5)),
                "intensity": 20.0,
                "cutoff_angle": 15,
            },
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look((0, 0, 3), (0, 0, 0)),
                "film": film(24),
            },
        }
    )
    agree(bdpt(max_depth=3), path(max_depth=3), scene, blocks=2, whole=0.02, block=0.04)
    estimates = technique_estimates(scene, pyramid(3), 64)
    first = estimates[1, 3]
    for other in ((2, 2), (3, 1)):
        assert not differences(estimates[other], first), other
        assert 6 * np.sqrt(estimates[other].error2[0].max()) < 0.1 * first.mean[0].max()


# --- Film ---------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("rfilter, border", [("mitchell", True), *extended(("gaussian", False))])
def test_filters_and_crops(rgb, rfilter, border):
    """Means of the outermost rows and columns of a crop window and of the whole agree with `path`,
    whatever the filter and its border."""
    window = {
        "crop_offset_x": 8,
        "crop_offset_y": 16,
        "crop_width": 16,
        "crop_height": 8,
        "sample_border": border,
    }
    scene = box_scene(32, rfilter, window)
    a, b = (
        np.array(
            [np.array(mi.render(scene, integrator=i, seed=seed, spp=spp)) for seed in range(16)]
        )
        for i, spp in ((bdpt(camera_paths=64), 256), (path(), 1024))
    )
    assert a.shape == (16, 8, 16, 3)
    for region in (
        np.s_[:, :, :],
        np.s_[:, 0, :],
        np.s_[:, -1, :],
        np.s_[:, :, 0],
        np.s_[:, :, -1],
        np.s_[:, :4, 8:],
    ):
        means = [Estimate.of(x[region].reshape(16, -1, 3).mean(axis=1)[:, None]) for x in (a, b)]
        assert not differences(*means), region
        assert np.sqrt(means[0].error2.max()) < 0.01 * means[0].mean.max()


def lamp_scene():
    """A lamp in view above a floor, a glass ball, a mask, under a sky."""
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": diffuse()},
            "glass": {
                "type": "sphere",
                "center": [1.7, 1.0, 0.6],
                "radius": 0.5,
                "bsdf": {"type": "dielectric"},
            },
            "mask": {
                "type": "rectangle",
                "to_world": T().translate([-1, 0.7, 0.7]).scale(0.7),
                "bsdf": {
                    "type": "mask",
                    "opacity": 0.5,
                    "bsdf": {"type": "twosided", "bsdf": diffuse()},
                },
            },
            "lamp": {
                "type": "rectangle",
                "to_world": look((0, -1, 2), (0, 0, 0)) @ T().scale(0.7),
                "bsdf": {"type": "twosided", "bsdf": diffuse()},
                "emitter": {"type": "area", "radiance": 2.0},
            },
            "sky": {"type": "constant", "radiance": 0.5},
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": look((0, -2, 5), (0, 0, 0.5), (0, 1, 0)),
                "film": {**film(24), "pixel_format": "rgba"},
            },
        }
    )


@pytest.mark.parametrize("hide", [True, *extended(False)])
def test_hidden_emitters_and_alpha(rgb, hide):
    scene = lamp_scene()
    agree(bdpt(hide_emitters=hide), path(hide_emitters=hide, rr_depth=50), scene, block=0.04)
    mine, truth = (
        np.array(mi.render(scene, integrator=i(hide_emitters=hide), spp=512))[:, :, 3]
        for i in (bdpt, path)
    )
    assert np.abs(mine - truth).mean() < 0.01


@pytest.mark.parametrize(
    "name, max_depth",
    [
        ("bdpt_ris", 2),
        *extended(("bdpt", 1), ("bdpt", 2), ("vcm", 1), ("pcbpt", 1), ("bdpt_ris", 1)),
    ],
)
def test_alpha_at_the_last_depth(rgb, name, max_depth):
    """What a path meets at its very last segment covers the background too, as in `path`, if it is
    no null surface there: four panes above a half transparent floor. (Quarters of the film;
    standard error of a difference below 0.0035, nine of them.)"""
    mask = {"type": "mask", "opacity": 0.5, "nested": diffuse()}
    panes = {
        "opaque": diffuse(),
        "null": {"type": "null"},
        "mask": mask,
        "mirror": {"type": "conductor"},
    }
    corners = {"opaque": (-1, -1), "null": (-1, 1), "mask": (1, -1), "mirror": (1, 1)}
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "point", "position": [0, 0, 3]},
            "floor": {"type": "rectangle", "to_world": T().scale(2.5), "bsdf": mask},
            **{
                kind: {
                    "type": "rectangle",
                    "to_world": T().translate([*corners[kind], 1]).scale(0.8),
                    "bsdf": bsdf,
                }
                for kind, bsdf in panes.items()
            },
            "sensor": {
                "type": "orthographic",
                "to_world": look((0, 0, 4), (0, 0, 0), (0, 1, 0)) @ T().scale([2, 2, 1]),
                "film": {**film(24), "pixel_format": "rgba"},
            },
        }
    )
    mine, truth = (
        block_means(
            np.array(
                mi.render(
                    scene, integrator=mi.load_dict({"type": kind, "max_depth": max_depth}), spp=256
                )
            )[:, :, 3:],
            2,
        )
        for kind in (name, "path")
    )
    np.testing.assert_allclose(mine, truth, atol=0.03)


@pytest.mark.extended
def test_max_depth(rgb):
    """Means of the image and of its quarters, to 2 %; what each depth adds is more."""
    scene = lamp_scene()
    means = []
    for max_depth in range(5):
        mine, truth = (
            block_means(
                np.array(mi.render(scene, integrator=i(max_depth=max_depth), spp=512))[:, :, :3], 2
            )
            for i in (bdpt, path)
        )
        np.testing.assert_allclose(mine, truth, rtol=0.02, atol=1e-6)
        means.append(truth[0, 0])
    assert means[0] == 0 and all(b > 1.03 * a for a, b in pairwise(means[:4]))


def test_roulette_and_unlimited_depth_leave_the_mean(rgb):
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": 1.0}}, diffuse(0.8)
    )
    for rr_depth in (1, 30):
        batches = SessionBatches(bdpt(max_depth=-1, rr_depth=rr_depth), scene, 2)
        batches.add(8)
        exact = Estimate.exact(np.full((5, 3), series(0.8 / np.pi, 0.8, None)))
        assert_same(*collect_until(batches, exact, 0.01, 0.03), 0.01, 0.03, 1e-4)


# --- Seeds and buffers --------------------------------------------------------


def render(scene, seed=0, spp=8, **parameters):
    return np.array(
        mi.render(scene, integrator=bdpt(camera_paths=1, **parameters), seed=seed, spp=spp)
    )


@pytest.fixture
def thin_lens_box(rgb):
    return glossy_box(
        sensor={
            "type": "thinlens",
            "fov": 45,
            "aperture_radius": 0.1,
            "focus_distance": 5.5,
            "to_world": look((0, -5, 2.5), (0, 0, 0.6), (0, 0, 1)),
            "film": film(32),
        }
    )


@pytest.mark.long
def test_seeds_and_iterations(thin_lens_box):
    """Same seed, same image, as a whole or as iterations; other seeds and iterations are
    uncorrelated."""
    scene = thin_lens_box
    session = bdpt(camera_paths=1).session(scene, 0, 7, 0)
    images = list(pictures(session, 4))
    np.testing.assert_allclose(sum(images) / 4, render(scene, 7, 4), rtol=1e-4, atol=1e-5)
    mean = render(scene, 1000, 128).mean(axis=2)
    images = [i.mean(axis=2) for i in images] + [
        render(scene, seed, 1).mean(axis=2) for seed in (8, 9)
    ]
    noise = [(i - mean).ravel() for i in images]
    noise = [np.clip(n, *np.quantile(n, [0.02, 0.98])) for n in noise]
    table = np.corrcoef(noise) - np.eye(len(noise))
    assert np.abs(table).max() < 0.2, table.round(2)


def test_full_buffers_lose_nothing(thin_lens_box):
    """Buffers that are far too small grow, and the passes run again with the same random
    numbers."""
    whole = render(thin_lens_box, 3, 2)
    session = bdpt(camera_paths=1).session(thin_lens_box, 0, 3, 0)
    session.capacity = {"light": 40, "camera": 56, "pairs": 16}
    session._freeze()
    session.iterate()
    session.iterate()
    np.testing.assert_allclose(session.image(), whole, rtol=1e-4, atol=1e-5)


def test_parts_lose_nothing(rgb, monkeypatch):
    """A film rendered in parts, the last one incomplete, has the same mean."""
    scene, batches = box_scene(24), []
    for chunk in (1 << 19, 1000):
        monkeypatch.setattr("mis_integrators.integrators.bdpt.CHUNK", chunk)
        session = SessionBatches(bdpt(), scene, 3, seed=chunk)
        session.add(32)
        batches.append(session)
    assert batches[1].session.chunks == 5 and batches[1].session.chunk * 5 > 24 * 24 * 8
    assert_same(*collect_until(*batches))


def test_variance_is_that_of_the_mean(rgb):
    scene = box_scene(24, "gaussian")
    images = np.array([render(scene, seed, 8, variance=True) for seed in range(12)])
    empirical, estimated = images[..., :3].var(axis=0, ddof=1).mean(), images[..., 3:].mean()
    assert estimated == pytest.approx(empirical, rel=0.2)


# --- Parameters ---------------------------------------------------------------


@pytest.mark.parametrize(
    "name, value, allowed",
    [
        ("beta", 0.5, "from 1"),
        ("beta", "power", "a number"),
        ("techniques", 11, "from 0"),
        ("techniques", True, "an integer"),
        ("technique_weights", 1, "true or false"),
        ("photon_count", 5, "unknown parameter"),
        ("max_depth", -2, "at least 0"),
    ],
)
def test_bad_parameter(rgb, name, value, allowed):
    with pytest.raises(RuntimeError, match=allowed) as error:
        mi.load_dict({"type": "bdpt", name: value})
    assert "bdpt: " in str(error.value) and f'"{name}"' in str(error.value)


def test_darkness(rgb):
    scene = {
        "type": "scene",
        "floor": {"type": "rectangle"},
        "sensor": {"type": "perspective", "to_world": look((0, 0, 3), (0, 0, 0)), "film": film(8)},
    }
    assert (render(mi.load_dict(scene)) == 0).all()


def test_a_sensor_that_cannot_be_joined(rgb):
    """Light tracing is left out under a `batch` sensor, and nothing is missing."""
    views = {
        f"view{x}": {
            "type": "perspective",
            "fov": 40,
            "to_world": look((x, 0, 3), (0, 0, 0)),
            "film": film(8),
        }
        for x in (0, 1)
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "point", "position": [0, 0, 2], "intensity": 3.0},
            "floor": {"type": "rectangle", "to_world": T().scale(5), "bsdf": diffuse(0.5)},
            "sensor": {"type": "batch", **views, "film": {**film(16), "height": 8}},
        }
    )
    agree(bdpt(), path(), scene, blocks=2)
