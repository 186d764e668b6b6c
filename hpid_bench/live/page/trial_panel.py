"""Test motions on the page: chosen, seen before they move, held, compared."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from nicegui import background_tasks, ui

from hpid_bench.live.history import extremes
from hpid_bench.live.page.parts import (
    COLOURS,
    Viewer,
    button,
    chart,
    chart_options,
    curve,
    labelled,
    table,
)
from hpid_bench.live.session import name_shown
from hpid_bench.live.trials import MOTION_KINDS, MotionWish, TrialResult, TrialStage, Variant
from hpid_ros.base.errors import HpidError
from hpid_ros.metrics.comparison import ratio
from hpid_ros.metrics.quantities import PAPER
from hpid_ros.motion.excitation import ExcitationPlan

_IN_FORCE, _CHOSEN = "what is in force", "what is chosen"
_SNAPSHOT = "snapshot "  # before its name, which may be any
_BUCKETS = 300  # of a curve that is drawn


class TrialPanel:
    """A motion, a button to hold, and what came of it."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._session, self._trials = viewer, viewer.session, viewer.trials
        self._shown: TrialResult | None = None
        self._planned_of: object = None
        ui.label("Test motion of the joints that are chosen").classes("heading")
        self._kind = ui.select(MOTION_KINDS, value="minimum_jerk").props(
            'dense outlined options-dense aria-label="kind of motion"'
        )
        self._kind.classes("wide")
        with ui.element("div").classes("bar numbers"):
            self._amplitude = _number("at most [rad or m]", 0.1)
            self._duration = _number("lasts [s]", 4.0)
            self._share = _number("share of the limits", 0.5)
        self._plan_text = ui.label().classes("hint")
        self._preview = chart("the motion that is planned", "preview")
        with ui.element("div").classes("bar"):
            self._one = _select("first with", [_IN_FORCE], _IN_FORCE)
            self._other = _select("then with", ["nothing", _CHOSEN], _CHOSEN)
        self._is_kept = ui.checkbox("keep the recordings (MCAP), in a folder here")
        with ui.element("div").classes("bar"):
            prepare = viewer.acting(self._on_prepare, self.refresh)
            self._prepare = button("Get ready", prepare, "unelevated")
            self._hold = ui.button("Hold to run").classes("hold")
            self._hold.props(
                'data-act="hold" no-caps color="positive" '
                'aria-label="hold to run, release to stop"'
            )
            self._hold.on("pointerdown", js_handler="(event) => window.hpidLive.holdBy(event)")
            self._cancel = button("Cancel", self._on_cancel)
        with ui.element("div").classes("bar") as self._offer_back:
            self._away = ui.label().classes("hint")
            self._back = button("Go back there first", viewer.acting(self._on_back, self.refresh))
        self._said = ui.label().props('aria-live="polite"')
        self._result = ui.element("div").classes("result")

    @property
    def _wish(self) -> MotionWish:
        return MotionWish(
            self._kind.value,
            float(self._amplitude.value or 0.0),
            float(self._duration.value or 0.0),
            float(self._share.value or 0.0),
        )

    def refresh(self) -> None:
        stage, may = self._trials.stage, self._viewer.may_edit
        is_idle = stage is TrialStage.IDLE
        self._offer()
        can_move = self._refresh_plan() if is_idle else True
        self._prepare.set_enabled(may and is_idle and can_move)
        # Before it is green it takes a press, too, so that one that is too early has an answer.
        is_ready = stage in (TrialStage.READY, TrialStage.MOVING)
        self._hold.set_enabled(may and stage not in (TrialStage.IDLE, TrialStage.ENDING))
        self._hold.props("color=positive" if is_ready else "color=grey")
        self._hold.props("aria-disabled=false" if is_ready else "aria-disabled=true")
        self._hold.set_text(self._hold_text())
        self._cancel.set_enabled(not is_idle and stage is not TrialStage.ENDING)
        away = self._trials.away(self._viewer.chosen()) if is_idle else ""
        self._offer_back.set_visibility(bool(away))
        self._away.set_text(away)
        self._back.set_enabled(may)
        self._said.set_text(self._trials.said)
        self._said.classes(replace="is-bad" if self._trials.is_bad else "advice")
        if self._trials.result is not self._shown:
            self._shown = self._trials.result
            self._show_result()

    def _hold_text(self) -> str:
        trials = self._trials
        if trials.stage is TrialStage.IDLE:
            return "Hold to run"
        if trials.stage is TrialStage.ENDING:
            return "Ending"
        which = f"({trials.number} of {trials.count})" if trials.count else "(back)"
        left = trials.seconds_left
        return f"Hold to run {which}" if left is None else f"Hold: {left:.0f} s {which}"

    def _offer(self) -> None:
        snapshots = [f"{_SNAPSHOT}{name}" for name in self._session.tuning.snapshots]
        names = [_IN_FORCE, _CHOSEN, *snapshots]
        if self._one.options != names:
            self._one.set_options(names, value=self._one.value or _IN_FORCE)
            self._other.set_options(["nothing", *names], value=self._other.value or _CHOSEN)

    def _refresh_plan(self) -> bool:
        """Show the motion that would be carried out, and return whether there is one."""
        nodes = self._viewer.chosen()
        states = tuple(self._session.controllers[node].lifecycle for node in nodes)
        about = (tuple(nodes), self._wish, self._stands(nodes), states)
        if about == self._planned_of:
            return True
        try:
            planned = self._trials.plan(nodes, self._wish)
        except HpidError as error:
            self._plan_text.set_text(str(error))
            self._preview.set_visibility(False)
            self._planned_of = None  # why not may pass, as where no state had come yet
            return False
        self._planned_of = about
        self._preview.set_visibility(True)
        self._plan_text.set_text(_plan_text(planned))
        self._preview.options.update(_curves_options(_plan_curves(planned)))
        self._preview.update()
        return True

    def _stands(self, nodes: Sequence[str]) -> tuple[float, ...]:
        """Return where joints are, so coarsely that noise plans nothing again."""
        places = (self._session.history(node).position for node in nodes)
        return tuple(round(each, 1) if each is not None else 0.0 for each in places)

    # What a person does

    def _on_prepare(self) -> None:
        nodes = self._viewer.chosen()
        names = [self._one.value]
        if self._other.value != "nothing":
            names.append(self._other.value)
        values = [self._variant(name, nodes, 2).values or {} for name in names]
        if len(names) == 2 and all(values[0].get(n) == values[1].get(n) for n in nodes):
            self._session.say(f"{names[0]} and {names[1]} are the same: one motion is enough")
            names.pop()
        variants = [self._variant(name, nodes, len(names)) for name in names]
        background_tasks.create(
            self._trials.run(
                self._viewer.page, nodes, self._wish, variants, is_kept=self._is_kept.value
            )
        )

    def _on_back(self) -> None:
        nodes = self._viewer.chosen()
        background_tasks.create(self._trials.go_back(self._viewer.page, nodes, self._wish))

    def _on_cancel(self) -> None:
        own = "cancelled" if self._viewer.may_edit else f"cancelled on {self._viewer.name}"
        self._trials.cancel(own)

    def _variant(self, name: str, nodes: Sequence[str], count: int) -> Variant:
        tuning = self._session.tuning
        if name == _IN_FORCE:
            values = {node: dict(tuning.in_force[node]) for node in nodes} if count > 1 else None
            return Variant("in force", values)
        if name == _CHOSEN:
            return Variant("chosen", {node: tuning.chosen(node) for node in nodes})
        return Variant(name, tuning.snapshots[name.removeprefix(_SNAPSHOT)])

    # What came of it

    def _show_result(self) -> None:
        self._result.clear()
        result = self._shown
        if result is None:
            return
        labels = [each.label for each in result.variants]
        with self._result:
            ui.label(" and ".join(labels)).classes("heading")
            _show_table(result, labels)
            ui.label("lower is better for every index").classes("hint")
            for label in labels[1:]:
                for each in result.comparison.differences(label):
                    ui.label(f"not fully comparable: {each.text}").classes("hint")
            errors = chart("errors of the motions", "preview")
            errors.options.update(_curves_options(_error_curves(result)))
            with ui.element("div").classes("bar"):
                for variant in result.variants if len(labels) > 1 else ():
                    keep = self._viewer.acting(partial(self._keep, variant), self.refresh)
                    button(f"keep {variant.label}", keep, "unelevated size=sm")
            for run, begin, end in result.motions:
                if run.path.exists():
                    window = f"--start {begin:g} --end {end:g}"
                    ui.label(f"hpid metrics {run.path} {window}").classes("command")

    async def _keep(self, variant: Variant) -> None:
        if self._trials.stage is TrialStage.IDLE:
            await self._trials.keep(variant)


