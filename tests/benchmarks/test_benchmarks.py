"""What the benchmarks conclude from figures: breaks, choices, fronts, regressions, styles,
pages."""

import json
import math
from inspect import signature
from pathlib import Path
from types import SimpleNamespace

from mis_integrators.analysis.fronts import pareto_front
from mis_integrators.analysis.metrics import References
from mis_integrators.analysis.stability import Point, breaks, choose, judge
from mis_integrators.analysis.zooms import telling_windows

import mitsuba as mi
import numpy as np
import pytest
from foggy import THREE_VIEWS
from test_bdpm import box_scene

SCENES = Path(__file__).parents[2] / "scenes"


def points(*errors, off=()):
    return [Point(2.0**i, error, 0.2 if i in off else 0.0, 0.001) for i, error in enumerate(errors)]


# --- Analysis -----------------------------------------------------------------


def test_front():
    assert pareto_front([1, 2, 3, 2], [5, 3, 4, 3]) == [True, True, False, True]


def test_breaks_by_error_and_by_mean():
    assert breaks(points(1, 1, 1.2, 3.5)) == [False, False, False, True]
    assert breaks(points(1, 1, 1, 1, off=[2])) == [False, False, True, False]
    assert breaks(points(1, 1, 1, math.inf)) == [False, False, False, True]


def test_mean_that_is_off_within_the_noise_is_not_off():
    assert (
        Point(1, 1, 0.06, 0.001).mean_is_off
        and not Point(1, 1, 0.06, 0.03).mean_is_off
        and not Point(1, 1, 0.04, 0.001).mean_is_off
    )


@pytest.mark.parametrize("factor, off", [(1.0, False), (1.2, True), (0.85, True), (1.02, False)])
def test_judged_image(factor, off):
    """Means that are off are found through noise and a lamp in the picture."""
    rng = np.random.default_rng(4)
    truth = np.full((64, 64, 3), 0.5)
    truth[:3, 20:30] = 500
    noise = [truth * (1 + rng.normal(0, 0.1, truth.shape)) for _ in range(3)]
    judged = judge(1, noise[0] * factor, References(noise[1], noise[2], "", True))
    assert judged.mean_is_off == off
    assert judge(
        1, np.where(truth > 100, np.nan, truth), References(noise[1], noise[2], "", True)
    ).mean_is_off


def test_choice_follows_from_the_figures():
    a, b, c = (
        points(1, 1, 1, 9),
        points(2, 0.9, 0.5, 0.4),
        points(0.1, 0.1, 0.1, 0.1, off=[0, 1, 2, 3]),
    )
    first, second = choose({"a": a, "b": b, "c": c})
    assert (first.low, first.high, first.best) == (1, 2, "a")  # b is better at 2, but hardly
    assert (second.low, second.high, second.best, second.close) == (4, 8, "b", ())
    assert "c" in first.broken and "a" in second.broken and "b" not in second.broken
    assert [choice.best for choice in choose({"c": c})] == ["none"]


def test_zoom_shows_where_methods_differ():
    maps = [np.full((64, 64), 0.1) for _ in range(4)]
    maps[0][40:56, 8:24] = maps[1][40:56, 8:24] = 0.8
    maps[3][:] = 1.0  # fails everywhere, tells nothing
    (y, x), second = telling_windows(maps, 16)
    assert (y, x) == (40, 8) and (abs(second[0] - y) >= 16 or abs(second[1] - x) >= 16)


def test_method_keeps_its_style():
    charts = pytest.importorskip("mis_integrators.analysis.charts")
    few, many = (
        charts.styles(["path", "bdpm:bdd=0", "new"]),
        charts.styles(["vcm", "bdpm:bdd=0", "path", "bdpm:bdd=1", "new"]),
    )
    assert all(few[label] == many[label] for label in few)
    assert len({(s.colour, s.marker) for s in many.values()}) == len(many)


# --- Regressions --------------------------------------------------------------


