"""The right side of the page: parameters that are staged and applied, tests, snapshots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from nicegui import ui

from hpid_ros.base.errors import HpidError
from hpid_ros.live.advice import Advice
from hpid_ros.live.page.knobs import AllParameters, Knob
from hpid_ros.live.page.trial_panel import TrialPanel
from hpid_ros.live.session import LiveSession
from hpid_ros.live.trials import Trials
from hpid_ros.live.tuning import BANDWIDTH, SLIDERS

_LARGEST_FILE = 1_000_000  # bytes


class SnapshotPanel:
    """Keeps what is active, goes back to it, writes and reads parameter files."""

    def __init__(
        self,
        session: LiveSession,
        chosen: Callable[[], list[str]],
        may_edit: Callable[[], bool],
    ) -> None:
        self._session, self._chosen, self._may_edit = session, chosen, may_edit
        self._shown: tuple[str, ...] | None = None
        ui.label("Snapshots").classes("heading")
        with ui.element("div").classes("bar"):
            self._name = ui.input(placeholder="name").props(
                'dense outlined aria-label="name of the snapshot"'
            )
            self._name.on("keydown.enter", self._on_keep)
            self._keep = ui.button("Keep what is in force", on_click=self._on_keep)
            self._keep.props("no-caps unelevated")
        self._list = ui.element("ul").classes("snapshots")
        ui.label("Parameter file").classes("heading")
        with ui.element("div").classes("bar"):
            ui.button("Save controllers.yaml", on_click=self._on_save).props("no-caps flat")
            self._upload = ui.upload(
                label="Load: choose a file, it is staged",
                auto_upload=True,
                max_file_size=_LARGEST_FILE,
                on_upload=self._on_load,
                on_rejected=lambda: ui.notify("at most 1 MB", type="negative"),
            ).props('flat bordered accept=".yaml,.yml" aria-label="load a parameter file"')

    def refresh(self) -> None:
        """Show the snapshots that there are."""
        self._keep.set_enabled(self._may_edit())
        self._upload.set_enabled(self._may_edit())
        names = tuple(self._session.tuning.snapshots)
        if names == self._shown:
            return
        self._shown = names
        self._list.clear()
        with self._list:
            for name in names:
                kept = self._session.tuning.snapshots[name]
                with ui.element("li"):
                    ui.label(f"{name} ({len(kept.values)} joints)")
                    ui.button(
                        "go back to it", on_click=lambda name=name: self._on_restore(name)
                    ).props("no-caps flat dense size=sm")

    def _on_keep(self) -> None:
        if not self._may_edit():
            return
        nodes = [node for node, each in self._session.controllers.items() if each.is_here]
        try:
            kept = self._session.tuning.keep(self._name.value or "", nodes)
        except HpidError as error:
            ui.notify(str(error), type="negative")
            return
        self._session.say(f"snapshot {kept.name} of {len(nodes)} joints")
        self._name.value = ""
        self.refresh()

    async def _on_restore(self, name: str) -> None:
        if self._may_edit():
            await self._session.restore(name)

    def _on_save(self) -> None:
        ui.download.content(self._session.document(), "controllers.yaml", "text/yaml")

    async def _on_load(self, event: Any) -> None:
        if not self._may_edit():
            return
        self._upload.reset()
        try:
            text = await event.file.text()
            self._session.load(text, event.file.name)
        except UnicodeDecodeError:
            self._session.say(f"{event.file.name} is no text", is_bad=True)
        except HpidError as error:
            self._session.say(str(error), is_bad=True)


_STEP = 0.1  # [rad], of the response that is shown


class TuningPanel:
    """Parameters of the joints that are chosen."""

    def __init__(
        self, session: LiveSession, trials: Trials, page: str, chosen: Callable[[], list[str]]
    ) -> None:
        self._session, self._page, self._chosen = session, page, chosen
        with ui.tabs().props("dense no-caps align=left") as tabs:
            tune, test, keep = ui.tab("Tune"), ui.tab("Try"), ui.tab("Save")
        with ui.tab_panels(tabs, value=tune).classes("panels"):
            with ui.tab_panel(tune):
                self._build_tune()
            with ui.tab_panel(test):
                self._trial = TrialPanel(session, trials, page, chosen)
            with ui.tab_panel(keep):
                self._snapshots = SnapshotPanel(session, chosen, lambda: self._may_edit)

    @property
    def _may_edit(self) -> bool:
        return self._session.control_lock.holds(self._page)

    def _build_tune(self) -> None:
        self._of = ui.label().classes("heading")
        self._law = ui.toggle({"pid": "PID", "hpid": "hPID"}, on_change=self._on_law).props(
            'dense no-caps aria-label="law"'
        )
        self._knobs = [
            Knob(self._session, name, self._chosen, lambda: self._may_edit, self.changed)
            for name in (BANDWIDTH, *SLIDERS)
        ]
        self._certified = ui.label().classes("advice").props('aria-live="polite"')
        self._margins = ui.label().classes("advice")
        self._objection = ui.label().classes("objection").props('role="alert"')
        with ui.element("div").classes("bar actions"):
            self._apply = ui.button("Apply", on_click=self._on_apply).props(
                'data-act="apply" no-caps unelevated color="primary" '
                'aria-keyshortcuts="Control+Enter"'
            )
            self._apply.tooltip("Ctrl+Enter")
            self._discard = ui.button("Discard", on_click=self._on_discard).props("no-caps flat")
            ui.space()
            self._undo = ui.button("Undo", on_click=self._on_undo).props(
                'data-act="undo" no-caps flat aria-keyshortcuts="Control+Z"'
            )
            self._revert = ui.button("Back to start", on_click=self._on_revert).props(
                "no-caps flat"
            )
        self._staged = ui.label().classes("staged")
        self._response_of = ui.label().classes("hint")
        self._response = (
            ui.echart(_response_options())
            .classes("response")
            .props('role="img" aria-label="response to a step, in force and as chosen"')
        )
        self._shown: Any = None
        self._all = AllParameters(
            self._session, self._chosen, lambda: self._may_edit, self.changed
        )

    # What is shown

    def changed(self) -> None:
        """Show what follows from another choice."""
        self.refresh()

    def refresh(self) -> None:
        """Show what is known now."""
        nodes = self._chosen()
        self._of.set_text(self._title(nodes))
        for knob in self._knobs:
            knob.refresh()
        self._refresh_law(nodes)
        self._refresh_advice(nodes)
        self._refresh_actions(nodes)
        self._all.refresh()
        self._snapshots.refresh()
        self._trial.refresh()

    def _title(self, nodes: Sequence[str]) -> str:
        if not nodes:
            return "choose a joint"
        if len(nodes) == 1:
            return self._session.label(nodes[0])
        return f"{len(nodes)} joints: gains are factors, all else is one value"

    def _refresh_law(self, nodes: Sequence[str]) -> None:
        self._law.set_enabled(bool(nodes) and self._may_edit)
        laws = {self._session.tuning.value(node, "law") for node in nodes}
        value = laws.pop() if len(laws) == 1 else None
        if self._law.value != value:
            self._is_setting = True
            self._law.value = value
            self._is_setting = False

    _is_setting = False

    def _on_law(self, event: Any) -> None:
        if not self._is_setting and event.value is not None and self._may_edit:
            self._session.tuning.stage(self._chosen(), "law", event.value)
            self.changed()

    def _refresh_advice(self, nodes: Sequence[str]) -> None:
        mu = next(knob for knob in self._knobs if knob.name == "mu")
        if not nodes:
            mu.show_interval(None, is_current=True)
            self._certified.set_text("")
            self._margins.set_text("")
            return
        found = [self._session.advice(node, _STEP, is_staged=True) for node in nodes]
        is_current = all(each for _, each in found)
        known = [advice for advice, _ in found if advice is not None]
        joint = _joint_advice(known) if len(known) == len(nodes) else None
        is_known = is_current and joint is not None and not joint.is_pending
        mu.show_interval(joint if is_known else None, is_current=is_known)
        degrees = [float(self._session.tuning.value(node, "mu")) for node in nodes]
        text, is_bad = _certificate_text(joint, degrees, is_current=is_current)
        self._certified.set_text(text)
        self._certified.classes(replace="advice is-bad" if is_bad else "advice")
        self._margins.set_text(_margins_text(joint))
        self._refresh_response(nodes)

    def _refresh_response(self, nodes: Sequence[str]) -> None:
        before, _ = self._session.advice(nodes[0], _STEP, is_staged=False)
        after, _ = self._session.advice(nodes[0], _STEP, is_staged=True)
        shown = (nodes[0], before, after)
        if shown == self._shown:
            return
        self._shown = shown
        self._response_of.set_text(
            f"{self._session.label(nodes[0])}: response of its inertia alone to a step of "
            f"{_STEP:g}, in percent"
        )
        self._response.options.update(_response_options(before, after))
        self._response.update()

    def _refresh_actions(self, nodes: Sequence[str]) -> None:
        tuning, may = self._session.tuning, self._may_edit
        staged = tuning.staged_sets(list(tuning.staged))
        objections = [
            f"{self._session.label(node)}: {line}"
            for node in staged
            if (line := tuning.objection(node))
        ]
        self._objection.set_text(objections[0] if objections else "")
        self._apply.set_enabled(may and bool(staged) and not objections)
        self._discard.set_enabled(may and bool(staged))
        self._undo.set_enabled(may and bool(tuning.done))
        self._revert.set_enabled(may and bool(tuning.reverting(nodes)))
        self._staged.set_text(self._staged_text(staged))

    def _staged_text(self, staged: dict[str, Any]) -> str:
        if not staged:
            return ""
        parts = []
        for node, values in staged.items():
            pairs = (f"{name} {_shown(value)}" for name, value in values.items())
            parts.append(f"{self._session.label(node)}: {', '.join(pairs)}")
        return "chosen, not sent: " + "; ".join(parts)

    # What a person does

    async def _on_apply(self) -> None:
        if self._may_edit:
            await self._session.apply(list(self._session.tuning.staged))
            self.changed()

    def _on_discard(self) -> None:
        if self._may_edit:
            self._session.tuning.unstage()
            self.changed()

    async def _on_undo(self) -> None:
        if self._may_edit:
            await self._session.undo()
            self.changed()

    async def _on_revert(self) -> None:
        if self._may_edit:
            await self._session.revert(self._chosen())
            self.changed()


def _joint_advice(known: Sequence[Advice]) -> Advice:
    """Return what holds for all of several joints: the narrowest interval, the least margins."""
    without = [each for each in known if each.interval is None]
    if without or not known:
        pending = [each for each in without if each.is_pending]
        return (pending or without or [Advice()])[0]
    intervals = [each.interval for each in known if each.interval is not None]
    return Advice(
        (max(low for low, _ in intervals), min(high for _, high in intervals)),
        "",
        min(each.phase for each in known),
        min(each.delay for each in known),
        max(each.sensitivity for each in known),
    )


def _certificate_text(
    advice: Advice | None, degrees: Sequence[float], *, is_current: bool
) -> tuple[str, bool]:
    """Return what the certificate says of degrees, and whether that is a warning."""
    if advice is None or not is_current or advice.is_pending:
        return "certificate: being computed …", False
    if advice.interval is None:
        return f"no certificate: {advice.reason}", True
    low, high = advice.interval
    text = f"certified stable for μ from {low:+.3f} to {high:+.3f}"
    beyond = [each for each in degrees if not low <= each <= high]
    if beyond:
        return f"{text}: μ = {beyond[0]:g} is NOT certified", True
    return text, False


def _margins_text(advice: Advice | None) -> str:
    if advice is None or not math.isfinite(advice.phase):
        return ""
    return (
        f"where λ is 1: phase margin {advice.phase:.0f}°, delay margin "
        f"{1e3 * advice.delay:.1f} ms, largest |S| {advice.sensitivity:.2f}"
    )


def _response_options(before: Advice | None = None, after: Advice | None = None) -> dict[str, Any]:
    series, end = [], 0.0
    for label, advice, colour in (("in force", before, "#8a939c"), ("chosen", after, "#d55e00")):
        response = advice.response if advice is not None else None
        if response is None:
            continue
        points = [
            [time, 100.0 * (1.0 - left)]
            for time, left in zip(response.times, response.errors, strict=True)
        ]
        settles = f", settles in {response.settling:.2f} s" if response.settling < 1e3 else ""
        series.append(
            {
                "name": f"{label}{settles}, overshoot {100 * response.overshoot:.0f} %",
                "type": "line",
                "data": points,
                "showSymbol": False,
                "lineStyle": {"width": 2, "color": colour},
                "itemStyle": {"color": colour},
                "symbol": "none",
            }
        )
        end = max(end, _interesting(response.times, response.errors))
    ink = "#7d8791"
    axis = {"axisLabel": {"color": ink}, "splitLine": {"lineStyle": {"color": "#80808050"}}}
    time = {**axis, "axisLabel": {"color": ink, "formatter": "{value} s"}}
    return {
        "animation": False,
        "legend": {
            "top": 0,
            "left": 0,
            "orient": "vertical",
            "itemGap": 4,
            "textStyle": {"color": ink},
        },
        "grid": {"left": 40, "right": 24, "top": 50, "bottom": 24},
        "xAxis": {"type": "value", "max": end or 1.0, **time},
        "yAxis": {"type": "value", "scale": True, "splitNumber": 3, **axis},
        "series": series,
    }


def _interesting(times: Sequence[float], errors: Sequence[float]) -> float:
    """Return until when a response is worth a look: somewhat beyond its last 5 %."""
    late = [time for time, left in zip(times, errors, strict=True) if abs(left) > 0.05]
    return float(f"{min(1.5 * (late[-1] if late else times[-1]), times[-1]):.2g}")


def _shown(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
