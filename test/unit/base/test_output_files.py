"""Files that a person named for what is written."""

import pytest

from hpid_ros.base.errors import ResultExistsError, SettingError
from hpid_ros.base.files import refuse_outputs


def test_two_options_may_not_name_one_file_however_they_spell_it(tmp_path):
    (tmp_path / "folder").mkdir()
    other = tmp_path / "folder" / ".." / "same"
    for force in (False, True):
        with pytest.raises(SettingError, match="--json and --plot must name different files"):
            refuse_outputs(
                [("-o", None), ("--json", tmp_path / "same"), ("--plot", other)],
                force=force,
                inputs=[],
            )
    outputs = [("--json", tmp_path / "a"), ("--plot", tmp_path / "b"), ("--plot", tmp_path / "c")]
    refuse_outputs(outputs, force=False, inputs=[])


def test_what_is_there_stays_unless_it_is_said_and_an_input_always(tmp_path):
    there = tmp_path / "there"
    there.write_text("kept")
    with pytest.raises(ResultExistsError, match="exists; name another with --json"):
        refuse_outputs([("--json", there)], force=False, inputs=iter(()))
    refuse_outputs([("--json", there)], force=True, inputs=())
    with pytest.raises(ResultExistsError, match="is an input; name another file with --plot"):
        refuse_outputs(
            [("--json", tmp_path / "new"), ("--plot", there)], force=True, inputs=iter([there])
        )


def test_a_place_where_nothing_can_be_made_is_refused_before_any_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingError, match=r"cannot write .*file/new/x.json: .*file is no folder"):
        refuse_outputs([("-o", tmp_path / "file" / "new" / "x.json")], force=True, inputs=())
    refuse_outputs([("-o", tmp_path / "new" / "folder" / "x.json")], force=False, inputs=())
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path)  # who is not root
    with pytest.raises(SettingError, match="permission denied in "):
        refuse_outputs([("-o", tmp_path / "new" / "x.json")], force=False, inputs=())
