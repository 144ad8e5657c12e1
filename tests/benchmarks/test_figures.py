"""`make figures`: the page of results says what stands in its file of figures, and a part that is
measured anew leaves the others as they were."""

import json
import re
import shlex
from pathlib import Path

import pytest
from test_benchmarks import TINY

MACHINE = {"commit": "abc", "date": "2026-01-02 03:04", "threads": 2, "processor": "Any"}
WRITTEN_BY_HAND = {"0.1"}
"""The only figure with a point outside of the tables: the share of pixels that is left out."""


def entry(command, rows, **more):
    return {"command": command, "machine": MACHINE, "rows": rows, **more}


def compared(*ratios):
    """Rows of `compare` with these errors over that of the better path."""
    labels = "path", "path:sampler=multijitter", "bdpm:bdd=0"
    names = "relMSE / best path", "MSE / best path"
    return [
        {"method": label, **dict.fromkeys(names, ratio)} for label, ratio in zip(labels, ratios)
    ]


@pytest.fixture
def figures(module):
    return module("experiments.figures")


@pytest.fixture
def results(module):
    return module("report.results")


def test_page_is_up_to_date(figures, results):
    """The tables are those of the figures, and stand between markers; no other part of the page has
    a figure. `run.py figures --page` writes it anew."""
    text, kept = figures.PAGE.read_text(), json.loads(figures.FIGURES.read_text())
    assert results.page(text, kept) == text
    assert list(results.TABLES) == list(figures.PARTS)
    for name in results.TABLES:
        begin, end = map(re.escape, results.markers(name))
        text = re.sub(f"{begin}.*?{end}", "", text, flags=re.DOTALL)
    assert set(re.findall(r"\d*\.\d+", text)) == WRITTEN_BY_HAND
    assert not re.search(r"^\|.*\| *\d", text, re.MULTILINE)


def test_a_figure_that_changes_changes_the_page(figures, results):
    text, kept = figures.PAGE.read_text(), json.loads(figures.FIGURES.read_text())
    kept["compare10"]["door"]["rows"][2]["relMSE / best path"] = 77.0
    assert "| 77.00 (" in results.page(text, kept)
    del kept["compare10"]
    begin, end = results.markers("compare10")
    assert f"{begin}\n\n{results.NOT_YET}\n\n{end}" in results.page(text, kept)
    with pytest.raises(ValueError, match="no place for compare10"):
        results.page(text.replace(begin, ""), kept)


def test_ratios_and_means_of_the_table(results):
    """The better `path` is what ratios are to; that of both samplers is the first column."""
    table = results.ten_seconds(
        {
            "b": entry("compare", compared(2.0, 1.0, 0.04)),
            "a": entry("compare", compared(1.0, 1.5, 4.0)),
            "cbox_empty_point": entry("compare", compared(1.0, 1.5, None)),
        }
    ).splitlines()
    assert table[0].split(" | ")[-1] == "`bdpm`, `bdd=0` |"
    assert table[2] == "| `a` | 1.50 (1.50) | 4.00 (4.00) |"
    assert table[3] == "| `b` | 0.50 (0.50) | 0.040 (0.040) |"
    assert table[4].startswith("| SmallVCM's") and table[4].endswith("| - (-) |")
    assert table[5] == "| geometric mean of 3 | 1.04 (1.04) | 0.40 (0.40) |"


def test_ratios_in_media_are_to_volpath(results):
    rows = compared(2.0, 1.0, 0.04)
    for row in rows[:2]:
        row["method"] = f"vol{row['method']}"
    table = results.in_media({"fog": entry("compare", rows)}).splitlines()
    assert table[0].startswith("| 20 s, in media | `multijitter` over `independent` | `bdpm`")
    assert table[2] == "| `fog` | 0.50 (0.50) | 0.040 (0.040) |"


def test_how_far_the_choice_is_behind(results):
    """A row for each time; a room is behind from a twentieth on."""
    ratios = {1: [(1.2, 0.25), (0.3, 1.0)], 20: [(1.04, 1.06)]}
    rows = [
        {"seconds": time, "relMSE / best path": a, "MSE / best path": b, "chosen": chosen}
        for time, pairs in ratios.items()
        for (a, b), chosen in zip(pairs, ("path", "bdpm"))
    ]
    first, last = results.choice({"room": entry("choice", rows)}).splitlines()[2:]
    assert first == "| 1 s | 1 | 0.60 | 1.20 | 1 of 2 | 0.50 | 1.00 | 0 of 2 |"
    assert last == "| 20 s | 0 | 1.04 | 1.04 | 0 of 1 | 1.06 | 1.06 | 1 of 1 |"


@pytest.mark.parametrize(
    "value, text",
    [(0.8, "0.80"), (0.0221, "0.022"), (0.000339, "0.00034"), (12.469, "12.47"), (-0.02, "-0.02")]
    + [(None, "-"), (float("nan"), "-"), (0.0, "0")],
)
def test_figures_have_two_digits(results, value, text):
    assert results.short(value) == text


