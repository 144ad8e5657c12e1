"""Several views at once: ``volpath_multiview`` against ``volpath`` of each view alone, in equal
time, for all views of a scene and for the first few; shares of invalid shifts; densities of the
shifts.

Variances are those of whole renders under different seeds, so they need no reference; each is
divided by the squared mean + 0.01 before it is averaged over pixels. With `--charts`, Figure 3 of
the paper is drawn: shifted densities.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from mis_integrators.analysis.metrics import RELATIVE_OFFSET
from mis_integrators.app import loading
from mis_integrators.core.session import PATHS_PER_PASS
from mis_integrators.volume.shifts import SHIFTS, Sections, majorant_at, optical_depth
from mis_integrators.volume.views import views_of

import drjit as dr
import mitsuba as mi
import numpy as np
from reports import Row, save, show, tell
from scene_files import BUNDLED

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
        return self.session.iterations * self.session.samples_per_iteration


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
    rows: list[Row] = []
    for path in options.scenes:
        rows += compare(path, options)
        show("Variance x time of volpath_multiview over that of volpath", rows)
        save(options.out, "multiview", rows, vars(options))
    shares = [share for path in options.scenes for share in invalid_shifts(path, options)]
    show("Connections of one iteration", shares)
    save(options.out, "multiview_shifts", shares, vars(options))
    if options.charts:
        draw_densities(options.out / "multiview_densities.png")


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


@dataclass
class Race:
    """What came of renders of all views in equal time: per method and seed the views side by side
    (H, W, 3) and `(seconds, samples a pixel)`."""

    views: int
    images: dict[str, list[np.ndarray]]
    used: dict[str, list[tuple[float, int]]]

    @property
    def mean(self) -> np.ndarray:
        """Mean of the renders by `volpath`."""
        return np.mean(self.images["volpath"], axis=0)

    def noise(self, name: str) -> np.ndarray:
        """Relative variance of one render (H, W, 3)."""
        return np.var(self.images[name], axis=0, ddof=1) / (self.mean**2 + RELATIVE_OFFSET)

    def seconds(self, name: str) -> float:
        """Seconds that a render took: iterations overrun a little."""
        return float(np.mean([s for s, _ in self.used[name]]))

    def samples(self, name: str) -> int:
        """Camera paths a pixel."""
        return round(np.mean([n for _, n in self.used[name]]))

    def cost(self, name: str) -> float:
        """Relative variance x seconds."""
        return self.seconds(name) * float(self.noise(name).mean())


def race(
    scene, parameters: dict, methods: dict[str, dict], label: str, options: argparse.Namespace
) -> Race:
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


# --- Figure 3 -----------------------------------------------------------------


def draw_densities(path: Path) -> None:
    """Densities of interactions shifted from a segment on [0, 9] to one on [0, 3], next to the
    target's own: tentative, null and real."""
    import matplotlib.pyplot as plt

    target = Sections([0.0], [3.0], [2.0])

    def real(t):  # extinction on the target
        return 1.0 + 0.8 * np.sin(2.5 * t)

    grid = np.linspace(1e-4, 3 - 1e-4, 600)
    own = 2.0 * np.exp(-optical_depth(target, grid))
    rng = np.random.default_rng(0)
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), sharey=True)
    for axis, majorant in zip(axes, (0.2, 0.7, 2.0)):
        base = Sections([0.0, 4.5], [4.5, 9.0], [majorant * 1.5, majorant * 0.5])
        axis.plot(grid, own, "k", label="tentative")
        axis.plot(grid, own * (1 - real(grid) / 2), "k--", label="null")
        axis.plot(grid, own * real(grid) / 2, "k:", label="real")
        for name in ("raw_depth", "majorant_optical_depth", "primary_sample"):
            # Density of one interaction at t' if the base places the first one: p(t) / |S'|, p the
            # free flight of the base.
            t = np.sort(rng.uniform(0, 9, 4000))
            shifted = SHIFTS[name](base, target, t)
            density = majorant_at(base, t) * np.exp(-optical_depth(base, t)) / shifted.jacobian
            axis.plot(shifted.t, density, label=name.replace("_", " "))
        axis.set(
            title=f"base majorant {1.5 * majorant:.2g}, then {0.5 * majorant:.2g} [1/m]",
            xlabel="t' [m]",
            ylim=(0, 2.6),
        )
    axes[0].set_ylabel("density [1/m]")
    axes[-1].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)
