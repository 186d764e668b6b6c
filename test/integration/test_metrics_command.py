"""``hpid metrics`` as a user meets it: inputs, choices, outputs, one line for what is wrong."""

import contextlib
import csv
import io
import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import yaml
from harness.bags import FLOATS, JOINT_STATE, MS, floats, small_log, write_bag
from harness.experiments import write_experiment
from harness.studies import compared

from hpid_bench.cli.commands import BAD_INPUT, DONE
from hpid_bench.experiment.result_folder import MARKER
from hpid_ros.base import yaml_files
from hpid_ros.messages import metadata, storage
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.mcap_file import McapFile
from hpid_ros.messages.writer import BagWriter


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Return the folder of a short comparison."""
    folder = tmp_path_factory.mktemp("metrics")
    return compared(write_experiment(folder), folder / "result")


@pytest.fixture
def bags(result):
    return [result / "bags" / label for label in ("PID", "hPID")]


@pytest.fixture
def run(hpid):
    """Return a function that runs the command and gives its streams."""
    return partial(hpid, "metrics")


def saved_indices(result):
    return json.loads((result / "result.json").read_text())["indices"]


# Inputs ----------------------------------------------------------------------------------------


def test_bags_a_result_folder_and_saved_numbers_give_the_same_numbers(run, result, bags, tmp_path):
    saved = tmp_path / "saved.json"
    assert run(*bags, "--save", saved)[0] == DONE
    for arguments in (bags, [result], [result / "result.json"], [saved]):
        code, printed, errors = run(*arguments, "--json")
        assert code == DONE
        assert json.loads(printed) == saved_indices(result)
        assert errors == ""


def test_each_bag_is_opened_once_and_its_metadata_are_read_once(run, tmp_path, monkeypatch):
    read, opened = [], []

    def load_yaml(path, *others):
        read.append(path.parent.name)
        return yaml_files.load_yaml(path, *others)

    class CountedFile(McapFile):
        def __init__(self, path, report):
            opened.append(path.stem)
            super().__init__(path, report)

    monkeypatch.setattr(metadata, "load_yaml", load_yaml)
    monkeypatch.setattr(storage, "McapFile", CountedFile)
    for names in (["a"], ["b", "c"]):
        assert run(*(write_bag(tmp_path / name, small_log()) for name in names))[0] == DONE
        assert read == opened == names
        read.clear()
        opened.clear()


def test_labels_name_the_bags_and_equal_labels_are_repeats(run, bags):
    _, printed, _ = run(*bags, "--labels", "one", "two", "--json")
    assert list(json.loads(printed)["runs"]) == ["one", "two"]
    _, printed, _ = run(*bags, "--labels", "one", "one", "--json")
    (folded,) = json.loads(printed)["runs"].values()
    assert folded["repeats"] == 2
    by_group = run("--group", "one", *bags, "--json")[1]
    assert json.loads(by_group)["runs"]["one"] == folded


def test_labels_that_were_exchanged_are_noticed_by_the_law_that_ran(run, bags):
    _, _, errors = run(*bags, "--labels", "hPID", "PID")
    for label, law in (("hPID", "pid"), ("PID", "hpid")):
        assert f"run {label!r}: its controllers ran law {law!r}: were two" in errors
    for labels in (("before", "rapid"), ("pid_tuned", "hpid_tuned")):
        assert run(*bags, "--labels", *labels)[2] == ""


def test_a_label_in_the_bags_metadata_is_taken(run, result, tmp_path):
    bag = shutil.copytree(result / "bags" / "PID", tmp_path / "0001")
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["custom_data"] = {"label": "my arm"}
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    assert list(json.loads(run(bag, "--json")[1])["runs"]) == ["my arm"]


def test_the_baseline_is_chosen_by_path_or_label_and_may_be_another_bag(run, result, bags):
    pid, hpid = bags
    for arguments in ([pid, hpid, "--baseline", hpid], [result, "--baseline", "hPID"]):
        document = json.loads(run(*arguments, "--json")[1])
        assert document["baseline"] == "hPID"
        assert list(document["ratios"]) == ["PID"]
    document = json.loads(run(hpid, "--baseline", pid, "--json")[1])
    assert document == saved_indices(result)


def test_a_mismatch_is_a_warning_and_the_numbers_come_all_the_same(run, result, tmp_path):
    document = json.loads((result / "result.json").read_text())
    document["indices"]["runs"]["hPID"]["conditions"]["duration"] = 0.5
    other = tmp_path / "other.json"
    other.write_text(json.dumps(document))
    code, printed, errors = run(other)
    assert code == DONE
    assert "IVC" in printed
    lines = errors.splitlines()
    assert "hpid: warning: runs 'PID' and 'hPID': durations differ: 0.3 s and 0.5 s" in lines


# What a bag lacks ------------------------------------------------------------------------------


def states_bag(path, effort=True, count=400):
    template = JointStateTemplate(["elbow", "wrist"], position=True, effort=effort)
    log = []
    for k in range(count):
        position = [np.sin(0.01 * k), np.cos(0.01 * k)]
        content = {"effort": [2.0 * np.cos(0.01 * k), 0.5]} if effort else {}
        raw = template.encode(k * 5 * MS + MS, position=position, **content)
        log.append(("joint_states", k * 5 * MS + MS, raw))
    return log


def test_a_bag_of_states_alone_gives_its_effort_indices_and_one_line_for_the_rest(run, tmp_path):
    bag = write_bag(tmp_path / "states", states_bag(tmp_path))
    code, printed, errors = run(bag)
    assert code == DONE
    assert "states: effort: measured, of /joint_states." in printed
    assert "No ITAE, ||e||: no reference was recorded." in printed
    (line,) = errors.splitlines()
    for option in ("--commands", "--command-topic JOINT=TOPIC[INDEX]", "--reference"):
        assert option in line
    document = json.loads(run(bag, "--json")[1])["runs"]["states"]
    assert document["joints"]["wrist"]["iavc"] == pytest.approx(0.5 * 399 * 0.005)
    assert document["assumed"] == {"effort": "measured, of /joint_states"}
    saved = tmp_path / "saved.json"
    assert run(bag, "--save", saved)[0] == DONE
    assert run(saved, "--csv")[1] == run(bag, "--csv")[1]


def test_a_bag_that_gives_no_index_is_one_line_that_names_all_options(run, refused, tmp_path):
    bag = write_bag(tmp_path / "states", states_bag(tmp_path, effort=False))
    errors = refused("metrics", bag)
    for words in ("no effort was recorded: --commands", "no reference was recorded: --reference"):
        assert words in errors
    assert run(bag, "--indices", "itae", "--reference", "hold")[0] == DONE


def test_a_reference_is_held_or_given_if_asked_for_and_then_it_is_said(run, refused, tmp_path):
    bag = write_bag(tmp_path / "states", states_bag(tmp_path))
    said = "reference: the first position, held as asked for"
    page = tmp_path / "report.html"
    code, printed, _ = run(bag, "--reference", "hold", "--report", page)
    assert code == DONE
    assert f"states: {said}." in printed
    assert said in page.read_text(encoding="utf-8").split("<h2>")[0]
    held = json.loads(run(bag, "--reference", "hold", "--json")[1])["runs"]["states"]
    assert held["assumed"]["reference"] == "the first position, held as asked for"
    file = tmp_path / "motion.yaml"
    file.write_text(
        "reference: {kind: step, times: [0.0], positions: {elbow: [1.0], wrist: [0.0]}}\n"
    )
    given = json.loads(run(bag, "--reference", file, "--json")[1])["runs"]["states"]
    t = np.arange(400) * 0.005
    area = np.trapezoid if hasattr(np, "trapezoid") else np.trapz
    expected = area(t * np.abs(1.0 - np.sin(0.01 * np.arange(400))), t)
    assert given["joints"]["elbow"]["itae"] == pytest.approx(expected, rel=1e-9)
    assert "reference" not in given["assumed"]
    for bad in (tmp_path / "none.yaml", "nowhere"):
        refused("metrics", bag, "--reference", bad)


def test_commands_that_may_be_positions_are_efforts_only_if_that_is_said(run, refused, tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path) as bag:
        states = bag.add_topic("/joint_states", JOINT_STATE)
        commands = bag.add_topic("/elbow_controller/commands", FLOATS)
        for _, log_time_ns, raw in states_bag(path, effort=False):
            bag.write(states, log_time_ns, raw)
            bag.write(commands, log_time_ns + 1, floats(1.0, 3.0))
    assert "/elbow_controller/commands may carry them" in refused("metrics", path)
    document = json.loads(run(path, "--commands", "effort", "--json")[1])["runs"]["bag"]
    assert document["joints"]["elbow"]["iavc"] == pytest.approx(399 * 0.005)
    mapped = json.loads(
        run(path, "--command-topic", "wrist=/elbow_controller/commands[1]", "--json")[1]
    )["runs"]["bag"]
    assert mapped["joints"]["wrist"]["iavc"] == pytest.approx(3.0 * 399 * 0.005)


def test_a_terminal_gets_its_width_and_colours(tmp_path):
    bag = write_bag(tmp_path / "states", states_bag(tmp_path))
    master, slave = os.openpty()
    command = [sys.executable, "-m", "hpid_bench.cli.main", "metrics", str(bag)]
    environment = {**os.environ, "COLUMNS": "60", "TERM": "xterm"}
    with subprocess.Popen(command, stdout=slave, stderr=subprocess.PIPE, env=environment) as ended:
        os.close(slave)
        printed = b""
        with contextlib.suppress(OSError):  # how a terminal says that nobody writes any more
            while block := os.read(master, 4096):
                printed += block
    os.close(master)
    assert ended.returncode == DONE
    lines = re.sub(r"\x1b\[[\d;]*m", "", printed.decode()).splitlines()
    assert 40 < max(map(len, lines)) <= 60
    assert b"\x1b[" in printed


# Choices ---------------------------------------------------------------------------------------


def test_indices_and_units_are_chosen_and_units_always_printed(run, result):
    _, printed, _ = run(result, "--indices", "rmse,max|e|", "--units", "deg", "--csv")
    rows = list(csv.DictReader(io.StringIO(printed)))
    assert {(row["quantity"], row["unit"]) for row in rows} == {
        ("rmse", "deg"),
        ("error_max", "deg"),
    }
    _, table, _ = run(result, "--indices", "ivc,ise", "--units", "deg", "--overall")
    assert "IVC [N m]" in table
    assert "ISE [deg^2 s]" in table
    assert "arm_joint_1" not in table


def test_formats_limits_and_cutoffs_reach_what_they_are_for(run, result):
    for name in ("csv", "json"):
        assert run(result, f"--{name}")[1] == run(result, "--format", name)[1] != ""
    _, printed, _ = run(result, "--effort-limit", "1e-9", "--cutoff", "50", "--json")
    runs = json.loads(printed)["runs"]
    assert runs["PID"]["totals"]["saturation"] > 90.0
    assert runs["PID"]["conditions"]["cutoff"] == 50.0


# Outputs ---------------------------------------------------------------------------------------


def test_figures_and_report_are_drawn_with_the_gains_of_the_result(run, result, tmp_path):
    folder, page = tmp_path / "figures", tmp_path / "deep" / "report.html"
    drawn = ("--figures", folder, "--formats", "svg", "--joint", "arm_joint_1")
    code, _, errors = run(result, *drawn, "--report", page, "--save", folder / "x.json")
    assert code == DONE
    assert json.loads((folder / "x.json").read_text())["indices"]
    names = {path.name for path in folder.iterdir()}
    assert {"positions.svg", "spectrum.svg", "multiplier.svg", "trade_off.svg"} <= names
    assert f"written: {folder}" in errors
    text = page.read_text(encoding="utf-8")
    assert '"name":"multiplier"' in text
    assert "norm.error_scale" in text


def test_saved_numbers_alone_draw_the_trade_off_and_say_what_is_missing(run, result, tmp_path):
    folder = tmp_path / "figures"
    outputs = ("--figures", folder, "--formats", "png", "--report", tmp_path / "r.html")
    code, _, errors = run(result / "result.json", *outputs)
    assert code == DONE
    assert {path.name for path in folder.iterdir()} == {"trade_off.png", MARKER}
    assert "only runs from bags are drawn" in errors


def test_nothing_is_replaced_unless_forced_and_figures_only_figures_of_ours(
    run, refused, result, tmp_path
):
    target, folder = tmp_path / "mine.json", tmp_path / "figures"
    target.write_text("mine")
    assert f"{target} exists" in refused("metrics", result, "--save", target)
    assert target.read_text() == "mine"
    assert run(result, "--save", target, "--force")[0] == DONE
    assert json.loads(target.read_text())["indices"] == saved_indices(result)
    command = (result / "result.json", "--figures", folder, "--formats", "png")
    assert run(*command)[0] == DONE
    (folder / "photo.png").write_text("mine")
    assert run(*command)[0] == BAD_INPUT
    assert run(*command, "--force")[0] == DONE
    assert (folder / "photo.png").read_text() == "mine"
    foreign = folder / "trade_off.svg"
    foreign.write_text("mine")
    code, _, told = run(*command[:-1], "svg", "--force")
    assert code == BAD_INPUT
    assert f"hpid: {foreign} is in the way: " in told


@pytest.mark.parametrize("option", ["--save", "--report"])
@pytest.mark.parametrize("inside", [".", "result.json", "bags/PID/metadata.yaml"])
def test_what_is_read_is_never_replaced(refused, result, option, inside):
    target = result / inside
    source = target if target.suffix == ".json" else result / "bags" / "PID"
    before = target.is_file() and target.read_bytes()
    refused("metrics", source, option, target, "--force")
    assert (target.is_file() and target.read_bytes()) == before


# What is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "name at least one bag"),
        (["none.mcap"], "none.mcap"),
        (["none.json"], "cannot read none.json: no such file or directory"),
        (["--group", "alone"], "--group alone names no bag"),
        (["x", "--labels", "a", "b"], "one label for each of 1 bags, not 2"),
        (["SAVED", "--labels", "a"], "holds 2 runs, PID, hPID: it cannot have the one label 'a'"),
        (["RESULT", "--baseline", "hPDI"], "unknown baseline 'hPDI'; did you mean 'hPID'"),
        (["RESULT", "--indices", "ivvc"], "unknown index 'ivvc'; did you mean 'ivc'"),
        (["RESULT", "--units", "grad"], "unknown unit of angles 'grad'; did you mean 'rad'"),
        (["RESULT", "--formats", "jpg"], "unknown figure format 'jpg'"),
        (["RESULT", "--cutoff", "-1"], "the cut-off must be positive and finite, not -1.0"),
        (["RESULT", "--effort-limit", "strong"], "must be EFFORT or JOINT=EFFORT, got 'strong'"),
        (["RESULT", "--effort-limit", "arm_joint_9=1"], "unknown joint 'arm_joint_9'"),
        (["RESULT", "--joints", "arm_joint_9"], "unknown joint 'arm_joint_9'"),
        (["RESULT", "--save", "/proc/x.json"], "cannot write /proc/x.json"),
        (["RESULT", "--parameters", "none.yaml"], "none.yaml"),
        (["RESULT", "--clock", "sundial"], "unknown clock 'sundial'"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_printed(refused, result, arguments, words):
    places = {"RESULT": result, "SAVED": result / "result.json"}
    assert words in refused("metrics", *(places.get(each, each) for each in arguments))


def test_numbers_saved_without_an_index_are_not_said_to_be_of_an_unknown_one(
    refused, result, tmp_path
):
    document = json.loads((result / "result.json").read_text())
    for run in document["indices"]["runs"].values():
        for numbers in (run["units"], run["totals"], *run["joints"].values()):
            numbers.pop("chatter", None)
    old = tmp_path / "old.json"
    old.write_text(json.dumps(document))
    told = refused("metrics", old, "--indices", "chatter")
    assert "run 'PID' was measured without chatter, its numbers are ivc, iavc, " in told


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", '{"runs": 3}', '{"runs": {"a": {}}}'])
def test_a_file_without_numbers_is_one_line(refused, tmp_path, content):
    file = tmp_path / "saved.json"
    file.write_text(content)
    assert str(file) in refused("metrics", file)
