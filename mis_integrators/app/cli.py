"""The command ``mis-render``: render a Mitsuba scene to an EXR file, and a PNG beside it."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.session import Session
from ..core.traits import unfinite_data
from ..core.untrusted import Malformed
from . import checkpoint, cluster, compare, denoising, loading, output, reproduce, tev
from .checkpoint import Checkpoint, CheckpointError
from .explain import explanation
from .options import parse, versions
from .progress import Progress, complain, tell
from .render_loop import Chore, Clock, Interrupt, fewest_iterations, iterate
from .request import Opened, Request
from .target_error import TargetError

EXIT_OK, EXIT_SCENE, EXIT_USAGE, EXIT_OUTPUT, EXIT_CHECKPOINT, EXIT_CLUSTER, EXIT_INTERRUPTED = (
    0,
    1,
    2,
    3,
    4,
    5,
    130,
)


TEV_SECONDS = 1.0
"""Between two images in tev."""


class Failure(Exception):
    """An error to report in one line, and the exit code."""

    def __init__(self, code: int, message: str):
        super().__init__(message)
        self.code = code


def main(arguments: list[str] | None = None) -> int:
    """Run ``mis-render`` with the arguments (default: those of the process) and return its exit
    code."""
    options = parse(arguments)
    interrupt = Interrupt()
    try:
        with (
            interrupt,
            np.errstate(all="ignore"),
        ):  # values that are not finite are left out, and said once
            return _run(options, interrupt)
    except BaseException as error:
        # Libraries turn an interrupt that reaches them into errors of any kind.
        if interrupt.stopped or isinstance(error, KeyboardInterrupt):
            left = f"only the preview {interrupt.preview}" if interrupt.preview else "nothing"
            complain(f"interrupted, {left} written{_about_earlier(options)}")
            return EXIT_INTERRUPTED
        if not isinstance(error, Failure):
            raise
        complain(str(error))
        return error.code


def _run(options: argparse.Namespace, interrupt: Interrupt) -> int:
    _check_outputs(options)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(output.alone(options.output))
        except OSError as error:
            raise Failure(
                EXIT_OUTPUT, f"cannot write {options.output}: {error.strerror or error}"
            ) from error
        try:
            return _render_alone(options, interrupt)
        except MemoryError as error:
            raise Failure(
                EXIT_SCENE,
                f"{OUT_OF_MEMORY}; render a smaller film, or fewer light paths an iteration",
            ) from error


def _render_alone(options: argparse.Namespace, interrupt: Interrupt) -> int:
    with contextlib.ExitStack() as stack:
        try:
            learned = _follow(options) if options.like else {}
            for flag, wanted, part in (
                ("--denoise", options.denoise, denoising),
                ("--compare", options.compare, compare),
            ):
                try:
                    if wanted:
                        part.require()
                except ImportError as error:
                    raise Failure(EXIT_USAGE, f"{flag}: {error}") from error
            needs_views = (
                "--all-views" if options.all_views else "--frames" if options.frames else None
            )
            opened = _request(options).open(needs_views)
            if options.denoise:
                denoising.check_channels(opened.session.channels)
            rival = (
                compare.prepare(options.compare, options.reference, opened)
                if options.compare
                else None
            )
            for description in unfinite_data(opened.loaded.scene):
                complain(
                    f"{description} (NaN or infinite): what they light or colour is left out of "
                    "the image"
                )
            session: Any = opened.session
            if learned != {}:
                _recall_image(session, learned, options)
            identity = opened.identity() if options.checkpoint else {}
            keep_variance = bool(options.checkpoint or options.target_error)
            if keep_variance:
                session.keep_variance()
            clock = _resume(options, identity, session) if options.checkpoint else Clock()
            target = TargetError(options.target_error) if options.target_error else None
            if options.workers or options.scheduler:
                client = stack.enter_context(cluster.connected(options.workers, options.scheduler))
                threads = max(1, dr.thread_count() // options.workers) if options.workers else None
                session = cluster.DistributedSession(client, opened, keep_variance, threads)
            kept, broken = _render(
                session,
                opened.sensor,
                options,
                identity,
                clock,
                target,
                interrupt,
                options.output.name,
            )
        except (Failure, MemoryError):
            raise
        except Exception as error:
            raise _failure(error) from error

        metadata = _metadata(options, opened.loaded, session, clock)
        metadata[reproduce.ATTRIBUTE] = reproduce.attribute(
            options, session, opened.session.learned
        )
        if pixels := session.unfinite_pixels():
            metadata["unfinitePixels"] = pixels
            complain(
                f"{pixels} pixels had values that are not finite (NaN or infinite) in some "
                "iterations; those values are left out"
            )
        if target:
            target.update(session)
            metadata["relativeError"] = target.error
            if target.black:
                complain(
                    "the image is black, so that its relative error says nothing: is there "
                    "light, and does the camera look at it?"
                )
        # Before the workers are left, which may take long.
        written, clean = _write(options, opened, session, metadata, options.output, kept)
        for suffix in (".preview.exr", ".preview.png") if options.preview else ():
            with contextlib.suppress(OSError):
                options.output.with_suffix(suffix).unlink()
    report = (
        f"{metadata['spp']} samples per pixel in {clock.rendering:.1f} s (and "
        f"{clock.compiling:.1f} s of "
        f"compiling){_about_error(target)}: {written}"
    )
    if broken:
        failure = _failure(broken)
        raise Failure(
            failure.code, f"{failure}; what was rendered before is written, {report}"
        ) from broken
    if interrupt.requested:
        complain(f"interrupted after {report}{_how_to_go_on(options, kept)}")
        return EXIT_INTERRUPTED
    if not options.quiet:
        complain(report, "")
    if options.explain:
        tell(*explanation(session.settings, opened.settings))
    if rival:
        first = compare.Rendered(opened, session.image(), clean, clock.rendering)
        return _compare(options, rival, first, interrupt)
    return EXIT_OK


def _compare(
    options: argparse.Namespace,
    rival: compare.Rival,
    first: compare.Rendered,
    interrupt: Interrupt,
) -> int:
    """Render the rival of an image that is written for the same time; put both side by side."""
    path = output.compared_path(options.output)
    try:
        rows = rival.rows(first, _render_rival(options, rival, first, interrupt))
        try:
            compare.write_picture(path, rows, rival.names)
        except OSError as error:
            reason = error.strerror or error
            raise Failure(EXIT_OUTPUT, f"cannot write {path}: {reason}") from error
    except BaseException as error:
        if interrupt.stopped or isinstance(error, KeyboardInterrupt):
            complain(f"interrupted, not compared; {options.output} is written")
            return EXIT_INTERRUPTED
        if not isinstance(error, Exception):
            raise
        failure = error if isinstance(error, Failure) else _failure(error)
        raise Failure(
            failure.code, f"--compare {options.compare}: {failure}; {options.output} is written"
        ) from error
    if not options.quiet:
        told = [entry.line for row in rows for entry in row if entry.effort or entry.quality]
        for line in (*told, f"side by side: {path}"):
            complain(line, "")
    if interrupt.requested:
        complain(f"interrupted: {options.compare} had less time")
        return EXIT_INTERRUPTED
    return EXIT_OK


def _render_rival(
    options: argparse.Namespace,
    rival: compare.Rival,
    first: compare.Rendered,
    interrupt: Interrupt,
) -> compare.Rendered:
    """The rival's image after the time of the first one, as `_render` makes it."""
    seconds = options.time or first.seconds
    as_long = {**vars(options), "time": seconds, "spp": None, "target_error": None}
    session, clock = rival.opened.session, Clock()
    _, broken = _render(
        session,
        rival.opened.sensor,
        argparse.Namespace(**as_long),
        {},
        clock,
        None,
        interrupt,
        f"{options.output.name}, {options.compare}",
    )
    if broken:
        raise broken
    image, clean = session.image(), None
    if options.denoise:
        clean, _ = _denoised(image, session.channels, rival.opened)
    return compare.Rendered(rival.opened, image, clean, clock.rendering)


