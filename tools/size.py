#!/usr/bin/env python3
"""Prints how large the two packages are, what a robot's processes load of them, tests and docs.

python tools/size.py [CHECKOUT]
"""

import ast
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

PACKAGES = ("hpid_ros", "hpid_bench")
# The executables without which no robot is driven, and the recorder: no bridge, no metrics.
ROBOTS_SIDE = (
    "joint_controller",
    "joint_controllers",
    "joint_command_merger",
    "follow_joint_trajectory",
    "trajectory_publisher",
    "bag_recorder",
)


def code_lines(text):
    """Count lines without docstrings, blank lines, comments and imports."""
    lines = text.splitlines()
    is_code = [bool(line.strip()) and not line.lstrip().startswith("#") for line in lines]
    for node in ast.walk(ast.parse(text)):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        is_text = is_text and isinstance(node.value.value, str)
        if is_text or isinstance(node, ast.Import | ast.ImportFrom):
            is_code[node.lineno - 1 : node.end_lineno] = [False] * (
                node.end_lineno - node.lineno + 1
            )
    return sum(is_code)


def loaded_files(checkout, nodes=ROBOTS_SIDE):
    """Return the files of both packages that a process has loaded when it has imported nodes."""
    program = (
        f"import {', '.join(f'hpid_ros.nodes.{node}' for node in nodes)}, sys\n"
        f"for name, module in sys.modules.items():\n"
        f"    if name.partition('.')[0] in {PACKAGES}:\n"
        f"        print(module.__file__)\n"
    )
    path = os.pathsep.join([str(checkout), os.environ.get("PYTHONPATH", "")])
    found = subprocess.run(
        [sys.executable, "-c", program],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        cwd=checkout,
    )
    return sorted(map(Path, found.stdout.splitlines()))


def repeated_classes(files):
    """Return the names of classes that are defined in several modules, with these modules."""
    places = defaultdict(list)
    for path in files:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path)
    return {name: paths for name, paths in sorted(places.items()) if len(paths) > 1}


def lines_in(folder, pattern):
    return sum(len(path.read_text().splitlines()) for path in folder.rglob(pattern))


def main(checkout):
    checkout = Path(checkout).resolve()
    files = {name: sorted((checkout / name).rglob("*.py")) for name in PACKAGES}
    robots_side = loaded_files(checkout)
    print("lines of code, and files")
    for name, paths in (*files.items(), ("what drives a robot loads", robots_side)):
        code = sum(code_lines(path.read_text()) for path in paths)
        print(f"  {name:30} {code:7} {len(paths):7}")
    print("lines")
    print(f"  {'test':30} {lines_in(checkout / 'test', '*.py'):7}")
    print(f"  {'docs':30} {lines_in(checkout / 'docs', '*.md'):7}")
    print("classes of one name")
    for name, paths in repeated_classes([each for own in files.values() for each in own]).items():
        places = ", ".join(str(path.relative_to(checkout)) for path in paths)
        print(f"  {name:30} {places}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1])
