"""The PIDs of ros2_control's own controllers as parameters of joint loops.

joint_trajectory_controller has its gains under ``gains.JOINT``, pid_controller under
``gains.DOF``. What their PID does is done here by the parameter of the same meaning; what has
none is told, a line each.

Source: ros2_controllers, ``joint_trajectory_controller_parameters.yaml``, ``pid_controller.yaml``
and what reads them; control_toolbox, ``pid.cpp``; branches humble, jazzy and master of August
2026.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import controller_name
from hpid_ros.base.text import shown
from hpid_ros.control.settings import LONGEST_TIMEOUT, PARAMETERS, Value

_Kind = Literal["trajectory", "pid"]

_GAINS = "gains."
_TRAJECTORY = "JointTrajectoryController"  # of joint_trajectory_controller, and scaled ones
_PID = "PidController"
_MANAGER = "controller_manager"
_DEFAULT_RATE = 100.0  # [Hz] of controller_manager
_PERIODS_TO_TIMEOUT = 3.0
_NEGLIGIBLE = 1e-9  # [rad] of a dead band; theirs is 1e-16 by default

_KNOWN = frozenset(
    {
        "p",
        "i",
        "d",
        "i_clamp",
        "i_clamp_max",
        "i_clamp_min",
        "u_clamp_max",
        "u_clamp_min",
        "antiwindup",
        "antiwindup_strategy",
        "tracking_time_constant",
        "error_deadband",
        "ff_velocity_scale",
        "feedforward_gain",
        "angle_wraparound",
        "normalize_error",
        "save_i_term",
        "activate_state_publisher",
    }
)


class Pids(NamedTuple):
    """The PIDs of a file as joint loops."""

    nodes: dict[str, dict[str, Value]]  # parameters by the name of the joint's controller node
    remarks: tuple[str, ...]  # what has no counterpart, or another one, a line each


def pids_of(sections: Mapping[str, Mapping[str, Any]], where: str) -> Pids | None:
    """Return the PIDs of a parameter file's sections; None where it has no such controller.

    A file with a joint controller of this package is that one's.

    Args:
        sections: Parameters by full dotted name, of each node.
        where: What errors call the file.

    Raises:
        SettingError: None of its PIDs commands efforts, or a value is none of its parameter's.
    """
    types, rates = _managed(sections)
    if any(
        "joint" in own and section.rpartition("/")[2] not in types
        for section, own in sections.items()
    ):
        return None  # a joint controller's own
    remarks = _Remarks()
    nodes: dict[str, dict[str, Value]] = {}
    owners: dict[str, str] = {}
    is_any = False
    for section, own in sections.items():
        name = section.rpartition("/")[2]
        kind = _kind(own, types.get(name) or str(own.get("type", "")))
        if kind is None:
            continue
        is_any = True
        controller = _Controller(name, kind, own, f"{where}: {name}", remarks)
        for joint, values in controller.loops(rates):
            node = controller_name(joint)
            if nodes.setdefault(node, values) != values:
                raise SettingError(
                    f"{where}: {joint!r} has gains in {owners[joint]} and others in {section}: "
                    "leave one of them in the file"
                )
            owners.setdefault(joint, section)
    if not is_any:
        return None
    if not nodes:
        raise SettingError(
            f"{where} has no PID of ros2_control that commands efforts: "
            f"{'; '.join(remarks.lines())}"
        )
    return Pids(nodes, tuple(remarks.lines()))


def _managed(
    sections: Mapping[str, Mapping[str, Any]],
) -> tuple[dict[str, str], list[object]]:
    """Return the types of controllers by name, and the managers' rates."""
    types: dict[str, str] = {}
    rates: list[object] = []
    for section, own in sections.items():
        if section.rpartition("/")[2] != _MANAGER:
            continue
        if "update_rate" in own:
            rates.append(own["update_rate"])
        for key, value in own.items():
            name, _, last = key.rpartition(".")
            if last == "type":
                types[name] = str(value)
    return types, rates


def _kind(own: Mapping[str, Any], type_name: str) -> _Kind | None:
    """Return which of the two a controller is: by its type, else by what it has."""
    if type_name:
        last = type_name.rpartition("/")[2]
        if last.endswith(_TRAJECTORY):
            return "trajectory"
        return "pid" if last.endswith(_PID) else None
    if not any(key.startswith(_GAINS) for key in own):
        return None
    if "dof_names" in own:
        return "pid"
    return "trajectory" if "joints" in own else None


