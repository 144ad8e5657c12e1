"""The command ``mis-render``: render a Mitsuba scene to an EXR file, and a PNG beside it."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi

from . import __version__, llvm, loading, output
from .progress import Progress
from .session import Session, make_session

EXIT_OK, EXIT_SCENE, EXIT_USAGE, EXIT_OUTPUT, EXIT_INTERRUPTED = 0, 1, 2, 3, 130

_EXIT_CODES = """exit codes:
  0    rendered and written
  1    error in the scene or in a parameter, or while rendering
  2    wrong usage of this command
  3    the image cannot be written
  130  interrupted: what had been rendered was written, if an iteration was done
"""


class Failure(Exception):
    """An error to report in one line, and the exit code."""

    def __init__(self, code: int, message: str):
        super().__init__(message)
        self.code = code


class Interrupt:
    """Ctrl-C: the first asks to stop after the current iteration; a second one, or one before any result,
    stops at once.
    """

    def __init__(self):
        self.requested = False
        self.have_result = False

    def __enter__(self) -> "Interrupt":
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, *_) -> None:
        if self.requested or not self.have_result:
            raise KeyboardInterrupt
        self.requested = True


class Clock:
    """Seconds spent on iterations, those on compiling kernels counted apart.

    Use it as a context, once an iteration, with ``JitFlag.KernelHistory`` set.
    """

    def __init__(self):
        self.rendering = 0.0
        self.compiling = 0.0

    def __enter__(self) -> None:
        dr.kernel_history_clear()
        self._start = time.perf_counter()

    def __exit__(self, *_) -> None:
        seconds = time.perf_counter() - self._start
        compiling = (
            sum(
                kernel.get("codegen_time", 0) + kernel.get("backend_time", 0)
                for kernel in dr.kernel_history([dr.KernelType.JIT])
            )
            / 1000
        )
        self.compiling += min(compiling, seconds)
        self.rendering += max(0.0, seconds - compiling)


def main(arguments: list[str] | None = None) -> int:
    """Run ``mis-render`` with the arguments (default: those of the process) and return its exit code."""
    options = _parse(arguments)
    try:
        with Interrupt() as interrupt:
            return _run(options, interrupt)
    except Failure as failure:
        print(f"mis-render: {failure}", file=sys.stderr)
        return failure.code
    except KeyboardInterrupt:
        print("mis-render: interrupted, nothing written", file=sys.stderr)
        return EXIT_INTERRUPTED


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="mis-render",
        description="Render a Mitsuba scene to an EXR file, and a tone-mapped PNG beside it.",
        epilog=_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", type=Path, metavar="SCENE.xml")
    parser.add_argument(
        "-o",
        dest="output",
        type=Path,
        metavar="FILE.exr",
        help="the image (default: beside the scene, with the scene's name)",
    )
    parser.add_argument(
        "-i",
        dest="plugin",
        metavar="PLUGIN",
        help=f"replace the scene's integrator, keeping its {', '.join(loading.INHERITED)}",
    )
    parser.add_argument(
        "-D",
        dest="variables",
        action="append",
        default=[],
        type=_assignment,
        metavar="var=value",
        help="set one of the scene's $variables",
    )
    parser.add_argument(
        "-P",
        dest="parameters",
        action="append",
        default=[],
        type=_assignment,
        metavar="param=value",
        help="set a parameter of the integrator",
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--spp", type=_positive_int, metavar="N", help="samples per pixel (default: the scene's sample_count)"
    )
    length.add_argument(
        "--time",
        type=_positive_seconds,
        metavar="SECONDS",
        help="render for so long, at least one iteration; compiling kernels does not count",
    )
    parser.add_argument(
        "--seed", type=_seed, default=0, metavar="S", help="seed of the random numbers (default: 0)"
    )
    parser.add_argument("--sensor", type=int, default=0, metavar="N", help="index of the sensor (default: 0)")
    parser.add_argument(
        "--all-views",
        action="store_true",
        help="render all views of the scene together (all sensors, and the children of a batch) into a contact sheet",
    )
    parser.add_argument(
        "--frames", action="store_true", help="also write each view, FILE.000.png and so on: frames of an animation"
    )
    parser.add_argument(
        "--variant",
        default="llvm_ad_rgb",
        choices=mi.variants(),
        metavar="V",
        help="Mitsuba's variant (default: llvm_ad_rgb)",
    )
    parser.add_argument("--quiet", action="store_true", help="print errors only")
    parser.add_argument("--version", action="version", version=_versions())
    options = parser.parse_args(arguments)
    options.output = options.output or options.scene.with_suffix(".exr")
    if options.output.suffix != ".exr":
        parser.error(f"argument -o: {options.output} does not end in .exr")
    return options


def _run(options: argparse.Namespace, interrupt: Interrupt) -> int:
    _check_output(options.output)
    try:
        _set_variant(options.variant)
        loaded = loading.load(
            options.scene,
            dict(options.variables),
            options.plugin,
            {name: loading.parse_value(text) for name, text in options.parameters},
        )
        sensor = _sensor(loaded.scene, options.sensor)
        spp = 0 if options.time else options.spp or sensor.sampler().sample_count()
        session = _session(loaded, sensor, options, spp)
        clock = _render(session, sensor, options, interrupt)
    except loading.SCENE_ERRORS as error:
        raise Failure(EXIT_SCENE, loading.one_line(error)) from error

    metadata = {
        "integrator": loaded.plugin,
        **loaded.parameters,
        **session.settings,
        "spp": session.iterations * session.samples_per_iteration,
        "iterations": session.iterations,
        "seed": options.seed,
        "variant": options.variant,
        "versions": _versions(),
        "renderTime": clock.rendering,
        "compileTime": clock.compiling,
    }
    written = _write(options, session, metadata)
    report = (
        f"{metadata['spp']} samples per pixel in {clock.rendering:.1f} s (and {clock.compiling:.1f} s of "
        f"compiling): {written}"
    )
    if interrupt.requested:
        print(f"mis-render: interrupted after {report}", file=sys.stderr)
        return EXIT_INTERRUPTED
    if not options.quiet:
        print(report, file=sys.stderr)
    return EXIT_OK


def _render(session: Session, sensor: mi.Sensor, options: argparse.Namespace, interrupt: Interrupt) -> Clock:
    """Iterate until the planned samples or the given time are reached, or the user interrupts."""
    clock = Clock()
    width, height = sensor.film().crop_size()
    paths = getattr(session, "pixels", width * height) * session.samples_per_iteration
    if options.time and hasattr(session, "plan_time"):
        session.plan_time(options.time)
    planned = session.iterations_planned
    with (
        Progress(paths, planned, options.time, options.quiet) as progress,
        dr.scoped_set_flag(dr.JitFlag.KernelHistory),
    ):
        if planned and options.spp and planned * session.samples_per_iteration > options.spp:
            progress.say(
                f"{options.spp} samples per pixel rounded up to {planned * session.samples_per_iteration}: "
                f"{planned} iterations of {session.samples_per_iteration}"
            )
        while True:
            with clock:
                session.iterate()
            interrupt.have_result = True
            progress.update(session.iterations, clock.rendering)
            enough = clock.rendering >= options.time if options.time else session.iterations >= planned
            if enough or interrupt.requested:
                return clock


def _session(loaded: loading.LoadedScene, sensor: mi.Sensor, options: argparse.Namespace, spp: int) -> Session:
    """The session that the options ask for; only some integrators render several views."""
    if not hasattr(loaded.integrator, "views_session") and (options.all_views or options.frames):
        option = "--all-views" if options.all_views else "--frames"
        raise Failure(EXIT_SCENE, f'{option}: "{loaded.plugin}" renders one view at a time; use -i volpath_multiview')
    if options.all_views:
        return loaded.integrator.views_session(loaded.scene, seed=options.seed, spp=spp)
    return make_session(loaded.integrator, loaded.scene, sensor, options.seed, spp)


def _write(options: argparse.Namespace, session: Session, metadata: dict[str, str | int | float]) -> str:
    path = options.output
    png, channels = path.with_suffix(".png"), session.channels
    views = session.view_images() if options.all_views or options.frames else []
    image = output.contact_sheet(views) if options.all_views else session.image()
    try:
        output.write_exr(path, image, channels, metadata)
        written = f"{path} and {png}" if output.write_png(png, image, channels) else str(path)
        if options.frames:
            for number, view in enumerate(views):
                output.write_png(output.frame_path(path, number), view, channels)
            written += f", {len(views)} frames from {output.frame_path(path, 0)}"
        return written
    except OSError as error:
        raise Failure(EXIT_OUTPUT, f"cannot write {path}: {error}") from error


def _check_output(path: Path) -> None:
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a directory")
        output.make_writable(path.parent)
    except OSError as error:
        raise Failure(EXIT_OUTPUT, f"cannot write {path}: {error.strerror or error}") from error


def _set_variant(variant: str) -> None:
    if variant.startswith("llvm_"):
        llvm.require()
    mi.set_variant(variant)


def _sensor(scene: mi.Scene, index: int) -> mi.Sensor:
    sensors = scene.sensors()
    if not 0 <= index < len(sensors):
        raise Failure(
            EXIT_SCENE,
            f"--sensor {index}: the scene's sensors are numbered 0 to {len(sensors) - 1}"
            if sensors
            else "the scene has no sensor",
        )
    return sensors[index]


def _versions() -> str:
    return f"mis_integrators {__version__}, mitsuba {mi.__version__}, drjit {dr.__version__}"


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text} is not of the form name=value")
    return name, value


def _positive_int(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("at least 1")
    return value


def _positive_seconds(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError("more than 0")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 1 << 32:
        raise argparse.ArgumentTypeError("0 to 4294967295")
    return value


if __name__ == "__main__":
    sys.exit(main())
