"""Caustics that the camera sees, in images that will be denoised: disks of a pixel's size."""

from types import SimpleNamespace

import mis_integrators  # noqa: F401 (registers the plugins)
from mis_integrators.photons.queries import read_queries
from mis_integrators.pilot.setting import APART, pilot_pixels

import mitsuba as mi
import numpy as np
import pytest
from comparing import grey_pictures
from pilots import knowing

SIZE = 24
FAR = 12.0
"""Height of the camera above the floor."""


@pytest.fixture(autouse=True)
def _rgb(rgb):
    pass


def sensor_of(kind="perspective", size=SIZE, fov=50):
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at([0, 0, FAR], [0, 0, 0], [0, 1, 0])
    if kind == "orthographic":
        return {"type": kind, "film": film, "to_world": to_world @ to_world.scale([5, 5, 1])}
    return {"type": kind, "film": film, "to_world": to_world, "fov": fov}


def caustic_scene(fog=None, leaf=None, **sensor):
    """A floor lit by nothing but what a mirror above the camera throws back: a spot of light. There
    may be a `fog` and a `leaf` in between."""
    transform = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": transform().scale(8)},
            "mirror": {
                "type": "rectangle",
                "to_world": transform().translate([0, 0, FAR + 2]).rotate([1, 0, 0], 180).scale(30),
                "bsdf": {"type": "conductor"},
            },
            "lamp": {
                "type": "spot",
                "to_world": transform().look_at([0, 0, FAR + 1], [0, 0, FAR + 2], [0, 1, 0]),
                "cutoff_angle": 60,
                "intensity": 1000.0,
            },
            "sensor": sensor_of(**sensor),
            **({"fog": fog} if fog else {}),
            **({"leaf": leaf} if leaf else {}),
        }
    )


def session_of(scene, photons, iterations=1e6, radii=None, **parameters):
    """A session that knows its radii. So long a render has no sparse photons."""
    plugin = {"type": "bdpm", "bdd": 0, "direct_paths": 1, "photon_count": photons}
    plugin |= {"denoised": True, "max_depth": 3, "sampler": "independent", **parameters}
    return knowing(mi.load_dict(plugin).session(scene, seed=3), radii or 1.0, iterations)


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_cones_are_as_wide_as_pixels(kind):
    """Width squared is the area that a pixel has across its ray, here by the rays through two
    neighbours, and grows with all of the way through mirrors."""
    from mis_integrators.paths.ray_cones import RayCones

    sensor = mi.load_dict(sensor_of(kind, 64, 80))
    x, y = (mi.Float(c.ravel()) for c in np.meshgrid(*[np.arange(1, 64, 6) / 64] * 2))
    rays = [
        sensor.sample_ray(0, 0.5, mi.Point2f(x + dx / 64, y + dy / 64), 0.5)[0]
        for dx, dy in ((0, 0), (-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))
    ]
    ray, *near = rays
    cones = RayCones(sensor)
    cone = cones.begin()
    far = 0.0
    for depth, t in ((1, 3.0), (2, 2.5)):
        at = SimpleNamespace(ray=ray, depth=mi.UInt32(depth), si=SimpleNamespace(t=mi.Float(t)))
        cone = cones.arrived(cone, at, mi.Bool(True))
        far += t
        d = np.array(ray.d)
        # Where the neighbours' rays meet the plane across this one.
        points = []
        for other in near:
            o, e = np.array(other.o) - np.array(ray.o), np.array(other.d)
            s = (far - (o * d).sum(axis=0)) / (e * d).sum(axis=0)
            points.append(o + s * e)
        across, down = points[1] - points[0], points[3] - points[2]
        area = np.linalg.norm(np.cross(across.T, down.T), axis=1)
        np.testing.assert_allclose(np.array(cone[0] + 0 * x), np.sqrt(area), rtol=0.01)


@pytest.mark.parametrize("outside", [True, False])
def test_curvatures_are_those_of_a_cylinder(outside):
    """Along it none, and around it one over its radius: convex from outside, concave within."""
    from mis_integrators.paths.bent_surfaces import FLAGS, curvatures

    scene = mi.load_dict({"type": "scene", "rod": {"type": "cylinder", "radius": 0.5}})
    ray = mi.Ray3f([3, 0, 0.3] if outside else [0, 0, 0.3], [-1, 0, 0])
    si = scene.ray_intersect(ray, FLAGS, mi.Bool(True))
    found = sorted(float(k[0]) for k in curvatures(si, -ray.d))
    np.testing.assert_allclose(found, [0, 2] if outside else [-2, 0], atol=1e-5)


