"""What the panels of a page share: whose page it is, how a curve is drawn, small elements."""

from __future__ import annotations

import inspect
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any

from nicegui import ui

from hpid_bench.live.session import LiveSession
from hpid_bench.live.trials import Trials
from hpid_ros.base.errors import HpidError

CHART_INK = "#7d8791"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#7570b3")
"""Those of Okabe and Ito first: people who see red and green alike tell them apart."""


@dataclass(frozen=True)
class Viewer:
    """One open page: which joints are chosen on it, and whether its person has control."""

    session: LiveSession
    trials: Trials
    page: str  # id of its client
    chosen: Callable[[], list[str]]  # returns the nodes of the joints that are chosen

    @property
    def may_edit(self) -> bool:
        return self.session.control_lock.holder == self.page

    @property
    def name(self) -> str:
        """What others call this page."""
        return self.session.control_lock.name(self.page)

    def stage(self, name: str, value: Any, *, is_factor: bool = False) -> None:
        """Choose a value, or times what is active, for the joints that are chosen."""
        if not self.may_edit:
            return
        tuning = self.session.tuning
        try:
            (tuning.stage_factor if is_factor else tuning.stage)(self.chosen(), name, value)
        except HpidError as error:
            ui.notify(str(error), type="negative")

    def acting(self, act: Callable[[], object], then: Callable[[], None]) -> Callable[[], Any]:
        """Return a handler that does something, and then something else, with control alone."""

        async def handle() -> None:
            if self.may_edit:
                done = act()
                if inspect.isawaitable(done):
                    await done
                then()

        return handle


def button(text: str, act: Callable[..., Awaitable[None] | None], look: str = "flat") -> Any:
    return ui.button(text, on_click=act).props("no-caps").props(look)


def labelled(element: Any, label: str) -> Any:
    """Give an element the name that screen readers say, and return it.

    As data: ``props()`` parses a text, in which the name of a joint could set any property, and
    NiceGUI runs the value of one that begins with a colon as JavaScript.
    """
    if element.props.get("aria-label") != label:
        element.props["aria-label"] = label
    return element


def mark(element: Any, name: str, *, is_on: bool) -> None:
    """Give an element a class, or take it."""
    element.classes(add=name if is_on else "", remove="" if is_on else name)


def table(heads: Sequence[str], tips: dict[str, str]) -> tuple[Any, Any]:
    with ui.element("table").classes("joints") as made:
        with ui.element("thead"), ui.element("tr"):
            for text in heads:
                with ui.element("th").props('scope="col"'):
                    label = ui.label(text)
                    if text in tips:
                        label.tooltip(tips[text])
        body = ui.element("tbody")
    return made, body


def chart(label: str, kind: str) -> Any:
    return labelled(ui.echart(chart_options([])).classes(kind).props("role=img"), label)


def chart_options(
    series: Sequence[dict[str, Any]], top: int = 30, end: float | str = "dataMax", **legend: Any
) -> dict[str, Any]:
    """Return what ECharts draws: curves over time in [s]."""
    soft = {"lineStyle": {"color": "#80808050"}}
    axis = {"type": "value", "axisLabel": {"color": CHART_INK}, "splitLine": soft}
    return {
        "animation": False,
        "legend": {"top": 0, "left": 0, "textStyle": {"color": CHART_INK}, **legend},
        "grid": {"left": 52, "right": 24, "top": top, "bottom": 24},
        "xAxis": {**axis, "max": end, "axisLabel": {"color": CHART_INK, "formatter": "{value} s"}},
        "yAxis": {**axis, "scale": True, "splitNumber": 3},
        "series": list(series),
    }


def curve(name: str, points: Sequence[Sequence[float]], colour: str) -> dict[str, Any]:
    return {
        "name": name,
        "type": "line",
        "data": points,
        "showSymbol": False,
        "symbol": "none",
        "lineStyle": {"width": 2, "color": colour},
        "itemStyle": {"color": colour},
    }
