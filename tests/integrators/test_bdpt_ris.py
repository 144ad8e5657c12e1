"""The plugins `pcbpt` and `bdpt_ris`: one weight function whichever technique makes a path, the
images, and where resampling could fail.

Comparisons of renders as in `test_against_path`: false-alarm rate 1e-6 each, and the errors named
are seen with a probability of 0.95.
"""

from functools import partial
from pathlib import Path

from mis_integrators.core.random import streams
from mis_integrators.mis.step_sums import LightEnd, sum_before
from mis_integrators.paths.camera_vertices import (
    STEP,
    leave,
    not_left,
    step_to_hit,
    step_to_vertex,
)
from mis_integrators.paths.connect import join_sensor
from mis_integrators.paths.setting import Limits, World
from mis_integrators.paths.subpaths import (
    NO_PARENT,
    hit_record,
    media_record,
    new_vertices,
    read_vertices,
    seen_normal,
    vertex_bsdf_of,
    vertex_layout,
)
from mis_integrators.paths.vertex import VertexBSDF, facing
from mis_integrators.resampling.light_vertices import END, LightVertices

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import (
    Estimate,
    SessionBatches,
    agree,
    assert_same,
    collect_until,
    kernels_of,
    pictures,
)
from merging import weights_of_merges
from selection import extended
from test_against_path import MONO, RGB, SPECTRAL, caustic_scene
from test_analytic import inside_sphere, series
from test_bdpm import box_scene, glossy_box, last_words
from test_bdpt import JointPaths, room
from worlds import (
    EMITTERS,
    POINT_LIKE,
    T,
    diffuse,
    film,
    floor_in_a_beam,
    has_delta,
    index_matched_pane,
    look,
    path,
    ptracer,
    tray,
)

SCENES = Path(__file__).parents[2] / "scenes"


def plugin(name, **parameters):
    return mi.load_dict({"type": name, "max_depth": 4, "camera_paths": 4, **parameters})


# --- One weight function ------------------------------------------------------


