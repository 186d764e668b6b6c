"""Parameters as files, dumps and people give them: taken for what they say, or refused by name."""

import importlib
import json
import os
import subprocess
import sys
from fnmatch import fnmatch
from functools import partial
from importlib.util import find_spec

import pytest
import yaml
from harness.bags import small_log, write_bag
from harness.engines import BRIDGE, INSTALLED, needs_bullet
from harness.fork_server import run_node
from harness.graph import ros_arguments
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import parameter_dict_from_yaml_file, parameter_value_to_python
from std_msgs.msg import Float64MultiArray

from hpid_bench.experiment.processes import module_of
from hpid_ros.base.resources import share_folder
from hpid_ros.nodes.core.process import LAUNCH

MS = 1_000_000
LISTENS_WITHIN = 150.0  # [s]; nine processes start at once, perhaps on a busy machine
EXECUTABLES = (
    "joint_controller",
    "joint_controllers",
    "single_process",
    "joint_command_merger",
    *(f"{engine}_bridge" for engine in INSTALLED),
    "trajectory_publisher",
    "bag_recorder",
    "bag_metrics",
)
ACTION = "follow_joint_trajectory"
STARTED = (*EXECUTABLES, ACTION) if find_spec("control_msgs") else EXECUTABLES
JOINTS = [f"joint_{number}" for number in range(8)]
OF_EVERY_NODE = {"use_sim_time", "start_type_description_service"}


def test_help_that_nobody_reads_is_no_fault():
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "hpid_ros.nodes.joint_controller", "--help"]
    with os.fdopen(write, "wb") as stream:
        done = subprocess.run(command, stdout=stream, stderr=subprocess.PIPE, timeout=300)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("name", [*EXECUTABLES, ACTION, "live.live_tuner"])
def test_help_is_a_few_lines_and_starts_nothing(name, capsys, monkeypatch):
    module = importlib.import_module(module_of(name))
    monkeypatch.setattr("rclpy.init", None)
    niceness = os.nice(0)
    for option in ("--help", "-h"):
        assert module.main([name, option]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].startswith(f"usage: {name.rpartition('.')[2]} --ros-args")
        assert len(lines) < 35
        assert max(map(len, lines)) <= 80
    assert os.nice(0) == niceness


class Graph:
    """All executables at once, the composed and the single one in namespaces of their own."""

    def __init__(self, harness, folder):
        self._harness, self._folder = harness, folder
        harness.node.create_subscription(  # its controllers wait for whoever hears the merger
            Float64MultiArray, "/many/joint_command_merger/commands", lambda _: None, 1
        )
        robot = {"initial_positions": [0.1] + 7 * [0.0]}
        self.arguments = {
            "joint_controller": ros_arguments(joint="elbow", gains__p=60, norm__floor=5e-5),
            "joint_controllers": [
                "-p",
                f"joints:=[{', '.join(JOINTS)}]",
                "-p",
                "merge:=true",
                "-r",
                "__ns:=/many",
            ],
            "single_process": [
                "-p",
                "joints:=[arm_joint_1]",
                "-p",
                f"bag:={folder / 'single'}",
                "-p",
                "record:=true",
                "-r",
                "__ns:=/one",
            ],
            "pybullet_bridge": [
                *ros_arguments(mode="realtime", real_time_factor=0.1, payload_mass=1, seed=3),
                "-p",
                f"initial_positions:={robot['initial_positions']}",
            ],
            "mujoco_bridge": ros_arguments(mode="realtime", real_time_factor=0.1, fixed_base=True),
            "joint_command_merger": [
                *ros_arguments(joints="[elbow, wrist]", fallback_efforts__elbow=1),
                *ros_arguments(command_timeouts__wrist=0.2),
            ],
            "trajectory_publisher": ros_arguments(
                reference_file=share_folder() / "config" / "experiments" / "tracking.yaml"
            ),
            "bag_recorder": ros_arguments(bag=folder / "recorded"),
            ACTION: ros_arguments(joints="[elbow, wrist]", constraints__elbow__goal=1),
            "bag_metrics": ["-p", f"bags:=[{folder / 'bag'}]", "-p", "keep_running:=true"],
        }
        self.nodes = {
            "joint_controller": ["/joint_controller"],
            "joint_controllers": [
                "/many/joint_controllers",
                f"/many/{JOINTS[7]}_controller",
                "/many/joint_command_merger",
            ],
            "single_process": [
                "/one/single_process",
                f"/one/{BRIDGE}",
                "/one/joint_controllers",
                "/one/arm_joint_1_controller",
                "/one/bag_recorder",
            ],
            **{f"{name}": [f"/{name}"] for name in EXECUTABLES[3:]},
            **({ACTION: ["/joint_trajectory_controller"]} if ACTION in STARTED else {}),
        }

    def start(self, suffix, arguments):
        return {
            name: self._harness.processes.start(
                f"{name}_{suffix}", name, arguments[name], is_renamed=False
            )
            for name in STARTED
        }

    def dump(self, node):
        """Return a node's parameters as ``ros2 param dump`` writes them, once it has them all.

        A controller's services are there before its subscription, which brings parameters along.
        """
        if node.endswith("controller"):
            self._harness.wait(
                lambda: self._hears_states(node), LISTENS_WITHIN, f"{node} to listen"
            )
        names = sorted(self._call(node, ListParameters, "list_parameters").result.names)
        values = self._call(node, GetParameters, "get_parameters", names=names).values
        assert len(values) == len(names)
        return dict(zip(names, map(parameter_value_to_python, values), strict=True))

    def _hears_states(self, node):
        namespace, _, name = node.rpartition("/")
        return self._harness.subscribes(name, f"{namespace}/joint_states", namespace or "/")

    def load(self, node, file):
        """Do what ``ros2 param load`` does, and return the reasons of what was refused."""
        parameters = parameter_dict_from_yaml_file(str(file), use_wildcard=True).values()
        results = self._call(
            node, SetParameters, "set_parameters", parameters=list(parameters)
        ).results
        return [result.reason for result in results if not result.successful]

    def are_fixed(self, node, names):
        found = self._call(node, DescribeParameters, "describe_parameters", names=names)
        return {each.name: each.read_only for each in found.descriptors}

    def set(self, node, **values):
        return self._harness.set_parameters(node, atomically=False, **values)

    def _call(self, node, kind, name, **request):
        return self._harness.call(kind, f"{node}/{name}", kind.Request(**request))