def _show_table(result: TrialResult, labels: Sequence[str]) -> None:
    comparison = result.comparison
    with table(["index", *labels, *(["ratio"] if len(labels) > 1 else [])], {})[1]:
        for quantity in PAPER:
            figures = [comparison.run(each).value(quantity) for each in labels]
            texts = [f"{each:.4g}" for each in figures]
            if len(labels) > 1:
                texts.append(f"{ratio(figures[1], figures[0]):.3f}")
            with ui.element("tr"):
                for text in (f"{quantity.symbol} [{comparison.unit(quantity)}]", *texts):
                    with ui.element("td").classes("figure"):
                        ui.label(text)


def _number(label: str, value: float) -> Any:
    field = ui.number(label, value=value, format="%.4g")
    return labelled(field.props("dense outlined debounce=400"), label)


def _select(label: str, options: list[str], value: str) -> Any:
    field = ui.select(options, value=value, label=label)
    return labelled(field.props("dense outlined options-dense"), label)


def _plan_text(planned: ExcitationPlan) -> str:
    parts: dict[str, list[str]] = {}
    for each in planned.joints:
        unit, peaks = each.bounds.unit, each.peaks
        notes = f" ({'; '.join(each.notes)})" if each.notes else ""
        text = f"{peaks.position:.3g} {unit}, at most {peaks.velocity:.3g} {unit}/s{notes}"
        parts.setdefault(text, []).append(name_shown(each.bounds.joint))
    lines = "; ".join(f"{', '.join(joints)}: {text}" for text, joints in parts.items())
    return f"{planned.duration:.1f} s from where the joints stand. {lines}"


