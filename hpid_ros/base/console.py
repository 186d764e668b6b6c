"""Output of a command: text, in which nothing that came from outside controls the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import IO, Any, TextIO, cast

from hpid_ros.base.text import shown_lines


class _Guard:
    """A stream that writes text alone, for all that is printed past a console."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        return self.stream.write(shown_lines(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def guarded_output() -> Iterator[None]:
    """Let nothing but text be printed while the block runs."""
    out, err = (cast("TextIO", _Guard(unguarded(each))) for each in (sys.stdout, sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        yield


def unguarded(stream: IO[str]) -> TextIO:
    """Return the stream that a guard writes to."""
    return stream.stream if isinstance(stream, _Guard) else cast("TextIO", stream)
