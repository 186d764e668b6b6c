"""What is given to nodes: values as declared, sections of files, names that no node has."""

import re

import pytest
from rclpy.parameter import Parameter

from hpid_ros.base.errors import SettingError
from hpid_ros.base.names import NODE_PARAMETERS, is_for, node_sections
from hpid_ros.base.records import names_of
from hpid_ros.control.parameter_files import parameters_from, settings_from_parameters
from hpid_ros.control.settings import PARAMETERS
from hpid_ros.nodes.core.parameters import as_declared, require_known_parameters
from hpid_ros.nodes.joint_controller import CONTROLLER_RECORDS

T = Parameter.Type


@pytest.mark.parametrize(
    ("kind", "value", "declared", "read"),
    [
        (T.INTEGER, 60, T.DOUBLE, 60.0),
        (T.STRING, "5e-05", T.DOUBLE, 5e-5),  # what ros2 param load makes of 5.0e-05
        (T.INTEGER_ARRAY, [0, 1], T.DOUBLE_ARRAY, [0.0, 1.0]),
        (T.STRING, "[0.0, 1e-05]", T.DOUBLE_ARRAY, [0.0, 1e-5]),
        (T.STRING, "null", T.INTEGER_ARRAY, None),  # ros2 param dump, of what was left out
        (T.STRING, "None", T.STRING_ARRAY, None),  # and ros2 param load, of that
        (T.BOOL_ARRAY, [], T.STRING_ARRAY, []),
        (T.STRING, "null", T.STRING, "null"),  # a text is a text
        (T.DOUBLE, 2.0, T.DOUBLE, 2.0),
    ],
)
def test_what_can_mean_only_one_thing_is_taken_for_that(kind, value, declared, read):
    taken = as_declared(Parameter("x", kind, value), declared)
    assert taken.value == read
    assert taken.type_ == (T.NOT_SET if read is None else declared)


@pytest.mark.parametrize(
    ("kind", "value", "declared", "said"),
    [
        (T.STRING, "abc", T.DOUBLE, "x must be a double, not a text ('abc')"),
        (T.BOOL, True, T.DOUBLE, "x must be a double, not true or false (True)"),
        (T.DOUBLE, 2.5, T.INTEGER, "x must be an integer, not a double (2.5)"),
        (
            T.INTEGER,
            1,
            T.STRING,
            "x must be a text, not an integer (1); without quotes numbers are no texts to ROS: "
            """write '"1"'""",
        ),
        (
            T.BOOL,
            True,
            T.STRING,
            "x must be a text, not true or false (True); without quotes y, yes, on and true are "
            """booleans to ROS: write '"y"'""",
        ),
        (
            T.BOOL_ARRAY,
            [False],
            T.STRING_ARRAY,
            """without quotes n, no, off and false are booleans to ROS: write '["n"]'""",
        ),
        (T.STRING, "a", T.STRING_ARRAY, "x must be an array of texts, not a text ('a')"),
        (T.STRING, "[a, 1]", T.DOUBLE_ARRAY, "x must be an array of doubles, not a text"),
    ],
)
def test_everything_else_is_refused_by_name(kind, value, declared, said):
    with pytest.raises(SettingError, match=re.escape(said)):
        as_declared(Parameter("x", kind, value), declared)


@pytest.mark.parametrize(
    ("document", "node", "is_its"),
    [
        ({"/**/elbow": {}}, "/elbow", True),
        ({"/**/elbow": {}}, "/a/b/elbow", True),
        ({"/**": {"elbow": {}}}, "/a/elbow", True),
        ({"/*/elbow": {}}, "/a/elbow", True),
        ({"/*/elbow": {}}, "/elbow", False),
        ({"elbow": {}}, "/elbow", True),
        ({"elbow": {}}, "/a/elbow", False),
        ({"a": {"elbow": {}}}, "/a/elbow", True),
        ({"/**": {}}, "/a/elbow", True),
        ({"/**/elbow": {}}, "/left_elbow", False),
    ],
)
def test_sections_are_matched_by_the_rules_of_rcl(document, node, is_its):
    def filled(values):
        inner = {key: filled(below) for key, below in values.items()}
        return inner or {"ros__parameters": {"p": 1}}

    (section,) = node_sections(filled(document))
    assert is_for(section, node) is is_its


