"""The documentation: its code runs, its commands are understood, its tables are those of the
docstrings, and these say what plugins take; its links and pictures exist."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from mis_integrators import _plugins
from mis_integrators.app import options

import mitsuba as mi
import pytest
import site_files

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
OTHERS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    ROOT / "benchmarks" / "README.md",
    ROOT / "scenes" / "README.md",
    ROOT / "notebooks" / "tutorial.ipynb",
]
OWN_PAGE = {"bdpm_opt2": "bdpm_opt", "bdpm_opt3": "bdpm_opt"}


def blocks(page: Path, language: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess:
    """Run a process in a folder, with this checkout's package and without a display."""
    return subprocess.run(
        arguments,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"},
    )


@pytest.mark.long
def test_notebook_runs(tmp_path):
    """Its cells one after the other, as Jupyter would run them; the tutorial's page has the same
    blocks."""
    pytest.importorskip(
        "matplotlib", reason="the tutorial draws a figure: pip install 'mis-integrators[bench]'"
    )
    cells = [
        cell
        for cell in json.loads((ROOT / "notebooks" / "tutorial.ipynb").read_text())["cells"]
        if cell["cell_type"] == "code"
    ]
    code = ["".join(cell["source"]) for cell in cells]
    assert (
        code == [block.strip("\n") for block in blocks(ROOT / "docs" / "tutorial.md", "python")]
        and len(code) > 4
    )
    result = run([sys.executable, "-c", "\n\n".join(code)], tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert "(64, 64, 3)" in result.stdout and result.stdout.count("relMSE without") == 3
    assert (tmp_path / "tutorial.png").stat().st_size > 10_000
    assert (
        run([sys.executable, str(ROOT / "tools" / "notebook.py"), "--check"], tmp_path).returncode
        == 0
    )


def test_commands_of_the_tutorial_run(tmp_path):
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    commands = [
        line for block in blocks(ROOT / "docs" / "tutorial.md", "sh") for line in block.splitlines()
    ]
    assert len(commands) == 2
    for command in commands:
        program, *arguments = command.split()
        assert program == "mis-render"
        result = run([sys.executable, "-m", "mis_integrators", "render", *arguments], tmp_path)
        assert result.returncode == 0, result.stderr
    assert (tmp_path / "caustics.exr").exists() and (tmp_path / "final.png").exists()


def commands(program: str) -> list[list[str]]:
    """The arguments of all command lines of a program in the pages: in lines of their own,
    indented, or within a text."""
    inline, own_line = rf"`{program} ([^`]+)`", rf"^    {program} (.*?)(?: {{3,}}#.*)?$"
    texts = [page.read_text() for page in [*PAGES, *OTHERS]]
    found = [
        match.split()
        for text in texts
        for pattern in (inline, own_line)
        for match in re.findall(pattern, text, re.MULTILINE)
    ]
    return [arguments for arguments in found if not {"SUB-COMMAND", "--help"} & set(arguments)]


def named(argument: str) -> str:
    """What a reader would write for it."""
    if argument.endswith(".xml"):
        return str(ROOT / "scenes" / "door.xml")
    return "path" if argument == "..." else argument


def test_commands_of_the_pages_are_understood(module):
    """Every option is one that there is, with a value that it takes; nothing is run."""
    benchmarks, renders = commands(r"python benchmarks/run\.py"), commands("mis-render")
    assert len(benchmarks) > 12 and len(renders) > 8
    parser = module("run")._parser()
    for arguments in benchmarks:
        parser.parse_args([named(argument) for argument in arguments])
    for arguments in renders:
        options.parse(
            arguments
            if any(argument.endswith(".xml") for argument in arguments)
            else ["scene.xml", *arguments]
        )


def test_strategy_of_the_documentation_works(tmp_path):
    """The page's integrator, its comparison with `path`, and its refusal."""
    code = "\n\n".join(blocks(ROOT / "docs" / "adding_a_strategy.md", "python"))
    assert code.count("assert ") == 2
    result = run([sys.executable, "-c", code], tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]


def test_every_plugin_has_a_page(rgb):
    """With its name in the title, a picture, equations, every parameter that it knows, and a line
    in the index."""
    index = (ROOT / "docs" / "README.md").read_text()
    for plugin in _plugins.PLUGINS:
        page = ROOT / "docs" / f"{OWN_PAGE.get(plugin, plugin)}.md"
        text = page.read_text()
        assert (
            f"`{plugin}`" in text.splitlines()[0]
            and f"({page.name})" in index
            and f"`{plugin}`" in index
        )
        assert re.search(r"^!\[.+\]\(images/", text, re.MULTILINE), page
        assert len(re.findall(r"^    .*[=:] .*\S", text, re.MULTILINE)) >= 1 or re.search(
            r"\w_?i?\^?2? = ", text
        ), page
        for name in mi.load_dict({"type": plugin}).settings():
            assert name == "integrator" or f"`{name}`" in text, (plugin, name)


@pytest.mark.parametrize("plugin", sorted(set(_plugins.PLUGINS) - set(OWN_PAGE)))
def test_docstrings_say_what_plugins_take(rgb, monkeypatch, plugin):
    """All parameters and no others, with the defaults that they have."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    from parameter_tables import parameters

    made = mi.load_dict({"type": plugin})
    rows = parameters(type(made).__doc__)
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": plugin, "nonsense": 1})
    assert (
        ", ".join(sorted(", ".join(name for name, *_ in rows).split(", ")))
        == str(error.value).strip().rpartition("allowed are: ")[2]
    )
    for name, kind, text in rows:
        default = re.search(r"\(Default: (?:yes, i\.e\. |no, i\.e\. )?(.*)\)$", text)
        assert default or not kind, name
        if default:
            value = made.settings()[name]
            shown = (
                str(value).lower()
                if isinstance(value, bool)
                else f"{value:g}"
                if isinstance(value, float)
                else str(value)
            )
            assert default[1].strip("`") == shown, name
            assert kind == {bool: "bool", int: "int", float: "float", str: "string"}[type(value)]


def test_tables_are_those_of_the_docstrings():
    result = run([sys.executable, str(ROOT / "tools" / "parameter_tables.py"), "--check"], ROOT)
    assert result.returncode == 0, result.stdout


def test_tables_are_those_of_the_history():
    """Recorded figures, and the command that writes them."""
    script = ROOT / "tools" / "history_tables.py"
    result = run([sys.executable, str(script), "--check"], ROOT)
    assert result.returncode == 0, result.stdout
    assert any("<!-- rows: " in page.read_text() for page in PAGES)


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    """Files that exist, and headings of those that are named."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("http"):
            continue
        name, _, heading = target.partition("#")
        file = page.parent / name if name else page
        assert file.exists(), f"{page.name}: {target}"
        if heading:
            slugs = {
                re.sub(r"[^\w -]", "", line.lstrip("# ").lower()).strip().replace(" ", "-")
                for line in file.read_text().splitlines()
                if line.startswith("#")
            }
            assert heading in slugs, f"{page.name}: {target}"


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: str(page.relative_to(ROOT)))
def test_merges_are_finished(page):
    """No marks of a merge are left."""
    assert not re.search("^(<{7}|={7}$|>{7})", page.read_text(), re.MULTILINE)


