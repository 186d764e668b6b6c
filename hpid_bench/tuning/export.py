"""A joint's loop in C99, with golden vectors; several in a plugin of ros2_control, certified."""

from __future__ import annotations

import hashlib
import json
import math
import random
import re
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from ctypes import c_float
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hpid_bench.tuning.replay import AskedReference
from hpid_ros import __version__
from hpid_ros.base.errors import HpidError, SettingError
from hpid_ros.base.names import node_word
from hpid_ros.base.units import NANOSECONDS
from hpid_ros.base.yaml_text import dump_yaml, inline_yaml
from hpid_ros.control.joint_loop import JointLoop
from hpid_ros.control.norms import NORMS
from hpid_ros.control.reference import (
    GRACE_NS,
    LARGEST_POSITION,
    LATCHED_WITHIN,
    LONGEST_WAIT,
)
from hpid_ros.control.settings import (
    LARGEST_MOTION,
    LEAST_WRAP,
    LOOP_PARAMETERS,
    PARAMETERS,
    LoopSettings,
    Value,
)
from hpid_ros.control.sources import SOURCE_RULE
from hpid_ros.stability.gain_boxes import GainRange
from hpid_ros.stability.gain_check import CERTIFICATES

_NORMS_IN_C = [norm for norm in NORMS.values() if norm.c_function]

_CHOICES: Mapping[str, tuple[str, ...]] = {
    "law": ("hpid", "pid"),
    "norm.type": tuple(norm.type for norm in _NORMS_IN_C),
    "discretization": ("explicit", "semi_implicit"),
    "antiwindup_strategy": ("none", "conditional_integration", "back_calculation"),
    "velocity_source": ("measured", "filtered", "homogeneous_differentiator"),
}
"""What the C code can do of what a parameter may say, in the order of its enumerators."""

_EXPORTED = (
    "law",
    "gains.p",
    "gains.i",
    "gains.d",
    "mu",
    "norm.type",
    "norm.error_scale",
    "norm.rate_weight",
    "norm.effort_scale",
    "norm.floor",
    "norm.cap",
    "u_clamp_max",
    "u_clamp_min",
    "i_clamp_max",
    "i_clamp_min",
    "antiwindup_strategy",
    "tracking_time_constant",
    "velocity_source",
    "velocity_filter_time_constant",
    "acceleration_bound",
    "discretization",
    "encoder_wrap",
    "angle_wraparound",
    "multi_turn",
    "position_step_max",
    "effort_rate_max",
    "position_max",
    "position_min",
    "velocity_max",
    "soft_stop.margin",
    "soft_stop.k_position",
    "soft_stop.k_velocity",
    "takeover_time",
    "fallback_effort",
    "state_timeout",
    "control_period",
    "encoder_resolution",
    "inertia",
)
_NUMBERS = tuple(n for n in _EXPORTED if isinstance(LOOP_PARAMETERS[n].default, float))
_TIMES = ("state_timeout", "control_period")  # compared with some slack in single precision

_OF_THE_NODE = {"joint", "state_clock"}
"""What a loop's node looks at: its name, and whether a silence may be a pause."""

_IN_C = {
    "encoder_wrap": "Range after which the reported position wraps [rad], such as 2 pi for "
    "(-pi, pi] or [0, 2 pi); 0 and -1 never"
}
"""What is said differently of parameters whose meaning in ROS has to do with its surroundings."""


class Field(NamedTuple):
    """One parameter as a member of the settings in C."""

    parameter: str  # its dotted name
    description: str  # what it is, with unit and range
    choices: tuple[str, ...] = ()  # what a text may say; empty for numbers and flags
    range: tuple[float, float] | None = None  # least and largest number; None for texts and flags

    @property
    def name(self) -> str:
        return self.parameter.replace(".", "_")

    def enumerator(self, prefix: str, choice: str) -> str:
        return f"{prefix}_{self.name}_{choice}".upper()


def _field(parameter: str) -> Field:
    spec = LOOP_PARAMETERS[parameter]
    text = _IN_C.get(parameter, spec.description)
    if parameter not in _NUMBERS:
        return Field(parameter, text, _CHOICES.get(parameter, ()))
    ends = spec.minimum, spec.maximum
    return Field(parameter, f"{text} ({ends[0]:g} to {ends[1]:g})", range=ends)


FIELDS = tuple(map(_field, _EXPORTED))
"""The members of the settings in C, in their order."""


