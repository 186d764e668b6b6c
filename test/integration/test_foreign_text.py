"""What strangers wrote is shown as text, and cannot choose where files are written."""

import csv
import html
import io
import json
import re
import subprocess
import sys

import pytest
import yaml
from harness.runs import run
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.cli.commands import BAD_INPUT, DONE
from hpid_bench.cli.main import main
from hpid_bench.experiment.description import load_experiment
from hpid_bench.report.console import TextConsole
from hpid_bench.report.page import render_report
from hpid_bench.report.table import ComparisonTable, table_text
from hpid_ros.base.console import guarded_output
from hpid_ros.base.errors import ExperimentError, HpidError, ResultExistsError
from hpid_ros.base.names import controller_name, is_label, require_node_names
from hpid_ros.base.text import csv_text, shown, shown_lines
from hpid_ros.messages.joint_state import JointStateTemplate
from hpid_ros.messages.writer import BagWriter
from hpid_ros.metrics import Comparison
from hpid_ros.metrics.texts import table_csv, table_lines

TITLE = "\x1b]0;owned\x07"  # sets the title of a terminal
LINK = "\x1b]8;;http://evil\x1b\\click\x1b]8;;\x1b\\"
HOSTILE = (
    TITLE,
    LINK,
    "\x1b[2J\x1b[1;31mred",
    "\x9b31m",
    "a\nhpid: all is well",
    "a\rb",
    "\x07",
    "\u202egnp.exe",
    "[bold red]x[/]",
    "[link=http://evil]x[/link]",
    ":smile:",
    "=cmd|' /C calc'!A0",
    "+1+1",
    "-1+1",
    "@SUM(A1)",
    "<script>alert(1)</script>",
    "\\input{/etc/passwd}",
    "$x^2$ & 100%",
)


def controls(text):
    """Return what in a text is no text, line breaks aside."""
    return {c for c in text if not c.isprintable()} - {"\n"}


@given(st.text())
def test_shown_text_is_one_printable_line_and_says_everything(text):
    assert shown(text).isprintable()
    assert shown(shown(text)) == shown(text)
    if "\\" not in text:
        assert shown(text).encode("ascii", "backslashreplace").decode("unicode_escape") == text
    assert controls(shown_lines(text)) <= {"\t"}
    assert shown_lines(text).count("\n") == text.count("\n")


@given(st.lists(st.one_of(st.text(), st.floats(allow_nan=False), st.integers()), min_size=1))
def test_csv_cells_are_texts_or_numbers_and_never_formulas(row):
    ((*cells,),) = csv.reader(io.StringIO(csv_text([row]))) if row != [""] else ([""],)
    for cell, value in zip(cells, row, strict=True):
        if isinstance(value, str):
            assert len(cell) < 2 or cell[0] not in "=+-@\t\r\n"
            assert cell.removeprefix("'").endswith(shown(value).removeprefix("'"))
        else:
            assert type(value)(cell) == value


LABELS = ("PID", "hPID+", "best hPID", "mu = -0.2", "μ=0,3 (b)", "Regler_2", "é", "2", "x" * 48)
NO_LABELS = (
    "",
    " ",
    ".",
    "..",
    ".x",
    "-x",
    "+x",
    "=x",
    "a/b",
    "../x",
    "/tmp/x",
    "a\\b",
    "x ",
    " x",
    "a\0b",
    "a\nb",
    "x" * 49,
    "a:b",
    "~",
    "a*",
    "$(x)",
    "é\u0301\u202e",
    *HOSTILE,
)


def test_labels_are_plain_names():
    assert [name for name in LABELS if not is_label(name)] == []
    assert [name for name in NO_LABELS if is_label(name)] == []


@pytest.mark.parametrize("label", ["../x", "a/b", TITLE], ids=ascii)
def test_no_other_name_is_a_label_wherever_it_is_given(experiment_file, tmp_path, label, refused):
    for changes, place in (({"compare": {label: {}}}, "compare"), ({"name": label}, "name")):
        path = experiment_file(**changes)
        with pytest.raises(ExperimentError) as refusal:
            load_experiment(path)
        line = str(refusal.value)
        assert line.startswith(f"{path}: {place}")
        assert line.isprintable()
    bag = tmp_path / "bag"
    bag.mkdir()
    before = sorted(tmp_path.rglob("*"))
    for arguments in (
        ["metrics", f"--labels={label}", "--", bag],
        ["metrics", "--group", label, bag],
        ["tune", "--law", "pid", f"--label={label}"],
    ):
        assert not controls(refused(*arguments))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_result_of_a_stranger_does_not_lead_to_other_bags(tmp_path, refused):
    """Its labels were joined to the path: any bag of the machine was read as its run."""
    bag_of(tmp_path / "stolen", ["elbow"])
    (tmp_path / "result").mkdir()
    document = {"indices": {"runs": {"../../stolen": {}}}}
    (tmp_path / "result" / "result.json").write_text(json.dumps(document))
    assert "result.json is damaged" in refused("metrics", tmp_path / "result")


