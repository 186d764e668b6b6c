"""Many loops certified: kinds found, computed once, and brought back into their own units."""

import pytest

from hpid_ros.base.errors import GainError
from hpid_ros.control import Gains, LoopSettings
from hpid_ros.control.settings import NormSettings
from hpid_ros.stability import gain_check as module
from hpid_ros.stability.certificate_search import certified_degree_interval
from hpid_ros.stability.certification import verify_certificate
from hpid_ros.stability.gain_check import certified_degrees, kind_of

pytestmark = pytest.mark.slow

NEAR_THE_LIMIT = Gains(5.0, 9.0, 2.0)


def loop(inertia=1.0, rate=1.0, scale=1.0, **norm):
    """Return the loop of NEAR_THE_LIMIT in other units of effort, time and error."""
    p, i, d = NEAR_THE_LIMIT.p, NEAR_THE_LIMIT.i, NEAR_THE_LIMIT.d
    gains = Gains(inertia * rate**2 * p, inertia * rate**3 * i, inertia * rate * d)
    norm = NormSettings(**{"error_scale": scale, "rate_weight": 3.0 / (scale * rate), **norm})
    return LoopSettings("j", gains, mu=0.05, norm=norm), (inertia, inertia)


@pytest.mark.parametrize("norm_type", ["weighted", "canonical"])
def test_loops_that_differ_by_their_units_are_of_one_kind(norm_type):
    kinds = {
        kind_of(*loop(inertia, rate, scale, type=norm_type))
        for inertia in (0.007, 1.0, 3.0)
        for rate in (0.3, 1.0, 17.0)
        for scale in (0.05, 1.0)
    }
    assert len(kinds) == 1
    assert kind_of(*loop(rate_weight=3.1)) not in kinds


def test_a_kind_is_computed_once_and_certifies_each_of_its_loops(monkeypatch):
    computed, told = [], []
    interval = module._interval
    monkeypatch.setattr(module, "_interval", lambda kind: computed.append(kind) or interval(kind))
    loops = [loop(), loop(0.007, 17.0, 0.05)]
    found = certified_degrees(loops, told.append)
    assert len(computed) == 1
    assert told == [["j", "j"]]
    assert len({each[:2] for each in found}) == 1
    for (settings, inertia), each in zip(loops, found, strict=True):
        assert each.certificate.gains == settings.gains
        assert each.certificate.inertias == inertia[:1]
        assert each.certificate.spans[0].norms[-1].degree == each.certificate.spans[1].lower
        assert verify_certificate(each.certificate).rate > 0.0
    alone = certified_degree_interval(NEAR_THE_LIMIT, loops[0][0].norm_family, 1.0)
    assert found[0][:2] == pytest.approx(alone[:2], abs=4e-3)


def test_a_range_of_inertia_comes_back_in_its_units():
    settings, _ = loop(0.1, 5.0, 0.2, rate_weight=0.5)
    (found,) = certified_degrees([(settings, (0.02, 0.1))])
    assert found.certificate.inertias == (0.02, pytest.approx(0.06), 0.1)
    verify_certificate(found.certificate)


def test_loops_without_an_interval_say_why_and_the_others_go_on():
    unstable = LoopSettings("u", Gains(1.0, 9.0, 1.0))
    without = LoopSettings("w", Gains(1.0, 0.0, 1.0))
    good = LoopSettings("g", Gains(100.0, 100.0, 20.0))
    found = certified_degrees([(each, (1.0, 1.0)) for each in (unstable, without, good)])
    assert [isinstance(each, GainError) for each in found] == [True, True, False]
    assert "must exceed" in str(found[0])
    assert "integral action" in str(found[1])
