"""The bundled scenes: every strategy and every weight makes the same light of them, and the light
that `path` sees.

The mean of each channel over the image, and over its quarters, agrees within the noise and 0.3 %
for the blur of the merge disk (false-alarm rate 1e-6 beyond that); an error of 1.3 % of the image
would be seen with a probability of 0.95. By default one scene; all with `-m full`.
"""

from pathlib import Path

from mis_integrators.core.traits import scene_bounds

import mitsuba as mi
import numpy as np
import pytest
from comparing import PathBatches, SessionBatches, assert_powerful, collect_until, differences

SCENES = sorted(path.stem for path in (Path(__file__).parents[2] / "scenes").glob("*.xml"))
BLUR, WHOLE, QUARTER = 0.003, 0.01, 0.04
BEYOND_PATH = ("caustics", "sds")
"""Scenes whose light `path` finds by luck alone."""
EXTENDED = (("cornell_point", "bdpm_opt"),)


def small(scene):
    """The scene on a film of about 1000 pixels, its depth limit, and a merge radius of 0.15 % of
    its diagonal."""
    path = Path(__file__).parents[2] / "scenes" / f"{scene}.xml"
    loaded = mi.load_file(str(path), resx=36, resy=28, integrator="path")
    radius = 0.0015 * float(np.linalg.norm(np.array(scene_bounds(loaded).extents())))
    return loaded, {
        "initial_radius": radius,
        "photon_count": 20000,
        "camera_paths": 4,
        "max_depth": 10,
    }


def assert_alike(mine, reference, whole=WHOLE, quarter=QUARTER):
    a, b = collect_until(mine, reference, whole, quarter, most=3000)
    assert b.mean[0].max() > 0
    found = differences(a, b, slack=BLUR)
    assert not found, "\n".join(found)
    assert_powerful(a, b, whole, quarter)


@pytest.mark.parametrize(
    "scene, plugin",
    [
        pytest.param(
            scene,
            plugin,
            marks=pytest.mark.extended if (scene, plugin) in EXTENDED else pytest.mark.full,
        )
        for scene in SCENES
        for plugin in ("bdpm_opt", "bdpm_balance")
    ],
)
def test_weights_keep_the_light(rgb, scene, plugin):
    """Against photons merged at the second vertex, all with full weight."""
    loaded, common = small(scene)
    extra = {"weights": "full", "mix_diffuse": True} if plugin == "bdpm_opt" else {}
    assert_alike(
        SessionBatches(mi.load_dict({"type": plugin, **extra, **common}), loaded, 2),
        SessionBatches(mi.load_dict({"type": "bdpm", "bdd": 1, **common}), loaded, 2, seed=2),
    )


@pytest.mark.full
@pytest.mark.parametrize("bdd", [0, 1])
@pytest.mark.parametrize("scene", [scene for scene in SCENES if scene not in BEYOND_PATH])
def test_photons_make_the_light_of_path(rgb, scene, bdd):
    loaded, common = small(scene)
    assert_alike(
        SessionBatches(mi.load_dict({"type": "bdpm", "bdd": bdd, **common}), loaded, 2),
        PathBatches(mi.load_dict({"type": "path", "max_depth": 10}), loaded, 2),
    )


@pytest.mark.full
@pytest.mark.parametrize("plugin", ["bdpt", "vcm", "bdpt_ris", "pcbpt"])
@pytest.mark.parametrize("scene", [scene for scene in SCENES if scene not in BEYOND_PATH])
def test_connections_make_the_light_of_path(rgb, scene, plugin):
    """An error of 3.3 % of the image would be seen; lamps in the picture make more very slow."""
    loaded, common = small(scene)
    own = {"initial_radius": common["initial_radius"]} if plugin == "vcm" else {}
    assert_alike(
        SessionBatches(
            mi.load_dict({"type": plugin, "max_depth": 10, "camera_paths": 32, **own}), loaded, 2
        ),
        PathBatches(mi.load_dict({"type": "path", "max_depth": 10}), loaded, 2, 256),
        0.03,
        0.1,
    )
