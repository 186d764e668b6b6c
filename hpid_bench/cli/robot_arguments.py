"""What the subcommands of ``hpid`` take that are for recordings, loops and running robots."""

from __future__ import annotations

from pathlib import Path

from hpid_bench.cli.arguments import (
    GAIN_OPTIONS,
    Parser,
    comma_separated,
    graph_options,
    options,
    robot_options,
    times_options,
    topics_options,
)


def metrics(parser: Parser) -> None:
    parser.describe(
        "BAG ...",
        "Compute performance indices of recordings, the first the baseline; tables, figures and a "
        "report. docs/indices.md defines every number.",
        {
            "hpid metrics my_bag": "one recording",
            "hpid metrics pid_bag hpid_bag --labels PID hPID": "second against first",
            "hpid metrics --group PID pid_* --group hPID hpid_*": "repeats: medians",
            "hpid metrics my_bag --indices step,rmse --units deg": "other indices",
            "hpid metrics my_bag --reference my_motion.yaml": "none in the bag: given",
            "hpid metrics a b --save ab.json --report ab.html": "to read again, a page",
        },
    )
    text = """
        bags BAG  bag folder or file; a result folder stands for its bags, a .json file for
            numbers that were saved
        --labels LABEL  one for each BAG; of the same label are repeats (from the bag's metadata,
            else its name)
        --group LABEL BAG ...  repeats of one run, for instance with other seeds; may be repeated
        --baseline BAG  what ratios are taken of: one of the bags, another one, or a label (the
            first)
        --joint NAME ...  this joint, or 'arm_*'; '!*hand*' leaves out (all)
        --joints JOINT
        --reference TOPIC|FILE|hold  what the joints were to follow: a topic, or a kind of it
            (trajectory, setpoint, sampled, controller_state); a YAML file with a reference
            section; hold: each its first position (auto: as reported or asked)
        --indices NAME,...  ivc, iavc, itae, iae, ise, rmse, error_max, effort_l2, error_l2,
            rise_time, settling_time, overshoot, steady_state_error, saturation, chatter, energy;
            or paper, step, all (paper)
        --units UNIT  of angles: rad, deg (rad)
    """
    options(
        parser,
        text,
        bags={"nargs": "*", "type": Path},
        labels={"nargs": "+"},
        group={"nargs": "+"},
        joint={"dest": "joints", "default": None},
        joints={"nargs": "+", "action": "extend"},
        reference="auto",
        indices="paper",
        units="rad",
    )
    options(
        parser.add_mutually_exclusive_group(),
        """
        --format  of the output (table)
        --csv  the same as --format csv
        --json  likewise
        """,
        format=("table", "csv", "json"),
        csv={"dest": "format", "action": "store_const", "const": "csv"},
        json={"dest": "format", "action": "store_const", "const": "json"},
    )
    text = """
        --save FILE  all numbers, to be read again
        --report FILE  one self-contained web page
        --figures FOLDER  draw the figures for print
        --force  replace files that exist
    """
    options(parser, text, save=Path, figures=Path, report=Path)
    rare = parser.rare()
    topics_options(rare)
    times_options(rare)
    text = """
        --align HOW  lay runs over each other where their references begin, where these first move
            (motion), or not (none) (auto: begin, or motion where that makes them one)
        --window LABEL=START[:END] ...  part of one recording, in s after its first state, instead
            of --align
        --overall  only the numbers over all joints, one a line
        --cutoff HZ  effort above it is chatter (20 Hz)
        --effort-limit [JOINT=]EFFORT ...  in N m, or N where it slides, at which a joint saturates
            (found in its efforts)
        --robot URDF  says which joints slide, in m and N (else the bag does, if it holds
            /robot_description); also tell how far its end effector was from the reference, by
            forward kinematics; an experiment file (.yaml) names wheels and initial positions, too
        --end-effector LINK  link whose pose counts, with --robot (the last)
        --wheels LEFT RIGHT  joints of the wheels of a base, with --robot: its odometry is added
        --formats FORMAT,...  of the figures: png, pdf, svg (png)
        --params FILE  parameter file of the controllers, for the report (from a result folder
            beside)
        --parameters FILE
    """
    options(
        rare,
        text,
        align="auto",
        cutoff=float,
        formats={"type": comma_separated, "default": ("png",)},
        params=Path,
        parameters={"dest": "params", "type": Path},
    )


