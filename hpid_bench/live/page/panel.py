"""The right side of the page: parameters that are staged and applied, tests, snapshots."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui

from hpid_bench.live.advice import Advice
from hpid_bench.live.page.parts import Viewer, button, chart, chart_options, curve, labelled, mark
from hpid_bench.live.page.trial_panel import TrialPanel
from hpid_bench.live.session import (
    BANDWIDTH,
    GAINS,
    SLIDERS,
    SliderRange,
    slider_range,
    values_line,
)
from hpid_ros.base.errors import HpidError
from hpid_ros.base.records import ParameterSpec
from hpid_ros.base.rounding import significant
from hpid_ros.control.laws import LAWS
from hpid_ros.control.settings import LOOP_PARAMETERS

_EDITED_FOR = 0.7  # [s] after an input in which it is not set from elsewhere
_STEPS = 400  # of a slider
_TYPED_FOR = 400  # [ms] without a key, after which a number is taken
_SLID_FOR = 0.05  # [s] between two places of a slider that is moved
_FACTORS = SliderRange(0.1, 10.0, is_logarithmic=True)
_BANDWIDTHS = SliderRange(0.2, 5.0, is_logarithmic=True)

LABELS = {
    BANDWIDTH: ("ω", "bandwidth factor ω: p is multiplied by ω², i by ω³, d by ω"),
    "gains.p": ("p", "proportional gain"),
    "gains.i": ("i", "integral gain"),
    "gains.d": ("d", "derivative gain"),
    "mu": ("μ", "homogeneity degree; 0 is the linear PID"),
    "norm.effort_scale": ("u0", "effort scale of the norm: firmer below, gentler above; 0 is off"),
}


class Knob:
    """A slider and a field for one parameter of the joints that are chosen, or their bandwidth.

    Of several joints a gain is a factor on what each has active; all else is one value for all.
    The bandwidth is always such a factor.
    """

    def __init__(self, viewer: Viewer, name: str, edited: Callable[[], None]) -> None:
        self._viewer, self._tuning = viewer, viewer.session.tuning
        self.name, self._edited = name, edited
        self._range = SliderRange(0.0, 1.0, is_logarithmic=False)
        self._edited_at = -math.inf
        symbol, text = LABELS[name]
        with ui.element("div").classes("knob") as self.row:
            self._label = ui.label(symbol).classes("knob-name").tooltip(text)
            with ui.element("div").classes("knob-slider"):
                if name == "mu":
                    with ui.element("div").classes("interval").props('aria-hidden="true"'):
                        self._certified = ui.element("div").classes("interval-certified")
                        ui.element("div").classes("interval-zero")
                self._slider = ui.slider(min=0, max=_STEPS, value=0, step=1)
                labelled(self._slider, text)
            self._field = ui.number(format="%.5g")
            labelled(self._field.props("dense outlined"), text)
            self._field.props["debounce"] = _TYPED_FOR
            self._now = ui.label().classes("knob-now")
        # What a person does; not what refresh sets.
        self._slider.on("update:model-value", self._on_slide, throttle=_SLID_FOR)
        self._field.on("update:model-value", self._on_type)

    def show_interval(self, advice: Advice | None, *, is_current: bool) -> None:
        if is_current:
            low, high = (advice.interval if advice is not None else None) or (0.0, 0.0)
            begin, end = (100.0 * (each + 0.5) for each in (low, high))
            self._certified.style(f"left: {begin:.2f}%; width: {max(end - begin, 0.0):.2f}%")
        mark(self._certified, "is-old", is_on=not is_current)

    @property
    def _is_factor(self) -> bool:
        return self.name == BANDWIDTH or (self.name in GAINS and len(self._viewer.chosen()) > 1)

    def refresh(self) -> None:
        """Show what is chosen, unless somebody is typing here."""
        nodes = self._viewer.chosen()
        is_usable = bool(nodes) and self._viewer.may_edit
        self._slider.set_enabled(is_usable)
        self._field.set_enabled(is_usable)
        if not nodes:
            return
        shown, is_staged = self._shown(nodes)
        mark(self.row, "is-staged", is_on=is_staged)
        self._now.set_text(self._said(nodes))
        if time.monotonic() - self._edited_at < _EDITED_FOR:
            return
        self._range = self._range_of(nodes[0])
        self._slider.value = self._place(1.0 if shown is None else shown)
        self._field.value = None if shown is None else significant(shown, 6)

    def _shown(self, nodes: Sequence[str]) -> tuple[float | None, bool]:
        """Return what is chosen, None where that is no one number, and whether it is staged."""
        tuning = self._tuning
        if self._is_factor:
            factor = tuning.factor(nodes[0], self.name)
            return factor, factor is not None and not math.isclose(factor, 1.0)
        is_staged = any(self.name in tuning.staged.get(node, {}) for node in nodes)
        return float(tuning.value(nodes[0], self.name)), is_staged

    def _range_of(self, node: str) -> SliderRange:
        if self._is_factor:
            return _BANDWIDTHS if self.name == BANDWIDTH else _FACTORS
        first = self._tuning.first[node]
        scale = float(first["gains.p"]) * float(first["norm.error_scale"])
        return slider_range(self.name, float(first[self.name]), scale)

    def _said(self, nodes: Sequence[str]) -> str:
        if self.name == BANDWIDTH:
            return "× p, i, d"
        if self._is_factor:
            return "× each"
        in_force = [float(self._tuning.in_force[node][self.name]) for node in nodes]
        low, high = min(in_force), max(in_force)
        return f"now {low:.4g}" if math.isclose(low, high) else f"now {low:.3g} … {high:.3g}"

    def _place(self, value: float) -> int:
        low, high, is_logarithmic = self._range
        if is_logarithmic:
            value = math.log(max(value, low) / low) / math.log(high / low)
        else:
            value = (value - low) / (high - low)
        return round(_STEPS * min(max(value, 0.0), 1.0))

    def _value(self, place: float) -> float:
        low, high, is_logarithmic = self._range
        share = place / _STEPS
        value = low * (high / low) ** share if is_logarithmic else low + share * (high - low)
        return significant(value, 4) if self.name != "mu" else round(value, 4)

    def _on_slide(self, event: Any) -> None:
        value = self._value(float(event.args))
        self._field.value = value
        self._stage(value)

    def _on_type(self, event: Any) -> None:
        if event.args not in (None, ""):
            value = float(event.args)
            self._slider.value = self._place(value)
            self._stage(value)

    def _stage(self, value: float) -> None:
        if self._viewer.may_edit:
            self._edited_at = time.monotonic()
            self._viewer.stage(self.name, value, is_factor=self._is_factor)
            self._edited()


_APART = {*SLIDERS, "joint", "law"}  # with controls of their own, or not to be changed


class AllParameters:
    """Fields for the parameters that have no slider; made when they are first looked at."""

    def __init__(self, viewer: Viewer, edited: Callable[[], None]) -> None:
        self._viewer, self._tuning = viewer, viewer.session.tuning
        self._edited = edited
        self._fields: dict[str, Any] = {}
        self._known: dict[str, object] = {}  # what each field was set to last
        self._place = ui.expansion("All parameters", on_value_change=self._on_open)
        self._place.props("dense").classes("all")

    def _on_open(self, event: Any) -> None:
        if event.value and not self._fields:
            with self._place:
                self._search = ui.input(placeholder="search", on_change=self._on_search)
                self._search.props('dense outlined clearable aria-label="search parameters"')
                for name, spec in LOOP_PARAMETERS.items():
                    if name not in _APART:
                        self._fields[name] = self._field(spec)
        self.refresh()

    def _field(self, spec: ParameterSpec) -> Any:
        with ui.element("div").classes("field") as row:
            label = ui.label(spec.name).classes("field-name")
            label.tooltip(spec.description)
            if isinstance(spec.default, bool):
                field: Any = ui.checkbox()
            elif spec.choices:
                field = ui.select(list(spec.choices))
            else:
                field = ui.number().props("debounce=400")  # a format would round what is left
            labelled(field.props("dense outlined options-dense"), spec.name)
            field.on_value_change(lambda event: self._stage(spec.name, event.value))
        field.hpid_row = row
        return field

    def _on_search(self, event: Any) -> None:
        wanted = (event.value or "").lower()
        for name, field in self._fields.items():
            text = f"{name} {LOOP_PARAMETERS[name].description}".lower()
            field.hpid_row.set_visibility(wanted in text)

    def _stage(self, name: str, value: object) -> None:
        if value not in (None, self._known.get(name)):
            self._viewer.stage(name, value)
            self._known.pop(name, None)  # what was refused does not stay
            self._edited()

    def refresh(self) -> None:
        """Show what is chosen; of several joints what the first one has."""
        if not self._fields or not self._place.value:
            return
        nodes, tuning = self._viewer.chosen(), self._tuning
        for name, field in self._fields.items():
            field.set_enabled(bool(nodes) and self._viewer.may_edit)
            is_staged = any(name in tuning.staged.get(node, {}) for node in nodes)
            mark(field.hpid_row, "is-staged", is_on=is_staged)
            if nodes:
                value = tuning.value(nodes[0], name)
                if self._known.get(name) != value:  # what a person types is left alone
                    self._known[name] = field.value = value


_LARGEST_FILE = 1_000_000  # bytes


class SnapshotPanel:
    """Keeps what is active, goes back to it, writes and reads parameter files."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._session = viewer, viewer.session
        self._shown: tuple[str, ...] | None = None
        ui.label("Snapshots").classes("heading")
        with ui.element("div").classes("bar"):
            self._name = ui.input(placeholder="name").props(
                'dense outlined aria-label="name of the snapshot"'
            )
            keep = viewer.acting(self._on_keep, self.refresh)
            self._name.on("keydown.enter", keep)
            self._keep = button("Keep what is in force", keep, "unelevated")
        self._list = ui.element("ul").classes("snapshots")
        ui.label("Parameter file").classes("heading")
        with ui.element("div").classes("bar"):
            button("Save controllers.yaml", self._on_save)
            self._upload = ui.upload(
                label="Load: choose a file, it is staged",
                auto_upload=True,
                max_file_size=_LARGEST_FILE,
                on_upload=self._on_load,
                on_rejected=lambda: ui.notify("at most 1 MB", type="negative"),
            ).props('flat bordered accept=".yaml,.yml" aria-label="load a parameter file"')

    def refresh(self) -> None:
        self._keep.set_enabled(self._viewer.may_edit)
        self._upload.set_enabled(self._viewer.may_edit)
        snapshots = self._session.tuning.snapshots
        if tuple(snapshots) == self._shown:
            return
        self._shown = tuple(snapshots)
        self._list.clear()
        with self._list:
            for name, values in snapshots.items():
                restore = partial(self._on_restore, name)
                with ui.element("li"):
                    ui.label(f"{name} ({len(values)} joints)")
                    act = self._viewer.acting(restore, self.refresh)
                    button("go back to it", act, "flat dense size=sm")

    def _on_keep(self) -> None:
        nodes = [node for node, each in self._session.controllers.items() if each.is_here]
        try:
            name = self._session.tuning.keep(self._name.value or "", nodes)
        except HpidError as error:
            ui.notify(str(error), type="negative")
            return
        self._session.say(f"snapshot {name} of {len(nodes)} joints")
        self._name.value = ""

    async def _on_restore(self, name: str) -> None:
        values = self._session.tuning.snapshots[name]
        await self._session.restore(values, f"snapshot {name}")

    def _on_save(self) -> None:
        ui.download.content(self._session.document(), "controllers.yaml", "text/yaml")

    async def _on_load(self, event: Any) -> None:
        if not self._viewer.may_edit:
            return
        self._upload.reset()
        try:
            self._session.load(await event.file.text(), event.file.name)
        except UnicodeDecodeError:
            self._session.say(f"{event.file.name} is no text", is_bad=True)
        except HpidError as error:
            self._session.say(str(error), is_bad=True)