def exported_values(settings: LoopSettings) -> dict[str, Value]:
    """Return the settings' values by parameter, of those that the C code has."""
    values = settings.to_parameters()
    for name, value in values.items():
        if name in _OF_THE_NODE:
            continue
        known = _CHOICES.get(name)
        if known is not None and value not in known:
            raise SettingError(
                f"{settings.joint}: {name} {value} is not exported to C, only {', '.join(known)}"
            )
        if name not in _EXPORTED and value != PARAMETERS[name].default:
            raise SettingError(
                f"{settings.joint}: {name} = {value} cannot be exported: the loop in C has no "
                f"{name.partition('.')[0]}; export the joint without it"
            )
    return {field.parameter: values[field.parameter] for field in FIELDS}


def in_single(settings: LoopSettings) -> LoopSettings:
    """Return settings with the numbers rounded to single precision, but for two times."""
    values = settings.to_parameters()
    for name in _NUMBERS:
        value = values[name]
        if name in _TIMES or value == PARAMETERS[name].default:  # which some of them must have
            continue
        values[name] = c_float(float(value)).value
        if value and not values[name]:
            raise SettingError(f"{settings.joint}: {name} = {value:g} is 0 in single precision")
    try:
        return LoopSettings.from_parameters(values)
    except HpidError as error:
        raise SettingError(f"{settings.joint}: in single precision {error}") from None


_ROWS = 1000
_RETUNE_AT = 520
_LARGEST_SWING = 0.3  # [rad]
_SAFETY = 300.0
_PRECISIONS = 2.0**29  # a last place in single precision, in those of double precision


class GivenLoop:
    """Python's loop, called as the exported one: with the reference of each state."""

    def __init__(self, settings: LoopSettings) -> None:
        self.loop = JointLoop(settings)
        self._reference = AskedReference({})
        self.loop.follow(self._reference)

    def step(
        self, stamp_ns: int, reference: float, rate: float, position: float, velocity: float | None
    ) -> float:
        """Return the effort that answers a state, in [N m].

        A reference that is no joint's makes the state one that cannot be used: Python's motions
        have none, they are checked before.
        """
        self._reference.samples.clear()
        self._reference.samples[stamp_ns] = reference, rate
        if not self._reference.is_usable(stamp_ns):
            return self.loop.reject(stamp_ns, f"reference {reference} rad, {rate} rad/s")
        return self.loop.step(stamp_ns, position, velocity)


class GoldenRow(NamedTuple):
    """One state, and what Python's loop answers."""

    stamp_ns: int  # [ns]
    reference: float  # [rad] where the joint should be
    rate: float  # [rad/s] how fast
    position: float  # [rad] measured
    velocity: float | None  # [rad/s] measured; None where it is not
    effort: float  # [N m] the answer


@dataclass(frozen=True)
class Golden:
    """Golden vectors of one loop."""

    rows: tuple[GoldenRow, ...]  # the states, in their order
    retune_at: int  # before this row the loop is retuned, its gains first, then its degree
    retuned: LoopSettings  # to these settings
    double_tolerance: float  # [N m]
    single_tolerance: float  # [N m] in single precision


def golden_vectors(settings: LoopSettings) -> Golden:
    """Return states that bring a loop into all that it does, with Python's answers.

    A swing about a resting position, with an error that decays over five decades; among the
    states are those of :func:`_disturbed`. They are the same for the same settings.

    What may deviate is measured: three hundred times what it changes to round every setting
    and every number of a state to the precision, and the efforts themselves. Of 2000 random
    loops in single precision none deviated by more than 0.4 of it.
    """
    settings = settings.with_parameters({"state_clock": "wall"})  # an exported loop has no other
    states, retuned = _disturbed(settings), _retuned(settings)
    rows = _answered(states, settings, retuned)
    largest = max(abs(row.effort) for row in rows)
    deviation = math.ulp(1.0) * largest * _PRECISIONS  # half a last place in single precision
    with suppress(HpidError):  # settings that are none in single precision
        rounded = [_rounded(state) for state in states]
        others = _answered(rounded, in_single(settings), in_single(retuned))
        pairs = zip(rows, others, strict=True)
        deviation += max(abs(row.effort - other.effort) for row, other in pairs)
    tolerance = _SAFETY * deviation
    return Golden(tuple(rows), _RETUNE_AT, retuned, tolerance / _PRECISIONS, tolerance)


def _answered(
    states: Sequence[GoldenRow], settings: LoopSettings, retuned: LoopSettings
) -> list[GoldenRow]:
    """Return states with the efforts that answer them."""
    given, rows = GivenLoop(settings), []
    for row, state in enumerate(states):
        if row == _RETUNE_AT:
            given.loop.retune(replace(settings, gains=retuned.gains))
            given.loop.retune(retuned)
        rows.append(state._replace(effort=given.step(*state[:-1])))
    return rows


