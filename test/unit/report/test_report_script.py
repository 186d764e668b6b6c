"""The report's program, function by function, in node (Debian: ``apt install nodejs``)."""

import json
import shutil
import subprocess

import numpy as np
import pytest

from hpid_ros.report.html.data import line_data
from hpid_ros.report.html.page import script, style_sheet

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="no node: apt install nodejs")
PAGE = 'const document = {getElementById: () => ({textContent: "{}"})};'


def evaluate(expression, data=None):
    """Return an expression of the first part of the program, with ``given`` at hand."""
    whole = script()
    ticks = whole[whole.index("\n", whole.index("=> {")) : whole.index("class Chart")]
    said = subprocess.run(
        [NODE, "-"],
        input=f"{PAGE} const given = {json.dumps(data)};\n{ticks}\n"
        f"process.stdout.write(JSON.stringify({expression}));",
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return json.loads(said.stdout)


def test_the_whole_program_can_be_read(tmp_path):
    path = tmp_path / "script.js"
    path.write_text(script(), encoding="utf-8")
    subprocess.run([NODE, "--check", path], check=True, timeout=60)
    assert "</" not in script()  # it stands in a script element
    assert "</" not in style_sheet()


def test_numbers_come_back_as_they_were_packed():
    x, y = np.linspace(0.0, 1.0, 7), np.array([1.0, np.nan, -3.5, 0.0, 1e-9, 2e9, 4.0])
    line = line_data(0, x, y)
    back = evaluate("[...floats(given.y)].map((v) => (Number.isNaN(v) ? null : v))", line)
    assert [np.nan if v is None else v for v in back] == pytest.approx(
        y.astype(np.float32).tolist(), nan_ok=True
    )


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.37, 12.6), (1e-4, 3e-4), (-5e6, 2e6)])
def test_ticks_are_round_lie_in_the_range_and_keep_their_distance(low, high):
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


def test_what_is_not_a_number_is_in_no_range():
    assert evaluate("extent([1, NaN, -2, 7], 0, 4, NOTHING)") == [-2, 7]
    assert evaluate("extent([1, NaN, -2, 7], 0, 2, [0, 0])") == [0, 1]


@pytest.mark.parametrize("x", [-1.0, 0.0, 0.5, 3.0, 9.0])
def test_the_first_place_at_a_value_or_behind_it(x):
    xs = [0.0, 1.0, 1.0, 2.0, 3.0]
    assert evaluate("firstAtLeast(given[0], given[1])", [xs, x]) == np.searchsorted(xs, x)
