"""The options of ``mis-render``."""

from __future__ import annotations

import argparse
from pathlib import Path

import drjit as dr
import mitsuba as mi

from .. import __version__
from ..core.untrusted import shown
from . import fingerprint, loading

LARGEST_SEED = 2**32 - 1
MOST_SAMPLES = 2**31 - 1
"""Samples per pixel at most."""
MOST_SENSORS = 2**16
SMALLEST_NUMBER, LARGEST_NUMBER = 1e-9, 1e9
"""Of seconds, and of relative errors."""
LARGEST_PORT = 2**16 - 1
MOST_WORKERS = 2**10
"""Processes on this machine at most."""

_EXIT_CODES = """exit codes:
  0    rendered and written
  1    error in the scene, in a parameter or in the image of --like, or while rendering
  2    wrong usage of this command, or a package that --denoise or --compare needs is missing
  3    the image cannot be written
  4    the checkpoint cannot be used: damaged, or of another scene or other settings
  5    the workers cannot be reached, or fail, or dask.distributed is missing
  130  interrupted (Ctrl-C, SIGTERM): what had been rendered was written, if an iteration was done
"""


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options that the arguments give (default: those of the process); exits with status 2
    where they are wrong."""
    parser = argparse.ArgumentParser(
        prog="mis-render",
        description="Render a Mitsuba scene to an EXR file, and a PNG beside it (sRGB, cut at 1).",
        epilog=_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for add_options in (_what, _how_long, _which_image, _comparison, _what_is_kept, _where):
        add_options(parser)
    parser.add_argument(
        "--explain",
        action="store_true",
        help="in the end, say what rendered and why: predicted errors of the candidates, merge "
        "radii, what the scene had no use for",
    )
    parser.add_argument(
        "--quiet", action="store_true", help="print errors, and what --explain says"
    )
    parser.add_argument("--version", action="version", version=versions())
    options = parser.parse_args(arguments)
    if options.scene.is_dir():
        parser.error(f"argument SCENE.xml: {options.scene} is a directory")
    options.output = options.output or options.scene.with_suffix(".exr")
    if options.output.suffix != ".exr":
        parser.error(f"argument -o: {options.output} does not end in .exr")
    if options.all_views and options.sensor is not None:
        parser.error("argument --sensor: not allowed with argument --all-views")
    for flag, given in (("--all-views", options.all_views), ("--frames", options.frames)):
        if options.denoise and given:
            parser.error(f"argument --denoise: not allowed with argument {flag}")
    if options.like:
        _check_like(parser, options)
    _check_comparison(parser, options)
    options.sensor = options.sensor or 0
    options.seed = options.seed or 0
    options.variant = options.variant or "llvm_ad_rgb"
    if options.resume and not options.checkpoint:
        options.checkpoint = 60.0
    return options


def _what(parser: argparse.ArgumentParser) -> None:
    """The scene, the image, the integrator."""
    add = parser.add_argument
    add("scene", type=Path, metavar="SCENE.xml")
    add(
        "-o",
        dest="output",
        type=Path,
        metavar="FILE.exr",
        help="the image (default: beside the scene, with the scene's name)",
    )
    add(
        "-i",
        dest="plugin",
        metavar="PLUGIN",
        help=f"replace the scene's integrator, keeping its {', '.join(loading.INHERITED)}",
    )
    for flag, name, what in (
        ("-D", "var", "one of the scene's $variables"),
        ("-P", "param", "a parameter of the integrator"),
    ):
        add(
            flag,
            dest="variables" if flag == "-D" else "parameters",
            action="append",
            default=[],
            type=_assignment,
            metavar=f"{name}=value",
            help=f"set {what}",
        )


def _how_long(parser: argparse.ArgumentParser) -> None:
    """When rendering ends."""
    add = parser.add_argument
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--spp",
        type=_samples,
        metavar="N",
        help="samples per pixel (default: the scene's sample_count)",
    )
    length.add_argument(
        "--time",
        type=_positive_number,
        metavar="SECONDS",
        help="render for about so long, at least one iteration; compiling kernels does not count",
    )
    add(
        "--target-error",
        type=_positive_number,
        metavar="E",
        help="stop when the estimated relative error of the image is E or less, such as 0.05: "
        "the root mean square over the pixels of standard "
        "deviation over brightness, without the worst 0.1 %% of the pixels; --spp or --time are "
        "then upper bounds, and there is none without them",
    )


def _which_image(parser: argparse.ArgumentParser) -> None:
    """What decides about the image besides the scene."""
    add = parser.add_argument
    add(
        "--like",
        type=Path,
        metavar="FILE.exr",
        help="render again what this image of mis-render shows: with its integrator, parameters, "
        "seed and samples, and what was found out for it, such "
        "as merge radii; the scene must be the same (not checked)",
    )
    add("--seed", type=_seed, metavar="S", help="seed of the random numbers (default: 0)")
    add(
        "--sensor", type=_sensor, default=None, metavar="N", help="index of the sensor (default: 0)"
    )
    add(
        "--all-views",
        action="store_true",
        help="render all views of the scene together (all sensors, and the children of a batch) "
        "into a contact sheet; needs -i volpath_multiview",
    )
    add(
        "--frames",
        action="store_true",
        help="also write each view, FILE.000.png and so on: frames of an animation; as --all-views",
    )
    add(
        "--denoise",
        action="store_true",
        help="also write the image without its noise, FILE.denoised.exr and .png, by Open Image "
        "Denoise; the film's reconstruction filter becomes a box, as denoisers want it",
    )
    add(
        "--variant",
        choices=mi.variants(),
        metavar="V",
        help="Mitsuba's variant (default: llvm_ad_rgb)",
    )


def _comparison(parser: argparse.ArgumentParser) -> None:
    """What the image is compared with."""
    add = parser.add_argument
    add(
        "--compare",
        metavar="PLUGIN",
        help="then render the scene with this integrator for the same time, and write both images "
        "side by side, FILE.compare.png; -P sets parameters of the first one only, but for "
        f"{', '.join(loading.INHERITED)}",
    )
    add(
        "--reference",
        type=Path,
        metavar="REFERENCE.exr",
        help="with --compare: print each one's relMSE, MSE and FLIP against this image",
    )


def _what_is_kept(parser: argparse.ArgumentParser) -> None:
    """What is written while rendering goes on."""
    add = parser.add_argument
    add(
        "--checkpoint",
        type=_positive_number,
        metavar="SECONDS",
        help="keep what has been rendered in FILE.checkpoint, every so many seconds and at the end",
    )
    add(
        "--resume",
        action="store_true",
        help="go on from FILE.checkpoint if there is one, with the same scene and settings; "
        "--spp, --time and --target-error may differ, and "
        "--time counts what was rendered before. Implies --checkpoint 60",
    )
    add(
        "--preview",
        type=_positive_number,
        metavar="SECONDS",
        help="write the image so far to FILE.preview.exr and .png every so many seconds, until "
        "the image is there",
    )
    add(
        "--tev",
        type=_address,
        metavar="HOST:PORT",
        help="show the image so far in the viewer tev that listens there (its own default is "
        "127.0.0.1:14158), every so many seconds as --preview says, else every second, and in "
        "the end; the render goes on whether one listens or not",
    )


def _where(parser: argparse.ArgumentParser) -> None:
    """Which processes render."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers",
        type=_workers,
        metavar="N",
        help="spread the iterations over so many processes of this machine; --time then includes "
        "their compiling",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="spread the iterations over the workers of a Dask cluster, such as tcp://host:8786, "
        "which must find the scene under "
        "the same path",
    )


