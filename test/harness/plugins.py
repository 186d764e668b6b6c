"""An exported plugin of ros2_control, compiled against stand-ins of what it calls, and called."""

import ctypes
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from harness.loops import loop_settings
from hpid_bench.experiment.in_process import controllers_text
from hpid_bench.tuning.export import GivenLoop, package_files
from hpid_ros.control.settings import LARGEST_MOTION, PARAMETERS
from hpid_ros.stability.gain_boxes import gain_ranges

COMPILER = shutil.which("g++") or shutil.which("clang++")
STRICT = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-Wpedantic", "-Wshadow")
FOLDER = Path(__file__).parent / "plugin"
PACKAGE = "arm_controller"
MS = 1_000_000
ELBOW = {
    **{"joint": "elbow", "gains__p": 39.6, "gains__i": 132.0, "gains__d": 3.96, "mu": -0.1},
    **{"norm__error_scale": 0.08, "norm__rate_weight": 1.2, "inertia": 0.1},
    **{"u_clamp_max": 20.0, "u_clamp_min": -20.0, "fallback_effort": 0.25},
    **{"position_max": 1.5, "position_min": -1.5, "velocity_max": 30.0},
}
WRIST = {
    **{"joint": "wrist", "law": "pid", "gains__p": 12.0, "gains__i": 5.0, "gains__d": 1.5},
    **{"inertia": 0.05, "velocity_source": "filtered"},
}
LOOPS = [loop_settings(**ELBOW), loop_settings(**WRIST)]
NO_STOPS = {"position_max": LARGEST_MOTION, "position_min": -LARGEST_MOTION}
NAMES = ["elbow", "wrist"]


def needs_cpp():
    """Skip a test where nothing compiles C++."""
    if COMPILER is None:
        pytest.skip("no C++ compiler (g++ or clang++) on this machine")


def export(folder, loops):
    """Write a package of loops, each judged at the inertia of its settings."""
    ranges = gain_ranges([(each, (each.inertia, each.inertia)) for each in loops])
    for name, text in package_files(PACKAGE, ranges, controllers_text(loops), "a test").items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def compile_plugin(folder, *options, driver="driver.cpp"):
    """Compile an exported package into a library that :class:`Plugin` calls, or a program."""
    needs_cpp()
    stand_ins = folder / "stand_ins"
    sources = [*sorted((folder / "src").glob("*.cpp")), folder / "src" / f"{PACKAGE}_loop.c"]
    for source in (folder / "src").iterdir():
        for name in re.findall(r'#include "(\w+/.+)"', source.read_text()):
            path = stand_ins / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text('#include "stand_ins.hpp"\n')
    (stand_ins / "rcutils" / "sha256.h").write_text(SHA256)
    parameters = stand_ins / PACKAGE / f"{PACKAGE}_parameters.hpp"
    parameters.write_text(_listener())
    for each in FOLDER.glob("*.cpp"):
        text = each.read_text().replace("{{ package }}", PACKAGE)
        (folder / each.name).write_text(text)
    includes = ["-I", stand_ins, "-I", FOLDER, "-I", folder / "src", "-I", folder]
    objects = []
    for source in [*sources, folder / driver]:
        own = [COMPILER, *STRICT] if source.suffix == ".cpp" else [COMPILER, "-x", "c", "-std=c99"]
        objects.append(folder / f"{source.name}.o")
        command = [*own, "-O1", "-ffp-contract=off", "-fPIC", *options, *includes]
        command += [f'-DSHARE_FOLDER="{folder}"', "-c", source, "-o", objects[-1]]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stderr
    is_library = driver == "driver.cpp"
    output = folder / ("plugin.so" if is_library else "program")
    kind = ["-shared"] if is_library else []
    subprocess.run([COMPILER, *kind, *options, *objects, "-o", output, "-pthread"], check=True)
    return output


