"""A joint's loop in C, compiled and called; and settings and states by chance for both loops."""

import ctypes
import math
import shutil
import subprocess

import pytest

from hpid_bench.tuning.export import FIELDS, c_files, c_name
from hpid_ros.control.norms import NORMS

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wshadow")
_ROOM = 4096  # bytes, for what a state holds beside what may be read


def needs_compiler():
    """Skip a test where nothing compiles C."""
    if COMPILER is None:
        pytest.skip("no C compiler (cc, gcc or clang) on this machine")


def compile_c(folder, sources, *options, output="program"):
    """Compile C files of a folder with every warning an error, and return what comes out."""
    needs_compiler()
    command = [COMPILER, *STRICT, "-O2", *options, *sources, "-o", output, "-lm"]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return folder / output


def write_c(folder, settings, precision="double"):
    """Write a joint's files into a folder and return the name that they begin with."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in c_files(settings, precision, "a test").items():
        (folder / name).write_text(text)
    return c_name(settings.joint)


class CLibrary:
    """The functions of one joint's loop in C, for any settings."""

    def __init__(self, folder, settings, precision="double"):
        self.prefix = write_c(folder, settings, precision)
        options = ("-shared", "-fPIC")
        path = compile_c(folder, [f"{self.prefix}.c"], *options, output="loop.so")
        self._library = ctypes.CDLL(str(path))
        self.real = ctypes.c_double if precision == "double" else ctypes.c_float
        members = [(field.name, self._type(field)) for field in FIELDS]
        self.settings_type = type("Settings", (ctypes.Structure,), {"_fields_": members})
        numbers = [
            "effort",
            "integral",
            "p",
            "i",
            "d",
            "error",
            "position",
            "velocity",
            "reference",
            "rate",
        ]
        head = [
            ("condition", ctypes.c_int),
            *((name, self.real) for name in numbers),
            ("is_limited", ctypes.c_bool),
            ("rest", ctypes.c_char * _ROOM),
        ]
        self.state_type = type("State", (ctypes.Structure,), {"_fields_": head})
        self.function("step").restype = self.real

    def _type(self, field):
        if field.range is not None:
            return self.real
        return ctypes.c_int if field.choices else ctypes.c_bool

    def function(self, name):
        """Return a function of the library by the end of its name."""
        return getattr(self._library, f"{self.prefix}_{name}")

    def call(self, name, *arguments):
        """Call a function; structures are told by their address. Most tell whether they did."""
        function = self.function(name)
        function.restype = ctypes.c_bool
        told = (
            ctypes.byref(each) if isinstance(each, ctypes.Structure) else each
            for each in arguments
        )
        return function(*told)

    def of_python(self, settings):
        """Return settings in C that are those of Python, however little they go together."""
        return self.of_values(settings.to_parameters())

    def of_values(self, values):
        """Return settings in C from parameters by dotted name."""
        found = self.settings_type()
        for field in FIELDS:
            value = values[field.parameter]
            number = field.choices.index(value) if field.choices else value
            setattr(found, field.name, number)
        return found

    def exported(self):
        """Return the settings that were exported."""
        return self.settings_type.in_dll(self._library, f"{self.prefix}_settings")


class CLoop:
    """A loop in C, called as Python's."""

    def __init__(self, library, settings):
        self._library = library
        self.state = library.state_type()
        self._at = ctypes.byref(self.state)
        self._step = library.function("step")
        real = library.real
        self._step.argtypes = [
            ctypes.c_void_p,
            ctypes.c_int64,
            real,
            real,
            real,
            ctypes.POINTER(real),
        ]
        self.is_ready = library.call("init", self.state, library.of_python(settings))

    def step(self, stamp_ns, reference, rate, position, velocity):
        given = None if velocity is None else ctypes.byref(self._library.real(velocity))
        return self._step(self._at, stamp_ns, reference, rate, position, given)

    def retune(self, settings):
        return self._library.call("retune", self.state, self._library.of_python(settings))

    def set_gains(self, gains):
        numbers = [self._library.real(each) for each in (gains.p, gains.i, gains.d)]
        return self._library.call("set_gains", self.state, *numbers)

    def set_degree(self, degree):
        return self._library.call("set_degree", self.state, self._library.real(degree))

    def supersede(self, effort):
        self._library.call("supersede", self.state, self._library.real(effort))

    def reset(self):
        self._library.call("reset", self.state)


