"""Lines about what strangers named, and lines of what comes again and again."""

from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import HpidError, reason_of, unknown_name
from hpid_ros.base.text import LONGEST_NAME, LineBudget, name_text, names_text


@given(st.text(max_size=LONGEST_NAME))
def test_a_name_that_people_write_is_shown_whole(name):
    assert name_text(name) == repr(name)


@given(st.text(min_size=LONGEST_NAME + 1, max_size=1000), st.integers(1, 1000))
def test_a_line_about_names_is_short_however_long_and_many_they_are(name, count):
    assert f"({len(name)} characters)" in name_text(name)
    line = names_text([name] * count)
    assert len(line) < 10 * (10 * LONGEST_NAME + 40) + 100
    assert ("more" in line) == (count > 10)
    assert len(unknown_name("joint", name * 100, ["elbow"])) < 10 * LONGEST_NAME + 100


def test_the_reason_of_an_error_is_one_line_that_names_a_foreign_kind():
    assert reason_of(HpidError("too\nlong")) == "too\\nlong"
    assert reason_of(MemoryError()) == "MemoryError"
    assert reason_of(ValueError("a\nb")) == "ValueError: a b"
    assert len(reason_of(ValueError("x" * 10**6))) < 1100


@given(st.lists(st.floats(0.0, 0.5), max_size=400))
def test_what_flaps_writes_few_lines_and_says_how_many_it_left_out(pauses):
    budget, now, written = LineBudget(), 100.0, []
    for pause in pauses:
        now += pause
        line = budget.admitted("again", now)
        written += [line] if line else []
    passed = now - 100.0
    assert len(written) <= 20 + 2.0 * passed + 1e-6
    assert len(written) >= min(len(pauses), 20)
    left_out = sum(int(line.split("(")[1].split()[0]) for line in written if "(" in line)
    assert left_out + len(written) <= len(pauses)
    line = budget.admitted("at last", now + 1.0)
    told = int(line.split("(")[1].split()[0]) if "(" in line else 0
    assert left_out + told + len(written) == len(pauses)
