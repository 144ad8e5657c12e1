"""What an iteration of bdpm costs and where, next to one sample per pixel of Mitsuba's path."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median

from mis_integrators.photons.gather import mean_photon_count
from mis_integrators.photons.queries import read_queries

import drjit as dr
import mitsuba as mi

from common.memory import PeakMemory
from common.methods import Method, SessionMaker
from common.rows import Row, save, show, tell
from common.scene_files import OpenScene, open_scene
from common.turns import Contender, take_turns

WARM_UP = 3
SIZE_OF_SWEEP = 256
"""Edge of the square film at which the number of light paths is varied."""
TRIFLE = 0.05
"""Of the time of the longest kernel: kernels that only number paths take less."""
COLUMNS = {
    "cost": (
        "size",
        "light paths",
        "radius",
        "photons a gather",
        "iteration ms",
        "light ms",
        "grid ms",
        "camera ms",
        "gather ms",
        "direct ms",
        "probes ms",
        "no kernel share",
        "path ms",
        "ratio",
        "ratio with probes",
    ),
    "rates": (
        "size",
        "light paths",
        "light paths/s",
        "photons",
        "photons inserted/s",
        "gathers",
        "gathers/s",
        "photons gathered/s",
        "path samples/s",
        "peak MiB",
        "arrays MiB",
    ),
}


def run(options: argparse.Namespace) -> None:
    """The sub-command ``throughput``."""
    pairs = configurations(options.sizes, options.light_paths, options.full)
    if options.quick:
        pairs = [(SIZE_OF_SWEEP, SIZE_OF_SWEEP**2)]
    rows: list[Row] = []
    for path in options.scenes:
        mine: list[Row] = []
        for size, light_paths in pairs:
            mine.append(measure(path, size, light_paths, options.photons, options.time))
            save(options.out, "throughput", rows + mine, vars(options))
        rows += mine
        name = mine[0]["scene"]
        show(f"{name}: milliseconds of an iteration, bdd = 0", mine, COLUMNS["cost"])
        show(f"{name}: rates of its parts, and peak memory", mine, COLUMNS["rates"])


def configurations(sizes: list[int], light_paths: list[int], full: bool) -> list[tuple[int, int]]:
    """Pairs of film edge and light paths: as many light paths as pixels for each size, and each
    number of light paths at one size; with ``full`` at every size."""
    swept = sizes if full else [SIZE_OF_SWEEP]
    square = [(size, size * size) for size in sizes]
    return square + [(size, count) for size in swept for count in light_paths]


class Parts:
    """Milliseconds of a session's iterations by part, from the kernels that they run."""

    def __init__(self, session):
        self._session = session
        self._kernels: dict[str, list[dict]] = {"light": [], "grid": []}
        self._light_pass, self._map_pass = session._photons, session._map_pass
        session._photons, session._map_pass = self._photons, self._maps
        self._add_direct_light = session.direct_light.add_to
        session.direct_light.add_to = self._direct_light
        self.rows: list[dict[str, float]] = []

    def __getitem__(self, part: str) -> float:
        """The median over the iterations: of ``light``, ``grid``, ``camera``, ``gather`` (with the
        probes, if any), ``direct`` (paths for direct light alone), or of ``idle``, the share of an
        iteration in which no kernel runs (Python, launches)."""
        return median(row[part] for row in self.rows)

    def observe(self, kernels: list[dict], seconds: float) -> None:
        """Sort one iteration's kernels: those of the light pass, of the maps and of the gather are
        set aside when these are done; of the last, those up to the first one that is as wide as all
        camera paths, and no trifle, are the camera pass. The rest is direct light alone."""
        mine = self._kernels["rest"]
        longest = max(kernel["execution_time"] for kernel in mine)
        camera = 1 + next(
            i
            for i, kernel in enumerate(mine)
            if kernel["type"] == dr.KernelType.JIT
            and kernel["size"] == self._session.chunk
            and kernel["execution_time"] > TRIFLE * longest
        )
        parts = {
            **{part: self._kernels[part] for part in ("light", "grid")},
            "camera": mine[:camera],
            "gather": mine[camera:],
            "direct": kernels,
        }
        row = {
            part: sum(kernel["execution_time"] for kernel in mine) for part, mine in parts.items()
        }
        self.rows.append({**row, "idle": 1 - sum(row.values()) / 1000 / seconds})

    def _photons(self, *args):
        photons = self._light_pass(*args)
        self._kernels["light"] = dr.kernel_history()
        if self._session._map_pass != self._maps:  # recorded anew, with more room
            self._map_pass, self._session._map_pass = self._session._map_pass, self._maps
        return photons

    def _direct_light(self, *args):
        self._kernels["rest"] = dr.kernel_history()
        return self._add_direct_light(*args)

    def _maps(self, *args):
        maps = self._map_pass(*args)
        self._kernels["grid"] = dr.kernel_history()
        return maps