def _rounded(state: GoldenRow) -> GoldenRow:
    stamp_ns, *numbers = state
    rounded = (None if each is None else c_float(each).value for each in numbers)
    return GoldenRow(stamp_ns, *rounded)  # type: ignore[arg-type]


def _retuned(settings: LoopSettings) -> LoopSettings:
    """Return the settings with other gains and another degree, where they can have them."""
    gains = settings.gains
    changes = {"gains.p": 1.1 * gains.p, "gains.i": 0.9 * gains.i, "gains.d": 1.05 * gains.d}
    for change in (changes, {"mu": 0.75 * settings.mu}):
        with suppress(HpidError):  # a gain at its end, or a floor that then has no room
            settings = settings.with_parameters(change)
    return settings


def _undisturbed(settings: LoopSettings) -> list[GoldenRow]:
    """Return states at even stamps, between the stops; efforts are still to come."""
    lower, upper = settings.motion.lower, settings.motion.upper
    amplitude = min(_LARGEST_SWING, 0.4 * (upper - lower))
    middle = min(max(0.0, lower + amplitude), upper - amplitude)
    period = settings.timing.control_period
    chance = random.Random(1)
    rows: list[GoldenRow] = []
    for row in range(_ROWS):
        angle = math.tau * row / 400.0
        reference = middle + amplitude * math.sin(angle)
        rate = amplitude * math.cos(angle) * math.tau / 400.0 / period
        decay = 10.0 ** (-5.0 * (row % 250) / 250.0)
        error = amplitude * decay * math.cos(math.tau * row / 60.0)
        position = reference - error
        speed = (position - rows[-1].position) / period if rows else 0.0
        velocity = speed * (1.0 + 0.01 * chance.gauss(0.0, 1.0))
        stamp_ns = NANOSECONDS + round(row * period * NANOSECONDS)
        rows.append(GoldenRow(stamp_ns, reference, rate, position, velocity, 0.0))
    return rows


def _disturbed(settings: LoopSettings) -> list[GoldenRow]:
    """Return states with a repeat, some that cannot be used, and times that are none."""
    rows = _undisturbed(settings)
    later_ns = round(5.0 * settings.timing.state_timeout * NANOSECONDS)

    def change(row: int, **values: Any) -> None:
        rows[row] = rows[row]._replace(**values)

    def shift(first: int, by_ns: int = 0, by: float = 0.0) -> None:
        for row in range(first, _ROWS):
            state = rows[row]
            change(row, stamp_ns=state.stamp_ns + by_ns, position=state.position + by)

    change(121, stamp_ns=rows[120].stamp_ns)  # a repeat
    change(180, position=math.nan)
    change(200, velocity=math.nan)
    for row in range(220, 240):
        change(row, velocity=None)
    shift(300, by_ns=later_ns)  # a gap
    change(400, position=rows[400].position + 4.0)  # passed over
    change(600, position=-math.inf)
    shift(650, by=3.5)  # a jump that is believed, with the second state
    change(750, stamp_ns=rows[750].stamp_ns + later_ns)  # a stamp from the future
    shift(800, by_ns=-3 * later_ns)  # the clock goes back
    change(900, rate=math.nan)
    change(950, reference=math.inf)
    return rows


Precision = Literal["double", "single"]
"""Of the floating-point numbers, where the macro of the header does not say another."""

_FILES = {"loop.h": ".h", "loop.c": ".c", "golden.h": "_golden.h", "test.c": "_test.c"}
_WIDTH = 80  # columns
_LONGEST_NAME = 60  # characters of a text that somebody else wrote


def c_name(joint: str) -> str:
    """Return what a joint's files and identifiers begin with in C."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", joint).strip("_")
    if not name:
        raise SettingError(
            f"joint {joint!r} cannot have a name in C: it has none of A-Z, a-z and 0-9"
        )
    return f"hpid_{name}"


def file_names(joint: str) -> tuple[str, ...]:
    """Return the names of a joint's files, the header first."""
    return tuple(f"{c_name(joint)}{suffix}" for suffix in _FILES.values())


def require_distinct(joints: Sequence[str]) -> None:
    """Refuse joints that would have the same names in C, or in a folder that ignores case."""
    owners: dict[str, str] = {}
    for joint in joints:
        for name in (c_name(joint), *file_names(joint)):
            other = owners.setdefault(name.casefold(), joint)
            if other is not joint:
                raise SettingError(
                    f"joints {other!r} and {joint!r} would both be {name} in C: name one of them "
                    "with --joint"
                )