class ResampledPaths(JointPaths):
    """The same joint paths, written into buffers as the passes write them, and weighted by the
    passes' own code."""

    def __init__(self, scene, length, **parameters):
        super().__init__(scene, length)
        self.session = plugin(
            parameters.pop("name", "bdpt_ris"), max_depth=-1, **parameters
        ).session(scene, 0, seed=1, spp=0)
        self.session._prepare()
        self.session._take_weights(1)
        self.lights, self.traits = self.session.lights, self.session.traits
        self.sent_to_caches = []

    def keep(self, buffer, states, number, side, state, parent):
        hit, si, _, to_camera, to_light, _ = self.vertices[number]
        towards = to_camera if side == "camera" else to_light
        seen = mi.SurfaceInteraction3f(si)
        seen.wi = si.to_local(towards)
        depth = number + 1 if side == "camera" else self.length - number
        slot = dr.arange(mi.UInt32, self.COUNT) + number * self.COUNT
        vertex_bsdf = VertexBSDF.at(
            self.traits, seen, si.bsdf(), self.valid, self.media[number], True
        )
        values = {
            "p": si.p,
            "n": vertex_bsdf.n,
            "ns": vertex_bsdf.ns,
            "towards": towards,
            "throughput": 1,
            "value": vertex_bsdf.value,
            "density": vertex_bsdf.density,
            "path": slot,
            "depth": depth,
            "number": number,
            **dict(zip(states, state)),
        }
        vertex_layout(states).write(buffer["words"], values, slot, self.valid)
        dr.scatter(buffer["parent"], parent, slot, self.valid)
        if "hit" in buffer:
            hit_record().write(buffer["hit"], {"hit": hit}, slot, self.valid)
        if "media" in buffer:
            sides = vertex_bsdf.sides
            values = {"above": sides.above, "below": sides.below}
            media_record().write(buffer["media"], values, slot, self.valid)
        dr.eval(buffer)
        return slot

    def camera_buffer(self, weights):
        """`(buffer, slot of each vertex, what `leave` says after the last one)`."""
        steps = (*STEP, *weights.kernels)
        buffer = new_vertices(self.traits, self.capacity, steps)
        left, slots = not_left(weights, self.COUNT), []
        parent = dr.full(mi.UInt32, NO_PARENT, self.COUNT)
        density = mi.Float(0)
        for number in range(self.length):
            _, si, _, to_camera, to_light, delta = self.vertices[number]
            p_camera, p_light = self.densities(number)
            if number:
                _, cosine, squared = self.segment(number - 1, number)
                state = step_to_vertex(weights, left, density, cosine, squared)
            else:
                of_rays = self.lens.density(si.p, si.time, self.aperture, self.valid)
                of_rays *= facing(self.traits, si.n, to_camera)
                state = [
                    weights.ratio / of_rays if self.lens.connects else mi.Float(0),
                    *[mi.Float(0)] * (5 + len(weights.kernels)),
                ]
            slot = self.keep(buffer, steps, number, "camera", state, parent)
            vertex_bsdf = self.vertex_bsdf(number)
            value, *_ = vertex_bsdf.f_and_pdfs(to_camera, to_light, self.valid)
            left = leave(weights, left, si, vertex_bsdf, value, p_camera, p_light, to_light, ~delta)
            density = dr.select(delta, 0, p_camera * facing(self.traits, si.n, to_light))
            parent = dr.select(delta, parent, slot)
            slots.append(slot)
            dr.eval(left, density, parent)
        return buffer, slots, left, density, parent

    def light_buffer(self, weights):
        """`(buffer, slot of each vertex)`."""
        buffer = new_vertices(self.traits, self.capacity, END)
        last, slots = self.vertices[-1][1], [None] * self.length
        source = dr.zeros(mi.DirectionSample3f, self.COUNT)
        source.p, source.n, source.emitter = self.light.p, self.light.n, self.light.emitter
        seen = mi.SurfaceInteraction3f(last)
        seen.wi = last.to_local(self.light.d)
        flux = self.brought / (
            self.lights.pdf_emission_origin(last, self.light, self.valid)
            * self.lights.pdf_emission_area(last, self.light, self.valid)
        )
        state = weights.init_light(
            seen, source, dr.full(mi.Bool, True, self.COUNT), self.valid, flux
        )
        for number in range(self.length - 1, -1, -1):
            _, si, _, to_camera, to_light, delta = self.vertices[number]
            slots[number] = self.keep(
                buffer, END, number, "light", state, dr.full(mi.UInt32, NO_PARENT, self.COUNT)
            )
            if number:
                p_camera, p_light = self.densities(number)
                vertex_bsdf = self.vertex_bsdf(number)
                value, *_ = vertex_bsdf.f_and_pdfs(to_camera, to_light, self.valid)
                mean = vertex_bsdf.scattered_mean(value, to_light, self.valid)
                left = weights.scatter(state, p_light, p_camera, delta, mean, vertex_bsdf)
                left_from = mi.SurfaceInteraction3f(si)
                left_from.wi = si.to_local(to_light)
                left = weights.depart(left, left_from, self.valid)
                near, far, squared = self.segment(number, number - 1)
                seen = mi.SurfaceInteraction3f(self.vertices[number - 1][1])
                seen.wi = seen.to_local(self.vertices[number - 1][4])
                state = weights.propagate(
                    left,
                    dr.select(delta, 0, p_light * near * far / squared),
                    seen,
                    squared,
                    mi.UInt32(self.length - number + 1),
                )
                dr.eval(state)
        return buffer, slots

    def weights(self):
        """{s: weight of technique s}, zero where it cannot make the path (numpy); with merging also
        {"merged at i": that of merging at vertex i, from the camera}."""
        session, last = self.session, self.vertices[-1][1]
        weights = self.session.weights(session._spectral(1))
        self.capacity = self.COUNT * self.length
        infinite = mi.has_flag(self.light.emitter.flags(), mi.EmitterFlags.Infinite)
        place = dr.select(infinite, mi.Point3f(self.light.d), self.light.p)
        self.light, self.brought = self.lights.emitted(
            last, self.light.emitter, place, self.light.n, self.light.uv, self.valid
        )
        # not of a vertex on the lamp itself
        self.valid &= (dr.max(self.brought) > 0) & (self.light.dist > 1e-2)
        camera, camera_slots, left, density, parent = self.camera_buffer(weights)
        light, light_slots = self.light_buffer(weights)
        delta = [np.array(v[-1]) for v in self.vertices]
        starts = {"emitter": self.light.emitter, "p": place, "n": self.light.n, "uv": self.light.uv}
        index = dr.arange(mi.UInt32, self.COUNT)
        result = {}

        hit = step_to_hit(
            self.lights,
            weights,
            left,
            density,
            last,
            self.light,
            self.brought,
            dr.square(self.light.dist),
            self.valid,
        )
        nearer = sum_before(
            camera,
            hit,
            parent,
            LightEnd(
                hit["start"],
                hit["light_mean"],
                mi.Float(1),
                hit["across"],
                mi.UInt32(self.length + 1),
                [hit[name] for name in weights.light_kernels],
            ),
            weights,
            self.valid,
        )
        result[0] = np.array(
            dr.select(self.lights.can_be_met(self.light.emitter, self.valid), 1 / (1 + nearer), 0)
        )
        for z in range(self.length - 1, -1, -1):
            places = dr.zeros(mi.UInt32, self.COUNT) if z == self.length - 1 else light_slots[z + 1]
            ends = LightVertices(
                self.traits,
                self.lights,
                starts,
                self.COUNT,
                light,
                places,
                mi.UInt32(2 * self.COUNT),
                session.reach,
                weights.eta_at,
            )
            steps = (*STEP, *weights.kernels)
            vertex = read_vertices(camera, camera_slots[z], self.valid, states=steps)
            place = index if z == self.length - 1 else index + self.COUNT
            sent = ends.send(vertex["p"], place, mi.Float(0), [], self.valid)
            vertex_bsdf = self.junction_at(camera, camera_slots[z])
            share = session._share(
                weights,
                self.own_gain(weights, vertex, ends, sent, place),
                camera,
                vertex,
                sent,
                (vertex_bsdf, *vertex_bsdf.f_and_pdfs(vertex["towards"], sent.d, self.valid)),
                vertex["depth"] + sent.vertices,
                self.valid,
            )
            blocked = delta[z] if z == self.length - 1 else delta[z] | delta[z + 1]
            result[self.length - z] = np.array(share) * ~blocked
            if weights.merging:
                result[f"merged at {z}"] = (
                    self.merged(weights, camera, camera_slots[z], light, light_slots[z]) * ~delta[z]
                )
        y = read_vertices(light, light_slots[0], self.valid, states=END)
        seen = join_sensor(
            World(self.scene, self.lights, self.traits),
            Limits(-1, 5),
            None,
            self.lens,
            y,
            self.aperture,
            [],
            self.valid,
            streams(index, mi.UInt32(7)),
        )
        self.valid &= seen.active | mi.Bool(delta[0])
        result[self.length + 1] = (
            np.array(weights.seen_by_sensor(seen, y)) * ~delta[0]
            if self.lens.connects
            else 0 * result[0]
        )
        valid = np.array(self.valid)
        return {s: np.broadcast_to(w, self.COUNT)[valid] for s, w in result.items()}

    def merged(self, weights, camera, camera_slot, light, light_slot):
        """Weight of a merge at a vertex."""
        z = read_vertices(camera, camera_slot, self.valid, states=STEP)
        y = read_vertices(light, light_slot, self.valid, states=END)
        weigher = partial(self.session._merge_weigher, weights, camera, z)
        merged, found = weights_of_merges(self.traits, y, z, self.valid, weigher, END)
        self.valid &= found
        return merged

    def own_gain(self, weights, vertex, ends, sent, place):
        """The gain of joining `ends` to the camera `vertex`: of published weights from what the
        pmfs of its cache points would be made of."""
        if not weights.kernels:
            return self.session._own_gain(weights, vertex, sent, self.valid)
        row, targets, r = self.session._row_of(vertex), weights.targets, []
        for number in range(weights.grid.neighbors):
            cache = targets.read(weights.grid.neighbor(row, number, self.valid), self.valid)
            there = ends.send(cache["p"], place, mi.Float(0), [], self.valid)
            seen = ends.unblocked(self.scene, cache["p"], cache["n"], there, self.valid)
            r.append(dr.select(seen, there.mean * targets.received(cache, there.d, self.valid), 0))
        self.sent_to_caches.append(np.array(r))
        return weights.gain(r, row, sent.vertices, self.valid)

    def junction_at(self, buffer, slots):
        steps = (*STEP, *self.session.weights(self.session._spectral(1)).kernels)
        return vertex_bsdf_of(
            self.traits, read_vertices(buffer, slots, self.valid, states=steps), [], self.valid
        )


