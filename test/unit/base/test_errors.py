"""What an error says is one line that can be printed, whatever a name in it is."""

import pytest

from hpid_ros.base.errors import BagError, unknown_name


@pytest.mark.parametrize("name", ["a" * 1_000_000, "\x1b" * 1_000_000])
def test_a_message_has_an_end(name):
    text = str(BagError(unknown_name("joint", name, [name, "b"])))
    assert text.isprintable()
    assert len(text) < 40_000
    assert text.startswith("unknown joint")
    assert text.endswith("b")
