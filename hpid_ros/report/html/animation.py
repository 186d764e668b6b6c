"""An animation in a report that is written already."""

from __future__ import annotations

import base64

from hpid_ros.recordings.series import SeriesError
from hpid_ros.report.html.page import template

_BEGIN, _END = "<!-- animation -->", "<!-- end of animation -->"
"""Where it stands; no text of a recording can look like that, they are all escaped."""


def require_place(page: str) -> None:
    """Refuse a report that has no place for an animation."""
    if _END not in page.partition(_BEGIN)[2]:
        raise SeriesError("the report has no place for an animation: an earlier version wrote it")


def with_animation(page: str, moving: bytes, still: bytes, text: str) -> str:
    """Return a report with an animation below its answer, in the place of any that is there."""
    require_place(page)
    before, begin, rest = page.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    figure = template("animation.html").render(
        moving=base64.b64encode(moving).decode(), still=base64.b64encode(still).decode(), text=text
    )
    return f"{before}{begin}{figure}{end}{after}"
