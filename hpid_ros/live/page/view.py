"""One page in a browser: what it is composed of, and how its parts hear of each other."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from datetime import datetime

from nicegui import ui

from hpid_ros.live.page.joints import JointTable
from hpid_ros.live.page.panel import TuningPanel
from hpid_ros.live.session import LiveSession
from hpid_ros.live.trials import Stage, Trials

_REFRESH_PERIOD = 0.3  # [s]
_HELD_REFRESH_PERIOD = 1.0  # [s]: a browser that renders all the time does not hear a button
_WINDOWS = (2, 5, 10, 20, 60)  # [s]

_HEAD = """
<link rel="stylesheet" href="/assets/live.css">
<script type="module" src="/assets/live.js"></script>
"""
_LOST = (
    "Connection lost. The robot goes on as it was told last, and this page cannot stop it: "
    "use the emergency stop of the robot."
)


class PageView:
    """Builds one page, within the client that it is for."""

    def __init__(self, session: LiveSession, trials: Trials) -> None:
        self._session, self._trials = session, trials
        self._client = ui.context.client
        self._page = self._client.id
        self._dark = ui.dark_mode(None)
        self._logged = 0
        self._refreshed_at = float("-inf")
        self._table: JointTable
        self._panel: TuningPanel
        ui.echart({}).style("display: none")  # brings the chart library onto the page
        ui.add_head_html(_HEAD)
        self._build()
        ui.timer(_REFRESH_PERIOD, self._refresh_in_time)
        begin = f"window.hpidLive.start({json.dumps(self._page)})"
        script = f"""
            if (window.hpidLive) {begin};
            else window.addEventListener("hpid-live", () => {begin}, {{ once: true }});
        """
        self._client.on_connect(lambda: ui.run_javascript(script))

    @property
    def _may_edit(self) -> bool:
        return self._session.desk.holds(self._page)

    def _build(self) -> None:
        with ui.element("div").classes("banner lost-banner").props('role="alert"'):
            ui.label(_LOST)
        with ui.element("div").classes("banner stop-banner").props('role="alert"'):
            ui.label("Not every controller could be stopped: use the robot's emergency stop.")
        with ui.header().classes("top"):
            self._build_header()
        with ui.element("main").classes("page"):
            with ui.element("section").classes("left"):
                self._build_joints()
                self._build_charts()
                self._log = (
                    ui.element("ul")
                    .classes("log")
                    .props('aria-live="polite" aria-label="what happened"')
                )
            with ui.element("section").classes("right"):
                self._panel = TuningPanel(
                    self._session, self._trials, self._page, lambda: self._table.chosen
                )

    def _build_header(self) -> None:
        ui.label("hpid live").classes("title")
        self._desk = ui.label().classes("desk")
        self._take = ui.button("Take control", on_click=self._take_desk)
        self._take.props("outline dense no-caps")
        ui.space()
        ui.button(icon="contrast", on_click=self._toggle_dark).props(
            'flat dense aria-label="light or dark"'
        )
        stop = (
            ui.button("Stop (Esc)")
            .classes("stop")
            .props(
                'data-act="stop" color="negative" no-caps '
                'aria-label="Stop: deactivate every controller (Escape)"'
            )
        )
        stop.on("click", js_handler="() => window.hpidLive.stop()")

    def _build_joints(self) -> None:
        with ui.element("div").classes("bar"):
            ui.label("Joints").classes("heading")
            ui.button("all", on_click=lambda: self._table.choose(is_all=True)).props(
                'flat dense no-caps size=sm aria-label="choose all joints"'
            )
            ui.button("none", on_click=lambda: self._table.choose(is_all=False)).props(
                'flat dense no-caps size=sm aria-label="choose no joint"'
            )
            ui.space()
            self._window = ui.select(
                {each: f"{each} s" for each in _WINDOWS}, value=10, on_change=self._show
            ).props('dense options-dense outlined aria-label="length of the window"')
            self._paused = ui.checkbox(
                "freeze plots",
                on_change=lambda event: ui.run_javascript(
                    f"window.hpidLive.pause({json.dumps(event.value)})"
                ),
            ).props("dense size=sm")
        self._table = JointTable(
            self._session, self._show, lambda: float(self._window.value or 10.0)
        )

    def _build_charts(self) -> None:
        names = {
            "position": "position and reference",
            "error": "error",
            "effort": "effort",
            "multiplier": "multiplier and norm",
        }
        with ui.element("div").classes("charts"):
            for name, text in names.items():
                ui.element("div").classes("chart").props(
                    f'data-chart="{name}" role="img" aria-label="{text} over time"'
                )

    def _take_desk(self) -> None:
        self._session.desk.take(self._page)
        self._refresh()

    def _toggle_dark(self) -> None:
        self._dark.value = not self._dark.value

    def _show(self) -> None:
        seen = self._session.controllers
        colours = self._table.colours
        shown = [
            {
                "node": node,
                "label": self._session.label(node),
                "colour": colours[node],
                "position": "m" if seen[node].limits.is_slide else "rad",
                "effort": "N" if seen[node].limits.is_slide else "N m",
            }
            for node in self._table.chosen
        ]
        self._paused.value = False
        ui.run_javascript(
            f"window.hpidLive?.show({json.dumps(shown)}, {float(self._window.value or 10)})"
        )
        self._panel.changed()

    def _refresh_in_time(self) -> None:
        is_moving = self._trials.stage is Stage.MOVING
        if not is_moving or time.monotonic() - self._refreshed_at >= _HELD_REFRESH_PERIOD:
            self._refresh()

    def _refresh(self) -> None:
        self._refreshed_at = time.monotonic()
        desk = self._session.desk
        if self._may_edit:
            others = f", {desk.pages - 1} more look on" if desk.pages > 1 else ""
            self._desk.set_text(f"you have control{others}")
        elif desk.holder is None:
            self._desk.set_text("nobody has control")
        else:
            self._desk.set_text("another page has control: this one looks on")
        self._take.set_visibility(not self._may_edit)
        self._table.refresh()
        self._panel.refresh()
        self._refresh_log()

    def _refresh_log(self) -> None:
        lines = list(self._session.log)
        total = self._session.said
        fresh = lines[max(len(lines) - (total - self._logged), 0) :]
        self._logged = total
        for line in fresh:
            with self._log:
                at = datetime.fromtimestamp(line.at).strftime("%H:%M:%S")
                item = ui.element("li").classes("is-bad" if line.is_bad else "")
                with item:
                    ui.label(f"{at}  {line.text}")
                item.move(self._log, 0)
        extra: Sequence[ui.element] = list(self._log)[60:]
        for item in extra:
            item.delete()
