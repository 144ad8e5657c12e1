"""Frozen passes: a pass is recorded once, and its kernels are launched again without running its
Python."""

import contextlib
import functools
import gc
import sys
import threading
import time

import drjit as dr
import mitsuba as mi


@contextlib.contextmanager
def no_garbage_collection():
    """A scene that Python's collector destroys in the middle of a recording aborts the process (its
    Embree release cannot be recorded), so the collector waits."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


UNDISTURBED = 0.05
"""Seconds that Python leaves a recorded call its turn when other threads ask for it, in place of
five thousandths: longer than such a call traverses its arguments."""


@contextlib.contextmanager
def undisturbed():
    """Other threads of Python run before and after, not in between. Dr.Jit 1.5 holds its own lock
    while a recorded call traverses its arguments with Python; a thread that gets its turn then, and
    touches an array (of a finished image, say), never hands it back."""
    if threading.active_count() > 1:
        time.sleep(0)  # who waits already has its turn now
    before = sys.getswitchinterval()
    sys.setswitchinterval(max(before, UNDISTURBED))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def recorder():
    """What records the passes of one session (they must not return named tuples, of which Dr.Jit's
    replays return the first one again): `frozen` (garbage is collected once, before the first
    pass), or what leaves a function as it is in spectral variants: Dr.Jit 1.5 records sensors with
    a response function wrongly (and leaves them corrupted), and cannot record some spectral
    textures."""
    if mi.is_spectral:
        return lambda function: function
    tidy = functools.cache(gc.collect)
    return lambda function: frozen(function, tidy)


_anchor = None
"""Inside a frozen pass, a zero that its kernels read."""


def lanes(count):
    """0, 1, ..., count - 1 (uint32), one a lane: what passes are to start from, instead of
    `dr.arange`.

    Dr.Jit 1.5 does not replay the sizes of a recording's kernels: it guesses them from the widths
    of what they read. A number of width one makes it right. Where a kernel does nothing but gather,
    the guess may take the data of virtual function calls for such an array, whose size in bytes it
    forgets to round up as the recording did: with an unlucky `count` all replays then lack some per
    cent of their lanes."""
    index = dr.arange(mi.UInt32, count)
    return index if _anchor is None else index + _anchor


def _anchored(function):
    """`function` with one more argument, the anchor."""

    def call(anchor, *args):
        global _anchor
        before, _anchor = _anchor, anchor
        try:
            return function(*args)
        finally:
            _anchor = before

    return call


def frozen(function, tidy=gc.collect):
    """`dr.freeze(function)`, safe against garbage collection while it records. It numbers its lanes
    by `lanes`.

    Evaluated arrays that `function` reads must be among its arguments, and numbers that change from
    call to call must be opaque arrays. Nothing inside may read an array's value. Where Dr.Jit
    refuses to record, the function runs as it is, with the same result and some more Python. `tidy`
    is called before the recording: objects of a forgotten scene that the collector has not met yet
    are still called, but are not among the arguments.
    """
    recorded = dr.freeze(_anchored(function))
    anchor = dr.opaque(mi.UInt32, 0)
    fresh, plain = True, False

    def attempt(args):
        with no_garbage_collection(), undisturbed():
            return recorded(anchor, *args)

    def call(*args):
        nonlocal fresh, plain
        if plain:
            return function(*args)
        if fresh:
            tidy()
            fresh = False
        try:
            return attempt(args)
        except RuntimeError:
            gc.collect()  # a scene may have been forgotten since
        try:
            return attempt(args)
        except RuntimeError as error:
            mi.Log(mi.LogLevel.Debug, f"not recorded: {error.__cause__ or error}")
            plain = True
            return function(*args)  # raises again what is not the recording's fault

    return call


def settle(scene):
    """Evaluates what a scene's plugins have left unevaluated (`plastic` its sampling weight). A
    recording does so anyway; done before, the kernels of a process's first session are those of the
    later ones."""
    if not mi.is_spectral:
        frozen(lambda scene, number: number + 1, tidy=lambda: None)(scene, dr.opaque(mi.UInt32, 0))
