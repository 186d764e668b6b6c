"""The bridge's parameters of drives, sensors and disturbances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from rclpy.node import Node
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.nodes.ros.parameters import read_only
from hpid_ros.simulation.columns import column_types, from_columns
from hpid_ros.simulation.drives import DriveSettings, Motor, Pwm
from hpid_ros.simulation.sensors import Homing
from hpid_ros.simulation.world.disturbances import Disturbances, PayloadChange, WrenchPulse, vector

Model = TypeVar("Model", Motor, Pwm, Homing)

_LONGEST = 1e5  # [s], of a schedule
_ARRAYS = {
    "float": Parameter.Type.DOUBLE_ARRAY,
    "int": Parameter.Type.INTEGER_ARRAY,
    "str": Parameter.Type.STRING_ARRAY,
}
MEANINGS = {
    "motor.torque_constant": "Torque constant and back EMF [N m/A]; 0 is an ideal motor",
    "motor.resistance": "Of the armature [ohm]",
    "motor.supply_voltage": "Largest voltage either way [V]",
    "motor.viscous_friction": "At the rotor [N m s/rad]",
    "motor.coulomb_friction": "At the rotor [N m]",
    "motor.gear_efficiency": "Of the gear, in (0, 1]",
    "motor.drive": "current: a current loop makes up for the back EMF; voltage: none does",
    "pwm.bits": "Resolution of the duty's magnitude; 0 is a bridge that gives any voltage",
    "pwm.dead_band": "Duties below it give nothing, in [0, 1)",
    "pwm.rate": "How often the duty is taken over [Hz]; 0 is with every physics step",
    "homing.speed": "Of the homing run [rad/s]; 0: the position at the start is known",
    "homing.position": "Where the Hall switch is [rad]",
    "homing.hysteresis": "Of the Hall switch [rad]",
    "effort_delay": "Control periods by which efforts act late",
    "position_noise": "Standard deviation of a position before it is measured [rad]",
    "velocity": "Velocities in joint_states: none, or differences of the measured positions",
    "payload_schedule.times": "When the payload changes [s]",
    "payload_schedule.masses": "To what [kg]",
    "wrench_schedule.links": "Links that are pushed",
    "wrench_schedule.starts": "From when [s]",
    "wrench_schedule.durations": "For how long [s]",
    "wrench_schedule.forces": "x, y, z of each in the world frame [N]",
    "wrench_schedule.torques": "x, y, z of each in the world frame [N m]",
}
"""Every parameter that is declared here, and what it is; docs/models.md has them all."""


def drives(node: Node, joints: Sequence[str]) -> tuple[DriveSettings, ...]:
    """Declare the parameters of the drives and return what they say.

    Args:
        node: The bridge.
        joints: The driven joints.

    Raises:
        SettingError: A value is out of range or missing.
    """
    count = len(joints)
    nothing = (None,) * count
    motors = _models(node, "motor", Motor, joints) or nothing
    pwms = _models(node, "pwm", Pwm, joints) or nothing
    delays = along(
        joints, "effort_delay", _array(node, "effort_delay", Parameter.Type.INTEGER_ARRAY)
    )
    each = zip(motors, pwms, delays or (0,) * count, strict=True)
    return tuple(DriveSettings(motor, pwm, delay) for motor, pwm, delay in each)


def homing(node: Node, joints: Sequence[str]) -> tuple[Homing | None, ...]:
    """Declare the parameters of the homing runs and return what they say.

    Raises:
        SettingError: A value is out of range or missing.
    """
    return _models(node, "homing", Homing, joints)


def position_noise(node: Node, joints: Sequence[str]) -> float | tuple[float, ...]:
    """Declare the parameter of the positions' noise and return it, in [rad].

    Raises:
        SettingError: There is not one entry for each joint.
    """
    values = _array(node, "position_noise", Parameter.Type.DOUBLE_ARRAY)
    return along(joints, "position_noise", values) or 0.0


def velocity(node: Node) -> str:
    """Declare the parameter of the measured velocities and return where they come from."""
    name = "velocity"
    return str(read_only(node, name, "none", MEANINGS[name]))


def disturbances(node: Node) -> Disturbances:
    """Declare the parameters of the schedule and return it.

    Raises:
        SettingError: Arrays that belong together differ in length, or a value is out of range.
    """
    doubles, texts = Parameter.Type.DOUBLE_ARRAY, Parameter.Type.STRING_ARRAY
    times, masses = _schedule(node, "payload_schedule", {"times": doubles, "masses": doubles})
    links, starts, durations, forces, torques = _schedule(
        node,
        "wrench_schedule",
        {
            "links": texts,
            "starts": doubles,
            "durations": doubles,
            "forces": doubles,
            "torques": doubles,
        },
        {"forces": 3, "torques": 3},
    )
    return Disturbances(
        tuple(PayloadChange(_ns(t), mass) for t, mass in zip(times, masses, strict=True)),
        tuple(
            WrenchPulse(
                link,
                vector("wrench_schedule.forces", forces[3 * index : 3 * index + 3]),
                vector("wrench_schedule.torques", torques[3 * index : 3 * index + 3]),
                _ns(start),
                max(1, _ns(duration)) if duration > 0.0 else 0,
            )
            for index, (link, start, duration) in enumerate(
                zip(links, starts, durations, strict=True)
            )
        ),
    )


def along(joints: Sequence[str], name: str, values: Any) -> tuple[Any, ...]:
    """Return the values of an optional array with one entry for each joint.

    Args:
        joints: The driven joints.
        name: Of the parameter.
        values: Of the parameter; None or empty when it was left out.

    Raises:
        SettingError: There is not one entry for each joint.
    """
    if not values:
        return ()
    if len(values) != len(joints):
        raise SettingError(
            f"{name} must have one entry for each of {len(joints)} driven joints, "
            f"not {len(values)}"
        )
    return tuple(values)


def _models(
    node: Node, prefix: str, kind: type[Model], joints: Sequence[str]
) -> tuple[Model | None, ...]:
    arrays = {}
    for name, kind_of_value in column_types(kind).items():
        arrays[name] = _array(node, f"{prefix}.{name}", _ARRAYS[kind_of_value])
    return from_columns(kind, arrays, joints)


def _array(node: Node, name: str, kind: Parameter.Type) -> list[Any]:
    """Declare an array that may be left out and return it, empty then."""
    is_of_joints = "schedule" not in name
    meaning = MEANINGS[name] + ("; one for each driven joint" if is_of_joints else "")
    return list(read_only(node, name, kind, meaning) or ())


def _schedule(
    node: Node,
    prefix: str,
    kinds: dict[str, Parameter.Type],
    widths: dict[str, int] | None = None,
) -> list[list[Any]]:
    """Return arrays of which each event has its part."""
    values = {name: _array(node, f"{prefix}.{name}", kind) for name, kind in kinds.items()}
    first, *_ = values
    for name, array in values.items():
        wanted = len(values[first]) * (widths or {}).get(name, 1)
        if len(array) != wanted:
            raise SettingError(
                f"{prefix}.{name} must have {wanted} entries, as {prefix}.{first} has "
                f"{len(values[first])}, not {len(array)}"
            )
    return list(values.values())


def _ns(seconds: float) -> int:
    """Return a time in [ns].

    Raises:
        SettingError: It is not a time of a schedule.
    """
    if not 0.0 <= seconds <= _LONGEST:
        raise SettingError(f"time {seconds} s of a schedule must lie in [0, {_LONGEST:g}] s")
    return round(seconds * NANOSECONDS)