def parameters_by_chance(chance, **others):
    """Return parameters of a loop, most of them sensible; they need not go together."""
    p = 10.0 ** chance.uniform(-1.0, 3.0)
    d = p * 10.0 ** chance.uniform(-2.0, 0.0)
    inertia = chance.choice((0.0, 0.0, d * d / p * chance.uniform(0.1, 1.0)))
    period = chance.choice((0.001, 0.001, 0.002, 0.01))
    most = 10.0 ** chance.uniform(-1.0, 4.0)
    values = {
        "joint": "elbow",
        "law": chance.choice(("hpid", "hpid", "hpid", "pid")),
        "gains.p": p,
        "gains.d": d * chance.choice((1.0, 1.0, 1.0, 0.0)),
        "gains.i": chance.choice((0.0, p * 10.0 ** chance.uniform(-1.0, 1.0))),
        "inertia": inertia,
        "mu": chance.choice((0.0, *(chance.uniform(-0.49, 0.49) for _ in range(4)))),
        "norm.type": chance.choice((*NORMS,)),
        "norm.floor": chance.choice((-1.0, -1.0, 0.0, 0.1, 1e-3, -0.5)),
        "norm.cap": chance.choice((1e6, 1e6, 2.0)),
        "u_clamp_max": most,
        "u_clamp_min": -most * chance.uniform(0.5, 1.0),
        "i_clamp_max": chance.choice((1e6, 0.5 * most)),
        "i_clamp_min": chance.choice((-1e6, -0.4 * most)),
        "antiwindup_strategy": chance.choice(
            ("none", "conditional_integration", "back_calculation")
        ),
        "tracking_time_constant": chance.choice((0.0, 0.0, 0.3, 1e-4)),
        "velocity_source": chance.choice(("measured", "filtered", "homogeneous_differentiator")),
        "velocity_filter_time_constant": chance.choice((0.0, 0.005, 0.02)),
        "acceleration_bound": 10.0 ** chance.uniform(0.0, 3.0),
        "discretization": chance.choice(("explicit", "explicit", "semi_implicit")),
        "encoder_wrap": chance.choice((-1.0, 0.0, 0.0, 2.0 * math.pi, 1.0, -0.3)),
        "encoder_resolution": chance.choice((0.0, 1e-4)),
        "position_step_max": chance.choice((0.0, 0.0, 1e6, 1.0)),
        "effort_rate_max": chance.choice((0.0, 0.0, 50.0 * most)),
        "position_max": chance.choice((1e6, 1e6, 0.2)),
        "position_min": chance.choice((-1e6, -1e6, -0.1)),
        "velocity_max": chance.choice((1e6, 1e6, 5.0)),
        "soft_stop.margin": chance.choice((0.05, 0.2)),
        "soft_stop.k_position": chance.choice((0.0, 0.0, 20.0)),
        "soft_stop.k_velocity": chance.choice((0.0, 0.0, 5.0)),
        "takeover_time": chance.choice((0.0, 0.05, 0.5)),
        "fallback_effort": chance.choice((0.0, 0.3, -1e4)),
        "control_period": period,
        "state_timeout": chance.choice((0.1, 0.02, 1.4 * period)),
        "angle_wraparound": chance.random() < 0.2,
        "multi_turn": chance.random() < 0.2,
    }
    if chance.random() < 0.4:
        values["norm.effort_scale"] = 10.0 ** chance.uniform(-1.0, 1.0)
    else:
        values["norm.error_scale"] = 10.0 ** chance.uniform(-3.0, 1.0)
        values["norm.rate_weight"] = 10.0 ** chance.uniform(-3.0, 1.0)
    return {**values, **{name.replace("__", "."): value for name, value in others.items()}}


def states_by_chance(chance, count, period):
    """Yield states of a joint: stamp, reference, its rate, position, velocity or None.

    Most follow each other as those of a joint do; some are lost, repeated, out of order, no
    numbers, or where no joint can have come to.
    """
    bad = (math.nan, math.inf, -math.inf, 1e300, 2e9, -1e9, 1e-300, 0.0, -0.0)
    stamp_ns, step_ns = chance.choice((0, 10**9, 10**15, -(10**12))), round(period * 1e9)
    position = reference = chance.uniform(-3.0, 3.0)
    speed = rate = 0.0
    for _ in range(count):
        lost = chance.choice((1,) * 60 + (0, 2, 3, 500, -1, -500))
        stamp_ns += lost * step_ns
        rate += chance.gauss(0.0, 0.3)
        rate *= 0.98
        reference += rate * period
        speed += 20.0 * (reference - position) * period + chance.gauss(0.0, 0.3)
        speed *= 0.97
        position += speed * period
        if chance.random() < 0.01:
            reference += chance.gauss(0.0, 1.0)
        if chance.random() < 0.01:
            position += chance.choice((0.5, -2.0 * math.pi, 4.0, 1.0))
        state = [stamp_ns, reference, rate, position, speed + chance.gauss(0.0, 0.01)]
        if chance.random() < 0.1:
            state[4] = None
        kind = chance.random()
        if kind < 0.02:
            state[chance.randrange(3, 5)] = chance.choice(bad)
        elif kind < 0.025:
            state[chance.randrange(1, 3)] = chance.choice(bad)
        elif kind < 0.04:
            state[0] += chance.choice((1, -1, 10**12, 37 * step_ns, -(10**9)))
        elif kind < 0.05:
            state[3] += chance.choice((4.0, -3.0))
        elif kind < 0.06:  # at rest, exactly
            state[1], state[2], state[4] = state[3], 0.0, 0.0
        yield tuple(state)
