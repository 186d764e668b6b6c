"""Interfaces of packages that PyPI lacks, built where they are not installed.

PyPI has neither control_msgs nor simulation_interfaces, but ROS from PyPI has the generators and
all that their code is linked to. A session whose wheels are new takes some seconds to build a
package; those that follow find it in pytest's cache. Built is what this package uses.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

TOLERANCE = "float64 position; float64 velocity; float64 acceleration"
CONTROL_MSGS = {  # version 5
    "msg/JointTolerance": f"string name; {TOLERANCE}",
    "msg/JointComponentTolerance": "uint16 X_AXIS=1; uint16 Y_AXIS=2; uint16 Z_AXIS=3; "
    f"uint16 TRANSLATION=4; uint16 ROTATION=5; string joint_name; uint16 component; {TOLERANCE}",
    "msg/InterfaceValue": "string[] interface_names; float64[] values",
    "msg/DynamicJointState": "std_msgs/Header header; string[] joint_names; "
    "InterfaceValue[] interface_values",
    "action/FollowJointTrajectory": "trajectory_msgs/JointTrajectory trajectory; "
    "trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory; "
    "JointTolerance[] path_tolerance; JointComponentTolerance[] component_path_tolerance; "
    "JointTolerance[] goal_tolerance; JointComponentTolerance[] component_goal_tolerance; "
    "builtin_interfaces/Duration goal_time_tolerance; ---; "
    "int32 SUCCESSFUL=0; int32 INVALID_GOAL=-1; int32 INVALID_JOINTS=-2; "
    "int32 OLD_HEADER_TIMESTAMP=-3; int32 PATH_TOLERANCE_VIOLATED=-4; "
    "int32 GOAL_TOLERANCE_VIOLATED=-5; int32 error_code; string error_string; ---; "
    "std_msgs/Header header; string[] joint_names; "
    "trajectory_msgs/JointTrajectoryPoint desired; "
    "trajectory_msgs/JointTrajectoryPoint actual; "
    "trajectory_msgs/JointTrajectoryPoint error; string[] multi_dof_joint_names; "
    "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired; "
    "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual; "
    "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error",
}
SIMULATION_INTERFACES = {  # version 1.5.1, Jazzy's
    "msg/Result": "uint8 RESULT_FEATURE_UNSUPPORTED=0; uint8 RESULT_OK=1; "
    "uint8 RESULT_NOT_FOUND=2; uint8 RESULT_INCORRECT_STATE=3; uint8 RESULT_OPERATION_FAILED=4; "
    "uint8 result; string error_message",
    "msg/SimulationState": "uint8 STATE_STOPPED=0; uint8 STATE_PLAYING=1; uint8 STATE_PAUSED=2; "
    "uint8 STATE_QUITTING=3; uint8 state",
    "msg/SimulatorFeatures": "uint8 SPAWNING=0; uint8 SIMULATION_RESET=20; "
    "uint8 SIMULATION_RESET_TIME=21; uint8 SIMULATION_RESET_STATE=22; "
    "uint8 SIMULATION_STATE_GETTING=24; uint8 SIMULATION_STATE_SETTING=25; "
    "uint8 SIMULATION_STATE_PAUSE=26; uint8 STEP_SIMULATION_SINGLE=31; "
    "uint16[] features; string[] spawn_formats; string custom_info",
    "srv/GetSimulatorFeatures": "---; SimulatorFeatures features",
    "srv/GetSimulationState": "---; SimulationState state; Result result",
    "srv/SetSimulationState": "SimulationState state; ---; uint8 ALREADY_IN_TARGET_STATE=101; "
    "uint8 STATE_TRANSITION_ERROR=102; uint8 INCORRECT_TRANSITION=103; Result result",
    "srv/ResetSimulation": "uint8 SCOPE_DEFAULT=0; uint8 SCOPE_TIME=1; uint8 SCOPE_STATE=2; "
    "uint8 SCOPE_SPAWNED=4; uint8 SCOPE_ALL=255; uint8 scope; ---; Result result",
    "srv/StepSimulation": "uint64 steps 1; ---; Result result",
}
PACKAGES = {"control_msgs": CONTROL_MSGS, "simulation_interfaces": SIMULATION_INTERFACES}
HASHES = {  # of these types in any installation of Jazzy: a field that differs is another type
    "control_msgs/msg/DynamicJointState": (
        "18024c98a62697680f581108eeed40b28fb4542fa0ac5a8e36f56c62b6813d26"
    ),
    "control_msgs/action/FollowJointTrajectory": (
        "738ebcb7a2d7cfa42f9f1001cc99ce3a4383d1cfe508015d9be8485e4b1c66f6"
    ),
}
USED = (  # by these interfaces, by services and by actions
    "action_msgs",
    "builtin_interfaces",
    "geometry_msgs",
    "service_msgs",
    "std_msgs",
    "trajectory_msgs",
    "unique_identifier_msgs",
)
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
PARTS = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", *TYPE_SUPPORTS)
LIBRARIES = (
    *("__".join(each) for each in product(USED, PARTS)),
    "rosidl_runtime_c",
    "rosidl_typesupport_c",
    *TYPE_SUPPORTS,
    "rosidl_typesupport_fastrtps_cpp",
    "rcutils",
    "rmw",
    "fastcdr",
    "stdc++",
)
HEADERS = Path(sysconfig.get_path("include"))  # of Python
PREFIX = Path(sys.prefix)  # of the wheels


def why_not(name):
    """Return in a line why a package is not there, for tests that are skipped without it."""
    takes = {
        "C++ compiler (cc, c++)": shutil.which("cc") and shutil.which("c++"),
        "Python.h": (HEADERS / "Python.h").exists(),
        "ROS from PyPI with its generators": (PREFIX / "include" / "rosidl_runtime_c").is_dir()
        and find_spec("rosidl_generator_py"),
    }
    missing = ", no ".join(name for name, is_there in takes.items() if not is_there)
    return f"{name} is not installed, and there is no {missing} to build it" if missing else ""


def needs(name):
    """Return a mark for tests that need a package."""
    return pytest.mark.skipif(find_spec(name) is None, reason=why_not(name))


def provide(name, cache):
    """Let this process and its children import a package, if it is installed or can be built.

    Args:
        name: One of ``PACKAGES``.
        cache: Folder of what earlier sessions built.
    """
    if find_spec(name) or why_not(name):
        return
    wheels = Path(sysconfig.get_path("platlib")).glob("*.dist-info")
    versions = sorted(each.name for each in wheels if each.name.startswith(("ros_", "numpy-")))
    known = (name, Path(__file__).read_text(), sys.version, sys.prefix, versions)
    built = cache / hashlib.sha256(repr(known).encode()).hexdigest()[:16]
    if not built.is_dir():
        with TemporaryDirectory(dir=cache) as folder:
            done = subprocess.run(
                [sys.executable, "-m", "harness.interfaces", name, folder],
                cwd=Path(__file__).parents[1],
                env={**os.environ, "AMENT_PREFIX_PATH": sys.prefix},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            assert done.returncode == 0, f"{name} cannot be built:\n{done.stdout}"
            try:
                Path(folder, "built").replace(built)
            except OSError:
                if not built.is_dir():  # another session was faster
                    raise
    sys.path.append(str(built))
    paths = (os.environ.get("PYTHONPATH"), str(built))
    os.environ["PYTHONPATH"] = os.pathsep.join(each for each in paths if each)


def _generate(name, folder, package, inspection):
    """Write the sources of the package; those of the inspection have names of others."""
    from rosidl_adapter.action import convert_action_to_idl
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_adapter.srv import convert_srv_to_idl
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    include = [str(PREFIX / "share" / each) for each in USED]
    idl = []
    converters = {
        "msg": convert_msg_to_idl,
        "srv": convert_srv_to_idl,
        "action": convert_action_to_idl,
    }
    for interface, definition in PACKAGES[name].items():
        kind = interface.partition("/")[0]
        file = folder / f"{interface}.{kind}"
        file.parent.mkdir(exist_ok=True)
        file.write_text(definition.replace("; ", "\n"))
        converters[kind](folder, name, file.relative_to(folder), package / kind)
        idl.append(f"{package}:{interface}.idl")
    hashed = HashTypeDescription("hash").generate_type_hashes(name, idl, include, package)
    for interface, expected in HASHES.items():
        of, _, file = interface.partition("/")
        if of != name:
            continue
        (found, *_) = json.loads((package / f"{file}.json").read_text())["type_hashes"]
        assert found["hash_string"] == f"RIHS01_{expected}", found
    GenerateC("c").generate(name, idl, include, package, hashed)
    for generator, output in (
        (GeneratePython("", typesupport_implementations=["rosidl_typesupport_c"]), package),
        (GenerateCTypesupport("", typesupport_implementations=[*TYPE_SUPPORTS]), package),
        (GenerateFastRTPSCTypesupport(""), package),
        (GenerateIntrospectionCTypesupport(""), inspection),
    ):
        generator.generate(name, idl, include, output)
    (package / "__init__.py").touch()


def _compile(name, folder, package, inspection):
    """Make a library of all sources; those that ROS looks for by other names are linked to it.

    ROS opens the library of a type support without a path: one that is loaded already is found,
    and Python loads all of them with the module.
    """
    import numpy

    # Most of what C++ takes is the headers of Fast CDR: all its files are one unit.
    unit = folder / "unit.cpp"
    unit.write_text("".join(f'#include "{each}"\n' for each in sorted(package.rglob("*.cpp"))))
    wheels = PREFIX / "include"
    include = (package.parent, inspection.parent, HEADERS, numpy.get_include(), wheels)
    compiled = (*(f"-I{each}" for each in (*include, *wheels.iterdir())), unit)
    sources = (*package.rglob("*.c"), *inspection.rglob("*.c"))
    libraries = (f"-L{PREFIX / 'lib'}", *(f"-l{each}" for each in LIBRARIES))
    whole, other = (f"lib{name}__{each}.so" for each in TYPE_SUPPORTS)
    for library, linked in (
        (whole, (*compiled, *sources, *libraries)),
        (other, (whole,)),
        (f"{name}_s__rosidl_typesupport_c.so", (whole, other)),
    ):
        options = ("-O0", "-w", "-fPIC", "-shared", f"-Wl,-soname,{library},--no-as-needed")
        paths = f"-Wl,-rpath,$ORIGIN:{PREFIX / 'lib'}"
        subprocess.run(["cc", *options, paths, "-o", library, *linked], cwd=package, check=True)


if __name__ == "__main__":
    asked, target = sys.argv[1], Path(sys.argv[2]).resolve()
    folders = target / "built" / asked, target / "inspection" / asked
    for each in folders:
        each.mkdir(parents=True)
    _generate(asked, target, *folders)
    _compile(asked, target, *folders)