MERGING = {"merging": True, "initial_radius": 0.02}


@pytest.mark.parametrize(
    "name, bsdf, light, sensor, length, parameters",
    [
        ("bdpt_ris", "rough", "area", "thinlens", 3, {"resamples": 4}),
        ("pcbpt", "plastic", "area", "perspective", 3, {"light_tracing": 4}),
        (
            "bdpt_ris",
            "bump",
            "constant",
            "perspective",
            2,
            {"weights": "published", "light_paths": 30},
        ),
        ("bdpt_ris", "rough", "area", "perspective", 3, MERGING),
        *extended(
            (
                "bdpt_ris",
                "rough",
                "area",
                "thinlens",
                3,
                {"weights": "published", "target": "f_y_f_yz", "resamples": 4},
            ),
            ("pcbpt", "plastic", "point", "thinlens", 2, MERGING),
            ("bdpt_ris", "bump", "constant", "perspective", 2, {}),
            ("bdpt_ris", "plastic", "point", "orthographic", 3, {"light_paths": 1}),
            ("bdpt_ris", "plastic", "sphere", "perspective", 3, {"cache_neighbors": 1}),
        ),
    ],
)
def test_weights_sum_to_one(rgb, name, bsdf, light, sensor, length, parameters):
    """Each technique's weight for the same joint path, from its own code; some in a thousand lose
    by rounding at grazing angles."""
    by_technique = ResampledPaths(
        room(bsdf, light, sensor), length, name=name, **parameters
    ).weights()
    total = sum(by_technique.values())
    assert len(total) > 0.3 * JointPaths.COUNT
    # Published weights ask N_c cache points at each vertex, whose distances are rounded, too.
    close = 4e-4 if parameters.get("weights") == "published" else 1e-4
    assert np.mean(np.abs(total - 1) < close) > 0.9 and np.mean(np.abs(total - 1) < 2e-3) > 0.995, (
        np.sort(np.abs(total - 1))[-20:]
    )
    smooth = {s for s, w in by_technique.items() if w.max() > 1e-3}
    # each of them counts somewhere
    assert smooth == set(by_technique) - ({0} if light in ("point", "spot") else set())


def test_guessed_weight_is_the_weight_where_nothing_is_guessed(rgb):
    """At the camera's first vertices on diffuse surfaces, under weights that ignore resampling."""
    from mis_integrators.mis.resampling import guessed_weight

    paths = ResampledPaths(room("diffuse", "area", "perspective"), 3, name="pcbpt")
    share, seen = paths.session._share, []
    guess = partial(guessed_weight, paths.traits)

    def spy(weights, own, camera, z, sent, *rest):
        result = share(weights, own, camera, z, sent, *rest)
        seen.append([np.array(x) for x in (z["depth"], sent.vertices, guess(z, sent), result)])
        return result

    paths.session._share = spy
    paths.weights()
    valid = np.array(paths.valid)
    depth, vertices, guessed, exact = (x[:, valid] for x in np.stack(seen, axis=1))
    first = depth == 1
    assert first.any() and np.all((guessed > 0) & (guessed <= 1))
    np.testing.assert_allclose(guessed[first], exact[first], rtol=1e-3, atol=1e-5)
    assert 0.01 < np.mean(exact[first]) < 0.99 and set(vertices[first]) == {3}


