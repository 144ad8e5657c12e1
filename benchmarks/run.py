#!/usr/bin/env python3
"""Benchmarks of the integrators: ``run.py SUB-COMMAND --help`` says what each measures."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import mis_integrators  # noqa: F401  (makes LLVM known and registers the plugins)
from mis_integrators.app import loading

import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

from common import references  # noqa: E402
from common.methods import CHOSEN_FROM, COMPARED, VARIED, Method, parse_method, registered  # noqa: E402
from common.scene_files import BUNDLED, bundled, open_scene  # noqa: E402
from experiments import (  # noqa: E402
    choice,
    combine,
    compare,
    constants,
    converge,
    costs,
    figures,
    freezing,
    multiview,
    opinions,
    overview,
    parsimony,
    radius,
    resampling,
    sampling,
    scaling,
    stability,
    throughput,
    variance,
    view_counts,
    view_weights,
)
from experiments.sweeps import SWEEPS  # noqa: E402


def main(arguments: list[str] | None = None) -> None:
    """Run the sub-command that the arguments name."""
    options = _parser().parse_args(arguments)
    options.run(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="SUB-COMMAND")

    command = _measuring(commands, "throughput", throughput)
    command.add_argument(
        "--sizes",
        type=int,
        nargs="+",
        default=[128, 256, 512, 1024],
        metavar="PIXELS",
        help="edges of the square film (default: 128 256 512 1024)",
    )
    command.add_argument(
        "--light-paths",
        type=int,
        nargs="*",
        metavar="N",
        default=[10_000, 30_000, 100_000, 300_000, 1_000_000],
        help=f"light paths an iteration, at {throughput.SIZE_OF_SWEEP} pixels; as many as "
        "pixels are measured at every size (default: 10000 30000 100000 300000 1000000)",
    )
    command.add_argument(
        "--full", action="store_true", help="every number of light paths at every size"
    )
    command.add_argument(
        "--quick", action="store_true", help="only 256 pixels and as many light paths"
    )
    command.add_argument(
        "--photons", type=_positive, default=10, help="photons a gather (default: 10)"
    )
    command.add_argument(
        "--time",
        type=_positive,
        default=3,
        metavar="SECONDS",
        help="what bdpm, bdpm with edge probes, and path have each (default: 3)",
    )

    command = _measuring(commands, "page", overview)
    _renders(command, None)
    _compares_with_references(command)
    command.set_defaults(seeds=2)
    command.add_argument(
        "--minutes",
        type=_positive,
        default=24,
        metavar="MINUTES",
        help="what all should take, if --time is not given (default: 24)",
    )
    command.add_argument(
        "--snapshots",
        type=int,
        default=5,
        metavar="N",
        help="at times T, T/2, T/4, ... (default: 5)",
    )
    command.add_argument(
        "--varied",
        nargs="+",
        type=_method,
        default=registered(VARIED),
        metavar="PLUGIN[:...]",
        help=f"methods of the variance maps (default: {_labels(registered(VARIED))})",
    )
    command.add_argument(
        "--variance-scale",
        type=_positive,
        default=0.5,
        metavar="SCALE",
        help="film size of variance maps (default: 0.5)",
    )
    _variance(command, 16)
    _sweeps(command, 0.4)
    command.add_argument(
        "--every-value",
        dest="coarse",
        action="store_false",
        help="all values of the sweeps instead of every other",
    )
    _views(command, (2, 8, 16, 64), 0.08, 2, 0.5)
    command.add_argument(
        "--resampled",
        nargs="*",
        type=_scene,
        default=[path for path in bundled() if path.stem == "door"],
        metavar="FILE.xml",
        help="scenes of the sweeps of resampling (default: door)",
    )
    _resampling(command, 1.0)

    command = _measuring(commands, "compare", compare)
    _renders(command, 10)
    _compares_with_references(command)
    command.add_argument(
        "--baseline",
        type=_file,
        metavar="FILE",
        help="figures of an earlier run (compare.json or benchmarks/history/*.json): print what "
        "became slower or noisier",
    )
    command.add_argument(
        "--record", action="store_true", help="keep the figures in benchmarks/history"
    )

    command = _measuring(commands, "combine", combine)
    _renders(command, 10)
    _compares_with_references(command)
    command.set_defaults(seeds=1)
    command.add_argument(
        "--shares",
        nargs="+",
        type=_share,
        default=[0.15, 0.5],
        metavar="SHARE",
        help="of the time that the second method has (default: 0.15 0.5)",
    )

    command = _measuring(commands, "parsimony", parsimony)
    command.add_argument(
        "--scale", type=_positive, default=1.0, help="film size, scene's own = 1 (default: 1)"
    )

    command = _measuring(commands, "choice", choice)
    _renders(command, (1.0, 5.0, 20.0))
    _compares_with_references(command)
    command.set_defaults(seeds=1, integrators=registered(CHOSEN_FROM), scenes=None)
    command.add_argument(
        "--rooms",
        type=int,
        default=0,
        metavar="N",
        help="random rooms, in place of the bundled scenes or besides those named (default: 0)",
    )

    command = _measuring(commands, "converge", converge)
    _renders(command, 16)
    _compares_with_references(command)
    command.add_argument(
        "--snapshots",
        type=int,
        default=6,
        metavar="N",
        help="at times T, T/2, T/4, ... (default: 6)",
    )

    command = _measuring(commands, "variance", variance)
    _chooses(command, VARIED, "some of them bdpm: ratios are to the best of these")
    command.add_argument(
        "--camera-paths", type=int, nargs="+", default=[1], metavar="N", help="N_B (default: 1)"
    )
    _variance(command, 24)
    command.add_argument(
        "--one-weight",
        action="store_true",
        help="measure bdpm_opt2 again, with one weight for direct light and photons at the last "
        "vertex",
    )
    command.add_argument(
        "--terms",
        action="store_true",
        help="split the variance into the cross, camera and photon terms of the noise law instead; "
        "three images a round, --iterations rounds",
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )

    command = _measuring(commands, "stability", stability, scenes=False)
    _chooses(command, COMPARED, "each swept where it knows the parameter")
    _sweeps(command, 0.6)
    command.add_argument("--coarse", action="store_true", help="only every other value of a sweep")
    references.add_folder(command)

    command = _measuring(commands, "resampling", resampling)
    command.set_defaults(scenes=[path for path in bundled() if path.stem == "door"])
    _resampling(command, 2.0)
    command.add_argument("--coarse", action="store_true", help="only every other value of a sweep")
    command.add_argument(
        "--published",
        action="store_true",
        help="the papers' own weights, in these sweeps, and the papers' other experiments",
    )
    command.add_argument(
        "--published-parts",
        nargs="*",
        choices=["time", "Q", "ladder"],
        default=["time", "Q", "ladder"],
        metavar="PART",
        help="MAPE over time, the spread of the estimates of Q, and the changes of the bounded "
        "form one at a time (default: time Q ladder)",
    )
    command.add_argument(
        "--published-time",
        type=_positive,
        default=60,
        metavar="SECONDS",
        help="seconds of MAPE over time (default: 60)",
    )
    references.add_options(command)

    command = _measuring(commands, "radius", radius)
    command.add_argument("--bdd", type=int, nargs="+", default=[0, 1], help="(default: 0 1)")
    command.add_argument(
        "--time",
        type=_positive,
        nargs="+",
        default=[5, 60],
        metavar="SECONDS",
        help="seconds for which the automatic radius is chosen and judged (default: 5 60)",
    )
    command.add_argument(
        "--rendering",
        type=_positive,
        default=10,
        metavar="SECONDS",
        help="what each radius renders; its error at other times follows (default: 10)",
    )
    command.add_argument(
        "--pilots",
        type=int,
        default=1,
        help="how many choices of the automatic radius are judged (default: 1)",
    )
    command.add_argument(
        "--radii", type=int, default=11, help="how many, factor sqrt 2 (default: 11)"
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )
    references.add_options(command)

    command = _measuring(commands, "references", opinions)
    command.add_argument(
        "--integrators",
        nargs="+",
        type=_method,
        metavar="PLUGIN[:name=value,...]",
        help="methods that must agree (default: those of references.json that there are)",
    )
    command.add_argument(
        "--again", action="store_true", help="ask them about references that were there before, too"
    )
    command.add_argument(
        "--time",
        type=_positive,
        default=20,
        metavar="SECONDS",
        help="rendering seconds of each of their two renders (default: 20)",
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )
    references.add_options(command)
    _sweeps(command, 0.4)
    command.add_argument(
        "--every-value",
        dest="coarse",
        action="store_false",
        help="all values of the sweeps instead of every other",
    )

    command = _measuring(commands, "multiview", multiview)
    command.set_defaults(scenes=multiview.SCENES)
    command.add_argument(
        "--weights",
        nargs="+",
        default=["mis", "mwis"],
        help="weights of volpath_multiview (default: mis mwis)",
    )
    command.add_argument(
        "--time",
        type=_positive,
        default=5,
        metavar="SECONDS",
        help="rendering seconds of each (default: 5)",
    )
    command.add_argument(
        "--seeds", type=int, default=8, help="renders of each, at least two (default: 8)"
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )
    command.add_argument(
        "--charts", action="store_true", help="draw the shifted densities (needs matplotlib)"
    )
    command.add_argument(
        "--shifts",
        action="store_true",
        help="compare the six shifts instead: variance, seconds, lost shares",
    )
    command.add_argument(
        "--no-lost-shares",
        dest="lost_shares",
        action="store_false",
        help="do not count what each shift loses",
    )

    command = _measuring(commands, "costs", costs)
    command.add_argument(
        "--plugins",
        nargs="+",
        choices=costs.PLUGINS,
        default=costs.PLUGINS,
        metavar="PLUGIN",
        help=f"those whose prices are fitted anew (default: {' '.join(costs.PLUGINS)})",
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )

    command = _measuring(commands, "sampling", sampling)
    _chooses(command, ("bdpm:bdd=0",), "each under both samplers")
    command.set_defaults(scenes=sampling.default_scenes())
    command.add_argument(
        "--size", type=int, default=96, metavar="PIXELS", help="edge of the film (default: 96)"
    )
    command.add_argument("--seeds", type=int, default=8, help="renders of each (default: 8)")
    _variance(command, 256, 0.01)

    command = _measuring(commands, "constants", constants)
    command.set_defaults(scenes=[])
    command.add_argument(
        "--file",
        type=Path,
        default=constants.FIGURES,
        metavar="FILE",
        help="where figures are kept, and added to (default: docs/notes/constants.json)",
    )
    command.add_argument(
        "--page",
        action="store_true",
        help="only write docs/notes/constants.md from code and figures",
    )
    command.add_argument(
        "--only", nargs="+", metavar="TEXT", help="constants whose names contain one of these"
    )
    command.add_argument(
        "--change",
        nargs="+",
        metavar="MODULE.NAME=VALUE",
        help="try these values, all at once, instead",
    )
    command.add_argument(
        "--method", type=_method, metavar="PLUGIN[:...]", help="what renders (default: by module)"
    )
    command.add_argument(
        "--time",
        type=_positive,
        default=3,
        metavar="SECONDS",
        help="rendering seconds of each (default: 3)",
    )
    command.add_argument("--seeds", type=int, default=1, help="renders of each (default: 1)")
    command.add_argument(
        "--width", type=int, default=160, help="of the films, in pixels (default: 160)"
    )
    command.add_argument(
        "--processor-time",
        action="store_true",
        help="count seconds of all processors together, for machines that do other work too",
    )
    references.add_options(command)

    command = _measuring(commands, "figures", figures)
    command.add_argument(
        "--only",
        nargs="+",
        choices=figures.PARTS,
        metavar="PART",
        help=f"measure these anew, and keep the others: {' '.join(figures.PARTS)}",
    )
    command.add_argument(
        "--file",
        type=Path,
        default=figures.FIGURES,
        metavar="FILE.json",
        help="where figures are kept; tables are written into FILE.md if there is one, and "
        "pictures into images beside it (default: docs/results.json)",
    )
    command.add_argument(
        "--page", action="store_true", help="only write the page's tables from the figures"
    )
    command.add_argument(
        "--time",
        type=_positive,
        metavar="SECONDS",
        help="of each render, in place of the parts' own: to try the command",
    )
    references.add_folder(command)
    command.add_argument(
        "--reference-time",
        type=_positive,
        default=30,
        metavar="SECONDS",
        help="rendering seconds at most of each of the two references (default: 30)",
    )
    command.set_defaults(parse=parser.parse_args, out=Path("out/figures"))

    command = _measuring(commands, "views", view_counts, scenes=False)
    _views(command, view_counts.COUNTS, 0.25, 3, 1)

    command = _measuring(commands, "view-weights", view_weights)
    command.set_defaults(scenes=[BUNDLED / "multiview" / "fly_through.xml"])
    command.add_argument(
        "--seeds", type=int, default=24, help="renders, at least two (default: 24)"
    )
    command.add_argument(
        "--iterations", type=int, default=8, help="of each, one sample a pixel (default: 8)"
    )
    command.add_argument(
        "--groups", type=int, default=8, help="groups of pixels, equally large (default: 8)"
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )

    command = _measuring(commands, "scaling", scaling)
    _chooses(command, ("bdpm",), "each by itself")
    command.add_argument(
        "--workers",
        type=int,
        nargs="+",
        default=[1, 2],
        metavar="N",
        help="local processes of one thread (default: 1 2)",
    )
    command.add_argument(
        "--time",
        type=_positive,
        default=20,
        metavar="SECONDS",
        help="for which each is measured (default: 20)",
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )

    for name, function in (("freeze-scenes", freezing.freeze), ("check-scenes", freezing.check)):
        command = commands.add_parser(name, help=function.__doc__, description=function.__doc__)
        command.set_defaults(run=function)
    return parser


def _method(text: str) -> Method:
    """A method whose plugin exists: else references would be rendered before that is said. What its
    parameters do to a scene is another matter."""
    try:
        method = parse_method(text)
        mi.load_dict({"type": method.plugin})
    except loading.SCENE_ERRORS as error:
        raise argparse.ArgumentTypeError(loading.one_line(error)) from None
    return method


def _labels(methods: Sequence[Method]) -> str:
    return " ".join(method.label for method in methods)


def _file(text: str) -> Path:
    if not Path(text).is_file():
        raise argparse.ArgumentTypeError(f"there is no file {text}")
    return Path(text)


def _scene(text: str) -> Path:
    """A scene file that can be loaded: else hours of measuring would end at it."""
    path = _file(text)
    try:
        open_scene(path)
    except loading.SCENE_ERRORS as error:
        raise argparse.ArgumentTypeError(f"{text}: {loading.one_line(error)}") from None
    return path


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return value


def _share(text: str) -> float:
    value = _positive(text)
    if value >= 1:
        raise argparse.ArgumentTypeError(f"{text} is not a number below 1")
    return value


def _measuring(commands, name: str, module, scenes: bool = True) -> argparse.ArgumentParser:
    """A sub-command with the options that all measurements have."""
    command = commands.add_parser(name, help=module.__doc__, description=module.__doc__)
    if scenes:
        command.add_argument(
            "--scenes",
            nargs="+",
            type=_scene,
            default=bundled(),
            metavar="FILE.xml",
            help="scene files (default: the bundled ones)",
        )
    command.add_argument(
        "--out",
        type=Path,
        default=Path("out/benchmarks"),
        metavar="DIR",
        help="where CSV and JSON files go (default: out/benchmarks)",
    )
    command.set_defaults(run=module.run)
    return command


def _chooses(command: argparse.ArgumentParser, labels: tuple[str, ...], what: str) -> None:
    """Which methods; by default those of the labels whose plugins there are."""
    methods = registered(labels)
    command.add_argument(
        "--integrators",
        nargs="+",
        type=_method,
        metavar="PLUGIN[:name=value,...]",
        default=methods,
        help=f"methods, {what} (default: {_labels(methods)})",
    )


def _variance(command: argparse.ArgumentParser, iterations: int, share: float = 0.005) -> None:
    """How variance is measured."""
    command.add_argument(
        "--iterations", type=int, default=iterations, help=f"for variances (default: {iterations})"
    )
    command.add_argument(
        "--radius",
        type=_positive,
        metavar="R",
        help="merge radius (default: a share of the scene's diagonal)",
    )
    command.add_argument(
        "--radius-share",
        type=_positive,
        default=share,
        metavar="SHARE",
        help=f"(default: {share})",
    )


def _sweeps(command: argparse.ArgumentParser, seconds: float) -> None:
    """Which parameters are swept, and how carefully."""
    names = [sweep.name for sweep in SWEEPS]
    command.add_argument(
        "--sweeps",
        nargs="*",
        choices=names,
        default=names,
        metavar="NAME",
        help=f"(default: {' '.join(names)})",
    )
    command.add_argument(
        "--size", type=int, default=64, metavar="PIXELS", help="edge of the film (default: 64)"
    )
    command.add_argument(
        "--point-time",
        type=_positive,
        default=seconds,
        metavar="SECONDS",
        help=f"rendering seconds of each point (default: {seconds})",
    )
    command.add_argument(
        "--room-reference-time",
        type=_positive,
        default=10,
        metavar="SECONDS",
        help="rendering seconds of each of the two references of the scene swept (default: 10)",
    )


def _views(
    command: argparse.ArgumentParser,
    counts: tuple[int, ...],
    seconds: float,
    seeds: int,
    scale: float,
) -> None:
    """Which numbers of views of which scenes are compared, and how carefully."""
    command.add_argument(
        "--view-scenes",
        nargs="*",
        type=_scene,
        default=view_counts.SCENES,
        metavar="FILE.xml",
        help="scenes with several views (default: the bundled ones whose views overlap)",
    )
    command.add_argument(
        "--view-counts",
        nargs="+",
        type=int,
        default=list(counts),
        metavar="N",
        help=f"how many of their views (default: {' '.join(map(str, counts))})",
    )
    command.add_argument(
        "--view-weights",
        nargs="+",
        default=["mis"],
        metavar="WEIGHTS",
        help="weights of volpath_multiview (default: mis)",
    )
    command.add_argument(
        "--view-time",
        type=_positive,
        default=seconds,
        metavar="SECONDS",
        help=f"rendering seconds of each for every view, for 16 at least (default: {seconds})",
    )
    command.add_argument(
        "--view-seeds",
        type=int,
        default=seeds,
        metavar="N",
        help=f"renders of each, at least two (default: {seeds})",
    )
    command.add_argument(
        "--view-scale",
        type=_positive,
        default=scale,
        metavar="SCALE",
        help=f"film size, scene's own = 1 (default: {scale:g})",
    )


def _resampling(command: argparse.ArgumentParser, seconds: float) -> None:
    """Which parameters of resampled connections are swept, and how carefully."""
    names = [sweep.name for sweep in resampling.SWEEPS]
    command.add_argument(
        "--parameters",
        nargs="*",
        choices=names,
        default=names,
        metavar="NAME",
        help=f"of resampling (default: {' '.join(names)})",
    )
    command.add_argument(
        "--draw-time",
        type=_positive,
        default=seconds,
        metavar="SECONDS",
        help=f"rendering seconds of each setting and seed of resampling (default: {seconds:g})",
    )
    command.add_argument(
        "--draw-seeds", type=int, default=2, metavar="N", help="renders of each (default: 2)"
    )
    command.add_argument(
        "--resampling-scale",
        type=_positive,
        default=0.35,
        metavar="SCALE",
        help="film size, scene's own = 1 (default: 0.35)",
    )


def _renders(command: argparse.ArgumentParser, seconds: float | tuple[float, ...] | None) -> None:
    """What is rendered, and how long; several times are tried one after the other."""
    _chooses(command, COMPARED, "ratios are to path, or to the first where it is not among them")
    if isinstance(seconds, tuple):
        command.set_defaults(spp=None)
        command.add_argument(
            "--times",
            nargs="+",
            type=_positive,
            default=seconds,
            metavar="SECONDS",
            help=f"rendering seconds of each (default: {' '.join(f'{t:g}' for t in seconds)})",
        )
        return
    command.add_argument(
        "--time",
        type=_positive,
        default=seconds,
        metavar="SECONDS",
        help=f"rendering seconds of each (default: {seconds or 'as fits'})",
    )
    command.add_argument(
        "--spp", type=int, metavar="N", help="samples per pixel of each, instead of equal time"
    )


def _compares_with_references(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--seeds", type=int, default=3, help="renders of each method (default: 3; page: 2)"
    )
    command.add_argument(
        "--scale", type=_positive, default=1, help="film size, scene's own = 1 (default: 1)"
    )
    command.add_argument(
        "--denoise",
        action="store_true",
        help="denoise all images, too, and judge both; films get box filters, and integrators that "
        "have the parameter denoised are told (needs mitsuba-oidn)",
    )
    references.add_options(command)


if __name__ == "__main__":
    main()
