"""Iterations spread over the processes of a Dask cluster, here or on other machines.

Iterations depend on the seed and their number alone, so any worker may run any of them: a worker
opens the scene by itself, runs the iterations that it is told, and hands back their sums. Whoever
gathers them adds each iteration once. What a worker that dies had in hand Dask gives to another;
what one holds that hangs, the gatherer does.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import math
import multiprocessing
import os
import signal
import statistics
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr

from ..core.session import Session
from ..core.sums import Iterations
from . import checkpoint
from .loading import one_line
from .request import Opened, Request

SECONDS_PER_BATCH, MOST_SECONDS_PER_BATCH = 1.0, 60.0
"""What a worker should need for what it is told at once: short enough to stop soon, and long enough
that handing over costs little."""
GATHERING_SHARE = 0.1
"""Share of its time that the gatherer should spend on adding: batches are long enough for that, up
to the second number above."""
BATCHES_PER_WORKER = 2
"""Batches that wait or run at a time: one to run, one to go on with."""
CONNECTION_SECONDS = 20
"""How long to look for the scheduler."""
CLOSING_SECONDS = 10.0
"""Seconds for the scheduler, and for local workers, to end by themselves."""
POLL_SECONDS = 0.5
"""Seconds that ``DistributedSession.iterate`` waits for something to come in, at most."""
LOOKING_SECONDS = 1.0
"""Seconds between two questions to the scheduler about its workers."""
ANSWER_SECONDS = 30.0
"""Seconds after which a scheduler that does not answer is given up."""
SILENCE = 20.0
"""Seconds without a heartbeat after which a worker counts as absent, until its next one."""
PATIENCE = 60.0
"""Seconds without any worker after which the render gives up."""
OVERDUE_SECONDS, OVERDUE_FACTOR = 30.0, 5.0
"""A batch is overdue after so many seconds (in which a worker may still open the scene and compile;
longer, if the first batch of all came back so late), and so many times what it and those before it
usually take."""
FIRST_BATCH_SECONDS = 1800.0
"""The same while no batch has come back: opening the scene, compiling, and one iteration."""
HAND_OUTS = 3
"""How often a batch may become overdue, or its sums may not be fetched; then the render gives
up."""
ATTEMPTS = 2
"""How often an iteration may fail with an error; then the render gives up."""
FETCHES, FETCHING_SECONDS = 2, 60.0
"""Batches whose sums are fetched at a time, which bounds memory, and the seconds that fetching may
take."""
FAILURES_ALLOWED = 10
"""Workers that may die with the same batch in hand."""
LONGEST_STEP = 2.0
"""Seconds between two polls that count, at most: while the process that gathers is stopped or busy
itself, nobody else is late."""


class ClusterError(Exception):
    """Workers cannot be reached, or fail; the message says why, in one line. Where a worker raises
    it, trying again will not help."""


class IterationError(Exception):
    """An iteration failed in the worker at an address, which says why in one line."""

    def __init__(self, address: str, message: str):
        super().__init__(address, message)
        self.address, self.message = address, message

    def __str__(self) -> str:
        return f"a worker failed: {self.message} ({self.address})"


@dataclass(frozen=True)
class Job:
    """What a worker must know: the request, what the gatherer has ``learned`` before the first
    iteration, the identity that the worker's own scene must have, whether variances are wanted, and
    how many threads (``None``: those of the Dask worker).
    """

    number: str
    request: Request
    learned: dict[str, Any]
    identity: dict[str, Any]
    keep_variance: bool
    threads: int | None


# --- In the worker --------------------------------------------------------------------------------

_open: dict[str, Session] = {}
# Sessions live in one thread, whatever thread Dask calls from.
_thread = ThreadPoolExecutor(1)


def run(job: Job, iterations: list[int]) -> tuple[dict[str, Any], Iterations, float]:
    """Run iterations of a job in this worker; returns their sums, which they are, and the seconds
    that they took.

    Raises ``ClusterError`` where the worker cannot open the job's scene, ``IterationError`` where
    an iteration fails.
    """
    from distributed import get_worker

    worker = get_worker()
    threads = job.threads or max(1, worker.state.nthreads)
    return _thread.submit(_run, job, iterations, threads, worker.address).result()


def _run(
    job: Job, iterations: list[int], threads: int, address: str
) -> tuple[dict[str, Any], Iterations, float]:
    session = _open.get(job.number) or _open_session(job, threads, address)
    _open.clear()  # an error leaves nothing half summed behind
    start = time.perf_counter()
    try:
        for iteration in iterations:
            session.iterate(iteration)
        arrays, done = session.sums.take()
    except Exception as error:
        raise IterationError(address, one_line(error)) from None
    _open[job.number] = session
    return arrays, done, time.perf_counter() - start


def _open_session(job: Job, threads: int, address: str) -> Session:
    _open.clear()
    try:
        dr.set_thread_count(threads)
        opened = job.request.open()
        what = checkpoint.difference(job.identity, opened.identity())
        if not what and job.keep_variance:
            opened.session.keep_variance()
        if not what:
            opened.session.recall(job.learned)
    except Exception as error:
        raise ClusterError(
            f"a worker cannot open the scene: {one_line(error)} ({address})"
        ) from None
    if what:
        raise ClusterError(f"a worker sees another render than was asked for: {what} ({address})")
    return opened.session


# --- In the process that gathers ------------------------------------------------------------------


@contextlib.contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A ``distributed.Client`` of a cluster of so many local processes, or of the scheduler at an
    address. Raises ``ClusterError``.

    Leaving takes seconds at most, whatever workers and scheduler do; no local worker is left.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ClusterError(
            f"dask.distributed is missing ({error}): pip install 'mis-integrators[cluster]'"
        ) from error

    for name in (
        "distributed",
        "distributed.client",
    ):  # Dask sets levels for both when it is imported
        logging.getLogger(name).setLevel(logging.CRITICAL)
    quiet = {
        "logging.distributed": "critical",
        "distributed.scheduler.allowed-failures": FAILURES_ALLOWED,
    }
    with dask.config.set(quiet), contextlib.ExitStack() as stack:
        try:
            cluster: Any = scheduler
            if scheduler:
                _check_address(scheduler)
            if workers:
                stack.enter_context(_no_process_left())
                # Its workers come later: were they waited for here, an interrupt would leave
                # nothing that could be closed.
                cluster = distributed.LocalCluster(
                    n_workers=0,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                    memory_limit=None,
                    silence_logs=logging.CRITICAL,
                )
                stack.callback(_close_cluster, cluster)
                cluster.scale(workers)
            client = distributed.Client(cluster, timeout=CONNECTION_SECONDS)
            stack.callback(_close_client, client)
            if workers:
                client.register_plugin(_interrupt_plugin(distributed))
                client.wait_for_workers(workers, timeout=PATIENCE)
        except Exception as error:  # Dask raises errors of many kinds for an address that is none
            raise ClusterError(_why_not_connected(scheduler, error)) from error
        yield client


def _check_address(scheduler: str) -> None:
    """Raise an error if nothing can be at an address. (A client that finds out by itself may hang
    when it is closed.)"""
    import distributed

    scheme, _ = distributed.comm.parse_address(scheduler)
    distributed.comm.get_address_host_port(scheduler)
    if scheme == "tls" and not distributed.Security().get_connection_args("client").get(
        "ssl_context"
    ):
        raise ValueError(
            "Dask's configuration names no certificates; set distributed.comm.tls.ca-file, "
            "distributed.comm.tls.client.cert and "
            "distributed.comm.tls.client.key"
        )


def _why_not_connected(scheduler: str | None, error: Exception) -> str:
    reason = " ".join(str(error).split()) or type(error).__name__
    return (
        f"no scheduler at {scheduler}: {reason}" if scheduler else f"cannot start workers: {reason}"
    )


def _close_client(client: Any) -> None:
    """Leave a scheduler, which then forgets what this client had asked for."""
    with contextlib.suppress(Exception):  # it may not answer any more
        client.close(timeout=CLOSING_SECONDS)


def _close_cluster(cluster: Any) -> None:
    """Let local workers end."""
    with contextlib.suppress(Exception):  # one that hangs may not
        cluster.close(timeout=CLOSING_SECONDS)
    cluster.shutdown_on_close = False  # else Dask tries again at exit


@contextlib.contextmanager
def _no_process_left() -> Iterator[None]:
    """End worker processes that were started in this context by force, if they are still there.
    (One that is stopped would be waited for at exit.)"""
    before = multiprocessing.active_children()
    try:
        yield
    finally:
        for process in multiprocessing.active_children():
            if process not in before and process.name.startswith("Dask Worker"):
                process.kill()


def _interrupt_plugin(distributed: Any) -> Any:
    """Ctrl-C in a terminal reaches local workers as well; it is for the process that gathers."""

    class IgnoreInterrupts(distributed.WorkerPlugin):
        name = "ignore-interrupts"

        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    return IgnoreInterrupts()


class Watch:
    """What the scheduler tells about its workers. It is asked now and then, and nobody waits for
    the answer."""

    def __init__(self, client: Any, news: threading.Event):
        self._client, self._news = client, news
        self._question: concurrent.futures.Future | None = None
        self._last, self._asked, self._last_present = time.monotonic(), -math.inf, 0.0
        self._heard: dict[str, tuple[float, float]] = {}
        """For each worker its last heartbeat by the scheduler's clock, and when that was news by
        this one."""
        self.now = 0.0
        """Seconds that this process has watched."""
        self.present: list[str] = []
        """Addresses of the workers whose heartbeats come in."""
        self.silent: set[str] = set()
        """Addresses of the others that the scheduler knows."""
        self.holders: dict[str, str] = {}
        """For each key that a worker has in hand, or whose result it keeps, the worker's
        address."""
        self.seen = -math.inf
        """When that was asked for."""

    def look(self, keys: list[str]) -> None:
        """Take in the answer, if there is one; ask again, if it is time, about these keys, too.
        Raises ``ClusterError`` if there is no answer, or no worker, for too long."""
        moment = time.monotonic()
        self.now += min(moment - self._last, LONGEST_STEP)
        self._last = moment
        if self._client.status != "running":
            raise ClusterError("the scheduler is gone")
        if self._question is not None and self._question.done():
            try:
                self._take(*self._question.result())
            except Exception as error:
                raise ClusterError(f"the scheduler is gone: {one_line(error)}") from error
            self._question = None
        if self._question is not None and self.now - self._asked > ANSWER_SECONDS:
            raise ClusterError(f"the scheduler has not answered for {ANSWER_SECONDS:.0f} s")
        if self._question is None and self.now - self._asked >= LOOKING_SECONDS:
            self._asked = self.now
            self._question = asyncio.run_coroutine_threadsafe(
                self._ask(keys), self._client.loop.asyncio_loop
            )
            self._question.add_done_callback(lambda _: self._news.set())
        if self.present:
            self._last_present = self.now
        elif self.now - self._last_present > PATIENCE:
            unheard = (
                f"; the scheduler does not hear of the {len(self.silent)} that it knows"
                if self.silent
                else ""
            )
            raise ClusterError(f"there has been no worker for {PATIENCE:.0f} s{unheard}")

    async def _ask(self, keys: list[str]) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        scheduler = self._client.scheduler
        workers = (await scheduler.identity(n_workers=-1))["workers"]
        return workers, await scheduler.processing(workers=None), await scheduler.who_has(keys=keys)

    def _take(
        self, workers: dict[str, Any], processing: dict[str, Any], kept: dict[str, Any]
    ) -> None:
        # Clocks of two machines cannot be compared, but a heartbeat has come in where the
        # scheduler's changes.
        self._heard = {
            address: self._heard[address]
            if address in self._heard and self._heard[address][0] == worker["last_seen"]
            else (worker["last_seen"], self.now)
            for address, worker in workers.items()
        }
        self.silent = {
            address for address, (_, when) in self._heard.items() if self.now - when > SILENCE
        }
        self.present = [address for address in workers if address not in self.silent]
        self.holders = {key: address for address, keys in processing.items() for key in keys}
        self.holders |= {key: addresses[0] for key, addresses in kept.items() if addresses}
        self.seen = self._asked


@dataclass(eq=False)
class Copy:
    """A batch as it was handed out once; ``since`` then, or later, by the watch's clock, it has
    been on its way."""

    future: Any
    since: float
    fetching: concurrent.futures.Future | None = None
    fetching_since: float = 0.0


@dataclass(eq=False)
class Batch:
    """Iterations that are under way, perhaps at several workers: the sums that come first count."""

    numbers: list[int]
    copies: list[Copy] = field(default_factory=list)
    overdue: int = 0
    """How often it was overdue, or its sums could not be fetched."""
    failed_at: list[str] = field(default_factory=list)
    """Workers in which it ended with an error."""

    def __str__(self) -> str:
        return (
            f"iteration {self.numbers[0]}"
            if len(self.numbers) == 1
            else f"iterations {self.numbers[0]} to {self.numbers[-1]}"
        )


class DistributedSession:
    """A ``Session`` whose iterations the workers of a cluster run: each ``iterate`` adds what has
    come in, several of them or none.

    All but ``iterate`` is that of the session ``opened``, in this process, which finds out what
    must be known before, and renders nothing but the iterations that it needs for that.
    """

    seconds_of_next = math.inf
    """That of the session tells of one process, not of many."""

    def __init__(self, client: Any, opened: Opened, keep_variance: bool, threads: int | None):
        self._client, self._opened, self._threads, self._keep_variance = (
            client,
            opened,
            threads,
            keep_variance,
        )
        self._session = opened.session
        self._identity = opened.identity()
        self._job: Job | None = None
        self._news = threading.Event()
        self._waiting: list[Batch] = []
        self._next = 0
        self._seconds_per_iteration: float | None = None
        self._usual: deque[float] = deque(maxlen=32)
        """Seconds per iteration of the last batches."""
        self._first_took = 0.0
        """Seconds from handing out the first batch that came back until then."""
        self.batches = 0
        """Batches that were added."""
        self.gathering = 0.0
        """Seconds that fetching and adding the last batch took: what bounds the number of workers
        that pay."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def iterate(self) -> None:
        """Add the iterations that workers have finished; wait ``POLL_SECONDS`` for some, at most.
        Raises ``ClusterError``; what has been added stays."""
        if self._job is None:
            self._begin()
        end = time.monotonic() + POLL_SECONDS
        while True:
            self._watch.look([copy.future.key for batch in self._waiting for copy in batch.copies])
            self._hand_out()
            left = end - time.monotonic()
            if self._gather() or left <= 0:
                return
            self._news.wait(left)
            self._news.clear()

    def _begin(self) -> None:
        with dr.suspend_grad():
            self._session.start()
        for number in list(getattr(self._session, "kept", ())):
            self._session.iterate(number)
        request = self._opened.request
        self._job = Job(
            f"{os.getpid()}-{time.time_ns()}",
            replace(request, scene=os.path.abspath(request.scene)),
            self._session.learned,
            self._identity,
            self._keep_variance,
            self._threads,
        )
        self._watch = Watch(self._client, self._news)

    # Handing out

    def _hand_out(self) -> None:
        """Hand out anew what does not come back; keep the workers busy with the first iterations
        that are neither done nor under way."""
        present = self._watch.present
        if not present:
            for batch in self._waiting:
                for copy in batch.copies:
                    copy.since = self._watch.now  # nobody is slow where nobody is
            return
        for batch in self._waiting:
            if self._needs_another(batch):
                holders = {self._watch.holders.get(copy.future.key) for copy in batch.copies}
                others = [address for address in present if address not in holders]
                if untried := [address for address in others if address not in batch.failed_at]:
                    others = untried
                if others:
                    self._send(batch, others)
        while len(self._waiting) < BATCHES_PER_WORKER * len(present) and (
            numbers := self._take_numbers(len(present))
        ):
            self._waiting.append(Batch(numbers))
            self._send(self._waiting[-1], present if self._watch.silent else None)

    def _send(self, batch: Batch, workers: list[str] | None) -> None:
        # The job goes with each batch: were it stored in the cluster, its only copy could be that
        # of a worker which hangs.
        future = self._client.submit(
            run, self._job, batch.numbers, pure=False, retries=0, workers=workers
        )
        future.add_done_callback(lambda _: self._news.set())
        batch.copies.append(Copy(future, self._watch.now))

    def _needs_another(self, batch: Batch) -> bool:
        """Whether no worker is likely to finish the batch soon. Raises ``ClusterError`` if that was
        so too often."""
        now, alive = self._watch.now, []
        for copy in list(batch.copies):
            holder = self._watch.holders.get(copy.future.key)
            if holder in self._watch.silent:
                copy.since = now  # whoever holds it is not slow but absent
            elif (
                holder is None
                and not copy.future.done()
                and self._watch.seen - copy.since > SILENCE
            ):
                self._drop(batch, copy)  # those who might have taken it have left
            else:
                alive.append(copy)
        if not alive:
            return True
        limit = self._seconds_allowed()
        if any(now - copy.since <= limit for copy in alive):
            return False
        self._count_overdue(
            batch, f"no worker has finished {batch} in {limit:.0f} s, {HAND_OUTS} times"
        )
        for copy in alive:
            copy.since = now
        return True

    def _seconds_allowed(self) -> float:
        """Seconds after which a batch is overdue."""
        if not self._usual:
            return FIRST_BATCH_SECONDS
        before = max(BATCHES_PER_WORKER, math.ceil(len(self._waiting) / len(self._watch.present)))
        longest = max(len(batch.numbers) for batch in self._waiting)
        return max(
            OVERDUE_SECONDS, 2 * self._first_took
        ) + OVERDUE_FACTOR * before * longest * statistics.median(self._usual)

    @staticmethod
    def _count_overdue(batch: Batch, message: str) -> None:
        batch.overdue += 1
        if batch.overdue >= HAND_OUTS:
            raise ClusterError(message)

    @staticmethod
    def _drop(batch: Batch, copy: Copy) -> None:
        """Ask for a copy no longer; what still comes of it is not looked at."""
        batch.copies.remove(copy)
        copy.future.release()

    def _take_numbers(self, workers: int) -> list[int]:
        done, planned = self._session.sums.done, self._session.iterations_planned
        size = 1
        if self._seconds_per_iteration:
            seconds = min(
                max(SECONDS_PER_BATCH, workers * self.gathering / GATHERING_SHARE),
                MOST_SECONDS_PER_BATCH,
            )
            size = max(1, round(seconds / max(self._seconds_per_iteration, 1e-6)))
        if planned is not None:
            size = min(
                size, max(1, math.ceil((planned - self._next) / (BATCHES_PER_WORKER * workers)))
            )
        numbers: list[int] = []
        while len(numbers) < size and (planned is None or self._next < planned):
            if self._next not in done:
                numbers.append(self._next)
            self._next += 1
        return numbers

    # Gathering

    def _gather(self) -> bool:
        """Add what has been fetched, and fetch more of what is finished. Returns whether something
        was added; raises ``ClusterError`` after it."""
        added, errors = False, []
        for batch in list(self._waiting):
            for copy in list(batch.copies):
                if batch in self._waiting and copy.fetching is not None and copy.fetching.done():
                    try:
                        added |= self._add(batch, copy)
                    except ClusterError as error:
                        errors.append(error)
        if errors:
            raise errors[0]
        copies = [copy for batch in self._waiting for copy in batch.copies]
        free = FETCHES - sum(
            copy.fetching is not None
            and self._watch.holders.get(copy.future.key) not in self._watch.silent
            for copy in copies
        )
        for copy in [copy for copy in copies if copy.fetching is None and copy.future.done()][
            : max(0, free)
        ]:
            copy.fetching_since = time.perf_counter()
            copy.fetching = asyncio.run_coroutine_threadsafe(
                self._fetch(copy.future), self._client.loop.asyncio_loop
            )
            copy.fetching.add_done_callback(lambda _: self._news.set())
        return added

    async def _fetch(self, future: Any) -> tuple[Any, float]:
        result = await asyncio.wait_for(
            self._client.gather(future, asynchronous=True), FETCHING_SECONDS
        )
        return result, time.perf_counter()

    def _add(self, batch: Batch, copy: Copy) -> bool:
        """Add a batch that has been fetched. Returns whether it could be; if not, it may be tried
        once more."""
        import distributed

        start = time.perf_counter()
        assert copy.fetching is not None
        try:
            (arrays, done, seconds), fetched = copy.fetching.result()
        except distributed.KilledWorker as error:
            raise ClusterError(
                f"{FAILURES_ALLOWED} workers died with the same iterations in hand; is there too "
                "little memory?"
            ) from error
        except (
            distributed.CancelledError,
            asyncio.CancelledError,
            concurrent.futures.CancelledError,
        ) as error:
            raise ClusterError("the scheduler has forgotten what was asked of it") from error
        except (TimeoutError, asyncio.TimeoutError):
            self._drop(batch, copy)
            self._count_overdue(
                batch,
                f"the sums of {batch} could not be fetched within {FETCHING_SECONDS:.0f} s, "
                f"{HAND_OUTS} times",
            )
            return False
        except ClusterError:
            raise
        except ImportError as error:  # the worker lacks what it needs to understand the job
            raise ClusterError(f"a worker failed: {one_line(error)}") from error
        except Exception as error:
            self._drop(batch, copy)
            batch.failed_at.append(getattr(error, "address", ""))
            if len(batch.failed_at) >= ATTEMPTS:
                raise ClusterError(
                    str(error)
                    if isinstance(error, IterationError)
                    else f"a worker failed: {one_line(error)}"
                ) from error
            return False
        self._waiting.remove(batch)
        for other in list(batch.copies):
            self._drop(batch, other)
        self._session.sums.merge(arrays, done)
        self.batches += 1
        self.gathering = fetched - copy.fetching_since + time.perf_counter() - start
        self._seconds_per_iteration = seconds / len(done)
        if not self._usual:
            self._first_took = self._watch.now - copy.since
        self._usual.append(self._seconds_per_iteration)
        return True