def nested(values):
    tree = {}
    for name, value in values.items():
        inner, *path = tree, *name.split(".")
        for part in path[:-1]:
            inner = inner.setdefault(part, {})
        inner[path[-1]] = value
    return tree


@pytest.mark.timeout(300)
def test_every_executable_starts_from_its_dump_and_takes_it_back(harness, tmp_path):
    write_bag(tmp_path / "bag", small_log())
    graph = Graph(harness, tmp_path)
    processes = graph.start("first", graph.arguments)
    dumps, files = {}, {}
    for executable, nodes in graph.nodes.items():
        usage = importlib.import_module(f"hpid_ros.nodes.{executable}").USAGE
        files[executable] = tmp_path / f"{executable}.yaml"
        document = {}
        for number, node in enumerate(nodes):
            dumps[node] = graph.dump(node)
            own = {node: {"ros__parameters": nested(dumps[node])}}
            file = tmp_path / f"{executable}_{number}.yaml"
            file.write_text(yaml.dump(own, default_flow_style=False))
            assert graph.load(node, file) == [], node
            document |= own
        files[executable].write_text(yaml.dump(document, default_flow_style=False))
        told = {name for name in dumps[nodes[0]] if not name.startswith("qos_overrides.")}
        for name in told - OF_EVERY_NODE:
            assert any(fnmatch(name, pattern) for pattern in usage.parameters), name
    assert dumps["/joint_controller"]["cpu_affinity"] is None
    assert dumps["/joint_controller"]["gains.p"] == 60.0

    # A real change of what is fixed is refused by its name, an integer is a double.
    for node, values in dumps.items():
        fixed = graph.are_fixed(node, ["status_fd" if "status_fd" in values else "use_sim_time"])
        for name, is_fixed in fixed.items():
            assert is_fixed is (name == "status_fd")
            if is_fixed:
                other = values[name] + 1  # what it has it takes
                is_set, reason = graph.set(node, **{name: other})
                assert not is_set
                assert name in reason
    assert graph.set("/joint_controller", gains__p=61) == (True, "")
    assert graph.dump("/joint_controller")["gains.p"] == 61.0

    for process in processes.values():
        process.process.terminate()
    for name, process in processes.items():
        assert process.process.wait(60) == 0, (tmp_path / f"{name}_first.log").read_text()
    log = (tmp_path / "joint_controllers_first.log").read_text()
    assert "number of timers" not in log

    for folder in ("recorded", "single"):  # nothing is recorded over
        (tmp_path / folder).rename(tmp_path / f"{folder}_before")
    spaces = {name: graph.arguments[name][-2:] for name in ("joint_controllers", "single_process")}
    again = graph.start(
        "again",
        {n: ["--params-file", str(files[n]), *spaces.get(n, [])] for n in STARTED},
    )
    for node, before in dumps.items():
        after = graph.dump(node)
        # This parent's own pipe, and what was set above.
        changed = {"status_fd", "gains.p"}
        assert after | dict.fromkeys(changed) == before | dict.fromkeys(changed), node
    for name, process in again.items():
        process.process.terminate()
        assert process.process.wait(60) == 0, name


