"""Animations and stills of recorded runs: motion, camera, chart, frames, files.

Positions are replayed, not simulated: each joint stands where it was measured, the base and bricks
where the simulation reported them. MuJoCo draws; Pillow, which matplotlib needs, writes WebP, GIF
and APNG, a still also as JPEG. MP4 would need ffmpeg.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure as Drawing
from matplotlib.font_manager import FontProperties, findfont
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from hpid_bench.report.figures import (
    BACKGROUND,
    INK,
    NO_RUN,
    RUN_STYLES,
    Figure,
    Line,
    Panel,
    are_slides,
)
from hpid_bench.report.plots import draw_panel, figure_style
from hpid_ros.base.errors import SettingError, unknown_name
from hpid_ros.base.records import Record, quantity
from hpid_ros.base.text import figure_text, shown
from hpid_ros.base.units import NANOSECONDS, Numbers, unit_over
from hpid_ros.base.yaml_files import load_document
from hpid_ros.messages.messages import BagMessages
from hpid_ros.messages.run import read_run
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import RunSeries, SeriesError, seconds_since
from hpid_ros.metrics.measure import recordings_of
from hpid_ros.metrics.signals import Signal, error_of, norm_of_run, position_of, reference_of
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.differential_drive import integrated
from hpid_ros.robot.kinematics import axis_rotations, link_poses
from hpid_ros.robot.shapes import Shape, drawn_shapes
from hpid_ros.simulation.gripper import BRICK_POSES
from hpid_ros.simulation.reports import TRUTH
from hpid_ros.simulation.settings import ENGINES, WorldSettings
from hpid_ros.simulation.stage import FIELD, Pixels, Stage, View
from hpid_ros.simulation.world_file import world_of

Stamps = NDArray[np.int64]

MOST_RUNS = 4
MOST_FRAMES = 1500
LONGEST_ANIMATION = 10.0  # [s]; a longer one is shown faster where nobody says how fast
_SHORTEST = 1e-3  # [s]


@dataclass(frozen=True)
class FilmSettings(Record):
    """What an animation shows, and how."""

    width: int = quantity("Width of the picture", "pixels", default=720, least=160, most=3840)
    height: int = quantity("Height of the picture", "pixels", default=450, least=160, most=2160)
    # Formats count in hundredths of a second.
    fps: float = quantity("Pictures in a second", "1/s", default=12.5, least=1.0, most=50.0)
    start: float = quantity("First instant, since the first state", "s", default=0.0)
    end: float | None = quantity("Last instant; None for the last state", "s", default=None)
    speed: float | None = quantity(
        "Seconds shown in one of the clock", default=None, least=0.01, most=1000.0
    )
    joint: str | None = quantity("Whose position is drawn below", default=None)
    engine: str | None = quantity("Whichever it is, MuJoCo draws", default=None, choices=ENGINES)
    azimuth: float = quantity(
        "Where the camera stands, about z from x", "deg", default=-50.0, least=-360.0, most=360.0
    )
    elevation: float = quantity(
        "Above the robot's middle", "deg", default=16.0, least=-85.0, most=85.0
    )

    @property
    def period_ms(self) -> int:
        """Time from one picture to the next, in [ms]."""
        return 10 * round(100.0 / self.fps)

    def instants(self, duration: float) -> tuple[Numbers, float]:
        """Return what is shown when, in [s], and seconds shown in one of the clock."""
        start, end = self.start, duration if self.end is None else self.end
        if not 0.0 <= start <= end <= duration + _SHORTEST:
            raise SettingError(
                f"from {start:g} s to {end:g} s is not within the runs, which take {duration:g} s"
            )
        speed = self.speed or max(1.0, float(np.ceil((end - start) / LONGEST_ANIMATION)))
        step = self.period_ms * 1e-3 * speed
        count = int((end - start) / step + 1e-6) + 1
        if count > MOST_FRAMES:
            raise SettingError(
                f"the animation would have {count} pictures, more than {MOST_FRAMES}: show less "
                "of the runs, faster, or with fewer pictures in a second"
            )
        return np.asarray(start + step * np.arange(count)), speed


class Film(NamedTuple):
    frames: list[Image.Image]  # the pictures
    period_ms: int  # [ms] how long each stands
    instants: Numbers  # what each shows, seconds since the first state


def recorded(
    result: Path, labels: Sequence[str] = ()
) -> tuple[WorldSettings, tuple[RunSeries, ...], dict[str, Path]]:
    """Return the world of a result, its runs in its order, and the recording of each by label."""
    bags = recordings_of(result)
    for label in labels:
        if label not in bags:
            raise SettingError(f"{result}: {unknown_name('run', label, bags)}")
    chosen = {label: bags[label] for label in labels or bags}
    document = load_document(result / "nodes" / next(iter(chosen)) / "world.yaml", SettingError)
    world = world_of(document.values, document).world
    selection = BagSelection(joints=world.joints)
    runs = tuple(read_run(bag, label, selection=selection) for label, bag in chosen.items())
    return world, runs, chosen


def require_few(labels: Sequence[str]) -> None:
    """Refuse more runs than stand next to each other in an animation."""
    if not 1 <= len(labels) <= MOST_RUNS:
        raise SettingError(
            f"an animation shows 1 to {MOST_RUNS} runs beside each other, not {len(labels)}: "
            f"choose some of {', '.join(labels)}"
        )


def render(
    world: WorldSettings,
    runs: Sequence[RunSeries],
    bags: Mapping[str, Path],
    settings: FilmSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Film:
    """Return the animation of some runs; it calls `progress` with pictures done and all."""
    require_few([run.label for run in runs])
    duration = max(run.duration for run in runs)
    instants, speed = settings.instants(duration)
    window = (0.0, duration) if settings.start == settings.end else (instants[0], instants[-1])
    page = _Page(settings, runs, (window[0], max(window[1], window[0] + _SHORTEST)), speed)
    description = RobotDescription.load(world.robot_description)
    shapes = drawn_shapes(description)
    links = list(dict.fromkeys(each.link for each in shapes))
    robot = [[each for each in shapes if each.link == link] for link in links]
    double = [[each._replace(color=_DOUBLE) for each in body] for body in robot]
    place = world.workplace
    boxes = [[Shape("", "box", each.size, _SUPPORT)] for each in place.supports]
    boxes += [[Shape("", "box", each.size, _BRICK)] for each in place.bricks]
    motions = [
        _Motion(world, description, links, run, bags[run.label]).placements(instants)
        for run in runs
    ]
    frames: list[Image.Image] = []
    with closing(Stage([*boxes, *robot, *double], *page.panel)) as stage:
        azimuth, elevation = np.radians(settings.azimuth), np.radians(settings.elevation)
        points = np.concatenate([stage.corners(each) for each in motions])
        view = framed(points, azimuth, elevation, page.panel[0] / page.panel[1])
        low, high = points.min(axis=0), points.max(axis=0)
        x, y = (low[:2] + high[:2]) / 2.0
        radius = float(np.linalg.norm(points[:, :2] - (x, y), axis=1).max())
        stage.open(view, (x, y, low[2]), radius)
        for each in motions:  # the double, seen from the camera, is behind what it coincides with
            far = each[:, len(boxes) + len(robot) :, :3]
            far += _BEHIND * (far - view.eye)
        for k, instant in enumerate(instants.tolist()):
            frames.append(page.frame(instant, [stage.draw(each[k]) for each in motions]))
            progress(k + 1, len(instants))
    return Film(frames, settings.period_ms, instants)


_SUPPORT, _BRICK = (0.86, 0.87, 0.90, 1.0), (0.70, 0.28, 0.20, 1.0)
_DOUBLE = (0.10, 0.66, 0.36, 0.25)  # shows where the references are
_BEHIND = 0.006  # of its distance from the camera
_UP = np.array([0.0, 0.0, 1.0])


class _Motion(NamedTuple):
    """A run in its world: placements of all that is drawn, at given instants."""

    world: WorldSettings
    description: RobotDescription
    links: Sequence[str]  # the links that are drawn
    run: RunSeries
    bag: Path

    def placements(self, instants: Numbers) -> Numbers:
        """Return supports, bricks, links, and links where every joint is at its reference."""
        robot = self._links("position", self._true_base(instants), instants)
        wanted = robot.copy()  # which hides it, where not all have a reference
        if all(series.has_reference for series in self.run.joints):
            wanted = self._links("reference", self._wanted_base(instants), instants)
        return np.concatenate([self._boxes(instants), robot, wanted], axis=1)

    def _sampled(self, instants: Numbers, stamps_ns: Stamps, rows: Numbers) -> Numbers:
        times = seconds_since(stamps_ns, self.run.start_ns)
        return np.column_stack([np.interp(instants, times, column) for column in rows.T])

    def _links(self, what: str, base: Numbers | None, instants: Numbers) -> Numbers:
        """Return the links' placements; the base is x [m], y [m] and heading [rad], (N, 3)."""
        count, still = len(instants), self.world.initial_positions
        joints = self.description.joints
        positions = {name: np.full(count, still[name]) for name in still if name in joints}
        for each in self.run.joints:
            column = getattr(each, what)[:, None]
            positions[each.joint] = self._sampled(instants, each.state_stamps_ns, column)[:, 0]
        poses = link_poses(self.description, positions, count)
        x, y, heading = np.zeros((3, count)) if base is None else base.T
        drive = self.world.base
        height = np.full(count, 0.0 if base is None or drive is None else drive.height)
        turns, origins = axis_rotations(_UP, heading), np.column_stack([x, y, height])
        found = []
        for link in self.links:
            places = origins + np.einsum("nij,nj->ni", turns, poses[link].positions)
            turned = Rotation.from_matrix(turns @ poses[link].rotations).as_quat()
            found.append(np.hstack([places, turned]))
        return np.stack(found, axis=1)

    def _true_base(self, instants: Numbers) -> Numbers | None:
        if self.world.rolling_base is None:
            return None
        truth = BagMessages(self.bag).planar(TRUTH)
        return self._sampled(instants, truth.stamps_ns, truth.poses)

    def _wanted_base(self, instants: Numbers) -> Numbers | None:
        """Return where the base would be if its wheels did as their references, without slip."""
        base, series = self.world.rolling_base, {each.joint: each for each in self.run.joints}
        if base is None or not set(base.joints) <= set(series):
            return None
        left, right = (series[wheel] for wheel in base.joints)
        paths = (np.concatenate((each.position[:1], each.reference)) for each in (left, right))
        return self._sampled(instants, left.state_stamps_ns, integrated(base, *paths)[1:])

    def _boxes(self, instants: Numbers) -> Numbers:
        place, count = self.world.workplace, len(instants)
        still = [[*box.position, *box.orientation] for box in (*place.supports, *place.bricks)]
        placements = np.tile(np.reshape(still, (-1, 7)), (count, 1, 1))
        reported = BagMessages(self.bag).poses(BRICK_POSES) if place.bricks else None
        if reported is not None:
            when = self.run.start_ns + np.round(instants * NANOSECONDS).astype(np.int64)
            at = np.searchsorted(reported.stamps_ns, when).clip(0, len(reported.stamps_ns) - 1)
            bricks = np.concatenate([reported.positions, reported.orientations], axis=2)
            placements[:, len(place.supports) :] = bricks[at]
        return placements


