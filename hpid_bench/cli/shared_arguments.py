"""Options that several subcommands of ``hpid`` take, declared once."""

from __future__ import annotations

from pathlib import Path

from hpid_bench.cli.parser import Arguments, Parser


def comma_separated(text: str) -> tuple[str, ...]:
    return tuple(each.strip().lower() for each in text.split(",") if each.strip())


def experiment_options(parser: Parser) -> None:
    parser.add_argument(
        "experiment", nargs="?", metavar="FILE", help="experiment file (the paper's comparison)"
    )


def joint_options(parser: Parser) -> None:
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME",
        help="this joint, or 'arm_*'; '!*hand*' leaves out (all)",
    )


def engine_options(parser: Parser) -> None:
    parser.add_argument("--engine", help="of the physics: pybullet or mujoco (as the file says)")


def output_options(parser: Parser, name: str) -> None:
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help=f"folder (results/{name}-TIME)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing result")


def process_options(parser: Parser) -> Arguments:
    """Add over how many processes a run on the graph is spread; return their exclusive group."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "--separate",
        dest="processes",
        action="store_const",
        const="each",
        help="each controller in a process of its own: the default with a core for each",
    )
    either.add_argument(
        "--composed",
        dest="processes",
        action="store_const",
        const="composed",
        help="all controllers in one process: the default with fewer cores",
    )
    either.add_argument(
        "--single-process",
        dest="processes",
        action="store_const",
        const="single",
        help="controllers and robot in one process",
    )
    return either


def jobs_options(parser: Parser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "-j", "--jobs", type=int, metavar="N", help="processes (one for each processor)"
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask scheduler whose workers run everything, tcp://HOST:PORT",
    )


def topics_options(place: Arguments) -> None:
    place.add_argument("--namespace", metavar="NAME", help="which of several robots")
    place.add_argument(
        "--states",
        action="append",
        default=[],
        metavar="TOPIC",
        help="of the joint states; once for each topic of one robot",
    )
    place.add_argument(
        "--commands",
        metavar="TOPIC",
        help="of the efforts. effort: take *_controller/commands as efforts; the topic of the "
        "states: use the measured ones; none: read no efforts (found by name and type, else the "
        "measured ones)",
    )
    place.add_argument(
        "--command-topic",
        action="append",
        default=[],
        metavar="JOINT=TOPIC[INDEX]",
        help="of one joint's efforts; may be repeated",
    )
    place.add_argument(
        "--sender",
        metavar="NUMBER",
        help="which sender of the states where several send the same joints: its number in the "
        "warning, its rate (50Hz) or its layout (names in their order) (the one that goes on)",
    )


def times_options(place: Arguments) -> None:
    place.add_argument("--clock", default="header", help="header or receive (header)")
    place.add_argument("--start", type=float, metavar="S", help="seconds after the first state")
    place.add_argument("--end", type=float, metavar="S", help="seconds after the first state")


def robot_options(parser: Parser, rare: Arguments) -> None:
    parser.add_argument(
        "--inertia",
        action="append",
        nargs="+",
        default=[],
        metavar="M",
        help="of every joint: M, or LOW HIGH; of one: JOINT=M or JOINT=LOW:HIGH, also with "
        "--urdf; or a file of hpid identify (.yaml)",
    )
    parser.add_argument(
        "--urdf",
        metavar="FILE",
        help="inertias over the ranges of this robot: a URDF, or an experiment file (.yaml)",
    )
    rare.add_argument(
        "--payload", type=float, default=0.0, metavar="KG", help="largest payload, with --urdf"
    )
    rare.add_argument(
        "--poses", type=int, metavar="N", help="sampled over the joints' ranges, with --urdf (200)"
    )


def graph_options(place: Arguments) -> None:
    place.add_argument("--namespace", metavar="NS", help="only controllers below this namespace")
    place.add_argument(
        "--states", default="joint_states", metavar="TOPIC", help="of the states (joint_states)"
    )