# --- Published weights ---------------------------------------------------------


def published_integrals(scene, **parameters):
    """A session, and its Q_s (cache points, lengths), and mean numbers of light vertices."""
    session = plugin("bdpt_ris", weights="published", rr_depth=50, **parameters).session(
        scene, 0, 3, 0
    )
    session.start()
    session._take_weights(0)
    Q, shares, uniform = (np.array(x) for x in session.published_tables)
    return session, Q[:, None] * shares.reshape(len(Q), -1), uniform[:-1] * uniform[-1]


@pytest.mark.parametrize("target, seen", [("f_y_rho_g_v", 1), ("f_y_f_yz", 0.6 / np.pi)])
def test_integrals_in_a_sphere(rgb, target, seen):
    """A point light in the middle of a diffuse sphere of radius one: the geometric term between its
    points is 1/4, so every light sub-path tells the truth: Q_s = I rho^(s-1), times the BSDF of the
    cache point for the target that has it."""
    rho, intensity = 0.6, 2.0
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": intensity}}, diffuse(rho)
    )
    _, Q_s, ends = published_integrals(scene, max_depth=6, target=target, light_paths=50)
    truth = seen * intensity * rho ** np.arange(6)
    np.testing.assert_allclose(Q_s[:, :6], np.tile(truth, (len(Q_s), 1)), rtol=2e-3)
    assert np.all(Q_s[:, 6:] == 0) and np.allclose(ends[:6], 1) and np.all(ends[6:] == 0)


def test_integrals_against_direct_light(rgb):
    """Q_1 is the irradiance of unoccluded direct light: against 4096 samples of next-event
    estimation at each cache point, in a room whose lamp hides a part of it. Of 20000 light
    sub-paths; cache points near the lamp, where both are noisy, are left out."""
    scene = room("diffuse", "area")
    session, Q_s, _ = published_integrals(scene, max_depth=3, light_paths=20000)
    cache, samples = session.cache, 4096
    count = dr.width(cache["depth"])
    point = dr.repeat(dr.arange(mi.UInt32, count), samples)
    z = session._cache_targets([]).read(point, True)
    si = dr.zeros(mi.SurfaceInteraction3f, count * samples)
    si.p, si.n = z["p"], z["n"]
    rng = mi.PCG32(count * samples)
    ds, light = scene.sample_emitter_direction(
        si, mi.Point2f(rng.next_float32(), rng.next_float32()), True
    )
    cosine = dr.dot(seen_normal(z), ds.d)
    truth = np.array(dr.mean(light) * dr.maximum(cosine, 0)).reshape(count, samples).mean(axis=1)
    far = np.linalg.norm(np.array(cache["p"]).T - [0.2, -0.1, 0.8], axis=1) > 0.7
    assert far.mean() > 0.5
    error = np.abs(Q_s[far, 0] - truth[far]) / truth[far].mean()
    # 20000 points of the lamp: a relative error of 1 / sqrt(20000) times a few, with visibility
    assert error.max() < 0.1 and error.mean() < 0.01
    assert Q_s[far, 1].mean() > 0.1 * truth[far].mean()  # there is light of longer sub-paths


