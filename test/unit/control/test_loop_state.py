"""What a state is to a loop: each kind by its conditions, and what the loop makes of it."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import pytest
from harness.examples import examples
from harness.loops import pure_loop
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.control.loop_state import (
    ANSWERED,
    LoopMode,
    LoopState,
    Outlier,
    StateKind,
    StateRules,
    kind_of_state,
)
from hpid_ros.control.reference import LARGEST_POSITION

MS = 1_000_000
LAST = 1000 * MS  # stamp of the last state, at position 0
TIMEOUT_MS = 100
RULES = StateRules(
    timeout=0.1, is_simulated=False, step_max=0.2, speed_max=2.0, turn=2.0 * math.pi
)
SIMULATED = replace(RULES, is_simulated=True)
BEGUN = LoopState(LoopMode.HOLDING, LAST)
DUE = replace(BEGUN, is_takeover_due=True)


def refused(ms, **others):
    """Return the loop's state after one that the law did not answer."""
    return replace(BEGUN, refused_ns=LAST + ms * MS, refused_count=1, **others)


def jumped(position, ms=1):
    return refused(ms, outlier=Outlier(LAST + ms * MS, position))


TABLE = [
    # kind, time after the last stamp [ms], position [rad], what is known, by which rules
    (StateKind.FIRST, 0, 0.5, LoopState(), RULES),
    (StateKind.FIRST, -5, 0.5, LoopState(), RULES),
    (StateKind.FIRST, 5, 0.5, LoopState(refused_ns=LAST), RULES),  # that was unusable
    (StateKind.UNUSABLE, 5, None, LoopState(), RULES),
    (StateKind.NEXT, 1, 0.0, BEGUN, RULES),
    (StateKind.NEXT, 1, 0.2, BEGUN, RULES),
    (StateKind.NEXT, TIMEOUT_MS, 0.2, BEGUN, RULES),
    (StateKind.NEXT, 1, 0.0, refused(0.5), RULES),
    (StateKind.NEXT, 50, 0.29, BEGUN, RULES),  # 0.2 rad and 2 rad/s for 50 ms
    (StateKind.JUMP, 50, 0.31, BEGUN, RULES),
    (StateKind.NEXT, 50, 0.31, DUE, RULES),  # it may have been moved
    (StateKind.NEXT, 2, 0.0, jumped(1.0), RULES),  # it was a glitch
    (StateKind.MOVED, 2, 1.1, jumped(1.0), RULES),
    (StateKind.MOVED, 2, 1.0 + 2.0 * math.pi, jumped(1.0), RULES),  # an encoder that wraps
    (StateKind.STRAY, 2, 1.0 + 2.0 * math.pi, jumped(1.0), replace(RULES, turn=math.inf)),
    (StateKind.STRAY, 2, -1.0, jumped(1.0), RULES),
    (StateKind.STRAY, 1, 1.0, jumped(1.0, 2), RULES),  # before the jump
    (StateKind.REPEAT, 0, 0.0, BEGUN, RULES),
    (StateKind.REPEAT, 0, None, BEGUN, RULES),
    (StateKind.REPEAT, 7, 0.0, refused(7), RULES),
    (StateKind.UNUSABLE, 1, None, BEGUN, RULES),
    (StateKind.UNUSABLE, 1, 2.0 * LARGEST_POSITION, BEGUN, RULES),
    (StateKind.LATE, TIMEOUT_MS + 1, 0.0, BEGUN, RULES),
    (StateKind.LATE, TIMEOUT_MS + 1, 9.0, DUE, SIMULATED),
    (StateKind.LATE, 300, 0.0, refused(5), RULES),  # that was no gap
    (StateKind.LATE, 300, 0.0, refused(500), RULES),  # one stamp far ahead is none, either
    (StateKind.RESUMED, 301, 9.0, refused(300), RULES),
    (StateKind.RESUMED, 900, 0.0, refused(300), RULES),  # both are beyond the timeout
    (StateKind.RESUMED, 101, 0.0, refused(50), RULES),  # states of a fault led there
    (StateKind.UNUSABLE, 301, 2.0 * LARGEST_POSITION, refused(300), RULES),
    (StateKind.EARLIER, -1, 0.0, BEGUN, RULES),
    (StateKind.EARLIER, -2, 0.0, refused(-1), RULES),  # back again
    (StateKind.SET_BACK, -1, 0.0, refused(-2), RULES),
    (StateKind.RESET, -1, 9.0, BEGUN, SIMULATED),
    (StateKind.RESET, -1, 2.0 * LARGEST_POSITION, BEGUN, SIMULATED),  # its turns are forgotten
    (StateKind.UNUSABLE, -1, None, BEGUN, SIMULATED),
]


@pytest.mark.parametrize(("kind", "ms", "position", "state", "rules"), TABLE)
def test_a_state_is_what_the_table_says(kind, ms, position, state, rules):
    stamp_ns = LAST + round(ms * MS)
    assert kind_of_state(stamp_ns, position, False, state, rules) is kind
    assert kind_of_state(stamp_ns, position, True, state, rules) is StateKind.CONFLICT


def test_the_table_and_its_page_have_every_kind():
    assert {row[0] for row in TABLE} | {StateKind.CONFLICT} == set(StateKind)
    page = (Path(__file__).parents[3] / "docs" / "architecture.md").read_text()
    assert all(f"| `{kind.name}` |" in page for kind in StateKind)


