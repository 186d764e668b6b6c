"""``hpid metrics`` as a user meets it: inputs, choices, outputs, one line for what is wrong."""

import csv
import io
import json
import shutil

import pytest

from hpid_ros.cli import main
from hpid_ros.commands import BAD_INPUT, DONE
from hpid_ros.experiment.result_folder import MARKER


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Return the folder of a short comparison."""
    import yaml

    from hpid_ros.resources import share_folder

    folder = tmp_path_factory.mktemp("metrics")
    document = yaml.safe_load(
        (share_folder() / "config" / "experiments" / "tracking.yaml").read_text()
    )
    document |= {"name": "short", "duration": 0.3, "simulation": {"physics_steps": 1}}
    file = folder / "short.yaml"
    file.write_text(yaml.safe_dump(document, sort_keys=False))
    assert main(["compare", str(file), "--in-process", "-o", str(folder / "result")]) == DONE
    return folder / "result"


@pytest.fixture
def run(capsys):
    """Return a function that runs the command and gives its streams."""

    def metrics(*arguments):
        capsys.readouterr()
        code = main(["metrics", *map(str, arguments)])
        return code, *capsys.readouterr()

    return metrics


def saved_indices(result):
    return json.loads((result / "result.json").read_text())["indices"]


# Inputs ----------------------------------------------------------------------------------------


def test_bags_a_result_folder_and_saved_numbers_give_the_same_numbers(run, result, tmp_path):
    bags = [result / "bags" / "PID", result / "bags" / "hPID"]
    saved = tmp_path / "saved.json"
    assert run(*bags, "--save", saved)[0] == DONE
    for arguments in (bags, [result], [result / "result.json"], [saved]):
        code, printed, errors = run(*arguments, "--json")
        assert code == DONE
        assert json.loads(printed) == saved_indices(result)
        assert errors == ""


def test_labels_name_the_bags_and_equal_labels_are_repeats(run, result):
    bags = [result / "bags" / "PID", result / "bags" / "hPID"]
    _, printed, _ = run(*bags, "--labels", "one", "two", "--json")
    assert list(json.loads(printed)["runs"]) == ["one", "two"]
    _, printed, _ = run(*bags, "--labels", "one", "one", "--json")
    (folded,) = json.loads(printed)["runs"].values()
    assert folded["repeats"] == 2
    by_group = run("--group", "one", *bags, "--json")[1]
    assert json.loads(by_group)["runs"]["one"] == folded


def test_a_label_in_the_bags_metadata_is_taken(run, result, tmp_path):
    import yaml

    bag = tmp_path / "0001"
    shutil.copytree(result / "bags" / "PID", bag)
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["custom_data"] = {"label": "my arm"}
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    _, printed, _ = run(bag, result / "bags" / "hPID", "--json")
    assert list(json.loads(printed)["runs"]) == ["my arm", "hPID"]


def test_the_baseline_is_chosen_by_path_or_label_and_may_be_another_bag(run, result):
    pid, hpid = result / "bags" / "PID", result / "bags" / "hPID"
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


def test_the_format_has_two_spellings(run, result):
    for name in ("csv", "json", "latex"):
        assert run(result, f"--{name}")[1] == run(result, "--format", name)[1] != ""


def test_a_limit_and_a_cutoff_reach_the_indices(run, result):
    _, printed, _ = run(result, "--effort-limit", "1e-9", "--cutoff", "50", "--json")
    runs = json.loads(printed)["runs"]
    assert runs["PID"]["totals"]["saturation"] > 90.0
    assert runs["PID"]["conditions"]["cutoff"] == 50.0


# Outputs ---------------------------------------------------------------------------------------


def test_figures_and_report_are_drawn_with_the_gains_of_the_result(run, result, tmp_path):
    folder, page = tmp_path / "figures", tmp_path / "deep" / "report.html"
    code, _, errors = run(result, "--figures", folder, "--formats", "svg", "--report", page)
    assert code == DONE
    names = {path.name for path in folder.iterdir()}
    assert {"positions.svg", "spectrum.svg", "multiplier.svg", "trade_off.svg"} <= names
    assert f"written: {folder}" in errors
    text = page.read_text(encoding="utf-8")
    assert '"name":"multiplier"' in text
    assert "norm.error_scale" in text


def test_saved_numbers_alone_draw_the_trade_off_and_say_what_is_missing(run, result, tmp_path):
    folder = tmp_path / "figures"
    code, _, errors = run(
        result / "result.json",
        "--figures",
        folder,
        "--formats",
        "png",
        "--report",
        tmp_path / "r.html",
    )
    assert code == DONE
    assert {path.name for path in folder.iterdir()} == {"trade_off.png", MARKER}
    assert "only runs from bags are drawn" in errors


def test_nothing_is_replaced_unless_forced(run, result, tmp_path):
    target = tmp_path / "mine.json"
    target.write_text("mine")
    code, printed, errors = run(result, "--save", target)
    assert (code, printed, target.read_text()) == (BAD_INPUT, "", "mine")
    named = f"hpid: {target} exists; name another with --save or replace it with --force\n"
    assert errors == named
    assert run(result, "--save", target, "--force")[0] == DONE
    assert json.loads(target.read_text())["indices"] == saved_indices(result)


def test_figures_replace_figures_of_ours_and_nothing_else(run, result, tmp_path):
    folder = tmp_path / "figures"
    numbers = result / "result.json"
    command = (numbers, "--figures", folder, "--formats", "png")
    assert run(*command)[0] == DONE
    (folder / "photo.png").write_text("mine")
    assert run(*command)[0] == BAD_INPUT
    assert run(*command, "--force")[0] == DONE
    assert (folder / "photo.png").read_text() == "mine"
    other = tmp_path / "photos"
    other.mkdir()
    (other / "trade_off.png").write_text("mine")
    code, _, errors = run(numbers, "--figures", other, "--formats", "png", "--force")
    assert (code, (other / "trade_off.png").read_text()) == (BAD_INPUT, "mine")
    assert "has no hpid_result.json" in errors


@pytest.mark.parametrize("option", ["--save", "--report"])
@pytest.mark.parametrize("inside", [".", "result.json", "bags/PID/metadata.yaml"])
def test_what_is_read_is_never_replaced(run, result, option, inside):
    target = result / inside
    source = target if target.suffix == ".json" else result / "bags" / "PID"
    before = target.is_file() and target.read_bytes()
    code, printed, errors = run(source, option, target, "--force")
    assert (code, printed, len(errors.splitlines())) == (BAD_INPUT, "", 1)
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
        (["RESULT", "--effort-limit", "strong"], "must be NM or JOINT=NM, got 'strong'"),
        (["RESULT", "--effort-limit", "arm_joint_9=1"], "unknown joint 'arm_joint_9'"),
        (["RESULT", "--joints", "arm_joint_9"], "unknown joint 'arm_joint_9'"),
        (["RESULT", "--save", "/proc/x.json"], "cannot write /proc/x.json"),
        (["RESULT", "--parameters", "none.yaml"], "none.yaml"),
        (["RESULT", "--clock", "sundial"], "unknown clock 'sundial'"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_printed(run, result, arguments, words):
    places = {"RESULT": result, "SAVED": result / "result.json"}
    code, printed, errors = run(*(places.get(each, each) for each in arguments))
    assert (code, printed) == (BAD_INPUT, "")
    assert errors.count("\n") == 1
    assert errors.startswith("hpid: ")
    assert words in errors


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", '{"runs": 3}', '{"runs": {"a": {}}}'])
def test_a_file_without_numbers_is_one_line(run, tmp_path, content):
    file = tmp_path / "saved.json"
    file.write_text(content)
    code, printed, errors = run(file)
    assert (code, printed, errors.count("\n")) == (BAD_INPUT, "", 1)
    assert str(file) in errors
