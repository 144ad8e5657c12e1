"""The plugin `bdpt`: one weight function whichever technique makes a path, each technique alone, and the images.

Comparisons of renders as in `test_against_path`: false-alarm rate 1e-6 each, and an error of 1 or 2 % in the image and of 3 or 8 % in a block is
seen with a probability of 0.95.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from comparing import Estimate, SessionBatches, agree, assert_same, block_means, collect_until, differences
from test_against_path import MONO, RGB, SPECTRAL, caustic_scene
from test_analytic import block_average, floor_from_above, inside_sphere, point_irradiance, series
from test_bdpm import box_scene, glossy_box, last_words
from worlds import EMITTERS, POINT_LIKE, T, bitmap, bump_bsdf, diffuse, film, has_delta, look, path, ptracer, tray
from mis_integrators.integrators.connection_weights import ConnectionWeights
from mis_integrators.integrators.pyramid import technique_names
from mis_integrators.transport.connections import join, join_sensor
from mis_integrators.transport.guide import EnvironmentGuide
from mis_integrators.transport.junctions import Junction
from mis_integrators.transport.lenses import Lens
from mis_integrators.transport.lights import Lights
from mis_integrators.transport.random import next_2d, streams
from mis_integrators.transport.subpaths import NO_PARENT, read_vertices, trace_camera_subpaths, trace_light_subpaths
from mis_integrators.transport.traits import SceneTraits


def bdpt(**parameters):
    return mi.load_dict({"type": "bdpt", "max_depth": 4, "camera_paths": 8, **parameters})


# --- One weight function ---------------------------------------------------------------------------------


def room(bsdf, light, sensor="perspective"):
    """A closed room of one material (open at both ends under a sky), with a lamp."""
    lamps = {"point": {"type": "point", "position": [0.3, 0.2, 0.7], "intensity": 1.0},
             "spot": {"type": "spot", "to_world": look((0.3, 0.2, 0.7), (0, 0, -0.5)), "cutoff_angle": 80, "beam_width": 79},
             "area": {"type": "rectangle", "to_world": look((0.2, -0.1, 0.8), (0, 0, 0)) @ T().scale(0.3), "emitter": {"type": "area"}},
             "sphere": {"type": "sphere", "center": [0.2, -0.1, 0.6], "radius": 0.2, "emitter": {"type": "area"}},
             "constant": {"type": "constant"}}
    bsdfs = {"diffuse": diffuse(0.7), "rough": {"type": "roughconductor", "alpha": 0.3}, "plastic": {"type": "plastic"}, "bump": bump_bsdf()}
    walls = {"type": "cylinder", "p0": [0, 0, -1], "p1": [0, 0, 1]} if light == "constant" else {"type": "cube"}
    view = {"to_world": look((0, -0.9, -0.3), (0.1, 0, 0), (0, 0, 1)), "film": film(8)}
    if sensor == "thinlens":
        view.update(aperture_radius=0.05, focus_distance=1.0)
    if sensor == "orthographic":
        view["to_world"] = view["to_world"] @ T().scale([0.5, 0.5, 1])
    else:
        view["fov"] = 70
    return mi.load_dict({"type": "scene", "walls": {**walls, "bsdf": {"type": "twosided", "bsdf": bsdfs[bsdf]}}, "lamp": lamps[light],
                         "sensor": {"type": sensor, **view}})


class JointPaths:
    """Random paths from the sensor through `length` surface vertices to a point of a light, some of them scattering by delta functions, and the
    weights that each technique's own code gives them."""

    COUNT = 2000

    def __init__(self, scene, length):
        self.scene, self.traits, self.length = scene, SceneTraits(scene), length
        sensor = scene.sensors()[0]
        guide = EnvironmentGuide(scene, sensor) if scene.environment() is not None else None
        self.lights = Lights(scene, "bdpt", guide)
        self.lens = Lens(sensor)
        rng = streams(dr.arange(mi.UInt32, self.COUNT), mi.UInt32(5))
        self.aperture = next_2d(rng)
        ray, _ = sensor.sample_ray(0, 0.5, next_2d(rng), self.aperture)
        self.valid = dr.full(mi.Bool, True, self.COUNT)
        self.vertices = []                       # (si, bsdf, to_camera, to_light, delta)
        for number in range(length):
            hit = self.scene.ray_intersect_preliminary(ray, active=self.valid)
            si = hit.compute_surface_interaction(ray, mi.RayFlags.All, self.valid)
            self.valid &= si.is_valid()
            bsdf = si.bsdf()
            bs, _ = bsdf.sample(mi.BSDFContext(), si, rng.next_float32(), next_2d(rng), self.valid)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            wo = si.to_world(bs.wo)
            if number == length - 1:
                self.light, value, self.light_pdf = self.lights.sample_direct(si, rng, self.valid)
                self.valid &= dr.max(value) > 0
                wo, delta = mi.Vector3f(self.light.d), dr.full(mi.Bool, False, self.COUNT)
            self.valid &= delta | (bs.pdf > 0)
            self.vertices.append((hit, si, bsdf, -ray.d, wo, delta))
            ray = si.spawn_ray(wo)
            dr.eval(ray, self.vertices, rng, self.valid, self.aperture)
        dr.eval(self.light, self.light_pdf)

    def junction(self, number):
        _, si, bsdf, *_ = self.vertices[number]
        return Junction.at(self.traits, si, bsdf, self.valid)

    def densities(self, number):
        """(p_camera, p_light) at a vertex."""
        _, si, _, to_camera, to_light, _ = self.vertices[number]
        _, p_camera, p_light = self.junction(number).between(to_camera, to_light, self.valid)
        return p_camera, p_light

    def segment(self, i, j):
        """|cos| at both ends and squared length, from vertex i to j."""
        (_, a, *_), (_, b, *_) = self.vertices[i], self.vertices[j]
        offset = b.p - a.p
        squared = dr.squared_norm(offset)
        d = offset * dr.rsqrt(squared)
        return dr.abs(dr.dot(a.n, d)), dr.abs(dr.dot(b.n, d)), squared

    def camera_states(self, weights):
        """Of the camera sub-path at each vertex, and after the last one's scattering."""
        _, si, _, to_camera, *_ = self.vertices[0]
        density = self.lens.density(si.p, si.time, self.aperture, self.valid) * dr.abs(dr.dot(si.n, to_camera))
        states, state = [], weights.seen(density, self.valid)
        for number in range(self.length):
            states.append(state)
            p_camera, p_light = self.densities(number)
            delta = self.vertices[number][-1]
            left = weights.left(state, p_camera, p_light, delta)
            if number < self.length - 1:
                near, far, squared = self.segment(number, number + 1)
                state = weights.arrived(left, dr.select(delta, 0, p_camera * near * far / squared))
            dr.eval(state, left)
        return states, left, p_camera, p_light

    def light_states(self, weights):
        last = self.vertices[-1][1]
        source = dr.zeros(mi.DirectionSample3f, self.COUNT)
        source.p, source.n, source.emitter = self.light.p, self.light.n, self.light.emitter
        states = {self.length - 1: weights.lit(last, source, dr.full(mi.Bool, True, self.COUNT), self.valid)}
        for number in range(self.length - 1, 0, -1):
            p_camera, p_light = self.densities(number)
            delta = self.vertices[number][-1]
            left = weights.left(states[number], p_light, p_camera, delta)
            near, far, squared = self.segment(number, number - 1)
            states[number - 1] = weights.arrived(left, dr.select(delta, 0, p_light * near * far / squared))
            dr.eval(states[number - 1])
        return states

    def record(self, number, side, state):
        """The vertex as `read_vertices` returns it."""
        hit, si, _, to_camera, to_light, _ = self.vertices[number]
        towards = to_camera if side == "camera" else to_light
        seen = mi.SurfaceInteraction3f(si)
        seen.wi = si.to_local(towards)
        junction = Junction.at(self.traits, seen, si.bsdf(), self.valid)
        hit = mi.PreliminaryIntersection3f(hit)
        return {"p": si.p, "n": junction.n, "ns": junction.ns, "towards": towards, "throughput": mi.Spectrum(1), "value": junction.value,
                "density": junction.density, "near": state[0], "far": state[1], **({"hit": hit} if self.traits.has_rough else {})}

    def weights(self, weights):
        """{s: weight of technique s}, zero where it cannot make the path (numpy)."""
        camera, left, p_camera, p_light = self.camera_states(weights)
        light = self.light_states(weights)
        last = self.vertices[-1][1]
        delta = [np.array(v[-1]) for v in self.vertices]
        facing = dr.abs(dr.dot(last.n, self.light.d))
        emission = self.lights.emission_ratio(last, self.light, self.valid)
        result = {}
        met = dr.select(self.light.delta, 0, weights.met(left, self.lights.pdf_direct(last, self.light, self.valid), emission, p_camera * facing))
        result[0] = np.array(met)
        result[1] = np.array(weights.direct(camera[-1], self.light_pdf, emission * facing, p_camera * facing, p_light, self.light.delta))
        for z in range(self.length - 2, -1, -1):
            pair = self.joined(camera, light, z)
            result[self.length - z] = np.array(weights.connected(*pair)) * ~(delta[z] | delta[z + 1])
        y = self.record(0, "light", light[0])
        seen = join_sensor(self.scene, None, self.traits, self.lens, y, self.aperture, mi.Float(0), [], False, self.valid)
        self.valid &= seen.active | mi.Bool(delta[0])
        result[self.length + 1] = np.array(weights.seen_by_sensor(seen, y)) * ~delta[0] if self.lens.connects else 0 * result[0]
        valid = np.array(self.valid)
        return {s: w[valid] for s, w in result.items()}

    def joined(self, camera, light, z):
        a, b = self.record(z, "camera", camera[z]), self.record(z + 1, "light", light[z + 1])
        _, si, _, _, to_light, _ = self.vertices[z]
        return join(self.traits, a, b, [], self.valid), a, b


@pytest.mark.parametrize("bsdf, light, sensor, length, beta", [
    ("diffuse", "area", "perspective", 3, 1), ("rough", "area", "thinlens", 3, 2), ("plastic", "point", "orthographic", 3, 1),
    ("plastic", "sphere", "perspective", 4, 1), ("bump", "spot", "perspective", 2, 2), ("rough", "constant", "perspective", 2, 1)])
def test_weights_sum_to_one(rgb, bsdf, light, sensor, length, beta):
    """Each technique's weight for the same joint path, from its own code; some in a thousand lose by rounding at grazing angles."""
    paths = JointPaths(room(bsdf, light, sensor), length)
    by_technique = paths.weights(ConnectionWeights(paths.lights, beta, 0.7))
    total = sum(by_technique.values())
    assert len(total) > 0.3 * paths.COUNT
    assert np.mean(np.abs(total - 1) < 2e-3) > 0.995, np.sort(np.abs(total - 1))[-20:]
    smooth = [s for s, w in by_technique.items() if w.max() > 1e-3]
    assert set(smooth) == set(by_technique) - ({0} if light in ("point", "spot") else set())      # each of them counts somewhere