@pytest.mark.parametrize(
    ("executable", "document", "said"),
    [
        ("mujoco_bridge", {"mujoco_bridge": {"seed": 1}}, "/**/mujoco_bridge in it stands"),
        (
            "mujoco_bridge",
            {"/**/sim": {"seed": 1}},
            "or robot_description must be given",
        ),
        ("joint_controller", {"/joint_controller": {"joint": "a"}}, "has parameters for"),
        ("joint_controller", {"/**": {"joint": "a", "gains": {"p": "x"}}}, "gains.p must be a"),
    ],
)
def test_a_file_that_is_for_another_node_is_one_line_and_exit_code_two(
    harness, tmp_path, executable, document, said
):
    file = tmp_path / "parameters.yaml"
    sections = {name: {"ros__parameters": values} for name, values in document.items()}
    file.write_text(yaml.safe_dump(sections))
    ended = run_node(executable, ["--params-file", str(file), "-r", "__ns:=/a"])
    assert ended.returncode == 2
    assert said in ended.stderr.strip().splitlines()[-1]
    assert executable in ended.stderr
    assert "Traceback" not in ended.stderr


class Robot:
    """One of two robots: a bridge, its controllers and its reference in a namespace."""

    def __init__(self, harness, name, experiment, folder):
        from hpid_bench.experiment.in_process import write_run_files

        folder.mkdir()
        write_run_files(folder, experiment, experiment.controllers["PID"])
        space = ["-r", f"__ns:=/{name}"]
        start = partial(harness.processes.start, is_renamed=False)
        start(
            f"{name}_reference",
            "trajectory_publisher",
            [*ros_arguments(reference_file=experiment.path), *space],
        )
        start(
            f"{name}_controllers",
            "joint_controllers",
            [
                "--params-file",
                str(folder / "controllers.yaml"),
                *space,
                *ros_arguments(certify=False, wait_for_reference=True, state_watchdog=False),
            ],
        )
        joints = len(experiment.world.joints)
        self._bridge = start(
            f"{name}_bridge",
            f"{experiment.world.engine}_bridge",
            [
                "--params-file",
                str(folder / "bridge.yaml"),
                *space,
                *ros_arguments(frame_prefix=f"{name}/", wait_for_subscribers=joints + 1),
                *ros_arguments(wait_for_publishers=joints, exit_when_done=False),
            ],
        )
        self.end = None

    def has_finished(self):
        for event in self._bridge.read_events():
            if event["event"] == "finished":
                self.end = event
        return self.end is not None


@needs_bullet
@pytest.mark.timeout(200)
def test_two_robots_side_by_side_are_two_robots(harness, experiment_file, tmp_path):
    from nav_msgs.msg import Odometry

    from hpid_bench.experiment.description import load_experiment

    panda = yaml.safe_load((share_folder() / "config/experiments/panda.yaml").read_text())
    panda |= {"duration": 0.5, "control": {"rate": 1000, "answer_timeout": 120.0}}
    other = tmp_path / "panda.yaml"
    other.write_text(yaml.safe_dump(panda))
    experiments = {
        "left": load_experiment(experiment_file(duration=0.5)),
        "right": load_experiment(other),
    }
    frames = {}
    for name in experiments:
        harness.node.create_subscription(
            Odometry,
            f"/{name}/odom",
            lambda message, name=name: frames.setdefault(name, message.child_frame_id),
            10,
        )
    robots = {
        name: Robot(harness, name, experiment, tmp_path / name)
        for name, experiment in experiments.items()
    }
    harness.wait(
        lambda: len(frames) == 2 and all(robot.has_finished() for robot in robots.values()),
        within=150.0,
        what="both robots",
    )
    for name, experiment in experiments.items():
        counts = robots[name].end["counts"]
        assert list(counts) == list(experiment.world.joints), json.dumps(counts)
        assert all(each["unanswered"] == 0 for each in counts.values())
        assert robots[name].end["foreign"] == 0
        assert frames[name].startswith(f"{name}/")


def test_nodes_do_not_outlive_the_launch_that_started_them(harness, tmp_path):
    """As ``ros2 launch`` ends on SIGTERM: without a word to what it started."""
    node = [sys.executable, "-m", "hpid_ros.nodes.joint_controller", "--ros-args"]
    clock = {"state_clock": "simulated", "state_watchdog": False}  # a busy machine is no silence
    node += ros_arguments(joint="elbow", gains__p=10.0, **clock)
    launch = (
        "import os, subprocess, time\n"
        f"os.environ[{LAUNCH!r}] = str(os.getpid())\n"
        f"subprocess.Popen({node!r}, stdin=subprocess.DEVNULL).wait()\n"
    )
    reader, writer = os.pipe()  # its end is that of all who have it
    process = subprocess.Popen([sys.executable, "-c", launch], stdout=writer, stderr=writer)
    os.close(writer)
    os.set_blocking(reader, False)

    def has_ended():
        try:
            return os.read(reader, 65536) == b""
        except BlockingIOError:
            return False

    try:
        harness.wait(lambda: harness.states.get_subscription_count() == 1, what="the node")
        assert harness.ask(0, 0.0) == 0.0
        assert harness.ask(MS, -0.1) == pytest.approx(1.0)
        process.kill()
        harness.wait(has_ended, what="the node to end")
        harness.wait(lambda: harness.commands[-1].effort == (0.0,), what="the last command")
    finally:
        process.kill()
        process.wait()
        os.close(reader)