def test_controllers_are_found_in_files_for_any_namespace():
    parameters = {"ros__parameters": {"joint": "elbow", "gains": {"p": 2.0, "d": 1.0}}}
    for document in (
        {"/**/elbow_controller": parameters},
        {"/**": {"elbow_controller": parameters}},
        {"elbow_controller": parameters},
    ):
        found = settings_from_parameters(document, "file")
        assert {name: each.gains.p for name, each in found.items()} == {"elbow_controller": 2.0}


@pytest.mark.parametrize(
    ("sections", "p"),
    [
        ({"/**": {"gains.p": 3.0}, "/arm/elbow": {}}, 3.0),
        ({"/arm/elbow": {"gains.p": 2.0}, "/**": {"gains.p": 3.0}}, 3.0),
        ({"/arm/elbow": {}, "/arm/**": {"gains.p": 3.0}}, 3.0),
        ({"/arm/elbow": {"gains.p": 2.0}, "/**/elbow": {"gains.p": 3.0}}, 3.0),
        ({"/arm/elbow": {"gains.p": 2.0}, "/*/elbow": {"gains.p": 3.0}}, 3.0),
        ({"/arm/elbow": {"gains.p": 2.0}, "/left/elbow": {"gains.p": 3.0}}, 2.0),
    ],
)
def test_sections_of_a_node_are_merged_as_ros_does(sections, p):
    document = {name: {"ros__parameters": own} for name, own in sections.items()}
    for name in ("/arm/elbow", "/left/elbow"):
        if name in document:
            document[name]["ros__parameters"] |= {"joint": "elbow"}
    found = settings_from_parameters(document, "file")
    assert set(found) == {"/arm/elbow", "/left/elbow"} & set(sections)
    assert found["/arm/elbow"].gains.p == p


def test_a_section_for_nodes_that_the_file_does_not_name_is_refused():
    document = {
        "elbow": {"ros__parameters": {"joint": "elbow"}},
        "/arm/**": {"ros__parameters": {"gains.p": 3.0}},
    }
    with pytest.raises(SettingError, match=r"/arm/\*\* has gains.p, and the file names no node"):
        settings_from_parameters(document, "file")


def test_a_file_of_very_many_sections_is_refused():
    """Each is held against each, and the live page reads what people give it."""
    document = {f"a{k}": {"ros__parameters": {}} for k in range(2000)}
    with pytest.raises(SettingError, match="2000 sections"):
        settings_from_parameters(document, "file")


def test_a_joint_may_have_any_name_in_the_inertia_ranges():
    document = {
        "elbow": {"ros__parameters": {"joint": "elbow"}},
        "/**/inertia_ranges": {"ros__parameters": {"joint": [0.1, 0.2]}},
    }
    found = parameters_from(document, "file")
    assert (list(found.loops), found.inertias) == (["elbow"], {"joint": (0.1, 0.2)})


CONTROLLER = {"gains.p", "gains.d", "joint"}


COMPOSED = {"joint_controllers": {"joints"}, "elbow": CONTROLLER, "merger": {"straggler_wait"}}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"elbow": {"gains.p"}, "merger": {"straggler_wait"}}, None),
        ({name: {"gains.p"} for name in COMPOSED}, None),  # of the command line: to all nodes
        ({"elbow": {"qos_overrides./joint_commands.publisher.depth"}}, None),
        ({"elbow": {"gains.dd"}}, "elbow: unknown parameter 'gains.dd'; did you mean 'gains.d'?"),
        (
            {name: {"stragler_wait"} for name in COMPOSED},
            "joint_controllers: unknown parameter 'stragler_wait'; did you mean 'straggler_wait'?",
        ),
        ({"elbow": {"straggler_wait"}}, "elbow: it has no parameter 'straggler_wait', merger has"),
        (
            {"merger": {"xyz"}},
            "merger: unknown parameter 'xyz'; --help lists those that there are",
        ),
    ],
)
def test_a_parameter_that_no_node_has_to_which_it_was_given_is_one_line_of_that_node(given, said):
    nodes = [(name, given.get(name, set()), has) for name, has in COMPOSED.items()]
    if said is None:
        require_known_parameters(nodes)
        return
    with pytest.raises(SettingError) as refused:
        require_known_parameters(nodes)
    assert str(refused.value) == said


def test_a_controllers_own_parameters_are_known_where_files_are_read():
    """The room that reads files knows no node, so the names stand there once more."""
    own = {name for name in names_of(*CONTROLLER_RECORDS) if name not in PARAMETERS}
    of_rclpy = {"qos_overrides", "start_type_description_service", "use_sim_time"}
    assert own | of_rclpy == NODE_PARAMETERS
