"""The package's tuned constants: numbers that could be others without anything being wrong.

A tuned constant is an upper-case name at the top level of a module whose docstring starts with
``Tuned:``. What is a limit, a tolerance, the format of a file or a matter of memory is not one.
"""

from __future__ import annotations

import ast
import importlib
import itertools
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mis_integrators

PACKAGE = Path(mis_integrators.__file__).parent
MARK = "Tuned:"


@dataclass(frozen=True)
class Constant:
    """A tuned constant as it stands in the code."""

    module: str
    """Relative to the package, such as ``pilot.radius``."""
    name: str
    value: float | tuple
    meaning: str

    @property
    def key(self) -> str:
        return f"{self.module}.{self.name}"

    def halved(self) -> float | int | None:
        return self._scaled(0.5)

    def doubled(self) -> float | int | None:
        return self._scaled(2)

    def _scaled(self, factor: float) -> float | int | None:
        """The value times `factor`; for shares above one half what is left to one is scaled.
        ``None`` where that means nothing: tuples, and whole numbers that do not change."""
        if isinstance(self.value, tuple):
            return None
        if isinstance(self.value, int):
            scaled = max(round(self.value * factor), 1)
            return None if scaled == self.value else scaled
        if 0.5 < self.value < 1:
            return 1 - (1 - self.value) / factor
        return self.value * factor


def tuned_constants() -> list[Constant]:
    """All of them, by module and line."""
    return [
        constant
        for path in sorted(PACKAGE.rglob("*.py"))
        for constant in _in_module(path, ".".join(path.relative_to(PACKAGE).with_suffix("").parts))
    ]


def _in_module(path: Path, module: str) -> Iterator[Constant]:
    body = ast.parse(path.read_text()).body
    for statement, following in itertools.pairwise(body):
        text = _docstring(following)
        if isinstance(statement, ast.Assign) and text.startswith(MARK):
            meaning = " ".join(text.removeprefix(MARK).split())
            for name, value in _names_and_values(statement):
                yield Constant(module, name, value, meaning)


def _docstring(statement: ast.stmt) -> str:
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return str(statement.value.value)
    return ""


def _names_and_values(statement: ast.Assign) -> Iterator[tuple[str, float | tuple]]:
    """``A, B = 1, 2`` are two constants, ``A = 1, 2`` is one."""
    target, value = statement.targets[0], statement.value
    number = eval(compile(ast.Expression(value), "constant", "eval"))
    if isinstance(target, ast.Tuple):
        yield from zip((name.id for name in target.elts), number)
    else:
        yield target.id, number


@contextmanager
def changed(values: Mapping[str, object]) -> Iterator[None]:
    """While this lasts, the constants of these keys have other values, in every module of the
    package that has imported them."""
    undo = []
    for key, value in values.items():
        module, _, name = key.rpartition(".")
        original = getattr(importlib.import_module(f"mis_integrators.{module}"), name)
        for holder in _holders(module, name, original):
            undo.append((holder, name, original))
            setattr(holder, name, value)
    try:
        yield
    finally:
        for holder, name, original in undo:
            setattr(holder, name, original)


def _holders(module: str, name: str, original: object) -> list:
    """Modules of the package where `name` is the constant of `module`: its own, and those that
    import it from there."""
    own = f"mis_integrators.{module}"
    found = [sys.modules[own]]
    for other, loaded in list(sys.modules.items()):
        if other.startswith("mis_integrators.") and other != own and loaded is not None:
            path = getattr(loaded, "__file__", None)
            if path and _imports(Path(path), module.rpartition(".")[2], name):
                found.append(loaded)
    return [holder for holder in found if getattr(holder, name, None) is original]


def _imports(path: Path, module: str, name: str) -> bool:
    return any(
        isinstance(node, ast.ImportFrom)
        and (node.module or "").rpartition(".")[2] == module
        and any(alias.name == name for alias in node.names)
        for node in ast.walk(ast.parse(path.read_text()))
    )