def _plan_curves(planned: ExcitationPlan) -> list[tuple[str, list[list[float]]]]:
    return [
        (name_shown(each.bounds.joint), np.column_stack([planned.times, positions]).tolist())
        for each, positions in zip(planned.joints, planned.positions.T, strict=True)
    ]


def _error_curves(result: TrialResult) -> list[tuple[str, list[list[float]]]]:
    curves = []
    for (run, *_), variant in zip(result.motions, result.variants, strict=True):
        if run.series is None:
            continue
        for each in run.series.joints:
            if each.has_reference:
                label = f"{variant.label}, error of {name_shown(each.joint)}"
                curves.append((label, _decimated(each.time, each.error)))
    return curves


def _decimated(times: Any, values: Any) -> list[list[float]]:
    """Return few points of a curve, the extremes of each stretch among them."""
    points = []
    for place in np.array_split(np.arange(len(times)), min(_BUCKETS, max(len(times), 1))):
        flat = extremes(times[place], values[place], 2)
        points += [list(pair) for pair in zip(flat[::2], flat[1::2], strict=True)]
    return points


def _curves_options(curves: Sequence[tuple[str, list[list[float]]]]) -> dict[str, Any]:
    """Return a chart of curves, those of one name up to its comma in one colour."""
    labels = list(dict.fromkeys(name.partition(",")[0] for name, _ in curves))
    colours = {label: COLOURS[k % len(COLOURS)] for k, label in enumerate(labels)}
    series = [curve(name, points, colours[name.partition(",")[0]]) for name, points in curves]
    return chart_options(series, type="scroll")