def row(method, ratio, error=0.01, seeds=6):
    figures = {
        name: value
        for ratio_name in ("cost ratio", "relMSE ratio", "trimmed ratio")
        for name, value in ((ratio_name, ratio), (f"{ratio_name} error", error))
    }
    return {
        "scene": "s",
        "size": "8x8",
        "method": method,
        "asked": "1 s",
        "seeds": seeds,
        **figures,
    }


def test_regressions_beyond_the_noise_are_named(module, tmp_path, capsys):
    regressions = module("report.regressions")
    before = [row("path", 1.0, 0.0), row("a", 1.0), row("b", 2.0)]
    now = [
        row("path", 1.0, 0.0),
        {**row("a", 1.02), "cost ratio": 1.3},
        {**row("b", 2.02), "relMSE ratio": 1.0},
        row("new", 1.0),
    ]
    changes, compared = regressions.find_changes(now, before)
    assert compared == 6
    assert [(change["method"], change["what"]) for change in changes] == [
        ("a", "slower"),
        ("b", "less so: noisier"),
    ]
    assert (
        changes[0]["change"] == pytest.approx(1.3) and changes[0]["from"] < 1.3 < changes[0]["to"]
    )
    assert regressions.find_changes(now, [row("a", 1.0, None)]) == ([], 0)
    kept = tmp_path / "before.json"
    kept.write_text(json.dumps(module("common.rows").document(before, {})))
    assert regressions.report(now, kept)


def test_regressions_raise_few_false_alarms(module):
    """Two runs of the same program, 60 figures each: some change is named in 5 % of the pairs
    (binomial, four standard deviations)."""
    find_changes, rng, trials, count = (
        module("report.regressions").find_changes,
        np.random.default_rng(2),
        150,
        60,
    )

    def run():
        values = rng.normal(0, 0.1, (count, 5))
        rows = [
            row(str(i), float(np.exp(v.mean())), float(v.std(ddof=1) / 5**0.5), 5)
            for i, v in enumerate(values)
        ]
        return [{**r, "relMSE ratio": None, "trimmed ratio": None} for r in rows]

    alarms = sum(bool(find_changes(run(), run())[0]) for _ in range(trials))
    assert alarms <= trials * 0.05 + 4 * math.sqrt(trials * 0.05 * 0.95)


def test_winner_and_those_that_cannot_be_told_apart(module):
    winners = module("common.winners")

    def of(method, *values):
        return {
            "scene": "s",
            "method": method,
            "trimmed ratio": np.mean(values),
            "trimmed by seed": " ".join(map(str, values)),
            "iterations": 5,
            "seconds": 1.0,
        }

    rows = [
        of("path", 1, 1.01, 0.99),
        of("a", 0.5, 0.51, 0.49),
        of("b", 0.55, 0.56, 0.54),
        of("c", 0.2, 2.0, 0.4),
        of("d", 0.7, 0.72, 0.69),
    ]
    assert winners.told_apart(rows[2], rows[1]) and not winners.told_apart(rows[3], rows[1])
    (winner,) = winners.winners(rows)
    assert winner["best"] == "a" and winner["about as good"] == "b, c"
    late = [
        {**of("e", 0.1, 0.1, 0.1), "iterations": 1, "seconds": 1.3},
        {**of("f", 0.3, 0.3, 0.3), "iterations": 1, "seconds": 1.1},
    ]
    assert winners.winners(rows + late)[0]["best"] == "f"


def test_radius_for_a_number_of_photons(module):
    """Throughput is measured at the same number of photons a gather everywhere."""
    session = mi.load_dict(
        {"type": "bdpm", "bdd": 0, "initial_radius": 0.1, "photon_count": 20000}
    ).session(box_scene(16))
    radius, photons, vertices, found = module("experiments.throughput").radius_for(session, 10.0)
    assert (
        found == pytest.approx(10, rel=0.2)
        and 0.001 < radius < 1
        and photons > 1000
        and 0 < vertices <= 256
    )


# --- The commands -------------------------------------------------------------


