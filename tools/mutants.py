"""How many errors the tests find: makes each of `mutations.MUTATIONS` in a copy of the sources and
runs the tests that should find it.

    python tools/mutants.py                      # all of them, each with the tests named for it
    python tools/mutants.py --list               # their numbers and what they break
    python tools/mutants.py 3 17 --selection all # two of them, with what `make test-all` runs, too
    python tools/mutants.py --whole              # with all tests of the selection: hours

Before, the same tests run without any change: where they fail already, nothing would be found out.
The exit code is 1 where an error has survived or ran out of time, 2 where no verdict is possible.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from mutations import MUTATIONS, Mutation

ROOT = Path(__file__).resolve().parents[1]
SELECTIONS = {
    "quick": [],
    "default": ["-m", "not extended and not full"],
    "all": ["-m", "not full"],
}
"""Arguments of pytest: what `make test`, continuous integration, and `make test-all` run."""
CAUGHT, SURVIVED, LATE = "caught", "SURVIVED", "TOO LONG"
VERDICTS = {0: SURVIVED, 1: CAUGHT}
"""By pytest's exit code."""


class NoVerdict(Exception):
    """The tests could not be run, or fail without any error in the sources."""


def mutated(mutation: Mutation, root: Path) -> str:
    """The content of its file with the error made. Raises ``NoVerdict`` if the text to replace is
    not there exactly once."""
    content = (root / "mis_integrators" / mutation.file).read_text()
    if content.count(mutation.text) != 1:
        raise NoVerdict(f"{mutation.name}: its text is there {content.count(mutation.text)} times")
    return content.replace(mutation.text, mutation.replacement)


def copied(root: Path, copy: Path) -> None:
    """Copies the files that git knows, or would take, into a folder."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=root, check=True, capture_output=True, text=True).stdout
    for name in filter(None, names.split("\0")):
        if (root / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, copy / name)


def run_tests(
    copy: Path, tests: Sequence[str], selection: str, limit: float | None
) -> tuple[str, str]:
    """Runs tests in a copy until the first fails: the verdict, and what pytest wrote."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-rf", "-p", "no:cacheprovider"]
    process = subprocess.Popen(
        [*command, *SELECTIONS[selection], *tests],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # to end with all processes that tests have started
    )
    try:
        output, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        return LATE, ""
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.returncode not in VERDICTS:
        raise NoVerdict(f"pytest ended with exit code {process.returncode}:\n{output}")
    return VERDICTS[process.returncode], output


def first_failure(output: str) -> str:
    """The first test that failed, as pytest's summary names it."""
    failed = [line for line in output.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failed[0].split(" ", 1)[1].split(" - ")[0] if failed else ""


def judge(
    mutations: Iterable[tuple[int, Mutation]], root: Path, selection: str, whole: bool, limit: float
) -> list[str]:
    """The verdicts on numbered mutations, printed as they come."""
    verdicts = []
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder)
        copied(root, copy)
        for number, mutation in mutations:
            path = copy / "mis_integrators" / mutation.file
            good, bad = path.read_text(), mutated(mutation, copy)
            path.write_text(bad)
            start = time.monotonic()
            tests = [] if whole else mutation.tests.split()
            verdict, output = run_tests(copy, tests, selection, limit)
            path.write_text(good)
            seconds = time.monotonic() - start
            by = first_failure(output) if verdict == CAUGHT else ""
            print(f"{number:3}  {verdict:8} {seconds:5.0f} s  {mutation.name}  {by}", flush=True)
            verdicts.append(verdict)
    return verdicts


def check_tests(mutations: Sequence[Mutation], root: Path, selection: str, whole: bool) -> None:
    """Runs the tests without any error in the sources. Raises ``NoVerdict`` if they fail."""
    tests = [] if whole else sorted({name for m in mutations for name in m.tests.split()})
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copied(root, Path(folder))
        verdict, output = run_tests(Path(folder), [*tests, "-n", "2"], selection, None)
    if verdict != SURVIVED:
        raise NoVerdict(f"the tests fail without any error in the sources:\n{output[-4000:]}")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("numbers", nargs="*", type=int, help="some of them only (default: all)")
    parser.add_argument("--selection", choices=SELECTIONS, default="default", help="of the tests")
    parser.add_argument("--whole", action="store_true", help="all tests, not those named only")
    parser.add_argument("--limit", type=float, default=900, help="seconds for each (%(default)s)")
    parser.add_argument("--unchecked", action="store_true", help="without the run before")
    parser.add_argument("--list", action="store_true", help="say what there is")
    options = parser.parse_args(arguments)
    numbered = list(enumerate(MUTATIONS, 1))
    chosen = [(n, m) for n, m in numbered if not options.numbers or n in options.numbers]
    if options.list:
        for number, mutation in chosen:
            print(f"{number:3}  {mutation.name}")
        return 0
    try:
        if not options.unchecked:
            check_tests([m for _, m in chosen], ROOT, options.selection, options.whole)
        verdicts = judge(chosen, ROOT, options.selection, options.whole, options.limit)
    except NoVerdict as error:
        print(error, file=sys.stderr)
        return 2
    caught = verdicts.count(CAUGHT)
    print(f"{caught} of {len(verdicts)} caught ({100 * caught / max(len(verdicts), 1):.0f} %)")
    return 0 if caught == len(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
