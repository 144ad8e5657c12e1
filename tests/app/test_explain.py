"""`--explain`: what rendered, and why."""

import io

from mis_integrators.app.explain import explanation

import rich.console
from test_cli import SCENE, render


def text(parts):
    """What a wide terminal shows of them."""
    console = rich.console.Console(width=200, file=io.StringIO())
    for part in parts:
        console.print(part)
    return console.file.getvalue()


def test_candidates_and_what_was_found_out():
    """All of it by the settings of a session; what the user gave is not repeated."""
    settings = {
        "integrator": "bdpm_auto",
        "choice": "path",
        "choice.because.1": "path: least predicted error",
        "choice.relmse.path": 0.0125,
        "choice.mse.path": 0.25,
        "choice.relmse.bdpm": 4.0,
        "left_out": "photons",
        "seed": 3,
    }
    shown = text(explanation(settings, {"integrator": "bdpm_auto", "seed": 3}))
    lines = shown.splitlines()
    (chosen,) = [line for line in lines if "renders" in line]
    assert "path" in chosen and "0.0125" in chosen and "0.25" in chosen
    assert any("bdpm " in line and "4" in line for line in lines)
    assert "least predicted error" in shown and "photons" in shown and "seed" not in shown


def test_the_command(tmp_path, rgb, capfd):
    """One candidate, and no light for photons: the reason, and what was left out."""
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    arguments = (scene, "-o", tmp_path / "a.exr", "-i", "bdpm_auto", "--spp", 2, "--explain")
    assert render(*arguments) == 0
    said = capfd.readouterr().err
    assert "left_out" in said and "path: " in said


def test_nothing_to_tell():
    assert explanation({"integrator": "bdpt"}, {"integrator": "bdpt"}) == []