def c_files(
    settings: LoopSettings, precision: Precision, source: str, name: str = ""
) -> dict[str, str]:
    """Return the files that are a loop in C99; identifiers begin with a name, or the joint's."""
    name = name or c_name(settings.joint)
    values = exported_values(settings)
    if precision == "single":
        in_single(settings)
    texts = {
        "c": name,
        "C": name.upper(),
        "joint": plain(settings.joint),
        "source": plain(source),
        "version": __version__,
        "is_single": precision == "single",
        "fields": FIELDS,
        "norms": _NORMS_IN_C,
        "values": values,
        "golden": golden_vectors(settings),
        "math": math,
        "largest_position": LARGEST_POSITION,
        "least_wrap": LEAST_WRAP,
        "largest_motion": LARGEST_MOTION,
        "parameters": LOOP_PARAMETERS,
        "sources": SOURCE_RULE,
    }
    return {
        f"{name}{suffix}": templates().get_template(template).render(texts)
        for template, suffix in _FILES.items()
    }


def _real(value: float) -> str:
    return f"REAL({_double(value)})"


def _double(value: float | None) -> str:
    """Return any number of double precision; one that is not there is 0."""
    if value is None:
        return "0.0"
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "-INFINITY"
    return repr(float(value))  # as many digits as tell it from every other number


def _pair(values: tuple[float, float]) -> str:
    return f"{{{_double(values[0])}, {_double(values[1])}}}"


def _comment(text: str, indent: int = 0) -> str:
    """Return a text for a comment, in lines; the first one begins after the indent."""
    lines = textwrap.wrap(text, _WIDTH - indent - len("/*  */"))
    return f"\n{' ' * indent} * ".join(lines)


def plain(text: str) -> str:
    """Return a text that somebody else wrote so that it can neither end a comment nor a line."""
    plain = re.sub(r"[^A-Za-z0-9 .,:()+=_-]", "_", text)
    return plain if len(plain) <= _LONGEST_NAME else f"{plain[: _LONGEST_NAME - 3]}..."