def _check_like(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuses what the image of ``--like`` already says."""
    told = {
        "-i": options.plugin,
        "-D": options.variables or None,
        "-P": options.parameters or None,
        "--spp": options.spp,
        "--time": options.time,
        "--target-error": options.target_error,
        "--seed": options.seed,
        "--sensor": options.sensor,
        "--all-views": options.all_views or None,
        "--denoise": options.denoise or None,
        "--variant": options.variant,
    }
    for flag, value in told.items():
        if value is not None:
            parser.error(f"argument {flag}: not allowed with argument --like")
    if options.like.resolve() == options.output.resolve():
        parser.error(f"argument -o: {options.output} is the image of --like")


def _check_comparison(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuses what is about one render alone."""
    if options.reference and not options.compare:
        parser.error("argument --reference: needs argument --compare")
    alone = {
        "--like": options.like,
        "--all-views": options.all_views,
        "--frames": options.frames,
        "--checkpoint": options.checkpoint,
        "--resume": options.resume,
        "--preview": options.preview,
        "--workers": options.workers,
        "--scheduler": options.scheduler,
    }
    for flag, value in alone.items():
        if options.compare and value:
            parser.error(f"argument --compare: not allowed with argument {flag}")


def versions() -> str:
    """The versions that an image depends on; of this package a hash of its sources, too."""
    return (
        f"mis_integrators {__version__} ({fingerprint.of_package()}), mitsuba "
        f"{mi.__version__}, drjit {dr.__version__}"
    )


def _assignment(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text} is not of the form name=value")
    return name, value


def _integer_between(text: str, low: int, high: int) -> int:
    try:
        value = int(text)
    except ValueError:  # of thousands of digits, too
        value = low - 1
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{shown(text)} is not an integer from {low} to {high}")
    return value


def _samples(text: str) -> int:
    return _integer_between(text, 1, MOST_SAMPLES)


def _seed(text: str) -> int:
    return _integer_between(text, 0, LARGEST_SEED)


def _sensor(text: str) -> int:
    return _integer_between(text, 0, MOST_SENSORS - 1)


def _workers(text: str) -> int:
    return _integer_between(text, 1, MOST_WORKERS)


def _address(text: str) -> tuple[str, int]:
    """Host and port; an IPv6 address may stand in brackets."""
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (host and colon and port.isascii() and port.isdigit()):
        raise argparse.ArgumentTypeError(f"{shown(text)} is not of the form HOST:PORT")
    return host, _integer_between(port, 1, LARGEST_PORT)


def _positive_number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{shown(text)} is not a number") from None
    if not SMALLEST_NUMBER <= value <= LARGEST_NUMBER:
        raise argparse.ArgumentTypeError(
            f"{shown(text)} is not a finite number from {SMALLEST_NUMBER:g} to {LARGEST_NUMBER:g}"
        )
    return value
