"""Say which key of package.xml rosdep resolves where, from rosdistro's own files.

    git clone --depth 1 https://github.com/ros/rosdistro
    python tools/check_rosdep_keys.py rosdistro

Nothing is installed and no rosdep is needed. The platforms are those for which the distribution
is released (``release_platforms``). Exit code 1 if a key does not resolve on Ubuntu, or only by
pip: there bloom refuses the package, and an externally managed Python refuses pip.

Source: REP 111 (rules of rosdep), REP 143 (distribution files).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import yaml

PACKAGE = Path(__file__).parents[1] / "package.xml"
RULES = ("base.yaml", "python.yaml")
REQUIRED = "ubuntu"
NOWHERE, BY_PIP = "-", "pip"


class Platform(NamedTuple):
    """An operating system, as rosdep names it, and the name of its version."""

    system: str
    version: str


class Distro(NamedTuple):
    """What rosdistro says of one ROS distribution.

    Attributes:
        name: For instance ``"jazzy"``.
        platforms: For which it is released, the required one first.
        packages: Released ROS packages.
        rules: Of rosdep, by key.
    """

    name: str
    platforms: tuple[Platform, ...]
    packages: frozenset[str]
    rules: Mapping[str, Any]

    def resolve(self, key: str, platform: Platform) -> str:
        """Return what a key installs on a platform; :data:`NOWHERE` if nothing."""
        if key in self.packages:
            return f"ros-{self.name}-{key.replace('_', '-')}"
        return _installed(self.rules.get(key), platform)


def load(rosdistro: Path, name: str) -> Distro:
    """Read what is said of a distribution.

    Args:
        rosdistro: A checkout of ros/rosdistro.
        name: The distribution.

    Raises:
        OSError: It is no such checkout, or has no such distribution.
    """
    document = _yaml(rosdistro / name / "distribution.yaml")
    platforms = [
        Platform(system, str(version))
        for system, versions in document["release_platforms"].items()
        for version in versions
    ]
    rules: dict[str, Any] = {}
    for file in RULES:
        rules |= _yaml(rosdistro / "rosdep" / file)
    return Distro(
        name,
        tuple(sorted(platforms, key=lambda each: each.system != REQUIRED)),
        frozenset(_released(document["repositories"])),
        rules,
    )


def keys_of(package: Path) -> dict[str, list[str]]:
    """Return the keys that a package.xml names, each with the kinds of dependency that it is."""
    keys: dict[str, list[str]] = {}
    for element in ElementTree.parse(package).getroot():
        if element.tag.endswith("depend") and element.text:
            keys.setdefault(element.text.strip(), []).append(element.tag)
    return keys


def _yaml(path: Path) -> Any:
    with path.open(encoding="utf-8") as stream:
        return yaml.load(stream, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def _released(repositories: Mapping[str, Any]) -> Iterator[str]:
    for name, repository in repositories.items():
        release = repository.get("release", {})
        if "version" in release:  # without one it waits for its first release
            yield from release.get("packages", [name])


def _installed(rule: Any, platform: Platform) -> str:
    """Return what a rule installs: a list, a table by version, or one by installer."""
    rule = rule.get(platform.system, rule.get("*")) if isinstance(rule, Mapping) else rule
    if isinstance(rule, Mapping) and not rule.keys() & {BY_PIP, "apt", "packages"}:
        rule = rule.get(platform.version, rule.get("*"))
    if isinstance(rule, Mapping):
        if BY_PIP in rule:
            return BY_PIP
        rule = rule.get("apt", rule).get("packages")
    return " ".join(rule) if isinstance(rule, list) else str(rule or NOWHERE)


def main(args: Sequence[str] | None = None) -> int:
    """Print the table and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rosdistro", type=Path, help="a checkout of ros/rosdistro")
    parser.add_argument("--ros", default="jazzy", metavar="NAME", help="distribution (jazzy)")
    parser.add_argument("--package", type=Path, default=PACKAGE, help="another package.xml")
    options = parser.parse_args(args)
    try:
        distro, keys = load(options.rosdistro, options.ros), keys_of(options.package)
    except OSError as error:
        where = f"{options.rosdistro} is no checkout of ros/rosdistro with {options.ros}"
        print(f"{parser.prog}: {where}: {error.filename} is missing", file=sys.stderr)
        return 2
    heads = [f"{each.system} {each.version}" for each in distro.platforms]
    rows = [["key", *heads]]
    rows += [[key, *(distro.resolve(key, each) for each in distro.platforms)] for key in keys]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(map(str.ljust, row, widths)).rstrip())
    failed = [row[0] for row in rows[1:] if row[1] in (NOWHERE, BY_PIP)]
    named = ", ".join(failed) or "none"
    print(f"\n{len(keys)} keys; not resolved on {heads[0]} without pip: {named}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