OUT_OF_MEMORY = "there is not enough memory"


def _failure(error: BaseException) -> Failure:
    """What to report of an error of the scene, of its rendering, or of the workers."""
    if isinstance(error, cluster.ClusterError):
        return Failure(EXIT_CLUSTER, str(error))
    if isinstance(error, MemoryError):
        return Failure(EXIT_SCENE, OUT_OF_MEMORY)
    known = isinstance(error, loading.SCENE_ERRORS)
    return Failure(
        EXIT_SCENE,
        loading.one_line(error) if known else f"{type(error).__name__}: {loading.one_line(error)}",
    )


def _follow(options: argparse.Namespace) -> dict[str, Any]:
    """Set the options to those of the image of ``--like``; returns what its session had learned."""
    recipe = reproduce.read(options.like)
    for name, value in recipe.options.items():
        setattr(options, name, value)
    if recipe.remark and not options.quiet:
        complain(f"{options.like} {recipe.remark}")
    return recipe.learned


def _recall_image(session: Session, learned: dict[str, Any], options: argparse.Namespace) -> None:
    try:
        session.recall(learned)
    except Malformed as error:
        raise Malformed(f"--like {options.like}: its header: {error}") from None


def _request(options: argparse.Namespace) -> Request:
    unbounded = options.time or (options.target_error and not options.spp)
    return Request(
        scene=str(options.scene),
        variables=dict(options.variables),
        plugin=options.plugin,
        parameters={name: loading.parse_value(text) for name, text in options.parameters},
        variant=options.variant,
        sensor=options.sensor,
        all_views=options.all_views,
        seed=options.seed,
        spp=0 if unbounded else options.spp,
        fine=bool(options.target_error or options.workers or options.scheduler),
        denoise=options.denoise,
    )


