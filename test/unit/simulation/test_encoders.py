from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.errors import SettingError
from hpid_ros.simulation.settings import Encoder

POSITIONS = st.floats(-1e3, 1e3)
COUNTS = st.integers(1, 1_000_000)
ENCODERS = st.builds(Encoder, COUNTS, st.floats(-0.5, 0.5))
ROUNDING = 1e-12  # [rad], of the arithmetic itself at 1e3 rad


@given(position=POSITIONS, encoder=ENCODERS)
def test_the_error_is_at_most_half_a_count(position: float, encoder: Encoder):
    assert abs(encoder.read(position) - position) <= math.pi / encoder.counts + ROUNDING


@given(position=POSITIONS, encoder=ENCODERS)
def test_readings_are_whole_counts_apart(position: float, encoder: Encoder):
    count = (encoder.read(position) - encoder.read(0.0)) / math.tau * encoder.counts
    assert count == pytest.approx(round(count), abs=1e-6)


@given(position=POSITIONS, counts=COUNTS)
def test_reading_a_reading_changes_nothing(position: float, counts: int):
    encoder = Encoder(counts)
    assert encoder.read(encoder.read(position)) == encoder.read(position)


@given(first=POSITIONS, second=POSITIONS, encoder=ENCODERS)
def test_readings_keep_the_order_of_positions(first: float, second: float, encoder: Encoder):
    low, high = sorted((first, second))
    assert encoder.read(low) <= encoder.read(high)


@given(position=POSITIONS)
def test_an_ideal_sensor_tells_the_truth(position: float):
    assert Encoder(0).read(position) == position


def test_two_positions_a_count_apart_read_differently():
    encoder = Encoder(4096)
    assert encoder.resolution == math.tau / 4096
    assert encoder.read(encoder.resolution) - encoder.read(0.0) == encoder.resolution


@pytest.mark.parametrize("counts", [-1, 4096.0, True, "4096"])
def test_counts_that_are_not_a_whole_number_are_refused(counts: object):
    with pytest.raises(SettingError, match="whole number"):
        Encoder(counts)  # type: ignore[arg-type]


def test_the_phase_moves_where_a_count_ends():
    third = math.tau / 4096 / 3.0
    assert Encoder(4096).read(third) == Encoder(4096).read(-third)
    assert Encoder(4096, 0.25).read(third) != Encoder(4096, 0.25).read(-third)
