"""How the benchmarks are laid out: `report` draws what it is given, and nothing imports in a
circle."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2] / "benchmarks"
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path
    for path in ROOT.rglob("*.py")
    if path.name != "__init__.py"
}


def imports(name: str) -> set[str]:
    """The benchmarks' modules that a module imports, within functions too."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found & MODULES.keys()


def packages(*names: str) -> set[str]:
    """The packages that the modules of these packages import."""
    mine = [name for name in MODULES if name.partition(".")[0] in names]
    return {other.partition(".")[0] for name in mine for other in imports(name)}


def test_report_measures_nothing():
    assert len(MODULES) > 25
    assert packages("common") == {"common"}
    assert packages("report") == {"common", "report"}
    assert packages("experiments") == {"common", "experiments", "report"}


def test_nothing_imports_in_a_circle():
    TopologicalSorter({name: imports(name) for name in MODULES}).prepare()
