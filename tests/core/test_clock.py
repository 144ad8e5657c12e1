"""A clock that stands still while kernels are compiled."""

import time

import mis_integrators  # noqa: F401 (registers the plugins)
from mis_integrators.core import clock

import drjit as dr
import mitsuba as mi
import pytest
from worlds import tray


def launch(factor):
    """A kernel that no other call has launched, if the factor is new."""
    dr.eval(dr.sin(dr.arange(mi.Float, 1000) * factor))


def test_kernels_are_seen_by_all_who_watch(rgb):
    """Reading Dr.Jit's history empties it; nobody misses a kernel for that."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), clock.watched_kernels() as outer:
        launch(1.25)
        with clock.watched_kernels() as inner:
            launch(2.5)
            clock.compiled_seconds()
            launch(3.75)
        launch(5.5)
    assert (len(outer), len(inner)) == (4, 2)
    assert clock.compile_seconds(outer) >= clock.compile_seconds(inner) > 0


def test_without_the_flag_it_is_the_usual_clock(rgb):
    """Within a tenth of a second."""
    start, usual = clock.now(), time.perf_counter()
    launch(7.25)
    time.sleep(0.1)
    assert clock.now() - start == pytest.approx(time.perf_counter() - usual, abs=0.1)


def slow_to_compile(monkeypatch, seconds):
    """Lets each iteration of a pilot take so long for kernels that have to be compiled."""
    from mis_integrators.integrators.pilot_passes import SubsetPasses

    trace, history, waiting = SubsetPasses.trace, dr.kernel_history, []

    def slow(self, number):
        time.sleep(seconds)
        waiting.append({"backend_time": 1000 * seconds})
        return trace(self, number)

    def told(*types):
        found, waiting[:] = [*history(*types), *waiting], []
        return found

    monkeypatch.setattr(SubsetPasses, "trace", slow)
    monkeypatch.setattr(dr, "kernel_history", told)


def test_plans_do_not_count_what_compiles(rgb, monkeypatch):
    """A render of one second, of which all would go: by the usual clock one iteration would be
    planned, and two hundred are without (half of that beside other work)."""

    def planned():
        session = mi.load_dict({"type": "bdpm", "max_depth": 4}).session(
            tray("lambertian", "rectangle")
        )
        session.plan_time(1.0)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            session.predict()
        return session.prediction.iterations

    planned()  # compiles
    usual = planned()
    slow_to_compile(monkeypatch, 0.6)
    assert usual > 10, "test too weak"
    assert planned() > 5
