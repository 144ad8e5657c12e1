"""Several views at once: ``volpath_multiview`` against ``volpath`` of each view alone, in equal
time, for all views of a scene and for the first few; shares of invalid shifts; densities of the
shifts.

Variances are those of whole renders under different seeds, so they need no reference; each is
divided by the squared mean + 0.01 before it is averaged over pixels. With `--charts`, Figure 3 of
the paper is drawn: shifted densities. With `--shifts` the six shifts are compared instead of the
weights.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from xml.etree import ElementTree

from mis_integrators.app import loading
from mis_integrators.core.session import PATHS_PER_PASS
from mis_integrators.volume.shifts import SHIFTS
from mis_integrators.volume.views import views_of

import drjit as dr
import mitsuba as mi
import numpy as np

from common.races import Race
from common.rows import Row, save, show, tell
from common.scene_files import BUNDLED
from report.figures import (
    BASE_MAJORANTS,
    STRETCHES,
    TARGET,
    base_segment,
    draw_densities,
    own_densities,
)

SCENES = sorted((BUNDLED / "multiview").glob("*.xml"))
SLICE_SECONDS = 0.3


class Together:
    """All views by one session of `volpath_multiview`."""

    def __init__(self, scene, parameters):
        self.session = mi.load_dict({"type": "volpath_multiview", **parameters}).views_session(
            scene
        )

    def restart(self, seed):
        self.session.restart(seed)

    def iterate(self):
        self.session.iterate()

    def images(self):
        return [np.array(image)[:, :, :3] for image in self.session.view_tensors()]

    @property
    def samples(self):
        """Camera paths a pixel so far."""
        return self.session.iterations * self.session.camera_paths


class Apart:
    """Each view, or each batch of views, by a render of its own, in passes as large as the time
    allows: what a pass costs besides counts little."""

    def __init__(self, scene, parameters, plugin="volpath"):
        self.scene, self.integrator = scene, mi.load_dict({"type": plugin, **parameters})
        self.spp = 1
        self.restart(0)
        for _ in range(2):
            self.iterate()  # compile

    def tune(self, seconds):
        """Chooses the samples of a pass so that one lasts about `seconds`: small passes mostly wait
        for their longest paths."""
        used = []
        for self.spp in (1, 9):
            self.iterate()  # compile
            start = time.perf_counter()
            self.iterate()
            used.append(time.perf_counter() - start)
        per_sample = max((used[1] - used[0]) / 8, 1e-4)
        width, height = self.scene.sensors()[0].film().crop_size()
        self.spp = int(
            np.clip((seconds - used[0]) / per_sample, 1, PATHS_PER_PASS // (width * height))
        )

    def restart(self, seed):
        self.seed, self.passes, self.sum, self.samples = seed, 0, 0.0, 0

    def iterate(self):
        images = []
        for number in range(len(self.scene.sensors())):
            seed = int(
                np.random.SeedSequence((self.seed, self.passes, number)).generate_state(1)[0]
            )
            with dr.suspend_grad():
                images.append(
                    np.array(
                        mi.render(
                            self.scene,
                            sensor=number,
                            integrator=self.integrator,
                            seed=seed,
                            spp=self.spp,
                        )
                    )[:, :, :3]
                )
        self.sum = [
            self.spp * image + before
            for image, before in zip(images, self.sum or [0.0] * len(images))
        ]
        self.passes += 1
        self.samples += self.spp

    def images(self):
        return [image / self.samples for image in self.sum]


def run(options: argparse.Namespace) -> None:
    """The sub-command ``multiview``."""
    if options.shifts:
        table: list[Row] = []
        for path in options.scenes:
            table += compare_shifts(path, options)
            show("Shifts: ratios to volpath, and lost shares", table)
            save(options.out, "multiview_shift_table", table, vars(options))
        return
    rows: list[Row] = []
    for path in options.scenes:
        rows += compare(path, options)
        show("Variance x time of volpath_multiview over that of volpath", rows)
        save(options.out, "multiview", rows, vars(options))
    if options.lost_shares:
        shares = [share for path in options.scenes for share in invalid_shifts(path, options)]
        show("Connections of one iteration", shares)
        save(options.out, "multiview_shifts", shares, vars(options))
    if options.charts:
        draw_densities(options.out / "multiview_densities.png")
        distances = density_distances()
        show("Distance of shifted densities from the target's own", distances)
        save(options.out, "multiview_densities", distances, vars(options))


def density_distances() -> list[Row]:
    """Total variation distances, in the figure of the shifted densities, of the density that a
    stretch brings to the target from the target's tentative, null and real ones; all of them
    normalised."""
    grid = np.linspace(0, 3, 3001)
    middle, step = 0.5 * (grid[1:] + grid[:-1]), grid[1] - grid[0]
    tentative, null, real = (
        density / (density.sum() * step) for density in own_densities(TARGET, 3.0, middle)
    )
    rows: list[Row] = []
    for majorant in BASE_MAJORANTS:
        base = base_segment(majorant)
        t = np.linspace(1e-4, 9 - 1e-4, 200_000)
        first = own_densities(base, 9.0, t)[0]
        for name in STRETCHES:
            at = SHIFTS[name](base, TARGET, t).t
            shifted = np.histogram(at, grid, weights=first)[0]
            shifted = shifted / (shifted.sum() * step)
            rows.append(
                {
                    "base majorant": 1.5 * majorant,
                    "stretch": name,
                    **{
                        what: float(0.5 * np.abs(shifted - own).sum() * step)
                        for what, own in (("tentative", tentative), ("null", null), ("real", real))
                    },
                }
            )
    return rows


def load(path: Path, scale: float, count: int | None = None):
    """A scene with films of `scale` times their size, and what its integrator hands on. `count`:
    only its first views (children of its batch, or sensors)."""
    loaded = loading.load(path, {}, None, {})
    parameters = {
        name: loaded.parameters[name] for name in loading.INHERITED if name in loaded.parameters
    }
    sensor = loaded.scene.sensors()[0]
    views, (width, height) = len(views_of(sensor)), (int(x) for x in sensor.film().crop_size())
    kept = min(count or views, views)
    size = {
        "resx": str(kept * max(1, round(width // views * scale))),
        "resy": str(max(1, round(height * scale))),
    }
    root = ElementTree.parse(path).getroot()
    group = next((s for s in root.findall("sensor") if s.get("type") == "batch"), root)
    for extra in group.findall("sensor")[count:] if count else []:
        group.remove(extra)
    mi.file_resolver().prepend(str(path.parent))
    return mi.load_string(ElementTree.tostring(root, encoding="unicode"), **size), parameters


def race(scene, parameters: dict, methods: dict, label: str, options: argparse.Namespace) -> Race:
    """Renders by `volpath` and by `volpath_multiview` with the parameters of each of the `methods`,
    `options.seeds` of each."""
    apart = Apart(scene, parameters)
    apart.tune(options.time)
    together = {name: Together(scene, {**parameters, **more}) for name, more in methods.items()}
    contenders = {"volpath": apart, **together}
    for contender in together.values():
        for _ in range(3):
            contender.iterate()  # compile and record
    images, used = {name: [] for name in contenders}, {name: [] for name in contenders}
    for seed in range(1, options.seeds + 1):
        seconds = equal_time(contenders, seed, options.time)
        for name, contender in contenders.items():
            images[name].append(np.concatenate(contender.images(), axis=1))
            used[name].append((seconds[name], contender.samples))
        tell(f"{label}: {seed} of {options.seeds} seeds")
    return Race(next(iter(together.values())).session.views.count, images, used)


def compare(path: Path, options: argparse.Namespace) -> list[Row]:
    """A row for each choice of weights: the ratio of variance times time to that of `volpath`, over
    all pixels and for single views."""
    scene, parameters = load(path, options.scale)
    run = race(
        scene,
        parameters,
        {weights: {"weights": weights} for weights in options.weights},
        path.stem,
        options,
    )
    rows = []
    for name in options.weights:
        ratios = [
            a.mean() / b.mean()
            for a, b in zip(
                *(
                    np.array_split(run.noise(n).mean(axis=-1), run.views, axis=1)
                    for n in (name, "volpath")
                )
            )
        ]
        times = run.seconds(name) / run.seconds("volpath")
        rows.append(
            {
                "scene": path.stem,
                "views": run.views,
                "weights": name,
                "ratio": run.cost(name) / run.cost("volpath"),
                "best view": times * float(min(ratios)),
                "worst view": times * float(max(ratios)),
                "mean ratio": float(np.mean(run.images[name]) / run.mean.mean()),
                "samples": run.samples(name),
                "volpath samples": run.samples("volpath"),
                "time ratio": times,
            }
        )
    return rows


def compare_shifts(path: Path, options: argparse.Namespace) -> list[Row]:
    """A row for each shift, for stretches without and with added null interactions (the paper has
    none): variance of a camera path, seconds of one, and their product, over those of `volpath`;
    the share of connections that the shift loses, of those that see the pivot."""
    scene, parameters = load(path, options.scale)
    methods = {
        (shift, add): {"shift": shift, "add_nulls": add}
        for add in (False, True)
        for shift in SHIFTS
        if not (add and shift.endswith("copy"))  # of no effect there
    }
    run = race(scene, parameters, methods, path.stem, options)
    lost = {row["shift"]: row["invalid"] for row in invalid_shifts(path, options)}

    def variance(name) -> float:
        return float(run.noise(name).mean()) * run.samples(name)

    def seconds(name) -> float:
        return run.seconds(name) / run.samples(name)

    return [
        {
            "scene": path.stem,
            "views": run.views,
            "shift": shift,
            "added nulls": "yes" if add else "no",
            "variance": variance((shift, add)) / variance("volpath"),
            "seconds": seconds((shift, add)) / seconds("volpath"),
            "variance x time": run.cost((shift, add)) / run.cost("volpath"),
            "lost": lost[shift],
            "mean ratio": float(np.mean(run.images[shift, add]) / run.mean.mean()),
        }
        for shift, add in methods
    ]


def equal_time(contenders: dict, seed: int, seconds: float) -> dict[str, float]:
    """Lets each contender render for about so long, in turns: another iteration is begun if that
    brings the time used closer to it. Returns what each has used."""
    used, last = dict.fromkeys(contenders, 0.0), dict.fromkeys(contenders, 0.0)
    for contender in contenders.values():
        contender.restart(seed)
    while unfinished := [name for name in contenders if used[name] + 0.5 * last[name] < seconds]:
        for name in unfinished:
            end = used[name] + SLICE_SECONDS
            while used[name] < end and used[name] + 0.5 * last[name] < seconds:
                start = time.perf_counter()
                contenders[name].iterate()
                last[name] = time.perf_counter() - start
                used[name] += last[name]
    return used


def invalid_shifts(path: Path, options: argparse.Namespace) -> list[Row]:
    """What becomes of connections between views, for each shift."""
    scene, parameters = load(path, options.scale)
    rows = []
    for shift in SHIFTS:
        session = Together(scene, {**parameters, "shift": shift, "max_depth": 2}).session
        session.iterate()
        counts = session.statistics
        seen = max(counts["reached"] + counts["lost"], 1)
        rows.append(
            {
                "scene": path.stem,
                "shift": shift,
                "seen": (counts["reached"] + counts["lost"]) / max(counts["tried"], 1),
                "invalid": counts["lost"] / seen,
            }
        )
    return rows