_HALVINGS = 50
_AIR = 1.1  # how much wider than what is in it a picture is


def framed(points: Numbers, azimuth: float, elevation: float, aspect: float) -> View:
    """Return the view from one side that holds some points, them in its middle."""
    axes = View((0.0, 0.0, 0.0), 1.0, azimuth, elevation).axes
    right, up, near = axes @ points.T
    high = math.tan(FIELD / 2.0) / _AIR
    wide = high * aspect
    eye = max(_nearest_eye(right, near, wide), _nearest_eye(up, near, high))
    depth, z = eye - near, (near.min() + near.max()) / 2.0
    tx, ty, tz = (axes.T @ (_middle(right, depth), _middle(up, depth), z)).tolist()
    return View((tx, ty, tz), float(eye - z), azimuth, elevation)


def _nearest_eye(across: Numbers, near: Numbers, slope: float) -> float:
    """Return from how near points are seen within a slope to either side, wherever across."""
    sides = (slope * near + across).max() + (slope * near - across).max()
    return float(sides / (2.0 * slope))


def _middle(across: Numbers, depth: Numbers) -> float:
    """Return where the eye sees as much of points to either side; nearer ones weigh more."""
    low, high = float(across.min()), float(across.max())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        seen = (across - middle) / depth
        low, high = (middle, high) if seen.max() > -seen.min() else (low, middle)
    return (low + high) / 2.0


