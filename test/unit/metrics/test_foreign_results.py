"""Saved certificates, numbers and parameters that somebody changed end in one line."""

import json

import pytest

from hpid_ros.base.errors import SettingError
from hpid_ros.metrics.measure import saved_parameters
from hpid_ros.stability.closed_loop import FORMAT, Certificate
from hpid_ros.stability.gain_check import saved_certificates


@pytest.mark.parametrize("value", ["x", 10**400, None, {"a": 1}], ids=range(4))
def test_a_certificate_of_no_numbers_is_refused(value):
    mapping = {"format": FORMAT, "gains": {"p": value, "i": 1.0, "d": 1.0}, "spans": []}
    with pytest.raises(SettingError, match="misshapes an entry"):
        Certificate.from_mapping(mapping)


def test_certificates_of_a_hundred_thousand_brackets_are_one_line(tmp_path):
    (tmp_path / "certificates.json").write_text("[" * 100_000)
    with pytest.raises(SettingError, match="is no JSON"):
        saved_certificates(tmp_path / "certificates.json")


def test_parameters_of_a_result_that_are_none_are_passed_over(tmp_path):
    document = {"parameters": {"PID": {"a": {"law": "pid"}, "b": None, "c": 1.0}}}
    (tmp_path / "result.json").write_text(json.dumps(document))
    assert saved_parameters(tmp_path / "bags" / "PID") == {"a": {"law": "pid"}}
