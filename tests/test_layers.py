"""Which package of the house may import which, and that its picture says so."""

import subprocess
import sys
from pathlib import Path

import house
import pytest

ROOT = Path(__file__).parents[1]
ONLY = {
    "weights": {"weights"},
    "core": {"core"},
    "analysis": {"analysis"},
    "pilot": {"pilot"},
}
"""Packages that import nothing of the house but these: pure functions, the ground of all others,
what judges images without rendering any, and what chooses radii from estimates that it is given."""
TRACING = {"lights", "paths", "photons", "resampling"}
NOT = {
    **{name: {"mis", "pilot", "integrators", "app", "volume"} for name in TRACING},
    "mis": {"integrators", "pilot", "app"},
    "volume": {"mis", "pilot", "integrators", "app"},
}
"""Packages, and what they do not import: how paths are made knows no weights, and neither knows the
plugins."""
WITHOUT_MITSUBA = {"weights", "analysis", "pilot"}
MAY_IMPORT_PLUGINS = {"mis_integrators", "mis_integrators._plugins"}
"""Modules outside `integrators` that may import a module of it: a plugin class belongs to the
variant in which it was registered, and they register it."""
EXCEPTIONS: dict[tuple[str, str], str] = {}
"""Imports that break a rule, with the reason why they may: `(module, imported)`."""


def breaks_a_rule(module: str, other: str) -> bool:
    mine, its = house.package_of(module), house.package_of(other)
    if its is None:
        return mine in WITHOUT_MITSUBA and other.partition(".")[0] == "mitsuba"
    if its == "integrators" and mine != "integrators" and module not in MAY_IMPORT_PLUGINS:
        return True
    return its not in ONLY.get(mine, {its}) or its in NOT.get(mine, ())


def test_every_import_is_allowed():
    """But for the exceptions, of which none may be left over."""
    assert {pair for pair in house.statements() if breaks_a_rule(*pair)} == EXCEPTIONS.keys()


def test_rules_are_about_packages_that_there_are():
    known = set(house.packages())
    assert len(known) > 10
    assert known >= ONLY.keys() | NOT.keys() | WITHOUT_MITSUBA | set().union(*NOT.values())
    assert set(house.modules()) >= MAY_IMPORT_PLUGINS


@pytest.mark.parametrize(
    "module, other",
    [
        ("weights.recursion", "core.random"),
        ("core.film", "paths.vertex"),
        ("core.film", "llvm"),
        ("paths.connect", "mis.heuristic"),
        ("mis.heuristic", "pilot.radius"),
        ("pilot.run", "core.random"),
        ("app.cli", "integrators.bdpm"),
        ("analysis.metrics", "app.loading"),
    ],
)
def test_what_is_not_allowed(module, other):
    assert breaks_a_rule(f"mis_integrators.{module}", f"mis_integrators.{other}")


def test_imports_are_read_wherever_they_stand(tmp_path):
    """Of modules and of names in them, by relative and by whole names, within functions too."""
    folder = tmp_path / "a"
    for name in ("b", "c"):
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").touch()
    (folder / "c" / "d.py").write_text("from . import e\nimport mitsuba as mi, a.b\n")
    (folder / "c" / "e.py").write_text("def f():\n    from ..c.d import x\n    from .. import b\n")
    (folder / "__init__.py").write_text("from .c import d\nfrom .c.e import f\n")
    known = house.modules(folder)
    found = {name: house.imports(name, path, known) for name, path in known.items()}
    assert found == {
        "a": {"a.c.d", "a.c.e"},
        "a.b": set(),
        "a.c": set(),
        "a.c.d": {"a.c.e", "mitsuba", "a.b"},
        "a.c.e": {"a.c.d", "a.b"},
    }


def test_picture_is_what_the_imports_say():
    subprocess.run([sys.executable, ROOT / "tools" / "house.py", "--check"], check=True, timeout=60)
