"""Directions towards an environment: its own sampler, and the table where that misses light."""

from mis_integrators.core.random import next_2d, streams
from mis_integrators.lights.environment_sampler import EnvironmentSampler, point, radiance

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from comparing import mean_and_error, stratified_directions
from worlds import EMITTERS, T

COUNT = 1 << 19


def environment(name):
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, **EMITTERS[name]("delta")})
    return scene.environment()


def drawn(emitter, sampler):
    """Directions of the sampler, with their densities."""
    sample = next_2d(streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(3)))
    it = point(mi.Point3f(0), mi.Float(0))
    turned, towards, sample = sampler.from_table(sample)
    ds, _ = emitter.sample_direction(it, sample)
    ds.d = dr.select(turned, towards, ds.d)
    return ds.d, sampler.density(emitter.pdf_direction(it, ds), ds.d)


@pytest.mark.parametrize("name", ["constant", "envmap rotated", "sunsky"])
def test_good_samplers_are_left_alone(rgb, name):
    sampler, own = EnvironmentSampler(environment(name)), mi.Float(0.1)
    assert not sampler.by_table and sampler.tables() == []
    assert sampler.density(own, mi.Vector3f(0, 0, 1)) is own


@pytest.mark.parametrize("angle, height", [(0, 80), (60, 80), (130, 80), (0, 2)])
def test_a_wide_sun_is_found(rgb, angle, height):
    """Wherever the sun stands (the last one sets), the light that directions bring is what
    stratified ones say (5.3 standard errors: 1e-7; 2 % are seen), and its variance is a small part
    of that of the sky's own sampler."""
    turn, tilt = T().rotate([0.6, 0.8, 0], angle), np.radians(height)
    sky = {
        "type": "sunsky",
        "sun_direction": turn @ mi.ScalarVector3f(np.cos(tilt), 0, np.sin(tilt)),
        "sun_aperture": 10.0,
        "to_world": turn,
    }
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "sky": sky})
    emitter = scene.environment()
    sampler = EnvironmentSampler(emitter)
    assert sampler.by_table
    towards, density = drawn(emitter, sampler)
    value = np.array(dr.select(density > 0, radiance(emitter, towards) / density, 0))
    sets = [radiance(emitter, stratified_directions(1024, k)).numpy() for k in range(8)]
    expected, expected_error = mean_and_error(4 * np.pi * np.mean(sets, axis=1))
    mean, error = mean_and_error(value)
    error = np.hypot(error, expected_error)
    assert abs(mean - expected) < 5.3 * error, f"{mean} against {expected}"
    assert (5.3 + 1.65) * error < 0.02 * expected, "test too weak"
    sample = next_2d(streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(5)))
    _, own = emitter.sample_direction(point(mi.Point3f(0), mi.Float(0)), sample)
    assert value.var() < 0.1 * np.array(dr.mean(own)).var()


def test_density_is_one_in_all(rgb):
    """The integral of the density over all directions; stratified ones, 5 standard errors."""
    sampler, towards = EnvironmentSampler(environment("wide sun")), stratified_directions(1024)
    assert sampler.by_table
    density = sampler.density(mi.Float(1 / (4 * np.pi)), towards)
    total, error = mean_and_error(4 * np.pi * np.array(density))
    assert error < 0.01 and abs(total - 1) < 5 * error, (total, error)
