"""A frame of an animation: labels above the pictures of the runs, the chart below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hpid_ros.base.foreign_text import shown
from hpid_ros.recordings.series import RunSeries, seconds_since
from hpid_ros.report.figures.film import FilmChart, font_file, run_color
from hpid_ros.report.figures.style import INK, PAPER
from hpid_ros.simulation.stage.stage import Pixels

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
