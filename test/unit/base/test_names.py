"""Names of nodes after joints: valid, distinct, and back again."""

import re

import pytest
from harness.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.names import (
    claim_topic,
    controller_name,
    joint_of_controller,
    node_word,
    text_of_word,
)

NAMED_AS_EVER = st.from_regex("[A-Za-z_][A-Za-z0-9_]{0,20}", fullmatch=True)
NAMES = st.one_of(st.text(), st.text("_u0df1a9-\xf6\U0001f600 x", max_size=12))
ESCAPED = re.compile("(^|_)u[0-9a-f]{4,6}_")


@examples(20)
@given(NAMES)
def test_a_joints_node_has_a_name_that_ros_allows_and_leads_back(joint):
    name = controller_name(joint)
    assert re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name)
    assert joint_of_controller(name) == joint


@examples(20)
@given(NAMES, NAMES)
def test_two_joints_never_have_the_same_node_or_claim(joint, other):
    assert (node_word(joint) == node_word(other)) is (joint == other)
    claims = claim_topic("joint_commands", joint), claim_topic("joint_commands", other)
    assert (claims[0] == claims[1]) is (joint == other)


@examples(4)
@given(NAMED_AS_EVER.filter(lambda name: not ESCAPED.search(name)))
def test_what_ros_allows_stays_as_it_is(joint):
    assert controller_name(joint) == f"{joint}_controller"
    assert claim_topic("joint_commands", joint) == f"joint_commands/_claim_{joint}"


@examples(4)
@given(st.text("_u0df1a9", max_size=15))
def test_a_word_that_is_made_of_no_text_is_that_text(word):
    """A controller of others may be called anything."""
    text = text_of_word(word)
    assert text == word or node_word(text) == word


@pytest.mark.parametrize(
    ("joint", "word"),
    [  # those of docs/interfaces.md
        ("left-arm 1", "left_u002d_arm_u0020_1"),
        ("left_arm_1", "left_arm_1"),
        ("1st", "u0031_st"),
        ("a.b", "a_u002e_b"),
        ("Gr\xf6\xdfe", "Gr_u00f6_u00df_e"),
        ("y", "y"),
        ("a_u002d_b", "a_u005f_u0075_002d_b"),
    ],
)
def test_examples(joint, word):
    assert node_word(joint) == word
