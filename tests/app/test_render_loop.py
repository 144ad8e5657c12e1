"""When rendering stops."""

import contextlib
from types import SimpleNamespace

from mis_integrators.app.render_loop import iterate

import pytest


class Slow(contextlib.AbstractContextManager):
    """A session and its clock: what goes before the first iteration, and each iteration, take so
    many seconds."""

    def __init__(self, before, each):
        self.rendering, self.iterations, self.before, self.each = 0.0, 0, before, each

    def iterate(self):
        self.rendering += self.each + (0 if self.iterations else self.before)
        self.iterations += 1

    def __exit__(self, *_):
        pass


@pytest.mark.parametrize(
    "before, each, seconds, iterations",
    [
        (0, 1, 10, 10),
        (0, 4, 11, 3),  # a quarter of the third one lies beyond
        (0, 4, 9, 2),  # three quarters of it would
        (3, 4, 10, 2),  # what the second takes is not known before
        (3, 4, 12, 2),
        (3, 4, 14, 3),
        (0, 20, 10, 1),
    ],
)
def test_iterations_that_would_be_late_are_not_begun(before, each, seconds, iterations):
    session = Slow(before, each)
    progress = SimpleNamespace(update=lambda *_: None)
    interrupt = SimpleNamespace(have_result=False, requested=False, stopped=False)
    iterate(session, None, seconds, None, session, [], progress, interrupt)
    assert session.iterations == iterations
