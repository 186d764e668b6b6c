"""Snapshots under names, and parameter files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from hpid_ros.base.errors import HpidError
from hpid_ros.live.session import LiveSession

_LARGEST_FILE = 1_000_000  # bytes


class SnapshotPanel:
    """Keeps what is in force, goes back to it, writes and reads parameter files."""

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
