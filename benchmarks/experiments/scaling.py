"""How iterations a second grow with the number of local worker processes, one thread each, and what
bounds them.

With t the seconds of an iteration on one worker, g those that the gatherer needs to fetch and add a
batch, and b the iterations of a batch, N workers make min(N / t, b / g) iterations a second: the
gatherer adds one batch at a time. Batches grow with g, so that it is idle most of the time. On one
machine the workers share caches and memory besides, which shows as an efficiency below one.
"""

from __future__ import annotations

import argparse
import os
import time

from mis_integrators.app import cluster
from mis_integrators.app.request import Request

import drjit as dr

from common.rows import Row, save, show, tell
from common.scene_files import scaled_size

BATCHES_BEFORE = 6
"""Batches of each worker before the clock starts: the first ones compile, and find out how long
batches should be."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``scaling``."""
    rows: list[Row] = []
    for path in options.scenes:
        size = scaled_size(path, options.scale)
        variables = {"resx": str(size[0]), "resy": str(size[1])} if size else {}
        for method in options.integrators:
            request = Request(
                str(path),
                variables,
                method.plugin,
                dict(method.parameters),
                "llvm_ad_rgb",
                0,
                False,
                0,
                0,
                True,
            )
            alone: float | None = None
            for workers in options.workers:
                tell(f"{path.stem}, {method.label}: {workers} workers")
                speed, gathering, batch = iterations_a_second(request, workers, options.time)
                alone = alone or speed
                rows.append(
                    {
                        "scene": path.stem,
                        "scale": options.scale,
                        "method": method.label,
                        "workers": workers,
                        "cores": os.cpu_count(),
                        "load": os.getloadavg()[0],
                        "iterations/s": speed,
                        "speed-up": speed / alone,
                        "efficiency": speed / alone / (workers / options.workers[0]),
                        "gathering ms": 1000 * gathering,
                        "iterations a batch": batch,
                        "most workers": batch / (alone / options.workers[0]) / max(gathering, 1e-9),
                    }
                )
                show("Scaling", rows)
                save(options.out, "scaling", rows, vars(options))


def iterations_a_second(
    request: Request, workers: int, seconds: float
) -> tuple[float, float, float]:
    """Iterations a second once all workers have compiled, the mean seconds to gather a batch, and
    the mean iterations of one."""
    with cluster.connected(workers, None) as client:
        session = cluster.DistributedSession(client, request.open(), False, 1)
        while session.batches < BATCHES_BEFORE * workers:
            session.iterate()
        start, done, before, gathering = (
            time.perf_counter(),
            session.iterations,
            session.batches,
            [],
        )
        while time.perf_counter() - start < seconds:
            batches = session.batches
            session.iterate()
            gathering += [session.gathering] * (session.batches > batches)
        dr.sync_thread()
        count, batches = session.iterations - done, session.batches - before
        return (
            count / (time.perf_counter() - start),
            sum(gathering) / max(len(gathering), 1),
            count / max(batches, 1),
        )
