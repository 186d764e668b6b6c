"""The bridge behind the services of simulation_interfaces, where these are installed."""

from importlib.util import find_spec

import pytest
from harness.graph import ros_arguments
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from hpid_ros.base.files import share_folder
from hpid_ros.experiment.in_process import write_document

pytestmark = pytest.mark.skipif(
    find_spec("simulation_interfaces") is None,
    reason="simulation_interfaces, which PyPI has not, is not installed",
)
STOPPED, PLAYING, PAUSED, QUITTING = range(4)  # simulation_interfaces/msg/SimulationState
UNSUPPORTED, OK, FAILED, ALREADY = 0, 1, 4, 101  # simulation_interfaces/msg/Result, and one more
WORLD = {
    "robot": {
        "description": str(share_folder() / "urdf" / "mobile_manipulator.urdf"),
        "driven": ["arm_joint_1"],
        "fixed_base": True,
    }
}


def test_a_simulation_is_held_stepped_reset_and_ended_by_the_standard(harness, tmp_path):
    from simulation_interfaces import msg, srv

    write_document(tmp_path / "world.yaml", WORLD)
    arguments = ros_arguments(
        world_file=tmp_path / "world.yaml",
        mode="realtime",
        control_rate=100.0,
        wait_for_subscribers=0,
    )
    process = harness.processes.start("mujoco_bridge", "mujoco_bridge", arguments)
    stamps = []
    harness.node.create_subscription(
        JointState,
        "joint_states",
        lambda each: stamps.append(
            each.header.stamp.sec * 100 + each.header.stamp.nanosec // 10**7
        ),
        qos_profile_sensor_data,
    )

    def call(kind, name, **fields):
        return harness.call(kind, f"mujoco_bridge/{name}", kind.Request(**fields), again=False)

    def state():
        answer = call(srv.GetSimulationState, "get_simulation_state")
        assert answer.result.result == OK
        return answer.state.state

    def turn(wanted):
        wanted = msg.SimulationState(state=wanted)
        return call(srv.SetSimulationState, "set_simulation_state", state=wanted).result

    def step(steps=1):
        return call(srv.StepSimulation, "step_simulation", steps=steps).result

    harness.wait(lambda: len(stamps) > 3, what="states")
    features = call(srv.GetSimulatorFeatures, "get_simulator_features").features.features
    assert msg.SimulatorFeatures.STEP_SIMULATION_SINGLE in features
    assert msg.SimulatorFeatures.SPAWNING not in features
    assert state() == PLAYING
    assert turn(PLAYING).result == ALREADY
    assert (step().result, step().error_message) == (FAILED, "the simulation is not paused")
    assert turn(PAUSED).result == OK
    assert state() == PAUSED

    assert turn(STOPPED).result == OK
    assert state() == STOPPED
    harness.wait(lambda: stamps[-1] == 0, what="time zero")
    for count in (1, 2, 3):
        assert step().result == OK
        harness.wait(lambda count=count: stamps[-1] == count, what="a step")
    refused = step(7)
    assert (refused.result, refused.error_message) == (UNSUPPORTED, "one step at a time, not 7")
    assert stamps[-1] == 3

    time_alone = call(srv.ResetSimulation, "reset_simulation", scope=1).result
    assert time_alone.result == UNSUPPORTED
    assert "scope 0, 3 or 255, not 1" in time_alone.error_message
    assert call(srv.ResetSimulation, "reset_simulation", scope=255).result.result == OK
    harness.wait(lambda: stamps[-1] == 0, what="time zero again")
    assert turn(9).result == UNSUPPORTED
    assert turn(PLAYING).result == OK
    harness.wait(lambda: stamps[-1] > 3, what="time to go on")
    assert turn(QUITTING).result == OK
    harness.wait(lambda: process.process.poll() is not None, what="the bridge to end")
    assert process.process.returncode == 0