def run_threads(folder, parameters, sanitizer):
    """Run a control loop beside the other thread under a sanitizer; return what it says."""
    needs_cpp()
    lines = []
    for joint, values in parameters.items():
        for name, value in values.items():
            kind = {float: "number", bool: "flag", str: "text"}[type(value)]
            shown = json.dumps(value) if kind != "number" else repr(value)
            lines.append(f'override_{kind}("{joint}_controller", "{name}", {shown});')
    (folder / "overrides.inc").write_text("\n".join(lines))
    options = ["-O0", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all"]
    probe = [COMPILER, *options, "-x", "c++", "-", "-o", folder / "probe"]
    if subprocess.run(probe, input=b"int main() {}", check=False, capture_output=True).returncode:
        pytest.skip(f"the C++ compiler has no sanitizer of {sanitizer}")
    program = compile_plugin(folder, *options, driver="threads.cpp")
    return subprocess.run([program], capture_output=True, text=True, check=False, timeout=300)


SHA256 = """
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <string>
#define RCUTILS_SHA256_BLOCK_SIZE 32
struct rcutils_sha256_ctx_t { std::string content; };
inline void rcutils_sha256_init(rcutils_sha256_ctx_t *) {}
inline void rcutils_sha256_update(rcutils_sha256_ctx_t * c, const std::uint8_t * d, std::size_t n)
{
  c->content.append(reinterpret_cast<const char *>(d), n);
}
inline void rcutils_sha256_final(rcutils_sha256_ctx_t * context, std::uint8_t * digest)
{
  const std::string path = std::string(SHARE_FOLDER) + "/hashed";
  std::FILE * file = std::fopen(path.c_str(), "wb");
  std::fwrite(context->content.data(), 1, context->content.size(), file);
  std::fclose(file);
  std::FILE * output = popen(("sha256sum " + path).c_str(), "r");
  for (int k = 0; k < 32; ++k) {
    unsigned byte = 0;
    if (std::fscanf(output, "%2x", &byte) == 1) {
      digest[k] = static_cast<std::uint8_t>(byte);
    }
  }
  pclose(output);
}
"""


class Plugin:
    """A controller of an exported package; the controller_manager is the test."""

    def __init__(self, library, joints, *, is_chained=False, update_rate=0, **overrides):
        self._library = ctypes.CDLL(str(library))
        for name, result in _RESULTS.items():
            getattr(self._library, name).restype = result
        self.joints = tuple(joints)
        for joint, values in overrides.items():
            self._override(f"{joint}_controller", values)
        self._made = self._library.make(is_chained, update_rate)
        self.log = self._text(self._library.logged())
        self.is_configured = bool(self._made)
        self._stamp_ns = 0

    def _override(self, node, values):
        kinds = {float: ctypes.c_double, bool: ctypes.c_bool}
        for name, value in values.items():
            kind = {float: "number", bool: "flag", str: "text"}[type(value)]
            given = value.encode() if kind == "text" else kinds[type(value)](value)
            call = getattr(self._library, f"override_{kind}")
            call(node.encode(), name.encode(), given)

    @staticmethod
    def _text(raw):
        return raw.decode()

    def _call(self, name, *arguments):
        return getattr(self._library, name)(ctypes.c_void_p(self._made), *arguments)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self._made:
            self._call("destroy")
            self._made = None

    def activate(self):
        return self._call("activate")

    def deactivate(self):
        return self._call("deactivate")

    def cleanup(self):
        return self._call("cleanup")

    def update(self, stamp_ns, *states, period_ns=None):
        """Return the efforts that answer positions and velocities, a pair for each joint.

        Without a period it is the time since the last update.
        """
        if period_ns is None:
            period_ns = stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        numbers = [each for pair in states for each in pair]
        efforts = (ctypes.c_double * len(self.joints))()
        given = (ctypes.c_double * len(numbers))(*numbers)
        self._call("update", ctypes.c_int64(stamp_ns), ctypes.c_int64(period_ns), given, efforts)
        return list(efforts)

    def ask(self, *references):
        """Ask for positions and velocities as a preceding controller does."""
        numbers = [each for pair in references for each in pair]
        self._call("ask", (ctypes.c_double * len(numbers))(*numbers))

    def set_chained(self, is_chained):
        """Begin or end chained mode as a manager does, within one cycle."""
        assert self.deactivate()
        self._library.tick(0)
        self._call("set_chained", ctypes.c_bool(False))
        self._call("set_chained", ctypes.c_bool(is_chained))
        assert self.activate()

    def set_type(self, *, is_double):
        """Give the first joint's position another type, or its own again."""
        self._call("set_type", ctypes.c_bool(is_double))

    def cannot_read(self):
        """Tell whether a cycle throws where a state is no double."""
        return bool(self._call("cannot_read"))

    def keep_command(self, tries):
        """Have another thread hold the first joint's command for so many tries to set it."""
        self._call("keep_command", ctypes.c_int(tries))

    def set_busy(self, is_busy):
        self._call("set_busy", ctypes.c_bool(is_busy))

    def tick(self):
        """Let the other thread do what is due."""
        self._library.tick(50)

    def node(self, joint):
        return f"/hpid_controller/{joint}_controller"

    def set(self, joint, **values):
        """Return why numbers are refused, empty if they are taken; ``__`` stands for a dot."""
        names = [name.replace("__", ".").encode() for name in values]
        return self._text(
            self._library.set_numbers(
                self.node(joint).encode(),
                (ctypes.c_char_p * len(names))(*names),
                (ctypes.c_double * len(names))(*values.values()),
                len(names),
            )
        )

    def transition(self, joint, which):
        return self._text(self._library.transition(self.node(joint).encode(), which.encode()))

    def lifecycle(self, joint):
        return self._text(self._library.lifecycle(self.node(joint).encode()))

    def verdict(self, joint):
        """Return the level and the line of its newest diagnostics."""
        return self._text(self._library.verdict(self.node(joint).encode()))

    def health(self, joint, key):
        """Return what its newest diagnostics say of a key."""
        return self._text(self._library.health(self.node(joint).encode(), key.encode()))

    def setpoint(self, joint, position):
        topic = f"{self.node(joint)}/setpoint"
        self._library.setpoint(topic.encode(), ctypes.c_double(position))

    def trajectory(self, joint, stamp_ns, times_ns, *columns):
        """Send positions and, if given, velocities, accelerations and efforts of a joint.

        Several names in one text have the same positions.
        """
        arrays = [
            None if each is None else (ctypes.c_double * len(times_ns))(*each) for each in columns
        ]
        arrays += [None] * (4 - len(arrays))
        self._library.trajectory(
            b"/hpid_controller/joint_trajectory",
            joint.encode(),
            ctypes.c_int64(stamp_ns),
            len(times_ns),
            (ctypes.c_int64 * len(times_ns))(*times_ns),
            *arrays,
        )

    def taken(self, topic):
        """Return the messages of a topic: stamp, and position, velocity, effort by joint."""
        found = []
        stamp_ns = ctypes.c_int64()
        numbers = (ctypes.c_double * 12)()
        full = f"/hpid_controller/{topic}".encode()
        while names := self._library.take(full, ctypes.byref(stamp_ns), numbers):
            rows = {
                name: tuple(numbers[3 * k : 3 * k + 3])
                for k, name in enumerate(names.decode().split())
            }
            found.append((stamp_ns.value, rows))
        return found

    def told(self):
        """Return what was logged since the last call."""
        return self._text(self._library.logged())


class Cycle:
    """A controller that is called each millisecond with a state that moves a little.

    ``given`` is Python's loop of the first joint, ``held`` where that is held.
    """

    def __init__(self, plugin):
        self.plugin, self.stamp_ns, self.position = plugin, 1_000_000_000, 0.1
        self.given, self.held = GivenLoop(LOOPS[0]), self.position + 1e-5

    def __call__(self, count=1, by=1e-5, speed=0.01):
        for _ in range(count):
            self.stamp_ns += MS
            self.position += by
            efforts = self.plugin.update(self.stamp_ns, *[(self.position, speed)] * 2)
        return efforts

    def as_python(self, count, by=1e-5, speed=0.01):
        """Call it, and see that the first joint's efforts are those of Python's loop."""
        for _ in range(count):
            found = self(1, by, speed)[0]
            assert found == self.given.step(self.stamp_ns, self.held, 0.0, self.position, speed)


def reference_of(plugin, joint, stamp_ns, states):
    """Return what a joint's loop followed in a cycle."""
    plugin.update(stamp_ns, *states)
    plugin.tick()
    *_, (_, rows) = plugin.taken(f"{joint}_controller/reference")
    return rows[joint][:2]


_RESULTS = {
    "make": ctypes.c_void_p,
    "activate": ctypes.c_bool,
    "deactivate": ctypes.c_bool,
    "cleanup": ctypes.c_bool,
    **dict.fromkeys(
        ("take", "set_numbers", "transition", "lifecycle", "logged", "health", "verdict"),
        ctypes.c_char_p,
    ),
}


def _listener():
    """Return what generate_parameter_library would make: all parameters, declared."""
    lines = []
    for name, spec in PARAMETERS.items():
        value = spec.default
        if isinstance(value, bool):
            shown = str(value).lower()
        else:
            shown = repr(value) if isinstance(value, float) else f'std::string("{value or ""}")'
        lines.append(f'    node->declare("{name}", {shown});')
    return f"""
#include "stand_ins.hpp"
namespace {PACKAGE}
{{
struct Params {{ std::string joint; double introspection_rate = -1.0; }};
class ParamListener
{{
public:
  explicit ParamListener(const rclcpp_lifecycle::LifecycleNode::SharedPtr & node)
  {{
{chr(10).join(lines)}
    params_.joint = node->get_parameter("joint").as_string();
  }}
  const Params & get_params() const {{ return params_; }}
private:
  Params params_;
}};
}}
"""
