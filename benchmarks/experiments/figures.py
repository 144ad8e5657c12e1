"""All figures of docs/results.md, by the other sub-commands: kept in docs/results.json, from which
the page's tables are written."""

from __future__ import annotations

import argparse
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mis_integrators.app import denoising, loading

from common.rows import Row, console, document, machine
from common.scene_files import BUNDLED, name_of
from common.winners import winners
from experiments import multiview
from report import results

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results.md"
FIGURES = PAGE.with_suffix(".json")
MEDIA = tuple(sorted((BUNDLED / "media").glob("*.xml")))
EVERYWHERE = ("room",)
"""What a part without scenes has its figures under."""


@dataclass(frozen=True)
class Part:
    """What one of the page's tables is made of."""

    command: str
    """The sub-command that measures it, with its options but for the scenes."""
    saved: str
    """The JSON file that this leaves, without its suffix."""
    columns: tuple[str, ...]
    """What is kept of each row."""
    bundled: tuple[str, ...] | None = None
    """Those of the bundled scenes that it is about; ``None``: all of them."""
    own: tuple[Path, ...] = ()
    """Scenes that it is about in place of these."""
    elsewhere: bool = True
    """Whether it is about scenes from elsewhere, too."""
    pictures: Mapping[str, str] | None = None
    """What it draws, and where that goes in the page's folder."""

    def scenes(self, given: Sequence[Path]) -> list[Path | None]:
        """Those of the scenes given that it measures; ``None`` stands for one of its own."""
        if self.bundled == EVERYWHERE:
            return [None]
        bundled = () if self.own else self.bundled
        return [
            *self.own,
            *(
                path
                for path in given
                if (
                    bundled is None or name_of(path) in bundled
                    if path.resolve().parent == BUNDLED
                    else self.elsewhere
                )
            ),
        ]


_EFFORT = ("method", "size", "seeds", "samples_per_pixel", "seconds", "first", "settings")
_ERRORS = (
    *_EFFORT,
    *("relMSE", "MSE", "FLIP", "artefacts", "relMSE / best path", "MSE / best path"),
)
_FRONT = ("method", "seconds", "relMSE", "relMSE trimmed", "on the front")
_CANDIDATES = "path path:sampler=multijitter bdpm:bdd=0 bdpm_opt2 bdpm_opt3 bdpm_auto"
_ROOMS = "--rooms 6 --times 1 5 20 --integrators path path:sampler=multijitter bdpm:bdd=0 bdpm_auto"

PARTS = {
    "compare10": Part(
        f"compare --time 10 --seeds 1 --integrators {_CANDIDATES}",
        "compare",
        _ERRORS,
    ),
    "denoised10": Part(
        "compare --denoise --time 10 --seeds 1 --integrators path path:sampler=multijitter"
        " bdpm:bdd=1 bdpm:bdd=2 bdpm_auto",
        "compare",
        (
            *_EFFORT,
            "denoised relMSE",
            "denoised MSE",
            "denoised FLIP",
            "denoised artefacts",
            "denoised relMSE / best path",
            "denoised MSE / best path",
            "denoised FLIP / best path",
        ),
    ),
    "choice": Part(
        f"choice {_ROOMS}",
        "choice",
        ("scene", "seconds", "relMSE / best path", "MSE / best path", "artefacts", "chosen"),
        bundled=EVERYWHERE,
    ),
    "choice_denoised": Part(
        f"choice --denoise {_ROOMS}",
        "choice",
        (
            *("scene", "seconds", "denoised relMSE / best path", "denoised MSE / best path"),
            *("denoised artefacts", "chosen"),
        ),
        bundled=EVERYWHERE,
    ),
    "compare1.5": Part(
        "compare --time 1.5 --seeds 2 --integrators path path:sampler=multijitter bdpm:bdd=0"
        " bdpm_opt3 bdpm_auto bdpt vcm",
        "compare",
        (
            *_EFFORT,
            "iterations",
            "relMSE trimmed",
            "trimmed ratio",
            "trimmed by seed",
            "MSE trimmed",
        ),
        elsewhere=False,
    ),
    "charts": Part(
        "converge --time 1.5 --seeds 2 --snapshots 5 --integrators path path:sampler=multijitter"
        " ptracer bdpm:bdd=0 bdpm_opt3 bdpm_auto bdpt vcm",
        "converge",
        _FRONT,
        bundled=("caustics", "door"),
        elsewhere=False,
        pictures={
            "caustics_time.png": "images/charts/caustics_time.png",
            "door_front.png": "images/charts/door_front.png",
        },
    ),
    "stability": Part(
        "stability --sweeps roughness --coarse --point-time 0.4 --integrators path bdpm:bdd=0"
        " bdpm:bdd=1 bdpm_balance bdpm_opt3 bdpm_auto bdpt",
        "choices",
        ("from", "to", "best", "about as good", "breaks"),
        bundled=EVERYWHERE,
        pictures={"stability_roughness.png": "images/charts/stability_roughness.png"},
    ),
    "variance": Part(
        "variance --radius 0.02 --iterations 16 --integrators bdpm:bdd=0,pass_narrow=false"
        " bdpm:bdd=1,pass_narrow=false bdpm:bdd=0"
        " bdpm_balance:strategies=2 bdpm_opt2 bdpm_opt3 bdpm_opt2:mix_diffuse=true",
        "variance",
        ("method", "radius", "ratio to best single", "time ratio", "equal-time ratio"),
        bundled=("cornell_glossy",),
        elsewhere=False,
        pictures={"variance_cornell_glossy_1.png": "images/variance_cornell_glossy.png"},
    ),
    "throughput": Part(
        "throughput --quick",
        "throughput",
        (
            *("size", "light paths", "photons a gather", "iteration ms", "light ms", "grid ms"),
            *("camera ms", "gather ms", "direct ms", "no kernel share", "path ms"),
            *("ratio", "ratio with probes", "peak MiB"),
        ),
        bundled=("cornell_point", "cornell_glossy"),
    ),
    "parsimony": Part(
        "parsimony",
        "parsimony",
        ("left out", "iteration with it / without", "all left out"),
    ),
    "media20": Part(
        "compare --time 20 --seeds 1 --reference-method bdpt --integrators volpath"
        " volpath:sampler=multijitter bdpt bdpm:bdd=0 bdpm_auto",
        "compare",
        _ERRORS,
        own=MEDIA,
    ),
    "media_charts": Part(
        "converge --time 5 --seeds 1 --snapshots 5 --reference-method bdpt --integrators volpath"
        " volpath:sampler=multijitter bdpt bdpm:bdd=0 bdpm_auto",
        "converge",
        _FRONT,
        own=MEDIA,
        elsewhere=False,
        pictures={
            f"{scene.stem}_time.png": f"images/charts/{scene.stem}_time.png" for scene in MEDIA
        },
    ),
    "multiview": Part(
        "multiview --time 3 --seeds 3 --weights mis --no-lost-shares",
        "multiview",
        ("weights", "views", "ratio", "best view", "worst view"),
        own=tuple(multiview.SCENES),
        elsewhere=False,
    ),
}
"""By name. The order is that in which they are measured: what matters most comes first. Together
they take two hours, so methods are those that a reader would choose between."""


