"""Test motions: planned, carried out while a person holds a button, measured, compared."""

from __future__ import annotations

import asyncio
import itertools
import re
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hpid_bench.live.known_controllers import RunningController, RunningGraph
from hpid_bench.live.motion import (
    BUTTON_RELEASED,
    HELD_WITHIN,
    Ending,
    HeldMotion,
    bounds_of,
    chosen_controllers,
)
from hpid_bench.live.session import LiveSession, Values, changed_values, same
from hpid_ros.base.errors import HpidError, RunError, SettingError
from hpid_ros.base.text import bounded
from hpid_ros.control.settings import Value
from hpid_ros.messages.selection import BagSelection
from hpid_ros.messages.series import JointSeries
from hpid_ros.metrics.comparison import Comparison
from hpid_ros.metrics.measure import Measured, Measuring, compare, measure
from hpid_ros.motion.excitation import Design, ExcitationPlan, Wish, plan, plan_return

_STANDS_WITHIN = 1e-9  # [rad]


@dataclass(frozen=True)
class Variant:
    """What controllers are set to for one motion."""

    label: str  # what it is called
    values: Mapping[str, Values] | None = None  # all loop parameters by node


class Tried:
    """What a trial sets: what its variants differ in from what was there, and nothing else."""

    def __init__(self, before: Mapping[str, Values], variants: Sequence[Variant]) -> None:
        self._before = before
        self._names = {
            node: {
                name
                for each in variants
                for name in changed_values(had, (each.values or {}).get(node, {}))
            }
            for node, had in before.items()
        }
        self._set: dict[str, dict[str, Value]] = {node: {} for node in before}

    def wanted(self, variant: Variant) -> dict[str, Values]:
        """Return what controllers are to be set to for a variant, by node."""
        values = variant.values or {}
        return {
            node: {name: values[node][name] for name in names if name in values[node]}
            for node, names in self._names.items()
            if node in values
        }

    def note(self, values: Mapping[str, Values]) -> None:
        for node, each in values.items():
            self._set[node] |= each

    def to_give_back(self, in_force: Mapping[str, Values]) -> dict[str, Values]:
        """Return what there was, of what is still as the trial has set it, by node."""
        return {
            node: {
                name: self._before[node][name]
                for name, value in tried.items()
                if same(in_force[node][name], value) and not same(self._before[node][name], value)
            }
            for node, tried in self._set.items()
        }


class MeasuredMotion(NamedTuple):
    """The numbers of a part of a recording."""

    run: Measured
    begin: float  # [s] after the first state
    end: float  # [s] likewise


@dataclass(frozen=True)
class TrialResult:
    """Motions that were measured."""

    variants: tuple[Variant, ...]  # in their order
    motions: tuple[MeasuredMotion, ...]  # of each
    comparison: Comparison  # of all, ratios to the first

    @classmethod
    def of(cls, variants: Sequence[Variant], motions: Sequence[MeasuredMotion]) -> TrialResult:
        """Compare the motions that came to their ends, the first so many of the variants."""
        compared = compare([each.run for each in motions])
        return cls(tuple(variants)[: len(motions)], tuple(motions), compared)


def measure_motion(bag: Path, label: str, planned: ExcitationPlan) -> MeasuredMotion:
    """Measure a recording while the motion lasts: neither the wait before it nor what follows.

    What a joint was told before, which is still on the graph, is in the recording, too: so the
    start is counted back from when the last reference came to rest.
    """
    selection = BagSelection(joints=planned.names)
    series = measure(bag, label, Measuring(selection)).series
    assert series is not None
    rests = [_rests_at(each) for each in series.joints if each.has_reference]
    if not rests:
        raise RunError(f"{label}: the recording tells no reference")
    begin = round(max(max(rests) - (planned.rests_at - planned.begin), 0.0), 3)
    end = round(begin + planned.end - planned.begin, 3)
    run = measure(bag, label, Measuring(replace(selection, start=begin, end=end)))
    return MeasuredMotion(run, begin, end)


def _rests_at(series: JointSeries) -> float:
    """Return when a reference changes for the last time, in [s]."""
    moved = np.flatnonzero(np.abs(series.reference - series.reference[-1]) > _STANDS_WITHIN)
    return float(series.time[moved[-1]]) if len(moved) else 0.0


