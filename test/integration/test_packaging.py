"""What a build installs, and what package.xml and the files of the project say of it."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from catkin_pkg.package import parse_package
from harness.places import ROOT

import hpid_ros
from hpid_ros.base.libraries import OPTIONAL

pytestmark = pytest.mark.repository

EXECUTABLES = {
    "joint_controller",
    "joint_controllers",
    "joint_command_merger",
    "pybullet_bridge",
    "mujoco_bridge",
    "trajectory_publisher",
    "follow_joint_trajectory",
    "bag_recorder",
    "bag_metrics",
    "live_tuner",
    "single_process",
    "hpid",
}


def run(*command, **options):
    ended = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Return a copy of what is under version control or about to be."""
    folder = tmp_path_factory.mktemp("workspace") / "src" / "hpid_ros"
    names = ("package.xml", "setup.py", "setup.cfg", "resource", "config", "launch", "urdf")
    folder.mkdir(parents=True)
    for name in (*names, "hpid_ros", "hpid_bench", "LICENSE", "README.md"):
        run("cp", "-r", str(ROOT / name), str(folder / name))
    return folder


@pytest.fixture(scope="module")
def installed(source):
    """Return the install tree of a colcon build."""
    workspace = source.parents[1]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    colcon = Path(sys.executable).parent / "colcon"
    run(colcon, "build", "--event-handlers", "console_direct+", cwd=workspace, env=environment)
    return workspace / "install" / "hpid_ros"


def test_colcon_puts_every_executable_where_ros2_run_looks(installed):
    found = {path.name for path in (installed / "lib" / "hpid_ros").iterdir()}
    assert found == EXECUTABLES
    assert all(os.access(installed / "lib" / "hpid_ros" / name, os.X_OK) for name in found)


def test_colcon_builds_it_as_an_ament_package(installed):
    index = installed / "share" / "ament_index" / "resource_index" / "packages" / "hpid_ros"
    assert index.is_file()
    share = installed / "share" / "hpid_ros"
    assert (share / "hook").is_dir(), "no ament hooks: colcon fell back to a plain package"
    for name in ("package.xml", "config", "launch", "urdf"):
        assert (share / name).exists()
    for file in (ROOT / "config").rglob("*.yaml"):
        assert (share / file.relative_to(ROOT)).read_bytes() == file.read_bytes()


