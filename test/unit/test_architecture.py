"""Imports point inward, each library has one room, and no folder is crowded.

Two houses: what drives a robot, and the bench, which may use it and is not used by it.
"""

import ast
import collections
import functools
import importlib.util
import inspect
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import hpid_ros

pytestmark = pytest.mark.repository

ROOT = Path(hpid_ros.__file__).parents[1]
HOUSES = {
    "hpid_ros": (
        "base",
        "control",
        "robot",
        "motion",
        "messages",
        "stability",
        "simulation",
        "metrics",
        "nodes",
    ),
    "hpid_bench": ("report", "tuning", "experiment", "live", "cli"),
}
ARCHITECTURE = ROOT / "docs" / "architecture.md"
ENTRIES = 24  # in one folder, at most

# From the inside out: a room may import those before it.
LAYERS = tuple(room for rooms in HOUSES.values() for room in rooms)
# The bench starts nodes as processes; what reads a running graph is one.
NOT_ALLOWED = {(room, "nodes") for room in ("report", "tuning", "experiment", "cli")}
ONLY_IN = {
    "rclpy": {"nodes", "live"},
    "launch": {"nodes"},
    "pybullet": {"simulation"},
    "mujoco": {"simulation"},
    "pinocchio": {"robot"},
    "rosbags": {"messages"},
    "mcap": {"messages"},
    "matplotlib": {"report", "tuning"},
    "jinja2": {"report", "tuning"},
    "PIL": {"report"},
    "nicegui": {"live"},
}
PURE = {"control"}
PURE_LIBRARIES = {"numpy", "scipy"}
FOREIGN = {"rclpy", "rosbags"}
# The only modules that may touch what another package keeps to itself.
INTERNALS = {
    "hpid_ros/nodes/parts/goal_server.py",
    "hpid_ros/nodes/core/rclpy_internals.py",
    "hpid_ros/messages/rosbags_internals.py",
}
# Documented in spite of the underscore: those of named tuples, and two of Python's own.
PUBLISHED = {"_replace", "_asdict", "_fields", "_make"}
BY_TEXT = {"getattr", "hasattr", "setattr", "delattr", "attrgetter"}
PUBLISHED_OF_MODULES = {"os._exit", "sys._current_frames"}
# rosbags keeps the rest to itself, without an underscore.
DOCUMENTED_BY_ROSBAGS = {
    "rosbags.interfaces",
    "rosbags.rosbag1",
    "rosbags.serde",
    "rosbags.typesys",
    "rosbags.typesys.store",
}
# Files, signals and terminals are not for the pure rooms.
SHELL = {
    "hpid_ros.base.console",
    "hpid_ros.base.processes",
    "hpid_ros.base.files",
    "hpid_ros.base.libraries",
    "hpid_ros.base.resources",
    "hpid_ros.base.yaml_files",
}


def test_the_page_on_architecture_has_the_rooms_in_their_order():
    rows = re.findall(r"^\| `(\w+)` \| ", ARCHITECTURE.read_text(), re.MULTILINE)
    assert tuple(each for each in rows if each in LAYERS) == LAYERS


@functools.cache
def modules():
    return tuple(sorted(path for house in HOUSES for path in (ROOT / house).rglob("*.py")))


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


@pytest.fixture(scope="module")
def size():
    """Return tools/size.py, which is in no package."""
    spec = importlib.util.spec_from_file_location("size", ROOT / "tools" / "size.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def room(path):
    _, *parts = path.relative_to(ROOT).parts
    return parts[0] if len(parts) > 1 else None


@functools.cache
def imports(path):
    """Return the dotted names that a file imports."""
    names = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.append(node.module)
            if node.module.split(".")[0] in HOUSES:
                names += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(names)


ROOMS = sorted({room(path) or "" for path in modules()})  # the houses themselves: ""


def modules_of(name):
    return [path for path in modules() if (room(path) or "") == name]


@pytest.mark.parametrize("name", ROOMS)
def test_imports_point_inward(name):
    for path in modules_of(name):
        wrong = [each for each in imports(path) if not is_allowed(each, room(path))]
        assert not wrong, f"{path.relative_to(ROOT)} must not import {', '.join(wrong)}"


def is_allowed(name, here):
    """Tell whether a room may import a name: a library, or what is of another room."""
    top, *rest = name.split(".")
    if top not in HOUSES:
        return here in ONLY_IN.get(top, {here})
    target = rest[0] if rest else None
    if here is None or target in (None, here, "__version__"):
        return True
    return LAYERS.index(target) < LAYERS.index(here) and (here, target) not in NOT_ALLOWED


@pytest.mark.parametrize("name", sorted(PURE))
def test_the_pure_core_needs_no_library_but_numpy_and_scipy(name):
    clocks = {"time", "datetime", "os", "pathlib", "io", "socket", "threading"}
    for path in modules_of(name):
        names = set(imports(path))
        tops = {each.split(".")[0] for each in names}
        assert tops - sys.stdlib_module_names <= HOUSES.keys() | PURE_LIBRARIES, path
        assert not clocks & tops, path
        assert not names & SHELL, path


def test_what_drives_a_robot_knows_nothing_of_the_bench():
    """Not even by name: what it starts as a process is started by the bench."""
    for path in (ROOT / "hpid_ros").rglob("*.py"):
        assert "hpid_bench." not in path.read_text(), path


# What a process of a robot loads ---------------------------------------------------------------


# Lines of code, see tools/size.py. To raise it is a decision: all of it runs next to a robot.
ROBOTS_SIDE_AT_MOST = 16_400
BENCH_ALONE = {"hpid_bench", "matplotlib", "rich", "jinja2", "joblib", "PIL"}
# What a controller has no use for before its first state; each takes its time to import.
UNUSED_BY_CONTROLLERS = {
    "csv",
    "difflib",
    "multiprocessing",
    "secrets",
    "shutil",
    "tempfile",
    "xml",
    "numpy.polynomial",
    "scipy",
    "hpid_ros.metrics",
    "hpid_ros.motion.base_path",
    "hpid_ros.motion.generators",
    "hpid_ros.robot.description",
}


def modules_loaded_by(*nodes):
    names = ", ".join(f"hpid_ros.nodes.{node}" for node in nodes)
    program = f"import {names}, sys; print(*sys.modules)"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    found = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, env=env
    )
    return set(found.stdout.split())