@cache
def templates() -> Environment:
    """Return the templates; whatever is foreign in what they print has been made plain before."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        real=_real, double=_double, pair=_pair, comment=_comment, yaml=inline_yaml
    )
    return environment


_PACKAGE = re.compile(r"[a-z](?:_?[a-z0-9])+")  # REP 144
_NODE = re.compile(r"[A-Za-z][A-Za-z0-9_]*")  # what a node's name may begin with
_DEPENDENCIES = (
    "ament_index_cpp",
    "controller_interface",
    "diagnostic_msgs",
    "lifecycle_msgs",
    "pluginlib",
    "rcl_interfaces",
    "rclcpp",
    "rclcpp_lifecycle",
    "rcutils",
    "sensor_msgs",
    "std_msgs",
    "trajectory_msgs",
)
_LAUNCHED = (
    "controller_manager",
    "hpid_ros",
    "joint_state_broadcaster",
    "joint_state_topic_hardware_interface",
    "launch_ros",
    "robot_state_publisher",
)
_PACKAGE_FILES = {
    "package.xml": "package.xml",
    "CMakeLists.txt": "CMakeLists.txt",
    "README.md": "README.md",
    "clang-format": ".clang-format",
    "plugin.xml": "{package}.xml",
    "controllers.yaml": "config/controllers.yaml",
    "world.yaml": "config/world.yaml",
    "simulated.launch.py.in": "launch/simulated.launch.py",
    **{
        f"{name}{end}": f"src/{name}{end}"
        for name in ("certificate", "controller", "joint", "joint_node", "reference")
        for end in (".hpp", ".cpp")
    },
    "handover.hpp": "src/handover.hpp",
    "parameters.hpp": "src/parameters.hpp",
    "test_controller.cpp": "test/test_controller.cpp",
    "test_loops.cpp": "test/test_loops.cpp",
}
"""Templates, and the files of the package that come of them."""


def require_package(name: str, joints: Sequence[str]) -> None:
    """Refuse what cannot be the name of a package, and joints that cannot be those of nodes."""
    if not _PACKAGE.fullmatch(name):
        raise SettingError(
            f"{name!r} cannot be the name of a package: it is that of the folder, which must be "
            "of a-z, 0-9 and single _, and begin with a letter"
        )
    for joint in joints:
        if not _NODE.fullmatch(joint) or node_word(joint) != joint:
            raise SettingError(
                f"joint {joint!r} cannot have a node of its own in a plugin: its name must be of "
                "A-Z, a-z, 0-9 and _, and begin with a letter"
            )


def package_files(
    package: str, ranges: Sequence[GainRange], joints_file: str, source: str
) -> dict[str, str]:
    """Return the files of the package by their paths in it.

    ``joints_file`` is the content of a parameter file of the joints' controllers.
    """
    loops = [each.settings for each in ranges]
    allowed = {each.settings.joint: _allowed(each) for each in ranges}
    proofs = {
        each.settings.joint: [corner.to_mapping() for box in each.boxes for corner in box.corners]
        for each in ranges
        if each.boxes
    }
    # What hpid check-gains verifies, and for which gains and degrees it stands.
    document = {"gain_ranges": allowed, CERTIFICATES: proofs}
    certificates = json.dumps(document, indent=1) + "\n"
    c = f"{package}_loop"
    files = {
        "config/joints.yaml": joints_file,
        "config/certificates.json": certificates,
        "src/parameters.yaml": dump_yaml(_parameters(package), width=100),
    }
    own = c_files(loops[0], "double", source, c)
    files |= {f"src/{c}{end}": own[f"{c}{end}"] for end in (".h", ".c")}
    for each in loops:
        golden = f"{c_name(each.joint)}_golden.h"
        files[f"test/{golden}"] = c_files(each, "double", source)[golden]
    texts: dict[str, Any] = {
        "package": package,
        "c": c,
        "C": c.upper(),
        "source": plain(source),
        "version": __version__,
        "license": "Apache-2.0",
        "dependencies": _DEPENDENCIES,
        "launched": _LAUNCHED,
        "fields": FIELDS,
        "joints": [each.joint for each in loops],
        "loops": [
            {"joint": each.joint, "c": c_name(each.joint), "settings": exported_values(each)}
            for each in loops
        ],
        "certificates": [*allowed.values()],
        "allowed": [(each.settings.joint, str(each)) for each in ranges],
        "sha256": hashlib.sha256(certificates.encode()).hexdigest(),
        "largest_position": LARGEST_POSITION,
        "largest_motion": LARGEST_MOTION,
        "grace_ns": GRACE_NS,
        "longest_wait_ns": LONGEST_WAIT * NANOSECONDS,
        "latched_within_ns": round(LATCHED_WITHIN * NANOSECONDS),
        "update_rate": round(1.0 / min(each.timing.control_period for each in loops)),
    }
    for template, path in _PACKAGE_FILES.items():
        text = templates().get_template(f"ros2_control/{template}").render(texts)
        files[path.format(package=package)] = text
    return files


def _allowed(found: GainRange) -> dict[str, Any]:
    return {
        "joint": found.settings.joint,
        "inertia": found.inertia,
        "norm": found.settings.norm.type,
        "boxes": [
            {key: value for key, value in each._asdict().items() if key != "corners"}
            for each in found.boxes
        ],
    }


def _parameters(package: str) -> dict[str, Any]:
    """Return the definition of a joint's parameters for generate_parameter_library.

    What the loop in C cannot do may only have its default.
    """
    exported = {field.parameter: field for field in FIELDS}
    root: dict[str, Any] = {}
    for name, spec in PARAMETERS.items():
        *groups, last = name.split(".")
        place = root
        for each in groups:
            place = place.setdefault(each, {})
        field = exported.get(name)
        own = _declared(spec.default, spec.description, is_fixed=field is None)
        if isinstance(spec.default, float):
            ends = field.range if field is not None and field.range else (spec.default,) * 2
            own["validation"] = {"bounds<>": list(ends)}
        elif isinstance(spec.default, str) and name != "joint":
            choices = field.choices if field is not None else (spec.default,)
            choices = spec.choices if name == "state_clock" else choices
            own["validation"] = {"one_of<>": [list(choices)]}
        place[last] = own
    for name, default, description in _NODE_PARAMETERS:
        root[name] = _declared(default, description, is_fixed=True)
    return {package: root}


def _declared(default: Value, description: str, *, is_fixed: bool) -> dict[str, Any]:
    own = {"type": _TYPES[type(default)], "default_value": default, "description": description}
    return {**own, "read_only": True} if is_fixed else own


_TYPES = {float: "double", bool: "bool", str: "string"}
_NODE_PARAMETERS: Sequence[tuple[str, Value, str]] = (
    ("robot_description", "", "Not used: give the robot's URDF to hpid export --urdf"),
    (
        "introspection_rate",
        20.0,
        "Of ~/reference and ~/terms [Hz]; 0 is off, negative is every sample",
    ),
    ("require_certificate", True, "What is outside the certificate is always refused"),
)
