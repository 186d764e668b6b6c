"""Animations and stills as files: WebP, GIF, APNG; a still also as JPEG.

Pillow writes them all, and is there because matplotlib needs it. MP4 would need ffmpeg.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from hpid_ros.base.errors import SettingError
from hpid_ros.rendering.film import Film

ANIMATED = (".webp", ".gif", ".png")
STILL = (".png", ".webp", ".jpg")
_LAST_MS = 1500
"""How long the last frame stands before the first comes again."""
_QUALITY = 72
_COARSER = (_QUALITY, 50, 25)
_LARGEST = 1_500_000  # bytes in a report
_COLORS = 128
_SAMPLES = 6


def require_suffix(path: Path, *, is_still: bool) -> None:
    """Refuse a file whose format is not known."""
    known = STILL if is_still else ANIMATED
    if path.suffix.lower() not in known:
        kind = "a still picture" if is_still else "an animation"
        raise SettingError(
            f"{path}: the suffix of {kind} must be one of {', '.join(known)}, not "
            f"{path.suffix or 'none'!r}"
        )


def encoded(film: Film, suffix: str, quality: int = _QUALITY) -> bytes:
    """Return an animation as the bytes of a file; of one frame, a still picture."""
    suffix, frames = suffix.lower(), film.frames
    buffer = io.BytesIO()
    if len(frames) == 1:
        frames[0].save(buffer, "JPEG" if suffix == ".jpg" else suffix[1:], quality=quality)
        return buffer.getvalue()
    times = [film.period_ms] * (len(frames) - 1) + [_LAST_MS]
    how = {"save_all": True, "duration": times, "loop": 0}
    if suffix == ".webp":
        frames[0].save(buffer, "WEBP", append_images=frames[1:], quality=quality, method=4, **how)
    elif suffix == ".gif":
        few = _few_colors(frames)
        few[0].save(buffer, "GIF", append_images=few[1:], optimize=False, **how)
    else:
        frames[0].save(buffer, "PNG", append_images=frames[1:], **how)
    return buffer.getvalue()


def for_report(film: Film) -> bytes:
    """Return an animation as WebP, coarser if it is large: a page is to stay light."""
    content = b""
    for quality in _COARSER:
        content = encoded(film, ".webp", quality)
        if len(content) <= _LARGEST:
            break
    return content


def _few_colors(frames: Sequence[Image.Image]) -> list[Image.Image]:
    """Return frames that share one palette, so that what does not move does not change."""
    some = frames[:: max(1, len(frames) // _SAMPLES)]
    width, height = frames[0].size
    together = Image.new("RGB", (width, height * len(some)))
    for k, frame in enumerate(some):
        together.paste(frame, (0, k * height))
    palette = together.quantize(_COLORS, Image.Quantize.MEDIANCUT)
    return [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