def bag_of(path, joints, label=""):
    """Write a bag of joints with any names, and a label among its metadata."""
    template = JointStateTemplate(joints, position=True, effort=True)
    count = len(joints)
    with BagWriter(path, metadata={"label": label} if label else {}) as bag:
        topic = bag.add_topic("/joint_states", "sensor_msgs/msg/JointState")
        for k in range(50):
            at = [0.1 * (k > 5)] * count
            raw = template.encode(k * 10**6, position=at, effort=[1.0] * count)
            bag.write(topic, k * 10**6, raw)


def test_a_strangers_bag_is_measured_without_taking_over_the_terminal(tmp_path, capsys):
    bag_of(tmp_path / "bag", HOSTILE, label=f"run {TITLE}")
    options = [str(tmp_path / "bag"), "--commands", "/joint_states", "--reference", "hold"]
    report = tmp_path / "report.html"
    assert main(["metrics", *options, "--report", str(report)]) == DONE
    captured = capsys.readouterr()
    for text in (captured.out, captured.err, report.read_text()):
        assert not controls(text)
    page = html.unescape(report.read_text())
    for name in HOSTILE:
        assert shown(name)[:8] in captured.out
        assert shown(name) in page
    printed = {}
    for form in ("csv", "json"):
        assert main(["metrics", *options, "--format", form]) == DONE
        printed[form] = capsys.readouterr().out
        assert not controls(printed[form])
    rows = list(csv.DictReader(io.StringIO(printed["csv"])))
    assert all(row["joint"][:1] not in tuple("=+-@") for row in rows)
    assert {row["joint"].removeprefix("'") for row in rows} >= set(map(shown, HOSTILE))
    assert all(row["value"] == "" or float(row["value"]) >= 0.0 for row in rows)
    (run,) = json.loads(printed["json"])["runs"].values()
    assert list(run["joints"]) == list(HOSTILE)


def test_tables_and_reports_show_names_as_text():
    rows = [(1.0, 2.0, 3.0)] * len(HOSTILE)
    comparison = Comparison(
        tuple(run(f"{end}{TITLE}", rows, names=list(HOSTILE)) for end in ("a", "b"))
    )
    for text in (table_text(comparison), table_lines(comparison), table_csv(comparison)):
        assert not controls(text)
    page = render_report(comparison, (), {"source": LINK}, {}, warnings=HOSTILE)
    assert not controls(page)
    terminal = io.StringIO()
    console = TextConsole(file=terminal, force_terminal=True, color_system=None, width=200)
    console.print(ComparisonTable(comparison))
    console.print(f"run {TITLE}")
    assert not controls(terminal.getvalue())
    assert all(shown(name) in terminal.getvalue() for name in HOSTILE)


def test_figures_show_names_as_text_and_not_as_formulas(tmp_path, capsys):
    name = "$\\bad{$" + TITLE
    bag_of(tmp_path / "bag", [name], label=name)
    options = [str(tmp_path / "bag"), "--commands", "/joint_states", "--formats", "svg"]
    folder = tmp_path / "figures"
    assert main(["metrics", *options, "--figures", str(folder)]) == DONE
    drawings = [path.read_text() for path in folder.glob("*.svg")]
    assert any(shown(name) in html.unescape(drawing) for drawing in drawings)
    assert not any("\x1b" in drawing for drawing in drawings)


def test_what_is_printed_past_a_console_is_text_as_well(capsys):
    with guarded_output():
        print(TITLE, "a\tb")
        print(LINK, file=sys.stderr)
    printed = capsys.readouterr()
    assert printed.out == "\\x1b]0;owned\\x07 a\tb\n"
    assert not controls(printed.err)


def test_errors_are_one_printable_line_also_in_the_logs_of_nodes():
    for kind in (HpidError, ExperimentError, ResultExistsError):
        assert str(kind(f"joint {TITLE}\nhpid: done")) == "joint \\x1b]0;owned\\x07\\nhpid: done"


def test_a_file_that_cannot_be_parsed_is_told_in_one_line(tmp_path):
    path = tmp_path / f"x{TITLE}.yaml"
    path.write_text(yaml.safe_dump({"name": TITLE}))
    command = [sys.executable, "-m", "hpid_bench.cli.main", "compare", str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == BAD_INPUT
    assert len(run.stderr.splitlines()) == 1
    assert not controls(run.stderr)


@pytest.mark.parametrize("joint", ["../../x", "a/b", "a b", "\xfc", "1st", "a\x1b", "y"])
def test_the_log_of_a_joints_node_stays_in_its_folder(joint):
    """It is named after the node: this was a way out of the result folder."""
    require_node_names([joint], ExperimentError)
    assert re.fullmatch("[A-Za-z][A-Za-z0-9_]*", controller_name(joint))


@pytest.mark.parametrize(("joint", "length"), [("a" * 191, 202), ("\xfc" * 40, 251)])
def test_joints_after_which_no_file_can_be_called_start_no_node(joint, length):
    refusal = f"cannot have a node: its name, .*, would have {length} characters, 200 are allowed"
    with pytest.raises(ExperimentError, match=refusal):
        require_node_names(["a", joint], ExperimentError)
