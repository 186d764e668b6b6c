"""Hurwitz against the eigenvalues of the linear loop."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hpid_ros.control.gains import Gains
from hpid_ros.control.stability import is_hurwitz, require_hurwitz
from hpid_ros.errors import GainError

POSITIVE = st.floats(0.05, 50.0)


@given(POSITIVE, POSITIVE, POSITIVE, POSITIVE)
def test_hurwitz_agrees_with_the_eigenvalues(p, i, d, inertia):
    assume(abs(p * d - inertia * i) > 1e-6 * (p * d))
    matrix = np.array([[0, 1, 0], [-p / inertia, -d / inertia, 1], [-i / inertia, 0, 0]])
    stable = bool(np.linalg.eigvals(matrix).real.max() < 0.0)
    assert is_hurwitz(Gains(p, i, d), inertia) == stable


def test_a_pd_is_stable_and_an_undamped_one_is_not():
    assert is_hurwitz(Gains(1.0, 0.0, 1.0))
    assert not is_hurwitz(Gains(1.0, 0.0, 0.0))
    assert not is_hurwitz(Gains(0.0, 0.0, 1.0))


@pytest.mark.parametrize("inertia", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_inertia_is_refused(inertia):
    with pytest.raises(GainError, match="inertia must be positive"):
        require_hurwitz(Gains(1.0, 1.0, 1.0), inertia)