_LOOK_PERIOD = 0.05  # [s]
_CERTIFIED_WITHIN, _ASKED_EVERY = 15.0, 1.5  # [s]
_LARGEST_TIME = 60.0  # [s]
_LONGEST_FILE_NAME = 60  # characters of a snapshot's name
_GONE_FOR = 10.0  # [s] until a trial ends whose page is gone
_CANCELLED = "cancelled"
_BY_STOP = "ended by Stop{}: activate the joints, then get ready again"
_THERE = 1e-3  # [rad] or [m] from where the first motion began


class MotionWish(NamedTuple):
    """A motion that a person wants."""

    kind: str = "minimum_jerk"  # one of MOTION_KINDS
    amplitude: float = 0.1  # [rad] or [m], at most; the joints' limits may make it less
    duration: float = 4.0  # [s] of the whole
    share: float = 0.5  # of the limits of each joint that it may use


MOTION_KINDS = {
    "minimum_jerk": "there and back, smooth (minimum jerk)",
    "step": "there and back, as fast as the limits allow",
    "sine": "sine",
}
"""The kinds of motion."""


class TrialStage(Enum):
    """How far a trial is."""

    IDLE = "nothing is under way"
    PREPARING = "preparing"
    READY = "ready"
    MOVING = "moving"
    MEASURING = "measuring"
    ENDING = "ending"


