"""A stranger's scene: no library beside it, in the current folder or anywhere but in Mitsuba's own
folder is loaded."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from mis_integrators.app import loading

import mitsuba as mi
import pytest
from selection import extended

ROOT = Path(__file__).parents[2]
LIBRARY = """
#include <stdio.h>
#include <stdlib.h>
__attribute__((constructor)) static void run(void) {
    FILE *file = fopen(getenv("MARK"), "w");
    if (file) fclose(file);
}
"""
SUFFIX = next((Path(mi.__file__).parent / "plugins").iterdir()).suffix
SCENE = """<scene version="3.0.0">%s<integrator type="path"/>
  <sensor type="perspective"><sampler type="independent"/>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
  </sensor>
  <shape type="sphere"/><emitter type="constant"/></scene>"""


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    """A shared library that makes the file ``$MARK`` when it is loaded."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no compiler on this machine")
    folder = tmp_path_factory.mktemp("library")
    (folder / "mark.c").write_text(LIBRARY)
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-o", folder / "mark.so", folder / "mark.c"], check=True
    )
    return folder / "mark.so"


@pytest.fixture
def render(tmp_path, library):
    """Renders a scene in the folder ``scene`` by a process in the folder ``current``, with the
    library under the given names; returns what it said, and whether the library was loaded."""

    def render(scene: str, places: list[str], *arguments: str):
        for place in [*places, "scene/scene.xml", "current/nothing"]:
            (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        for place in places:
            shutil.copy(library, tmp_path / place)
        (tmp_path / "scene" / "scene.xml").write_text(scene)
        command = [
            sys.executable,
            "-m",
            "mis_integrators",
            "render",
            tmp_path / "scene" / "scene.xml",
            "--spp",
            "1",
            "-o",
            tmp_path / "a.exr",
        ]
        result = subprocess.run(
            [*command, *arguments],
            cwd=tmp_path / "current",
            capture_output=True,
            text=True,
            timeout=100,
            env={**os.environ, "PYTHONPATH": str(ROOT), "MARK": str(tmp_path / "mark")},
        )
        return result, (tmp_path / "mark").exists()

    return render


def test_library_would_be_loaded(tmp_path, library):
    """By Mitsuba alone: else the tests below show nothing."""
    (tmp_path / "plugins").mkdir()
    shutil.copy(library, tmp_path / "plugins" / f"independent{SUFFIX}")
    code = (
        "import mitsuba as mi; mi.set_variant('scalar_rgb'); mi.load_dict({'type': 'independent'})"
    )
    subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        env={**os.environ, "MARK": str(tmp_path / "mark")},
        timeout=100,
    )
    assert (tmp_path / "mark").exists()


@pytest.mark.parametrize(
    "plugin, folder",
    [
        ("independent", "scene"),
        ("path", "current"),
        ("merge", "scene"),
        *extended(
            *((name, "current") for name in ("independent", "merge")),
            *((name, "scene") for name in ("hdrfilm", "path", "sphere", "gaussian", "d65")),
        ),
    ],
)
def test_library_named_like_a_plugin_of_mitsuba(render, folder, plugin):
    """Mitsuba's own is used: of those that the scene names, and of those that Mitsuba or an
    integrator takes by itself. (All at once: below.)"""
    result, loaded = render(SCENE % "", [f"{folder}/plugins/{plugin}{SUFFIX}"], "-i", "bdpm_auto")
    assert result.returncode == 0 and not loaded, result.stderr


def test_libraries_named_like_all_plugins_of_mitsuba(render):
    names = [library.name for library in (Path(mi.__file__).parent / "plugins").iterdir()]
    result, loaded = render(
        SCENE % "",
        [f"{folder}/plugins/{name}" for folder in ("scene", "current") for name in names],
    )
    assert result.returncode == 0 and not loaded, result.stderr


@pytest.mark.parametrize(
    "plugin, folder",
    [
        ("nobodys", "scene"),
        ("bdpm", "current"),
        *extended(("nobodys", "current"), ("bdpt", "scene")),
    ],
)
def test_library_for_a_plugin_that_is_none_of_mitsubas(render, folder, plugin):
    """It is refused, also under the name of a plugin of this package, for which Mitsuba would load
    it."""
    result, loaded = render(
        SCENE.replace('type="sphere"', f'type="{plugin}"') % "",
        [f"{folder}/plugins/{plugin}{SUFFIX}"],
    )
    assert result.returncode == 1 and not loaded
    assert (
        f'is not loaded for the plugin "{plugin}"' in result.stderr
        and result.stderr.count("\n") == 1
    )


@pytest.mark.parametrize(
    "name", ["../evil", "sub/evil", "", "a b", *extended("../../evil", "evil.so", "év", "a\\b")]
)
def test_plugin_names_are_words(render, name):
    result, loaded = render(
        SCENE.replace('type="sphere"', f'type="{name}"') % "",
        [f"evil{SUFFIX}", f"scene/evil{SUFFIX}", f"scene/plugins/sub/evil{SUFFIX}"],
    )
    assert result.returncode == 1 and not loaded and result.stderr.count("\n") == 1
    assert "is not the name of a plugin" in result.stderr or "missing" in result.stderr, (
        result.stderr
    )


def test_name_of_the_replacement_is_a_word(render):
    result, loaded = render(SCENE % "", [f"scene/evil{SUFFIX}"], "-i", "../evil")
    assert (
        result.returncode == 1
        and not loaded
        and "'../evil' is not the name of a plugin" in result.stderr
    )


def test_included_files(render, tmp_path):
    """Their elements are looked at like the others, and folders that they have Mitsuba search are
    not trusted."""
    (tmp_path / "scene" / "sub").mkdir(parents=True)
    included = tmp_path / "scene" / "sub" / "more.xml"
    included.write_text(
        '<scene version="3.0.0"><path value="other"/><bsdf type="diffuse" id="grey"/></scene>'
    )
    places = [f"scene/{folder}/plugins/diffuse{SUFFIX}" for folder in ("sub", "other", "sub/other")]
    result, loaded = render(
        SCENE % '<include filename="sub/more.xml"/><path value="other"/>', places
    )
    assert result.returncode == 0 and not loaded, result.stderr
    included.write_text('<scene version="3.0.0"><bsdf type="../../evil"/></scene>')
    result, loaded = render(SCENE % '<include filename="sub/more.xml"/>', [f"evil{SUFFIX}"])
    assert result.returncode == 1 and not loaded and "is not the name of a plugin" in result.stderr


def test_folders_that_are_searched_stay(rgb, tmp_path):
    """Files of the scene are found as before, whatever was kept out."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / f"blackbody{SUFFIX}").write_text("no library")
    (tmp_path / "scene.xml").write_text(SCENE % "")
    before = [str(folder) for folder in mi.file_resolver()]
    try:
        loading.load(tmp_path / "scene.xml", {}, None, {})
        assert [str(folder) for folder in mi.file_resolver()] == [str(tmp_path), *before]
    finally:
        mi.file_resolver().clear()
        for folder in before:
            mi.file_resolver().append(folder)
