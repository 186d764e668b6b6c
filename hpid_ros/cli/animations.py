"""Animations from the command line: rendered with a progress line, put into a result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hpid_ros.base.errors import SettingError
from hpid_ros.cli.options import progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from hpid_ros.experiment.result_folder import ResultFolder
    from hpid_ros.report.film import Film, FilmSettings


ANIMATION, PICTURE, REPORT = "animation.webp", "picture.png", "report.html"
"""Names of files in a result folder."""


def rendered(
    console: Console, result: Path, labels: Sequence[str], settings: FilmSettings
) -> Film:
    """Return the animation of a result's runs, and show how far it is meanwhile."""
    from hpid_ros.report.film import render
    from hpid_ros.report.film_motion import recorded

    found = recorded(result, labels)
    with _pictures(console) as told:
        return render(found.world, found.runs, found.bags, settings, told)


def report_page(result: Path) -> str:
    """Return the report of a result, which has a place for an animation."""
    from hpid_ros.report.page import require_place

    report = result / REPORT
    try:
        page = report.read_text(encoding="utf-8")
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SettingError(f"cannot read {report}: {reason}") from None
    require_place(page)
    return page


def save_in_report(folder: ResultFolder, film: Film) -> None:
    """Put an animation into the report of a result, in the place of one that is there."""
    from hpid_ros.report.film import encoded, for_report
    from hpid_ros.report.page import with_animation

    page = report_page(folder.path)
    still = encoded(film._replace(frames=film.frames[:1]), ".webp")
    text = f"The robot as it moved, from {film.instants[0]:g} s to {film.instants[-1]:g} s"
    folder.write(REPORT, with_animation(page, for_report(film), still, text))


@contextmanager
def _pictures(console: Console) -> Iterator[Callable[[int, int], None]]:
    """Show how many pictures are done, from the first one on."""
    with ExitStack() as stack:
        advance: Callable[[str], None] | None = None

        def told(done: int, total: int) -> None:
            nonlocal advance
            if advance is None:
                advance = stack.enter_context(progress(console, "pictures", total))
            advance("")

        yield told
