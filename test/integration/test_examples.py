"""Every example runs alone and says what it promises."""

import json
import re
import runpy
import subprocess
import sys
from types import ModuleType

import matplotlib
import pytest
from harness.places import ROOT

from hpid_ros.control import LOOP_PARAMETERS

pytestmark = pytest.mark.repository

EXAMPLES = ROOT / "examples"
SAYS = {
    "law/double_integrator.py": r"(?s)^PID +settles in 1\.164 s\n.*mu -0\.2 settles in 0\.\d+ s"
    r".*hPID, mu \+0\.2 does not settle within 5 s",
    "law/degrees_on_the_robot.py": r"\+0\.2 +0\.\d+ rad",
    "law/homogeneous_norm.ipynb": r"mu \+0\.3: n\(d\(s\) x\) = e\^s n\(x\) to \de-1\d",
    "law/own_law.py": r"PID +overshoot 0\.24\d+.*\nClegg +overshoot 0\.10\d+",
    "law/own_norm.py": r"LargerPart +homogeneous to \de-1\d, settles in 0\.6\d+ s, "
    r"certified: to a hundredth in 0\.7\d+ s",
    "recordings/write_bag.py": r"/joint_states +sensor_msgs/msg/JointState +1000 messages",
    "recordings/indices_of_a_signal.py": r"IVC +\d+\.\d+ N m",
    # 0.5 exp(-4 t) is below 0.05 from ln(10) / 4 = 0.5756 s on, 0.3 exp(-8 t) from ln(6) / 8 on
    "recordings/own_index.py": r"shoulder +0\.576 s above 0\.05 rad\nelbow +0\.22[46] s",
    "recordings/bag_to_pandas.py": r"(?s)shoulder.*0\.4998.*elbow",
    "recordings/report_from_python.py": r"IAVC +fast / slow +0\.667\n.*\nwritten: report\.html",
    "robot/own_urdf.py": r"shoulder within 0\.01 rad after 0\.\d+ s, holds with -3\.0\d N m",
    "robot/trajectory_by_code.py": r"arm_joint_4: at \+0\.3\d+ rad",
    "ros/own_node.py": r"elbow: 0\.(49\d\d|50\d\d) rad after 1\.2 s, wanted 0\.5",
    "ros/driver_adapter.py": r"\d+ commands, at [+-]\d+\.\d+ rad, wanted \+0\.3 rad",
    "ros/odrive_can.py": r"node 1, closed loop +: 027#08000000",
    "ros/retuning_client.py": r"mu = -0\.1: taken\n.*: taken\nmu = 0\.6: refused: .*\n.*: refused",
    "ros/send_trajectory.py": r"3 points for shoulder, elbow, heard by no controllers",
    "ros/action_client.py": r"no server of joint_traj|control_msgs is not installed",
}
LAUNCH = sorted((EXAMPLES / "launch").glob("*.launch.py"))


def code_of(notebook):
    """Return the code of a notebook as one text."""
    cells = json.loads(notebook.read_text())["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize("name", [each for each in SAYS if not each.startswith("ros/")])
def test_an_example_says_what_it_promises(name, tmp_path, monkeypatch, capsys):
    """In this process, which has imported most of what it needs, as if it were started alone."""
    path = EXAMPLES / name
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(path.parent)
    monkeypatch.setattr(sys, "argv", [str(path)])
    if path.suffix == ".ipynb":
        matplotlib.use("Agg")
        exec(compile(code_of(path), name, "exec"), {"__name__": "__main__"})
    else:
        runpy.run_path(str(path), run_name="__main__")
    assert re.search(SAYS[name], capsys.readouterr().out)


@pytest.mark.parametrize("name", [each for each in SAYS if each.startswith("ros/")])
def test_an_example_on_the_graph_says_what_it_promises(name, tmp_path, module_harness):
    """In a domain of the tests, without a robot."""
    command = [sys.executable, EXAMPLES / name]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert re.search(SAYS[name], ended.stdout)


def test_every_example_is_run_and_listed():
    found = {
        str(path.relative_to(EXAMPLES))
        for path in EXAMPLES.rglob("*")
        if path.suffix in (".py", ".ipynb")
    }
    assert found == {*SAYS, *(f"launch/{path.name}" for path in LAUNCH)}
    listed = re.findall(r"^\| \[([^]]+)\]", (EXAMPLES / "README.md").read_text(), re.MULTILINE)
    assert set(listed) == found

    for folder in {EXAMPLES, *(path.parent for path in EXAMPLES.rglob("*.py"))}:
        assert len([each for each in folder.iterdir() if each.name != "__pycache__"]) <= 14


def test_the_notebook_is_kept_without_outputs():
    for path in EXAMPLES.rglob("*.ipynb"):
        for cell in json.loads(path.read_text())["cells"]:
            assert not cell.get("outputs")
            assert cell.get("execution_count") is None


class Told:
    """Stands for any class of launch and launch_ros: keeps what it was told."""

    made: list = []  # noqa: RUF012 (of one test)

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs
        Told.made.append(self)


@pytest.fixture
def without_launch(monkeypatch):
    """Put stand-ins where ROS's launch is imported from; its own is in no wheel."""
    Told.made = []
    names = ("", ".actions", ".substitutions", ".launch_description_sources")
    ros = ("", ".actions", ".substitutions", ".parameter_descriptions")
    for name in [*(f"launch{each}" for each in names), *(f"launch_ros{each}" for each in ros)]:
        module = ModuleType(name)
        module.__getattr__ = lambda name: type(name, (Told,), {})
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.parametrize("path", LAUNCH, ids=lambda path: path.stem)
def test_a_launch_file_names_what_there_is(path, without_launch):
    described = runpy.run_path(str(path))["generate_launch_description"]()
    assert described.args
    nodes = [each for each in Told.made if type(each).__name__ == "Node"]
    assert {node.kwargs["package"] for node in nodes} > {"hpid_ros"} or "ros2_control" in path.name
    setup = (ROOT / "setup.py").read_text()
    others = {"command_interface", "state_clock", *LOOP_PARAMETERS}
    for node in nodes:
        if node.kwargs["package"] == "hpid_ros":
            assert f'"{node.kwargs["executable"]}"' in setup
            assert not set(node.kwargs["parameters"][0]) - others
    for each in Told.made:
        if type(each).__name__ == "PathJoinSubstitution":
            assert ROOT.joinpath(*each.args[0][1:]).is_file()