def test_bundled_scenes_are_as_frozen(module, monkeypatch, tmp_path, capsys):
    """Figures of different versions are about the same scenes. A file that changed, one that is
    new, and one that is gone are named."""
    freezing = module("experiments.freezing")
    freezing.check(None)
    frozen = json.loads(freezing.RECORD.read_text())
    assert len(frozen) > 20 and all(len(digest) == 64 for digest in frozen.values())
    del frozen["door.xml"]
    monkeypatch.setattr(freezing, "RECORD", tmp_path / "scenes.json")
    freezing.RECORD.write_text(json.dumps({**frozen, "sds.xml": 64 * "0", "attic.xml": 64 * "0"}))
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        freezing.check(None)
    assert exit.value.code == 1 and capsys.readouterr().out.splitlines() == [
        "attic.xml: gone",
        "door.xml: new",
        "sds.xml: changed",
    ]


def test_sweeps_of_views(module):
    """The views' sweeps name plugins that there are, and vary what they say."""
    sweeps = [sweep for sweep in module("experiments.sweeps").SWEEPS if sweep.labels]
    assert {sweep.parameter for sweep in sweeps} == {"density", "spacing", "sideways"}
    for sweep in sweeps:
        assert [method.label for method in sweep.methods([])] == list(sweep.labels)
        (_, low), *_, (_, high) = sweep.scenes(coarse=True)
        scenes = [sweep.scene(16, **change) for change in (low, high)]
        assert (
            scenes[0].size == (32, 8)
            and scenes[0].name != scenes[1].name
            and scenes[0].made != scenes[1].made
        )
        parameters = [
            {name: str(value) for name, value in mi.traverse(opened.scene)} for opened in scenes
        ]
        assert parameters[0].keys() == parameters[1].keys() and parameters[0] != parameters[1]


def test_first_views_of_a_scene(module):
    """Those of a batch, and sensors of their own."""
    load, folder = module("experiments.multiview").load, SCENES / "multiview"
    orbit, parameters = load(folder / "smoke_orbit.xml", 0.25, 3)
    assert tuple(orbit.sensors()[0].film().size()) == (48, 16) and parameters["max_depth"] == 64
    whole, _ = load(folder / "smoke_orbit.xml", 0.25)
    assert tuple(whole.sensors()[0].film().size()) == (256, 16)
    flight, _ = load(folder / "fly_through.xml", 0.5, 2)
    assert [tuple(sensor.film().size()) for sensor in flight.sensors()] == [(32, 32)] * 2


def test_defaults_name_registered_plugins_only(module):
    methods = module("common.methods")
    assert [m.label for m in methods.registered(("path", "nonsense", "bdpm:bdd=0"))] == [
        "path",
        "bdpm:bdd=0",
    ]
    assert methods.registered(methods.COMPARED)[0].label == methods.BASE


