#!/usr/bin/env python3
"""Prints how large the package and its tests are: lines, code, files, rooms, single importers.

python tools/size.py [CHECKOUT]
"""

import ast
import sys
from collections import defaultdict
from pathlib import Path


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


def single_siblings(package, files):
    """Return the modules that one module alone imports, from the same folder."""
    names = {".".join(path.relative_to(package.parent).with_suffix("").parts) for path in files}
    importers = defaultdict(set)
    for path in files:
        own = ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                for name in (node.module, *(f"{node.module}.{a.name}" for a in node.names)):
                    if name in names and name != own:
                        importers[name].add(own)
    return sorted(
        name
        for name, users in importers.items()
        if len(users) == 1 and next(iter(users)).rpartition(".")[0] == name.rpartition(".")[0]
    )


def main(checkout):
    package = Path(checkout) / "hpid_ros"
    files = sorted(package.rglob("*.py"))
    texts = [path.read_text() for path in files]
    tests = [path.read_text() for path in (Path(checkout) / "test").rglob("*.py")]
    docs = [path.read_text() for path in (Path(checkout) / "docs").rglob("*.md")]
    rooms = {path.relative_to(package).parts[0] for path in files if path.parent != package}
    figures = {
        "lines in hpid_ros": sum(len(text.splitlines()) for text in texts),
        "  of them code": sum(map(code_lines, texts)),
        "files": len(files),
        "rooms": len(rooms),
        "files imported by one sibling only": len(single_siblings(package, files)),
        "lines of tests": sum(len(text.splitlines()) for text in tests),
        "lines of docs": sum(len(text.splitlines()) for text in docs),
    }
    for name, value in figures.items():
        print(f"{name:36} {value:7}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1])
