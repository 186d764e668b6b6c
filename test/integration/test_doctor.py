"""``hpid doctor``: one line for each thing, and what to do where it is missing."""

import json
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from hpid_bench.cli.commands import DONE, FAILED, doctor
from hpid_bench.cli.main import main
from hpid_ros.simulation.settings import ENGINES

pytestmark = pytest.mark.slow


def without(monkeypatch, *names):
    found = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in names else found(name))


def failing(monkeypatch, message):
    ended = subprocess.CompletedProcess([], 1, "", f"Traceback\nbase.Error: {message}\n")
    monkeypatch.setattr(doctor, "_python", lambda program: ended)


@pytest.mark.alone  # discovery is looked at by the clock of the wall
def test_each_thing_has_a_line_and_two_nodes_meet_within_a_second(capsys, monkeypatch):
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    code = main(["doctor", "--json"])
    found = {each["name"]: each for each in json.loads(capsys.readouterr().out)}
    assert len(found) == len(doctor.LOOKS)
    assert found["discovery"]["state"] == doctor.GOOD, found
    assert code == (FAILED if "bad" in {each["state"] for each in found.values()} else DONE)


def test_what_is_printed_says_what_to_do(capsys, monkeypatch):
    bad = doctor.Finding(doctor.BAD, "none", "pip install mujoco")
    monkeypatch.setattr(doctor, "LOOKS", {"engines": lambda: bad, "Python": doctor.python})
    assert main(["doctor"]) == FAILED
    first, second, third = capsys.readouterr().out.splitlines()
    assert first.split() == ["bad", "engines", "none"]
    assert second.strip() == "-> pip install mujoco"
    assert third.startswith("ok    Python")


def test_a_python_that_is_not_known_is_noted(monkeypatch):
    monkeypatch.setattr(doctor, "sys", SimpleNamespace(version_info=(3, 99, 1), prefix="/usr"))
    assert doctor.python().state == doctor.NOTE


def test_no_ros_another_one_and_two_are_told(monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "humble")
    assert "hide the installed humble" in doctor.ros().found
    with monkeypatch.context() as patch:
        without(patch, "rclpy")
        assert doctor.ros().state == doctor.discovery().state == doctor.BAD
        assert doctor.middleware().found == doctor.discovery().found == doctor._NO_ROS
        assert "hpid_ros[ros]" in doctor.ros().remedy


def test_a_middleware_that_does_not_load_ends_nothing(monkeypatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_none")
    assert doctor.middleware().state == doctor.discovery().state == doctor.BAD
    assert "rmw_none does not load" in doctor.middleware().found


def test_nodes_that_may_not_find_each_other_are_told_with_the_setting(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    run, soon = (
        doctor._python,
        "from hpid_bench.live import discovery as d; d._GIVEN_UP_AFTER = 0.5\n",
    )
    monkeypatch.setattr(doctor, "_python", lambda program: run(soon + program))
    found = doctor.discovery()
    assert found.state == doctor.BAD
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF" in found.remedy


def test_shared_memory_that_is_full_or_not_there_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "SHARED_MEMORY", tmp_path)
    monkeypatch.setattr(doctor, "SHARED_MEMORY_ROOM", 2**80)
    assert "--shm-size" in doctor.shared_memory().remedy
    monkeypatch.setattr(doctor, "SHARED_MEMORY", Path("/nowhere"))
    assert doctor.shared_memory().state == doctor.BAD


def test_what_is_missing_is_told_with_what_it_is_for(monkeypatch):
    with monkeypatch.context() as patch:
        without(patch, "pybullet")
        assert doctor.engines().state == doctor.NOTE
        without(patch, *ENGINES)
        assert doctor.engines().state == doctor.BAD
        without(patch, "nicegui", "lz4")
        assert "nicegui, for the live page; lz4, for reading bags" in doctor.libraries().found
        assert "not tried" in doctor.drawing().found
    failing(monkeypatch, f"no OpenGL: {doctor._OPENGL}")
    assert doctor.drawing().state == doctor.real_time().state == doctor.NOTE
    assert doctor.drawing().remedy == doctor._OPENGL
    assert "mujoco: no OpenGL" in doctor.engines().found
