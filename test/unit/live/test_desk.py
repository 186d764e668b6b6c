"""One page has the robot in hand; and nobody acts faster than people do."""

from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.live.session import ControlLock, Limit


def test_the_first_page_has_it_and_the_second_looks_on_until_a_person_takes_it():
    control_lock = ControlLock()
    control_lock.join("a")
    control_lock.join("b")
    assert control_lock.holds("a")
    assert not control_lock.holds("b")
    control_lock.take("b")
    assert control_lock.holds("b")
    assert not control_lock.holds("a")


def test_what_a_page_had_in_hand_when_it_went_nobody_gets_by_itself():
    control_lock = ControlLock()
    control_lock.join("a")
    control_lock.join("b")
    control_lock.leave("a")
    assert control_lock.holder is None
    control_lock.take("a")  # it is gone
    assert control_lock.holder is None


def test_a_page_that_was_cut_off_gets_it_back_unless_somebody_has_taken_it():
    control_lock = ControlLock()
    control_lock.join("a")
    control_lock.join("b")
    control_lock.leave("a")
    control_lock.join("a")
    assert control_lock.holds("a")
    control_lock.leave("a")
    control_lock.take("b")
    control_lock.join("a")
    assert control_lock.holds("b")


def test_a_page_that_is_back_before_its_old_connection_is_found_to_be_dead_keeps_it():
    control_lock = ControlLock()
    control_lock.join("a")
    control_lock.join("b")
    control_lock.join("a")
    assert control_lock.pages == 2
    control_lock.leave("a")  # of the old one
    assert control_lock.holds("a")
    control_lock.take("b")
    control_lock.take("a")
    assert control_lock.holds("a")
    control_lock.leave("a")
    assert control_lock.holder is None
    assert control_lock.pages == 1


def test_a_page_that_is_opened_when_none_is_has_it():
    control_lock = ControlLock()
    control_lock.join("a")
    control_lock.leave("a")
    control_lock.join("b")
    assert control_lock.holds("b")


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=60))
def test_in_no_window_are_there_more_acts_than_allowed(gaps):
    now, acts = 0.0, []
    limit = Limit(5, 1.0, clock=lambda: now)
    for gap in gaps:
        now += gap
        if limit.allows():
            acts.append(now)
    assert all(later - sooner >= 1.0 for sooner, later in zip(acts, acts[5:], strict=False))
    assert acts[0] == gaps[0]