def _about_error(target: TargetError | None) -> str:
    if target is None:
        return ""
    if math.isinf(target.error):
        return ", relative error unknown after one iteration"
    missed = f" (target {target.target:g} not reached)" if target.error > target.target else ""
    return f", relative error {target.error:.3g}{missed}"


def _how_to_go_on(options: argparse.Namespace, kept: Path | None) -> str:
    """What to say after an interrupt; ``kept``: the checkpoint of what was rendered, if any."""
    if kept is None:
        return "" if options.checkpoint else "; only a render with --checkpoint can go on later"
    with_resume = "" if options.resume else " with --resume"
    return f"; to go on from {kept}, give the same command{with_resume}"


def _about_earlier(options: argparse.Namespace) -> str:
    """What to say of the checkpoint of an earlier moment, if there is one."""
    path = checkpoint.beside(options.output)
    kept = options.checkpoint and os.path.lexists(path)
    return f"; {path} holds what was rendered earlier, for --resume" if kept else ""


def _metadata(
    options: argparse.Namespace, loaded: loading.LoadedScene, session: Session, clock: Clock
) -> dict[str, str | int | float]:
    return {
        "integrator": loaded.plugin,
        **loaded.parameters,
        **session.settings,
        "spp": session.iterations * session.camera_paths,
        "iterations": session.iterations,
        "seed": options.seed,
        "variant": options.variant,
        "versions": versions(),
        "renderTime": clock.rendering,
        "compileTime": clock.compiling,
    }


def _render(
    session: Session,
    sensor: mi.Sensor,
    options: argparse.Namespace,
    identity: dict[str, Any],
    clock: Clock,
    target: TargetError | None,
    interrupt: Interrupt,
    title: str,
) -> tuple[Path | None, Exception | None]:
    """Iterate as long as the options say; returns the checkpoint that holds all of it, if there is
    one, and the error that ended it after there was enough for an image, if one did. ``title``:
    the image's name in tev."""
    width, height = sensor.film().crop_size()
    pixels = getattr(session, "pixels", width * height)
    if options.time and hasattr(session, "plan_time"):
        session.plan_time(options.time)
    planned = None if options.time else session.iterations_planned
    with (
        Progress(
            lambda: pixels * session.camera_paths, planned, options.time, options.quiet
        ) as progress,
        dr.scoped_set_flag(dr.JitFlag.KernelHistory),
    ):
        asked = options.spp or sensor.sampler().sample_count()
        if planned and planned * session.camera_paths > asked:
            progress.say(
                f"{asked} samples per pixel rounded up to {planned * session.camera_paths}: "
                f"{planned} iterations of {session.camera_paths}"
            )
        path = checkpoint.beside(options.output)
        keep = Chore(
            f"write {path}",
            options.checkpoint or math.inf,
            lambda: _keep(path, identity, session, clock),
            progress.warn,
        )
        preview = options.output.with_suffix(".preview.exr")
        show = Chore(
            f"write {preview}",
            options.preview or math.inf,
            lambda: _preview(session, options, preview, interrupt),
            progress.warn,
        )
        viewer = tev.Viewer(options.tev, title) if options.tev else None
        watch = Chore(
            f"show the image in tev at {viewer.address}" if viewer else "",
            (options.preview or TEV_SECONDS) if viewer else math.inf,
            lambda: _show(session, options, viewer),
            progress.warn,
        )
        broken = None
        try:
            iterate(
                session,
                planned,
                options.time,
                target,
                clock,
                [keep, show, watch],
                progress,
                interrupt,
            )
        except Exception as error:
            if session.iterations < fewest_iterations(session):
                if options.checkpoint and session.iterations:
                    keep.now()
                raise
            broken = error
        if viewer:
            watch.now()
            viewer.close()
        if not options.checkpoint:
            return None, broken
        keep.now()
        return None if keep.failure else path, broken


def _keep(path: Path, identity: dict[str, Any], session: Session, clock: Clock) -> None:
    sums = session.sums
    checkpoint.write(
        path,
        Checkpoint(
            identity, session.learned, sums.done, clock.rendering, clock.compiling, sums.arrays()
        ),
    )