def excite(parser: Parser) -> None:
    parser.describe(
        "[--joint NAME]",
        "Move joints of a running robot, by sums of sines or steps within shares of their limits, "
        "through the controllers that run, and record it. It asks before anything moves. At any "
        "limit, when a controller, the states or the recorder are silent, when somebody else "
        "sends a trajectory, and at Ctrl-C the joints come to rest, and their controllers hold "
        "them. Watch the robot, with a hand at its emergency stop: it knows neither its "
        "surroundings nor itself.",
        {
            "hpid excite --joint elbow --dry-run": "the plan, and nothing moves",
            "hpid excite --joint elbow -o elbow_bag": "then: hpid identify elbow_bag",
        },
    )
    text = """
        --joint NAME ...  only this joint; may be repeated (all that run)
        --kind  of motion (multisine)
        --together  all joints at once, not one after the other
        --duration S  of each joint (20)
        --share SHARE  of what is left of each limit of position and effort, and of the velocity
            limit (0.5)
        --amplitude A  at most, in rad or m (0.5)
    """
    options(parser, text, kind=("multisine", "steps"), duration=20.0, share=0.5, amplitude=0.5)
    rare = parser.rare()
    robot_options(parser, rare)
    text = """
        -o --output BAG  new folder (excitation-TIME)
        --plot FILE  draw the plan: .png, .pdf or .svg
        --force  replace the file of --plot
        --dry-run  show what would be done, and do nothing
        --yes  move without asking
    """
    options(parser, text, output=Path, plot=Path)
    graph_options(rare)
    text = """
        --frequencies LOW HIGH  of the sines in Hz (0.1 2.5)
        --velocity V  at most, in rad/s or m/s
        --acceleration A  at most, in rad/s^2 or m/s^2
        --tolerance E  stop a joint that is further from its reference, in rad or m (half its
            amplitude)
        --seed SEED  of the sines' phases (0)
    """
    options(
        rare,
        text,
        frequencies=(0.1, 2.5),
        velocity=float,
        acceleration=float,
        tolerance=0.0,
        seed=0,
    )


def identify(parser: Parser) -> None:
    parser.describe(
        "BAG",
        "Find what each joint's motor moves and what holds it back, from recorded positions and "
        "efforts, with 95 % intervals, and say what the recording cannot tell. With --urdf the "
        "links' masses are known, and rotors, friction and the effort's scale are sought; "
        "without, each joint is taken for itself, as if the others were at rest.",
        {
            "hpid identify my_bag --urdf arm.urdf -o found.yaml": "for --urdf of others",
            "hpid identify my_bag --joint elbow --plot elbow.png": "look at one joint",
        },
        "Exit code 1 if nothing could be found of any joint.",
    )
    text = """
        bag BAG  bag folder or file
        --urdf FILE  the robot: a URDF, or an experiment file (.yaml); its base stands still, and
            its own rotors and friction do not count
        --joint NAME ...  this joint, or 'arm_*'; '!*hand*' leaves out (all)
        --effort-unit  any: efforts are in a unit of their own, as of current, which the masses of
            --urdf fix (si: N m and N)
        -o --output FILE  what was found, as YAML that experiment files extend and that --urdf and
            --inertia of other commands take
        --json FILE  every number
        --plot FILE  predicted and measured efforts: .png, .pdf or .svg
        --force  replace files that exist
    """
    options(parser, text, bag=Path, effort_unit=("si", "any"), output=Path, json=Path, plot=Path)
    rare = parser.rare()
    topics_options(rare)
    times_options(rare)
    text = """
        --cutoff HZ  of the low pass (by each joint's noise)
        --longest-delay S  to look for (0.1 s)
    """
    options(rare, text, cutoff=float, longest_delay=0.1)