@pytest.mark.parametrize(
    "eta, radius, focus", [(1.0, -2.0, 1.0), (1.5, 1.0, 3.0), (1.33, 4.0, 4 * 1.33 / 0.33)]
)
def test_cones_meet_in_the_focus(eta, radius, focus):
    """Of a concave mirror, at half its radius; and behind a boundary of glass, at
    radius e / (e - 1). On the way there and as far beyond it a pixel is as narrow as they are, but
    not close to the focus."""
    from mis_integrators.paths import ray_cones
    from mis_integrators.paths.bent_surfaces import FLAGS

    sensor = mi.load_dict(sensor_of("orthographic", 64, 80))
    cones = ray_cones.RayCones(sensor)
    ball = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": abs(radius)}})
    ray = mi.Ray3f([0, 0, 0] if radius < 0 else [9, 0, 0], [-1, 0, 0])
    si = ball.ray_intersect(ray, FLAGS, mi.Bool(True))
    bs = mi.BSDFSample3f()
    bs.eta, mirrors = mi.Float(eta), eta == 1
    bs.wo = mi.Vector3f(0, 0, si.wi.z if mirrors else -si.wi.z)
    cone = cones.bent(cones.begin(), si, -ray.d, bs, mi.Bool(True))
    for share in (0.1, 0.3, 0.7, 0.8, 1.0, 1.2, 1.3, 1.9, 3.0):
        far = cones.grown(cone, ray.d, share * focus, mi.Bool(False), mi.Bool(True))
        plain, across, along = (float(width[0]) for width in far[::2])
        np.testing.assert_allclose([across, along], (1 - share) * plain, atol=1e-3 * plain)
        width = min(abs(1 - share), 1)
        expected = width * plain if width > ray_cones.NARROWEST else 0
        np.testing.assert_allclose(float(cones.pixel_width(far)[0]), expected, atol=2e-3 * plain)


def refracted(d, n, eta):
    """Direction of a ray behind a boundary of this relative index: Snell's law. `n` is turned
    against `d`."""
    cosine = -d @ n
    return d / eta + (cosine / eta - np.sqrt(1 - (1 - cosine**2) / eta**2)) * n


def where_it_lands(angle, center, radius, eta):
    """On the floor, beside the axis, a ray of the camera that goes through a ball of glass."""
    o, d, middle = np.array([0, FAR]), np.array([np.sin(angle), -np.cos(angle)]), [0, center]
    for index, side in ((eta, -1), (1 / eta, 1)):
        to = o - middle
        o = o + d * (-(to @ d) + side * np.sqrt((to @ d) ** 2 - to @ to + radius**2))
        d = refracted(d, -side * (o - middle) / radius, index)
    return o[0] - o[1] * d[0] / d[1]