STAMPS_MS = st.integers(-300, 300)
POSITIONS = st.sampled_from([0.0, 0.1, 0.5, 1.0, 7.0, 2.0 * LARGEST_POSITION])
STATES = st.builds(
    LoopState,
    mode=st.sampled_from(LoopMode),
    stamp_ns=st.none() | st.just(LAST),
    position=st.just(0.0),
    is_takeover_due=st.booleans(),
    outlier=st.none() | st.builds(Outlier, STAMPS_MS.map(lambda ms: LAST + ms * MS), POSITIONS),
    refused_ns=st.none() | STAMPS_MS.map(lambda ms: LAST + ms * MS),
)


@examples(8)
@given(
    STAMPS_MS,
    POSITIONS | st.none(),
    st.booleans(),
    STATES,
    st.sampled_from([RULES, SIMULATED, replace(RULES, step_max=math.inf)]),
)
def test_each_kind_needs_its_conditions_and_each_state_has_one(
    ms, position, is_split, state, rules
):
    stamp_ns, before = LAST + ms * MS, copy.copy(state)
    kind = kind_of_state(stamp_ns, position, is_split, state, rules)
    assert state == before
    has_begun = state.stamp_ns is not None
    is_next = has_begun and 0 < ms <= TIMEOUT_MS
    is_far = position is not None and abs(position) > rules.step_max + rules.speed_max * ms * 1e-3
    needs = {
        StateKind.CONFLICT: is_split,
        StateKind.REPEAT: state.is_repeat(stamp_ns),
        StateKind.FIRST: not has_begun,
        StateKind.NEXT: is_next and (state.is_takeover_due or not is_far),
        StateKind.JUMP: is_next and is_far and state.outlier is None,
        StateKind.MOVED: is_next and is_far and state.outlier is not None,
        StateKind.STRAY: is_next and is_far and state.outlier is not None,
        StateKind.LATE: has_begun and ms > TIMEOUT_MS,
        StateKind.RESUMED: has_begun and ms > TIMEOUT_MS and state.refused_ns is not None,
        StateKind.EARLIER: has_begun and ms < 0 and not rules.is_simulated,
        StateKind.SET_BACK: has_begun and ms < 0 and not rules.is_simulated,
        StateKind.RESET: has_begun and ms < 0 and rules.is_simulated,
        StateKind.UNUSABLE: position is None or abs(position) > LARGEST_POSITION,
    }
    assert needs[kind]
    if is_split or state.is_repeat(stamp_ns):
        assert kind in (StateKind.CONFLICT, StateKind.REPEAT)
    if kind in ANSWERED:
        assert position is not None
    if state.is_takeover_due:
        assert kind not in (StateKind.JUMP, StateKind.STRAY, StateKind.MOVED)


COUNTED = {  # of LoopCounts, by one
    StateKind.FIRST: {"samples"},
    StateKind.NEXT: {"samples"},
    StateKind.RESUMED: {"samples", "takeovers"},
    StateKind.SET_BACK: {"samples", "takeovers", "resets"},
    StateKind.RESET: {"samples", "resets"},
    StateKind.MOVED: {"samples", "takeovers"},
    StateKind.REPEAT: {"repeats"},
    StateKind.CONFLICT: {"rejected"},
    StateKind.UNUSABLE: {"rejected"},
    StateKind.LATE: {"rejected", "gaps"},
    StateKind.EARLIER: {"rejected"},
    StateKind.JUMP: {"rejected", "jumps"},
    StateKind.STRAY: {"rejected", "jumps"},
}
FALLBACK = 0.5


@examples(2)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([1, 1, 1, 2, 50, 150, 500, 0, -5, -400]),
            st.sampled_from([0.0, 0.0, 0.0, 0.05, 1.0, -1.0, math.nan]),
        ),
        min_size=5,
        max_size=60,
    ),
    st.sampled_from(["wall", "simulated"]),
)
def test_a_loop_does_with_a_state_what_its_kind_says(steps, clock):
    loop = pure_loop(
        state_clock=clock, velocity_max=2.0, gains__p=30.0, gains__d=5.0, fallback_effort=FALLBACK
    )
    stamp_ns = LAST
    for ms, position in steps:
        stamp_ns += ms * MS
        is_place = not math.isnan(position)
        is_split = is_place and copy.deepcopy(loop.sources).take(stamp_ns, position)
        state, effort, counts = copy.copy(loop.state), loop.law.effort, vars(loop.counts).copy()
        kind = kind_of_state(
            stamp_ns, position if is_place else None, is_split, state, loop._rules
        )
        given_effort = loop.step(stamp_ns, position, 0.0)
        after = vars(loop.counts)
        counted = {
            name
            for name in counts
            if after[name] > counts[name] and name not in ("saturated", "missed")
        }
        expected = set(COUNTED[kind])
        if kind is StateKind.NEXT and state.is_takeover_due:
            expected.add("takeovers")
        if kind is StateKind.CONFLICT and state.mode is not LoopMode.CONFLICT:
            expected.add("conflicts")
        assert counted == expected
        if kind in ANSWERED:
            assert loop.state == LoopState(LoopMode.HOLDING, stamp_ns, position)
        elif kind in (StateKind.UNUSABLE, StateKind.STRAY, StateKind.CONFLICT):
            # An effort of a conflict stays as it is until one source has ended.
            assert given_effort == FALLBACK
        else:
            assert given_effort == effort
        if kind not in ANSWERED and kind is not StateKind.REPEAT:
            assert loop.state.refused_ns == stamp_ns
