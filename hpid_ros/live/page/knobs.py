"""Sliders and fields for parameters, the certified interval on that of the degree."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any

from nicegui import ui

from hpid_ros.base.errors import HpidError
from hpid_ros.base.records import ParameterSpec
from hpid_ros.control.settings import LOOP_PARAMETERS
from hpid_ros.live.advice import Advice
from hpid_ros.live.session import LiveSession
from hpid_ros.live.tuning import BANDWIDTH, GAINS, SLIDERS, Range, slider_range

_EDITED_FOR = 0.7  # [s] after an input in which it is not set from elsewhere
_STEPS = 400  # of a slider
_TYPED_FOR = 400  # [ms] without a key, after which a number is taken
_FACTORS = Range(0.1, 10.0, is_logarithmic=True)
_BANDWIDTHS = Range(0.2, 5.0, is_logarithmic=True)

LABELS = {
    BANDWIDTH: ("ω", "bandwidth, times that in force: p by its square, i its cube, d itself"),
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

    def __init__(
        self,
        session: LiveSession,
        name: str,
        chosen: Callable[[], Sequence[str]],
        may_edit: Callable[[], bool],
        edited: Callable[[], None],
    ) -> None:
        self._session, self.name = session, name
        self._chosen, self._may_edit, self._edited = chosen, may_edit, edited
        self._range = Range(0.0, 1.0, is_logarithmic=False)
        self._is_setting = False
        self._edited_at = -math.inf
        self._build()

    def _build(self) -> None:
        symbol, text = LABELS[self.name]
        with ui.element("div").classes("knob") as self.row:
            self._label = ui.label(symbol).classes("knob-name").tooltip(text)
            with ui.element("div").classes("knob-slider"):
                if self.name == "mu":
                    self._build_interval()
                self._slider = ui.slider(min=0, max=_STEPS, value=0, step=1)
                self._slider.props(f'aria-label="{text}"').on_value_change(self._on_slide)
            self._field = ui.number(format="%.5g", on_change=self._on_type)
            self._field.props(f'dense outlined debounce={_TYPED_FOR} aria-label="{text}"')
            self._now = ui.label().classes("knob-now")

    def _build_interval(self) -> None:
        with ui.element("div").classes("interval").props('aria-hidden="true"'):
            self._certified = ui.element("div").classes("interval-certified")
            ui.element("div").classes("interval-zero")

    def show_interval(self, advice: Advice | None, *, is_current: bool) -> None:
        """Draw the certified degrees."""
        if is_current:
            low, high = (advice.interval if advice is not None else None) or (0.0, 0.0)
            begin, end = (100.0 * (each + 0.5) for each in (low, high))
            self._certified.style(f"left: {begin:.2f}%; width: {max(end - begin, 0.0):.2f}%")
        self._certified.classes(
            add="" if is_current else "is-old", remove="is-old" if is_current else ""
        )

    @property
    def _is_factor(self) -> bool:
        return self.name == BANDWIDTH or (self.name in GAINS and len(self._chosen()) > 1)

    def refresh(self) -> None:
        """Show what is chosen, unless somebody is typing here."""
        nodes = self._chosen()
        is_usable = bool(nodes) and self._may_edit()
        self._slider.set_enabled(is_usable)
        self._field.set_enabled(is_usable)
        if not nodes:
            return
        shown, is_staged = self._shown(nodes)
        self.row.classes(
            add="is-staged" if is_staged else "", remove="" if is_staged else "is-staged"
        )
        self._now.set_text(self._said(nodes))
        if time.monotonic() - self._edited_at < _EDITED_FOR:
            return
        self._range = self._range_of(nodes[0])
        with self._set():
            self._slider.value = self._place(1.0 if shown is None else shown)
            self._field.value = None if shown is None else float(f"{shown:.6g}")

    def _shown(self, nodes: Sequence[str]) -> tuple[float | None, bool]:
        """Return what is chosen, None where that is no one number, and whether it is staged."""
        tuning = self._session.tuning
        if self._is_factor:
            factor = tuning.factor(nodes[0], self.name)
            return factor, factor is not None and not math.isclose(factor, 1.0)
        is_staged = any(self.name in tuning.staged.get(node, {}) for node in nodes)
        return float(tuning.value(nodes[0], self.name)), is_staged

    def _range_of(self, node: str) -> Range:
        if self.name == BANDWIDTH:
            return _BANDWIDTHS
        return _FACTORS if self._is_factor else self._own_range(node)

    def _own_range(self, node: str) -> Range:
        first = self._session.tuning.first[node]
        scale = float(first["gains.p"]) * float(first["norm.error_scale"])
        return slider_range(self.name, float(first[self.name]), scale)

    def _said(self, nodes: Sequence[str]) -> str:
        if self.name == BANDWIDTH:
            return "× p, i, d"
        if self._is_factor:
            return "× each"
        in_force = [float(self._session.tuning.in_force[node][self.name]) for node in nodes]
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
        return float(f"{value:.4g}") if self.name != "mu" else round(value, 4)

    @contextmanager
    def _set(self) -> Any:
        self._is_setting = True
        try:
            yield
        finally:
            self._is_setting = False

    def _on_slide(self, event: Any) -> None:
        if not self._is_setting and event.value is not None:
            value = self._value(float(event.value))
            with self._set():
                self._field.value = value
            self._stage(value)

    def _on_type(self, event: Any) -> None:
        if not self._is_setting and event.value is not None:
            with self._set():
                self._slider.value = self._place(float(event.value))
            self._stage(float(event.value))

    def _stage(self, value: float) -> None:
        if not self._may_edit():
            return
        self._edited_at = time.monotonic()
        nodes, tuning = self._chosen(), self._session.tuning
        try:
            if self._is_factor:
                tuning.stage_factor(nodes, self.name, value)
            else:
                tuning.stage(nodes, self.name, value)
        except HpidError as error:
            ui.notify(str(error), type="negative")
        self._edited()


_APART = {*SLIDERS, "joint", "law"}  # with controls of their own, or not to be changed


class AllParameters:
    """Fields for the parameters that have no slider; made when they are first looked at."""

    def __init__(
        self,
        session: LiveSession,
        chosen: Callable[[], Sequence[str]],
        may_edit: Callable[[], bool],
        edited: Callable[[], None],
    ) -> None:
        self._session, self._chosen = session, chosen
        self._may_edit, self._edited = may_edit, edited
        self._fields: dict[str, Any] = {}
        self._is_setting = False
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
        props = f'dense outlined options-dense aria-label="{spec.name}"'
        with ui.element("div").classes("field") as row:
            label = ui.label(spec.name).classes("field-name")
            label.tooltip(spec.description)
            if isinstance(spec.default, bool):
                field: Any = ui.checkbox()
                props = f'dense aria-label="{spec.name}"'
            elif spec.choices:
                field = ui.select(list(spec.choices))
            else:
                field = ui.number(format="%.6g").props("debounce=400")
            field.props(props)
            field.on_value_change(lambda event: self._stage(spec.name, event.value))
        field.hpid_row = row
        return field

    def _on_search(self, event: Any) -> None:
        wanted = (event.value or "").lower()
        for name, field in self._fields.items():
            text = f"{name} {LOOP_PARAMETERS[name].description}".lower()
            field.hpid_row.set_visibility(wanted in text)

    def _stage(self, name: str, value: object) -> None:
        nodes = self._chosen()
        if self._is_setting or value is None or not nodes or not self._may_edit():
            return
        if value == self._session.tuning.value(nodes[0], name) and len(nodes) == 1:
            return
        try:
            self._session.tuning.stage(nodes, name, value)
        except HpidError as error:
            ui.notify(str(error), type="negative")
        self._edited()

    def refresh(self) -> None:
        """Show what is chosen; of several joints what the first one has."""
        if not self._fields or not self._place.value:
            return
        nodes, tuning = self._chosen(), self._session.tuning
        self._is_setting = True
        for name, field in self._fields.items():
            field.set_enabled(bool(nodes) and self._may_edit())
            is_staged = any(name in tuning.staged.get(node, {}) for node in nodes)
            field.hpid_row.classes(
                add="is-staged" if is_staged else "", remove="" if is_staged else "is-staged"
            )
            if nodes:
                value = tuning.value(nodes[0], name)
                if self._last(field) != value:
                    field.hpid_last = value
                    field.value = value
        self._is_setting = False

    @staticmethod
    def _last(field: Any) -> object:
        """Return what was put into a field last: what a person is typing is left alone."""
        return getattr(field, "hpid_last", None)
