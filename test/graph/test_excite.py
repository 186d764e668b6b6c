"""Excitations through real nodes: recorded and telling, and at rest however they end."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from harness.turntable import (
    COULOMB,
    INERTIA,
    VISCOUS,
    positions,
    start_turntable,
    wait_for_rest,
)

from hpid_ros.base.errors import SettingError
from hpid_ros.cli.commands.motions import agreed
from hpid_ros.cli.main import main
from hpid_ros.live.graph_client import running_graph
from hpid_ros.live.motion import bounds_of, carry_out, chosen
from hpid_ros.motion.excitation import Design, Wish, plan

SHORT = Design(duration=6.0, band=(0.3, 3.0), fade=0.5)


@pytest.mark.alone  # in lock-step its timeouts are shorter on the clock of the wall
def test_an_excitation_is_shown_carried_out_recorded_and_tells_what_the_joint_is(
    harness, tmp_path, capsys
):
    start_turntable(harness, tmp_path, "lockstep")
    bag, options = tmp_path / "bag", ["--duration", "5", "--frequencies", "0.4", "3"]
    picture = tmp_path / "plan.png"
    assert main(["excite", *options, "--dry-run", "--plot", str(picture)]) == 0
    shown = capsys.readouterr().out
    assert "turn" in shown
    assert "its inertia is taken from its gains" in shown
    assert picture.stat().st_size > 10_000
    assert not bag.exists()
    assert np.ptp(positions(harness)) < 1e-3
    assert main(["excite", *options, "-o", str(bag), "--yes"]) == 0
    assert f"hpid identify {bag}" in capsys.readouterr().out
    assert wait_for_rest(harness) == pytest.approx(0.0, abs=0.02)
    assert main(["excite", *options, "-o", str(bag), "--yes"]) == 2  # nothing is written over
    assert main(["identify", str(bag), "--json", str(tmp_path / "found.json")]) == 0
    found = read_estimates(tmp_path / "found.json")
    assert found["inertia"] == pytest.approx(INERTIA, rel=0.03)
    assert found["viscous"] == pytest.approx(VISCOUS, rel=0.1)
    assert found["coulomb"] == pytest.approx(COULOMB, rel=0.1)


def read_estimates(file):
    (joint,) = json.loads(file.read_text())["joints"].values()
    return {name: each["value"] for name, each in joint["estimates"].items()}


@pytest.mark.faults
def test_whatever_ends_an_excitation_the_joint_comes_to_rest_and_is_held(harness, tmp_path):
    start_turntable(harness, tmp_path, "lockstep")
    graph = running_graph()
    controllers = chosen(graph, [])
    (bounds,) = [bounds_of(each, INERTIA) for each in controllers]
    stood = []

    def stand_still(event, seconds):
        """Do nothing, as a command that Ctrl-Z has stopped, until the joint rests for good."""
        while event == "at" and seconds > 1.0 and not stood:
            if np.ptp(positions(harness, 2.0)) < 2e-3:
                stood.append(seconds)

    for effort, tell, reason in (
        (10.0, interrupt, "it was interrupted"),
        (10.0, stand_still, "the command that watches it was stopped"),
        (0.01, lambda *_: None, "from its reference, its tolerance is"),  # less than friction
    ):
        design = SHORT._replace(duration=20.0) if tell is stand_still else SHORT
        made = plan([replace(bounds, position=positions(harness)[-1])], Wish(), design)
        harness.set_parameters("turn_controller", u_clamp_max=effort, u_clamp_min=-effort)
        bag = tmp_path / reason
        ending = carry_out(made, controllers, graph, bag, tell)
        harness.set_parameters("turn_controller", u_clamp_max=10.0, u_clamp_min=-10.0)
        wait_for_rest(harness)
        assert reason in ending.reason
        assert ending.is_interrupted == (tell is interrupt)
        assert (bag / "metadata.yaml").exists()


def interrupt(event, seconds):
    """Interrupt a motion under way."""
    if event == "at" and seconds > 1.0:
        raise KeyboardInterrupt


def test_joints_do_not_move_before_somebody_says_yes(monkeypatch, capsys):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    assert agreed("Move", is_given=True)
    for answer, meant in (("y\n", True), ("Yes\n", True), ("\n", False), ("", False)):
        monkeypatch.setattr("sys.stdin", Terminal(answer))
        assert agreed("Move", is_given=False) is meant
    assert "Move? [y/N]" in capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    with pytest.raises(SettingError, match="--yes"):
        agreed("Move", is_given=False)
