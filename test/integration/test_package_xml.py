"""package.xml says what the code imports, in words that rosdep and bloom take."""

import ast
import importlib.util
import re
import sys
from xml.etree import ElementTree

import pytest
import yaml
from catkin_pkg.package import parse_package
from harness.places import ROOT

import hpid_ros
from hpid_ros.base.processes import OPTIONAL

pytestmark = pytest.mark.repository

PACKAGE = ROOT / "package.xml"
KEY_OF = {
    **{
        name: f"python3-{name}"
        for name in ("argcomplete", "jinja2", "joblib", "matplotlib", "numpy", "rich")
    },
    **{"scipy": "python3-scipy", "yaml": "python3-yaml", "markupsafe": "python3-jinja2"},
    "PIL": "python3-pil",
}
"""Keys of Python modules; those of ROS packages have the module's name."""

WITHOUT_KEY = {*OPTIONAL} - {"rclpy"} | {
    *("compression", "simulation_interfaces", "controller_manager_msgs")
}
"""Imported where they are installed; the last two add services, and nothing is missed without."""


def tool(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def runtime_imports(tree):
    """Yield modules that are imported when the code runs, not only for its types."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module.partition(".")[0]
        yield from runtime_imports(node)


def imported_in(*folders):
    found = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        found |= set(runtime_imports(ast.parse(path.read_text())))
    return found - sys.stdlib_module_names - {"hpid_ros", "benchmarks"}


def test_what_benchmarks_import_comes_with_their_extra():
    (extra,) = re.findall(r'"bench": \[(.*?)\]', (ROOT / "setup.py").read_text())
    known = {name.replace("-", "_") for name in re.findall(r'"([\w-]+)', extra)}
    assert imported_in("benchmarks") - imported_in("hpid_ros") == known


def test_whatever_is_imported_has_its_key():
    keys = set(tool("check_rosdep_keys").keys_of(PACKAGE))
    imported = imported_in("hpid_ros", "launch") - WITHOUT_KEY
    assert {"rclpy", "launch", "numpy", "ament_index_python"} <= imported
    assert "pinocchio" in keys
    assert {KEY_OF.get(name, name) for name in imported} - keys == set()


def test_catkin_and_bloom_take_it():
    """Name and licence as REP 144 and REP 149 (SPDX) ask; catkin_pkg warns of what they refuse."""
    warnings = []
    package = parse_package(str(PACKAGE), warnings=warnings)
    assert not warnings
    assert re.fullmatch(r"[a-z][a-z0-9_]+[a-z0-9]", package.name)
    (licence,) = package.licenses
    assert (licence, licence.file) == ("Apache-2.0", "LICENSE")
    assert "Apache License" in (ROOT / "LICENSE").read_text()
    assert package.get_build_type() == "ament_python"
    assert package.authors
    assert package.maintainers[0].email.rpartition(".")[2] in {"org", "com", "net"}
    assert package.package_format == 3


def test_one_version_everywhere():
    version = parse_package(str(PACKAGE)).version
    assert hpid_ros.__version__ == version
    assert f'version="{version}"' in (ROOT / "setup.py").read_text()
    assert f"\n{version} (" in (ROOT / "CHANGELOG.rst").read_text()


RULES = {
    "python3-plain": {"ubuntu": ["python3-plain"]},
    "python3-by-version": {"ubuntu": {"jammy": None, "*": ["python3-new"]}, "rhel": None},
    "python3-some-pip": {"ubuntu": {"pip": {"packages": ["some"]}}},
    "python3-by-apt": {"ubuntu": {"noble": {"apt": {"packages": ["one", "two"]}}}},
    "python3-old": {"ubuntu": {"jammy": ["python3-old"]}},
}


@pytest.fixture
def rosdistro(tmp_path):
    """Return a small checkout of the form of ros/rosdistro."""
    repositories = {
        "rclpy": {"release": {"version": "1.0.0-1"}},
        "messages": {"release": {"packages": ["sensor_msgs"], "version": "1.0.0-1"}},
        "waiting": {"release": {"url": "of its releases, of which there is none"}},
        "unreleased": {"source": {"version": "main"}},
    }
    distribution = {
        "release_platforms": {"rhel": ["9"], "ubuntu": ["noble"]},
        "repositories": repositories,
    }
    for path, document in (
        ("jazzy/distribution.yaml", distribution),
        ("rosdep/base.yaml", {}),
        ("rosdep/python.yaml", RULES),
    ):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(yaml.safe_dump(document))
    return tmp_path


@pytest.mark.parametrize(
    ("key", "on_ubuntu"),
    [
        ("rclpy", "ros-jazzy-rclpy"),
        ("sensor_msgs", "ros-jazzy-sensor-msgs"),
        ("python3-plain", "python3-plain"),
        ("python3-by-version", "python3-new"),
        ("python3-by-apt", "one two"),
        ("python3-some-pip", "pip"),
        ("python3-old", "-"),
        ("waiting", "-"),
        ("unreleased", "-"),
        ("nobody_knows", "-"),
    ],
)
def test_each_key_is_said_to_resolve_where_it_does(key, on_ubuntu, rosdistro, tmp_path, capsys):
    package = ElementTree.Element("package")
    ElementTree.SubElement(package, "exec_depend").text = key
    ElementTree.ElementTree(package).write(tmp_path / "package.xml")
    code = tool("check_rosdep_keys").main(
        [str(rosdistro), "--package", str(tmp_path / "package.xml")]
    )
    head, row, *_, summary = capsys.readouterr().out.splitlines()
    assert re.split(r"  +", head) == ["key", "ubuntu noble", "rhel 9"]
    assert re.split(r"  +", row)[:2] == [key, on_ubuntu]
    is_resolved = on_ubuntu not in ("-", "pip")
    assert code == int(not is_resolved)
    assert summary.endswith(": none" if is_resolved else f": {key}")


def test_a_folder_that_is_no_rosdistro_is_one_line(tmp_path, capsys):
    assert tool("check_rosdep_keys").main([str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "is no checkout of ros/rosdistro with jazzy" in line


def test_python_versions_are_said_alike():
    """In pyproject.toml for the tools, and for pip."""
    least = re.search(r'python_requires=">=([\d.]+)"', (ROOT / "setup.py").read_text())[1]
    tools = (ROOT / "pyproject.toml").read_text()
    assert f'python_version = "{least}"' in tools
    assert f'target-version = "py{least.replace(".", "")}"' in tools