def test_an_installed_executable_finds_its_share_folder(installed, tmp_path):
    """Run from elsewhere, with the install tree sourced, as ros2 run does."""
    script = (
        f". {installed}/share/hpid_ros/package.sh && {installed}/lib/hpid_ros/hpid --version && "
        f"{sys.executable} -c 'from hpid_ros.base.resources import share_folder as s; print(s())'"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    environment["COLCON_CURRENT_PREFIX"] = str(installed)
    version, share = run("sh", "-c", script, cwd=tmp_path, env=environment).splitlines()
    assert version.startswith("hpid_ros ")
    assert Path(share) == installed / "share" / "hpid_ros"


def test_a_wheel_holds_every_file_and_command(source, tmp_path):
    run(
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--wheel-dir",
        str(tmp_path),
        str(source),
    )
    (wheel,) = tmp_path.glob("hpid_ros-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (entries,) = (name for name in names if name.endswith("entry_points.txt"))
        entry_points = archive.read(entries).decode()
    for path in ("config/experiments/paper.yaml", "urdf/mobile_manipulator.urdf", "package.xml"):
        assert any(name.endswith(f"data/share/hpid_ros/{path}") for name in names)
    of_report = ("report/assets/chart.js", "report/templates/page.html")
    for file in ("py.typed", *of_report, "tuning/templates/loop.c", "tuning/templates/loop.h"):
        assert f"hpid_bench/{file}" in names
    houses = dict.fromkeys(("hpid", "live_tuner"), "hpid_bench")
    for name in EXECUTABLES:
        assert f"{name} = {houses.get(name, 'hpid_ros')}." in entry_points


# package.xml -----------------------------------------------------------------------------------

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

WITHOUT_KEY = {name for name in OPTIONAL if name not in KEY_OF} - {"rclpy"} | {
    "compression",
    "simulation_interfaces",
    "controller_manager_msgs",
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
    return found - sys.stdlib_module_names - {"hpid_ros", "hpid_bench", "benchmarks"}


def test_what_benchmarks_import_comes_with_their_extra():
    text = (ROOT / "setup.py").read_text()
    (extra,) = re.findall(r'"peers": \[(.*?)\n    \]', text, re.DOTALL)
    named = {"mcap-ros2-support": "mcap_ros2", "roboto-mcap-codec": "mcap_codec"}
    names = re.findall(r'"([\w-]+)', extra)
    known = {named.get(name, name.replace("-", "_")) for name in names}
    assert imported_in("benchmarks") - imported_in("hpid_ros", "hpid_bench") == known


def test_whatever_is_imported_has_its_key():
    keys = set(tool("check_rosdep_keys").keys_of(PACKAGE))
    imported = imported_in("hpid_ros", "hpid_bench", "launch") - WITHOUT_KEY
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


def test_each_key_is_said_to_resolve_where_it_does(rosdistro, tmp_path, capsys):
    on_ubuntu = {
        **{"rclpy": "ros-jazzy-rclpy", "sensor_msgs": "ros-jazzy-sensor-msgs"},
        **{"python3-plain": "python3-plain", "python3-by-version": "python3-new"},
        **{"python3-by-apt": "one two", "python3-some-pip": "pip", "python3-old": "-"},
        **{"waiting": "-", "unreleased": "-", "nobody_knows": "-"},
    }

    def checked(keys):
        package = ElementTree.Element("package")
        for key in keys:
            ElementTree.SubElement(package, "exec_depend").text = key
        ElementTree.ElementTree(package).write(tmp_path / "package.xml")
        options = [str(rosdistro), "--package", str(tmp_path / "package.xml")]
        code = tool("check_rosdep_keys").main(options)
        return code, capsys.readouterr().out.splitlines()

    code, (head, *rows) = checked(on_ubuntu)
    assert code == 1
    assert re.split(r"  +", head) == ["key", "ubuntu noble", "rhel 9"]
    found = dict(re.split(r"  +", row)[:2] for row in rows[: len(on_ubuntu)])
    assert found == on_ubuntu
    missing = {key for key, name in on_ubuntu.items() if name in ("-", "pip")}
    assert set(re.split("[:,] ?", rows[-1])[1:]) == missing
    code, rows = checked(["rclpy", "python3-plain"])
    assert (code, rows[-1].endswith(": none")) == (0, True)


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


# Files of the project ---------------------------------------------------------------------------

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]


def steps(workflow):
    document = yaml.safe_load(workflow.read_text())
    for job in document["jobs"].values():
        yield from ((job, step) for step in job["steps"])


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_uses_released_actions_and_files_that_are_there(workflow):
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for _, step in steps(workflow):
        assert step.keys() & {"uses", "run"}
        assert re.fullmatch(r"[\w-]+/[\w-]+@v[\d.]+", step.get("uses", "a/b@v1"))
        for target in re.findall(r"\bmake ([a-z]+)", step.get("run", "")):
            assert target in targets
        for path in re.findall(r"(?<![\w/])((?:tools|\.ci)/[\w.]+)", step.get("run", "")):
            assert (ROOT / path).exists()


def test_the_suite_and_the_wheel_are_tried_with_every_python_that_is_named():
    matrices = [
        job["strategy"]["matrix"]["python"]
        for workflow in WORKFLOWS
        for job, _ in steps(workflow)
        if "python" in job.get("strategy", {}).get("matrix", {})
    ]
    assert matrices
    assert all(matrix == PYTHONS for matrix in matrices)
    setup = (ROOT / "setup.py").read_text()
    assert re.findall(r"Python :: (3\.\d+)\"", setup) == PYTHONS


@pytest.mark.parametrize("form", [each for each in FORMS if each.stem != "config"])
def test_an_issue_form_has_what_github_asks_for(form):
    document = yaml.safe_load(form.read_text())
    assert document.keys() >= {"name", "description", "body"}
    fields = [each for each in document["body"] if each["type"] != "markdown"]
    assert all(each["attributes"]["label"] for each in fields)
    assert len({each["id"] for each in fields}) == len(fields)


def test_the_citation_is_of_this_version_and_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == hpid_ros.__version__
    assert citation["license"] == "Apache-2.0"
    (paper,) = citation["references"]
    assert paper["identifiers"][0]["value"] == "arXiv:2511.16406"
    assert [each["family-names"] for each in paper["authors"]] == ["Luna", "Chairez", "Polyakov"]


def pins(text):
    """Return the versions that a text asks for, by library."""
    found = re.findall(r'"?([A-Za-z][\w.-]*)"?(?: = ")?(>=[\d.]+,<[\d.]+)', text)
    return {name.lower().replace("-python", "").replace("-base", ""): each for name, each in found}


@pytest.mark.parametrize("path", ["docker/Dockerfile", "docs/install.md", "pixi.toml"])
def test_the_other_ways_to_install_ask_for_the_same_versions(path):
    wanted = pins((ROOT / "setup.py").read_text())
    wanted |= {"pinocchio": wanted["pin"]}
    asked = pins((ROOT / path).read_text())
    assert {"mujoco", "rosbags", "backports.zstd"} <= asked.keys()
    assert {name: wanted[name] for name in asked} == asked
