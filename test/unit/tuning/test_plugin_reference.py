"""The plugin's reference is Python's, to the last bit, whatever sequence of messages comes."""

import ctypes
import math
import struct
import subprocess

import pytest
from harness.examples import examples
from harness.plugins import COMPILER, FOLDER, PACKAGE, STRICT, needs_cpp
from harness.streams import SmoothMotion, Stream, anything, draws, played
from hypothesis import given
from hypothesis import strategies as st

from hpid_bench.tuning.export import templates
from hpid_ros.control.following import Following
from hpid_ros.control.limits import MotionBounds, MotionLimits
from hpid_ros.control.reference import LARGEST_POSITION

SEEDS = st.integers(0, 2**32)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    needs_cpp()
    folder = tmp_path_factory.mktemp("follower")
    texts = {"package": PACKAGE, "largest_position": LARGEST_POSITION}
    for name in ("reference.cpp", "reference.hpp"):
        text = templates().get_template(f"ros2_control/{name}").render(texts)
        (folder / name).write_text(text)
    driver = (FOLDER / "follower.cpp").read_text().replace("{{ package }}", PACKAGE)
    (folder / "follower.cpp").write_text(driver)
    command = [COMPILER, *STRICT, "-O2", "-ffp-contract=off", "-fPIC", "-shared"]
    sources = [folder / "reference.cpp", folder / "follower.cpp"]
    subprocess.run([*command, *sources, "-o", folder / "follower.so"], check=True)
    found = ctypes.CDLL(str(folder / "follower.so"))
    found.begin.restype = ctypes.c_void_p
    return found


class PluginFollowing:
    """The plugin's Follower, called as Python's Following."""

    def __init__(self, library, position, takeover_time, limits):
        low, high, fastest = -math.inf, math.inf, math.inf
        if limits is not None:
            low, high = limits.reference(-1e9, 0.0)[0], limits.reference(1e9, 0.0)[0]
            fastest = limits.fastest
        numbers = (position, takeover_time, fastest, low, high)
        self._library = library
        self._it = ctypes.c_void_p(library.begin(*map(ctypes.c_double, numbers)))
        self._came = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._library.finish(self._it)

    def follow(self, column):
        self._came.append(column)

    def sample(self, stamp_ns, _takeover_time, limits):
        for column in self._came:
            rows = list(zip(*column.knots, strict=True))
            times = (ctypes.c_int64 * len(rows[0]))(*rows[0])
            numbers = [
                (ctypes.c_double * len(row))(*(math.nan if x is None else x for x in row))
                for row in rows[1:4]
            ]
            stamps = (ctypes.c_int64(stamp_ns), ctypes.c_int64(column.stamp_ns))
            self._library.receive(self._it, *stamps, len(rows[0]), times, *numbers)
        self._came = []
        found = (ctypes.c_double * 2)()
        self._library.sample(self._it, ctypes.c_int64(stamp_ns), found)
        position, velocity = found
        if limits is not None:
            inside, velocity = limits.reference(position, velocity)
            position = inside
        return position, velocity, 0.0


@given(SEEDS)
@examples(8)
def test_a_stream_and_anything_else_is_followed_as_python_follows_it(library, seed):
    draw = draws(seed)
    seconds, period = 1.5, draw.choice([0.001, 0.002, 0.005])
    takeover_time = draw.choice([0.0, 0.05, 0.5, 2.0])
    limits = None
    if draw.random() < 0.3:
        bounds = MotionBounds(-0.5, 0.6, draw.choice([0.4, 3.0]), 0.1, 1, 1, math.inf, -9, 9)
        limits = MotionLimits(bounds)
    if draw.random() < 0.5:
        motion = SmoothMotion(draw)
        arrivals = list(Stream.by_chance(draw).arrivals(draw, motion, seconds))
        start = motion(0.0)
    else:
        arrivals = list(anything(draw, seconds, speed=draw.choice([None, 1.0])))
        start = draw.uniform(-0.5, 0.5)
    python = Following()
    python.stand(start)
    settings = (arrivals, period, seconds, takeover_time, limits)
    mine = list(played(python, *settings))
    with PluginFollowing(library, start, takeover_time, limits) as plugin:
        theirs = list(played(plugin, *settings))
    for one, other in zip(mine, theirs, strict=True):
        bits = [struct.pack("3d", *(x + 0.0 for x in each)) for each in (one, other)]
        assert bits[0] == bits[1], (seed, one, other)