def test_pmfs_are_made_of_what_weights_ask(rgb):
    """Targets at cache points in the pmfs, and as camera vertices draw from them."""
    scene = room("rough", "area")
    session = plugin("bdpt_ris", weights="published", light_paths=60).session(scene, 0, 1, 0)
    session.start()
    session._take_weights(0)
    light, spectral = session._light(0, 0, session._spectral(0)), session._spectral(0)
    _, starts, places, found, pmfs = session._proposals(0, spectral, light)
    _, totals, r = pmfs
    points, width = dr.width(totals), dr.width(r) // dr.width(totals)
    ends = session._ends(starts, light[0], places, found, session.weights(spectral))
    index = dr.arange(mi.UInt32, points * width)
    active = index % width < ends.count[0]
    z = session._cache_targets([]).read(index // width, active)
    sent = ends.send(z["p"], index % width, mi.Float(0), [], active)
    cosine = dr.maximum(dr.dot(seen_normal(z), sent.d), 0)
    expected = dr.select(ends.unblocked(scene, z["p"], z["n"], sent, active), sent.mean * cosine, 0)
    np.testing.assert_allclose(np.array(r), np.array(expected), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        np.array(totals), np.array(expected).reshape(points, width).sum(axis=1), rtol=1e-3
    )
    assert np.mean(np.array(r) > 0) > 0.1


def test_published_weights_from_a_file(tmp_path):
    """The reference modes of both plugins, by name from an XML file."""
    mi.set_variant(RGB)
    text = """<scene version="3.0.0">
    <integrator type="{plugin}">
        <integer name="max_depth" value="3"/>
        <string name="weights" value="published"/>
        <string name="target" value="f_y_f_yz"/>
    </integrator>
    <shape type="sphere"><boolean name="flip_normals" value="true"/></shape>
    <emitter type="point"><point name="position" x="0" y="0" z="0"/></emitter>
    <sensor type="perspective">
        <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/>
        </film>
    </sensor>
</scene>"""
    for name in ("bdpt_ris", "pcbpt"):
        file = tmp_path / f"{name}.xml"
        file.write_text(text.format(plugin=name))
        scene = mi.load_file(str(file))
        assert scene.integrator().settings()["weights"] == "published"
        image = np.array(mi.render(scene, spp=64))
        # the film sees the sphere from its middle: all pixels alike, of direct and once more light
        assert image.mean() == pytest.approx(series(0.5 / np.pi, 0.5, 2), rel=0.02)


# --- Images -------------------------------------------------------------------


def assert_value(integrator, scene, value, whole=0.01):
    batches = SessionBatches(integrator, scene, 1)
    assert_same(
        *collect_until(batches, Estimate.exact(np.full((2, 3), value)), whole, whole, most=1500),
        whole,
        whole,
    )


@pytest.mark.parametrize(
    "name, parameters",
    [
        ("bdpt_ris", {}),
        ("bdpt_ris", {"resamples": 4, "target": "f_y_f_yz", "light_paths": 30}),
        ("bdpt_ris", {"weights": "published"}),
        *extended(
            ("pcbpt", {}),
            ("bdpt_ris", {"light_paths": 1}),
            ("bdpt_ris", {"weights": "published", "light_paths": 1, "cache_neighbors": 1}),
        ),
    ],
    ids=[
        "aware",
        "four_draws",
        "published",
        "unaware",
        "one_light_path",
        "published_one_light_path",
    ],
)
def test_point_in_sphere(rgb, name, parameters):
    """A point light in the middle of a diffuse sphere: L = rho I / pi (1 + rho + rho^2 + ...), here
    four terms."""
    rho, intensity = 0.6, 2.0
    scene = inside_sphere(
        {"light": {"type": "point", "position": [0, 0, 0], "intensity": intensity}}, diffuse(rho)
    )
    assert_value(
        plugin(name, max_depth=5, **parameters), scene, series(rho * intensity / np.pi, rho, 4)
    )


@pytest.mark.parametrize("name", ["pcbpt", *extended("bdpt_ris")])
def test_emitting_sphere(rgb, name):
    """A furnace: walls of albedo rho that emit L, any length of paths: L / (1 - rho)."""
    scene = inside_sphere({}, diffuse(0.5), {"type": "area", "radiance": 0.7})
    assert_value(plugin(name, max_depth=-1, light_paths=50), scene, 1.4)


# plugin, emitter, family, sensor, variant, parameters
ROWS = [
    pytest.param(
        "bdpt_ris",
        "envmap rotated",
        "mixed2",
        "thinlens",
        RGB,
        {"light_paths": 50},
        marks=pytest.mark.full,
    ),
    ("pcbpt", "several", "smooth1", "orthographic", MONO, {}),
    *extended(
        (
            "bdpt_ris",
            "several",
            "mixed1",
            "thinlens",
            RGB,
            {"weights": "published", "target": "f_y_f_yz", "resamples": 2, "light_paths": 50},
        ),
        ("pcbpt", "rectangle", "smooth0", "perspective", MONO, {"weights": "published"}),
        (
            "bdpt_ris",
            "textured",
            "smooth0",
            "perspective",
            MONO,
            {"resamples": 4, "target": "f_y_f_yz"},
        ),
        ("bdpt_ris", "several", "smooth0", "perspective", RGB, {"guided_lights": False}),
    ),
]


@pytest.mark.parametrize(
    "name, emitter, family, sensor, variant_name, parameters",
    ROWS,
    ids=["-".join(getattr(row, "values", row)[:5]).replace(" ", "_") for row in ROWS],
)
def test_agrees(name, emitter, family, sensor, variant_name, parameters):
    mi.set_variant(variant_name)
    agree(
        plugin(name, camera_paths=16, **parameters),
        path(rr_depth=50),
        tray(family, emitter, sensor),
        whole=0.03,
        block=0.1,
        most=200,
    )


@pytest.mark.parametrize(
    "name, emitter, family, sensor",
    [
        *extended(
            ("bdpt_ris", "rectangle", "mixed0", "thinlens"),
            ("pcbpt", "spot", "smooth1", "perspective"),
        ),
    ],
)
def test_merging_agrees(rgb, name, emitter, family, sensor):
    """Connections and merges together."""
    agree(
        plugin(name, camera_paths=8, merging=True, initial_radius=0.03),
        path(rr_depth=50),
        tray(family, emitter, sensor),
        whole=0.03,
        block=0.12,
        most=400,
    )


@pytest.mark.parametrize("name", ["bdpt_ris", *extended("pcbpt")])
def test_light_that_only_merging_makes(rgb, name):
    """A floor under a pane without refraction, seen through it, in a parallel beam: L = rho E / pi,
    all of it by merges, in films that are rendered in parts, too."""
    scene = floor_in_a_beam(1, pane=index_matched_pane(0.25))
    batches = SessionBatches(plugin(name, merging=True, initial_radius=0.05), scene, 2)
    batches.add(8)
    exact = Estimate.exact(np.full((5, 3), 0.6 / np.pi))
    assert_same(*collect_until(batches, exact, 0.01, 0.03), 0.01, 0.03, 1e-3)
    dark = np.array(mi.render(scene, integrator=plugin(name), spp=16))
    assert dark.max() == 0


@pytest.mark.parametrize("rounds", [1, *extended(2)])
def test_merges_in_parts(rgb, monkeypatch, rounds):
    """The film in parts, each with light sub-paths of its own in one round or two: the same light
    as all at once, merged once."""
    from mis_integrators.integrators import resampled_passes

    scene = floor_in_a_beam(1, pane=index_matched_pane(0.25))
    monkeypatch.setattr(resampled_passes, "CHUNK", 600)
    monkeypatch.setattr(resampled_passes, "KNOWN_PATHS", 50)
    integrator = plugin(
        "bdpt_ris", merging=True, initial_radius=0.08, light_paths=50, light_tracing=rounds
    )
    session = integrator.session(scene, 0, 1, 0)
    session.start()
    assert session.chunks > 1 and session.light_rounds == rounds
    batches = SessionBatches(integrator, scene, 2)
    batches.add(8)
    exact = Estimate.exact(np.full((5, 3), 0.6 / np.pi))
    assert_same(*collect_until(batches, exact, 0.02, 0.06), 0.02, 0.06, 1e-3)


@pytest.mark.full
def test_agrees_in_spectral_variants():
    mi.set_variant(SPECTRAL)
    agree(
        plugin("bdpt_ris", camera_paths=16),
        path(rr_depth=50),
        tray("mixed0", "rectangle"),
        whole=0.03,
        block=0.1,
        most=200,
    )


@pytest.mark.full
@pytest.mark.parametrize("emitter", EMITTERS)
@pytest.mark.parametrize("family", ["mixed0", "mixed1", "mixed2", "smooth0", "smooth1", "smooth2"])
@pytest.mark.parametrize("name", ["bdpt_ris", "pcbpt"])
def test_agrees_full(rgb, emitter, family, name):
    if has_delta(family) and emitter in POINT_LIKE:
        pytest.skip("path is blind there")
    oracle = ptracer if emitter == "directionalarea" else path
    agree(plugin(name), oracle(rr_depth=50), tray(family, emitter), block=0.05, most=8192)


@pytest.mark.parametrize("emitter", extended("directionalarea"))
def test_caustics_against_ptracer(rgb, emitter):
    """Light that reaches a floor by mirror and glass: only joining to the sensor makes it, and the
    emitter has no start to be joined with."""
    agree(
        plugin("bdpt_ris", max_depth=-1, camera_paths=16),
        ptracer(rr_depth=50),
        caustic_scene(emitter),
        whole=0.03,
        block=0.1,
        most=200,
    )


@pytest.mark.full
@pytest.mark.parametrize("scene", ["door", "window"])
def test_bundled_scenes(rgb, scene):
    """Against `bdpt`, in rooms most of whose light sub-paths a cache point does not see."""
    scene = mi.load_file(str(SCENES / f"{scene}.xml"), resx=24, resy=24)
    a, b = (
        SessionBatches(
            mi.load_dict({"type": name, "max_depth": 5, "camera_paths": paths}), scene, 2
        )
        for name, paths in (("bdpt_ris", 4), ("bdpt", 16))
    )
    assert_same(*collect_until(a, b, 0.03, 0.08, most=1000), 0.03, 0.08)


# --- Where resampling could fail ----------------------------------------------


@pytest.mark.long
def test_nothing_is_visible(rgb):
    """A lamp in a box of its own: no cache point sees any light vertex, every pmf falls back, and
    the image is black and finite."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(2), "bsdf": diffuse(0.6)},
            "box": {
                "type": "cube",
                "to_world": T().translate([0, 0, 1.5]).scale(0.4),
                "flip_normals": True,
                "bsdf": {"type": "twosided", "bsdf": diffuse(0.5)},
            },
            "lamp": {
                "type": "sphere",
                "center": [0, 0, 1.5],
                "radius": 0.1,
                "emitter": {"type": "area"},
            },
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look((0, -2, 3), (0, 0, 0)),
                "film": film(16),
            },
        }
    )
    for name, given in (
        ("bdpt_ris", {"resamples": 1}),
        ("bdpt_ris", {}),
        ("pcbpt", {}),
        ("bdpt_ris", {"weights": "published", "resamples": 1}),
    ):
        session = plugin(name, **given).session(scene, 0, 1, 0)
        session.iterate()
        session.iterate()
        # Rays start a little beside their surface: 5e-7 gets out on average, as with `bdpt`. With
        # more draws single pixels are brighter.
        assert np.all(session.image() >= 0) and session.image().mean() < 1e-5
        assert session.integrator.resamples > 1 or np.all(session.image() < 1e-4)
        tables = session.records, session.shares, *session.published_tables
        assert all(np.isfinite(np.array(x)).all() for x in tables)


def test_one_dominant_sub_path(rgb):
    """Beside a lamp that lights everything, one so small, bright and rarely chosen that a light
    sub-path of its carries most of the light when there is one: nothing is lost, though Q then
    rises with it."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(2), "bsdf": diffuse(0.6)},
            "wide": {"type": "point", "position": [0, 0, 40], "intensity": 2000.0},
            "near": {"type": "point", "position": [0, 0, 1], "intensity": 10.0},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": look((0, -2, 3), (0, 0, 0)),
                "film": film(16),
            },
        }
    )
    agree(
        plugin("bdpt_ris", light_paths=10), path(), scene, blocks=1, whole=0.2, block=0.2, most=900
    )


