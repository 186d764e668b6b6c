"""One page in a browser: what it is composed of, and how its parts hear of each other."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from datetime import datetime
from functools import partial

from nicegui import ui

from hpid_bench.live.history import JointHistory, RisingCount
from hpid_bench.live.known_controllers import SILENT_AFTER, RunningController
from hpid_bench.live.page.panel import TuningPanel
from hpid_bench.live.page.parts import COLOURS, Viewer, button, labelled, mark, table
from hpid_bench.live.session import LiveSession
from hpid_bench.live.trials import Trials, TrialStage

_MISSED_LATELY = 10.0  # [s]
_COLUMNS = ("", "joint", "state", "mean |e|", "largest |e|", "IVC/s", "rms u", "missed", "")
_LEVELS = ("ok", "warning", "error", "error")
_FAR, _FAR_SLIDE = 0.1, 0.02  # [rad, m] from the reference, that is not shown green

_TIPS = {
    "mean |e|": "ITAE over the window, as a mean error: late errors weigh more",
    "largest |e|": "largest absolute error in the window",
    "IVC/s": "variation of the effort per second",
    "rms u": "root mean square of the effort",
    "missed": "states that the controller has missed since its start; coloured where the last "
    "10 s added some",
}


class JointTable:
    """A row for every controller."""

    def __init__(
        self, viewer: Viewer, select: Callable[[], None], window: Callable[[], float]
    ) -> None:
        self._viewer, self._select, self._window = viewer, select, window
        self._rows: dict[str, _Row] = {}
        self._table, self._body = table(_COLUMNS, _TIPS)
        self._empty = ui.label(
            "No joint controller is found yet. They appear by themselves: "
            "ros2 launch hpid_ros robot.launch.py, or your own."
        ).classes("hint")

    @property
    def ticked(self) -> list[str]:
        """Nodes that are chosen, in order; one that has gone may come back."""
        return [node for node, row in self._rows.items() if row.box.value]

    @property
    def chosen(self) -> list[str]:
        """Nodes that are chosen and here, in order."""
        seen = self._viewer.session.controllers
        return [node for node in self.ticked if seen[node].is_here]

    @property
    def colours(self) -> dict[str, str]:
        return {node: row.colour for node, row in self._rows.items()}

    def refresh(self) -> None:
        seen = self._viewer.session.tuning.in_force
        for node in seen:
            if node not in self._rows:
                with self._body:
                    self._rows[node] = row = _Row(self._viewer, node, len(self._rows))
                row.box.on_value_change(self._select)
                row.name.on("click", partial(self._choose_alone, node))
                if len(self._rows) == 1:
                    self._select()
        self._empty.set_visibility(not seen)
        self._table.set_visibility(bool(seen))
        for row in self._rows.values():
            row.refresh(self._window())

    def choose(self, *, is_all: bool) -> None:
        for row in self._rows.values():
            row.box.value = is_all

    def _choose_alone(self, node: str) -> None:
        for each, row in self._rows.items():
            row.box.value = each == node


class _Row:
    def __init__(self, viewer: Viewer, node: str, number: int) -> None:
        self._viewer, self._session, self._node = viewer, viewer.session, node
        self.colour = COLOURS[number % len(COLOURS)]
        name = self._session.label(node)
        with ui.element("tr") as self._row:
            with ui.element("td"):
                self.box = ui.checkbox(value=number == 0)
                labelled(self.box.props("dense size=sm"), f"choose {name}")
            with ui.element("td").classes("joint-name"):
                ui.element("span").classes("swatch").style(f"background: {self.colour}")
                self.name = ui.label(name).tooltip(f"{node}; a click chooses it alone")
            with ui.element("td"):
                self._state = ui.label().classes("state")
                with self._state:
                    self._tip = ui.tooltip("")
            self._figures = []
            self._missed = RisingCount(_MISSED_LATELY)
            for _ in range(5):
                with ui.element("td").classes("figure"):
                    self._figures.append(ui.label())
            with ui.element("td"):
                self._switch = button("", self._transit, "flat dense size=sm")

    def refresh(self, window: float) -> None:
        seen = self._session.controllers[self._node]
        history = self._session.history(self._node)
        state, level, tip = _state(seen, history)
        self._state.set_text(state)
        self._state.classes(replace=f"state is-{level}")
        self._tip.set_text(tip)
        mark(self._row, "is-gone", is_on=not seen.is_here)
        found = history.indices(window)
        missed = seen.health.values.get("missed samples", "") if seen.health else ""
        if missed.isdecimal():
            rises = self._missed.tell(int(missed), time.monotonic())
            self._figures[-1].classes(replace="is-bad" if rises else "")
        figures = (found.itae_rate, found.error, found.ivc_rate, found.effort)
        for label, text in zip(self._figures, [*map(_figure, figures), missed], strict=True):
            label.set_text(text)
        is_active = seen.lifecycle == "active"
        act = "deactivate" if is_active else "activate"
        self._switch.set_text(act)
        labelled(self._switch, f"{act} {self._session.label(self._node)}")
        self._switch.set_enabled(seen.is_here and seen.lifecycle in ("active", "inactive"))

    async def _transit(self) -> None:
        if not self._viewer.may_edit:
            ui.notify("this page looks on: take control first", type="warning")
            return
        seen = self._session.controllers[self._node]
        transition = "deactivate" if seen.lifecycle == "active" else "activate"
        await self._session.transit([self._node], transition)


def _state(seen: RunningController, history: JointHistory) -> tuple[str, str, str]:
    """Return a controller's state in a word or two, how bad that is, and more about it."""
    health, lifecycle = seen.health, seen.lifecycle
    if not seen.is_here:
        return "gone", "error", "its process has ended, or is out of reach"
    if lifecycle and lifecycle != "active":
        return lifecycle, "warning", "it controls nothing"
    if health is None:
        return lifecycle or "found", "ok", "it has said nothing on /diagnostics yet"
    if time.monotonic() - health.heard_at > SILENT_AFTER:
        return "silent", "error", f"nothing on /diagnostics for {SILENT_AFTER:g} s"
    level = _LEVELS[min(health.level, 3)]
    if level != "ok":
        return lifecycle or "active", level, health.message
    unit, far = ("m", _FAR_SLIDE) if seen.limits.is_slide else ("rad", _FAR)
    if history.is_saturated:
        return "saturated", "warning", f"its effort is at a limit; {health.message}"
    if history.distance > far:
        tip = f"{history.distance:.3g} {unit} from its reference; {health.message}"
        return "far off", "warning", tip
    return lifecycle or "active", level, health.message


