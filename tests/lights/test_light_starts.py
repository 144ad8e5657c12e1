"""Starts of light sub-paths: the two densities whose product is that of the whole first segment,
and the light that comes from a start."""

from mis_integrators.core.random import streams
from mis_integrators.core.sequences import SampleSequence
from mis_integrators.lights.lights import Lights
from mis_integrators.paths.light_starts import read_starts, sample_light_starts

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from selection import extended, one_of_each_kind
from worlds import EMITTERS, tray

COUNT = 4096


def lights_of(emitter):
    scene = tray("lambertian", emitter)
    return scene, Lights.seen_by(scene, scene.sensors()[0], "bdpm")


def spread(x):
    return np.broadcast_to(np.array(x), COUNT)


@pytest.mark.parametrize(
    "emitter", one_of_each_kind(e for e in EMITTERS if e not in ("projector", "directionalarea"))
)
def test_flux_is_light_over_densities(rgb, emitter):
    """The flux of a light sub-path is the light at its first vertex over the densities of its start
    and of the way there."""
    scene, lights = lights_of(emitter)
    ray, flux, _, source = lights.sample_emission(
        streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(7)), mi.Float(0), []
    )
    si = scene.ray_intersect(ray)
    active = si.is_valid() & (dr.max(flux) > 0)
    infinite = mi.has_flag(source.emitter.flags(), mi.EmitterFlags.Infinite)
    ds, light = lights.emitted(
        si,
        source.emitter,
        dr.select(infinite, mi.Point3f(-ray.d), source.p),
        source.n,
        source.uv,
        active,
    )
    found = light / (
        lights.pdf_emission_origin(si, ds, active) * lights.pdf_emission_area(si, ds, active)
    )
    used = spread(active)
    assert used.sum() > 500
    a, b = (spread(dr.mean(x))[used] for x in (found, flux))
    # Cells of the environment's guide, edges of textures and of cones: rounding decides there, on a
    # few paths.
    assert (np.abs(a - b) < 3e-3 * b).mean() > 0.995
    assert spread(dr.abs(dr.dot(ds.d, ray.d) + 1) < 1e-4)[used].all()


@pytest.mark.parametrize(
    "emitter",
    [
        "textured",
        "spot",
        "envmap rotated",
        "projector",
        *extended("rectangle", "sphere", "directional", "several"),
    ],
)
def test_starts_light_the_scene(rgb, emitter):
    """Light from all starts over their densities: its mean is the unoccluded light at a point, as
    next-event estimation finds it (5.3 standard errors: 1e-7; an error of 3 % is seen with a
    probability of 0.95)."""
    scene, lights = lights_of(emitter)
    count = 1 << 20
    starts = sample_light_starts(
        lights, SampleSequence(mi.UInt32(3), mi.UInt32(0), count, True), count, [], mi.Float(0)
    )
    starts = read_starts(starts, dr.arange(mi.UInt32, count), mi.Bool(True))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n = mi.Point3f(0.3, -0.2, 0.4), mi.Normal3f(0, 0, 1)
    ds, light = lights.emitted(
        si, starts["emitter"], starts["p"], starts["n"], starts["uv"], mi.Bool(True)
    )
    density = lights.pdf_emission_origin(si, ds, mi.Bool(True))
    a = np.array(dr.select(density > 0, dr.mean(light) / density, 0))
    total, error2 = 0.0, 0.0
    for e in scene.emitters():
        rng = streams(dr.arange(mi.UInt32, count), mi.UInt32(11))
        ds, weight = e.sample_direction(si, mi.Point2f(rng.next_float32(), rng.next_float32()))
        b = np.broadcast_to(np.array(dr.select(ds.pdf > 0, dr.mean(weight), 0)), count)
        total, error2 = total + b.mean(), error2 + b.var() / count
    error = np.sqrt(error2 + a.var() / count)
    assert abs(a.mean() - total) < 5.3 * error + 1e-4 * total, (
        f"{a.mean()} against {total} ({error})"
    )
    assert (5.3 + 1.65) * error < 0.03 * total, "test too weak"
