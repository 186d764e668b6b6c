"""An animation of runs: the robot under each controller, side by side, above what is judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from hpid_ros.base.arrays import Numbers
from hpid_ros.base.errors import SettingError
from hpid_ros.recordings.series import RunSeries
from hpid_ros.rendering.motion import Stand, motion_of
from hpid_ros.rendering.page import Page, PageSize
from hpid_ros.rendering.studio import Studio
from hpid_ros.report.figures.film import film_chart
from hpid_ros.robot.description import RobotDescription
from hpid_ros.robot.shapes import drawn_shapes
from hpid_ros.simulation.settings import WorldSettings, default_engine, require_engine
from hpid_ros.simulation.stage.stage import MESHES

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