def test_what_drives_a_robot_has_not_grown(size):
    files = size.loaded_files(ROOT)
    assert ROOT / "hpid_ros" / "nodes" / "joint_controller.py" in files
    code = sum(size.code_lines(path.read_text()) for path in files)
    assert code <= ROBOTS_SIDE_AT_MOST
    assert code > 0.9 * ROBOTS_SIDE_AT_MOST  # else the ceiling is to come down


def test_a_robots_nodes_load_nothing_that_is_the_benchs_alone(size):
    loaded = modules_loaded_by(*size.ROBOTS_SIDE)
    assert not BENCH_ALONE & {name.partition(".")[0] for name in loaded}


def test_a_controller_loads_nothing_that_it_has_no_use_for():
    assert not UNUSED_BY_CONTROLLERS & modules_loaded_by("joint_controller")


def test_there_is_no_circle():
    """Not even within a room: whoever is imported can be read without who imports it."""
    names = {module_name(path): path for path in modules()}
    after = {name: {n for n in imports_of(path) if n in names} for name, path in names.items()}
    done = set()
    while after:
        free = [name for name, needs in after.items() if not needs - done - {name}]
        assert free, f"a circle among {sorted(after)}"
        done.update(free)
        for name in free:
            del after[name]


def module_name(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports_of(path):
    """Yield what a module imports, wherever it does: for its types or in a function, too."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in HOUSES:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_folder_is_crowded():
    for folder in {path.parent for path in modules()}:
        entries = [entry for entry in folder.iterdir() if entry.name != "__pycache__"]
        assert len(entries) <= ENTRIES, f"{folder} has {len(entries)} entries"


def test_nodes_do_not_import_each_other():
    """What has a main is a node; parts that nodes share are below them."""
    nodes = {
        p.stem
        for p in (ROOT / "hpid_ros" / "nodes").glob("*.py")
        if "\ndef main(" in p.read_text()
    }
    composed = {"joint_controllers", "single_process"}  # several nodes, by definition
    for path in (ROOT / "hpid_ros" / "nodes").rglob("*.py"):
        used = {f"hpid_ros.nodes.{node}" for node in nodes} & set(imports(path))
        assert not used or path.stem in composed, f"{path.stem} imports {used}"
    assert nodes >= {p.stem for p in (ROOT / "hpid_ros" / "nodes").glob("*.py")} - {"__init__"}


def test_the_repository_holds_its_own_sources_alone():
    top = ROOT
    if not (top / ".git").exists():
        pytest.skip("not a checkout")
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=top, check=True, capture_output=True, text=True
    )
    tracked = [top / name for name in listing.stdout.split("\0") if name]
    foreign = {".whl", ".gz", ".zip", ".so", ".pyc", ".log", ".TXT", ".mcap", ".db3"}
    assert not [path.name for path in tracked if path.suffix in foreign]
    assert not [path.name for path in tracked if path.is_file() and path.stat().st_size > 1 << 20]


# Private names: who sees `x._name` in a file cannot tell whose x is. So an underscore is allowed
# where the file itself, or for `self` an own base class, is the one that made the name.


def is_private(name):
    return re.fullmatch(r"_[A-Za-z]\w*", name) is not None


def is_self(node):
    """Tell whether an expression is the object or the class that a method is of."""
    is_super = isinstance(node, ast.Call) and ast.unparse(node.func) == "super"
    return is_super or (isinstance(node, ast.Name) and node.id in ("self", "cls"))


@functools.cache
def bound(tree):
    """Return the private names that a class or a file makes: functions, variables, attributes."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names |= {node.attr} if is_self(node.value) else set()
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__slots__":
            names |= {
                each.value for each in ast.walk(node.value) if isinstance(each, ast.Constant)
            }
    return {name for name in names if is_private(name)}


def classes(*trees):
    return [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]


def bound_by_class(name, known):
    """Return the private names of a class and of its bases, as far as they are known."""
    names = set()
    for node in known:
        if node.name == name:
            names |= bound(node)
            for base in node.bases:
                names |= bound_by_class(ast.unparse(base).rpartition(".")[2], known)
    return names


def foreign_privates(tree, known):
    """Yield the expressions that touch a private name which neither file nor class has made."""
    in_file, of_self = bound(tree), {}
    for node in classes(tree):
        names = bound_by_class(node.name, known)
        of_self.update({id(each): names for each in ast.walk(node)})
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            made = of_self.get(id(node), set()) if is_self(node.value) else in_file
            published = node.attr in PUBLISHED or ast.unparse(node) in PUBLISHED_OF_MODULES
            if node.attr not in made and not published:
                yield ast.unparse(node)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in BY_TEXT:
            texts = [each.value for each in node.args if isinstance(each, ast.Constant)]
            if any(isinstance(text, str) and is_private(text) for text in texts):
                yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [getattr(node, "module", ""), *(alias.name for alias in node.names)]
            if any(is_private(part) for name in names for part in name.split(".")):
                yield ast.unparse(node)


@pytest.fixture(scope="module")
def known_classes():
    return classes(*(parsed(path) for path in modules()))


@pytest.mark.parametrize("name", ROOMS)
def test_what_others_keep_to_themselves_is_used_in_one_module_for_each(name, known_classes):
    for path in modules_of(name):
        if str(path.relative_to(ROOT)) in INTERNALS:
            continue
        assert list(foreign_privates(parsed(path), known_classes)) == [], path
        of_rosbags = {each for each in imports(path) if each.split(".")[0] == "rosbags"}
        assert of_rosbags <= DOCUMENTED_BY_ROSBAGS, path


@pytest.mark.parametrize(
    "text",
    [
        "def f(node): return node._parameters",
        "class A(Node):\n    def f(self): return self._overrides['a']",
        "class A(Node):\n    def f(self): self._overrides['a'] = 1",
        "class A:\n    def f(self): self._x = 1\nclass B:\n    def f(self): return self._x",
        "class A(Node):\n    def f(self): return super()._handle",
        "getattr(node, '_handle')",
        "from rclpy.impl import _rclpy",
        "from rclpy._rclpy import Node",
        "import rclpy._rclpy",
        "os._environ",
    ],
)
def test_a_foreign_private_name_is_seen(text):
    tree = ast.parse(text)
    assert len(list(foreign_privates(tree, classes(tree)))) == 1


@functools.cache
def bound_by_foreign(base):
    """Return the private names that a class of a library makes."""
    return bound(ast.parse(textwrap.dedent(inspect.getsource(base))))


def test_no_own_private_name_hides_one_of_a_foreign_base():
    """Else the base would read ours: rclpy's nodes alone have dozens of such names."""
    checked = 0
    for path in modules():
        is_private_to_both = str(path.relative_to(ROOT)) in INTERNALS
        if is_private_to_both or not FOREIGN & {name.split(".")[0] for name in imports(path)}:
            continue
        module = importlib.import_module(module_name(path))
        for node in classes(parsed(path)):
            for base in getattr(module, node.name).__mro__:
                if base.__module__.split(".")[0] in FOREIGN:
                    hidden = bound(node) & bound_by_foreign(base)
                    assert not hidden, f"{node.name} hides {hidden} of {base}"
                    checked += 1
    assert checked > 5


# One name, one thing: else a search for a name leads astray.
MODULES_OWN = {"USAGE"}  # each node has one, what its --help says


def doubled(places):
    return {name: each for name, each in places.items() if len(each) > 1}


def test_a_class_has_its_name_for_itself():
    places = collections.defaultdict(list)
    for path in modules():
        for node in classes(parsed(path)):
            places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert doubled(places) == {}


def test_a_public_constant_or_type_means_the_same_wherever_it_is():
    meanings = collections.defaultdict(dict)
    for path in modules():
        named = [(node.name, f"class in {path}") for node in classes(parsed(path))]
        for name, meaning in [*named, *constants(parsed(path))]:
            if not name.startswith("_") and name not in MODULES_OWN:
                meanings[name][meaning] = path.relative_to(ROOT)
    assert doubled(meanings) == {}


def constants(tree):
    """Yield the names that a module binds, each with the text of what it is bound to."""
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            targets = [node.target]
        else:
            targets = node.targets if isinstance(node, ast.Assign) else []
        for target in targets:
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = zip(target.elts, node.value.elts, strict=True)
            else:
                pairs = [(target, node.value)]
            for each, value in pairs:
                if isinstance(each, ast.Name):
                    yield each.id, ast.unparse(value)


def test_a_doubled_name_is_seen():
    found = list(constants(ast.parse("A, B = 1, 2\nA: int = 3\nC = dict[str, int]")))
    assert found == [("A", "1"), ("B", "2"), ("A", "3"), ("C", "dict[str, int]")]
