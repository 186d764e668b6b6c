"""hpid upgrade: statistics of a recording, the choice of the degree, the file."""

import math

import numpy as np
import pytest
import yaml

from hpid_ros.analysis.series import JointSeries
from hpid_ros.cli import main
from hpid_ros.commands import BAD_INPUT, DONE
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.control.stability import certified_degree_interval, verify_certificate
from hpid_ros.errors import GainError, SettingError
from hpid_ros.simulation.encoders import Encoder
from hpid_ros.tuning.certified_degrees import norm_family
from hpid_ros.tuning.controller_files import settings_from_parameter_file
from hpid_ros.tuning.loop_statistics import loop_statistics
from hpid_ros.tuning.upgrade import upgrade

MS = 1_000_000


def recording(counts=4096, noise=0.0):
    """Return a decaying error, as an encoder sees it."""
    time = np.arange(3000) * 1e-3
    encoder = Encoder(counts, 0.3)
    true = 0.5 * (1.0 - np.exp(-4.0 * time))
    position = np.array([encoder.read(float(each)) for each in true])
    stamps = np.arange(3000) * MS
    reference = np.full(3000, 0.5)
    return JointSeries("elbow", stamps, position + noise, reference, stamps, position)


def pid(**changes):
    values = {"joint": "elbow", "law": "pid", "gains": Gains(39.6, 132.0, 3.96), "inertia": 0.132}
    return LoopSettings(**{**values, **changes})


@pytest.mark.parametrize("counts", [1024, 4096, 16384])
def test_statistics_find_scales_and_the_encoder(counts):
    found = loop_statistics(recording(counts), filter_time_constant=0.01)
    assert found.largest_error == pytest.approx(0.5, abs=math.pi / counts)
    assert found.largest_rate == pytest.approx(2.0, rel=0.15)
    assert found.resolution == pytest.approx(math.tau / counts, rel=1e-6)
    assert found.period == pytest.approx(0.001)


def test_an_ideal_sensor_has_no_resolution():
    time = np.arange(500) * 1e-3
    stamps = np.arange(500) * MS
    position = 0.1 * np.sin(7.0 * time)
    series = JointSeries("elbow", stamps, position, np.zeros(500), stamps, position)
    assert loop_statistics(series, 0.005).resolution == 0.0


@pytest.mark.parametrize(("goal", "sign"), [("smooth", 1.0), ("fast", -1.0)])
def test_the_degree_has_the_goals_sign_and_is_certified(goal, sign):
    found = upgrade(pid(), (0.1, 0.2), goal, loop_statistics(recording(), 0.005))
    assert sign * found.settings.mu > 0.05
    assert found.interval[0] < found.settings.mu < found.interval[1]
    interval = certified_degree_interval(
        found.settings.gains, norm_family(found.settings), (0.1, 0.2)
    )
    assert verify_certificate(interval.certificate).rate > 0.0
    assert found.settings.gains == pid().gains
    law = found.settings.make_law()
    assert 0.5 <= law.norm_floor**found.settings.mu <= 2.0


def test_every_number_of_the_proposal_has_a_reason_or_a_default():
    found = upgrade(pid(), (0.132, 0.132), "fast", loop_statistics(recording(), 0.005))
    for name in ("mu", "law", "norm.error_scale", "norm.rate_weight", "encoder_resolution"):
        assert found.reasons[name]
    assert "certified" in found.reasons["mu"]


def test_gains_near_the_limit_keep_a_small_degree():
    near = pid(gains=Gains(5.0, 9.0, 2.0), inertia=1.0, norm_rate_weight=3.0)
    found = upgrade(near, (1.0, 1.0), "smooth")
    assert 0.0 < found.settings.mu <= 0.8 * 0.1


def test_unstable_gains_are_not_upgraded():
    with pytest.raises(GainError, match="unstable"):
        upgrade(pid(gains=Gains(1.0, 9.0, 1.0), inertia=0.0), (1.0, 1.0), "fast")


@pytest.mark.parametrize(
    ("series", "words"),
    [
        (
            JointSeries("j", np.arange(3) * MS, np.zeros(3), np.ones(3), np.arange(3), np.ones(3)),
            "3 states",
        ),
        (
            JointSeries(
                "j", np.arange(20) * MS, np.ones(20), np.ones(20), np.arange(20), np.ones(20)
            ),
            "zero throughout",
        ),
    ],
)
def test_recordings_that_say_nothing_are_refused(series, words):
    with pytest.raises(SettingError, match=words):
        loop_statistics(series, 0.005)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Return the folder of a short comparison on the graph: parameter files and bags."""
    from hpid_ros.experiment.compare import compare
    from hpid_ros.experiment.description import load_experiment
    from hpid_ros.experiment.progress import Silence
    from hpid_ros.resources import share_folder

    folder = tmp_path_factory.mktemp("upgrade")
    document = yaml.safe_load((share_folder() / "config/experiments/tracking.yaml").read_text())
    document |= {"duration": 1.0, "simulation": {"physics_steps": 1}}
    (folder / "short.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    compare(load_experiment(folder / "short.yaml"), folder / "result", Silence())
    return folder / "result"


def test_from_recording_to_a_file_that_runs_and_is_certified(result, tmp_path, capsys):
    file = tmp_path / "upgraded.yaml"
    parameters = result / "nodes" / "PID" / "controllers.yaml"
    command = ["upgrade", str(parameters), "--goal", "fast", "--bag", str(result / "bags" / "PID")]
    command += ["--urdf", "urdf/mobile_manipulator.urdf", "--poses", "3", "-o", str(file)]
    assert main(command) == DONE
    assert "Predicted, simulated on the model" in capsys.readouterr().out
    before, after = map(settings_from_parameter_file, (parameters, file))
    assert list(before) == list(after)
    for name, settings in after.items():
        assert settings.law == "hpid"
        assert settings.mu < 0.0
        assert settings.gains == before[name].gains
        assert settings.encoder_resolution == pytest.approx(math.tau / 16384, rel=1e-4)
    numbers = [line for line in file.read_text().splitlines() if ": " in line and "#" not in line]
    assert [line.split(":")[0].strip() for line in numbers] == ["joints"]
    assert main(["check-gains", str(file)]) == DONE
    assert "exists" in refused(command, capsys)
    own = [*command[:-1], str(parameters), "--force"]
    assert "is an input; name another file with -o" in refused(own, capsys)
    assert list(map(settings_from_parameter_file, (parameters, file))) == [before, after]


def refused(command, capsys):
    capsys.readouterr()
    assert main(command) == BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_a_bag_without_the_joint_is_one_line(result, tmp_path, capsys):
    parameters = {"joint": "elbow", "law": "pid", "inertia": 1.0}
    parameters["gains"] = {"p": 3.0, "i": 1.0, "d": 3.0}
    file = tmp_path / "elbow.yaml"
    file.write_text(yaml.safe_dump({"elbow_controller": {"ros__parameters": parameters}}))
    command = ["upgrade", str(file), "--goal", "fast", "-o", str(tmp_path / "new.yaml")]
    assert "elbow" in refused([*command, "--bag", str(result / "bags" / "PID")], capsys)
    assert main(command) == DONE  # and without the bag it works
    assert "cannot write" in refused([*command[:-1], "/proc/new.yaml"], capsys)