@pytest.mark.parametrize(
    "parameters", [{}, {"max_depth": 2}, *extended({"max_depth": 0}, {"max_depth": 1})]
)
def test_dark_and_short(rgb, parameters):
    """A scene without light is black; depths 0, 1 and 2 show what `path` shows."""
    floor = {
        "floor": {"type": "rectangle", "to_world": T().scale(2), "bsdf": diffuse(0.6)},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": look((0, -2, 3), (0, 0, 0)),
            "film": film(16),
        },
    }
    if not parameters:
        assert np.all(
            np.array(
                mi.render(
                    mi.load_dict({"type": "scene", **floor}), integrator=plugin("bdpt_ris"), spp=8
                )
            )
            == 0
        )
        return
    scene = mi.load_dict(
        {
            "type": "scene",
            **floor,
            "lamp": {
                "type": "rectangle",
                "to_world": look((0, 0, 1.5), (0, 0.6, 0)) @ T().scale(0.3),
                "bsdf": {"type": "twosided", "bsdf": diffuse(0.5)},
                "emitter": {"type": "area"},
            },
        }
    )
    images = [
        np.array(mi.render(scene, integrator=i, spp=512))
        for i in (plugin("bdpt_ris", **parameters), path(**parameters))
    ]
    np.testing.assert_allclose(*[x.mean(axis=(0, 1)) for x in images], rtol=0.03)


