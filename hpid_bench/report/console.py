"""Output to a terminal: text, in which nothing that came from outside controls it."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from hpid_ros.base.console import unguarded
from hpid_ros.base.text import shown_lines


class TextConsole(Console):
    """A console on which every text is text: no markup, no emoji codes, no escape sequences.

    Styles are given with the texts. What a foreign name would do is shown instead.
    """

    def __init__(self, **options: Any) -> None:
        if "file" not in options:
            options["file"] = unguarded(sys.stderr if options.get("stderr") else sys.stdout)
        super().__init__(**({"markup": False, "emoji": False, "highlight": False} | options))

    def render_str(self, text: str, *args: Any, **options: Any) -> Text:
        return super().render_str(shown_lines(text), *args, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        if isinstance(renderable, Text):
            plain = shown_lines(renderable.plain)
            if plain != renderable.plain:
                renderable = Text(plain, style=renderable.style, justify=renderable.justify)
        yield from super().render(renderable, options)

    def on_broken_pipe(self) -> None:
        raise  # what is being handled: rich would end the process with code 1


def plain_console(width: int) -> TextConsole:
    """Return a console for texts: Unicode without colours, whatever the terminal is."""
    return TextConsole(file=io.StringIO(), width=width, color_system=None, legacy_windows=False)