def replay(parser: Parser) -> None:
    parser.describe(
        "BAG",
        "Feed the recorded states, references and parameter changes to the same control loops, "
        "and say whether every command is theirs, or where and how it is not. A bag must hold the "
        "states, the commands with the stamps of the states that they answer (joint_commands), "
        "and what the controllers were told: joint_trajectory, ~/setpoint, and /parameter_events "
        "if anything was retuned.",
        {
            "hpid replay results/mine/bags/hPID": "a bag of hpid compare or run",
            "hpid replay my_bag --params controllers.yaml": "a bag of ros2 bag record",
        },
        "Exit codes: 0 every command is the law's, 1 one is not, 2 the input cannot be used.",
    )
    text = """
        bag BAG  a bag folder, or one file of it
        --params FILE  parameter file of the controllers as they were started (those in the bag)
        --joint NAME ...  this joint, or 'arm_*'; '!*hand*' leaves out (all)
        --namespace NAME  only topics below this namespace
        --states TOPIC ...  topic of the states; once for each topic of one robot
        --commands TOPIC  topic of the commands
    """
    options(parser, text, bag=Path, params=Path)


def repair(parser: Parser) -> None:
    parser.describe(
        "BAG",
        "Write every message that can be read into a new bag, with its index and metadata.yaml, "
        "and say what was saved and what was lost. The old bag is never changed.",
        {
            "hpid repair my_bag": "the readable part into my_bag_repaired",
            "hpid repair my_bag.mcap -o saved": "of one file that lost its folder",
        },
        "Exit codes: 0 a bag was written (what was lost is listed), 2 nothing could be read or "
        "written.",
    )
    text = """
        bag BAG  a bag folder, or one file of it
        -o --output FOLDER  the new bag, which must not exist (BAG_repaired beside BAG)
    """
    options(parser, text, bag=Path, output=Path)


def check_gains(parser: Parser) -> None:
    parser.describe(
        "[FILE]",
        "Check gains given as options, in a controller parameter file or experiment, or of the "
        "controllers that run. Exit code 0 only if every joint is certified.",
        {
            "hpid check-gains my.yaml --urdf arm.urdf": "of a file",
            "hpid check-gains --live --inertia 0.2": "of what runs",
            "hpid check-gains --p 40 --i 130 --d 4 --mu -0.2 --inertia 0.2": "one",
        },
    )
    text = """
        file FILE  parameter file, experiment, or certificates.json of a result, to verify
        --live  of all running joint controllers
    """
    options(parser, text, file={"nargs": "?", "type": Path})
    for name, parameter in GAIN_OPTIONS.items():
        usage = f"--{name.replace('_', '-')} {name.upper()}"
        options(parser, f"{usage}  as {parameter}", **{name: str if name == "norm" else float})
    robot_options(parser, parser.rare())
    options(parser, "--json  everything, with the certificates")


