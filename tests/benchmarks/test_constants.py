"""The table of tuned constants says what stands in the code, and changing one reaches all who read
it."""

import ast

from mis_integrators.photons import frozen, gather
from mis_integrators.pilot import radius

from common import tuned
from experiments import constants

ALLOWED = {
    "pilot/bias.py": {"LEAST_BIAS"},
}
"""Defaults that callers overrule wherever it matters."""


def test_page_is_up_to_date():
    assert constants.PAGE.read_text() == constants.page(), "run.py constants --page prints it anew"


def test_constants_are_found_with_their_meaning():
    found = {constant.key: constant for constant in tuned.tuned_constants()}
    assert found["pilot.radius.LARGEST_SHARE"].value == radius.LARGEST_SHARE
    assert all(constant.meaning for constant in found.values())
    assert {"pilot.bias.LEAST_BIAS", "pilot.bias.MOST_BIAS"} <= set(found)


def test_every_importer_sees_a_change():
    """`frozen` imports what `gather` defines."""
    before = gather.SAME_SURFACE_COSINE
    with tuned.changed({"photons.gather.SAME_SURFACE_COSINE": 0.25}):
        assert gather.SAME_SURFACE_COSINE == frozen.SAME_SURFACE_COSINE == 0.25
    assert gather.SAME_SURFACE_COSINE == frozen.SAME_SURFACE_COSINE == before


def test_nothing_is_computed_from_them_before_they_can_change():
    """Values at the top of modules, and defaults of functions, would keep what they were."""
    names = {constant.name for constant in tuned.tuned_constants()}
    for path in tuned.PACKAGE.rglob("*.py"):
        early = []
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                early += [*node.args.defaults, *filter(None, node.args.kw_defaults)]
            elif isinstance(node, ast.Module):
                early += [part.value for part in node.body if isinstance(part, ast.Assign)]
        read = {part.id for node in early for part in ast.walk(node) if isinstance(part, ast.Name)}
        allowed = ALLOWED.get(path.relative_to(tuned.PACKAGE).as_posix(), set())
        assert not (read & names) - allowed, path


def test_every_method_judges_something():
    keys = [constant.key for constant in tuned.tuned_constants()]
    for place in constants.METHODS:
        assert any(key.startswith(place) for key in keys), place


def test_halves_and_doubles():
    """Whole numbers stay whole; shares above one half stay below one."""
    of = {value: tuned.Constant("m", "N", value, "") for value in (1, 4, 0.8, 0.2, (1, 2))}
    assert of[4].halved() == 2 and of[4].doubled() == 8
    assert of[1].halved() is None and of[(1, 2)].doubled() is None
    assert of[0.2].halved() == 0.1 and of[0.2].doubled() == 0.4
    assert abs(of[0.8].halved() - 0.6) < 1e-12 and abs(of[0.8].doubled() - 0.9) < 1e-12