def test_index_names_every_page():
    index = (DOCS / "README.md").read_text()
    names = {page.relative_to(DOCS).as_posix() for page in PAGES} - {"README.md"}
    assert [name for name in sorted(names) if f"({name})" not in index] == []


def test_site_has_every_page():
    """Each page of the repository is in the site's navigation, once, and what it links to is one of
    the site's files."""
    files = site_files.site_files()
    in_navigation = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(in_navigation) == [file for file in files if file.endswith(".md")]
    assert {"docs/images/house.svg", "mis_integrators/core/sequences.py", "LICENSE"} <= set(files)


def test_the_path_through_the_code_is_true():
    """Each file of the page is there and defines the function or class that is named beside it."""
    page = (ROOT / "docs" / "a_path_through_the_code.md").read_text()
    named = re.findall(r"\| `([\w/]+\.py)` \| `(\w+)` \|", page)
    named += re.findall(r"`([\w/]+\.py)`, `(\w+)`", page)
    assert len(named) >= 20
    for file, name in named:
        source = (ROOT / "mis_integrators" / file).read_text()
        assert re.search(rf"^\s*(def|class) {name}\b", source, re.MULTILINE), (file, name)
    for file in re.findall(r"`([\w/]+\.py)`", page):
        folder = ROOT if file.startswith("tests/") else ROOT / "mis_integrators"
        assert (folder / file).exists(), file
