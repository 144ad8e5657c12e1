#!/usr/bin/env python3
"""Benchmarks of the integrators: ``run.py SUB-COMMAND --help`` says what each measures."""

from __future__ import annotations

import argparse
from pathlib import Path

import mis_integrators  # noqa: F401  (makes LLVM known and registers the plugins)
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

import compare  # noqa: E402
import freezing  # noqa: E402
import multiview  # noqa: E402
import radius  # noqa: E402
import references  # noqa: E402
import throughput  # noqa: E402
import variance  # noqa: E402
from methods import parse_method  # noqa: E402
from scene_files import bundled  # noqa: E402


def main(arguments: list[str] | None = None) -> None:
    """Run the sub-command that the arguments name."""
    options = _parser().parse_args(arguments)
    options.run(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="SUB-COMMAND")

    command = _measuring(commands, "throughput", throughput)
    command.add_argument("--sizes", type=int, nargs="+", default=[128, 256, 512, 1024], metavar="PIXELS",
                         help="edges of the square film (default: 128 256 512 1024)")
    command.add_argument("--light-paths", type=int, nargs="*", metavar="N",
                         default=[10_000, 30_000, 100_000, 300_000, 1_000_000],
                         help=f"light paths an iteration, at {throughput.SIZE_OF_SWEEP} pixels; as many as "
                         "pixels are measured at every size (default: 10000 30000 100000 300000 1000000)")
    command.add_argument("--full", action="store_true", help="every number of light paths at every size")
    command.add_argument("--quick", action="store_true", help="only 256 pixels and as many light paths")
    command.add_argument("--photons", type=float, default=10, help="photons a gather (default: 10)")
    command.add_argument("--time", type=float, default=3, metavar="SECONDS",
                         help="what bdpm, bdpm with edge probes, and path have each (default: 3)")

    command = _measuring(commands, "compare", compare)
    command.add_argument("--integrators", nargs="+", type=parse_method, metavar="PLUGIN[:name=value,...]",
                         default=[parse_method(text) for text in ("path", "bdpm:bdd=0", "bdpm:bdd=1")],
                         help="methods; ratios are to the first (default: path bdpm:bdd=0 bdpm:bdd=1)")
    command.add_argument("--time", type=float, default=10, metavar="SECONDS",
                         help="rendering seconds of each (default: 10)")
    _compares_with_references(command)

    command = _measuring(commands, "variance", variance)
    command.add_argument("--integrators", nargs="+", type=parse_method, metavar="PLUGIN[:name=value,...]",
                         default=[parse_method(text) for text in ("bdpm:bdd=0", "bdpm:bdd=1", "bdpm:bdd=2", "bdpm_balance",
                                                                  "bdpm_opt2", "bdpm_opt3", "bdpm_opt3:weights=full")],
                         help="methods, some of them bdpm: ratios are to the best of these (default: bdpm with bdd 0, 1, 2, "
                         "bdpm_balance, bdpm_opt2, bdpm_opt3 with local and with full weights)")
    command.add_argument("--iterations", type=int, default=24, help="(default: 24)")
    command.add_argument("--camera-paths", type=int, nargs="+", default=[1], metavar="N", help="N_B (default: 1)")
    command.add_argument("--radius", type=float, metavar="R", help="merge radius (default: a share of the scene's diagonal)")
    command.add_argument("--radius-share", type=float, default=0.005, metavar="SHARE", help="(default: 0.005)")
    command.add_argument("--scale", type=float, default=1, help="film size, scene's own = 1 (default: 1)")

    command = _measuring(commands, "radius", radius)
    command.add_argument("--bdd", type=int, nargs="+", default=[0, 1], help="(default: 0 1)")
    command.add_argument("--time", type=float, nargs="+", default=[5, 60], metavar="SECONDS",
                         help="rendering seconds of each radius (default: 5 60)")
    command.add_argument("--radii", type=int, default=9, help="how many, factor sqrt 2 (default: 9)")
    _compares_with_references(command)

    command = _measuring(commands, "multiview", multiview)
    command.set_defaults(scenes=multiview.SCENES)
    command.add_argument("--weights", nargs="+", default=["mis", "mwis"], help="weights of volpath_multiview (default: mis mwis)")
    command.add_argument("--time", type=float, default=5, metavar="SECONDS", help="rendering seconds of each (default: 5)")
    command.add_argument("--seeds", type=int, default=8, help="renders of each, at least two (default: 8)")
    command.add_argument("--scale", type=float, default=1, help="film size, scene's own = 1 (default: 1)")
    command.add_argument("--charts", action="store_true", help="draw the shifted densities (needs matplotlib)")

    for name, function in (("freeze-scenes", freezing.freeze), ("check-scenes", freezing.check)):
        command = commands.add_parser(name, help=function.__doc__, description=function.__doc__)
        command.set_defaults(run=function)
    return parser


def _measuring(commands, name: str, module) -> argparse.ArgumentParser:
    """A sub-command with the options that all measurements have."""
    command = commands.add_parser(name, help=module.__doc__, description=module.__doc__)
    command.add_argument("--scenes", nargs="+", type=Path, default=bundled(), metavar="FILE.xml",
                         help="scene files (default: the bundled ones)")
    command.add_argument("--out", type=Path, default=Path("out/benchmarks"), metavar="DIR",
                         help="where CSV and JSON files go (default: out/benchmarks)")
    command.set_defaults(run=module.run)
    return command


def _compares_with_references(command: argparse.ArgumentParser) -> None:
    command.add_argument("--seeds", type=int, default=1, help="renders of each method (default: 1)")
    command.add_argument("--scale", type=float, default=1, help="film size, scene's own = 1 (default: 1)")
    references.add_options(command)


if __name__ == "__main__":
    main()
