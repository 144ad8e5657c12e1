"""When rendering stops."""

import contextlib
import math
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
        (3, 4, 10, 2),  # what goes before counts as one more
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


class Timed(Slow):
    """The same, but it has rendered the first iterations beforehand, and knows what one takes."""

    def __init__(self, before, each, ready):
        super().__init__(before, each)
        self.ready = ready

    @property
    def seconds_of_next(self):
        return 0 if self.iterations < self.ready else self.each

    def iterate(self):
        self.rendering += self.seconds_of_next + (0 if self.iterations else self.before)
        self.iterations += 1


@pytest.mark.parametrize(
    "before, each, ready, seconds, iterations",
    [
        (11, 6, 1, 20, 2),  # the mean so far, 11, would not let the second begin
        (13, 6, 1, 20, 2),
        (18, 6, 1, 20, 1),
        (21, 6, 2, 20, 2),  # it is too late, but the second is there
        (9, 60, 1, 20, 2),  # measured with something else in it: the mean knows better
        (14, 60, 1, 20, 1),
        (15, math.inf, 1, 20, 2),
        (17, math.inf, 1, 20, 1),
    ],
)
def test_sessions_that_know_what_an_iteration_takes(before, each, ready, seconds, iterations):
    session = Timed(before, each, ready)
    progress = SimpleNamespace(update=lambda *_: None)
    interrupt = SimpleNamespace(have_result=False, requested=False, stopped=False)
    iterate(session, None, seconds, None, session, [], progress, interrupt)
    assert session.iterations == iterations
