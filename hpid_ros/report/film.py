"""Animations and stills: camera, frames, page, files (WebP, GIF, APNG; a still also JPEG).

Pillow writes them all, and is there because matplotlib needs it. MP4 would need ffmpeg.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hpid_ros.base.errors import SettingError
from hpid_ros.base.text import shown
from hpid_ros.base.units import Numbers
from hpid_ros.messages.series import RunSeries, seconds_since
from hpid_ros.report.film_chart import FilmChart, film_chart, font_file, run_color
from hpid_ros.report.film_motion import Motion, Stand, corners, motion_of
from hpid_ros.report.style import INK, PAPER
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.shapes import Body, drawn_shapes
from hpid_ros.simulation.settings import WorldSettings, default_engine, require_engine
from hpid_ros.simulation.stage import (
    FIELD,
    MESHES,
    Picture,
    Pixels,
    Stage,
    StageSettings,
    View,
    open_stage,
)

_ROUNDS = 8
_AIR = 1.1
"""How much wider than what is in it a picture is."""


def framed(points: Numbers, azimuth: float, elevation: float, aspect: float) -> View:
    """Return the view from one side that holds some points, them in its middle."""
    axes = View((0.0, 0.0, 0.0), 1.0, azimuth, elevation).axes
    right, up, near = axes @ points.T
    high = math.tan(FIELD / 2.0) / _AIR
    wide = high * aspect
    x, y, z = ((each.min() + each.max()) / 2.0 for each in (right, up, near))
    distance = 0.0
    for _ in range(_ROUNDS):
        reach = np.maximum(abs(right - x) / wide, abs(up - y) / high)
        distance = float((reach + near - z).max())
        depth = distance - (near - z)
        # Nearer points weigh more: the middle of what is seen is not that of the points.
        x += _middle((right - x) / depth) * distance
        y += _middle((up - y) / depth) * distance
    tx, ty, tz = (axes.T @ (x, y, z)).tolist()
    return View((tx, ty, tz), distance, azimuth, elevation)


def _middle(values: Numbers) -> float:
    return float(values.min() + values.max()) / 2.0


_FLOOR, _THICKNESS = (0.93, 0.94, 0.96), 0.004
_DEEP, _WIDE = 3.6, 12.0
"""Edges of the floor over half of what the robot needs of it: none but the far one is seen."""
_DOUBLE, _SHARE = (0.10, 0.66, 0.36), 0.45
_IN_FRONT = 0.006
"""How much nearer the double is where it is drawn over the robot, over the camera's distance."""
_LEAST = 0.1
"""What moves less is not drawn again, over the height of a pixel; of a body's turn over 1 m."""


