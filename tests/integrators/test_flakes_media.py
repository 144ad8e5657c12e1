"""Media of flakes (`sggx`), whose extinction depends on the direction and whose phase functions are
not symmetric, under all plugins.

The oracle is `bdpt`, whose techniques are compared with each other in `test_bdpt_media`: Mitsuba's
`volpath` (3.9.1) draws directions by another density than it says (`paths.flakes`). False-alarm
rate 1e-6 each; an error of 3 % of the whole image and of 10 % of a quarter is seen with a
probability of 0.95, where a test says nothing else.
"""

import mitsuba as mi
import numpy as np
import pytest
from comparing import Estimate, SessionBatches, agree, assert_same, collect_until
from foggy import around, batch, flaky, grid, multiview, pockets, views_agree
from selection import extended
from test_balance_media import SmallRadius as SmallBalance
from test_bdpm import last_words
from test_bdpm_media import SLACK, SmallRadiusBatches
from test_bdpt_media import bdpt, cloud, fog_scene, homogeneous
from test_opt_media import SmallRadius as SmallOptimal

MEDIA = {
    "even": lambda: homogeneous(2.0, 0.9, flaky()),
    "grid": lambda: grid(pockets, scale=6.0, albedo=0.9) | {"phase": flaky()},
}


PHOTONS = {
    "bdpm 0": lambda scene: SmallRadiusBatches(scene, 2, bdd=0),
    "bdpm 1": lambda scene: SmallRadiusBatches(scene, 2, bdd=1),
    "bdpm_balance": lambda scene: SmallBalance(scene, 2),
    "bdpm_opt": lambda scene: SmallOptimal(scene, 3),
}


@pytest.mark.parametrize(
    "name, kind",
    extended(
        ("bdpm 0", "grid"),
        ("bdpm 0", "even"),
        ("bdpm 1", "even"),
        ("bdpm 1", "grid"),
        ("bdpm_balance", "even"),
        ("bdpm_opt", "even"),
        ("bdpm_opt", "grid"),
    ),
)
def test_photons_agree_with_bdpt(rgb, name, kind):
    world, visible = fog_scene(MEDIA[kind]()), (0.03, 0.1)
    estimates = collect_until(
        PHOTONS[name](world), SessionBatches(bdpt(), world, 2), *visible, most=600
    )
    assert_same(*estimates, *visible, slack=2 * SLACK)


@pytest.mark.parametrize(
    "plugin, kind", extended(("vcm", "even"), ("bdpt_ris", "even"), ("pcbpt", "grid"))
)
def test_agrees_with_bdpt(rgb, plugin, kind):
    integrator = mi.load_dict({"type": plugin, "max_depth": 6, "camera_paths": 16})
    agree(integrator, bdpt(), fog_scene(MEDIA[kind]()), blocks=2, whole=0.03, block=0.1, spp=256)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["even", *extended("grid")])
def test_views_agree_with_bdpt(rgb, kind):
    """Each view has its own extinction at what it shares."""
    world = fog_scene(MEDIA[kind](), batch(around()))
    views_agree(multiview(max_depth=6), bdpt(), world, whole=0.05, block=0.15)


@pytest.mark.long
def test_furnace(rgb):
    """A medium of flakes that absorbs nothing cannot be told from an even sky: flakes take from
    each direction as much light as they send there."""
    furnace = cloud(1.0, phase=flaky())
    batches = SmallRadiusBatches(furnace, 2, max_depth=-1, rr_depth=100, bdd=0)
    batches.add(2)
    exact = Estimate.exact(np.ones((5, 3)))
    assert_same(*collect_until(batches, exact, 0.02, 0.04), 0.02, 0.04, slack=SLACK)


def test_flakes_within_others_are_refused(rgb):
    """Mitsuba asks the outer phase function for the areas of flakes, which does not know them."""
    blend = {"type": "blendphase", "weight": 0.3, "a": flaky(), "b": {"type": "isotropic"}}
    for integrator in (bdpt(), multiview()):
        with pytest.raises(Exception) as error:
            mi.render(fog_scene(homogeneous(phase=blend)), integrator=integrator, spp=16)
        assert '"sggx" is not supported as part of another' in last_words(error.value)
