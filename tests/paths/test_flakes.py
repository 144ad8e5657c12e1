"""Media of flakes: what is drawn has the density that Mitsuba evaluates, and the phase functions of
camera paths and light sub-paths are each other's adjoint. False-alarm rate 1e-6 each."""

from mis_integrators.paths import flakes

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import assert_frequencies
from foggy import flaky
from selection import extended

COUNT = 1 << 20
CELLS = 12, 24
"""Of the sphere of directions: cosines and angles about the z axis."""


def interaction(wi, count=COUNT):
    """A point in a medium of flakes, and a direction that leads from there, `count` times."""
    medium = mi.load_dict({"type": "homogeneous", "phase": flaky()})
    here = dr.zeros(mi.MediumInteraction3f, count)
    here.wi = dr.normalize(mi.Vector3f(wi))
    here.medium = mi.MediumPtr(medium)
    return medium, here


def on_sphere(generator, count=COUNT):
    numbers = generator.uniform(size=(2, count)).astype(np.float32)
    return mi.warp.square_to_uniform_sphere(mi.Point2f(numbers))


def cell(d):
    """Number of the cell of each direction."""
    x, y, z = (np.array(c, dtype=np.float64) for c in (d.x, d.y, d.z))
    row = np.minimum(((z + 1) / 2 * CELLS[0]).astype(int), CELLS[0] - 1)
    column = ((np.arctan2(y, x) / (2 * np.pi)) % 1 * CELLS[1]).astype(int) % CELLS[1]
    return row * CELLS[1] + column


@pytest.mark.parametrize("x, y, z", [(1, 2, 3), *extended((0, 0, 1), (1, 0, 0), (-2, 1, -1))])
def test_samples_have_their_density(rgb, x, y, z):
    """Counts of a million samples on the sphere against the integral of the phase function."""
    generator = np.random.default_rng(1)
    medium, here = interaction((x, y, z))
    point = mi.Point2f(generator.uniform(size=(2, COUNT)).astype(np.float32))
    wo, pdf = flakes.sample(here, point, mi.Bool(True))
    counts = np.bincount(cell(wo), minlength=CELLS[0] * CELLS[1])

    expected = np.zeros(counts.size)
    context, rounds = mi.PhaseFunctionContext(None), 16
    for _ in range(rounds):
        d = on_sphere(generator)
        value, _ = medium.phase_function().eval_pdf(context, here, d)
        weights = np.array(value, dtype=np.float64).reshape(-1, COUNT)[0]
        expected += np.bincount(cell(d), weights, minlength=counts.size) * 4 * np.pi / rounds
    assert abs(expected.sum() / COUNT - 1) < 2e-3
    # The integrals have a noise of their own: with half of the counts' weight it makes no alarm.
    assert_frequencies(counts / 2, expected * (counts.sum() / expected.sum() / 2))
    said, _ = medium.phase_function().eval_pdf(context, here, wo)
    assert dr.allclose(mi.Float(said.x), pdf, rtol=1e-3)


def test_adjoint(rgb):
    """p(l, c) of light sub-paths is p(c, l) of camera paths times the factor; and extinction times
    the phase function is symmetric."""
    generator = np.random.default_rng(2)
    medium, here = interaction((0, 0, 1), 1000)
    to_camera, to_light = on_sphere(generator, 1000), on_sphere(generator, 1000)
    phase, context = medium.phase_function(), mi.PhaseFunctionContext(None)
    factor = flakes.adjoint_factor(here, to_camera, to_light, mi.Bool(True))
    sides = []
    for wi, wo in ((to_camera, to_light), (to_light, to_camera)):
        here.wi = wi
        _, _, extinction = medium.get_scattering_coefficients(here)
        sides.append((mi.Float(phase.eval_pdf(context, here, wo)[0].x), extinction.x))
    (camera, seen), (light, lit) = sides
    assert dr.allclose(camera * factor, light, rtol=1e-4)
    assert dr.allclose(camera * seen, light * lit, rtol=1e-4)
    assert float(dr.max(dr.abs(factor - 1))[0]) > 0.3