def _figure(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""


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
        client = ui.context.client
        self._viewer = Viewer(session, trials, client.id, lambda: self._table.chosen)
        self._logged = 0
        self._refreshed_at = float("-inf")
        self._table: JointTable
        self._panel: TuningPanel
        ui.echart({}).style("display: none")  # brings the chart library onto the page
        ui.add_head_html(_HEAD)
        self._build()
        ui.timer(_REFRESH_PERIOD, self._refresh_in_time)
        begin = f"window.hpidLive.start({json.dumps(client.id)})"
        script = f"""
            if (window.hpidLive) {begin};
            else window.addEventListener("hpid-live", () => {begin}, {{ once: true }});
        """
        client.on_connect(lambda: ui.run_javascript(script))

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
                self._panel = TuningPanel(self._viewer)

    def _build_header(self) -> None:
        dark = ui.dark_mode(None)
        ui.label("hpid live").classes("title")
        self._control_lock = ui.label().classes("desk")
        self._take = button("Take control", self._take_control, "outline dense")
        ui.space()
        ui.button(icon="contrast", on_click=lambda: dark.set_value(not dark.value)).props(
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
            for text, label, is_all in (("all", "all joints", True), ("none", "no joint", False)):
                act = partial(self._choose, is_all)
                labelled(button(text, act, "flat dense size=sm"), f"choose {label}")
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
        window = self._window
        self._table = JointTable(self._viewer, self._show, lambda: float(window.value or 10.0))

    def _choose(self, is_all: bool) -> None:
        self._table.choose(is_all=is_all)

    def _build_charts(self) -> None:
        names = {
            "position": "position and reference",
            "error": "error",
            "effort": "effort",
            "multiplier": "multiplier and norm",
        }
        with ui.element("div").classes("charts"):
            for name, text in names.items():
                place = ui.element("div").classes("chart").props("role=img")
                place.props["data-chart"] = name
                labelled(place, f"{text} over time")

    def _take_control(self) -> None:
        self._session.take_control(self._viewer.page)
        self._refresh()

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
            for node in self._table.ticked
        ]
        self._paused.value = False
        ui.run_javascript(
            f"window.hpidLive?.show({json.dumps(shown)}, {float(self._window.value or 10)})"
        )
        self._panel.refresh()

    def _refresh_in_time(self) -> None:
        is_moving = self._trials.stage is TrialStage.MOVING
        if not is_moving or time.monotonic() - self._refreshed_at >= _HELD_REFRESH_PERIOD:
            self._refresh()

    def _refresh(self) -> None:
        self._refreshed_at = time.monotonic()
        control_lock = self._session.control_lock
        if self._viewer.may_edit:
            others = f", {control_lock.pages - 1} more look on" if control_lock.pages > 1 else ""
            self._control_lock.set_text(f"you have control ({self._viewer.name}){others}")
        elif control_lock.holder is None:
            self._control_lock.set_text("nobody has control")
        else:
            name = control_lock.name(control_lock.holder)
            self._control_lock.set_text(f"{name} has control: this one looks on")
        self._take.set_visibility(not self._viewer.may_edit)
        self._table.refresh()
        self._panel.refresh()
        self._refresh_log()

    def _refresh_log(self) -> None:
        lines, fresh = list(self._session.log), self._session.said - self._logged
        self._logged = self._session.said
        for line in lines[max(len(lines) - fresh, 0) :]:
            with self._log, ui.element("li").classes("is-bad" if line.is_bad else "") as item:
                ui.label(f"{datetime.fromtimestamp(line.at):%H:%M:%S}  {line.text}")
            item.move(self._log, 0)
        for item in list(self._log)[60:]:
            item.delete()
