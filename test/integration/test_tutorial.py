"""The tutorial can be followed: its files are written, its commands typed, one after the other."""

import re
import shlex

import pytest
from harness.places import ROOT

from hpid_ros.cli.main import main

pytestmark = pytest.mark.repository

PAGE = (ROOT / "docs" / "tutorial.md").read_text()
FILES = dict(re.findall(r"```yaml\n# (\S+)\n(.*?)```", PAGE, re.DOTALL))
COMMANDS = re.findall(r"^\$ (.+)$", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """Return the folder after every command of the package, which all did what they were to."""
    folder = tmp_path_factory.mktemp("tutorial")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in COMMANDS:
            program, *arguments = shlex.split(command)
            if program == "hpid":
                assert main(arguments) == 0, command
    return folder


def test_it_ends_with_a_controller_file_and_a_report(followed):
    assert len(FILES) == 2
    for name in ("my_hpid.yaml", "report.html"):
        assert (followed / name).is_file()
    text = (followed / "my_hpid.yaml").read_text()
    assert text.count("law: hpid") == 2
    degrees = re.findall(r"^    mu: (\S+)", text, re.MULTILINE)
    assert all(float(degree) < -0.1 for degree in degrees)


def test_what_is_typed_on_the_robot_names_nodes_and_parameters_that_there_are():
    setup = (ROOT / "setup.py").read_text()
    typed = [command for command in COMMANDS if command.startswith("ros2 ")]
    assert len(typed) == 5
    for command in typed:
        for node in re.findall(r"ros2 run hpid_ros (\w+)", command):
            assert f'"{node}"' in setup
        for node in re.findall(r"ros2 param set (\S+) mu", command):
            assert f"{node}:" in FILES["my_pid.yaml"]
