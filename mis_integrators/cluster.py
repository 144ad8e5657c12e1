"""Iterations spread over the processes of a Dask cluster, here or on other machines.

Iterations depend on the seed and their number alone, so any worker may run any of them: a worker opens the scene by itself, runs the iterations that
it is told, and hands back their sums. Whoever gathers them adds each iteration once. What a worker that dies had in hand Dask gives to another.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Iterator

import drjit as dr

from . import checkpoint
from .opening import Opened, Request
from .session import Session
from .sums import Iterations

SECONDS_PER_BATCH, MOST_SECONDS_PER_BATCH = 1.0, 60.0
"""What a worker should need for what it is told at once: short enough to stop soon, and long enough that handing over costs little."""
GATHERING_SHARE = 0.1
"""Share of its time that the gatherer should spend on adding: batches are long enough for that, up to the second number above."""
BATCHES_PER_WORKER = 2
"""Batches that wait or run at a time: one to run, one to go on with."""
CONNECTION_SECONDS = 20
"""How long to look for the scheduler."""
PATIENCE = 60.0
"""Seconds without any worker after which the render gives up."""
FAILURES_ALLOWED = 10
"""Workers that may die with the same batch in hand."""


class ClusterError(Exception):
    """Workers cannot be reached, or fail; the message says why, in one line."""


@dataclass(frozen=True)
class Job:
    """What a worker must know: the request, what the gatherer has ``learned`` before the first iteration, the identity that the worker's own
    scene must have, whether variances are wanted, and how many threads (``None``: those of the Dask worker).
    """

    number: str
    request: Request
    learned: dict[str, Any]
    identity: dict[str, Any]
    keep_variance: bool
    threads: int | None


# --- In the worker ------------------------------------------------------------------------------------

_open: dict[str, Session] = {}
# Sessions live in one thread, whatever thread Dask calls from.
_thread = ThreadPoolExecutor(1)


def run(job: Job, iterations: list[int]) -> tuple[dict[str, Any], Iterations, float]:
    """Run iterations of a job in this worker; returns their sums, which they are, and the seconds that they took."""
    from distributed import get_worker

    threads = job.threads or max(1, get_worker().state.nthreads)
    return _thread.submit(_run, job, iterations, threads).result()


def _run(job: Job, iterations: list[int], threads: int) -> tuple[dict[str, Any], Iterations, float]:
    session = _open.get(job.number) or _open_session(job, threads)
    _open.clear()                # an error leaves nothing half summed behind
    start = time.perf_counter()
    for iteration in iterations:
        session.iterate(iteration)
    arrays, done = session.sums.take()
    _open[job.number] = session
    return arrays, done, time.perf_counter() - start


def _open_session(job: Job, threads: int) -> Session:
    _open.clear()
    dr.set_thread_count(threads)
    opened = job.request.open()
    if what := checkpoint.difference(job.identity, opened.identity()):
        raise ClusterError(f"a worker sees another render than was asked for: {what}")
    if job.keep_variance:
        opened.session.keep_variance()
    opened.session.recall(job.learned)
    return opened.session


# --- In the process that gathers --------------------------------------------------------------------


@contextlib.contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A ``distributed.Client`` of a cluster of so many local processes, or of the scheduler at an address. Raises ``ClusterError``."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ClusterError(f"dask.distributed is missing ({error}): pip install 'mis-integrators[cluster]'") from error

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    quiet = {"logging.distributed": "critical", "distributed.scheduler.allowed-failures": FAILURES_ALLOWED}
    with dask.config.set(quiet), contextlib.ExitStack() as stack:
        try:
            if workers:
                scheduler = stack.enter_context(
                    distributed.LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None,
                                             memory_limit=None, silence_logs=logging.CRITICAL)
                )
            client = stack.enter_context(distributed.Client(scheduler, timeout=CONNECTION_SECONDS))
            if workers:
                client.register_plugin(_interrupt_plugin(distributed))
        except (OSError, ValueError, TimeoutError) as error:
            raise ClusterError(f"no scheduler at {scheduler}: {' '.join(str(error).split())}") from error
        yield client


def _interrupt_plugin(distributed: Any) -> Any:
    """Ctrl-C in a terminal reaches local workers as well; it is for the process that gathers."""

    class IgnoreInterrupts(distributed.WorkerPlugin):
        name = "ignore-interrupts"

        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    return IgnoreInterrupts()


class DistributedSession:
    """A ``Session`` whose iterations the workers of a cluster run: each ``iterate`` adds what comes in next, which may be several of them.

    All but ``iterate`` is that of the session ``opened``, in this process, which renders nothing itself but finds out what must be known before.
    """

    def __init__(self, client: Any, opened: Opened, keep_variance: bool, threads: int | None):
        self._client, self._opened, self._threads, self._keep_variance = client, opened, threads, keep_variance
        self._session = opened.session
        self._identity = opened.identity()
        self._job: Any = None
        self._waiting: dict[Any, list[int]] = {}
        self._next = 0
        self._seconds_per_iteration: float | None = None
        self.gathering = 0.0
        """Seconds that fetching and adding the last batch took: what bounds the number of workers that pay."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def iterate(self) -> None:
        """Add the iterations of the next batch that a worker has finished. Raises ``ClusterError``."""
        if self._job is None:
            self._begin()
        self._submit()
        batch = self._next_finished()
        start = time.perf_counter()
        self._waiting.pop(batch)
        arrays, done, seconds = self._result(batch)
        batch.release()
        self._session.sums.merge(arrays, done)
        self.gathering = time.perf_counter() - start
        self._seconds_per_iteration = seconds / len(done)

    def _begin(self) -> None:
        with dr.suspend_grad():
            self._session.start()
        request = self._opened.request
        job = Job(f"{os.getpid()}-{time.time_ns()}", replace(request, scene=os.path.abspath(request.scene)), self._session.learned, self._identity,
                  self._keep_variance, self._threads)
        self._job = self._client.scatter(job, hash=False)

    def _workers(self) -> int:
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def _submit(self) -> None:
        """Keep the workers busy with the first iterations that are neither done nor under way."""
        workers = max(1, self._workers())
        while len(self._waiting) < BATCHES_PER_WORKER * workers and (batch := self._take_numbers(workers)):
            future = self._client.submit(run, self._job, batch, pure=False, retries=FAILURES_ALLOWED)
            self._waiting[future] = batch

    def _take_numbers(self, workers: int) -> list[int]:
        done, planned = self._session.sums.done, self._session.iterations_planned
        size = 1
        if self._seconds_per_iteration:
            seconds = min(max(SECONDS_PER_BATCH, workers * self.gathering / GATHERING_SHARE), MOST_SECONDS_PER_BATCH)
            size = max(1, round(seconds / max(self._seconds_per_iteration, 1e-6)))
        if planned is not None:
            size = min(size, max(1, math.ceil((planned - self._next) / (BATCHES_PER_WORKER * workers))))
        numbers: list[int] = []
        while len(numbers) < size and (planned is None or self._next < planned):
            if self._next not in done:
                numbers.append(self._next)
            self._next += 1
        return numbers

    def _next_finished(self) -> Any:
        import distributed

        last_seen = time.monotonic()
        while True:
            try:
                return next(iter(distributed.wait(list(self._waiting), timeout=1, return_when="FIRST_COMPLETED").done))
            except (TimeoutError, distributed.TimeoutError):
                pass
            if self._client.status != "running":
                raise ClusterError("the scheduler is gone")
            if self._workers():
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > PATIENCE:
                raise ClusterError(f"there has been no worker for {PATIENCE:.0f} s")

    def _result(self, batch: Any) -> tuple[dict[str, Any], Iterations, float]:
        import distributed

        try:
            return batch.result()
        except distributed.KilledWorker as error:
            raise ClusterError(f"{FAILURES_ALLOWED} workers died with the same iterations in hand; is there too little memory?") from error
        except distributed.CancelledError as error:
            raise ClusterError("the scheduler has forgotten what was asked of it") from error
        except ClusterError:
            raise
        except Exception as error:
            raise ClusterError(f"a worker failed: {' '.join(str(error).split())}") from error
