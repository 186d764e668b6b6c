"""Imports point inward, each library has one room, and no folder is crowded."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hpid_ros

ROOT = Path(hpid_ros.__file__).parent
ENTRIES = 14  # in one folder, at most

# What each room may import of the others, from the inside out; base is open to all.
ALLOWED = {
    "base": set(),
    "documents": set(),
    "control": set(),
    "wire": set(),
    "recordings": set(),
    "trajectory": {"documents"},
    "robot": {"documents"},
    "stability": {"control"},
    "compensation": {"control", "robot"},
    "planning": {"documents", "robot", "trajectory"},
    "simulation": {"compensation", "control", "documents", "planning", "robot", "wire"},
    "bags": {"documents", "recordings", "trajectory", "wire"},
    "analysis": {"recordings"},
    "report": {"analysis", "recordings"},
    "metrics": {"analysis", "bags", "control", "recordings", "robot", "stability"},
    "tuning": {
        *("analysis", "compensation", "control", "documents", "recordings", "robot"),
        *("simulation", "stability", "trajectory"),
    },
}
BELOW_EXPERIMENTS = set(ALLOWED)
ALLOWED["experiment"] = BELOW_EXPERIMENTS
ALLOWED["studies"] = BELOW_EXPERIMENTS | {"experiment"}
ALLOWED["nodes"] = BELOW_EXPERIMENTS
ALLOWED["cli"] = BELOW_EXPERIMENTS | {"experiment", "studies"}
ONLY_IN = {
    "rclpy": {"nodes"},
    "pybullet": {"simulation"},
    "mujoco": {"simulation"},
    "pinocchio": {"robot", "compensation"},
    "rosbags": {"bags"},
    "matplotlib": {"report"},
}
PURE = {"control", "trajectory", "wire", "recordings"}
PURE_LIBRARIES = {"numpy", "scipy"}
# Files, signals and terminals are not for the pure rooms.
SHELL = {
    *("hpid_ros.base.console", "hpid_ros.base.interrupts", "hpid_ros.base.output_files"),
    *("hpid_ros.base.resources", "hpid_ros.documents.yaml_files"),
}


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
            if node.module.split(".")[0] == "hpid_ros":
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_inward(path):
    here = room(path)
    for name in imports(path):
        top, *rest = name.split(".")
        if top != "hpid_ros":
            assert here in ONLY_IN.get(top, {here}), f"{name} belongs into {ONLY_IN[top]}"
            continue
        target = rest[0] if rest else None
        if here is None or target in (None, here, "base", "__version__"):
            continue
        assert target in ALLOWED[here], f"{here} must not import {name}"


@pytest.mark.parametrize("path", [p for p in modules() if room(p) in PURE], ids=str)
def test_the_pure_core_needs_no_library_but_numpy_and_scipy(path):
    names = set(imports(path))
    foreign = {name.split(".")[0] for name in names} - sys.stdlib_module_names
    assert foreign <= {"hpid_ros"} | PURE_LIBRARIES
    clocks = {"time", "datetime", "os", "pathlib", "io", "socket", "threading"}
    assert not clocks & {name.split(".")[0] for name in names}
    assert not names & SHELL


def test_there_is_no_circle():
    """Not even within a room: whoever is imported can be read without who imports it."""
    names = {module_name(path): path for path in modules()}
    after = {name: {n for n in at_import(path) if n in names} for name, path in names.items()}
    done = set()
    while after:
        free = [name for name, needs in after.items() if not needs - done - {name}]
        assert free, f"a circle among {sorted(after)}"
        done.update(free)
        for name in free:
            del after[name]


def module_name(path):
    return ".".join(("hpid_ros", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(
        ".__init__"
    )


def at_import(path):
    """Yield what is imported when a module is: what stands at its top level."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "hpid_ros":
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_folder_is_crowded():
    """But for the house itself, whose rooms are many."""
    for folder in {path.parent for path in modules()} - {ROOT}:
        entries = [entry for entry in folder.iterdir() if entry.name != "__pycache__"]
        assert len(entries) <= ENTRIES, f"{folder} has {len(entries)} entries"


def test_nodes_do_not_import_each_other():
    """What has a main is a node; parts that nodes share are below them."""
    nodes = {p.stem for p in (ROOT / "nodes").glob("*.py") if "\ndef main(" in p.read_text()}
    composed = {"joint_controllers", "single_process"}  # several nodes, by definition
    for path in (ROOT / "nodes").rglob("*.py"):
        used = {f"hpid_ros.nodes.{node}" for node in nodes} & set(imports(path))
        assert not used or path.stem in composed, f"{path.stem} imports {used}"
    assert nodes >= {p.stem for p in (ROOT / "nodes").glob("*.py")} - {"__init__"}


def test_the_repository_holds_its_own_sources_alone():
    top = ROOT.parent
    if not (top / ".git").exists():
        pytest.skip("not a checkout")
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=top, check=True, capture_output=True, text=True
    )
    tracked = [top / name for name in listing.stdout.split("\0") if name]
    foreign = {".whl", ".gz", ".zip", ".so", ".pyc", ".log", ".TXT", ".mcap", ".db3"}
    assert not [path.name for path in tracked if path.suffix in foreign]
    assert not [path.name for path in tracked if path.is_file() and path.stat().st_size > 1 << 20]
