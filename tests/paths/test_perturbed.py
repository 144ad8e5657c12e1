"""Light that scatters at normal maps."""

from mis_integrators.core.random import next_2d, streams
from mis_integrators.paths.perturbed import sample_perturbed, seen_from, smooth_density

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from worlds import bitmap

COUNT = 1 << 21
IMPORTANCE = mi.TransportMode.Importance
MATT = {"type": "diffuse", "reflectance": 0.8}
SHINY = {"type": "roughconductor", "alpha": 0.1, "material": "none"}


def lit_surface(tilt, inner, angle):
    """An interaction (of width `COUNT`) with a surface whose normals a map tilts, lit from `angle`
    (degrees, to the same side); its BSDF; the scene, which owns both."""
    normals = np.broadcast_to(np.array([0, tilt, np.sqrt(1 - tilt * tilt)]) * 0.5 + 0.5, (4, 4, 3))
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "bsdf": {"type": "normalmap", "normalmap": bitmap(normals), "bsdf": inner},
            },
        }
    )
    a = np.radians(angle)
    towards = mi.Vector3f(0, float(np.sin(a)), float(np.cos(a)))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(towards), -towards))
    si = dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, COUNT))
    return si, mi.BSDFPtr(scene.shapes()[0].bsdf()), scene


@pytest.mark.thinned(3, 1, 3)
@pytest.mark.parametrize("angle", [-60, 10, 70])
@pytest.mark.parametrize("inner", [MATT, SHINY], ids=["matt", "shiny"])
def test_flux_and_density(rgb, inner, angle):
    """Moments of scattered light agree with those of directions spread evenly over the hemisphere
    (5.3 standard errors: 1e-7), and the density with a histogram of the samples."""
    si, bsdf, _scene = lit_surface(0.4, inner, angle)
    rng = streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(3))
    everywhere = mi.warp.square_to_uniform_hemisphere(next_2d(rng))
    light = bsdf.eval(mi.BSDFContext(), seen_from(si, everywhere), si.wi).x * (2 * dr.pi)
    bs, _, weight = sample_perturbed(bsdf, si, rng, mi.Bool(True), mi.Bool(True))
    above = bs.wo.z > 0
    scattered = dr.select(above, weight.x, 0)
    own = bsdf.pdf(mi.BSDFContext(IMPORTANCE), si, everywhere)
    density = smooth_density(bsdf, si, everywhere, own, mi.Bool(True)) * (2 * dr.pi)
    found = dr.select(above & (bs.wo.y > 0.3), mi.Float(1), 0)
    stated = dr.select(everywhere.y > 0.3, density, 0)
    for a, b in (
        (scattered, light),
        (scattered * bs.wo.y, light * everywhere.y),
        (found, stated),
    ):
        a, b = np.array(a), np.array(b)
        error = np.hypot(a.std(), b.std()) / np.sqrt(COUNT)
        assert abs(a.mean() - b.mean()) < 5.3 * error
    size = np.abs(np.array(light)).mean()
    if size > 0.01:
        assert 5.3 * np.array(scattered).std() / np.sqrt(COUNT) < 0.05 * size, "test too weak"


def test_no_rare_bright_light(rgb):
    """Light leaves below the perturbed horizon from the turned lobe: where only the lobe of the
    light's own side is drawn from, weights are fifty times larger."""
    si, bsdf, _scene = lit_surface(0.5, SHINY, 10)
    rng = streams(dr.arange(mi.UInt32, COUNT), mi.UInt32(3))
    bs, _, weight = sample_perturbed(bsdf, si, rng, mi.Bool(True), mi.Bool(True))
    flux = np.array(weight.x * dr.abs(bs.wo.z))
    assert flux.max() < 10, flux.max()
