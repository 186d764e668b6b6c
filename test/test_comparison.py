import csv
import io
import json
import math
import re
import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from hpid_ros.analysis.comparison import Comparison, Verdict, answer, ratio, verdict
from hpid_ros.analysis.indices import (
    EFFORT_L2,
    ERROR_L2,
    IAVC,
    INDICES,
    ITAE,
    IVC,
    NORMS,
    JointIndices,
    RunIndices,
)
from hpid_ros.analysis.number_text import format_ratio, format_values
from hpid_ros.analysis.series import SeriesError
from hpid_ros.analysis.table import ComparisonTable, table_text
from hpid_ros.analysis.table_export import CSV_COLUMNS, table_csv, table_latex

# The paper's Table I and norms.
PAPER_PID = ((982, 114, 2.776), (2390, 142, 4.385), (836, 43, 1.198), (111, 67, 6.589))
PAPER_HPID = ((615, 65, 2.806), (618, 68, 3.704), (853, 50, 0.987), (56, 65, 6.345))


def run(label, rows, norms=(1.0, 1.0), names=None):
    names = names or [f"joint{k + 1}" for k in range(len(rows))]
    joints = {name: JointIndices(*map(float, row)) for name, row in zip(names, rows, strict=True)}
    totals = JointIndices(*(float(sum(column)) for column in zip(*rows, strict=True)))
    return RunIndices(label, joints, totals, *map(float, norms))


@pytest.fixture
def paper():
    return Comparison(
        (run("PID", PAPER_PID, (423.933, 52.2818)), run("hPID", PAPER_HPID, (329.459, 55.0789)))
    )


@pytest.fixture
def three(paper):
    return Comparison((*paper.runs, run("hPID_canonical", PAPER_HPID)))


# Comparison ------------------------------------------------------------------------------------


def test_ratios_are_over_the_first_run(paper):
    assert paper.ratio("hPID", IVC, "joint2") == 618 / 2390
    assert paper.ratio("hPID", IAVC) == (65 + 68 + 50 + 65) / (114 + 142 + 43 + 67)
    assert paper.ratio("hPID", EFFORT_L2) == 329.459 / 423.933
    assert paper.ratio("PID", ERROR_L2) == 1.0


@given(st.floats(0.0, 1e300), st.floats(0.0, 1e300))
def test_a_ratio_is_always_defined_without_a_warning(value, baseline):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quotient = ratio(value, baseline)
    assert not math.isnan(quotient)
    assert (quotient == 1.0) if value == baseline else True


def test_a_zero_baseline_makes_zero_equal_and_anything_else_infinitely_worse():
    assert ratio(0.0, 0.0) == 1.0
    assert ratio(1e-300, 0.0) == math.inf
    assert verdict(ratio(1.0, 0.0)) is Verdict.WORSE


def test_runs_that_cannot_be_compared_are_refused():
    one = run("PID", PAPER_PID)
    with pytest.raises(SeriesError, match="at least one run"):
        Comparison(())
    with pytest.raises(SeriesError, match="unlike labels"):
        Comparison((one, one))
    with pytest.raises(SeriesError, match="only one of them has elbow, joint4"):
        Comparison((one, run("b", PAPER_HPID, names=["joint1", "joint2", "joint3", "elbow"])))
    with pytest.raises(SeriesError, match="unknown run 'hpid'"):
        Comparison((one,)).ratio("hpid", IVC)


def test_joints_in_another_order_compare_by_name():
    names = ["a", "b", "c", "d"]
    left, right = run("x", PAPER_PID, names=names), run("y", PAPER_PID[::-1], names=names[::-1])
    comparison = Comparison((left, right))
    assert comparison.joint_names == tuple(names)
    assert all(comparison.ratio("y", IVC, name) == 1.0 for name in names)


def test_the_mapping_is_json_even_against_a_zero_baseline():
    comparison = Comparison((run("a", [(0, 1, 0)]), run("b", [(1, 2, 0)])))
    mapping = json.loads(json.dumps(comparison.as_mapping(), allow_nan=False))
    assert mapping["baseline"] == "a"
    assert mapping["ratios"]["b"]["joints"]["joint1"] == {"ivc": None, "iavc": 2.0, "itae": 1.0}
    assert mapping["ratios"]["b"]["error_l2"] == 1.0
    assert "a" not in mapping["ratios"]


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        (
            (50, 120, 10),
            "lowered the variation of the effort (IVC) by 50.0%, raised the effort spent (IAVC) "
            "by 20.0% and left the time-weighted error (ITAE) unchanged",
        ),
        (
            (50, 60, 9),
            "lowered the variation of the effort (IVC) by 50.0%, the effort spent (IAVC) by "
            "40.0% and the time-weighted error (ITAE) by 10.0%",
        ),
        (
            (300, 100.01, 10),
            "raised the variation of the effort (IVC) to 3 times and left the effort spent "
            "(IAVC) and the time-weighted error (ITAE) unchanged",
        ),
    ],
)
def test_the_answer_says_what_fell_and_what_rose(row, sentence):
    comparison = Comparison((run("PID", [(100, 100, 10)]), run("hPID", [row])))
    expected = f"Over the one joint and against PID, hPID {sentence}."
    assert answer(comparison) == expected


