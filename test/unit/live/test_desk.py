"""One page has the robot in hand; and nobody acts faster than people do."""

from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.live.session import Desk, Limit


def test_the_first_page_has_it_and_the_second_looks_on_until_a_person_takes_it():
    desk = Desk()
    desk.join("a")
    desk.join("b")
    assert desk.holds("a")
    assert not desk.holds("b")
    desk.take("b")
    assert desk.holds("b")
    assert not desk.holds("a")


def test_what_a_page_had_in_hand_when_it_went_nobody_gets_by_itself():
    desk = Desk()
    desk.join("a")
    desk.join("b")
    desk.leave("a")
    assert desk.holder is None
    desk.take("a")  # it is gone
    assert desk.holder is None


def test_a_page_that_was_cut_off_gets_it_back_unless_somebody_has_taken_it():
    desk = Desk()
    desk.join("a")
    desk.join("b")
    desk.leave("a")
    desk.join("a")
    assert desk.holds("a")
    desk.leave("a")
    desk.take("b")
    desk.join("a")
    assert desk.holds("b")


def test_a_page_that_is_back_before_its_old_connection_is_found_to_be_dead_keeps_it():
    desk = Desk()
    desk.join("a")
    desk.join("b")
    desk.join("a")
    assert desk.pages == 2
    desk.leave("a")  # of the old one
    assert desk.holds("a")
    desk.take("b")
    desk.take("a")
    assert desk.holds("a")
    desk.leave("a")
    assert desk.holder is None
    assert desk.pages == 1


def test_a_page_that_is_opened_when_none_is_has_it():
    desk = Desk()
    desk.join("a")
    desk.leave("a")
    desk.join("b")
    assert desk.holds("b")


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