# --- Repeatability, memory, parameters ----------------------------------------


def test_same_seed_same_image(rgb):
    """Cache points, draws and ends do not depend on the order of threads; iterations, whose light
    sub-paths all pixels share, are uncorrelated."""
    scene = room("rough", "area")
    sessions = [plugin("bdpt_ris").session(scene, 0, seed, 0) for seed in (3, 3, 4)]
    means = [[picture.mean() for picture in pictures(session, 30)] for session in sessions]
    np.testing.assert_allclose(sessions[0].image(), sessions[1].image(), rtol=1e-4, atol=1e-6)
    same, other = np.array(means[0]), np.array(means[2])
    # 1e-6 for 30 pairs
    assert (
        abs(np.corrcoef(same, other)[0, 1]) < 0.75
        and abs(np.corrcoef(same[1:], same[:-1])[0, 1]) < 0.75
    )


@pytest.mark.parametrize(
    "parameters",
    [
        {"light_paths": 30},
        {"light_paths": 30, "weights": "published"},
        {"light_paths": 30, "merging": True, "alpha": 0.7},
        *extended({"light_paths": 300}),
    ],
)
def test_iterations_in_any_order(rgb, parameters):
    """What the first iteration's light sub-paths tell of Q is known to all others, and not to
    itself, and of published weights what each iteration's tell to the next, whoever renders which
    first: workers of a cluster, or a render that goes on."""
    scene, images = box_scene(16), []
    for order in ((0, 1, 2), (2, 0, 1)):
        session = plugin("bdpt_ris", **parameters).session(scene, 0, 7, 0)
        for number in order:
            session.iterate(number)
        images.append(session.image())
        assert session.first_light is None
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-5)


@pytest.mark.long
def test_replays_are_what_was_recorded(monkeypatch):
    """The pass that makes the pmfs has a size that Dr.Jit, left alone, would take for a multiple of
    its virtual calls' data, and get wrong (`core.recording.lanes`): 192 cache points times 520
    light vertices."""
    mi.set_variant(MONO)
    from mis_integrators.integrators import resampled

    monkeypatch.setattr(resampled, "FEWEST_CACHE_POINTS", 192)
    scene = tray("smooth1", "several", "orthographic")
    images = []
    for recorded in (True, False):
        session = plugin("pcbpt", camera_paths=1, light_paths=200).session(scene, 0, 3, 0)
        session._prepare()
        session.capacity["ends"] = 320
        if not recorded:
            session.recorded = lambda function: function
        session._freeze()
        for _ in range(3):
            session.iterate()
        assert session.capacity["ends"] == 320 and dr.width(session.cache["depth"]) == 192
        images.append(session.image())
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-4)


def test_memory_is_bounded(rgb, monkeypatch):
    """Beyond the bound on pairs there are fewer cache points, and the image is the same."""
    from mis_integrators.integrators import resampled

    scene = room("diffuse", "area")
    monkeypatch.setattr(resampled, "MOST_PAIRS", 6000)
    session = plugin("bdpt_ris", light_paths=50).session(scene, 0, 1, 0)
    session.iterate()
    width = 50 + session.capacity["ends"]
    assert 1 <= dr.width(session.cache["depth"]) <= 6000 // width < resampled.FEWEST_CACHE_POINTS
    agree(
        plugin("bdpt_ris", light_paths=50),
        path(),
        scene,
        blocks=1,
        whole=0.05,
        block=0.05,
        most=600,
    )


def test_parts_share_their_proposals(rgb, monkeypatch):
    """A film rendered in parts, the last one incomplete, has the mean of `path`, and draws from one
    set of pmfs in each iteration."""
    from mis_integrators.integrators import resampled_passes

    monkeypatch.setattr(resampled_passes, "CHUNK", 470)
    scene = box_scene(24)
    session = plugin("bdpt_ris", light_tracing=1).session(scene, 0, 1, 0)
    assert session.chunks == 5 and session.chunk * 5 > session.path_count
    made, pmfs = [], session._pmfs
    session._pmfs = lambda *args: made.append(args) or pmfs(*args)
    for _ in range(3):
        session.iterate()
    assert len(made) == 3
    agree(plugin("bdpt_ris"), path(rr_depth=50), scene, blocks=2, whole=0.02, block=0.05, most=600)


