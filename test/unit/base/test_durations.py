"""Durations are summed up truly, and noting one costs the hot path no object."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.durations import NOTHING, Durations

TIMES = st.lists(st.integers(200, 10**11), min_size=1, max_size=300)


@given(st.lists(TIMES, min_size=1, max_size=4))
def test_recent_is_exact_and_whole_is_within_a_percent(reports):
    durations = Durations()
    for report in reports:
        for value in report:
            durations.note(value)
        spread = durations.recent()
        assert spread.samples == len(report)
        assert spread.median == pytest.approx(np.median(report) / 1e3)
        assert spread.maximum == max(report) / 1e3
    everything = sorted(value for report in reports for value in report)
    whole = durations.whole()
    assert whole.samples == len(everything)
    assert whole.maximum == everything[-1] / 1e3
    for share, told in ((0.5, whole.median), (0.99, whole.p99)):
        # The value below which that share lies, as the histogram's bin holds it.
        exact = everything[max(0, int(np.ceil(share * len(everything))) - 1)] / 1e3
        assert told == pytest.approx(exact, rel=0.012)


def test_nothing_noted_is_nothing():
    durations = Durations()
    assert durations.recent() == durations.whole() == NOTHING
    durations.note(5_000)
    durations.recent()
    assert durations.recent() == NOTHING
    assert durations.whole().samples == 1
