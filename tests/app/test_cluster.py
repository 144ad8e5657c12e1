"""Renders whose iterations are spread over processes: the image is that of one process, whatever
happens to workers."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

from mis_integrators.app import checkpoint, cluster
from mis_integrators.app.request import Request
from mis_integrators.core.sums import Iterations, Sums

import numpy as np
import pytest
from lamplit import ROOT, command, read, render, run, same, write_scene
from pilots import learned
from selection import extended

pytest.importorskip(
    "distributed",
    reason="dask.distributed is not installed: pip install 'mis-integrators[cluster]'",
)


pytestmark = pytest.mark.usefixtures("usual_vectors")


@pytest.fixture
def scene(tmp_path, rgb):
    return write_scene(tmp_path)


@pytest.fixture(scope="module")
def client():
    """Two workers of one thread each."""
    with cluster.connected(2, None) as client:
        yield client


def request_for(scene, plugin, spp, **parameters) -> Request:
    return Request(
        scene=str(scene),
        variables={"size": "48"},
        plugin=plugin,
        parameters=parameters,
        variant="llvm_ad_rgb",
        sensor=0,
        all_views=False,
        seed=7,
        spp=spp,
        fine=True,
    )


def iterate_for(session, seconds, until=lambda: False) -> None:
    """Poll until something is so, for so many seconds at most."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not until():
        session.iterate()


def test_image_is_that_of_one_process(scene, tmp_path, client):
    """Through the scheduler's address, from a checkpoint on, with a pilot whose result the workers
    must be told (its radius is for the three samples that were planned then)."""
    options = [
        "-i",
        "bdpm_opt3",
        "-P",
        "mix_diffuse=true",
        "-P",
        "variance=true",
        "--seed",
        3,
        "--quiet",
    ]
    for name, where in (("one", []), ("two", ["--scheduler", client.scheduler.address])):
        assert (
            render(scene, *options, "--spp", 3, "-o", tmp_path / f"{name}.exr", "--checkpoint", 100)
            == 0
        )
        assert (
            render(scene, *options, "--spp", 12, "-o", tmp_path / f"{name}.exr", "--resume", *where)
            == 0
        )
    (one_header, one), (header, image) = (read(tmp_path / f"{name}.exr") for name in ("one", "two"))
    assert (
        header["iterations"] == one_header["iterations"] == 12
        and header["radius.indirect"] == one_header["radius.indirect"]
    )
    assert same(one, image)
    assert checkpoint.read(tmp_path / "two.checkpoint").done == Iterations(12)


def test_killed_worker_costs_its_iterations_only(scene, client, monkeypatch):
    """A worker is killed with iterations in hand: they are done again, each is summed once."""
    monkeypatch.setattr(cluster, "SECONDS_PER_BATCH", 0.2)
    request = request_for(scene, "bdpm", 60, bdd=0, initial_radius=0.2)
    whole = request.open().session
    for _ in range(60):
        whole.iterate()
    session = cluster.DistributedSession(client, request.open(), False, 1)
    for _ in range(3):
        session.iterate()
    pids = client.run(os.getpid)
    deadline = time.monotonic() + 60
    while (
        not (victims := [worker for worker, keys in client.processing().items() if keys])
        and time.monotonic() < deadline
    ):
        session.iterate()
    in_hand, before = sum(len(batch.numbers) for batch in session._waiting), session.iterations
    os.kill(pids[victims[0]], signal.SIGKILL)
    while session.iterations < 60:
        session.iterate()
    assert in_hand > 0 and before < 60
    assert session.sums.done == Iterations(60)
    assert same(whole.image(), session.image())
    client.wait_for_workers(2, timeout=60)
    assert pids[victims[0]] not in client.run(os.getpid).values()


def test_worker_that_sees_another_scene_is_an_error(scene, client, tmp_path):
    opened = request_for(scene, "path", 4).open()
    session = cluster.DistributedSession(client, opened, False, 1)
    (tmp_path / "lamp.xml").write_text((tmp_path / "lamp.xml").read_text().replace("5, 4", "5, 5"))
    with pytest.raises(
        cluster.ClusterError, match=r"a worker sees another render.*lamp\.xml has changed"
    ):
        iterate_for(session, 60)