def test_parts_hold_every_path_once(rgb, monkeypatch):
    """Parts of a film, each of which sees all of it."""
    from mis_integrators.integrators import resampled_passes

    monkeypatch.setattr(resampled_passes, "CHUNK", 470)
    session = plugin("pcbpt").session(box_scene(23), 0, 1, 0)
    numbers = []
    for chunk in range(session.chunks):
        gaps = session.all_over_the_film(chunk)
        some = session.part_of_paths(*gaps)
        numbers.append(np.array(some)[np.array(session.in_chunk(*gaps))])
        assert np.ptp(numbers[-1]) > 0.9 * session.path_count
    assert (
        np.array_equal(np.sort(np.concatenate(numbers)), np.arange(session.path_count))
        and session.chunks == 5
    )


def test_pilot_sees_all_of_the_film(rgb, monkeypatch):
    """Cache points of a film in parts come from all over it, as those of a film in one: heights of
    first vertices, two samples of the same distribution (Kolmogorov and Smirnov; false alarms
    1e-6)."""
    from mis_integrators.integrators import resampled_passes

    heights = []
    for chunk in (1 << 18, 500):
        monkeypatch.setattr(resampled_passes, "CHUNK", chunk)
        session = plugin("bdpt_ris", light_tracing=1).session(box_scene(32), 0, 1, 0)
        session._prepare()
        first = np.array(session.cache["depth"]) == 1
        heights.append(np.sort(np.array(session.cache["p"].y)[first]))
    assert session.chunks == 9
    a, b = heights
    both = np.concatenate(heights)
    apart = np.abs(
        np.searchsorted(a, both, side="right") / len(a)
        - np.searchsorted(b, both, side="right") / len(b)
    ).max()
    assert apart < np.sqrt(-np.log(1e-6 / 2) / 2 * (1 / len(a) + 1 / len(b)))


# --- How many light sub-paths -------------------------------------------------


def test_no_light_tracing_is_the_default(rgb):
    """0, which once left the number to a pilot."""
    assert plugin("bdpt_ris", light_tracing=0).settings() == plugin("bdpt_ris").settings()
    assert plugin("pcbpt").settings()["light_tracing"] == 1


@pytest.mark.parametrize("ratio", [8, *extended(0.125)])
def test_any_light_tracing_is_unbiased(rgb, monkeypatch, ratio):
    """Fewer light sub-paths than camera paths, and so many that they are traced in several rounds,
    of a film in parts."""
    from mis_integrators.integrators import resampled_passes

    monkeypatch.setattr(resampled_passes, "CHUNK", 1200)
    monkeypatch.setattr(resampled_passes, "KNOWN_PATHS", 50)
    scene = box_scene(24)
    integrator = plugin("bdpt_ris", light_tracing=ratio, light_paths=50)
    session = integrator.session(scene, 0, 1, 0)
    session.start()
    assert session.light_rounds == (8 if ratio == 8 else 1) and float(
        session.ratio[0]
    ) == pytest.approx(ratio, rel=0.02)
    agree(integrator, path(rr_depth=50), scene, blocks=2, whole=0.02, block=0.05, most=600)


@pytest.mark.parametrize("name", ["bdpt_ris", *extended("bdpt", "vcm")])
def test_kernels_know_neither_seed_nor_room(rgb, name):
    """Another seed, with other cache points and a grid of other cells about them, and buffers of
    other sizes, one of which grows: no path kernel is compiled anew. (Merging knows the size of its
    table, which goes with the light buffer's.)"""
    scene, compiled, grids = glossy_box(size=16), [], set()
    for number, seed in enumerate((0, 1, 3)):
        session = mi.load_dict({"type": name, "max_depth": 4, "camera_paths": 1}).session(
            scene, 0, seed, 0
        )
        session.capacity.update(
            camera=2048 >> number,
            light=session.capacity["light"] if name == "vcm" else (1024, 64, 2048)[number],
        )
        compiled.append(kernels_of(session.iterate, 500))
        grids.add(tuple(session.grid.resolution) if name == "bdpt_ris" else seed)
    assert len(grids) > 1 and len(compiled[0]) >= 4
    assert compiled[1] <= compiled[0] and compiled[2] <= compiled[0]


@pytest.mark.parametrize(
    "parameters, words",
    [
        ({"light_paths": 0}, ("light_paths", "from 1")),
        ({"resamples": 1.5}, ("resamples", "integer")),
        ({"cache_neighbors": 17}, ("cache_neighbors", "16")),
        ({"target": "f"}, ("target", "f_y_rho_g_v")),
        ({"weights": "best"}, ("weights", "bounded", "published")),
        ({"light_tracing": 9}, ("light_tracing", "0.125")),
        ({"merging": True, "alpha": 0.0}, ("alpha", "(0, 1]")),
        ({"merging": True, "weights": "published"}, ("merging", "bounded")),
        ({"initial_radius": 0.1}, ("initial_radius", "merging")),
        ({"beta": 2.0}, ("beta", "unknown", "light_paths")),
    ],
)
def test_parameters_are_checked(rgb, parameters, words):
    for name in ("pcbpt", "bdpt_ris"):
        with pytest.raises(Exception) as error:
            plugin(name, **parameters)
        assert all(word in last_words(error.value) for word in (name, *words))