_HEADER, _CHART = 0.075, 0.31  # of the height
_LABEL, _READING = 0.55, 0.45  # of the header's height
_SOFT, _PALE = "#5b6472", 0.22
_EDGE = 12  # [pixels]
_DOTS_PER_INCH = 100


class _Page:
    """Puts frames together: labels and what is read off, pictures, the chart below.

    The chart is there pale and in full; a frame shows the full one up to its instant, so that
    matplotlib draws twice for a whole animation.
    """

    def __init__(
        self,
        settings: FilmSettings,
        runs: Sequence[RunSeries],
        window: tuple[float, float],
        speed: float,
    ) -> None:
        self._size = width, height = settings.width, settings.height
        self._header, chart = round(_HEADER * height), round(_CHART * height)
        self.panel = width // len(runs), height - self._header - chart
        self._runs, self._speed = runs, speed
        self._label, self._plain = (
            ImageFont.truetype(
                findfont(FontProperties(family="DejaVu Sans", weight=weight)),
                round(share * self._header),
            )
            for weight, share in (("bold", _LABEL), ("normal", _READING))
        )
        self._draw_chart(settings.joint, (width, chart), window)

    @figure_style()
    def _draw_chart(
        self, joint: str | None, size: tuple[int, int], window: tuple[float, float]
    ) -> None:
        """Draw the error's norm over all joints, or the position of a joint, within a time."""
        lines, runs = [], self._runs
        if joint is None:
            self._symbol, self._unit = "|e|", unit_over("rad", are_slides(runs))
            title = f"error, norm over all joints [{self._unit}]; green: where the references are"
            signals = self._readings = [norm_of_run(run, error_of) for run in runs]
        else:
            for run in runs:
                if joint not in run.joint_names:
                    raise SeriesError(unknown_name("joint", joint, run.joint_names))
            series = [run.joints[run.joint_names.index(joint)] for run in runs]
            self._symbol, self._unit = "e", "m" if any(e.is_slide for e in series) else "rad"
            title = f"{joint} and its reference, grey [{self._unit}]; green: all references"
            signals = [position_of(each) for each in series]
            self._readings = [error_of(each) for each in series]
            lines.append(_within(window, NO_RUN, runs[0], reference_of(series[0])))
        lines += [_within(window, k, run, signals[k]) for k, run in enumerate(runs)]
        figure = Figure("film", "time", title, "", "", [Panel(title, lines, 0.0)])
        width, height = size
        inches = width / _DOTS_PER_INCH, height / _DOTS_PER_INCH
        drawing = Drawing(figsize=inches, dpi=_DOTS_PER_INCH)
        panel = drawing.add_axes((58 / width, 34 / height, 1.0 - 76 / width, 1.0 - 60 / height))
        draw_panel(panel, figure, figure.panels[0])
        panel.set_title(figure_text(title), fontsize=8.5, fontweight="normal", pad=5)
        panel.tick_params(labelsize=8)
        panel.set_xlabel("time [s]", fontsize=8.5, labelpad=2)
        panel.set_xlim(*window)
        self._full = _picture(drawing)
        for line in panel.lines:
            line.set_alpha(_PALE)
        self._pale = _picture(drawing)
        self._window, self._box = window, panel.get_window_extent()

    def frame(self, instant: float, pictures: Sequence[Pixels]) -> Image.Image:
        frame = Image.new("RGB", self._size, BACKGROUND)
        pen = ImageDraw.Draw(frame)
        middle = self._header // 2 + 2
        for k, (run, picture) in enumerate(zip(self._runs, pictures, strict=True)):
            left, right = k * self.panel[0], (k + 1) * self.panel[0]
            frame.paste(Image.fromarray(picture), (left, self._header))
            color, label = RUN_STYLES[k % len(RUN_STYLES)].color, shown(run.label)
            pen.text((left + _EDGE, middle), label, color, self._label, anchor="lm")
            stamps_ns, values = self._readings[k]
            if values.size:
                value = np.interp(instant, seconds_since(stamps_ns, run.start_ns), values)
                text = f"{self._symbol} = {value:.3f} {self._unit}"
                pen.text((right - _EDGE, middle), text, _SOFT, self._plain, anchor="rm")
        height, box = self._full.height, self._box
        top, (first, last) = self._size[1] - height, self._window
        column = round(box.x0 + (instant - first) / (last - first) * (box.x1 - box.x0))
        frame.paste(self._pale, (0, top))
        frame.paste(self._full.crop((0, 0, column, height)), (0, top))
        ends = [(column, top + round(height - y)) for y in (box.y1, box.y0)]
        pen.line(ends, INK, 1)
        text = f"{instant:.2f} s" + ("" if self._speed == 1.0 else f"   {self._speed:g} x")
        pen.text((self._size[0] - _EDGE, top + 4), text, INK, self._plain, anchor="ra")
        return frame


