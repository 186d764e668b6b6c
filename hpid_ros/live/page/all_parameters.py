"""Every parameter of the loop, each with a field of its kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from nicegui import ui

from hpid_ros.base.errors import HpidError
from hpid_ros.control.settings.table import LOOP_PARAMETERS, ParameterSpec
from hpid_ros.live.session import LiveSession
from hpid_ros.live.tuning import SLIDERS

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
