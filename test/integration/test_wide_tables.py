"""Every table, in terminals of any width and in a pipe: each number is there in full."""

import io
import re

import pytest
from harness.runs import run
from rich.console import Console

from hpid_bench.cli.commands.check_gains import gain_table as table_of_gains
from hpid_bench.cli.terminal import output_console
from hpid_bench.report.table import UNLIMITED_WIDTH, ComparisonTable, TableColumn, WideTable
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.control.settings import Timing
from hpid_ros.metrics import Comparison
from hpid_ros.stability.gain_check import GainVerdict, check_gains

WIDTHS = (24, 40, 60, 80)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")


def printed(renderable, width):
    """Return the text, and check that no line is wider than the terminal."""
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(renderable)
    text = console.file.getvalue()
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width
    assert "…" not in text.replace(" … ", "")
    return text


def numbers(text):
    return set(NUMBER.findall(text))


def gain_table():
    def verdict(joint, k):
        return GainVerdict(
            joint, "hpid", -0.123 - k / 1000, (0.10523 + k, 0.576269 + k), k % 2 == 0,
            "" if k % 2 == 0 else f"mu = -0.{k}23 is outside the certified interval",
            (-0.495 + k / 100, 0.48125), 0.485 + k / 1000, 3.044, (0.931, 1.42), 6.61 + k,
            None,
        )  # fmt: skip

    names = ["arm_joint_1", "a_joint_with_a_name_as_long_as_somebody_liked", "x"]
    return table_of_gains({name: verdict(name, k) for k, name in enumerate(names)})


def comparison_table():
    rows = [(2390.12, 142.345, 4.38512), (618.987, 68.0123, 3.70421), (0.00123, 1e9, 55.5)]
    runs = [
        run(label, [tuple(x * (1 + k / 7) for x in row) for row in rows])
        for k, label in enumerate(["PID", "hPID", "a label that is long", "another"])
    ]
    return ComparisonTable(Comparison(tuple(runs)))


def study_table():
    headings = ("index", "PID", "hPID", "ratio", "searched", "ratio")
    row = ("IVC [N m]", "34.758 (33.1..35.9)", "34.209 (33.0..34.9)", "0.984 (0.97..0.99)", "9")
    rows = ((*row, "8"), ("note", *["-"] * 5))
    return WideTable.of_rows(headings, rows, title="totals", note="Medians.")


TABLES = (gain_table, comparison_table, study_table)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("table", TABLES)
def test_every_number_is_there_in_full_at_any_width(table, width):
    wide = printed(table(), UNLIMITED_WIDTH)
    assert numbers(wide)
    if table is comparison_table:  # roomy layouts show a digit more
        wide = printed(table(), 40)
    assert numbers(wide) <= numbers(printed(table(), width))


@pytest.mark.parametrize("width", WIDTHS)
def test_each_block_has_the_names_of_its_rows(width):
    columns = [TableColumn(f"column {k}", [f"{k}.25", f"{k}.75"]) for k in range(12)]
    text = printed(
        WideTable([TableColumn("joint", ["elbow", "wrist"], is_text=True)], columns), width
    )
    count = len(re.findall(r"^joint", text, re.M))
    assert count > 1
    assert len(re.findall(r"^elbow", text, re.M)) == count
    cells = {f"{k}.{end}" for k in range(12) for end in (25, 75)}
    assert numbers(text) <= cells | set(map(str, range(12)))


def test_a_pipe_does_not_limit_the_width():
    assert output_console().width == UNLIMITED_WIDTH  # pytest captures it


def test_a_gain_table_names_a_sampling_rate_that_breaks_the_loop():
    loop = LoopSettings("elbow", Gains(100.0, 100.0, 20.0), timing=Timing(control_period=0.06))
    text = printed(table_of_gains({"elbow": check_gains([(loop, (1.0, 1.0))])[0]}), 80)
    assert "T kd lam / m = 1.20: the sampled loop breaks at 0.85" in " ".join(text.split())