def margins(parser: Parser) -> None:
    parser.describe(
        "FILE",
        "Compute the margins of every joint's loop as it is sampled and held, over the inertia "
        "and, for the homogeneous law, over the multipliers that it reaches, each frozen in turn; "
        "beside them what is certified of the law itself. docs/margins.md defines every number.",
        {
            "hpid margins my.yaml --urdf arm.urdf --delay 0.002": "all",
            "hpid margins my.yaml --joint elbow --plot elbow.png": "one, drawn",
        },
        "Exit code 0 if every frozen loop is stable, 1 if one is not.",
    )
    text = """
        file FILE  parameter file of controllers, or experiment
        --joint NAME ...  this joint, or 'arm_*'; '!*hand*' leaves out (all)
        --controller LABEL  only this controller of an experiment (all)
    """
    options(parser, text, file=Path)
    rare = parser.rare()
    robot_options(parser, rare)
    text = """
        --friction B ...  viscous friction [N m s/rad] of every joint, or JOINT=B (the damping of
            --urdf or of the experiment's robot, else 0)
        --delay S  from a state to its effort at the joint, beyond the hold: computation, bus, dead
            time [s] (0); an experiment's drives add theirs
        --bag BAG  recorded excitation: the measured frequency response is compared and drawn
        --json FILE  write everything as JSON
        --plot FILE  draw Bode, Nyquist, |S| and |T| as .png, .pdf or .svg; of several loops one
            file each, FILE with the loop's name
        --force  replace existing files
    """
    options(parser, text, friction={"nargs": "+"}, delay=0.0, bag=Path, json=Path, plot=Path)
    text = """
        --norm-max N  largest norm that the loops reach (norm.cap, or 2 where there is none)
        --coherence C  frequencies of the bag with less are left out (0.95)
    """
    options(rare, text, norm_max=float, coherence=0.95)


def autotune(parser: Parser) -> None:
    parser.describe(
        "--live [--joint NAME]",
        "Have a relay drive one joint of a running robot for some cycles, inside its own "
        "controller and under all of its limits, record it, and propose SIMC gains and the "
        "homogeneous PID with them. It asks before the joint moves and before it writes a file, "
        "and never sets parameters. Ctrl-C, a reference, parameters, a missing state end the "
        "relay; so does the controller, after 30 s at the latest. Have a hand at the emergency "
        "stop.",
        {
            "hpid autotune --live --joint elbow --dry-run": "nothing moves",
            "hpid autotune --live --joint elbow -o elbow.yaml": "",
        },
    )
    text = """
        --live  on the robot that runs (there is no other way yet)
        --joint NAME  which (the only one that runs)
        --effort A  amplitude of the relay in N m (--share)
        --share SHARE  of what the load leaves of the limits (0.2)
        --amplitude A  of the motion in rad (0.05)
        --cycles N  (8)
        --inertia M  about, to choose the relay (by the gains)
        --closed-loop-time S  of SIMC (four effective delays)
        --goal  of the upgrade (fast)
        -o --output FILE  controller file
        --bag BAG  new folder (autotune-TIME)
        --force  replace the file of -o
        --dry-run  show the relay, and do nothing
        --yes  move and write without asking
    """
    options(
        parser,
        text,
        effort=0.0,
        share=0.2,
        amplitude=0.05,
        cycles=8,
        inertia=float,
        closed_loop_time=float,
        goal={"choices": ("smooth", "fast"), "default": "fast"},
        bag=Path,
        output=Path,
    )
    graph_options(parser.rare())


def live(parser: Parser) -> None:
    parser.describe(
        "",
        "Serve a page for the controllers that run, and open it in the browser: see joints, "
        "retune them within what is certified, try motions, stop. Ctrl-C ends the page, and "
        "changes nothing on the robot.",
        {"hpid live": "", "hpid live --no-browser --port 0": "print the address alone"},
    )
    text = """
        --host ADDRESS  where to listen (127.0.0.1: this computer alone); another one needs --token
        --port N  0 chooses a free one (8080)
        --token TEXT  what opens the page (drawn anew each time)
        --no-browser  print the address alone
        --rate HZ  frames a second, 5 to 60 (30)
        --button-timeout S  joints stop when nothing was heard of a held button for so long, 0.2 to
            2 (0.4)
    """
    options(parser, text, host="127.0.0.1", port=8080, token="", rate=30.0, button_timeout=0.4)