class Studio:
    """Takes pictures of the motions of one robot, all from the same place."""

    def __init__(
        self,
        stand: Stand,
        motions: Sequence[Motion],
        engine: str,
        size: tuple[int, int],
        side: tuple[float, float],
    ) -> None:
        self._motions = motions
        robot = [shape.body for shape in stand.shapes]
        boxes = stand.boxes
        points = np.concatenate(
            [
                corners([*robot, *boxes], np.concatenate([places, each.boxes], axis=1))
                for each in motions
                for places in (each.robot, each.wanted)
                if places is not None
            ]
        )
        floor, self._floor = _floor(points, side[0])
        view = framed(points, *side, size[0] / size[1])
        self._nearer = _IN_FRONT * view.distance
        self._least = _LEAST * 2.0 * math.tan(FIELD / 2.0) * view.distance / size[1]
        self._drawn: dict[tuple[int, int], tuple[Numbers, Picture]] = {}
        self._stages: list[Stage] = []
        try:
            bodies = (floor, *boxes, *robot)
            self._stages.append(open_stage(engine, StageSettings(bodies, view, *size)))
            if any(each.wanted is not None for each in motions):
                double = [body._replace(color=_DOUBLE) for body in robot]
                settings = StageSettings(double, view, *size, is_lit=False)
                self._stages.append(open_stage(engine, settings))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free what draws."""
        while self._stages:
            self._stages.pop().close()

    def shoot(self, number: int, k: int) -> Pixels:
        """Return the picture of one of the motions at its k-th instant."""
        motion = self._motions[number]
        places = np.concatenate([self._floor[None], motion.boxes[k], motion.robot[k]])
        picture = self._draw(0, number, places)
        if motion.wanted is None:
            return picture.pixels
        return self._with_double(picture, self._draw(1, number, motion.wanted[k]))

    def _draw(self, stage: int, number: int, places: Numbers) -> Picture:
        """Return the picture of bodies, the last one while nothing moves that could be seen."""
        last = self._drawn.get((stage, number))
        if last is not None and abs(places - last[0]).max() < self._least:
            return last[1]
        picture = self._stages[stage].draw(places)
        self._drawn[stage, number] = places, picture
        return picture

    def _with_double(self, picture: Picture, double: Picture) -> Pixels:
        """Return a picture with the double where it stands before everything else."""
        shown = double.depth < picture.depth - self._nearer
        mixed = (1.0 - _SHARE) * picture.pixels[shown] + _SHARE * double.pixels[shown]
        pixels: Pixels = picture.pixels.copy()
        pixels[shown] = mixed.round()
        return pixels


def _floor(points: Numbers, azimuth: float) -> tuple[Body, Numbers]:
    """Return a floor below everything, one edge along the picture, and its placement."""
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = (low[:2] + high[:2]) / 2.0
    radius = float(np.linalg.norm(points[:, :2] - (x, y), axis=1).max())
    turn = math.sin(azimuth / 2.0), math.cos(azimuth / 2.0)
    place = np.array([x, y, low[2] - _THICKNESS / 2.0, 0.0, 0.0, *turn])
    return Body("box", (_DEEP * radius, _WIDE * radius, _THICKNESS), _FLOOR), place


_HEADER, _CHART = 0.075, 0.31  # of the height
_LABEL, _READING = 0.55, 0.45  # of the header's height
_SOFT = "#5b6472"
_EDGE = 12  # [pixels]


class PageSize(NamedTuple):
    """Where everything is, in pixels."""

    width: int  # of the frame
    height: int  # of the frame
    header: int  # height of the labels
    panel: tuple[int, int]  # width and height of each picture
    chart: tuple[int, int]  # width and height of the chart

    @classmethod
    def of(cls, width: int, height: int, count: int) -> PageSize:
        """Return the places for so many runs side by side."""
        header, chart = round(_HEADER * height), round(_CHART * height)
        panel = width // count, height - header - chart
        return cls(width, height, header, panel, (width, chart))


class Page:
    """Puts frames together."""

    def __init__(
        self, size: PageSize, runs: Sequence[RunSeries], chart: FilmChart, speed: float
    ) -> None:
        self._size, self._runs, self._chart, self._speed = size, runs, chart, speed
        self._pale, self._full = (Image.fromarray(each) for each in (chart.pale, chart.full))
        self._label = ImageFont.truetype(font_file(is_bold=True), round(_LABEL * size.header))
        self._plain = ImageFont.truetype(font_file(), round(_READING * size.header))
        self._times = [
            seconds_since(reading.stamps_ns, run.start_ns)
            for run, reading in zip(runs, chart.readings, strict=True)
        ]

    def frame(self, instant: float, pictures: Sequence[Pixels]) -> Image.Image:
        """Return the frame of an instant."""
        size = self._size
        frame = Image.new("RGB", (size.width, size.height), PAPER)
        pen = ImageDraw.Draw(frame)
        for k, picture in enumerate(pictures):
            left = k * size.panel[0]
            frame.paste(Image.fromarray(picture), (left, size.header))
            self._write(pen, k, left, instant)
        self._paste_chart(frame, pen, instant)
        return frame

    def _write(self, pen: ImageDraw.ImageDraw, k: int, left: int, instant: float) -> None:
        middle, right = self._size.header // 2 + 2, left + self._size.panel[0] - _EDGE
        label = shown(self._runs[k].label)
        pen.text((left + _EDGE, middle), label, run_color(k), self._label, anchor="lm")
        values = self._chart.readings[k].values
        if values.size:
            value = float(np.interp(instant, self._times[k], values))
            text = f"{self._chart.symbol} = {value:.3f} {self._chart.unit}"
            pen.text((right, middle), text, _SOFT, self._plain, anchor="rm")

    def _paste_chart(self, frame: Image.Image, pen: ImageDraw.ImageDraw, instant: float) -> None:
        chart, (width, height) = self._chart, self._size.chart
        top = self._size.height - height
        share = (instant - chart.first) / (chart.last - chart.first)
        column = round(chart.left + share * (chart.right - chart.left))
        frame.paste(self._pale, (0, top))
        frame.paste(self._full.crop((0, 0, column, height)), (0, top))
        low, high = top + chart.top, top + chart.bottom
        pen.line([(column, low), (column, high)], INK, 1)
        speed = "" if self._speed == 1.0 else f"   {self._speed:g} x"
        text = f"{instant:.2f} s{speed}"
        pen.text((width - _EDGE, top + 4), text, INK, self._plain, anchor="ra")


MOST_RUNS = 4
MOST_FRAMES = 1500
LONGEST = 10.0
"""An animation that is longer is shown faster where nobody says how fast, in [s]."""
_SHORTEST = 1e-3  # [s]
_AZIMUTH, _ELEVATION = -50.0, 16.0  # [deg]


@dataclass(frozen=True)
class FilmSettings:
    """What an animation shows, and how."""

    width: int = 720  # of the picture, in pixels
    height: int = 450  # of the picture, in pixels
    fps: float = 12.5  # pictures in a second; formats count in hundredths of a second
    start: float = 0.0  # first instant, seconds since the first state
    end: float | None = None  # last instant; None for the runs' last state
    speed: float | None = None  # seconds shown in one of the clock
    joint: str | None = None  # draw this joint's position below
    engine: str | None = None  # who draws, pybullet or mujoco; None for the default
    azimuth: float = _AZIMUTH  # [deg] where the camera stands, about z from x
    elevation: float = _ELEVATION  # [deg] how far above the robot's middle

    def __post_init__(self) -> None:
        for name, least, most in (
            ("width", 160, 3840),
            ("height", 160, 2160),
            ("fps", 1.0, 50.0),
            ("speed", 0.01, 1000.0),
            ("azimuth", -360.0, 360.0),
            ("elevation", -85.0, 85.0),
        ):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise SettingError(f"{name} {value:g} must be from {least:g} to {most:g}")

    @property
    def period_ms(self) -> int:
        """Time from one picture to the next, in [ms]."""
        return 10 * round(100.0 / self.fps)


class Film(NamedTuple):
    """An animation."""

    frames: list[Image.Image]  # the pictures
    period_ms: int  # [ms] how long each stands
    speed: float  # seconds shown in one of the clock
    instants: Numbers  # what each shows, seconds since the first state


Progress = Callable[[int, int], None]
"""Is told how many pictures of how many are done."""


def render(
    world: WorldSettings,
    runs: Sequence[RunSeries],
    bags: Mapping[str, Path],
    settings: FilmSettings,
    progress: Progress = lambda done, total: None,
) -> Film:
    """Return the animation of some runs."""
    if not 1 <= len(runs) <= MOST_RUNS:
        raise SettingError(
            f"an animation shows 1 to {MOST_RUNS} runs beside each other, not {len(runs)}: choose "
            f"some of {', '.join(run.label for run in runs)}"
        )
    instants, speed = _instants(settings, max(run.duration for run in runs))
    engine = settings.engine or default_engine()
    require_engine(engine)
    description = RobotDescription.load(world.robot_description)
    stand = Stand(world, description, drawn_shapes(description, MESHES[engine]))
    size = PageSize.of(settings.width, settings.height, len(runs))
    window = _window(settings, instants, max(run.duration for run in runs))
    page = Page(size, runs, film_chart(runs, settings.joint, size.chart, window), speed)
    motions = [motion_of(stand, run, bags[run.label], instants) for run in runs]
    side = np.radians(settings.azimuth), np.radians(settings.elevation)
    frames: list[Image.Image] = []
    with closing(Studio(stand, motions, engine, size.panel, side)) as studio:
        for k, instant in enumerate(instants.tolist()):
            frames.append(
                page.frame(instant, [studio.shoot(each, k) for each in range(len(runs))])
            )
            progress(k + 1, len(instants))
    return Film(frames, settings.period_ms, speed, instants)


def _window(settings: FilmSettings, instants: Numbers, duration: float) -> tuple[float, float]:
    """Return what the chart shows: the same as the pictures, or of one picture the whole run."""
    if settings.start == settings.end:
        return 0.0, max(duration, _SHORTEST)
    first, last = float(instants[0]), float(instants[-1])
    return first, max(last, first + _SHORTEST)


def _instants(settings: FilmSettings, duration: float) -> tuple[Numbers, float]:
    """Return what is shown when, in [s], and seconds shown in one of the clock."""
    start, end = settings.start, duration if settings.end is None else settings.end
    if not 0.0 <= start <= end <= duration + _SHORTEST:
        raise SettingError(
            f"from {start:g} s to {end:g} s is not within the runs, which take {duration:g} s"
        )
    speed = settings.speed or max(1.0, float(np.ceil((end - start) / LONGEST)))
    step = settings.period_ms * 1e-3 * speed
    count = int((end - start) / step + 1e-6) + 1
    if count > MOST_FRAMES:
        raise SettingError(
            f"the animation would have {count} pictures, more than {MOST_FRAMES}: show less of "
            "the runs, faster, or with fewer pictures in a second"
        )
    return np.asarray(start + step * np.arange(count)), speed


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