def measure(
    path: Path, size: int, light_paths: int, photons_a_gather: float, seconds: float
) -> Row:
    """One row: bdpm without and with coverage probes, and path, taking turns for ``seconds``
    each."""
    tell(f"{path.stem} {size}x{size}, {light_paths} light paths: compiling")
    opened = open_scene(path, (size, size))
    start = time.perf_counter()
    peak = PeakMemory()
    plain = new_session(opened, light_paths, first_guess(opened))
    radius, photons, gathers, gathered = radius_for(plain, photons_a_gather)
    plain, probing = (new_session(opened, light_paths, radius) for _ in range(2))
    probing.corrects = lambda kind: kind == "indirect"
    for session in (plain, probing):
        for _ in range(WARM_UP):
            session.iterate()
    memory = peak.process, peak.arrays
    path_maker = SessionMaker(Method("path", "path"), opened, seconds)
    compiling = time.perf_counter() - start

    parts, parts_probing = Parts(plain), Parts(probing)
    contenders = [
        Contender("plain", plain, observe=parts.observe),
        Contender("probing", probing, observe=parts_probing.observe),
    ]
    contenders.append(Contender("path", path_maker.make(seed=0)))
    take_turns(contenders, seconds, tell)
    iteration, with_probes, path_pass = (1000 * median(c.seconds) for c in contenders)
    path_sample = path_pass / contenders[2].session.camera_paths
    return {
        "scene": opened.name,
        "size": f"{size}x{size}",
        "light paths": light_paths,
        "radius": radius,
        "photons a gather": gathered,
        "iteration ms": iteration,
        "light ms": parts["light"],
        "grid ms": parts["grid"],
        "camera ms": parts["camera"],
        "gather ms": parts["gather"],
        "direct ms": parts["direct"],
        "probes ms": parts_probing["gather"] - parts["gather"],
        "no kernel share": parts["idle"],
        "path ms": path_sample,
        "ratio": iteration / path_sample,
        "ratio with probes": with_probes / path_sample,
        "light paths/s": 1000 * light_paths / parts["light"],
        "photons": photons,
        "photons inserted/s": 1000 * photons / parts["grid"],
        "gathers": gathers,
        "gathers/s": 1000 * gathers / parts["gather"],
        "photons gathered/s": 1000 * gathers * gathered / parts["gather"],
        "path samples/s": 1000 * opened.pixels / path_sample,
        "peak MiB": memory[0],
        "arrays MiB": memory[1],
        "iterations": contenders[0].session.iterations,
        "compiling s": compiling,
    }


def new_session(opened: OpenScene, light_paths: int, radius: float):
    """A session of bdpm that gathers at the first smooth vertex within a given radius."""
    parameters = {"bdd": 0, "photon_count": light_paths, "initial_radius": radius}
    integrator = Method("bdpm", "bdpm", parameters).integrator(opened)
    return integrator.session(opened.scene, opened.sensor, seed=0, spp=0)


def first_guess(opened: OpenScene) -> float:
    """A radius to start the search with."""
    box = opened.scene.bbox()
    return 0.01 * float(dr.norm(box.extents()))


def radius_for(session, photons_a_gather: float) -> tuple[float, int, int, float]:
    """The radius at which a gather finds so many photons, all photon maps together.

    Returns it with an iteration's photons, the camera vertices that gather, and how many photons
    each finds.
    """
    spectral = session._spectral(0)
    photons = session._photons(0, spectral)
    camera_pass = session.describe_camera_pass(
        session.sensor,
        session._sequence(0, 1, session.camera_paths),
        session.part_of_paths(mi.UInt32(0)),
        spectral,
    )
    _, _, _, vertices, *_ = session._trace_camera(camera_pass, session.vertex_capacity, spectral)
    vertices = read_queries(vertices)
    radius = session.integrator.initial_radius
    for _ in range(3):
        opaque = dr.opaque(mi.Float, radius)
        found = sum(
            mean_photon_count(session._map(photons, kind, opaque), vertices, opaque)
            for kind in session.kinds()
        )
        if abs(found / photons_a_gather - 1) < 0.05:
            break
        radius *= (photons_a_gather / max(found, 1e-3)) ** 0.5
    used = int(dr.count(dr.max(vertices["throughput"]) > 0)[0])
    return radius, int(photons[2][0]), used, found
