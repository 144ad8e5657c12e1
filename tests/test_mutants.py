"""The errors of `tools/mutations.py` can be made, and are judged by what the tests say."""

import re
from collections import Counter
from pathlib import Path

import mutants
import pytest
from mutations import MUTATIONS, Mutation

ROOT = Path(__file__).parents[1]
CHEAP = Mutation(
    "core/segments.py",
    "return max(0, (max(end, 1) - 1).bit_length() - LOG)",
    "return max(0, max(end, 1).bit_length() - LOG)",
    "a render of eight iterations has segments of two",
    "tests/core/test_segments.py::test_segments_are_runs_of_iterations",
)


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.breaks)
def test_mutation_can_be_made(mutation):
    """Its text is there once, Python understands what takes its place, and its tests are there."""
    changed = mutants.mutated(mutation, ROOT)
    compile(changed, mutation.file, "exec")
    for name in mutation.tests.split():
        file, _, function = name.partition("::")
        assert (ROOT / file).exists(), name
        if function:
            assert f"\ndef {function}(" in (ROOT / file).read_text(), name


def test_mutations_are_spread():
    """Three at least in each of eleven packages, and no two alike."""
    counts = Counter(m.file.partition("/")[0] for m in MUTATIONS)
    assert len(counts) == 11 and min(counts.values()) >= 3
    assert len(MUTATIONS) >= 40 and len({m.name for m in MUTATIONS}) == len(MUTATIONS)


def test_text_that_is_gone_is_said():
    with pytest.raises(mutants.NoVerdict, match="0 times"):
        mutants.mutated(CHEAP._replace(text="no such text"), ROOT)


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="git tells which files to copy")
def test_verdicts(capsys):
    """A mutation that its test sees, and one that it does not look at."""
    other = CHEAP._replace(tests="tests/core/test_segments.py::test_complete_segments")
    same = other._replace(replacement=other.text)
    found = mutants.judge([(1, CHEAP), (2, same)], ROOT, "default", False, 300)
    assert found == [mutants.CAUGHT, mutants.SURVIVED]
    said = capsys.readouterr().out
    assert re.search(r"1  caught .*segments of two  tests/core/test_segments.py::test_segm", said)
    late = mutants.judge([(1, CHEAP)], ROOT, "default", False, 0.1)
    assert late == [mutants.LATE]
