"""Parameters that a person has in hand: staged, taken, undone, kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.control.settings import PARAMETERS, LoopSettings, Value

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

_DECADES = 1.0  # of a gain's slider to either side of where it stood at first
_NONE = 1e6  # of a limit
_DEPTH = 100  # steps that can be undone
_TOLERANCE = 1e-12

Values = Mapping[str, Value]


class Range(NamedTuple):
    """The ends of a slider."""

    low: float  # least value
    high: float  # largest value
    is_logarithmic: bool  # whether equal ways are equal factors


def slider_range(name: str, first: float, error_scale: float = 0.0) -> Range:
    """Return a sensible range of a parameter.

    A gain goes from a tenth to ten times of where it stood at first. Beyond that there is its
    field, up to what the parameter allows.
    """
    if name == "mu":
        return Range(-0.4999, 0.4999, is_logarithmic=False)
    centre = first if first > 0.0 else error_scale
    if centre <= 0.0:
        return Range(0.0, 10.0, is_logarithmic=False)
    return Range(centre * 10.0**-_DECADES, centre * 10.0**_DECADES, is_logarithmic=True)


def same(one: Value, other: Value) -> bool:
    """Return whether two values of a parameter are one."""
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=_TOLERANCE)
    return one == other


def differences(before: Values, after: Values) -> dict[str, Value]:
    """Return what is other in the second, of the names that it has."""
    return {
        name: value
        for name, value in after.items()
        if name not in before or not same(before[name], value)
    }


@dataclass(frozen=True)
class Step:
    """One thing that a person did: what it set on which controllers, and what was there."""

    what: str  # in words
    before: Mapping[str, Values]  # values that it replaced, by node and name
    after: Mapping[str, Values]  # values that it set, likewise


@dataclass
class Tuning:
    """What a person has staged, done and kept.

    Nothing here reaches a robot: :meth:`staged_sets`, :meth:`undoing` and the others return sets
    of parameters by node, which somebody sends.
    """

    first: dict[str, dict[str, Value]] = field(default_factory=dict)
    in_force: dict[str, dict[str, Value]] = field(default_factory=dict)
    staged: dict[str, dict[str, Value]] = field(default_factory=dict)
    snapshots: dict[str, dict[str, Values]] = field(default_factory=dict)
    done: list[Step] = field(default_factory=list)

    def see(self, node: str, values: Values) -> None:
        """Take note of what is active on a controller.

        What was staged and is active now, whoever set it, is staged no more.
        """
        self.first.setdefault(node, dict(values))
        self.in_force[node] = dict(values)
        if node in self.staged:
            self.staged[node] = differences(values, self.staged[node])

    def value(self, node: str, name: str) -> Value:
        """Return a parameter as it is chosen: staged, or active."""
        staged = self.staged.get(node, {})
        return staged[name] if name in staged else self.in_force[node][name]

    def stage(self, nodes: Sequence[str], name: str, value: object) -> None:
        """Choose a value for controllers; what is active already is not staged."""
        checked = _checked(name, value)
        for node in nodes:
            chosen = {**self.staged.get(node, {}), name: checked}
            self.staged[node] = differences(self.in_force[node], chosen)

    def stage_factor(self, nodes: Sequence[str], name: str, factor: float) -> None:
        """Choose so many times what is active, on each controller its own."""
        if not 0.0 < factor <= _LARGEST_FACTOR:
            raise SettingError(
                f"a factor must be positive and at most {_LARGEST_FACTOR:g}, not {factor:g}"
            )
        products = [
            (node, gain, _checked(gain, factor**power * float(self.in_force[node][gain])))
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
        if not taken:
            return
        kept = {node: {name: before[node][name] for name in taken[node]} for node in taken}
        self.done = [*self.done, Step(what, kept, taken)][-_DEPTH:]

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
            self.done = self.done[:-1]
            raise SettingError(f"somebody has changed what “{step.what}” set: it is not undone")
        return sets

    def undone(self) -> None:
        """Forget the newest step: it has been taken back."""
        self.done = self.done[:-1]

    def reverting(self, nodes: Sequence[str]) -> dict[str, Values]:
        """Return the sets after which controllers are as they were first seen."""
        return self._towards({node: self.first[node] for node in nodes})

    def keep(self, name: str, nodes: Sequence[str]) -> str:
        """Keep what is active on controllers under a name, and return that."""
        name = name.strip()
        if not name:
            raise SettingError("a snapshot needs a name")
        self.snapshots[name] = {node: dict(self.in_force[node]) for node in nodes}
        return name

    def returning(self, name: str) -> dict[str, Values]:
        """Return the sets after which controllers are as in a snapshot."""
        return self._towards(self.snapshots[name])

    def _towards(self, values: Mapping[str, Values]) -> dict[str, Values]:
        found: dict[str, Values] = {}
        for node, wanted in values.items():
            other = differences(self.in_force.get(node, wanted), wanted)
            if other:
                found[node] = other
        return found

    def document(self, nodes: Sequence[str]) -> dict[str, Any]:
        """Return what is active as a ROS parameter file has it."""
        return {node: {"ros__parameters": dict(self.in_force[node])} for node in nodes}

    def stage_loops(self, loops: Mapping[str, LoopSettings]) -> list[str]:
        """Stage what a parameter file says, joint by joint."""
        found = {}
        for node, values in self.in_force.items():
            own = [each for name, each in loops.items() if _is_of(name, node)]
            own = own or [each for each in loops.values() if each.joint == values["joint"]]
            if own:
                found[node] = own[0].to_parameters()
        if not found:
            names = ", ".join(loops) or "none"
            raise SettingError(f"no controller of this file is here; it has {names}")
        for node, wanted in found.items():
            self.staged[node] = differences(self.in_force[node], _without_joint(wanted))
        return sorted(found)


def _is_of(name: str, node: str) -> bool:
    return name in (node, node.rpartition("/")[2])


def _without_joint(values: Values) -> dict[str, Value]:
    return {name: value for name, value in values.items() if name != "joint"}


def _checked(name: str, value: object) -> Value:
    spec = PARAMETERS[name]
    if isinstance(value, int) and isinstance(spec.default, float) and not isinstance(value, bool):
        value = float(value)
    return spec.checked(value)
