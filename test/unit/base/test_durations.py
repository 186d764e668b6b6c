"""Durations are summed up truly, and noting one costs the hot path no object."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.durations import NO_DURATIONS, Durations

TIMES = st.lists(st.integers(200, 10**11), min_size=1, max_size=300)


@given(st.lists(TIMES, min_size=1, max_size=4))
def test_medians_and_percentiles_are_within_a_percent_and_the_rest_is_exact(reports):
    durations, noted = Durations(), []
    for report in reports:
        for value in report:
            durations.note(value)
        noted += report
        require_spread(durations.recent(), report)
    require_spread(durations.whole(), noted)


def require_spread(spread, values):
    values = sorted(values)
    assert spread.samples == len(values)
    assert spread.maximum == values[-1] / 1e3
    for share, told in ((0.5, spread.median), (0.99, spread.p99)):
        # The value below which that share lies, as the histogram's bin holds it.
        exact = values[max(0, int(np.ceil(share * len(values))) - 1)] / 1e3
        assert told == pytest.approx(exact, rel=0.012)


def test_what_another_thread_notes_during_a_report_is_in_the_next(monkeypatch):
    durations, convert = Durations(), np.array
    durations.note(5_000)

    def array(*arguments, **options):
        durations.note(6_000)
        return convert(*arguments, **options)

    with monkeypatch.context() as patched:
        patched.setattr(np, "array", array)
        assert durations.recent().samples == 1
    assert durations.recent().maximum == 6.0


def test_nothing_noted_is_nothing():
    durations = Durations()
    assert durations.recent() == durations.whole() == NO_DURATIONS
    durations.note(5_000)
    durations.recent()
    assert durations.recent() == NO_DURATIONS
    assert durations.whole().samples == 1
