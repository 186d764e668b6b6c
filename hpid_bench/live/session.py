"""One session of tuning: its controllers, who has control, and what is staged and applied.

All pages that are open show this one session; one of them has it in hand.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hpid_bench.live.advice import Advice, AdviceClient
from hpid_bench.live.history import JointHistory
from hpid_bench.live.known_controllers import Answer, Change, RunningController, Samples
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.text import bounded
from hpid_ros.base.yaml_files import parse_yaml
from hpid_ros.base.yaml_text import dump_yaml
from hpid_ros.control.parameter_files import parameters_in_file
from hpid_ros.control.settings import PARAMETERS, LoopSettings, Value

if TYPE_CHECKING:
    from hpid_bench.live.graph_client import GraphClient

GAINS = ("gains.p", "gains.i", "gains.d")
SLIDERS = (*GAINS, "mu", "norm.effort_scale")
"""The parameters that are turned most, each with a slider."""

BANDWIDTH = "bandwidth"
"""No parameter, but what turns the three gains at once: on an inertia the same loop, faster."""

_POWERS = {
    **{name: {name: 1} for name in GAINS},
    BANDWIDTH: {"gains.p": 2, "gains.i": 3, "gains.d": 1},
}
_LARGEST_FACTOR = 1000.0

_DEPTH = 100  # steps that can be undone
_TOLERANCE = 1e-12

Values = Mapping[str, Value]


class SliderRange(NamedTuple):
    """The ends of a slider."""

    low: float  # least value
    high: float  # largest value
    is_logarithmic: bool  # whether equal ways are equal factors


def slider_range(name: str, first: float, error_scale: float = 0.0) -> SliderRange:
    """Return a sensible range of a parameter.

    A gain goes from a tenth to ten times of where it stood at first. Beyond that there is its
    field, up to what the parameter allows.
    """
    if name == "mu":
        return SliderRange(-0.4999, 0.4999, is_logarithmic=False)
    centre = first if first > 0.0 else error_scale
    if centre <= 0.0:
        return SliderRange(0.0, 10.0, is_logarithmic=False)
    return SliderRange(0.1 * centre, 10.0 * centre, is_logarithmic=True)


def same(one: Value, other: Value) -> bool:
    """Return whether two values of a parameter are one."""
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_TOLERANCE)
    return one == other


def changed_values(before: Values, after: Values) -> dict[str, Value]:
    """Return what is other in the second, of the names that it has."""
    return {
        name: value
        for name, value in after.items()
        if name not in before or not same(before[name], value)
    }


@dataclass(frozen=True)
class TuningStep:
    """One thing that a person did: what it set on which controllers, and what was there."""

    what: str  # in words
    before: Mapping[str, Values]  # values that it replaced, by node and name
    after: Mapping[str, Values]  # values that it set, likewise


@dataclass
class Tuning:
    """What a person has staged, done and kept.

    Nothing here reaches a robot: :meth:`staged_sets`, :meth:`undoing` and :meth:`towards` return
    sets of parameters by node, which somebody sends.
    """

    first: dict[str, dict[str, Value]] = field(default_factory=dict)
    in_force: dict[str, dict[str, Value]] = field(default_factory=dict)
    staged: dict[str, dict[str, Value]] = field(default_factory=dict)
    snapshots: dict[str, dict[str, Values]] = field(default_factory=dict)
    done: deque[TuningStep] = field(default_factory=lambda: deque(maxlen=_DEPTH))

    def see(self, node: str, values: Values) -> None:
        """Take note of what is active on a controller.

        What was staged and is active now, whoever set it, is staged no more.
        """
        self.first.setdefault(node, dict(values))
        self.in_force[node] = dict(values)
        if node in self.staged:
            self.staged[node] = changed_values(values, self.staged[node])

    def value(self, node: str, name: str) -> Value:
        """Return a parameter as it is chosen: staged, or active."""
        staged = self.staged.get(node, {})
        return staged[name] if name in staged else self.in_force[node][name]

    def stage(self, nodes: Sequence[str], name: str, value: object) -> None:
        """Choose a value for controllers; what is active already is not staged."""
        checked = PARAMETERS[name].checked(value)
        for node in nodes:
            chosen = {**self.staged.get(node, {}), name: checked}
            self.staged[node] = changed_values(self.in_force[node], chosen)

    def stage_factor(self, nodes: Sequence[str], name: str, factor: float) -> None:
        """Choose so many times what is active, on each controller its own."""
        if not 0.0 < factor <= _LARGEST_FACTOR:
            raise SettingError(
                f"a factor must be positive and at most {_LARGEST_FACTOR:g}, not {factor:g}"
            )
        products = [
            (
                node,
                gain,
                PARAMETERS[gain].checked(factor**power * float(self.in_force[node][gain])),
            )
            for node in nodes
            for gain, power in _POWERS[name].items()
        ]
        for node, gain, product in products:
            self.stage([node], gain, product)

    def factor(self, node: str, name: str) -> float | None:
        """Return how many times what is active is chosen; None where that is no one number."""
        in_force = self.in_force[node]
        factors = [
            (float(self.value(node, gain)) / float(in_force[gain])) ** (1.0 / power)
            for gain, power in _POWERS[name].items()
            if float(in_force[gain]) > 0.0
        ]
        alike = all(math.isclose(each, factors[0], rel_tol=_TOLERANCE) for each in factors)
        return factors[0] if factors and alike else None

    def unstage(self, nodes: Sequence[str] = ()) -> None:
        """Forget what is staged, on these controllers or on all."""
        for node in nodes or list(self.staged):
            self.staged.pop(node, None)

    def chosen(self, node: str) -> dict[str, Value]:
        """Return all values of a controller as they would be."""
        return {**self.in_force[node], **self.staged.get(node, {})}

    def objection(self, node: str) -> str:
        """Return why a controller would refuse what is staged, in one line; empty if nothing is.

        The controller itself decides; it also knows its certificate.
        """
        try:
            LoopSettings.from_parameters(self.chosen(node))
        except HpidError as error:
            return str(error)
        return ""

    def staged_sets(self, nodes: Sequence[str]) -> dict[str, Values]:
        """Return what is staged by node, of those where something is."""
        return {node: dict(self.staged[node]) for node in nodes if self.staged.get(node)}

    def note(self, what: str, taken: Mapping[str, Values], before: Mapping[str, Values]) -> None:
        """Take note of sets that controllers took."""
        if taken:
            kept = {node: {name: before[node][name] for name in taken[node]} for node in taken}
            self.done.append(TuningStep(what, kept, taken))

    def undoing(self) -> dict[str, Values]:
        """Return the sets that take the newest step back, without what somebody changed since."""
        if not self.done:
            raise SettingError("there is nothing to undo")
        step = self.done[-1]
        sets: dict[str, Values] = {}
        for node, after in step.after.items():
            now = self.in_force[node]
            own = {n: step.before[node][n] for n, v in after.items() if same(now[n], v)}
            if own:
                sets[node] = own
        if not sets:
            self.done.pop()
            raise SettingError(f"somebody has changed what “{step.what}” set: it is not undone")
        return sets

    def starts(self, nodes: Sequence[str]) -> dict[str, Values]:
        """Return what controllers had when they were first seen."""
        return {node: self.first[node] for node in nodes}

    def keep(self, name: str, nodes: Sequence[str]) -> str:
        """Keep what is active on controllers under a name, and return that."""
        name = name.strip()
        if not name:
            raise SettingError("a snapshot needs a name")
        self.snapshots[name] = {node: dict(self.in_force[node]) for node in nodes}
        return name

    def towards(self, values: Mapping[str, Values]) -> dict[str, Values]:
        """Return the sets after which controllers have these values."""
        found = {
            node: changed_values(self.in_force.get(node, wanted), wanted)
            for node, wanted in values.items()
        }
        return {node: other for node, other in found.items() if other}

    def stage_loops(self, loops: Mapping[str, Values]) -> list[str]:
        """Stage what a parameter file says, joint by joint, and nothing else."""
        found = []
        for node, values in self.in_force.items():
            full_or_own = node, node.rpartition("/")[2]
            own = [each for name, each in loops.items() if name in full_or_own]
            # By its joint, unless a section names a node in another namespace.
            anywhere = [each for name, each in loops.items() if "/" not in name.lstrip("/")]
            own = own or [each for each in anywhere if each["joint"] == values["joint"]]
            if own:
                wanted = {**own[0], "joint": values["joint"]}
                self.staged[node] = changed_values(values, wanted)
                found.append(node)
        if not found:
            names = ", ".join(loops) or "none"
            raise SettingError(f"no controller of this file is here; it has {names}")
        return sorted(found)


_AT_REST = ("inactive", "unconfigured", "finalized")  # lifecycle of what drives nothing


class Limit:
    """At most so many acts in so much time."""

    def __init__(
        self, most: int, within: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._most, self._within, self._clock = most, within, clock
        self._acts: deque[float] = deque(maxlen=most)

    def allows(self) -> bool:
        """Return whether one more act is allowed now, and count it if so."""
        now = self._clock()
        if len(self._acts) == self._most and now - self._acts[0] < self._within:
            return False
        self._acts.append(now)
        return True


class ControlLock:
    """One page at a time has the controllers in hand; the others look on.

    The first one has it. Another gets it when a person takes it there. A page that was cut off for
    a moment gets it back, if nobody has taken it meanwhile. Stopping is everybody's.
    """

    def __init__(self) -> None:
        self.holder: str | None = None  # None if no page is open, or the one that had it is gone
        self._pages: Counter[str] = Counter()
        self._last: str | None = None
        self._names: dict[str, str] = {}

    @property
    def pages(self) -> int:
        return len(self._pages)

    def name(self, page: str) -> str:
        """Return what a page is called: the number in which it came, and the address it is at."""
        return self._names.get(page, "another page")

    def join(self, page: str, address: str = "") -> None:
        """Let a page look on; it has control if no other page is there, or if it had it last.

        A page that was cut off may join once more before it has left.
        """
        at = f" at {address}" if address else ""
        self._names.setdefault(page, f"page {len(self._names) + 1}{at}")
        self._pages[page] += 1
        if len(self._pages) == 1 or (self.holder is None and self._last == page):
            self.holder = self._last = page

    def take(self, page: str) -> None:
        """Give control to a page whose person asked for it."""
        if page in self._pages:
            self.holder = self._last = page

    def leave(self, page: str) -> None:
        """Forget a page that has left as often as it has joined; nobody has control then."""
        self._pages -= Counter([page])
        if self.holder not in self._pages:
            self.holder = None


_SETS, _SETS_WITHIN = 5, 1.0  # acts of a person in [s]
_LINES = 200  # of the log


class LogLine(NamedTuple):
    at: float  # [s] wall time
    text: str  # one line
    is_bad: bool = False  # whether something was refused, or has failed


class LiveSession:
    def __init__(self, graph: GraphClient, advice: AdviceClient) -> None:
        self.graph = graph
        self.tuning = Tuning()
        self.control_lock = ControlLock()
        self.log: deque[LogLine] = deque(maxlen=_LINES)
        self.said = 0
        self._advice = advice
        self._histories: dict[str, JointHistory] = {}
        self._known: dict[tuple[str, bool], tuple[Values, Advice]] = {}
        self._asked: dict[tuple[str, bool], Values] = {}
        self._limit = Limit(_SETS, _SETS_WITHIN)
        self._acting = asyncio.Lock()  # what one act replaces is what the one before it has set
        self._here: dict[str, bool] = {}
        self._watched: tuple[str, ...] = ()

    # What is seen

    @property
    def controllers(self) -> Mapping[str, RunningController]:
        return self.graph.controllers()

    def label(self, node: str) -> str:
        """Return what people call a controller: its joint, with the namespace where it has one.

        In one line, however its joint is named.
        """
        seen = self.controllers[node]
        space = seen.namespace.strip("/")
        return name_shown(f"{space}/{seen.joint}" if space else seen.joint)

    def history(self, node: str) -> JointHistory:
        """Return the samples of a controller's joint."""
        if node not in self._histories:
            self._histories[node] = JointHistory(self.controllers[node].settings)
        return self._histories[node]

    def pulse(
        self, is_seen: bool = True, samples: Mapping[str, Samples] | None = None
    ) -> tuple[dict[str, dict[str, list[float]]], list[Change]]:
        """Take what is new, and return what is to be drawn: curves by node and signal, changes."""
        seen = self.controllers
        self._note_arrivals(seen)
        watched = tuple(node for node, each in seen.items() if each.is_here) if is_seen else ()
        if watched != self._watched:
            for node in set(watched) - set(self._watched):  # its clock starts again
                self._histories.pop(node, None)
            self._watched = watched
            self.graph.watch(watched)
        for node, controller in seen.items():
            self.tuning.see(node, controller.values)
            self.history(node).retune(controller.settings)
        changes = [each for each in self.graph.changes() if each.node in seen]
        for change in changes:
            self.say(f"{self.label(change.node)}: {values_line(change.values)}")
        for node, each in (self.graph.take() if samples is None else samples).items():
            if node in seen:
                self.history(node).append(each)
        return {node: self.history(node).drawn() for node in watched}, changes

    def _note_arrivals(self, seen: Mapping[str, RunningController]) -> None:
        for node, each in seen.items():
            if self._here.get(node) == each.is_here:
                continue
            if each.is_here:
                self.say(f"{self.label(node)}: {'back' if node in self._here else 'found'}")
            else:
                self.say(f"{self.label(node)}: its controller has gone", is_bad=True)
            self._here[node] = each.is_here

    def say(self, text: str, *, is_bad: bool = False) -> None:
        self.said += 1
        self.log.append(LogLine(time.time(), bounded(text), is_bad))

    # What mathematics says

    def advice(self, node: str, step: float, *, is_staged: bool) -> tuple[Advice | None, bool]:
        """Return what is known of a controller's settings, and ask if that is of other ones."""
        tuning = self.tuning
        values = tuning.chosen(node) if is_staged else tuning.in_force[node]
        asked = {**values, "": step}
        about = (node, is_staged)
        known = self._known.get(about)
        if known is not None and known[0] == asked:
            return known[1], True
        if self._asked.get(about) != asked:
            self._asked[about] = asked
            self._advice.ask(
                about, values, step, lambda advice: self._known.update({about: (asked, advice)})
            )
        return (known[1] if known else None), False

    # What a person does

    async def apply(self, nodes: Sequence[str], what: str = "") -> bool:
        """Send what is staged, as one set for each controller, and all or none of them."""
        async with self._acting:
            sets = self.tuning.staged_sets([node for node in nodes if self._here.get(node)])
            for node in sets:
                objection = self.tuning.objection(node)
                if objection:
                    self.say(f"{self.label(node)}: not sent: {objection}", is_bad=True)
                    return False
            if not sets:
                self.say("nothing is staged for a controller that is here")
                return False
            return await self._send(sets, what or _summary(sets))

    async def _send(self, sets: Mapping[str, Values], what: str, *, is_kept: bool = True) -> bool:
        """Have controllers take sets. Where one does not, the others get theirs back."""
        if not self._limit.allows():
            self.say(f"{what}: not sent: at most {_SETS} a second", is_bad=True)
            return False
        before = {node: dict(self.tuning.in_force[node]) for node in sets}
        answers = await self._asked_all(sets)
        refused = {node: each.reason for node, each in answers.items() if not each.is_taken}
        if not refused:
            for node, values in sets.items():
                self.tuning.see(node, {**self.tuning.in_force[node], **values})
            if is_kept:
                self.tuning.note(what, sets, before)
            return True
        for node, reason in refused.items():
            self.say(f"{self.label(node)} refused: {reason}", is_bad=True)
        await self._set_back(sets, answers, before)
        return False

    async def _set_back(
        self,
        sets: Mapping[str, Values],
        answers: Mapping[str, Answer],
        before: Mapping[str, Values],
    ) -> None:
        """Give those that took their sets, or may yet take them, what they had.

        What somebody else has set meanwhile stays.
        """
        back = {}
        for node, answer in answers.items():
            if answer.is_taken or not answer.is_certain:
                now, old = self.controllers[node].values, before[node]
                back[node] = {
                    name: old[name]
                    for name, new in sets[node].items()
                    if same(now[name], new) or same(now[name], old[name])
                }
        await self._give_back(back, "because not every one took it")

    async def give_back(self, values: Mapping[str, Values], why: str) -> bool:
        """Have controllers take what they had, each for itself, whatever the others do."""
        async with self._acting:
            before = {node: dict(self.tuning.in_force[node]) for node in values}
            taken = await self._give_back(values, why)
            self.tuning.note(f"back {why}", taken, before)
            return all(node in taken for node, each in values.items() if each)

    async def _give_back(self, values: Mapping[str, Values], why: str) -> dict[str, Values]:
        """Return what was taken."""
        sets = {node: each for node, each in values.items() if each}
        here = {node: each for node, each in sets.items() if self.controllers[node].is_here}
        answers = dict.fromkeys(sets, Answer(False, "its controller has gone"))
        answers |= await self._asked_all(here)
        for node, answer in answers.items():
            if answer.is_taken:
                self.tuning.see(node, {**self.tuning.in_force[node], **sets[node]})
                self.say(f"{self.label(node)}: restored, {why}")
            else:
                self.say(f"{self.label(node)}: NOT restored: {answer.reason}", is_bad=True)
        return {node: each for node, each in sets.items() if answers[node].is_taken}

    async def _asked_all(self, sets: Mapping[str, Values]) -> dict[str, Answer]:
        futures = [asyncio.wrap_future(self.graph.set(node, each)) for node, each in sets.items()]
        return dict(zip(sets, await asyncio.gather(*futures), strict=True))

    async def undo(self) -> bool:
        async with self._acting:
            try:
                undone = self.tuning.undoing()
            except SettingError as error:
                self.say(str(error), is_bad=True)
                return False
            what = self.tuning.done[-1].what
            sets = {node: each for node, each in undone.items() if self._here.get(node)}
            if sets and not await self._send(sets, f"undo: {what}", is_kept=False):
                return False
            self.tuning.done.pop()
            if sets:
                self.say(f"undone: {what}")
            else:
                self.say(f"{what}: not undone: its controllers have gone", is_bad=True)
            return bool(sets)

    async def restore(self, values: Mapping[str, Values], what: str) -> bool:
        """Have the controllers that are here take values that they had."""
        async with self._acting:
            here = {node: each for node, each in values.items() if self._here.get(node)}
            sets = self.tuning.towards(here)
            if not sets:
                self.say(f"{what}: nothing differs")
                return True
            return await self._send(sets, what)

    async def send_if_other(self, values: Mapping[str, Values], what: str) -> bool:
        """Have controllers take these values, where they have others."""
        async with self._acting:
            sets = self.tuning.towards(values)
            return not sets or await self._send(sets, what)

    def take_control(self, page: str) -> None:
        """Give control to a page whose person asked for it, and say who had it."""
        lock, before = self.control_lock, self.control_lock.holder
        lock.take(page)
        if lock.holder == page != before:
            of = "" if before is None else f" from {lock.name(before)}"
            self.say(f"{lock.name(page)} has taken control{of}")

    async def stop(self, by: str = "") -> bool:
        """Deactivate every controller that is shown: each joint is left as its ``stop`` says."""
        seen = self.controllers
        nodes = [node for node, each in seen.items() if each.is_here]
        self.say(f"STOP{by}: deactivating {len(nodes)} controllers", is_bad=True)
        gone = {node: each for node, each in seen.items() if not each.is_here}
        lost = [node for node, each in gone.items() if each.lifecycle not in _AT_REST]
        for node in lost:
            text = "NOT stopped: out of reach, or its process has ended"
            self.say(f"{self.label(node)}: {text}", is_bad=True)
        return await self.transit(nodes, "deactivate") and not lost

    async def transit(self, nodes: Iterable[str], transition: str) -> bool:
        asked = {node: self.graph.change_state(node, transition) for node in nodes}
        futures = [asyncio.wrap_future(each) for each in asked.values()]
        answers = dict(zip(asked, await asyncio.gather(*futures), strict=True))
        for node, answer in answers.items():
            if answer.is_taken:
                self.say(f"{self.label(node)}: {transition}d")
            else:
                self.say(f"{self.label(node)}: not {transition}d: {answer.reason}", is_bad=True)
        return all(answer.is_taken for answer in answers.values())

    # Files

    def document(self) -> str:
        """Return what is active as a ROS parameter file, in YAML."""
        sections = {
            node: {"ros__parameters": self.tuning.in_force[node]}
            for node, each in self.controllers.items()
            if each.is_here
        }
        return dump_yaml(sections)

    def load(self, text: str, name: str) -> list[str]:
        """Stage what a parameter file says."""
        name = Path(name).name
        content = parse_yaml(name, text, SettingError)
        nodes = self.tuning.stage_loops(parameters_in_file(content, name))
        self.say(f"{name}: staged for {', '.join(map(self.label, nodes))}")
        return nodes


_LONGEST_NAME = 60  # characters


def name_shown(name: str) -> str:
    """Return a name that somebody else chose as it is shown: in one line, and not a long one."""
    return bounded(name, _LONGEST_NAME)


def values_line(values: Values) -> str:
    """Return parameters with their values in a line."""
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in values.items()
    )


def _summary(sets: Mapping[str, Values]) -> str:
    names = list(dict.fromkeys(name for each in sets.values() for name in each))
    of = f" on {len(sets)} joints" if len(sets) > 1 else ""
    return f"{', '.join(names)}{of}"
