"""Optimal weights keep their advantage: variance of one iteration at equal merge radius, against
single strategies and the balance heuristic.

Two bundled scenes at 64 x 64 pixels, fixed seeds. Of each method 84 iterations in 12 groups of 7;
from each group a variance map, and from it the mean relative variance without the worst 2 % of the
pixels. The logarithm of the ratio of two methods' means has a standard error from the groups.

`variance_guard.json` holds the ratios of an earlier state of the code with their errors (``pytest
tests/integrators/test_variance_guard.py --record-variances`` writes it, to be done when weights
were changed on purpose). The test fails where a ratio has grown by more than the noise of both:
Student's t over both runs' groups, one-sided, false-alarm rate 1e-3 for the whole module; and where
optimal weights are not below the best single strategy at all, beyond the noise, at the same rate.
The maps are left as PNG in ``--maps`` (default: out/ci).
"""

import json
import math
from pathlib import Path

from mis_integrators.analysis.confidence import t_quantile
from mis_integrators.analysis.metrics import trimmed_mean
from mis_integrators.analysis.variance_maps import relative_variance

import mitsuba as mi
import numpy as np
import pytest
from comparing import in_one_thread, pictures
from selection import extended

ROOT = Path(__file__).parents[2]
RECORD = Path(__file__).with_name("variance_guard.json")
SIZE, ITERATIONS, GROUPS, TRIMMED = 64, 84, 12, 0.02
FALSE_ALARM = 1e-3

# Scene -> merge radius, and the parameters of the mixtures: on diffuse surfaces they mix only when
# told to.
SCENES = {
    "cornell_glossy": (0.06, {"mix_diffuse": True}),
    "cornell_point": (0.06, {"mix_diffuse": True}),
}
SINGLE = tuple(f"bdpm:bdd={bdd}" for bdd in (0, 1, 2))
METHODS = (*SINGLE, "bdpm_balance", "bdpm_opt2", "bdpm_opt3")
RATIOS = {
    "bdpm_opt2 / best single": ("bdpm_opt2", None),
    "bdpm_opt3 / best single": ("bdpm_opt3", None),
    "bdpm_opt3 / bdpm_balance": ("bdpm_opt3", "bdpm_balance"),
}
TESTS = len(SCENES) * 5
"""Comparisons of the module: three ratios a scene against the record, two against one."""


def integrator(method, radius, mixture):
    plugin, _, bdd = method.partition(":bdd=")
    own = {"bdd": int(bdd)} if bdd else mixture if plugin.startswith("bdpm_opt") else {}
    return mi.load_dict(
        {"type": plugin, "initial_radius": radius, "photon_count": 8000, "max_depth": 8, **own}
    )


@in_one_thread
def iterations(scene, method, radius, mixture):
    """Pictures of independent iterations, (ITERATIONS, H, W, 3)."""
    session = integrator(method, radius, mixture).session(scene, seed=5)
    return np.array([picture[..., :3] for picture in pictures(session, ITERATIONS)])


@pytest.fixture(scope="module", params=["cornell_glossy", *extended("cornell_point")])
def measured(request):
    """Of a scene: its name, the mean relative variance of each method and group, and the maps and
    pictures."""
    mi.set_variant("llvm_ad_rgb")
    radius, mixture = SCENES[request.param]
    scene = mi.load_file(str(ROOT / "scenes" / f"{request.param}.xml"), resx=SIZE, resy=SIZE)
    pictures = {method: iterations(scene, method, radius, mixture) for method in METHODS}
    mean = np.mean([p.mean(axis=0) for p in pictures.values()], axis=0)
    groups = {
        method: np.array(
            [
                trimmed_mean(relative_variance(group.var(axis=0, ddof=1), mean), TRIMMED)
                for group in np.split(p, GROUPS)
            ]
        )
        for method, p in pictures.items()
    }
    maps = {
        method: relative_variance(p.var(axis=0, ddof=1), mean) for method, p in pictures.items()
    }
    draw(request.config.getoption("--maps"), request.param, pictures, maps, groups)
    return request.param, groups


def draw(folder, name, pictures, maps, groups):
    """The maps side by side, as a PNG."""
    from mis_integrators.analysis import charts

    best = min(groups[method].mean() for method in SINGLE)
    notes = [f"{groups[method].mean() / best:.2f} x best single" for method in METHODS]
    charts.save(
        charts.variance_maps(
            METHODS, [p.mean(axis=0) for p in pictures.values()], list(maps.values()), notes
        ),
        Path(folder) / f"variance_{name}.png",
    )


def ratios(groups):
    """Name -> (logarithm of the ratio, its squared standard error)."""
    best = min(SINGLE, key=lambda method: groups[method].mean())
    found = {}
    for name, (method, other) in RATIOS.items():
        values, base = groups[method], groups[other or best]
        error2 = sum((v.std(ddof=1) / v.mean()) ** 2 / GROUPS for v in (values, base))
        found[name] = math.log(values.mean() / base.mean()), error2
    return found


@pytest.mark.long
def test_advantage_is_what_it_was(measured, request):
    """Against the record; a tolerance above 25 % would be no guard and fails, too."""
    name, groups = measured
    found = ratios(groups)
    if request.config.getoption("--record-variances"):
        record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
        RECORD.write_text(json.dumps({**record, name: found}, indent=1, sort_keys=True) + "\n")
    record = json.loads(RECORD.read_text())[name]
    t = t_quantile(2 * FALSE_ALARM / TESTS, 2 * (GROUPS - 1))
    for what, (log_ratio, error2) in found.items():
        before, before2 = record[what]
        tolerance = t * math.sqrt(error2 + before2)
        assert tolerance < math.log(1.25), (
            f"{name}, {what}: too noisy to guard anything (tolerance {tolerance:.2f})"
        )
        assert log_ratio < before + tolerance, (
            f"{name}, {what}: variance ratio {math.exp(log_ratio):.3f}, "
            f"was {math.exp(before):.3f}; tolerance {math.expm1(tolerance):.1%}"
        )


@pytest.mark.long
def test_optimal_weights_beat_single_strategies(measured):
    name, groups = measured
    t = t_quantile(2 * FALSE_ALARM / TESTS, 2 * (GROUPS - 1))
    for what in ("bdpm_opt2 / best single", "bdpm_opt3 / best single"):
        log_ratio, error2 = ratios(groups)[what]
        assert log_ratio + t * math.sqrt(error2) < 0, (
            f"{name}, {what}: {math.exp(log_ratio):.3f} is not clearly below 1"
        )
