"""The controllers that are found: which are chosen, and how they do."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from nicegui import ui

from hpid_ros.live.graph import SILENT_AFTER
from hpid_ros.live.history import RisingCount
from hpid_ros.live.session import LiveSession

_MISSED_LATELY = 10.0  # [s]
_COLUMNS = ("", "joint", "state", "mean |e|", "largest |e|", "IVC/s", "rms u", "missed", "")
_LEVELS = ("ok", "warning", "error", "error")

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
        self, session: LiveSession, select: Callable[[], None], window: Callable[[], float]
    ) -> None:
        self._session, self._select, self._window = session, select, window
        self._rows: dict[str, _Row] = {}
        self._table = ui.element("table").classes("joints")
        self._empty = ui.label(
            "No joint controller is found yet. They appear by themselves: "
            "ros2 launch hpid_ros robot.launch.py, or your own."
        ).classes("hint")
        with self._table, ui.element("thead"), ui.element("tr"):
            for name in _COLUMNS:
                with ui.element("th").props('scope="col"'):
                    label = ui.label(name)
                    if name in _TIPS:
                        label.tooltip(_TIPS[name])
        with self._table:
            self._body = ui.element("tbody")

    @property
    def chosen(self) -> list[str]:
        """Nodes that are chosen and here, in order."""
        return [node for node, row in self._rows.items() if row.is_chosen]

    @property
    def colours(self) -> dict[str, int]:
        """Number of each node's colour."""
        return {node: number for number, node in enumerate(self._rows)}

    def refresh(self) -> None:
        """Show what is known now."""
        seen = self._session.controllers
        for node in seen:
            if node not in self._rows:
                with self._body:
                    self._rows[node] = _Row(
                        self._session, node, len(self._rows), self._select, self._choose_alone
                    )
                if len(self._rows) == 1:
                    self._select()
        self._empty.set_visibility(not seen)
        self._table.set_visibility(bool(seen))
        for row in self._rows.values():
            row.refresh(self._window())

    def choose(self, *, is_all: bool) -> None:
        """Choose all controllers, or none."""
        for row in self._rows.values():
            row.box.value = is_all

    def _choose_alone(self, node: str) -> None:
        for each, row in self._rows.items():
            row.box.value = each == node


class _Row:
    def __init__(
        self,
        session: LiveSession,
        node: str,
        number: int,
        select: Callable[[], None],
        choose_alone: Callable[[str], None],
    ) -> None:
        self._session, self._node = session, node
        name = session.label(node)
        with ui.element("tr") as self._row:
            with ui.element("td"):
                self.box = ui.checkbox(value=number == 0, on_change=lambda: select())
                self.box.props(f'dense size="sm" aria-label="choose {name}"')
            with ui.element("td").classes("joint-name"):
                ui.element("span").classes(f"swatch colour-{number % 8}")
                label = ui.label(name).tooltip(f"{node}; a click chooses it alone")
                label.on("click", lambda: choose_alone(node))
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
                self._switch = ui.button(on_click=self._transit).props(
                    "flat dense no-caps size=sm"
                )

    @property
    def is_chosen(self) -> bool:
        return bool(self.box.value) and self._session.controllers[self._node].is_here

    def refresh(self, window: float) -> None:
        seen = self._session.controllers[self._node]
        state, level, tip = _state(seen)
        self._state.set_text(state)
        self._state.classes(replace=f"state is-{level}")
        self._tip.set_text(tip)
        self._row.classes(
            add="" if seen.is_here else "is-gone", remove="is-gone" if seen.is_here else ""
        )
        found = self._session.indices(self._node, window)
        missed = seen.health.values.get("missed samples", "") if seen.health else ""
        if missed.isdecimal():
            rises = self._missed.tell(int(missed), time.monotonic())
            self._figures[-1].classes(replace="is-bad" if rises else "")
        texts = [_figure(each) for each in (found.itae_rate, found.error, found.ivc_rate)]
        for label, text in zip(
            self._figures, [*texts, _figure(found.effort), missed], strict=True
        ):
            label.set_text(text)
        is_active = seen.lifecycle == "active"
        act = "deactivate" if is_active else "activate"
        self._switch.set_text(act)
        self._switch.props(f'aria-label="{act} {self._session.label(self._node)}"')
        self._switch.set_enabled(seen.is_here and seen.lifecycle in ("active", "inactive"))

    async def _transit(self) -> None:
        if not self._session.desk.holds(ui.context.client.id):
            ui.notify("this page looks on: take control first", type="warning")
            return
        seen = self._session.controllers[self._node]
        transition = "deactivate" if seen.lifecycle == "active" else "activate"
        await self._session.transit([self._node], transition)


def _state(seen: object) -> tuple[str, str, str]:
    """Return a controller's state in a word or two, how bad that is, and more about it."""
    health, lifecycle = seen.health, seen.lifecycle  # type: ignore[attr-defined]
    if not seen.is_here:  # type: ignore[attr-defined]
        return "gone", "error", "its process has ended, or is out of reach"
    if lifecycle and lifecycle != "active":
        return lifecycle, "warning", "it controls nothing"
    if health is None:
        return lifecycle or "found", "ok", "it has said nothing on /diagnostics yet"
    if time.monotonic() - health.heard_at > SILENT_AFTER:
        return "silent", "error", f"nothing on /diagnostics for {SILENT_AFTER:g} s"
    return lifecycle or "active", _LEVELS[min(health.level, 3)], health.message


def _figure(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""