def _within(window: tuple[float, float], k: int, run: RunSeries, signal: Signal) -> Line:
    times = seconds_since(signal.stamps_ns, run.start_ns)
    kept = (times >= window[0]) & (times <= window[1])
    return Line(k, times[kept], signal.values[kept])


def _picture(drawing: Drawing) -> Image.Image:
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png", dpi=_DOTS_PER_INCH)
    return Image.open(buffer).convert("RGB")


ANIMATED = (".webp", ".gif", ".png")
STILL = (".png", ".webp", ".jpg")
_LAST_MS = 1500  # how long the last frame stands before the first comes again
_QUALITY = 72
_COARSER = (_QUALITY, 50, 25)
_LARGEST = 1_500_000  # bytes in a report
_COLORS = 128
_PALETTE_FRAMES = 6


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
    suffix, (first, *rest) = suffix.lower(), film.frames
    buffer = io.BytesIO()
    if not rest:
        first.save(buffer, "JPEG" if suffix == ".jpg" else suffix[1:], quality=quality)
        return buffer.getvalue()
    how: dict[str, Any] = {"quality": quality, "method": 4} if suffix == ".webp" else {}
    if suffix == ".gif":
        (first, *rest), how = _few_colors(film.frames), {"optimize": False}
    times = [film.period_ms] * len(rest) + [_LAST_MS]
    first.save(
        buffer, suffix[1:], save_all=True, append_images=rest, duration=times, loop=0, **how
    )
    return buffer.getvalue()


def for_report(film: Film) -> bytes:
    """Return an animation as WebP, coarser if it is large: a page is to stay light."""
    for quality in _COARSER:
        content = encoded(film, ".webp", quality)
        if len(content) <= _LARGEST:
            break
    return content


def _few_colors(frames: Sequence[Image.Image]) -> list[Image.Image]:
    """Return frames that share one palette, so that what does not move does not change."""
    some = frames[:: max(1, len(frames) // _PALETTE_FRAMES)]
    width, height = frames[0].size
    together = Image.new("RGB", (width, height * len(some)))
    for k, frame in enumerate(some):
        together.paste(frame, (0, k * height))
    palette = together.quantize(_COLORS, Image.Quantize.MEDIANCUT)
    return [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
