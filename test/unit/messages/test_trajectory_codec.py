"""Trajectories as bytes: what is encoded is what ROS reads, and what was meant."""

import numpy as np
from harness.bags import JOINT_TRAJECTORY as KIND
from harness.bags import TYPES
from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.messages.joint_trajectory import decode_trajectory, encode_trajectory


@st.composite
def trajectories(draw):
    """Names, times, and arrays of which each point has the same, or its own."""
    names = draw(st.lists(st.text("abcé_", min_size=1, max_size=6), min_size=1, max_size=5))
    gaps = draw(st.lists(st.integers(1, 10**10), min_size=1, max_size=9))
    times_ns = np.cumsum(gaps) + draw(st.integers(-(10**10), 10**10))
    seed = np.random.default_rng(draw(st.integers(0, 99)))
    arrays = [seed.normal(size=(len(gaps), len(names))) for _ in range(4)]
    is_mixed = draw(st.booleans())
    for each in arrays[1:]:
        given_by = [draw(st.booleans()) for _ in (gaps if is_mixed else gaps[:1])]
        each[~np.resize(given_by, len(gaps))] = np.nan
    return names, times_ns, tuple(arrays)


@given(trajectories(), st.integers(0, 2**31 * 10**9 - 1))
def test_ros_reads_what_was_encoded(trajectory, stamp_ns):
    names, times_ns, arrays = trajectory
    raw = encode_trajectory(stamp_ns, names, times_ns, arrays)
    message = TYPES.deserialize_cdr(raw, KIND)
    assert bytes(TYPES.serialize_cdr(message, KIND)) == raw
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
    assert message.joint_names == names
    assert len(message.points) == len(times_ns)
    for k, point in enumerate(message.points):
        time = point.time_from_start
        assert time.sec * 10**9 + time.nanosec == times_ns[k]
        given_ = point.positions, point.velocities, point.accelerations, point.effort
        for values, each in zip(given_, arrays, strict=True):
            assert list(values) == ([] if np.isnan(each[k, 0]) else list(each[k]))


@given(trajectories(), st.integers(0, 10**18))
def test_our_decoder_gives_it_back(trajectory, stamp_ns):
    names, times_ns, arrays = trajectory
    decoded = decode_trajectory(encode_trajectory(stamp_ns, names, times_ns, arrays))
    assert (decoded.stamp_ns, decoded.names) == (stamp_ns, tuple(names))
    assert np.array_equal(decoded.times_ns, times_ns)
    for got, meant in zip(decoded.arrays, arrays, strict=True):
        assert np.array_equal(got, meant, equal_nan=True)