def run(options: argparse.Namespace) -> None:
    """The sub-command ``figures``: adds what it finds to a file, after each scene."""
    if options.time and options.file.resolve() == FIGURES:
        raise SystemExit("figures: --time is to try the command, and needs a --file of its own")
    if not options.page:
        measure_parts(options)
    write_page(options.file)


def write_page(file: Path) -> None:
    """Write the tables of the page beside the figures, if there is one."""
    page = file.with_suffix(".md")
    if page.exists():
        text = page.read_text()
        page.write_text(results.page(text, json.loads(file.read_text())))


def measure_parts(options: argparse.Namespace) -> None:
    """Measure the parts that the options name, each in all of its scenes; a scene's new figures
    replace its old ones, and others stay."""
    parts = {name: PARTS[name] for name in options.only or PARTS}
    if any("--denoise" in part.command for part in parts.values()):
        try:
            denoising.require()
        except ImportError as error:
            raise SystemExit(f"figures: {error}") from None
    stamp, failures = machine(), []  # before files of this checkout are written
    found = json.loads(options.file.read_text()) if options.file.exists() else {}
    for name, part in parts.items():
        for path in part.scenes(options.scenes):
            scene = EVERYWHERE[0] if path is None else name_of(path)
            console.rule(f"{name}: {scene}")
            start = time.perf_counter()
            try:
                rows = measure(part, path, options, options.out / name / scene)
            except (*loading.SCENE_ERRORS, SystemExit) as error:
                failures.append(f"{name}, {scene}: {loading.one_line(error)}")
                console.print(failures[-1])
                continue
            entry = {
                "command": part.command,
                "machine": stamp,
                "wall_seconds": round(time.perf_counter() - start, 1),
                "rows": document([_kept(row, part.columns) for row in rows], {})["rows"],
            }
            if name == "compare1.5":
                entry["least"] = winners(rows)[0]
            found.setdefault(name, {})[scene] = entry
            options.file.parent.mkdir(parents=True, exist_ok=True)
            options.file.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
            _copy_pictures(part, options.out / name / scene, options.file.parent)
    if failures:
        raise SystemExit("figures: not measured:\n" + "\n".join(failures))


def measure(part: Part, path: Path | None, options: argparse.Namespace, out: Path) -> list[Row]:
    """The rows that the part's sub-command finds in a scene."""
    asked = options.parse(part.command.split())
    asked.out = out
    if path is not None:
        asked.scenes = [path]
    if hasattr(asked, "references"):
        asked.references = options.references
    for seconds in ("reference_time", "room_reference_time"):
        if hasattr(asked, seconds):
            setattr(asked, seconds, min(getattr(asked, seconds), options.reference_time))
    for seconds in ("time", "point_time"):
        if options.time and hasattr(asked, seconds):
            setattr(asked, seconds, options.time)
    asked.run(asked)
    return json.loads((out / f"{part.saved}.json").read_text())["rows"]


def _kept(row: Row, columns: Sequence[str]) -> Row:
    return {name: _rounded(row[name]) for name in columns}


def _rounded(value: str | int | float | None) -> str | int | float | None:
    """Four digits: more are noise, and would change all lines of the file each time."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _copy_pictures(part: Part, drawn: Path, folder: Path) -> None:
    for name, place in (part.pictures or {}).items():
        if (drawn / name).exists():
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(drawn / name, folder / place)
