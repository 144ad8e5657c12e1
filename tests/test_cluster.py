"""Renders whose iterations are spread over processes: the image is that of one process, whatever happens to workers."""

import os
import signal
import subprocess
import time

import numpy as np
import pytest
from lamplit import ROOT, command, read, render, run, same, write_scene

from mis_integrators import checkpoint, cluster
from mis_integrators.opening import Request
from mis_integrators.sums import Iterations

pytest.importorskip("distributed", reason="dask.distributed is not installed: pip install 'mis-integrators[cluster]'")


@pytest.fixture
def scene(tmp_path, rgb):
    return write_scene(tmp_path)


@pytest.fixture(scope="module")
def client():
    """Two workers of one thread each."""
    with cluster.connected(2, None) as client:
        yield client


def request_for(scene, plugin, spp, **parameters) -> Request:
    return Request(scene=str(scene), variables={"size": "48"}, plugin=plugin, parameters=parameters, variant="llvm_ad_rgb", sensor=0,
                   all_views=False, seed=7, spp=spp, fine=True)


def test_image_is_that_of_one_process(scene, tmp_path, client):
    """Through the scheduler's address, from a checkpoint on, with a pilot whose result the workers must be told (its radius is for the three samples
    that were planned then)."""
    options = ["-i", "bdpm_opt3", "-P", "mix_diffuse=true", "-P", "variance=true", "--seed", 3, "--quiet"]
    for name, where in (("one", []), ("two", ["--scheduler", client.scheduler.address])):
        assert render(scene, *options, "--spp", 3, "-o", tmp_path / f"{name}.exr", "--checkpoint", 100) == 0
        assert render(scene, *options, "--spp", 12, "-o", tmp_path / f"{name}.exr", "--resume", *where) == 0
    (one_header, one), (header, image) = (read(tmp_path / f"{name}.exr") for name in ("one", "two"))
    assert header["iterations"] == one_header["iterations"] == 12 and header["radius.indirect"] == one_header["radius.indirect"]
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
    while not (victims := [worker for worker, keys in client.processing().items() if keys]) and time.monotonic() < deadline:
        session.iterate()
    in_hand, before = sum(map(len, session._waiting.values())), session.iterations
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
    with pytest.raises(cluster.ClusterError, match="a worker sees another render.*lamp.xml has changed"):
        session.iterate()


def test_workers_are_told_what_a_pilot_found(scene, client):
    """With a time limit it hangs on the clock: a worker that had a pilot of its own would merge within another radius."""
    request = request_for(scene, "bdpm", 8, bdd=0)
    opened = request.open()
    told = {"radii": {kind: 0.31 for kind in opened.session.kinds()}, "corrected": {kind: False for kind in opened.session.kinds()},
            "camera_paths": 2}
    identity = opened.identity()
    opened.session.recall(told)
    opened.session.iterate(2)
    arrays, done, _ = client.submit(cluster.run, cluster.Job("told", request, told, identity, False, 1), [2], pure=False).result()
    assert done == Iterations(0, (2,)) and same(opened.session.sums.arrays()["total"], arrays["total"])


def test_error_of_a_worker_leaves_nothing_half_summed(scene, client, monkeypatch):
    """The worker forgets the session in which an iteration failed; the next batch opens it anew."""
    request = request_for(scene, "path", 8)
    opened = request.open()
    job = cluster.Job("test", request, opened.session.learned, opened.identity(), False, 1)
    worker = list(client.scheduler_info()["workers"])[0]

    def ask(iterations):
        return client.submit(cluster.run, job, iterations, pure=False, workers=[worker]).result()

    expected = ask([4])[0]["total"]
    with pytest.raises(Exception):
        ask([3, -1])                     # numpy refuses a negative seed, or the sums a negative iteration, after iteration 3 was summed
    arrays, done, _ = ask([4])
    assert done == Iterations(0, (4,))
    np.testing.assert_allclose(arrays["total"], expected, rtol=1e-4, atol=1e-6)


def test_processes_of_this_machine_and_ctrl_c(scene, tmp_path):
    """Ctrl-C in a terminal reaches the workers, too: what they have rendered is written, and one process can go on from it."""
    options = ["-i", "bdpt", "-D", "size=48", "--spp", 4000, "-o", tmp_path / "a.exr", "--checkpoint", 0.2]
    process = subprocess.Popen(command(scene, *options, "--workers", 2), cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        deadline = time.monotonic() + 100
        while not (tmp_path / "a.checkpoint").exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=60) == 130
        assert "interrupted after" in process.stderr.read()
    finally:
        process.kill()
    done = checkpoint.read(tmp_path / "a.checkpoint").done
    assert 0 < len(done) == read(tmp_path / "a.exr")[0]["iterations"]
    count = max([done.below, *(number + 1 for number in done.beyond)]) + 2
    options[options.index(4000)] = count
    assert render(scene, *options, "--resume", "--quiet") == 0
    assert render(scene, "-i", "bdpt", "-D", "size=48", "--spp", count, "-o", tmp_path / "b.exr", "--quiet") == 0
    assert same(read(tmp_path / "b.exr")[1], read(tmp_path / "a.exr")[1])


def test_scheduler_that_is_not_there(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cluster, "CONNECTION_SECONDS", 1)
    assert render(scene, "-o", tmp_path / "a.exr", "--scheduler", "tcp://127.0.0.1:9") == 5
    error = capsys.readouterr().err
    assert "no scheduler at tcp://127.0.0.1:9" in error and error.count("\n") == 1


def test_dask_that_is_missing(scene, tmp_path):
    hidden = "import sys; sys.modules['distributed'] = None; from mis_integrators import cli; sys.exit(cli.main())"
    result = run([command(scene)[0], "-c", hidden, str(scene), "--workers", "2", "-o", str(tmp_path / "a.exr")])
    assert result.returncode == 5 and "mis-integrators[cluster]" in result.stderr and result.stderr.count("\n") == 1


def test_numbers_are_handed_out_once(scene):
    """With gaps in what is done already, each missing number below the planned one is given to some worker, once."""
    opened = request_for(scene, "path", 0).open()
    session = cluster.DistributedSession.__new__(cluster.DistributedSession)
    session._session, session._next, session._seconds_per_iteration, session.gathering = opened.session, 0, 0.3, 0.01
    opened.session.sums.done = Iterations(2, (4, 7))
    opened.session.iterations_planned = 12
    session.gathering = 2.0                     # two workers, of whose time the gatherer may take a tenth: batches of 40 seconds
    opened.session.iterations_planned = 10**6
    assert len(session._take_numbers(2)) == round(40 / 0.3)
    session._next, session.gathering, opened.session.iterations_planned = 0, 0.01, 12
    handed_out = []
    while numbers := session._take_numbers(2):
        handed_out += numbers
    assert handed_out == [2, 3, 5, 6, 8, 9, 10, 11]
