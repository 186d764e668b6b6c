"""Imports point inward, and each library has one room."""

import ast
from pathlib import Path

import pytest

import hpid_ros

ROOT = Path(hpid_ros.__file__).parent

# What each room may import of the others; what a room may always import is below.
ALLOWED = {
    "control": set(),
    "trajectory": set(),
    "messages": set(),
    "robot": set(),
    "analysis": set(),
    "bags": {"analysis", "messages", "trajectory", "yaml_files"},  # metadata.yaml, with its bounds
    "simulation": {"control", "robot"},
    "planning": {"robot", "trajectory"},
    "nodes": {
        *("analysis", "bags", "control", "messages", "robot", "simulation", "trajectory"),
        *("planning", "tuning"),
    },
    "tuning": {"analysis", "bags", "control", "robot", "simulation", "trajectory"},
    "commands": {"analysis", "bags", "control", "experiment", "robot", "tuning"},
    "experiment": {
        *("analysis", "bags", "control", "messages", "robot", "simulation", "trajectory"),
        *("planning", "tuning"),
    },
}
EVERYWHERE = {"durations", "errors", "names", "sections"}  # pure, and below every room
SHELL = {
    "resources",
    "yaml_files",
    "interrupts",
    "terminal",
}  # files and signals: for shells alone
ONLY_IN = {
    "rclpy": "nodes",
    "pybullet": "simulation",
    "pinocchio": "robot",
    "rosbags": "bags",
    "matplotlib": "analysis",
}
SHELLS = {"nodes", "experiment", "tuning", "commands"}
PURE = {"control", "trajectory", "messages"}
PURE_LIBRARIES = {"numpy", "scipy"}


def modules():
    return sorted(ROOT.rglob("*.py"))


def room(path):
    parts = path.relative_to(ROOT).parts
    return parts[0] if len(parts) > 1 else None


def imports(path):
    """Yield the dotted names that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            if node.module == "hpid_ros":
                yield from (f"hpid_ros.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_inward(path):
    here = room(path)
    for name in imports(path):
        top, *rest = name.split(".")
        if top != "hpid_ros":
            assert ONLY_IN.get(top, here) == here, f"{name} belongs into {ONLY_IN[top]}"
            continue
        target = rest[0] if rest else None
        if here is None or target in (None, here, "__version__") or target in EVERYWHERE:
            continue
        allowed = ALLOWED[here] | (SHELL if here in SHELLS else set())
        assert target in allowed, f"{here} must not import {name}"


@pytest.mark.parametrize("path", [p for p in modules() if room(p) in PURE], ids=str)
def test_the_pure_core_needs_no_library_but_numpy_and_scipy(path):
    import sys

    foreign = {name.split(".")[0] for name in imports(path)} - sys.stdlib_module_names
    assert foreign <= {"hpid_ros"} | PURE_LIBRARIES
    clocks = {"time", "datetime", "os", "pathlib", "io", "socket", "threading"}
    assert not clocks & {name.split(".")[0] for name in imports(path)}


def test_nobody_imports_the_nodes():
    for path in modules():
        if room(path) != "nodes":
            assert not [name for name in imports(path) if name.startswith("hpid_ros.nodes")]


def test_nodes_do_not_import_each_other():
    """Shared parts of the shell have no main; what has one is a node."""
    nodes = {p.stem for p in (ROOT / "nodes").glob("*.py") if "\ndef main(" in p.read_text()}
    composed = {"joint_controllers", "single_process"}  # several nodes, by definition
    for path in (ROOT / "nodes").glob("*.py"):
        used = {name.rpartition(".")[2] for name in imports(path)} & nodes
        assert not used or path.stem in composed, f"{path.stem} imports {used}"