def test_stamps_name_what_measured_each_scene(results):
    """One line where all scenes are of one run; else the scenes of each."""
    same = {name: entry("compare --time 10", []) for name in "ab"}
    line = "Commit `abc`, 2026-01-02, 2 threads of Any."
    assert results.stamps(same) == f"    python benchmarks/run.py compare --time 10\n\n{line}"
    newer = {**MACHINE, "commit": "def"}
    text = results.stamps({**same, "c": {**same["a"], "machine": newer}})
    assert "`a`, `b`: commit `abc`" in text and "`c`: commit `def`" in text


def test_every_part_is_a_command(figures, module):
    """With options that there are; its scenes are bundled ones, or those that are given."""
    parse = module("run")._parser().parse_args
    bundled = module("common.scene_files").bundled()
    elsewhere = [Path("elsewhere/scene.xml")]
    for name, part in figures.PARTS.items():
        options = parse(part.command.split())
        assert len(part.scenes(bundled)) in (1, 2, 5, 9), name
        assert (elsewhere[0] in part.scenes([*bundled, *elsewhere])) == (
            name in ("compare10", "denoised10", "parsimony", "throughput", "media20")
        )
        path = "volpath" if part.own else "path"
        for label in (path, "bdpm_auto") if hasattr(options, "denoise") else ():
            assert label in [method.label for method in options.integrators]
    assert [path.stem for path in figures.PARTS["charts"].scenes(bundled)] == ["caustics", "door"]


def test_a_part_measured_anew_leaves_the_others(figures, module, tmp_path, monkeypatch, capsys):
    """Its own stamp and figures are new; scenes and parts that were not measured stay. What cannot
    be measured is named in the end, and the rest is kept."""
    parse = module("run")._parser().parse_args
    kept = tmp_path / "results.json"
    kept.write_text(
        json.dumps(
            {
                "compare10": {"door": entry("old", compared(1, 1, 0.5))},
                "denoised10": {name: entry("old", []) for name in ("door", "elsewhere")},
            }
        )
    )
    (tmp_path / "results.md").write_text(figures.PAGE.read_text())

    def measure(part, path, options, out):
        if path.stem == "sds":
            raise SystemExit("no method can render it")
        return [{**dict.fromkeys(part.columns, 0.123456), "method": "bdpm_auto", "unknown": 1}]

    monkeypatch.setattr(figures, "measure", measure)
    monkeypatch.setattr(figures, "machine", lambda: {**MACHINE, "commit": "new"})
    scenes = [str(figures.BUNDLED / f"{name}.xml") for name in ("door", "sds")]
    options = ["--file", str(kept), "--scenes", *scenes, "--only", "denoised10", "throughput"]
    with pytest.raises(SystemExit, match="denoised10, sds: no method can render it"):
        figures.run(parse(["figures", *options]))
    found = json.loads(kept.read_text())
    assert found.keys() == {"compare10", "denoised10"}
    assert found["compare10"]["door"]["machine"] == MACHINE
    assert found["denoised10"].keys() == {"door", "elsewhere"}
    assert found["denoised10"]["elsewhere"]["machine"] == MACHINE
    new = found["denoised10"]["door"]
    assert new["machine"]["commit"] == "new" and new["rows"][0]["denoised relMSE"] == 0.1235
    assert "unknown" not in new["rows"][0] and new["command"].startswith("compare --denoise")
    with pytest.raises(SystemExit, match="needs a --file of its own"):
        figures.run(parse(["figures", "--time", "1"]))


def test_make_figures_runs_the_command(figures):
    """The page names it, and the Makefile installs what it needs."""
    recipe = (figures.PAGE.parents[1] / "Makefile").read_text()
    body = re.search(r"^figures:.*\n((?:\t.*\n)+)", recipe, re.MULTILINE)[1]
    assert "[bench,denoise]" in body and "benchmarks/run.py figures" in body
    assert "    make figures\n" in figures.PAGE.read_text()


@pytest.mark.extended
def test_figures_of_one_small_scene(module, figures, tmp_path):
    """The whole way, small: a part of a scene from elsewhere, with its own references; the page has
    its row, and the figures name no folder of this machine."""
    scene = tmp_path / "tiny.xml"
    scene.write_text(TINY)
    (tmp_path / "results.md").write_text(figures.PAGE.read_text())
    module("run").main(
        shlex.split(
            f"figures --only compare10 --scenes {scene} --time 0.2 --reference-time 0.2 "
            f"--references {tmp_path}/references --out {tmp_path}/out "
            f"--file {tmp_path}/results.json"
        )
    )
    found = json.loads((tmp_path / "results.json").read_text())["compare10"]["tiny"]
    assert len(found["rows"]) == 6 and found["wall_seconds"] > 1.2
    assert min(row["relMSE / best path"] for row in found["rows"][:2]) == 1
    assert str(tmp_path) not in json.dumps(found)
    assert "| `tiny` | " in (tmp_path / "results.md").read_text()