TINY = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm">
    <integer name="width" value="48"/><integer name="height" value="40"/></film></sensor>
    <shape type="sphere"/>
    <emitter type="point"><point name="position" x="1" y="2" z="4"/></emitter></scene>"""


@pytest.mark.parametrize(
    "bsdf, lamp, fog, expected",
    [
        ("dielectric", "point", False, "vcm"),
        ("dielectric", "point", True, "bdpt"),
        ("dielectric", "constant", False, "path"),
        ("diffuse", "point", False, "path"),
        ("diffuse", "point", True, "volpath"),
        ("diffuse", "directionalarea", False, "vcm"),
    ],
)
def test_references_show_all_light(module, rgb, bsdf, lamp, fog, expected):
    """Camera paths make no references where lamps that they cannot meet shine on glass, or where
    connections make no light of theirs."""
    outside = {"exterior": {"type": "homogeneous"}} if fog else {}
    ball = {"type": "sphere", "bsdf": {"type": bsdf}, **outside}
    lamp = {"type": lamp}
    if lamp["type"] == "directionalarea":
        lamp = {"type": "rectangle", "emitter": lamp}
    scene = mi.load_dict({"type": "scene", "ball": ball, "lamp": lamp})
    assert module("common.references").complete(scene).partition(":")[0] == expected


def test_path_under_another_sampler(module, tmp_path):
    """One pass takes the whole time, with the scene's film; the scene's own sampler stays."""
    file = tmp_path / "tiny.xml"
    file.write_text(TINY)
    methods = module("common.methods")
    opened = module("common.scene_files").open_scene(file, (24, 20))
    plain, other = (
        methods.SessionMaker(methods.parse_method(label), opened, 0.5, warm_up=False).make(1)
        for label in ("path", "path:sampler=multijitter")
    )
    assert other.iterations_planned == 1 and other.camera_paths > 4
    assert "Multijitter" in str(opened.sensor_with("multijitter").sampler())
    assert "Independent" in str(opened.sensor.sampler())
    assert opened.sensor_with(None) is opened.sensor
    for session in (plain, other):
        session.iterate()
    assert plain.image().shape == other.image().shape == (20, 24, plain.image().shape[2])
    assert other.image().mean() == pytest.approx(plain.image().mean(), rel=0.1)
    with pytest.raises(Exception, match="nonsense"):
        methods.SessionMaker(methods.parse_method("path:sampler=nonsense"), opened, 0.5)


def test_convergence_of_samplers(module, tmp_path):
    """A row for each sampler and power of two; the chart has a panel for each scene."""
    pytest.importorskip("matplotlib")
    file = tmp_path / "tiny.xml"
    file.write_text(TINY)
    module("run").main(
        ["sampling", "--scenes", str(file), "--size", "16", "--iterations", "4", "--seeds", "3"]
        + ["--out", str(tmp_path)]
    )
    rows = json.loads((tmp_path / "sampling.json").read_text())["rows"]
    assert [(row["sampler"], row["iterations"]) for row in rows] == [
        (sampler, n) for sampler in ("sobol", "independent") for n in (1, 2, 4)
    ]
    assert all(row["variance"] > 0 for row in rows)
    assert (tmp_path / "sampling.png").stat().st_size > 1000


@pytest.mark.extended
def test_page_of_one_small_scene(module, tmp_path):
    """The whole way, small: every part of the page is there, everything it shows is embedded, and
    it names what cannot be rendered."""
    pytest.importorskip("matplotlib")
    scene = tmp_path / "tiny.xml"
    scene.write_text(TINY)
    views = tmp_path / "views.xml"
    views.write_text(THREE_VIEWS)
    argv = [
        "page",
        "--scenes",
        str(scene),
        "--view-scenes",
        str(views),
        "--view-counts",
        "2",
        "3",
        "4",
        "--view-time",
        "0.01",
        "--view-seeds",
        "2",
        "--integrators",
        "path",
        "bdpm:bdd=0",
        "bdpm:bdd=0,bogus=1",
        "--varied",
        "bdpm:bdd=0",
        "--time",
        "0.3",
        "--seeds",
        "2",
        "--reference-time",
        "0.2",
        "--references",
        str(tmp_path / "references"),
        "--iterations",
        "2",
        "--sweeps",
        "camera_paths",
        "--size",
        "16",
        "--point-time",
        "0.05",
        "--room-reference-time",
        "0.3",
        "--resampled",
        "--out",
        str(tmp_path / "out"),
    ]
    module("run").main(argv)
    page = (tmp_path / "out" / "index.html").read_text()
    assert 'src="http' not in page and page.count('src="data:') >= 12
    for part in (
        "Many views at once",
        "view 3 of 3",
        "geometric mean",
        "error against time",
        "variance of one iteration",
        "Which method where",
        "bogus",
        "HDR-FLIP",
    ):
        assert part in page or (part == "HDR-FLIP" and "relative error" in page), part
    references, opened = module("common.references"), module("common.scene_files").open_scene(scene)
    kept = {"references": tmp_path / "references", "reference_method": None}
    assert references.are_there(opened, SimpleNamespace(**kept, reference_time=0.2))
    assert not references.are_there(opened, SimpleNamespace(**kept, reference_time=0.3))
    rows = json.loads((tmp_path / "out" / "compare.json").read_text())["rows"]
    assert [r["method"] for r in rows] == ["path", "bdpm:bdd=0"]
    assert rows[0]["relMSE ratio"] == 1 and 0.9 < rows[1]["mean ratio"] < 1.1
    counts = json.loads((tmp_path / "out" / "view_counts.json").read_text())["rows"]
    assert [r["views"] for r in counts] == [2, 3]  # there are no four
    assert all(
        r["ratio"] == pytest.approx(r["variance x s"] / r["volpath variance x s"])
        and r["samples"] > 0
        for r in counts
    )
    for name in (
        "converge.csv",
        "views_views.png",
        "views_views_2_volpath.png",
        "variance.csv",
        "stability.csv",
        "which_method.md",
        "which_scene.md",
        "tiny_time.png",
        "tiny_path.png",
        "variance_tiny_1.png",
    ):
        assert (tmp_path / "out" / name).stat().st_size > 0


@pytest.mark.full
def test_resampling_is_swept(module, tmp_path):
    """N_c of two values: each method beside `bdpt`, whose own ratios are one, and error, noise and
    cost agree with each other."""
    pytest.importorskip("matplotlib")
    scene = tmp_path / "tiny.xml"
    scene.write_text(TINY)
    resampling = module("experiments.resampling")
    module("run").main(
        [
            "resampling",
            "--scenes",
            str(scene),
            "--parameters",
            "cache_neighbors",
            "--coarse",
            "--draw-time",
            "0.2",
            "--draw-seeds",
            "2",
            "--resampling-scale",
            "1",
            "--reference-time",
            "0.3",
            "--references",
            str(tmp_path / "references"),
            "--out",
            str(tmp_path),
        ]
    )
    rows = json.loads((tmp_path / "resampling.json").read_text())["rows"]
    assert [(r["value"], r["method"]) for r in rows] == [
        (value, method) for value in (1, 5) for method in resampling.METHODS
    ]
    for r in rows:
        assert (r["MAPE ratio"] == r["cost ratio"] == 1) == (r["method"] == "bdpt") and 0.05 < r[
            "cost ratio"
        ] < 20
    page = (tmp_path / "resampling.html").read_text()
    assert (
        'id="resampling"' in page
        and page.count('src="data:image/svg') == 1
        and (tmp_path / "resampling_tiny.png").stat().st_size > 0
    )


def test_ratios_of_resampling(module):
    """What a method needs is said as ratios to `bdpt`: half the error in a quarter of the
    iterations that each cost four times as much."""
    resampling = module("experiments.resampling")
    base = [{"MAPE": 0.2, "relMSE": 0.04, "noise": 4.0, "cost": 0.01, "iterations": 100}] * 2
    mine = [{"MAPE": 0.1, "relMSE": 0.01, "noise": 0.25, "cost": 0.04, "iterations": 25}] * 2
    found = resampling.row(SimpleNamespace(name="s"), resampling.SWEEPS[0], 50, "pcbpt", mine, base)
    assert (
        found["MAPE ratio"],
        found["relMSE ratio"],
        found["noise ratio"],
        found["cost ratio"],
    ) == pytest.approx((0.5, 0.25, 1 / 16, 4))
    lines = module("report.sections").lines
    line = lines([found], ["pcbpt"], resampling.SWEEPS[0].name, "noise ratio")["pcbpt"]
    assert (line.values, line.ratios) == ([50], [found["noise ratio"]])
    method = module("common.methods").parse_method("bdpt_ris:target=f_y_f_yz")
    assert resampling.with_value(method, "resamples", 4).parameters == {
        "target": "f_y_f_yz",
        "resamples": 4,
    }
    assert (
        resampling.with_value(
            module("common.methods").parse_method("bdpt"), "resamples", 4
        ).parameters
        == {}
    )


def test_a_slow_start_does_not_end_a_rendering(module):
    """The first iteration, with its pilots, tells nothing of the second."""
    Contender = module("common.turns").Contender
    contender = Contender("any", None, seconds=[1.4], usual=0.2)
    assert contender.wants(2.0) and contender.wants(1.51) and not contender.wants(1.49)
    assert not Contender("any", None, seconds=[1.4]).wants(2.0)
    contender.seconds.append(0.5)
    assert contender.wants(2.2) and not contender.wants(2.1)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--integrators", "bdpmm"], '"bdpmm" not found'),
        (["--integrators", "bdpm:bdd"], "name=value"),
        (["--scenes", "none.xml"], "no file none.xml"),
        (["--time", "-1"], "-1 is not a number above 0"),
    ],
)
def test_what_is_asked_for_is_checked_before_it_is_measured(module, capsys, arguments, message):
    with pytest.raises(SystemExit) as exit:
        module("run").main(["compare", *arguments])
    assert exit.value.code == 2 and message in capsys.readouterr().err.splitlines()[-1]


def test_a_scene_that_cannot_be_loaded_is_told_before_others_are_measured(module, tmp_path, capsys):
    (tmp_path / "dark.xml").write_text(
        '<scene version="3.0.0"><emitter type="point"><rgb name="intensty" value="1"/>'
        "</emitter></scene>"
    )
    good, bad = str(SCENES / "cornell_point.xml"), str(tmp_path / "dark.xml")
    with pytest.raises(SystemExit) as exit:
        module("run").main(["choice", "--scenes", good, bad])
    message = capsys.readouterr().err.splitlines()[-1]
    assert exit.value.code == 2 and bad in message and "intensty" in message


def test_a_baseline_is_a_file_of_figures_and_no_scene(module, tmp_path):
    figures = tmp_path / "compare.json"
    figures.write_text("[]")
    options = module("run")._parser().parse_args(["compare", "--baseline", str(figures)])
    assert options.baseline == figures


def test_comparisons_without_path_are_shown(module, capsys):
    """Artefacts are counted beside `path`: without it the table has no such column."""
    compare = module("experiments.compare")
    row = dict.fromkeys(set(compare.COLUMNS) - {"artefacts"}, 1.5) | {"method": "bdpt"}
    row |= {f"{name} ratio {end}": 1.0 for name in ("relMSE", "cost") for end in ("low", "high")}
    base = SimpleNamespace(method=SimpleNamespace(label="bdpt"))
    measurement = SimpleNamespace(base=base, opened=SimpleNamespace(name="s"), failures={})
    options = SimpleNamespace(spp=None, time=1.0, seeds=2, denoise=False)
    compare.show_comparison([row], measurement, options)
    shown = capsys.readouterr().out
    assert "ratios to bdpt" in shown and "artefacts" not in shown and "1.5" in shown


@pytest.mark.extended
def test_comparisons_of_denoised_images(tmp_path, module, rgb):
    """Denoised images have errors of their own, over those of the better `path`; integrators are
    told; references are rendered with the box filter that the film then has."""
    pytest.importorskip("mitsuba_oidn")
    scene = tmp_path / "tiny.xml"
    scene.write_text(TINY.replace("</film>", '<rfilter type="gaussian"/></film>'))
    module("run").main(
        [
            *("compare", "--denoise", "--scenes", str(scene), "--spp", "4", "--seeds", "1"),
            *("--integrators", "path", "path:sampler=multijitter", "bdpm", "bdpt"),
            *("--reference-time", "0.2", "--references", str(tmp_path / "references")),
            *("--out", str(tmp_path / "out")),
        ]
    )
    rows = json.loads((tmp_path / "out" / "compare.json").read_text())["rows"]
    for name in ("denoised relMSE", "denoised FLIP"):
        better = min(row[name] for row in rows[:2])
        for row in rows:
            assert row[f"{name} / best path"] == pytest.approx(row[name] / better)
    assert rows[0]["denoised relMSE"] != rows[0]["relMSE"]
    assert "images denoised" in (tmp_path / "out" / "compare.html").read_text()
    assert len(list((tmp_path / "references").glob("*_box*.exr"))) == 2
    files = module("common.scene_files")
    told = [
        module("common.methods").parse_method(label).integrator(files.open_scene(scene, None, True))
        for label in ("bdpm", "bdpm:denoised=false", "bdpt")
    ]
    assert [getattr(integrator, "denoised", None) for integrator in told] == [True, False, False]


def test_images_combined_by_their_true_errors(module):
    """Two images of independent noise, each good in another half: the combination has the error
    1 / (1/a + 1/b) in each. Of 4096 pixels and three channels, five standard errors: false alarms
    below 1e-6."""
    combine, metrics = module("experiments.combine"), module("mis_integrators.analysis.metrics")
    rng = np.random.default_rng(1)
    references = metrics.References(*(np.ones((64, 64, 3)) for _ in range(2)), "ones", False)
    left = np.arange(64)[None, :, None] < 32
    deviations = [np.where(left, 0.1, 0.4), np.where(left, 0.2, 0.1)]
    images = [1 + rng.normal(size=(64, 64, 3)) * deviation for deviation in deviations]
    found = metrics.errors(combine.mixed(images, references), references).mse
    least = np.mean(1 / sum(1 / deviation**2 for deviation in deviations))
    assert found == pytest.approx(least, rel=5 * (2 / (64 * 64 * 3)) ** 0.5)


@pytest.mark.long
def test_whether_methods_should_share_the_time(tmp_path, module, capsys):
    """One row a share and method beside the best; a method is at most as good as the best alone in
    the product of both errors."""
    scene = tmp_path / "tiny.xml"
    scene.write_text(TINY)
    module("run").main(
        [
            *("combine", "--scenes", str(scene), "--time", "0.2", "--shares", "0.15", "0.5"),
            *("--integrators", "path", "bdpm:bdd=0", "bdpt", "--reference-time", "0.2"),
            *("--references", str(tmp_path / "references"), "--out", str(tmp_path / "out")),
        ]
    )
    rows = json.loads((tmp_path / "out" / "combine.json").read_text())["rows"]
    assert len(rows) == 4 and len({row["method"] for row in rows} | {rows[0]["best"]}) == 3
    for row in rows:
        assert row["relMSE / best"] * row["MSE / best"] >= 1
        assert row["relMSE with the best / best"] > 0 and row["share"] in (0.15, 0.5)
    with pytest.raises(SystemExit):
        module("run").main(["combine", "--shares", "1.5"])
    assert "1.5 is not a number below 1" in capsys.readouterr().err


@pytest.mark.long
def test_whether_bdpm_auto_is_behind(tmp_path, module):
    """A row a scene and time, random rooms among them, with what was chosen; shares over all."""
    scene = tmp_path / "tiny.xml"
    scene.write_text(TINY)
    module("run").main(
        [
            *("choice", "--scenes", str(scene), "--rooms", "1", "--times", "0.1", "0.2"),
            *("--integrators", "path", "bdpm_auto", "--reference-time", "0.2", "--scale", "0.1"),
            *("--references", str(tmp_path / "references"), "--out", str(tmp_path / "out")),
        ]
    )
    rows = json.loads((tmp_path / "out" / "choice.json").read_text())["rows"]
    asked = [(scene, t) for scene in ("tiny", "room00") for t in (0.1, 0.2)]
    assert [(row["scene"], row["seconds"]) for row in rows] == asked
    for row in rows:
        assert row["relMSE / best"] == max(1, row["relMSE / best path"])
        assert row["chosen"] in ("path", "bdpm", "bdpm_opt2", "bdpm_opt3")
    found = {row["ratio"]: row for row in module("experiments.choice").shares(rows)}
    of_path = [row["MSE / best path"] for row in rows]
    assert found["MSE / best path"]["largest"] == max(of_path)
    assert found["MSE / best path"]["<= 1.3"] == np.mean(np.array(of_path) <= 1.3)


def test_errors_below_the_noise_of_references_have_no_ratios(module):
    """Where a few bright pixels are noisy in the references, all errors may come out as zero."""
    choice = module("experiments.choice")
    ratio = {"relMSE / best path": 0.5, "MSE / best path": math.nan}
    row = {"scene": "s", "relMSE": 2.0, "MSE": 0.0, "artefacts": 0, **ratio}
    compared = [
        {**row, "method": "path", "relMSE": 4.0, "settings": ""},
        {**row, "method": "bdpm_auto", "settings": "choice=bdpm because"},
    ]
    rows = choice.judged(compared, 5.0, "")
    assert rows[0]["relMSE / best"] == 1 and math.isnan(rows[0]["MSE / best"])
    assert [found["ratio"] for found in choice.shares(rows)] == [
        "relMSE / best path",
        "relMSE / best",
    ]


def test_choice_counts_artefacts_beside_volpath_too(module):
    choice = module("experiments.choice")
    row = {"scene": "s", "relMSE": 2.0, "MSE": 1.0, "relMSE / best path": 0.5, "MSE / best path": 1}
    volpath = {**row, "method": "volpath:sampler=multijitter", "settings": "", "artefacts": 0.1}
    mine = {**row, "method": "bdpm_auto", "settings": "choice=bdpm because", "artefacts": 0.2}
    assert choice.judged([volpath, mine], 5.0, "")[0]["artefacts of path"] == 0.1
    # Without any of them they are counted nowhere.
    alone = {name: value for name, value in mine.items() if name != "artefacts"}
    assert math.isnan(choice.judged([alone], 5.0, "")[0]["artefacts of path"])


def test_random_rooms_are_the_same_each_time(module):
    rooms = module("common.rooms")
    assert rooms.room(3) == rooms.room(3) != rooms.room(4)


@pytest.mark.long
def test_published_forms_change_what_they_name(module):
    """Every form of the ladder: its plugin takes its parameters, and while it renders the
    integrator has the values that it names."""
    published, methods = module("experiments.published"), module("common.methods")
    changed = module("common.tuned").changed
    from mis_integrators.integrators import resampled_passes
    from mis_integrators.mis import resampling as bounded
    from mis_integrators.resampling import proposals

    seen = set()
    for label, (method, values) in published.LADDER.items():
        parsed = methods.parse_method(method)
        plugin = mi.load_dict({"type": parsed.plugin, **parsed.parameters})
        assert plugin.published == label.startswith("published")
        with changed(values):
            seen.add(
                (
                    resampled_passes.PublishedWeights,
                    resampled_passes.ResampledWeights,
                    resampled_passes.guessed_weight,
                    bounded.BLIND_SHARE,
                    bounded.LEAST_GAIN,
                    bounded.MOST_GAIN,
                    proposals.BLIND_SHARE,
                    proposals.UNIFORM_SHARE,
                )
            )
    # `published`, `bounded` and both with path densities change nothing; all others differ.
    assert len(seen) == len(published.LADDER) - 3
    assert signature(published.no_guess) == signature(resampled_passes.guessed_weight)
    forms = published.WithBounds, published.WithoutLengths
    assert resampled_passes.PublishedWeights not in forms


def test_common_noise_is_that_of_blocks(module):
    """Means of 8 x 8 pixels; what does not fill a block is left out."""
    published = module("experiments.published")
    image = np.zeros((17, 24, 3))
    image[:8, 8:16] = 2.0
    image[16] = 100.0
    blocks = published._blocks(image)
    assert blocks.shape == (2, 3, 3)
    assert np.array_equal(blocks[..., 0], [[0, 2, 0], [0, 0, 0]])


def test_distances_of_shifted_densities(module):
    """Zero for what is the same, and of the stretches only the primary samples follow the target's
    majorant."""
    rows = module("experiments.multiview").density_distances()
    assert len(rows) == 9
    for row in rows:
        assert 0 <= row["tentative"] <= 1 and row["tentative"] != row["real"]
        if row["stretch"] == "primary_sample":
            assert row["tentative"] < 0.02
        elif row["base majorant"] != pytest.approx(1.05):
            assert row["tentative"] > 0.1


def test_files_of_scenes_may_lie_anywhere(module, tmp_path):
    """Files are known by their place beside the scene's, wherever they are."""
    digests = module("common.scene_files").digests
    (tmp_path / "scene").mkdir()
    for name in ("scene/near.png", "far.png"):
        (tmp_path / name).write_bytes(name.encode())
    file = tmp_path / "scene/scene.xml"
    names = "near.png", "../far.png", str(tmp_path / "far.png")
    strings = "".join(f'<string name="filename" value="{name}"/>' for name in names)
    file.write_text(f'<scene version="3.0.0">{strings}</scene>')
    assert sorted(digests(file)) == ["../far.png", "near.png", "scene.xml"]