def test_the_answer_handles_a_lone_run_many_runs_and_a_zero_baseline(three):
    assert "nothing to compare" in answer(Comparison(three.runs[:1]))
    assert answer(three).count("Over all 4 joints and against PID, ") == 2
    zero = Comparison((run("a", [(0, 1, 1)]), run("b", [(1, 1, 1)])))
    assert "raised the variation of the effort (IVC) from zero" in answer(zero)


# The table -------------------------------------------------------------------------------------


def test_the_table_of_two_runs_fits_eighty_columns_side_by_side(paper):
    lines = table_text(paper, 80).splitlines()
    assert max(map(len, lines)) <= 80
    assert all(f"{quantity.symbol} [{quantity.unit}]" in lines[0] for quantity in INDICES)
    row = next(line for line in lines if line.startswith("joint2"))
    assert re.split(r"\s+", row)[:4] == ["joint2", "2390.0", "618.0", "0.259▼"]
    assert re.split(r"\s+", row)[4:] == ["142.00", "68.00", "0.479▼", "4.385", "3.704", "0.845▼"]
    assert next(line for line in lines if line.startswith("total")).split()[3] == "0.496▼"


@pytest.mark.parametrize("width", [60, 66, 80, 120])
def test_no_number_is_cut_off_at_any_width(three, width):
    text = table_text(three, width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    numbers = [
        format_values(r.value(q, j) for r in three.runs for j in (*three.joint_names, None))
        for q in INDICES
    ]
    for number in {n[:4] for column in numbers for n in column}:
        assert number in text


def test_a_table_too_narrow_folds_its_numbers_and_drops_no_digit(paper):
    text = table_text(paper, 24)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 24


def test_better_and_worse_read_without_colour_and_without_unicode(paper):
    assert "0.259▼" in table_text(paper)
    assert "1.054▲" in table_text(paper)  # the error norm
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    console = Console(file=stream, width=80, color_system=None)
    console.print(ComparisonTable(paper))
    stream.flush()
    text = stream.buffer.getvalue().decode("ascii")
    assert "0.259v" in text
    assert "1.054^" in text


def test_labels_are_text_and_never_markup():
    names = ["[red]a[/red]", "[/]"]
    rows = [(1, 1, 1), (2, 2, 2)]
    comparison = Comparison((run("[b]x", rows, names=names), run(":smile:", rows, names=names)))
    text = table_text(comparison, 120)
    assert all(word in text for word in (*names, "[b]x", ":smile:"))


@given(st.lists(st.floats(0.0, 1e12), min_size=1, max_size=8))
def test_formatted_values_line_up_and_never_hide_a_number(values):
    texts = format_values(values)
    plain = {len(text.partition(".")[2]) for text in texts if "e" not in text}
    assert len(plain) <= 1
    for value, text in zip(values, texts, strict=True):
        assert (float(text) == 0.0) == (value == 0.0)
        assert float(text) == pytest.approx(
            value, rel=0.051, abs=0.51 * 10.0 ** -max(plain or {0})
        )


@pytest.mark.parametrize(
    ("value", "text"), [(0.25901, "0.259"), (12.345, "12.35"), (math.inf, "inf"), (1e6, "1.0e6")]
)
def test_formatted_ratios(value, text):
    assert format_ratio(value) == text


# Files -----------------------------------------------------------------------------------------


def test_the_csv_returns_every_number_to_the_bit(three):
    rows = list(csv.DictReader(io.StringIO(table_csv(three))))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == 3 * (4 * 3 + 3 + 2)
    quantities = {quantity.key: quantity for quantity in (*INDICES, *NORMS)}
    for row in rows:
        quantity, joint = quantities[row["quantity"]], row["joint"] or None
        assert float(row["value"]) == three.run(row["run"]).value(quantity, joint)
        assert row["unit"] == quantity.unit
        if row["run"] == "PID":
            assert row["ratio"] == ""
        else:
            assert float(row["ratio"]) == three.ratio(row["run"], quantity, joint)


def test_the_latex_needs_no_package_and_every_row_has_all_columns(three):
    text = table_latex(three)
    assert not re.search(r"toprule|midrule|cmidrule|siunitx|\\SI|rowcolor", text)
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 2
    main = text.split(r"\end{tabular}")[0]
    for line in main.splitlines():
        if line.endswith(r"\\ \hline"):
            spans = [int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
            assert len(re.findall(r"(?<!\\)&", line)) + sum(spans) == 9
    assert r"hPID\_canonical" in text


def test_the_latex_marks_the_lower_number_and_no_tie(paper):
    text = table_latex(paper)
    assert r"joint2 & 2390.0 & \textbf{618.0} & 142.00 & \textbf{68.00}" in text
    assert r"\textbf{2.776} & 2.806" in text
    tie = Comparison((run("a", [(1, 1, 1)]), run("b", [(1, 1, 1)])))
    assert "textbf" not in table_latex(tie)
    infinite = Comparison((run("a", [(0, 1, 1)]), run("b", [(1, 1, 1)])))
    assert r"$\infty$" in table_latex(infinite)


def test_a_single_run_has_a_table_in_every_form(paper):
    alone = Comparison(paper.runs[:1])
    assert "ratio" not in table_text(alone)
    assert len(table_csv(alone).splitlines()) == 1 + 4 * 3 + 3 + 2
    assert "PID /" not in table_latex(alone)
    assert alone.ratio("PID", ITAE) == 1.0