def upgrade(parser: Parser) -> None:
    parser.describe(
        "FILE|BAG",
        "Of a parameter FILE: choose norm and degree for the gains of a PID, inside the certified "
        "interval, and write a controller parameter file with a comment on every number. Of a BAG "
        "with --urdf: identify the robot, check the PID that ran, propose, predict in simulation "
        "what that will bring, and write parameters, a page and the prediction. A joint keeps its "
        "PID where there is nothing to gain.",
        {
            "hpid upgrade my_bag --urdf arm.urdf": "upgrade.yaml and .html",
            "hpid upgrade pid.yaml --goal fast --urdf arm.urdf": "upgraded.yaml",
            "hpid upgrade --verify before_bag after_bag": "did the prediction hold?",
        },
        "Exit code 1 if a joint could not be upgraded (the file holds it as it was, with the "
        "reason), if the simulated PID is nothing like the recorded one (only the page is "
        "written), or if a prediction did not hold.",
    )
    text = """
        file FILE|BAG  parameter file of the PID, or a bag that was recorded under it
        --goal  smooth lowers the variation of the effort, fast shortens transients; balanced does
            both for the robot as a whole, by one norm in N m for all joints, and needs a
            recording. A FILE needs it, of a BAG it is balanced
    """
    options(
        parser,
        text,
        file={"nargs": "?", "type": Path},
        goal={"choices": ("smooth", "fast", "balanced")},
    )
    rare = parser.rare()
    robot_options(parser, rare)
    text = """
        -o --output FILE  new file (upgraded.yaml; of a BAG upgrade.yaml, .html and .json)
        --force  replace existing files
        --verify BEFORE AFTER  hold the prediction against two bags of the same motion
    """
    options(parser, text, output=Path, verify=Path)
    text = """
        --bag BAG  beside FILE: recorded under the PID; gives scales and floor and, with --urdf,
            the poses for the inertias, unless --poses asks for others
        --params FILE  beside BAG: parameters of the controllers that ran, if the bag does not hold
            them
        --prediction FILE  with --verify: what upgrade BAG has written (upgrade.json)
    """
    options(rare, text, bag=Path, params=Path, prediction=Path)


def export(parser: Parser) -> None:
    parser.describe(
        "FILE (--c | --ros2-control) -o DIR",
        "Write the loop of each joint as self-contained C99, with a program that replays what "
        "Python answers to a thousand states; or all loops as a package for ros2_control, with "
        "certificates of the gains around theirs.",
        {
            "hpid export my.yaml --c -o c_code": "for a microcontroller",
            "hpid export my.yaml --ros2-control -o my_arm": "for colcon build",
        },
        "--urdf gives the joints' limits, too, and the inertias that nothing else says. "
        "docs/export.md says what the code holds and what stays with the node.",
    )
    text = """
        file FILE  parameter file of controllers, or experiment
        --joint NAME ...  this joint, or 'arm_*'; '!*hand*' leaves out (all)
        --controller LABEL  of an experiment (its first with a homogeneous loop)
        --precision  of the numbers in C (double); a macro in the header can say another
        -o --output DIR  folder to write into; its name is that of the package
        --force  replace existing files
    """
    kinds = parser.add_mutually_exclusive_group(required=True)
    options(kinds, "--c  in C99\n--ros2-control  a plugin for controller_manager")
    options(
        parser,
        text,
        file=Path,
        precision=("double", "single"),
        output={"required": True, "type": Path},
    )
    robot_options(parser, parser.rare())


def robot(parser: Parser) -> None:
    parser.describe(
        "FILE",
        "Show the joints of a URDF, or of an experiment's robot with all that the experiment "
        "knows better, and what to know before it is simulated. Ends with 1 where limits are "
        "missing.",
        {"hpid robot arm.urdf": "", "hpid robot found.yaml --save known.urdf": ""},
    )
    text = """
        file FILE  URDF, or experiment file (.yaml)
        --poses N  sampled for the inertias (200)
        --json  machine-readable
        --save URDF  write the robot to a new file
        --force  replace an existing file
    """
    options(parser, text, poses=200, save=Path)
