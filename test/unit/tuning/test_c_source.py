"""The texts that are a joint's loop in C, and the program that replays Python's answers."""

import re
import subprocess

import pytest
from harness.c_loops import COMPILER, compile_c, needs_compiler, write_c
from harness.loops import loop_settings

from hpid_bench.tuning.export import c_files, golden_vectors, require_distinct
from hpid_ros.base.errors import SettingError

EVERYTHING = {
    **{"gains__p": 39.6, "gains__i": 132.0, "gains__d": 3.96, "mu": -0.2},
    **{"norm__type": "canonical", "norm__effort_scale": 3.0, "takeover_time": 0.1},
    **{"u_clamp_max": 20.0, "u_clamp_min": -20.0, "effort_rate_max": 1e4},
    **{"position_max": 1.0, "velocity_max": 30.0, "velocity_source": "filtered"},
    "antiwindup_strategy": "back_calculation",
}


def settings(**changes):
    return loop_settings(**{**EVERYTHING, **changes})


QUICK = "-O0"  # enough where the last bit is not compared


def ended(folder, name, *options):
    program = compile_c(folder, [f"{name}.c", f"{name}_test.c"], *options)
    return subprocess.run([program], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    return folder, write_c(folder, settings())


def test_the_sanitizers_find_nothing_in_either_precision(exported):
    needs_compiler()
    folder, name = exported
    sanitized = (
        QUICK,
        "-fsanitize=address,undefined,float-cast-overflow",
        "-fno-sanitize-recover",
    )
    probe = [COMPILER, *sanitized, "-x", "c", "-", "-o", folder / "probe"]
    if subprocess.run(probe, input=b"int main(void) { return 0; }", check=False).returncode:
        pytest.skip("the C compiler has no sanitizers")
    single = f"-D{name.upper()}_SINGLE=1"
    for options, word in ((sanitized, "double"), ((*sanitized, single), "single")):
        found = ended(folder, name, *options)
        assert found.returncode == 0, found.stdout + found.stderr
        assert f"{word} precision" in found.stdout
        assert not found.stderr


@pytest.mark.parametrize(
    ("line", "broken"),
    [
        (r"\.gains_d = REAL\(3\.96\)", ".gains_d = REAL(3.960001)"),
        (r"p \* square \* error", "p * factor * error"),
        (r"#define TOLERANCE REAL\(1e-15\)", "#define TOLERANCE REAL(1e-3)"),
        (r"passage->position = position;", "passage->position = wanted;"),
    ],
)
def test_the_program_finds_a_broken_number(exported, tmp_path, line, broken):
    folder, name = exported
    for file in folder.glob(f"{name}*.[ch]"):
        (tmp_path / file.name).write_text(file.read_text())
    source = tmp_path / f"{name}.c"
    text, count = re.subn(line, broken, source.read_text(), count=1)
    assert count == 1
    source.write_text(text)
    found = ended(tmp_path, name, QUICK)
    assert found.returncode == 1
    assert "NOT GOOD" in found.stdout


def test_two_joints_are_in_one_firmware_and_a_header_in_c_plus_plus_guards(tmp_path):
    first = write_c(tmp_path, settings(joint="elbow"))
    second = write_c(tmp_path, settings(joint="wrist/1"), "single")
    assert (first, second) == ("hpid_elbow", "hpid_wrist_1")
    (tmp_path / "firmware.c").write_text(
        f"""#include <stddef.h>
#include "{first}.h"
#include "{second}.h"
int main(void)
{{
    static {first}_state elbow;
    static {second}_state wrist;
    bool are_ready = {first}_init(&elbow, &{first}_settings) &&
        {second}_init(&wrist, &{second}_settings);
    {first}_step(&elbow, 0, 0.0, 0.0, 0.0, NULL);
    {second}_step(&wrist, 0, 0.0f, 0.0f, 0.0f, NULL);
    return are_ready && sizeof({second}_real) == 4 ? 0 : 1;
}}
"""
    )
    program = compile_c(tmp_path, ["firmware.c", f"{first}.c", f"{second}.c"], QUICK)
    assert subprocess.run([program], check=False).returncode == 0
    assert 'extern "C" {' in (tmp_path / f"{first}.h").read_text()


def test_a_name_that_somebody_else_wrote_stays_in_its_comment(tmp_path):
    evil = '*/ int x; /* ??/\n"\\'
    files = c_files(settings(joint=evil), "double", f"{evil}.yaml")
    for name, text in files.items():
        assert re.fullmatch(r"hpid_int_x(_golden|_test)?\.[ch]", name)
        assert "*/ int" not in text
        assert "??" not in text
    name = write_c(tmp_path, settings(joint=evil))
    compile_c(tmp_path, [f"{name}.c", f"{name}_test.c"], QUICK)


@pytest.mark.parametrize(
    "joints", [("a-1", "A_1"), ("arm", "arm_test"), ("arm_golden", "arm"), ("関節",)]
)
def test_joints_without_a_name_of_their_own_in_c_are_refused(joints):
    require_distinct(["a_1", "a_2", "arm", "arm_2", "arm_golden_2"])
    with pytest.raises(SettingError, match="in C"):
        require_distinct(joints)


@pytest.mark.parametrize(
    ("changes", "precision", "words"),
    [
        ({"compensation": "gravity"}, "double", "elbow: compensation = gravity cannot"),
        ({"compensation": "decoupling", "inertia": 0.1, "gains__i": 1.0}, "double", "tion = dec"),
        ({"mu": 0.49999999999}, "single", "in single precision.* mu"),
        ({"gains__i": 1e-60}, "single", "is 0 in single"),
    ],
)
def test_what_the_c_code_cannot_do_is_refused(changes, precision, words):
    if precision == "single":
        c_files(settings(**changes), "double", "a test")
    with pytest.raises(SettingError, match=words) as refused:
        c_files(settings(**changes), precision, "a test")
    assert "\n" not in str(refused.value)


def test_golden_vectors_meet_all_that_a_loop_does():
    golden = golden_vectors(settings())
    assert golden == golden_vectors(settings())
    simulated = golden_vectors(settings().with_parameters({"state_clock": "simulated"}))
    assert golden == simulated  # an exported loop has no such clock
    assert golden.retuned.mu != settings().mu
    assert golden.retuned.gains != settings().gains
    efforts = [row.effort for row in golden.rows]
    assert max(efforts) == 20.0
    assert min(efforts) == -20.0
    assert 0.0 in efforts  # the fallback
    assert 0.0 < golden.double_tolerance < 1e-9 < golden.single_tolerance < 0.2
