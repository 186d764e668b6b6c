"""Controllers as a package of ros2_control: exported loops of C in a plugin, with certificates."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from typing import Any

import yaml

from hpid_ros import __version__
from hpid_ros.base.errors import SettingError
from hpid_ros.control.reference import LARGEST_POSITION
from hpid_ros.control.settings import LARGEST_MOTION, PARAMETERS, Value
from hpid_ros.stability.gain_boxes import GainRange
from hpid_ros.stability.gain_check import CERTIFICATES
from hpid_ros.tuning.c_export import FIELDS, c_files, c_name, exported_values, plain, templates

_PACKAGE = re.compile(r"[a-z](?:_?[a-z0-9])+")  # REP 144
_NODE = re.compile(r"[A-Za-z][A-Za-z0-9_]*")  # what a node's name may begin with
_DEPENDENCIES = (
    *("ament_index_cpp", "controller_interface", "diagnostic_msgs", "lifecycle_msgs"),
    *("pluginlib", "rcl_interfaces", "rclcpp", "rclcpp_lifecycle", "rcutils"),
    *("sensor_msgs", "std_msgs", "trajectory_msgs"),
)
_LAUNCHED = (
    *("controller_manager", "hpid_ros", "joint_state_broadcaster"),
    *("joint_state_topic_hardware_interface", "launch_ros", "robot_state_publisher"),
)
_FILES = {
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
        if not _NODE.fullmatch(joint):
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
        "src/parameters.yaml": yaml.safe_dump(_parameters(package), sort_keys=False, width=100),
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
        "update_rate": round(1.0 / min(each.timing.control_period for each in loops)),
    }
    for template, path in _FILES.items():
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
    for name, default, description in _OF_THE_NODE:
        root[name] = _declared(default, description, is_fixed=True)
    return {package: root}


def _declared(default: Value, description: str, *, is_fixed: bool) -> dict[str, Any]:
    own = {"type": _TYPES[type(default)], "default_value": default, "description": description}
    return {**own, "read_only": True} if is_fixed else own


_TYPES = {float: "double", bool: "bool", str: "string"}
_OF_THE_NODE: Sequence[tuple[str, Value, str]] = (
    ("robot_description", "", "Not used: give the robot's URDF to hpid export --urdf"),
    (
        "introspection_rate",
        20.0,
        "Of ~/reference and ~/terms [Hz]; 0 is off, negative is every sample",
    ),
    ("require_certificate", True, "What is outside the certificate is always refused"),
)
