"""``hpid play``: the simulated robot with its controllers and the live page, by one command."""

from __future__ import annotations

import argparse
import os
import shlex
import tempfile
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from hpid_bench.cli.commands import DONE
from hpid_bench.cli.options import experiment_to_run
from hpid_bench.cli.terminal import output_console
from hpid_bench.experiment.description import Experiment
from hpid_bench.experiment.graph_run import COMPOSED, TRAJECTORY_PUBLISHER
from hpid_bench.experiment.in_process import (
    bridge_document,
    bridge_name,
    write_document,
    write_run_files,
)
from hpid_bench.experiment.processes import NodeGroup, parameters
from hpid_ros.base.errors import ExperimentError, RunError, require_known
from hpid_ros.base.libraries import require_ros
from hpid_ros.base.names import controller_name, require_node_names
from hpid_ros.base.processes import raise_if_interrupted

_PAGE = "live_tuner"
_STARTS_WITHIN, _LOOK_PERIOD, _ENDS_WITHIN = 60.0, 0.1, 10.0  # [s]
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_PEERS = ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")
_CHOSEN = (_RANGE, "ROS_LOCALHOST_ONLY", *_PEERS)


def run(options: argparse.Namespace) -> int:
    require_ros("a robot to play with")
    experiment = experiment_to_run(options)
    label = options.controller or list(experiment.controllers)[-1]
    require_known("controller", [label], experiment.controllers, ExperimentError)
    require_node_names(experiment.world.joints, ExperimentError)
    console = output_console()
    with (
        tempfile.TemporaryDirectory(prefix="hpid_play_") as folder,
        NodeGroup(_environment(), Path(folder)) as group,
    ):
        try:
            _start(group, Path(folder), experiment, label, has_window=not options.no_window)
            bridge = bridge_name(experiment.world)
            _wait_for(group, bridge, "started", "all controllers", _STARTS_WITHIN)
            page = options.no_page or _start_page(group, options)
            _print(console, experiment, label, is_page_missing=not page)
            while True:
                _look_after(group)
                time.sleep(_LOOK_PERIOD)
        except KeyboardInterrupt:
            console.print("\nended")
            return DONE
        finally:
            group.stop(patience=_ENDS_WITHIN)


def _environment() -> dict[str, str]:
    """Return the environment of nodes that stay on this computer, unless the user says otherwise.

    A simulated robot must not answer to the controllers of a real one in the same network.
    """
    here = {} if any(name in os.environ for name in _CHOSEN) else {_RANGE: "LOCALHOST"}
    return {**os.environ, **here, "PYTHONUNBUFFERED": "1"}


def _start(
    group: NodeGroup, folder: Path, experiment: Experiment, label: str, *, has_window: bool
) -> None:
    settings = experiment.controllers[label]
    controllers, bridge = write_run_files(folder, experiment, settings)
    count = len(experiment.world.joints)
    group.start(
        TRAJECTORY_PUBLISHER, TRAJECTORY_PUBLISHER, parameters(reference_file=experiment.path)
    )
    group.start(
        COMPOSED,
        COMPOSED,
        [
            "--params-file",
            str(controllers),
            *parameters(wait_for_reference=True, state_clock="simulated"),
        ],
        is_renamed=False,
    )
    document = bridge_document(experiment, folder / "world.yaml")
    (values,) = document.values()
    values["ros__parameters"] |= {
        "mode": "realtime",
        "gui": has_window and bool(os.environ.get("DISPLAY")),
        "duration": 0.0,
        # The robot would fall while its controllers are still starting.
        "wait_for_subscribers": count + 1,
        "wait_for_publishers": count,
    }
    write_document(bridge, document)
    name = bridge_name(experiment.world)
    group.start(name, name, ["--params-file", str(bridge)])


def _start_page(group: NodeGroup, options: argparse.Namespace) -> bool:
    """Start the live page where its library is installed, and print its address."""
    if find_spec("nicegui") is None:
        return False
    arguments = parameters(open_browser=not options.no_browser, port=options.port)
    group.start(_PAGE, f"live.{_PAGE}", arguments)
    serving = _wait_for(group, _PAGE, "serving", "the page", _STARTS_WITHIN)
    print(f"page: {serving['url']}", flush=True)
    return True


def _print(console: Console, experiment: Experiment, label: str, *, is_page_missing: bool) -> None:
    joints = experiment.world.joints
    chosen = _environment()
    is_alone = chosen.get("ROS_LOCALHOST_ONLY") == "1" or (
        chosen.get(_RANGE) == "LOCALHOST" and not any(chosen.get(name) for name in _PEERS)
    )
    where = "this computer alone" if is_alone else "the network, as you chose"
    node = f"/{controller_name(joints[-1])}"
    lines = [
        f"robot: {experiment.name}, {len(joints)} joints under {label}, in real time by "
        f"{experiment.world.engine}, on {where}"
    ]
    if is_page_missing:
        lines.append("no page: pip install 'hpid_ros[live]' adds it")
    lines += [
        "in another terminal:",
        "  hpid check-gains --live                 # for which degrees are they certified?",
        f"  hpid excite --joint {shlex.quote(joints[-1])}         # move a joint, and record it",
        f"  ros2 param set {node} mu 0.2  # where ROS 2 is installed",
        "Ctrl-C ends it.",
    ]
    for line in lines:
        console.print(line, soft_wrap=True)


def _wait_for(
    group: NodeGroup, node: str, event: str, what: str, within: float
) -> Mapping[str, object]:
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        for each in group.nodes[node].read_events():
            if each["event"] == event:
                return each
        _look_after(group)
        time.sleep(_LOOK_PERIOD)
    raise RunError(f"waited {within:g} s in vain for {what}")


def _look_after(group: NodeGroup) -> None:
    """Raise where a node has ended: the others are of no use without it."""
    raise_if_interrupted()
    for name, node in group.nodes.items():
        code = node.process.poll()
        if code is not None and (name != TRAJECTORY_PUBLISHER or code):
            raise RunError(f"{name} ended with code {code}: {node.last_words()}")
