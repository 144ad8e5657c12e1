"""Photons of a kept light pass."""

import drjit as dr
import mitsuba as mi
import numpy as np
from worlds import diffuse, film, look


def test_frozen_photons_stay_on_their_side_of_curved_sheets(rgb, monkeypatch):
    """Photons on the inside of a closed shade count there, and none counts on its outside, even of
    those that come from beyond the plane through a point there."""
    from mis_integrators.integrators import bdpm_opt
    from mis_integrators.photons.frozen import SurfacePhotons

    made = []

    class Kept(SurfacePhotons):
        def __init__(self, *photons):
            super().__init__(*photons)
            made.append(self)

    monkeypatch.setattr(bdpm_opt, "SurfacePhotons", Kept)
    scene = mi.load_dict(
        {
            "type": "scene",
            "shade": {"type": "sphere", "bsdf": {"type": "twosided", "both": diffuse(0.8)}},
            "lamp": {"type": "point", "position": [0, 0.5, 0], "intensity": 5.0},
            "sensor": {
                "type": "perspective",
                "to_world": look((0, -0.5, 0), (0, 1, 0)),
                "film": film(8),
            },
        }
    )
    integrator = mi.load_dict({"type": "bdpm_opt2", "max_depth": 5, "mix_diffuse": True})
    integrator.session(scene, seed=1).start()
    (photons,) = made
    sides = 16
    angle = 2 * np.pi * np.arange(sides) / sides
    around = mi.Vector3f(np.array([np.cos(angle), np.sin(angle), 0 * angle]))

    def visit(photon, hit, totals):
        return (totals[0] + dr.select(hit, 1.0, 0.0),)

    inside, outside = (
        np.array(photons.around(mi.Point3f(around), facing, 0.4, visit, (mi.Float(0),))[0])
        for facing in (-around, around)
    )
    assert inside.min() > 50 and outside.max() == 0