class Trials:
    """One trial at a time, of the page that has the controllers in hand."""

    def __init__(self, session: LiveSession, within: float = HELD_WITHIN) -> None:
        self._session, self._within = session, within
        self._stage = TrialStage.IDLE
        self.said, self.is_bad = "", False
        self.result: TrialResult | None = None
        self._page = ""
        self._motion: HeldMotion | None = None
        self._tried: Tried | None = None
        self._folder: Path | None = None
        self._is_kept = False
        self._is_held = self._is_released = False
        self._is_ignored = False  # a press too early, or of the motion before, until it is let go
        self._call = ""  # what the button is for, once the motion is ready
        self._end = ""  # why the trial is to end
        self._start: dict[str, float] = {}  # references of its joints when it first moved them
        self._here_at = self._ends_at = 0.0
        self._stopping: asyncio.Task[bool] | None = None
        self.number = self.count = 0

    @property
    def stage(self) -> TrialStage:
        is_ending = self._end and self._stage is not TrialStage.IDLE
        return TrialStage.ENDING if is_ending else self._stage

    @property
    def is_idle(self) -> bool:
        return self._stage is TrialStage.IDLE

    @property
    def seconds_left(self) -> float | None:
        """For how long the button has to be held from now on, in [s]; None while nothing moves."""
        is_moving = self.stage is TrialStage.MOVING
        return max(self._ends_at - time.monotonic(), 0.0) if is_moving else None

    def plan(self, nodes: Sequence[str], wish: MotionWish) -> ExcitationPlan:
        return self._planned(nodes, wish)[0]

    def _planned(
        self, nodes: Sequence[str], wish: MotionWish
    ) -> tuple[ExcitationPlan, list[RunningController], RunningGraph]:
        if not nodes:
            raise SettingError("choose a joint")
        if not 0.0 < wish.duration <= _LARGEST_TIME:
            raise SettingError(
                f"a motion may last up to {_LARGEST_TIME:g} s, not {wish.duration:g}"
            )
        controllers, graph = self._running(nodes)
        bounds = [bounds_of(each, None) for each in controllers]
        design = Design(kind=wish.kind, duration=wish.duration, are_together=True)  # type: ignore[arg-type]
        return plan(bounds, Wish(wish.share, wish.amplitude), design), controllers, graph

    def _running(self, nodes: Sequence[str]) -> tuple[list[RunningController], RunningGraph]:
        if inactive := self._inactive(nodes):
            raise SettingError(inactive)
        session = self._session
        graph = session.graph.running(nodes, lambda node: session.history(node).state)
        return chosen_controllers(graph, []), graph

    # The button

    def press(self, page: str) -> None:
        """Note that a page's button is held; of the page whose trial it is.

        A press that comes before the motion is ready does not count until it is let go.
        """
        if page != self._page or self._is_ignored or self._end or self.stage is TrialStage.IDLE:
            return
        motion = self._motion
        if motion is not None and motion.stage in ("ready", "moving"):
            self._is_held = True
            motion.press()
        elif not self._is_held:
            self._is_ignored = True
            self._say(
                "not ready yet: let go, and press again when the button is green", is_bad=True
            )

    def release(self, page: str) -> None:
        """Note that it is not held any more, or that the page is gone: a motion stops."""
        if page != self._page:
            return
        was_pressed, was_ignored = self._is_held, self._is_ignored
        self._is_held = self._is_ignored = False
        if was_ignored and self.stage is TrialStage.READY:
            self._say(self._call)
        # Who was pressed may move already, and not have said so yet.
        begun = ("ready", "moving") if was_pressed else ("moving",)
        if self._motion is not None and self._motion.stage in begun:
            self._is_released = True
            self._motion.release()

    def cancel(self, why: str = _CANCELLED) -> None:
        """End what is under way: from now on no press moves anything.

        The reason is said on the page.
        """
        if self.stage is TrialStage.IDLE:
            return
        if not self._end:
            self._end = self.said = why
            self.is_bad = True
        if self._motion is not None:
            self._motion.release()

    async def stop(self, who: str = "") -> bool:
        """End what is under way, and deactivate every controller that is shown."""
        by = f" on {who}" if who else ""
        self.cancel(_BY_STOP.format(by))
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.create_task(self._session.stop(by))
        return await asyncio.shield(self._stopping)  # one that is asked for twice is one

    def unfinished(self) -> list[str]:
        """Return the joints whose controllers have what a trial that is under way has set."""
        if self._tried is None:
            return []
        back = self._tried.to_give_back(self._session.tuning.in_force)
        return [self._session.label(node) for node, values in back.items() if values]

    async def keep(self, variant: Variant) -> None:
        """Have controllers keep what they were tried with."""
        if variant.values is None:
            return
        if await self._session.send_if_other(variant.values, f"keep {variant.label}"):
            self._say(f"kept, now in force: {variant.label}")

    # The course

    async def run(
        self,
        page: str,
        nodes: Sequence[str],
        wish: MotionWish,
        variants: Sequence[Variant],
        *,
        is_kept: bool,
        start: Mapping[str, float] | None = None,
    ) -> None:
        """Carry out one motion for each variant, and measure them.

        Joints for which it is given where they start go there first.

        A motion whose button was released is prepared once more, and begins where the first one
        began: joints that stopped elsewhere go back there first, while the button is held. When
        one ends for another reason, or is cancelled, so does the trial, also while its last
        motion is measured:
        controllers are set back to what they were before, each that is there, and what was
        measured until then is its result. What somebody else sets meanwhile stays.
        """
        if self.stage is not TrialStage.IDLE:
            self._say("another trial is under way", is_bad=True)
            return
        self._page, self._stage = page, TrialStage.PREPARING
        self._is_held = self._is_ignored = False
        self._end, self._start = "", dict(start or {})
        self._here_at = time.monotonic()
        self.result, self.count = None, len(variants)
        staged = self._session.tuning.staged_sets(nodes)
        before = {node: dict(self._session.tuning.in_force[node]) for node in nodes}
        self._tried = tried = Tried(before, variants)
        found: list[MeasuredMotion] = []
        try:
            self._forget()
            self._folder = _new_folder(is_kept=is_kept)
            self._is_kept = is_kept
            is_done = await self._carry_out(nodes, wish, variants, tried, found)
            if found:
                tried_with = [
                    each if each.values is None else replace(each, values=tried.wanted(each))
                    for each in variants
                ]
                await self._show(tried_with, found)
            if is_done and self._end:  # while its result was made
                self._say(self._end, is_bad=True)
            if is_done and not self._end:
                self._start = {}  # they are there
            has_set = any(each.values is not None for each in variants)
            if has_set and (self._end or not is_done):
                await self._set_back(tried, staged)
        except OSError as error:
            self._say(str(error), is_bad=True)
        finally:
            self._motion, self._tried, self._stage = None, None, TrialStage.IDLE

    async def _carry_out(
        self,
        nodes: Sequence[str],
        wish: MotionWish,
        variants: Sequence[Variant],
        tried: Tried,
        found: list[MeasuredMotion],
    ) -> bool:
        """Carry out and measure one motion after the other, and tell whether all were."""
        try:
            assert self._folder is not None
            if not variants:
                await self._go_back(nodes, wish, "the joints", self._folder / "0")
            for number, variant in enumerate(variants):
                await self._set(number, variant, tried)
                found.append(await self._measured(number, nodes, wish, variant))
                self._require_wanted()
        except (HpidError, OSError) as error:
            text = str(error)
            self._say(text if self._end in text else f"{self._end}; {text}", is_bad=True)
            return False
        where = f"; recorded in {self._folder}" if self._is_kept else ""
        last = f", now in force: {variants[-1].label}" if len(variants) > 1 else ""
        self._say(f"done{last}{where}")
        return True

    async def _set_back(self, tried: Tried, staged: Mapping[str, Values]) -> None:
        """Have controllers take what they had; what was chosen is still chosen."""
        tuning = self._session.tuning
        back = tried.to_give_back(tuning.in_force)
        if not await self._session.give_back(back, "as before the trial"):
            self._say(f"{self.said}; NOT every controller was restored", is_bad=True)
        for node, values in staged.items():
            for name, value in values.items():
                if name not in tuning.staged.get(node, {}):  # what was chosen since stays
                    tuning.stage([node], name, value)

    async def _show(self, variants: Sequence[Variant], found: Sequence[MeasuredMotion]) -> None:
        """Make a result of the motions that came to their ends."""
        try:
            self.result = await asyncio.to_thread(TrialResult.of, variants, found)
        except HpidError as error:
            self._say(str(error), is_bad=True)

    async def _measured(
        self, number: int, nodes: Sequence[str], wish: MotionWish, variant: Variant
    ) -> MeasuredMotion:
        """Carry one motion out, as often as its button is released, and measure it."""
        assert self._folder is not None
        for attempt in itertools.count(1):
            label = variant.label if attempt == 1 else f"{variant.label}, attempt {attempt}"
            name = "_".join(re.findall(r"\w+", variant.label))[:_LONGEST_FILE_NAME] or "run"
            again = "" if attempt == 1 else f"_attempt_{attempt}"
            bag = self._folder / f"{number + 1}_{name}{again}"
            await self._go_back(nodes, wish, variant.label, bag)
            self._require_wanted()
            planned, controllers, graph = self._planned(nodes, wish)
            motion = HeldMotion(planned, controllers, graph, bag, self._within)
            ending = await self._ending(motion, nodes, label, planned.duration)
            if not self._start:
                self._start = dict(zip(planned.names, ending.began_at, strict=False))
            if not ending.reason:
                break
            self._explain(ending, label)
        self._stage = TrialStage.MEASURING
        self._say(f"{label}: measuring, let go")
        measuring = asyncio.ensure_future(
            asyncio.to_thread(measure_motion, bag, variant.label, planned)
        )
        while not measuring.done():
            await asyncio.wait([measuring], timeout=_LOOK_PERIOD)
            self._note_presence()
            if self._end:  # what was set is given back first
                measuring.add_done_callback(lambda each: each.cancelled() or each.exception())
                raise RunError(self._end)
        return measuring.result()

    def away(self, nodes: Sequence[str]) -> str:
        """Return how far joints are from where the trial that was interrupted began."""
        parts = []
        for node, way in zip(nodes, self._ways_back(nodes).values(), strict=True):
            if abs(way) >= _THERE:
                unit = "m" if self._session.controllers[node].limits.is_slide else "rad"
                parts.append(f"{self._session.label(node)} is {abs(way):.3g} {unit}")
        return f"{', '.join(parts)} from where the motion began" if parts else ""

    async def go_back(self, page: str, nodes: Sequence[str], wish: MotionWish) -> None:
        """Move joints back there, while the button is held."""
        await self.run(page, nodes, wish, (), is_kept=False, start=self._start)

    async def _go_back(
        self, nodes: Sequence[str], wish: MotionWish, label: str, bag: Path
    ) -> None:
        """Move joints back to where the trial's first motion began, while the button is held."""
        for attempt in itertools.count(1):
            ways = self._ways_back(nodes)
            if all(abs(way) < _THERE for way in ways.values()):
                return
            self._require_wanted()
            controllers, graph = self._running(nodes)
            joints = [each.joint for each in controllers]
            planned = plan_return(
                [bounds_of(each, None) for each in controllers],
                [ways[joint] for joint in joints],
                Wish(wish.share, wish.amplitude),
            )
            place = bag.with_name(f"{bag.name}_back_{attempt}")
            ends = [self._start[joint] for joint in joints]
            motion = HeldMotion(planned, controllers, graph, place, self._within, ends)
            back = f"{label}, back to where the motion began"
            ending = await self._ending(motion, nodes, back, planned.duration)
            if not self._is_kept:
                shutil.rmtree(place, ignore_errors=True)
            if not ending.reason:
                return
            self._explain(ending, back)

    def _ways_back(self, nodes: Sequence[str]) -> dict[str, float]:
        """Return how far joints are from where the trial's first motion began."""
        ways = {}
        for node in nodes:
            joint, history = self._session.controllers[node].joint, self._session.history(node)
            now = history.position if history.reference is None else history.reference
            start = self._start.get(joint)
            ways[joint] = 0.0 if start is None or now is None else start - now
        return ways

    async def _ending(
        self, motion: HeldMotion, nodes: Sequence[str], label: str, duration: float
    ) -> Ending:
        self._motion, self._stage, self._is_released = motion, TrialStage.PREPARING, False
        self._say(f"{label}: preparing")
        while motion.stage != "ended":
            self._note_presence()
            if self._end:
                self.cancel()
            elif inactive := self._inactive(nodes):
                self.cancel(inactive)
            if motion.stage == "ready" and self.stage is TrialStage.PREPARING:
                self._stage = TrialStage.READY
                self._call = f"{label}: hold the button, {duration:.1f} s"
                too_early = f"{label}: ready: let go, then hold the button"
                self._say(too_early if self._is_ignored else self._call)
            elif motion.stage == "moving" and self.stage in (
                TrialStage.PREPARING,
                TrialStage.READY,
            ):
                self._stage, self._ends_at = TrialStage.MOVING, time.monotonic() + duration
                self._say(f"{label}: moving")
            await asyncio.sleep(_LOOK_PERIOD)
        self._is_ignored |= self._is_held  # the next motion wants a press of its own
        self._is_held = False
        ending = motion.ending
        assert ending is not None
        return ending

    def _explain(self, ending: Ending, label: str) -> None:
        rest = "" if ending.is_at_rest else "; the joints were not seen to rest"
        if self._end:
            raise RunError(f"{self._end}{rest}")
        if not ending.reason.startswith(BUTTON_RELEASED) or rest:
            raise RunError(f"stopped: {self._why(ending)}{rest}")
        self._say(f"{label}: stopped: {self._why(ending)}; hold it once more", is_bad=True)

    def _require_wanted(self) -> None:
        """Go on only where nobody has ended the trial, and its page has control."""
        self._note_presence()
        if self._end:
            raise RunError(self._end)

    def _inactive(self, nodes: Sequence[str]) -> str:
        """Return which joint its controller does not control; empty if all do."""
        seen = self._session.controllers
        for node in nodes:
            if seen[node].lifecycle not in ("", "active"):
                return f"{self._session.label(node)} is {seen[node].lifecycle}: activate it first"
        return ""

    def _note_presence(self) -> None:
        """Cancel where another page has control, or the trial's own has been gone for a while."""
        control_lock, now = self._session.control_lock, time.monotonic()
        holder = control_lock.holder
        if holder == self._page:
            self._here_at = now
        elif holder is not None:
            self.cancel(f"ended: {control_lock.name(holder)} has taken control")
        elif now - self._here_at > _GONE_FOR:
            self.cancel(f"ended: its page has been gone for {_GONE_FOR:g} s")

    async def _set(self, number: int, variant: Variant, tried: Tried) -> None:
        """Have controllers take what is next; who wants a certificate may compute it first."""
        self._require_wanted()
        self._stage, self.number = TrialStage.PREPARING, number + 1
        label, wanted, seen = variant.label, tried.wanted(variant), self._session.controllers
        patience = _CERTIFIED_WITHIN if any(seen[n].requires_certificate for n in wanted) else 0.0
        for _ in range(1 + round(patience / _ASKED_EVERY)):
            if await self._session.send_if_other(wanted, f"{label}, for the trial"):
                tried.note(wanted)
                return
            self._require_wanted()
            if patience:
                await asyncio.sleep(_ASKED_EVERY)
        raise RunError(f"{label} was refused")

    def _why(self, ending: Ending) -> str:
        if ending.reason == BUTTON_RELEASED and not self._is_released:
            return (
                f"nothing was heard of the button for {self._within:g} s, page, network or "
                f"computer are slow (hpid live --button-timeout)"
            )
        return ending.reason

    def _say(self, text: str, *, is_bad: bool = False) -> None:
        self.said, self.is_bad = bounded(text), is_bad
        self._session.say(f"trial: {text}", is_bad=is_bad)

    def _forget(self) -> None:
        """Remove the recordings that nobody wanted to keep."""
        if self._folder is not None and not self._is_kept:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._folder = None

    def close(self) -> None:
        """Stop what is under way, and remove what nobody wanted to keep."""
        self.cancel()
        self._forget()


def _new_folder(*, is_kept: bool) -> Path:
    if not is_kept:
        return Path(tempfile.mkdtemp(prefix="hpid_live_"))
    folder = Path(f"live-{datetime.now():%Y%m%d-%H%M%S}").resolve()
    folder.mkdir()
    return folder