class _Remarks:
    """Lines about joints, those of one text together."""

    def __init__(self) -> None:
        self._joints: dict[tuple[str, str], dict[str, None]] = {}

    def add(self, controller: str, text: str, joint: str = "") -> None:
        joints = self._joints.setdefault((controller, text), {})
        if joint:
            joints[joint] = None

    def lines(self) -> Iterator[str]:
        for (controller, text), joints in self._joints.items():
            listed = ", ".join(map(shown, joints))
            yield f"{controller}: {listed}: {text}" if listed else f"{controller}: {text}"


class _Controller:
    """One controller's part of a file."""

    def __init__(
        self, name: str, kind: _Kind, own: Mapping[str, Any], where: str, remarks: _Remarks
    ) -> None:
        self._name, self._kind, self._own, self._where = name, kind, own, where
        self._remarks = remarks
        self._gains: dict[str, dict[str, Any]] = {}
        for key, value in own.items():
            joint, _, parameter = key.removeprefix(_GAINS).rpartition(".")
            if key.startswith(_GAINS) and joint:
                self._gains.setdefault(joint, {})[parameter] = value

    def _remark(self, text: str, joint: str = "") -> None:
        self._remarks.add(self._name, text, joint)

    def _rate(self, managed: Iterable[object]) -> float:
        """Return how often it computes, in [Hz]."""
        rates = [self._own["update_rate"]] if self._own.get("update_rate") else list(managed)
        if not rates:
            self._remark(
                f"no update_rate is given: {_DEFAULT_RATE:g} Hz, controller_manager's default"
            )
            return _DEFAULT_RATE
        rate = self._number({"update_rate": rates[0]}, "update_rate", 0.0)
        if not 0.0 < rate < math.inf:
            raise SettingError(f"{self._where}: update_rate must be positive, not {rate:g}")
        return rate

    def loops(self, rates: Iterable[object]) -> Iterator[tuple[str, dict[str, Value]]]:
        """Yield each joint's parameters, where its PID commands efforts on positions.

        ``rates`` are those of its manager.
        """
        if not self._commands_efforts():
            return
        timing = self._timing(1.0 / self._rate(rates))
        for joint in self._names("joints" if self._kind == "trajectory" else "dof_names"):
            if "$(" in joint:
                raise SettingError(
                    f"{self._where}: {shown(joint)} is a substitution of launch: give the file as "
                    "the controllers get it"
                )
            gains = self._gains.get(joint)
            if gains is None:
                self._remark("no gains, left out", joint)
                continue
            yield joint, {"joint": joint, **timing, **self._values(joint, gains)}
        if self._own.get("command_joints", self._own.get("joints")) != self._own.get("joints"):
            self._remark("command_joints has no counterpart: a loop reads and drives one joint")
        scaling = [key for key in self._own if key.startswith("speed_scaling")]
        if scaling:
            self._remark(f"{scaling[0]} has no counterpart: trajectories keep their own time")

    def _commands_efforts(self) -> bool:
        if self._kind == "pid":
            commands, states = self._own.get("command_interface"), self._states()
            if commands != "effort":
                self._remark(f"commands {shown(str(commands))}, not effort: left out")
            elif states[:1] != ["position"]:
                self._remark(f"controls {shown(', '.join(states))}, not position: left out")
            return commands == "effort" and states[:1] == ["position"]
        if "command_interfaces" not in self._own:
            self._remark("no command_interfaces are given: taken for effort")
            return True
        commands = self._names("command_interfaces")
        if commands == ["effort"]:
            return True
        listed = shown(", ".join(commands))
        if commands == ["velocity"]:
            self._remark("its PID commands velocity, not effort: left out")
        else:
            self._remark(f"commands {listed}, for which it uses no PID: left out")
        return False

    def _states(self) -> list[str]:
        return self._names("reference_and_state_interfaces")

    def _names(self, key: str) -> list[str]:
        names = self._own.get(key)
        if not isinstance(names, list) or not all(isinstance(each, str) for each in names):
            raise SettingError(f"{self._where}: {key} must be a list of names, not {names!r:.60}")
        return names

    def _timing(self, period: float) -> dict[str, Value]:
        timeout = float(PARAMETERS["state_timeout"].default)
        return {
            "law": "pid",
            "control_period": period,
            "state_timeout": min(max(timeout, _PERIODS_TO_TIMEOUT * period), LONGEST_TIMEOUT),
        }

    def _values(self, joint: str, gains: Mapping[str, Any]) -> dict[str, Value]:
        unknown = sorted(gains.keys() - _KNOWN)
        if unknown:
            self._remark(f"gains.JOINT.{shown(unknown[0])} is not known: passed over", joint)
        values: dict[str, Value] = {
            f"gains.{term}": self._number(gains, term, 0.0) for term in ("p", "i", "d")
        }
        for name in ("u_clamp_max", "u_clamp_min"):
            clamp = self._number(gains, name, math.inf)
            if math.isfinite(clamp):
                values[name] = clamp
        if values["gains.i"]:
            values |= self._integral(joint, gains)
        if not values["gains.i"] or values.get("i_clamp_max") == values.get("i_clamp_min") == 0.0:
            values["gains.i"] = 0.0
            values = {name: value for name, value in values.items() if "i_clamp" not in name}
        values |= self._feedforward(joint, gains)
        if gains.get("angle_wraparound") is True or gains.get("normalize_error") is True:
            values["angle_wraparound"] = True
            self._remark(
                "angle_wraparound takes the shorter way round to each new reference here, theirs "
                "at each sample",
                joint,
            )
        if gains.get("save_i_term") is True:
            self._remark(
                "save_i_term has no counterpart: no integral outlives a deactivation", joint
            )
        if self._kind == "pid" and len(self._states()) == 1:
            values |= {"velocity_source": "filtered", "velocity_filter_time_constant": 0.0}
            self._remark(
                "d acts on differences of the error: velocity_source is filtered, with a time "
                "constant of 0",
                joint,
            )
        return values

    def _integral(self, joint: str, gains: Mapping[str, Any]) -> dict[str, Value]:
        """Return what limits the integral, which is in N m as theirs."""
        values: dict[str, Value] = {}
        clamp = self._number(gains, "i_clamp", math.inf)
        upper = self._number(gains, "i_clamp_max", math.inf)
        lower = self._number(gains, "i_clamp_min", -math.inf)
        upper = upper if math.isfinite(upper) else clamp
        lower = lower if math.isfinite(lower) else -clamp
        if not {"i_clamp", "i_clamp_max", "i_clamp_min"} & gains.keys():
            self._remark(
                "no i_clamp is given: no limit, as from Jazzy on (in Humble it would be 0, which "
                "switches i off)",
                joint,
            )
        if upper == lower == 0.0:
            self._remark("i_clamp 0 holds the integral at 0: gains.i is taken as 0", joint)
        if math.isfinite(upper):
            values["i_clamp_max"] = upper
        if math.isfinite(lower):
            values["i_clamp_min"] = lower
        strategy = str(gains.get("antiwindup_strategy", "legacy"))
        if strategy == "legacy":
            strategy = "none"
            self._remark(
                "antiwindup_strategy legacy, their default until Jazzy, is none here: i_clamp "
                "holds the integral itself, with antiwindup and without",
                joint,
            )
        values["antiwindup_strategy"] = strategy
        if gains.get("tracking_time_constant"):
            values["tracking_time_constant"] = self._number(gains, "tracking_time_constant", 0.0)
        deadband = self._number(gains, "error_deadband", 0.0)
        if deadband > _NEGLIGIBLE:
            self._remark(
                f"error_deadband {deadband:g} has no counterpart: every error is integrated", joint
            )
        return values

    def _feedforward(self, joint: str, gains: Mapping[str, Any]) -> dict[str, Value]:
        """Return what is added for the reference's velocity."""
        name = "ff_velocity_scale" if self._kind == "trajectory" else "feedforward_gain"
        gain = self._number(gains, name, 0.0)
        if not gain:
            return {}
        if self._kind == "pid" and self._own.get("enable_feedforward") is not True:
            self._remark(
                f"{name} {gain:g} is not taken: enable_feedforward is not true (where there is no "
                "such parameter it acts)",
                joint,
            )
            return {}
        if self._kind == "pid" and len(self._states()) == 1:
            self._remark(f"{name} {gain:g} multiplies the position: it has no counterpart", joint)
            return {}
        if gain < 0.0:
            self._remark(f"{name} {gain:g} is negative: it has no counterpart", joint)
            return {}
        self._remark(f"{name} {gain:g} is feedforward.viscous_friction, in N m s/rad", joint)
        return {"feedforward.viscous_friction": gain}

    def _number(self, values: Mapping[str, Any], name: str, default: float) -> float:
        value = values.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SettingError(f"{self._where}: {name} must be a number, not {value!r:.60}")
        return float(value)
