"""Read JSON that anyone may have written: headers of images, checkpoints. Every value has a type
and a range; whatever else is there is refused."""

from __future__ import annotations

import errno
import json
import os
import stat
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

LONGEST_JSON = 1 << 24
"""Characters of a JSON text that is read, at most."""
LONGEST_TEXT = 4096
"""Characters of a text inside it, at most."""
LONGEST_SHOWN = 200
"""Characters of a refused value that a message shows, at most."""


class Malformed(ValueError):
    """A value that is missing, of the wrong type or out of range; the message says in one line
    which, and what is allowed."""


def open_regular(path: Path) -> BinaryIO:
    """Open a file to read bytes. Raises ``OSError``, also for what is not a regular file: opening a
    FIFO would wait for its writer."""
    file = open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return file


def parse(text: object, what: str) -> Any:
    """The value of a JSON text; ``what`` it is of is named in messages. Raises ``Malformed``."""
    if not isinstance(text, str):
        raise Malformed(f"{what} is no text")
    if len(text) > LONGEST_JSON:
        raise Malformed(f"{what} is longer than {LONGEST_JSON} characters")
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise Malformed(f"{what} is no JSON: {' '.join(str(error).split())}") from None


def shown(value: object) -> str:
    """A value for a message: short, and without characters that a terminal would act on."""
    if isinstance(value, int) and abs(value) > 10**18:
        return "an integer of too many digits"
    text = value if isinstance(value, str) else repr(value)
    text = text if text.isprintable() else repr(text)
    return text if len(text) <= LONGEST_SHOWN else text[:LONGEST_SHOWN] + "..."


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number")


class Fields:
    """The fields of a JSON object: each is asked for by its name, type and range, and ``finish``
    refuses those that were not asked for.

    All methods raise ``Malformed``.
    """

    def __init__(self, value: object, what: str):
        if not isinstance(value, dict):
            raise Malformed(f"{what} is not a JSON object")
        self._given: dict[str, Any] = value
        self._what = what
        self._asked: set[str] = set()

    def _get(self, name: str) -> Any:
        self._asked.add(name)
        if name not in self._given:
            raise Malformed(f'{self._what}: "{name}" is missing')
        return self._given[name]

    def refuse(self, name: str, allowed: str) -> Malformed:
        """The error that the value of a field is not ``allowed``."""
        return Malformed(
            f'{self._what}: "{name}" = {shown(self._given.get(name))} is not allowed: expected '
            f"{allowed}"
        )

    def any(self, name: str) -> Any:
        """Any value: for what is only compared."""
        return self._get(name)

    def integer(self, name: str, low: int, high: int) -> int:
        """An integer from ``low`` to ``high``."""
        value = self._get(name)
        if type(value) is not int or not low <= value <= high:
            raise self.refuse(name, f"an integer from {low} to {high}")
        return value

    def number(self, name: str, most: float = sys.float_info.max, least: float = 0.0) -> float:
        """A number from ``least`` to ``most``."""
        value = self._get(name)
        if not is_number(value) or not least <= value <= most:
            raise self.refuse(name, f"a number from {least:g} to {most:g}")
        return float(value)

    def boolean(self, name: str) -> bool:
        """True or false."""
        value = self._get(name)
        if type(value) is not bool:
            raise self.refuse(name, "true or false")
        return value

    def text(self, name: str) -> str:
        """A text that can be printed as it is."""
        value = self._get(name)
        if not is_text(value):
            raise self.refuse(name, f"printable text of at most {LONGEST_TEXT} characters")
        return value

    def texts(self, name: str) -> list[str]:
        """A list of such texts."""
        value = self._get(name)
        if not isinstance(value, list) or not all(map(is_text, value)):
            raise self.refuse(name, "a list of printable texts")
        return value

    def choice(self, name: str, allowed: Iterable[Any]) -> Any:
        """One of the values that are ``allowed``."""
        value, allowed = self._get(name), list(allowed)
        if not any(type(value) is type(one) and value == one for one in allowed):
            raise self.refuse(name, "one of " + ", ".join(json.dumps(one) for one in allowed))
        return value

    def assignments(self, name: str, of_variables: bool = False) -> list[tuple[str, str]]:
        """A list of pairs of a name and a printable text: names of parameters are words, those of a
        scene's variables anything that can stand before ``=``."""
        value, is_name = self._get(name), is_printable_name if of_variables else is_word
        if not isinstance(value, list) or not all(
            isinstance(pair, list) and len(pair) == 2 and is_name(pair[0]) and is_text(pair[1])
            for pair in value
        ):
            raise self.refuse(name, "a list of pairs [name, text]")
        return [(first, second) for first, second in value]

    def object(self, name: str) -> Fields:
        """The fields of an object inside this one."""
        value = self._get(name)
        if not isinstance(value, dict):
            raise self.refuse(name, "an object")
        return Fields(value, f'{self._what}: "{name}"')

    def names(self) -> list[str]:
        """The names that are given."""
        return list(self._given)

    def finish(self) -> None:
        """Refuse what was given but not asked for."""
        if unknown := [name for name in self._given if name not in self._asked]:
            raise Malformed(f'{self._what}: "{shown(unknown[0])}" does not belong there')


def is_number(value: object) -> bool:
    """Whether a JSON value is a finite number."""
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and abs(value) <= sys.float_info.max
    )


def is_text(value: object) -> bool:
    """Whether a JSON value is text that can be printed as it is."""
    return isinstance(value, str) and len(value) <= LONGEST_TEXT and value.isprintable()


def is_word(value: object) -> bool:
    """Whether a JSON value is a word of letters, digits, ``_`` and ``.``."""
    return isinstance(value, str) and value.isascii() and value.replace(".", "_").isidentifier()


def is_printable_name(value: object) -> bool:
    """Whether a JSON value can stand before ``=``."""
    return is_text(value) and bool(value) and "=" not in str(value)
