"""The live page over a simulated graph, as a process: tells its address and all that reaches it.

    python live_server.py [JOINTS]

Each line on stdout is JSON: {"url": ...}, {"set": [node, values]}, {"transition": [node, name]}.
A line on stdin is done: {"refuse": [node, reason]}, {"gone": node}.
"""

import json
import sys
import threading

from harness.simulated_graph import SimulatedGraph, arm
from hpid_ros.live.page.server import PageServer


def tell(**values):
    print(json.dumps(values), flush=True)


class ToldGraph(SimulatedGraph):
    def set(self, node, values):
        tell(set=[node, dict(values)])
        return super().set(node, values)

    def change_state(self, node, transition):
        tell(transition=[node, transition])
        return super().change_state(node, transition)


def main():
    graph = ToldGraph(arm(int(sys.argv[1]) if len(sys.argv) > 1 else 3))
    served = PageServer(graph, port=0)
    tell(url=served.url, threads=threading.active_count())
    for line in sys.stdin:
        order = json.loads(line)
        if "refuse" in order:
            node, reason = order["refuse"]
            graph.refusals[node] = reason
        if "gone" in order:
            graph.gone.add(order["gone"])
    served.stop()


if __name__ == "__main__":
    main()
