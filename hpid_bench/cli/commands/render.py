"""``hpid render``: the robot as it moved under each controller, side by side, as an animation."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.options import progress, write_output
from hpid_bench.cli.terminal import output_console, print_result_places
from hpid_bench.experiment.result_folder import ResultFolder, system_errors
from hpid_bench.report.film import (
    Film,
    FilmSettings,
    encoded,
    for_report,
    recorded,
    render,
    require_suffix,
)
from hpid_ros.base.errors import SettingError
from hpid_ros.base.files import refuse_output

ANIMATION, PICTURE, REPORT = "animation.webp", "picture.png", "report.html"
"""Names of files in a result folder."""
_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})")


def run(options: argparse.Namespace) -> int:
    settings = _settings(options)
    is_still = options.at is not None
    if is_still and options.report:
        raise SettingError("--report takes an animation: leave out --at")
    result: Path = options.result
    own = result / (PICTURE if is_still else ANIMATION)
    target: Path = options.output or own
    require_suffix(target, is_still=is_still)
    refuse_output(target, force=options.force, inputs=(), option="-o")
    if options.report:
        report_page(result)  # before it is drawn, which takes a while
    console = output_console()
    film = rendered(console, result, options.controller, settings)
    content = encoded(film, target.suffix)
    if options.output is None or options.report:
        with ResultFolder.reopen(result) as folder:
            if options.output is None:
                folder.write(own.name, content)
            if options.report:
                save_in_report(folder, film)
    if options.output is not None:
        write_output(target, content)
    count = len(film.frames)
    what = "1 picture" if count == 1 else f"{count} pictures"
    console.print(f"{what}, {len(content) / 1e6:.2f} MB")
    report = {"report": result / REPORT} if options.report else {}
    print_result_places(console, {"written": target} | report)
    return DONE


def rendered(
    console: Console, result: Path, labels: Sequence[str], settings: FilmSettings
) -> Film:
    """Return the animation of a result's runs, and show how far it is meanwhile."""
    world, runs, bags = recorded(result, labels)
    with ExitStack() as stack:
        advances: list[Any] = []

        def advance(done: int, total: int) -> None:
            if not advances:  # from the first one on, so that a refusal shows no bar
                advances.append(stack.enter_context(progress(console, "pictures", total)))
            advances[0]("")

        return render(world, runs, bags, settings, advance)


def report_page(result: Path) -> str:
    """Return the report of a result, which has a place for an animation."""
    from hpid_bench.report.page import require_place

    report = result / REPORT
    with system_errors(f"cannot read {report}", SettingError):
        page = report.read_text(encoding="utf-8")
    require_place(page)
    return page


def save_in_report(folder: ResultFolder, film: Film) -> None:
    """Put an animation into the report of a result, in the place of one that is there."""
    from hpid_bench.report.page import with_animation

    page = report_page(folder.path)
    still = encoded(film._replace(frames=film.frames[:1]), ".webp")
    text = f"The robot as it moved, from {film.instants[0]:g} s to {film.instants[-1]:g} s"
    folder.write(REPORT, with_animation(page, for_report(film), still, text))


def _settings(options: argparse.Namespace) -> FilmSettings:
    size = _SIZE.fullmatch(options.size)
    if size is None:
        raise SettingError(f"--size {options.size!r} must be WIDTHxHEIGHT, for instance 720x450")
    if options.at is not None and (options.to is not None or options.start):
        raise SettingError("--at is one instant: leave out --from and --to")
    azimuth, elevation = options.view
    return FilmSettings(
        width=int(size[1]),
        height=int(size[2]),
        fps=options.fps,
        start=options.start if options.at is None else options.at,
        end=options.to if options.at is None else options.at,
        speed=options.speed,
        joint=options.joint,
        engine=options.engine,
        azimuth=azimuth,
        elevation=elevation,
    )