_STEP = 0.1  # [rad], of the response that is shown


class TuningPanel:
    """Parameters of the joints that are chosen."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._session = viewer, viewer.session
        self._shown: Any = None
        with ui.tabs().props("dense no-caps align=left") as tabs:
            tune, test, keep = ui.tab("Tune"), ui.tab("Try"), ui.tab("Save")
        with ui.tab_panels(tabs, value=tune).classes("panels"):
            with ui.tab_panel(tune):
                self._build_tune()
            with ui.tab_panel(test):
                self._trial = TrialPanel(viewer)
            with ui.tab_panel(keep):
                self._snapshots = SnapshotPanel(viewer)

    def _build_tune(self) -> None:
        session, tuning = self._session, self._session.tuning
        self._of = ui.label().classes("heading")
        laws = {name: law.title for name, law in LAWS.items()}
        self._law = ui.toggle(laws, on_change=self._on_law).props('dense no-caps aria-label="law"')
        self._knobs = {
            name: Knob(self._viewer, name, self.refresh) for name in (BANDWIDTH, *SLIDERS)
        }
        self._certified = ui.label().classes("advice").props('aria-live="polite"')
        self._margins = ui.label().classes("advice")
        self._objection = ui.label().classes("objection").props('role="alert"')
        with ui.element("div").classes("bar actions"):
            self._apply = self._button(
                "Apply",
                lambda: session.apply(list(tuning.staged)),
                'unelevated color="primary" data-act="apply" aria-keyshortcuts="Control+Enter"',
            )
            self._apply.tooltip("Ctrl+Enter")
            self._discard = self._button("Discard", tuning.unstage)
            ui.space()
            keys = 'flat data-act="undo" aria-keyshortcuts="Control+Z"'
            self._undo = self._button("Undo", session.undo, keys)
            self._revert = self._button(
                "Back to start",
                lambda: session.restore(tuning.starts(self._viewer.chosen()), "back to the start"),
            )
        self._staged = ui.label().classes("staged")
        self._response_of = ui.label().classes("hint")
        self._response = chart("response to a step, in force and as chosen", "response")
        self._all = AllParameters(self._viewer, self.refresh)

    def _button(self, text: str, act: Callable[[], object], look: str = "flat") -> Any:
        return button(text, self._viewer.acting(act, self.refresh), look)

    def refresh(self) -> None:
        nodes = self._viewer.chosen()
        self._of.set_text(self._title(nodes))
        for knob in self._knobs.values():
            knob.refresh()
        self._refresh_law(nodes)
        self._refresh_advice(nodes)
        self._refresh_actions(nodes)
        self._all.refresh()
        self._snapshots.refresh()
        self._trial.refresh()

    def _title(self, nodes: Sequence[str]) -> str:
        if len(nodes) > 1:
            return f"{len(nodes)} joints: gains are factors, all else is one value"
        return self._session.label(nodes[0]) if nodes else "choose a joint"

    def _refresh_law(self, nodes: Sequence[str]) -> None:
        self._law.set_enabled(bool(nodes) and self._viewer.may_edit)
        laws = {self._session.tuning.value(node, "law") for node in nodes}
        self._law.value = laws.pop() if len(laws) == 1 else None

    def _on_law(self, event: Any) -> None:
        nodes, tuning = self._viewer.chosen(), self._session.tuning
        is_other = any(tuning.value(node, "law") != event.value for node in nodes)
        if is_other and event.value is not None:
            self._viewer.stage("law", event.value)
            self.refresh()

    def _is_homogeneous(self, node: str) -> bool:
        return LAWS[str(self._session.tuning.value(node, "law"))].is_homogeneous

    def _refresh_advice(self, nodes: Sequence[str]) -> None:
        mu = self._knobs["mu"]
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
        tuning = self._session.tuning
        degrees = [
            float(tuning.value(node, "mu")) if self._is_homogeneous(node) else 0.0
            for node in nodes
        ]
        text, is_bad = _certificate_text(joint if is_known else None, degrees)
        self._certified.set_text(text)
        self._certified.classes(replace="advice is-bad" if is_bad else "advice")
        self._margins.set_text(_margins_text(joint))
        self._refresh_response(nodes[0])

    def _refresh_response(self, node: str) -> None:
        before, _ = self._session.advice(node, _STEP, is_staged=False)
        after, _ = self._session.advice(node, _STEP, is_staged=True)
        if (node, before, after) == self._shown:
            return
        self._shown = (node, before, after)
        self._response_of.set_text(
            f"{self._session.label(node)}: response of its inertia alone to a step of "
            f"{_STEP:g}, in percent"
        )
        self._response.options.update(_response_options(before, after))
        self._response.update()

    def _refresh_actions(self, nodes: Sequence[str]) -> None:
        session, tuning, may = self._session, self._session.tuning, self._viewer.may_edit
        staged = tuning.staged_sets(list(tuning.staged))
        objections = [
            f"{session.label(node)}: {line}" for node in staged if (line := tuning.objection(node))
        ]
        self._objection.set_text(objections[0] if objections else "")
        self._apply.set_enabled(may and bool(staged) and not objections)
        self._discard.set_enabled(may and bool(staged))
        self._undo.set_enabled(may and bool(tuning.done))
        self._revert.set_enabled(may and bool(tuning.towards(tuning.starts(nodes))))
        parts = [
            f"{session.label(node)}: {values_line(values)}" for node, values in staged.items()
        ]
        self._staged.set_text(f"chosen, not sent: {'; '.join(parts)}" if parts else "")


def _joint_advice(known: Sequence[Advice]) -> Advice:
    """Return what holds for all of several joints: the narrowest interval, the least margins."""
    without = [each for each in known if each.interval is None]
    pending = [each for each in without if each.is_pending]
    lows, highs = zip(*(each.interval or (0.0, 0.0) for each in known), strict=True)
    return replace(
        (pending or without or known)[0],
        interval=None if without else (max(lows), min(highs)),
        phase=float(np.min([each.phase for each in known])),  # nan where one is not known
        delay=float(np.min([each.delay for each in known])),
        sensitivity=float(np.max([each.sensitivity for each in known])),
    )


def _certificate_text(advice: Advice | None, degrees: Sequence[float]) -> tuple[str, bool]:
    """Return what the certificate says of degrees, and whether that is a warning."""
    if advice is None:
        return "certificate: being computed …", False
    if advice.interval is None:
        return f"no certificate: {advice.reason}", True
    low, high = advice.interval
    text = f"certified stable for μ from {low:+.3f} to {high:+.3f}"
    beyond = [each for each in degrees if not low <= each <= high]
    return (f"{text}: μ = {beyond[0]:g} is NOT certified", True) if beyond else (text, False)


def _margins_text(advice: Advice | None) -> str:
    if advice is None or not math.isfinite(advice.phase):
        return ""
    return (
        f"where λ is 1: phase margin {advice.phase:.0f}°, delay margin "
        f"{1e3 * advice.delay:.1f} ms, largest |S| {advice.sensitivity:.2f}"
    )


def _response_options(before: Advice | None, after: Advice | None) -> dict[str, Any]:
    series, end = [], 0.0
    for label, advice, colour in (("in force", before, "#8a939c"), ("chosen", after, "#d55e00")):
        response = advice.response if advice is not None else None
        if response is None:
            continue
        pairs = zip(response.times, response.errors, strict=True)
        settles = f", settles in {response.settling:.2f} s" if response.settling < 1e3 else ""
        name = f"{label}{settles}, overshoot {100 * response.overshoot:.0f} %"
        series.append(curve(name, [[at, 100.0 * (1.0 - left)] for at, left in pairs], colour))
        end = max(end, _interesting(response.times, response.errors))
    return chart_options(series, 50, end or 1.0, orient="vertical", itemGap=4)


def _interesting(times: Sequence[float], errors: Sequence[float]) -> float:
    """Return until when a response is worth a look: somewhat beyond its last 5 %."""
    late = [time for time, left in zip(times, errors, strict=True) if abs(left) > 0.05]
    return significant(min(1.5 * (late[-1] if late else times[-1]), times[-1]), 2)
