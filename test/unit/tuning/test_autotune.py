"""Gains by SIMC on what was identified, certified for it."""

import pytest

from hpid_ros.base.errors import SettingError
from hpid_ros.control import LoopSettings
from hpid_ros.tuning.autotune import autotuned, effective_delay
from hpid_ros.tuning.gain_design import simc

RUNNING = {"joint": "elbow", "gains.p": 30.0, "gains.i": 90.0, "gains.d": 3.0}
FILTERED = {"velocity_source": "filtered", "velocity_filter_time_constant": 0.006}


def test_filter_and_hold_count_as_delay():
    plain = LoopSettings.from_parameters({**RUNNING, "control_period": 0.004})
    assert effective_delay(plain, 0.003) == pytest.approx(0.005)
    filtered = LoopSettings.from_parameters({**RUNNING, **FILTERED, "control_period": 0.004})
    assert effective_delay(filtered, 0.003) == pytest.approx(0.011)


def test_the_gains_are_simc_s_and_the_rest_of_the_loop_stays():
    settings = LoopSettings.from_parameters({**RUNNING, **FILTERED, "u_clamp_max": 7.0})
    found = autotuned(settings, (0.095, 0.105), 0.004, 0.05, "fast")
    exact = simc(0.1, 0.05, found.delay)
    assert found.pid.gains.p == pytest.approx(exact.p, rel=1e-3)
    assert found.pid.gains.d == pytest.approx(exact.d, rel=1e-3)
    upgraded = found.upgrade.settings
    assert upgraded.gains == found.pid.gains
    assert upgraded.effort.u_clamp_max == 7.0
    low, high = found.upgrade.interval
    assert low < upgraded.mu < 0.0 < high
    assert "SIMC" in found.upgrade.reasons["gains.p"]


def test_by_itself_the_closed_loop_takes_four_delays():
    settings = LoopSettings.from_parameters(RUNNING)
    found = autotuned(settings, (0.1, 0.1), 0.01, None, "smooth")
    assert found.closed_loop_time == pytest.approx(4.0 * found.delay)


def test_a_loop_that_decouples_is_refused():
    model = {"compensation": "decoupling", "model.description": "arm.urdf"}
    settings = LoopSettings.from_parameters({**RUNNING, **model, "gains.i": 50.0})
    with pytest.raises(SettingError, match="unit inertia"):
        autotuned(settings, (0.1, 0.1), 0.01, None, "fast")