@pytest.mark.parametrize("height, index", [(0.7, 1.2), (1.4, 1.4), (2.1, 1.4)])
def test_pixels_behind_a_magnifying_glass_are_narrow(height, index):
    """As narrow as the rays' places on the floor, before the focus of a ball of glass and behind
    it; close to it what is seen asks for photons of the usual radius. (Few paths are thrown back at
    the glass and wander.)"""
    from mis_integrators.paths.ray_cones import NARROWEST

    ball = {"type": "sphere", "center": [0, 0, height], "radius": 0.6}
    ball |= {"bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}}
    scene = caustic_scene(leaf=ball, fov=1)  # sees nothing beside it
    session = session_of(scene, 1000, radii=0.1, max_depth=6)
    assert session.kinds() == ["seen_caustic", "caustic", "indirect"]
    setting = session.pilot_setting()
    trace = session.pilot_passes(setting, pilot_pixels(setting)).trace
    widths = np.array(read_queries(trace(0).vertices)["pixel"])
    pixel = 2 * np.tan(np.radians(0.5)) / SIZE
    expected = 2 * abs(where_it_lands(pixel / 2, height, 0.6, index))
    assert expected < 0.8 * pixel * FAR
    if expected < NARROWEST * pixel * FAR:
        expected = 0
    np.testing.assert_allclose(np.median(widths), expected, rtol=0.03)
    assert (height == 1.4) == (expected == 0)


def test_widths_grow_through_boundaries():
    """Those of media, and masks that are passed: widths are as without them."""
    null = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([9, 9, 4])}
    null |= {"bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 0.02}}
    mask = {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse"}}
    up = mi.ScalarTransform4f().translate([0, 0, 6]).scale(9)
    leaf = {"type": "rectangle", "to_world": up, "bsdf": mask}
    for more in ({}, {"leaf": leaf}):
        scene = caustic_scene(fog=null, **more)
        session = session_of(scene, 1000, max_depth=6)
        setting = session.pilot_setting()
        record = read_queries(
            session.pilot_passes(setting, pilot_pixels(setting)).trace(0).vertices
        )
        p = np.array(record["ray_o"] + record["ray_d"] * record["hit"].t)
        on_floor = (np.array(record["throughput"])[0] > 0) & (np.abs(p[2]) < 1e-3)
        on_floor &= np.array(record["pixel"]) > 0
        width = np.array(record["pixel"])[on_floor]
        cosine = FAR / np.linalg.norm(p[:, on_floor] - [[0], [0], [FAR]], axis=0)
        assert len(width) > 50
        in_middle = 2 * np.tan(np.radians(25)) / SIZE * FAR
        np.testing.assert_allclose(width, in_middle * np.sqrt(cosine), rtol=2e-3)


def test_widths_belong_to_vertices_that_the_camera_sees():
    """The first that scatter smoothly, seen in mirrors or not; later ones have none."""
    scene = caustic_scene()
    session = session_of(scene, 1000, bdd=2, max_depth=6)
    setting = session.pilot_setting()
    iteration = session.pilot_passes(setting, pilot_pixels(setting)).trace(0)
    record = read_queries(iteration.vertices)
    used = np.array(record["throughput"])[0] > 0
    pixel, depth = np.array(record["pixel"])[used], np.array(record["depth"])[used] & 0xFF
    straight = depth == 1
    width = 2 * np.tan(np.radians(25)) / SIZE * FAR
    assert straight.any() and (depth > 2).any()
    assert np.all(pixel[straight] > 0.7 * width) and np.all(pixel[straight] <= 1.001 * width)
    # From floor to mirror, and down again: the camera does not see these.
    assert np.all(pixel[~straight] == 0)
    np.testing.assert_allclose(
        np.sort(iteration.pixel_widths()), np.sort(pixel[straight]), rtol=1e-6
    )


def test_near_pixels_share_no_noise():
    """Neighbours' estimates are hardly correlated over iterations, with disks of three pixels they
    are by more than a half; and their means are the same, within 5 standard errors of a block
    (36 blocks: a false alarm in 50000 runs), which are 3 % of it."""
    scene = caustic_scene()
    small = session_of(scene, 24000)
    assert small.kinds() == ["seen_caustic", "indirect"]
    found = {}
    for name, session in (
        ("small", small),
        ("wide", session_of(scene, 24000, denoised=False, initial_radius=1.5)),
    ):
        images = grey_pictures(session, 200)[:, 6:18, 6:18]
        noise = images - images.mean(axis=0)
        alike = (noise[..., 1:] * noise[..., :-1]).mean() / (noise**2).mean()
        blocks = images.reshape(-1, 6, 2, 6, 2).mean(axis=(2, 4))
        found[name] = alike, blocks.mean(axis=0), blocks.var(axis=0, ddof=1) / len(blocks)
    (alike, mean, square), (shared, other, of_other) = found["small"], found["wide"]
    assert alike < 0.15 and shared > 0.5
    error = np.sqrt(square + of_other)
    assert np.abs((mean - other) / error).max() < 5
    assert error.max() < 0.03 * mean.mean()


def test_light_counts_once():
    """Where paths gather at their second vertex, too, seen caustics and all others are in maps of
    their own: the mean is that of a render with one map, within 4.9 standard errors (a false alarm
    in a million), which are 2 % of it."""
    scene = caustic_scene()
    sums = []
    for parameters in ({}, {"denoised": False, "initial_radius": 0.5}):
        session = session_of(scene, 4000, bdd=1, max_depth=5, **parameters)
        assert ("seen_caustic" in session.kinds()) is (not parameters)
        sums.append(grey_pictures(session, 100).mean(axis=(1, 2)))
    error = np.sqrt(sum(np.var(s, ddof=1) / len(s) for s in sums))
    assert abs(sums[0].mean() - sums[1].mean()) < 4.9 * error
    assert error < 0.02 * sums[0].mean()


def test_disks_are_no_wider_than_the_map_is_for():
    """Where pixels are far away and wide all disks have its radius: the image is that of a render
    with this one radius."""
    scene, radius = caustic_scene(), 0.06  # 0.35 pixels are 0.16
    far = session_of(scene, 100000, radii={"seen_caustic": radius, "indirect": 1.0})
    given = session_of(
        scene,
        100000,
        radii={"caustic": radius, "indirect": 1.0},
        denoised=False,
        initial_radius=radius,
    )
    one, other = (grey_pictures(session, 2) for session in (far, given))
    assert one.max() > 0
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * one.max())


def test_sparse_photons_keep_wide_disks():
    """In a short render of few photons a denoiser would see single dots: they have larger radii."""
    scene, radii = caustic_scene(), {"seen_caustic": 0.5, "indirect": 1.0}
    short = session_of(scene, 300, iterations=4.0, radii=radii)
    long = session_of(scene, 300, iterations=1e6, radii=radii)
    dark = [np.mean(grey_pictures(session, 4).mean(axis=0) == 0) for session in (short, long)]
    assert dark[0] < 0.1 and dark[1] > 0.4


def test_who_has_such_disks():
    """Images that will be denoised, of scenes with caustics, where the radius is automatic. Paths
    that gather at later vertices need another map for these."""
    scene = caustic_scene()

    def kinds(**parameters):
        return mi.load_dict({"type": "bdpm", **parameters}).session(scene).kinds()

    assert kinds(denoised=True) == ["seen_caustic", "caustic", "indirect"]
    assert kinds(denoised=True, bdd=0) == ["seen_caustic", "indirect"]
    assert kinds(denoised=True, initial_radius=0.1) == ["caustic", "indirect"]
    assert kinds() == ["caustic", "indirect"]


@pytest.mark.parametrize("size", [1, SIZE])
def test_disks_are_no_larger_than_suits_the_scene(size):
    """One pixel may show all of it."""
    from mis_integrators.pilot.radius import largest_radius

    scene = caustic_scene(size=size)
    session = mi.load_dict({"type": "bdpm", "denoised": True}).session(scene, seed=3, spp=4)
    session.start()
    width, largest = 2 * np.tan(np.radians(25)) / size * FAR, largest_radius(session.traits.extent)
    assert (width > largest) == (size == 1)
    radius = session.radii["seen_caustic"]
    assert 0.8 * min(width, largest) < radius < 1.01 * min(width, largest)


def test_groups_of_a_pilot_look_through_near_pixels():
    """Of each pilot pixel's paths, those of the second group are `APART` pixels further on."""
    scene = caustic_scene()
    session = session_of(scene, 1000)
    setting = session.pilot_setting()
    pixels = pilot_pixels(setting)
    assert (pixels.groups, pixels.apart) == (2, APART)
    record = read_queries(session.pilot_passes(setting, pixels).trace(0).vertices)
    d, path = np.array(record["ray_d"]), np.array(record["path"])
    used = np.array(record["throughput"])[0] > 0
    film = SIZE * (0.5 + 0.5 * d[:2] / -d[2] / np.tan(np.radians(25)))
    column, row = np.floor(film[0]).astype(int), np.floor(SIZE - film[1]).astype(int)
    found = (row * SIZE + column)[used]
    per_group = pixels.camera_paths // pixels.groups
    number, group = path[used] % pixels.count, path[used] // pixels.count // per_group
    np.testing.assert_array_equal(found, number * pixels.stride + APART * group)
    assert set(group) == {0, 1}


def test_the_pilot_counts_little_of_their_noise():
    """What it predicts of them is a denoiser's share of the noise of pixels, measured over
    iterations, within a factor of two (few photons: rare bright pixels)."""
    from mis_integrators.pilot.denoiser import LEFT

    scene = caustic_scene()
    session = mi.load_dict(
        {"type": "bdpm", "bdd": 0, "denoised": True, "photon_count": 20000, "max_depth": 3}
    ).session(scene, seed=3, spp=64)
    session.start()
    assert session.prediction.caustic_share > 0.9
    images = grey_pictures(session, 32)
    weights = 1 / (images.mean() ** 2 * 1.1)
    inner = images[:, 4:20, 4:20]
    measured = LEFT * (inner.var(axis=0, ddof=1) * weights).mean()
    predicted = session.prediction.errors["relmse"].variance
    assert 0.5 * measured < predicted < 2 * measured


@pytest.mark.parametrize("kind", ["radiancemeter", "irradiancemeter", "distant", "batch"])
def test_sensors_without_pixels_have_no_cones(kind):
    """Their rays tell nothing of a pixel's width."""
    from mis_integrators.paths.ray_cones import cones_of

    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    sensor = {"type": kind, "film": film}
    if kind == "batch":
        sensor["child"] = sensor_of("perspective", 60, SIZE)
    if kind == "irradiancemeter":
        shape = mi.load_dict({"type": "rectangle", "meter": sensor})
        sensor = shape.sensor()
    else:
        sensor = mi.load_dict(sensor)
    assert cones_of(sensor) is None