def _resume(options: argparse.Namespace, identity: dict[str, Any], session: Session) -> Clock:
    """Let the session go on from the checkpoint, if it shall and there is one."""
    path = checkpoint.beside(options.output)
    if not os.path.lexists(path):
        return Clock()
    if not options.resume:
        raise Failure(
            EXIT_CHECKPOINT,
            f"{path} holds an earlier render: --resume goes on from it; remove it to start anew",
        )
    try:
        found = checkpoint.read(path)
        if what := checkpoint.difference(found.identity, identity):
            raise CheckpointError(f"{path} is of another render: {what}")
        session.recall(dict(found.learned))
        shapes = {name: array.shape for name, array in found.arrays.items()}
        learned = json.loads(json.dumps(session.learned))
        if shapes != (session.sum_shapes() if len(found.done) else {}) or (
            len(found.done) and learned != found.learned
        ):
            raise CheckpointError(f"{path} is no checkpoint of this render: its sums do not fit")
        session.sums.merge(found.arrays, found.done)
    except Malformed as error:
        raise Failure(
            EXIT_CHECKPOINT, f"cannot resume: {path} is no checkpoint of this render: {error}"
        ) from error
    except CheckpointError as error:
        raise Failure(EXIT_CHECKPOINT, f"cannot resume: {error}") from error
    except (OSError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or OUT_OF_MEMORY
        raise Failure(EXIT_CHECKPOINT, f"cannot resume: {path}: {reason}") from error
    for written in (path, options.output, options.output.with_suffix(".png")):
        output.remove_leftovers(written)
    return Clock(found.seconds, found.compiling)


def _preview(session: Any, options: argparse.Namespace, path: Path, interrupt: Interrupt) -> None:
    """Write the image so far, if there is one."""
    image = _image_so_far(session, options)
    if image is None:
        return
    output.write_exr(path, image, session.channels, {"iterations": session.iterations})
    interrupt.preview = path
    output.write_png(path.with_suffix(".png"), image, session.channels)


def _show(session: Any, options: argparse.Namespace, viewer: tev.Viewer | None) -> None:
    """Show the image so far in the viewer, if there are both."""
    if viewer:
        viewer.connect()  # before an image is made for nobody
        image = _image_so_far(session, options)
        if image is not None:
            viewer.show(image, session.channels)


def _image_so_far(session: Any, options: argparse.Namespace) -> np.ndarray | None:
    """The image, if there are iterations enough for one; all views on one sheet if so asked."""
    if session.iterations < fewest_iterations(session):
        return None
    return output.contact_sheet(session.view_images()) if options.all_views else session.image()


def _denoised(
    image: np.ndarray, channels: Sequence[str], opened: Opened
) -> tuple[np.ndarray, list[str]]:
    """As `denoising.denoised_picture` returns it."""
    loaded = opened.loaded
    hide_emitters = bool(loaded.parameters.get("hide_emitters", False))
    return denoising.denoised_picture(image, channels, loaded.scene, opened.sensor, hide_emitters)


def _write(
    options: argparse.Namespace,
    opened: Opened,
    session: Any,
    metadata: dict[str, str | int | float],
    path: Path,
    kept: Path | None,
) -> tuple[str, np.ndarray | None]:
    """Write the image, and what goes with it; returns what was written, in words, and the denoised
    image, if there is one."""
    png, channels = path.with_suffix(".png"), session.channels
    views = session.view_images() if options.all_views or options.frames else []
    image = output.contact_sheet(views) if options.all_views else session.image()
    writing, written, clean = path, "", None
    try:
        output.write_exr(path, image, channels, metadata)
        writing, written = png, str(path)
        if output.write_png(png, image, channels):
            written += f" and {png}"
        if options.frames:
            for number, view in enumerate(views):
                writing = output.frame_path(path, number)
                output.write_png(writing, view, channels)
            written += f", {len(views)} frames from {output.frame_path(path, 0)}"
        if options.denoise:
            clean, names = _denoised(image, channels, opened)
            writing = output.denoised_path(path)
            output.write_exr(writing, clean, names, {**metadata, "denoiser": denoising.version()})
            written += f", denoised {writing}"
            writing = writing.with_suffix(".png")
            output.write_png(writing, clean, names)
        return written, clean
    except OSError as error:
        rest = (
            f"; {written} is written"
            if written
            else f"; {kept} holds what was rendered, for --resume"
            if kept
            else ""
        )
        raise Failure(
            EXIT_OUTPUT, f"cannot write {writing}: {error.strerror or error}{rest}"
        ) from error


def _check_outputs(options: argparse.Namespace) -> None:
    """Refuse, before anything is rendered, what cannot be written in the end."""
    image = options.output
    files = [image, image.with_suffix(".png")]
    if options.denoise:
        denoised = output.denoised_path(image)
        files += [denoised, denoised.with_suffix(".png")]
    if options.preview:
        files += [image.with_suffix(".preview.exr"), image.with_suffix(".preview.png")]
    if options.compare:
        files.append(output.compared_path(image))
    for file in files:
        try:
            output.make_writable(file)
        except OSError as error:
            raise Failure(EXIT_OUTPUT, f"cannot write {file}: {error.strerror or error}") from error


if __name__ == "__main__":
    sys.exit(main())