def test_workers_are_told_what_a_pilot_found(scene, client):
    """With a time limit it hangs on the clock: a worker that had a pilot of its own would merge
    within another radius."""
    request = request_for(scene, "bdpm", 8, bdd=0)
    opened = request.open()
    told = learned(opened.session, 0.31)
    identity = opened.identity()
    opened.session.recall(told)
    opened.session.iterate(2)
    arrays, done, _ = client.submit(
        cluster.run, cluster.Job("told", request, told, identity, False, 1), [2], pure=False
    ).result()
    assert done == Iterations(0, (2,)) and same(
        opened.session.sums.arrays()["total"], arrays["total"]
    )


def test_error_of_a_worker_leaves_nothing_half_summed(scene, client, monkeypatch):
    """The worker forgets the session in which an iteration failed; the next batch opens it anew."""
    request = request_for(scene, "path", 8)
    opened = request.open()
    job = cluster.Job("test", request, opened.session.learned, opened.identity(), False, 1)
    worker = next(iter(client.scheduler_info()["workers"]))

    def ask(iterations):
        return client.submit(cluster.run, job, iterations, pure=False, workers=[worker]).result()

    expected = ask([4])[0]["total"]
    # After iteration 3 was summed, numpy refuses a negative seed, or the sums a negative iteration.
    with pytest.raises(Exception, match="negative"):
        ask([3, -1])
    arrays, done, _ = ask([4])
    assert done == Iterations(0, (4,))
    np.testing.assert_allclose(arrays["total"], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.long
def test_processes_of_this_machine_and_ctrl_c(scene, tmp_path):
    """Ctrl-C in a terminal reaches the workers, too: what they have rendered is written, and one
    process can go on from it."""
    options = [
        "-i",
        "bdpt",
        "-D",
        "size=48",
        "--spp",
        4000,
        "-o",
        tmp_path / "a.exr",
        "--checkpoint",
        0.2,
    ]
    process = subprocess.Popen(
        command(scene, *options, "--workers", 2),
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 100
        while (
            not (tmp_path / "a.checkpoint").exists()
            and time.monotonic() < deadline
            and process.poll() is None
        ):
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        error = process.communicate(timeout=60)[1]
        assert process.returncode == 130 and "interrupted after" in error, error
    finally:
        process.kill()
    done = checkpoint.read(tmp_path / "a.checkpoint").done
    assert 0 < len(done) == read(tmp_path / "a.exr")[0]["iterations"]
    count = max([done.below, *(number + 1 for number in done.beyond)]) + 2
    options[options.index(4000)] = count
    assert render(scene, *options, "--resume", "--quiet") == 0
    assert (
        render(
            scene,
            "-i",
            "bdpt",
            "-D",
            "size=48",
            "--spp",
            count,
            "-o",
            tmp_path / "b.exr",
            "--quiet",
        )
        == 0
    )
    assert same(read(tmp_path / "b.exr")[1], read(tmp_path / "a.exr")[1])


def test_scheduler_that_is_not_there(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cluster, "CONNECTION_SECONDS", 1)
    assert render(scene, "-o", tmp_path / "a.exr", "--scheduler", "tcp://127.0.0.1:9") == 5
    error = capsys.readouterr().err
    assert "no scheduler at tcp://127.0.0.1:9" in error and error.count("\n") == 1


def test_dask_that_is_missing(scene, tmp_path):
    hidden = (
        "import sys; sys.modules['distributed'] = None; "
        "from mis_integrators.app import cli; sys.exit(cli.main())"
    )
    result = run(
        [
            command(scene)[0],
            "-c",
            hidden,
            str(scene),
            "--workers",
            "2",
            "-o",
            str(tmp_path / "a.exr"),
        ]
    )
    assert (
        result.returncode == 5
        and "mis-integrators[cluster]" in result.stderr
        and result.stderr.count("\n") == 1
    )


def test_numbers_are_handed_out_once(scene):
    """With gaps in what is done already, each missing number below the planned one is given to some
    worker, once."""
    opened = request_for(scene, "path", 0).open()
    session = cluster.DistributedSession.__new__(cluster.DistributedSession)
    session._session, session._next, session._seconds_per_iteration, session.gathering = (
        opened.session,
        0,
        0.3,
        0.01,
    )
    opened.session.sums.done = Iterations(2, (4, 7))
    opened.session.iterations_planned = 12
    session.gathering = (
        2.0  # two workers, of whose time the gatherer may take a tenth: batches of 40 seconds
    )
    opened.session.iterations_planned = 10**6
    assert len(session._take_numbers(2)) == round(40 / 0.3)
    session._next, session.gathering, opened.session.iterations_planned = 0, 0.01, 12
    handed_out = []
    while numbers := session._take_numbers(2):
        handed_out += numbers
    assert handed_out == [2, 3, 5, 6, 8, 9, 10, 11]


@pytest.fixture
def impatient(monkeypatch):
    """Workers are silent, and given up, after seconds."""
    for name, seconds in (
        ("SILENCE", 2.0),
        ("PATIENCE", 2.0),
        ("ANSWER_SECONDS", 2.0),
        ("SECONDS_PER_BATCH", 0.2),
        ("CLOSING_SECONDS", 2.0),
    ):
        monkeypatch.setattr(cluster, name, seconds)


def test_stopped_worker_costs_its_iterations_only(scene, client, impatient):
    """One of two workers hangs with iterations in hand: the other does them, and those that remain;
    each is summed once."""
    request = request_for(scene, "bdpm", 60, bdd=0, initial_radius=0.2)
    whole = request.open().session
    for _ in range(60):
        whole.iterate()
    pids = client.run(os.getpid)
    session = cluster.DistributedSession(client, request.open(), False, 1)
    iterate_for(session, 60, lambda: session.iterations >= 3)
    victim = next(iter(pids))
    stuck: tuple = ()
    while not stuck and session.iterations < 50:  # it may be done before it is stopped
        os.kill(pids[victim], signal.SIGCONT)
        iterate_for(session, 60, lambda: client.processing()[victim])
        os.kill(pids[victim], signal.SIGSTOP)
        stuck, before = client.processing()[victim], session.iterations
    try:
        iterate_for(session, 60, lambda: session.iterations == 60)
        assert stuck and before < 60 and victim in session._watch.silent
    finally:
        os.kill(pids[victim], signal.SIGCONT)
    assert session.sums.done == Iterations(60)
    assert same(whole.image(), session.image())
    # a worker that is heard of again counts again
    iterate_for(session, 20, lambda: not session._watch.silent)
    assert set(session._watch.present) == set(pids)


def test_no_worker_is_heard_of(scene, client, impatient):
    """Before the first result, too. Polls stay short meanwhile, so signals and clocks are
    heeded."""
    pids = client.run(os.getpid)
    session = cluster.DistributedSession(client, request_for(scene, "path", 60).open(), False, 1)
    for pid in pids.values():
        os.kill(pid, signal.SIGSTOP)
    polls, start = [], time.monotonic()
    try:
        with pytest.raises(
            cluster.ClusterError, match=r"there has been no worker for 2 s.*the 2 that it knows"
        ):
            while True:
                polls.append(time.monotonic())
                session.iterate()
    finally:
        for pid in pids.values():
            os.kill(pid, signal.SIGCONT)
    assert 4 < time.monotonic() - start < 15 and max(np.diff(polls[1:])) < 2
    assert session.iterations == 0


@pytest.mark.parametrize(
    "end, message",
    [
        (signal.SIGSTOP, "the scheduler has not answered for 2 s"),
        (signal.SIGKILL, "the scheduler is gone"),
    ],
)
def test_scheduler_that_ends(scene, impatient, monkeypatch, capfd, end, message):
    """One that hangs is waited for in vain for a while; both are left within seconds, and Dask says
    nothing of its own."""
    monkeypatch.setattr(cluster, "PATIENCE", 60.0)
    arguments = [
        "-c",
        "from dask.__main__ import main; main()",
        "scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
    ]
    process = subprocess.Popen([sys.executable, *arguments], stderr=subprocess.PIPE, text=True)
    try:
        address = next(line.split()[-1] for line in process.stderr if "Scheduler at:" in line)
        with pytest.raises(cluster.ClusterError, match=message):
            with cluster.connected(None, address) as client:
                session = cluster.DistributedSession(
                    client, request_for(scene, "path", 4).open(), False, 1
                )
                session.iterate()
                process.send_signal(end)
                start = time.monotonic()
                iterate_for(session, 20)
        assert time.monotonic() - start < 12 and capfd.readouterr().err == ""
    finally:
        process.kill()


def workers_of(process) -> list:
    """Its worker processes, for psutil."""
    import psutil

    found = []
    for child in psutil.Process(process.pid).children():
        with contextlib.suppress(psutil.Error):  # others of its children may have ended meanwhile
            found += [child] if "spawn_main" in " ".join(child.cmdline()) else []
    return found


@pytest.mark.parametrize("end", ["SIGTERM", *extended("time")])
def test_only_worker_is_stopped(scene, tmp_path, end):
    """The time limit and SIGTERM are heeded while nothing comes in: what there is is written, and
    no process stays."""
    options = [
        "-i",
        "bdpt",
        "-D",
        "size=48",
        "-o",
        tmp_path / "a.exr",
        "--checkpoint",
        0.2,
        "--workers",
        1,
    ]
    process = subprocess.Popen(
        command(scene, *options, *(["--time", 7] if end == "time" else ["--spp", 10**6])),
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 100
        while (
            not (tmp_path / "a.checkpoint").exists()
            and time.monotonic() < deadline
            and process.poll() is None
        ):
            time.sleep(0.01)
        workers = workers_of(process)
        assert len(workers) == 1
        workers[0].suspend()
        start = time.monotonic()
        if end == "SIGTERM":
            time.sleep(1)
            process.send_signal(signal.SIGTERM)
        error = process.communicate(timeout=60)[1]
        assert time.monotonic() - start < 20
        assert process.returncode == (0 if end == "time" else 130), error
        assert ("interrupted after" in error) == (end == "SIGTERM")
        assert not workers[0].is_running()
    finally:
        process.kill()
    done = checkpoint.read(tmp_path / "a.checkpoint").done
    assert 0 < len(done) == read(tmp_path / "a.exr")[0]["iterations"]


def test_worker_that_is_stopped_while_it_starts(scene, tmp_path):
    """Interrupted then, the command ends at once, says one line, and leaves no process."""
    process = subprocess.Popen(
        command(scene, "-o", tmp_path / "a.exr", "--workers", 1),
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        workers, deadline = [], time.monotonic() + 60
        while not workers and time.monotonic() < deadline:
            workers = workers_of(process)
        workers[0].suspend()
        time.sleep(1)
        process.send_signal(signal.SIGTERM)
        error = process.communicate(timeout=30)[1]
    finally:
        process.kill()
    assert process.returncode == 130 and error == "mis-render: interrupted, nothing written\n"
    assert not workers[0].is_running()


COUNT_OPENINGS = """
from mis_integrators.app.request import Request
if not hasattr(Request, "open_itself"):
    Request.open_itself = Request.open
    def count(self, *rest):
        Request.tries += 1
        return self.open_itself(*rest)
    Request.open = count
Request.tries = 0
"""


def test_scene_that_a_worker_cannot_open_is_tried_once(scene, client):
    client.run(exec, COUNT_OPENINGS, {})
    session = cluster.DistributedSession(client, request_for(scene, "path", 1).open(), False, 1)
    (scene.parent / "lamp.xml").write_text("<scene>")
    with pytest.raises(
        cluster.ClusterError,
        match=r"a worker cannot open the scene: .*lamp\.xml.*tcp://127\.0\.0\.1",
    ) as raised:
        iterate_for(session, 60)
    assert "\n" not in str(raised.value) and "Traceback" not in str(raised.value)
    tries = client.run(eval, "__import__('mis_integrators').app.request.Request.tries")
    assert sum(tries.values()) == 1


def test_iteration_that_fails_is_tried_once_more_elsewhere(scene, client, monkeypatch):
    session = cluster.DistributedSession(client, request_for(scene, "path", 8).open(), False, 1)
    # the sums refuse a negative iteration, or numpy such a seed
    numbers = iter([[0], [1, -1], [2]])
    monkeypatch.setattr(session, "_take_numbers", lambda workers: next(numbers, []))
    sent, send = [], session._send
    monkeypatch.setattr(
        session, "_send", lambda batch, workers: (sent.append(batch), send(batch, workers))
    )
    with pytest.raises(
        cluster.ClusterError, match=r"a worker failed: .*negative.*tcp://127\.0\.0\.1"
    ):
        iterate_for(session, 60)
    (failed,) = [batch for batch in session._waiting if batch.failed_at]
    assert (
        failed.numbers == [1, -1]
        and sent.count(failed) == 2
        and set(failed.failed_at) == set(client.run(os.getpid))
    )
    assert session.sums.done in (
        Iterations(1),
        Iterations(1, (2,)),
        Iterations(0, (2,)),
        Iterations(),
    )


class FakeFuture:
    def __init__(self, key: str, workers):
        self.key, self.workers, self.result, self.released, self._finished = (
            key,
            workers,
            None,
            False,
            False,
        )
        self._callbacks = []

    def add_done_callback(self, callback):
        self._callbacks.append(callback)

    def done(self) -> bool:
        return self._finished

    def finish(self, result) -> None:
        self.result, self._finished = result, True
        for callback in self._callbacks:
            callback(self)

    def release(self) -> None:
        self.released = True


class FakeClient:
    """A client of two workers that do nothing until they are told to: what is handed out, and by
    whom it is held, is in ``futures``."""

    status = "running"

    def __init__(self):
        self.futures, self.heartbeats = [], {"one": 0.0, "two": 0.0}
        self.loop = SimpleNamespace(asyncio_loop=asyncio.new_event_loop())
        self.scheduler = self
        threading.Thread(target=self.loop.asyncio_loop.run_forever, daemon=True).start()

    def submit(self, function, job, numbers, pure, retries, workers):
        assert retries == 0
        loads = {
            name: sum(future.workers == [name] for future in self.futures)
            for name in workers or self.heartbeats
        }
        self.futures.append(
            FakeFuture(f"{len(self.futures)}: {numbers}", [min(loads, key=loads.get)])
        )
        return self.futures[-1]

    async def identity(self, n_workers):
        return {"workers": {name: {"last_seen": seen} for name, seen in self.heartbeats.items()}}

    async def processing(self, workers):
        return {
            name: [
                future.key
                for future in self.futures
                if future.workers == [name] and not (future.done() or future.released)
            ]
            for name in self.heartbeats
        }

    async def who_has(self, keys):
        return {
            future.key: future.workers
            for future in self.futures
            if future.key in keys and future.done()
        }

    async def gather(self, future, asynchronous):
        if isinstance(future.result, Exception):
            raise future.result
        return future.result


@pytest.fixture
def fakes(scene, monkeypatch):
    """A session of five iterations with a fake client; the other sums are how often each iteration
    was added."""
    monkeypatch.setattr(cluster, "POLL_SECONDS", 0.1)
    monkeypatch.setattr(cluster, "LOOKING_SECONDS", 0.0)
    for name in ("SILENCE", "PATIENCE", "ANSWER_SECONDS"):
        monkeypatch.setattr(cluster, name, float("inf"))
    client, session = (
        FakeClient(),
        SimpleNamespace(sums=Sums(), iterations_planned=5, learned={}, start=lambda: None),
    )
    opened = SimpleNamespace(session=session, identity=dict, request=request_for(scene, "path", 5))
    yield client, cluster.DistributedSession(client, opened, False, 1)
    loop = client.loop.asyncio_loop
    asyncio.run_coroutine_threadsafe(asyncio.sleep(0.1), loop).result()
    loop.call_soon_threadsafe(loop.stop)


def sums_of(*numbers):
    return (
        {"count": np.bincount(numbers, minlength=5).astype(float)},
        Iterations(0, numbers),
        0.1 * len(numbers),
    )


def pass_time(session, seconds) -> None:
    """Let seconds pass in which nothing comes in."""
    session._watch.now += seconds
    for _ in range(2):
        session.iterate()


def test_overdue_batches_are_handed_to_others_and_duplicates_dropped(fakes):
    client, session = fakes
    session.iterate()
    assert [future.key for future in client.futures] == [
        "0: [0]",
        "1: [1]",
        "2: [2]",
        "3: [3]",
    ] and session.sums.done == Iterations()
    # Before the first result nobody knows how long it takes.
    pass_time(session, 0.9 * cluster.FIRST_BATCH_SECONDS)
    assert len(client.futures) == 4
    session._watch.now = 10.0
    for batch in session._waiting:
        batch.copies[0].since = 10.0
    client.futures[0].finish(sums_of(0))
    iterate_for(session, 10, lambda: len(client.futures) == 5)
    assert (
        session.sums.done == Iterations(1)
        and client.futures[0].released
        and client.futures[4].key == "4: [4]"
    )
    pass_time(session, 20)
    assert len(client.futures) == 5  # 30 seconds are allowed, and ten times that of an iteration
    pass_time(session, 20)
    again = client.futures[5:]
    assert [future.key.partition(" ")[2] for future in again] == ["[1]", "[2]", "[3]", "[4]"]
    for future, first in zip(again, client.futures[1:5]):
        assert future.workers != first.workers and not first.released
    # the first copy comes after all, and so does the second, at the same time
    client.futures[1].finish(sums_of(1))
    again[0].finish(sums_of(1))
    again[1].finish(sums_of(2))  # of this one only the second comes in time
    iterate_for(session, 10, lambda: len(session.sums.done) == 3)
    assert again[0].released and client.futures[1].released and client.futures[2].released
    client.futures[2].finish(sums_of(2))
    pass_time(session, 1)
    with pytest.raises(
        cluster.ClusterError, match=r"no worker has finished iteration [34] in 31 s, 3 times"
    ):
        pass_time(session, 60)
        pass_time(session, 60)
    assert session.sums.done == Iterations(3)
    np.testing.assert_array_equal(session.sums["count"], [1, 1, 1, 0, 0])


def test_what_was_rendered_for_a_choice_is_added(fakes):
    """And is not asked of workers again."""
    _, session = fakes
    opened = session._session
    opened.kept = {0: "block", 1: "block"}

    def iterate(number):
        del opened.kept[number]
        opened.sums.done.add(number)

    opened.iterate = iterate
    session.iterate()
    assert not opened.kept and len(opened.sums.done) == 2
    asked = sorted(number for batch in session._waiting for number in batch.numbers)
    assert asked == [2, 3, 4]


def test_time_in_which_the_gatherer_itself_was_stopped_does_not_count(fakes, monkeypatch):
    _, session = fakes
    session.iterate()
    later = time.monotonic() + 10000
    monkeypatch.setattr(cluster.time, "monotonic", lambda: later)
    session._watch.look([])
    monkeypatch.undo()
    assert session._watch.now < 5 and not session._watch.silent


def test_sums_that_cannot_be_fetched(fakes, monkeypatch):
    """They are asked of another worker, three times at most."""
    client, session = fakes
    session._session.iterations_planned = 1
    session.iterate()
    for count in (1, 2):
        client.futures[-1].finish(TimeoutError())
        iterate_for(session, 10, lambda count=count: len(client.futures) == count + 1)
    client.futures[-1].finish(TimeoutError())
    with pytest.raises(cluster.ClusterError, match="the sums of iteration 0 could not be fetched"):
        iterate_for(session, 10)


def test_sums_in_a_worker_that_hangs_are_asked_of_another(fakes, monkeypatch):
    """Batches were finished, but their sums cannot be fetched: this keeps nobody from fetching
    those of others."""
    client, session = fakes
    session.iterate()
    hanging = [future for future in client.futures if future.workers == ["one"]]
    never = asyncio.run_coroutine_threadsafe(asyncio.sleep(1000), client.loop.asyncio_loop)
    monkeypatch.setattr(
        client,
        "gather",
        lambda future, asynchronous, gather=client.gather: (
            asyncio.wrap_future(never, loop=client.loop.asyncio_loop)
            if future in hanging
            else gather(future, asynchronous)
        ),
    )
    for future in hanging:
        future.finish(None)
    pass_time(session, 0)
    monkeypatch.setattr(cluster, "SILENCE", 0.5)
    for _ in range(8):
        client.heartbeats["two"] += 1
        session.iterate()
    assert (
        session._watch.silent == {"one"}
        and [future.workers for future in client.futures] == [["one"], ["two"]] * 2 + [["two"]] * 2
    )
    for future in client.futures[1:]:
        if future not in hanging:
            future.finish(sums_of(*eval(future.key.partition(" ")[2])))

    def beat():
        client.heartbeats["two"] += 1
        return len(session.sums.done) == 4

    iterate_for(session, 10, beat)
    assert session.sums.done == Iterations(4) and all(
        future.released for future in client.futures[:6]
    )
    never.cancel()


@pytest.mark.parametrize(
    "address, message",
    [
        ("tls://127.0.0.1:9", "distributed.comm.tls.ca-file"),
        ("nonsense", "no scheduler at nonsense: "),
        ("http://x:1", "no scheduler at http://x:1: "),
        ("::::", "no scheduler at ::::"),
        ("tcp://127.0.0.1:x", "no scheduler at tcp://127.0.0.1:x: "),
        ("inproc://1", "no scheduler at inproc://1: "),
    ],
)
def test_addresses_that_are_none(address, message, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECTION_SECONDS", 1)
    with pytest.raises(cluster.ClusterError, match=message) as raised:
        with cluster.connected(None, address):
            pass
    assert "\n" not in str(raised.value)
