"""The norm in units of effort: one scale in N m for every joint of a robot."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.control import LoopSettings
from hpid_ros.control.assembly import make_law
from hpid_ros.stability.gain_check import kind_of

NORMS = st.sampled_from(["weighted", "canonical"])
GAINS = {"gains.p": 21.0, "gains.i": 52.5, "gains.d": 2.1}
BASE = {"joint": "j", **GAINS, "mu": -0.3, "norm.effort_scale": 3.0, "norm.floor": 0.0}
scales = st.floats(1e-2, 1e2)
errors = st.floats(-10.0, 10.0)


def settings(**changes):
    return LoopSettings.from_parameters(
        BASE | {k.replace("__", "."): v for k, v in changes.items()}
    )


def simc(inertia, time):
    """Return the gains of SIMC's rule for a double integrator."""
    return {
        "gains__p": inertia / (2.0 * time**2),
        "gains__i": inertia / (16.0 * time**3),
        "gains__d": inertia / time,
    }


@given(NORMS, scales, st.floats(-0.45, 0.45))
def test_the_norm_is_1_where_either_term_of_the_pid_is_the_scale(norm_type, scale, mu):
    norm = settings(norm__type=norm_type, norm__effort_scale=scale).norm_family(mu)
    assert norm(scale / GAINS["gains.p"], 0.0) == pytest.approx(1.0, rel=1e-12)
    assert norm(0.0, -scale / GAINS["gains.d"]) == pytest.approx(1.0, rel=1e-12)


@given(NORMS, errors, errors, scales, scales, st.floats(-0.45, 0.45))
def test_laws_that_differ_by_their_units_of_effort_are_one(norm_type, e, de, scale, unit, mu):
    """Gains and scale in other units of effort: the same multiplier, so the effort in the unit."""
    law = make_law(settings(norm__type=norm_type, norm__effort_scale=scale, mu=mu))
    other = make_law(
        settings(
            norm__type=norm_type,
            norm__effort_scale=unit * scale,
            mu=mu,
            **{name.replace(".", "__"): unit * value for name, value in GAINS.items()},
        )
    )
    effort = law.update(e, de, 0.001)
    assert other.update(e, de, 0.001) == pytest.approx(unit * effort, rel=1e-9, abs=1e-12)


@given(NORMS, scales, st.floats(1e-3, 10.0), st.floats(0.02, 0.5))
def test_joints_tuned_by_one_rule_share_a_certificate_whatever_the_scale(
    norm_type, scale, inertia, time
):
    """rho and kd / kp in the loop's own time say it all: the scale in N m is not among them."""
    one = settings(norm__type=norm_type, norm__effort_scale=scale, **simc(inertia, time))
    other = settings(norm__type=norm_type, **simc(0.105, 0.05))
    kinds = kind_of(one, (inertia, inertia)), kind_of(other, (0.105, 0.105))
    first, second = ((k.p, k.d, k.least_inertia, k.rate_weight) for k in kinds)
    assert first == pytest.approx(second, rel=1e-9)


def test_other_damping_is_another_kind():
    one = kind_of(settings(), (0.1, 0.1))
    assert kind_of(settings(gains__d=2.5), (0.1, 0.1)).rate_weight != one.rate_weight


def test_a_gain_that_changes_keeps_the_scale():
    changed = settings().with_parameters({"gains.p": 42.0, "gains.d": 4.2})
    assert changed.norm_family.error_scale == 3.0 / 42.0
    assert changed.norm_family.rate_weight == 4.2 / 3.0
    assert changed.norm.effort_scale == 3.0


def test_without_it_the_norm_is_the_joints_own():
    off = settings(norm__effort_scale=0.0, norm__error_scale=0.3, norm__rate_weight=0.2)
    assert (off.norm_family.error_scale, off.norm_family.rate_weight) == (0.3, 0.2)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"norm__error_scale": 0.3},
            "norm.error_scale, which must stay at its default 1, not",
        ),
        ({"norm__rate_weight": 0.2}, "norm.rate_weight, which must stay at its default 0.1"),
        ({"gains__d": 0.0, "gains__i": 0.0}, "neither may be 0, as of 21 and 0"),
        ({"norm__effort_scale": math.inf}, "norm.effort_scale must"),
        ({"norm__effort_scale": -1.0}, "[0, 1e+06], not -1"),
    ],
)
def test_what_excludes_each_other_is_refused(changes, said):
    with pytest.raises(SettingError) as error:
        settings(**changes)
    assert said in str(error.value)


def test_with_decoupling_the_scale_is_still_an_effort():
    """There the gains are accelerations: the joint's inertia makes efforts of them."""
    loop = settings(compensation="decoupling", **simc(1.0, 0.05), inertia=0.105)
    assert loop.norm_family.error_scale == pytest.approx(3.0 / (0.105 * loop.gains.p))
    open_yet = settings(compensation="decoupling", **simc(1.0, 0.05))
    with pytest.raises(SettingError, match="needs the inertia"):
        make_law(open_yet)
