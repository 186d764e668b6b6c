"""Write the layouts for PlotJuggler and Foxglove in config/: every joint of the paper's robot.

Run from the checkout: ``python tools/make_layouts.py``. For another robot, name its experiment
file: ``python tools/make_layouts.py my_experiment.yaml FOLDER``.
"""

from __future__ import annotations

import json
import math
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from hpid_bench.experiment.description import load_experiment
from hpid_ros.base.names import controller_name

CHECKOUT = Path(__file__).resolve().parent.parent
PAPER = CHECKOUT / "config" / "experiments" / "paper.yaml"
MEASURED, REFERENCE = "#0b4a8f", "#8a94a3"
TERMS = {"p": "#e8590c", "i": "#2b8a5b", "d": "#8f4bb8"}
COLUMNS = 2
BUFFER = 30  # seconds that Foxglove follows


def plotjuggler(joints: Sequence[str]) -> str:
    """Return the layout for PlotJuggler 3, with its ROS 2 streaming plugin set up.

    Its parser names a JointState's series TOPIC/JOINT/FIELD.
    """
    root = ET.Element("root")
    tabs = ET.SubElement(root, "tabbed_widget", parent="main_window", name="Main Window")
    curves = {
        "positions [rad]": lambda joint: {
            f"/{controller_name(joint)}/reference/{joint}/position": REFERENCE,
            f"/joint_states/{joint}/position": MEASURED,
        },
        "efforts [N m]": lambda joint: {f"/joint_commands/{joint}/effort": MEASURED},
        "terms p, i, d [N m]": lambda joint: {
            f"/{controller_name(joint)}/terms/{term}/effort": color
            for term, color in TERMS.items()
        },
    }
    for title, curves_of in curves.items():
        tab = ET.SubElement(tabs, "Tab", containers="1", tab_name=title)
        container = ET.SubElement(tab, "Container")
        rows = math.ceil(len(joints) / COLUMNS)
        grid = splitter(container, "-", rows)
        for row in range(rows):
            names = joints[row * COLUMNS : (row + 1) * COLUMNS]
            line = splitter(grid, "|", len(names))
            for joint in names:
                area = ET.SubElement(line, "DockArea", name=joint)
                plot = ET.SubElement(area, "plot", mode="TimeSeries", style="Lines")
                for name, color in curves_of(joint).items():
                    ET.SubElement(plot, "curve", name=name, color=color)
    ET.SubElement(tabs, "currentTabIndex", index="0")
    plugins = ET.SubElement(root, "Plugins")
    plugin = ET.SubElement(plugins, "plugin", ID="ROS2 Topic Subscriber")
    ET.SubElement(plugin, "use_header_stamp", value="true")
    ET.SubElement(plugin, "selected_topics", value=";".join(topics(joints)))
    ET.SubElement(root, "previouslyLoaded_Streamer", name="ROS2 Topic Subscriber")
    ET.indent(root, " ")
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def splitter(parent: ET.Element, orientation: str, count: int) -> ET.Element:
    """Return a row (``|``) or column (``-``) of equal places."""
    sizes = ";".join([f"{1 / count:.6f}"] * count)
    return ET.SubElement(
        parent, "DockSplitter", orientation=orientation, count=str(count), sizes=sizes
    )


def topics(joints: Sequence[str]) -> list[str]:
    """Return the topics that a live look needs."""
    nodes = [controller_name(joint) for joint in joints]
    own = [f"/{node}/{topic}" for node in nodes for topic in ("reference", "terms")]
    return ["/joint_states", "/joint_commands", *own]


def foxglove(joints: Sequence[str]) -> str:
    """Return the layout for Foxglove, which finds a joint by its place in joint_states."""
    panels: dict[str, object] = {}
    tabs = []
    series = {
        "positions": lambda joint, k: {
            "reference": (f"/{controller_name(joint)}/reference.position[0]", REFERENCE),
            "measured": (f"/joint_states.position[{k}]", MEASURED),
        },
        "efforts": lambda joint, k: {"applied": (f"/joint_states.effort[{k}]", MEASURED)},
        "terms": lambda joint, k: {
            term: (f"/{controller_name(joint)}/terms.effort[{place}]", color)
            for place, (term, color) in enumerate(TERMS.items())
        },
    }
    for title, series_of in series.items():
        unit = "rad" if title == "positions" else "N m"
        names = []
        for k, joint in enumerate(joints):
            names.append(f"Plot!{title}-{joint}")
            panels[names[-1]] = plot(joint, f"{title} [{unit}]", series_of(joint, k))
        rows = [names[k : k + COLUMNS] for k in range(0, len(names), COLUMNS)]
        layout = mosaic([mosaic(row, "row") for row in rows], "column")
        tabs.append({"title": title, "layout": layout})
    panels["DiagnosticSummary!health"] = {"topicToRender": "/diagnostics"}
    tabs.append({"title": "diagnostics", "layout": "DiagnosticSummary!health"})
    panels["Tab!main"] = {"activeTabIdx": 0, "tabs": tabs}
    document = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!main",
    }
    return json.dumps(document, indent=1) + "\n"


def plot(joint: str, label: str, series: dict[str, tuple[str, str]]) -> dict[str, object]:
    """Return one plot panel that follows the newest data."""
    paths = [
        {"value": path, "enabled": True, "label": name, "color": color}
        | {"timestampMethod": "receiveTime"}
        for name, (path, color) in series.items()
    ]
    return {
        "foxglovePanelTitle": joint,
        "paths": paths,
        "xAxisVal": "timestamp",
        "yAxisLabel": label,
        "followingViewWidth": BUFFER,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "sidebarDimension": 240,
    }


def mosaic(parts: Sequence[object], direction: str) -> object:
    """Return equal places side by side (``row``) or one below the other (``column``)."""
    if len(parts) == 1:
        return parts[0]
    return {
        "first": parts[0],
        "second": mosaic(parts[1:], direction),
        "direction": direction,
        "splitPercentage": 100 / len(parts),
    }


def main() -> None:
    """Write both files."""
    experiment = load_experiment(Path(sys.argv[1]) if len(sys.argv) > 1 else PAPER)
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else CHECKOUT / "config"
    joints = experiment.world.joints
    (folder / "plotjuggler.xml").write_text(plotjuggler(joints), encoding="utf-8")
    (folder / "foxglove.json").write_text(foxglove(joints), encoding="utf-8")


if __name__ == "__main__":
    main()
