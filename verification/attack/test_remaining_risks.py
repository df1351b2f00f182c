"""What any client on an open network can do, and why each of it ends within the limits of the robot.

docs/concepts/open-network.md lists these actions. More of them are in test_forged_data.py, test_commands.py and
test_second_run.py. The access control of a router prevents them.
"""

import itertools
import os
import signal
import time
from contextlib import AbstractContextManager
from typing import Any

from snakesim_testing.harness.wait import wait_until
from verification.attack.client import NetworkClient
from verification.attack.limits import find_limit_violations
from verification.attack.robot import AttackedRobot
from verification.attack.tools import wire
from verification.attack.tools.repetition import repeat_in_background

READABLE_KEYS = (
    "sensor/joints",
    "sensor/pose",
    "actuator/joints",
    "hal/clock",
    "hal/status",
    "hal/description",
)
EXTREME_TARGET_RAD = 1e4
FORGERY_PERIOD_S = 0.02
RESTART_TIMEOUT_S = 30.0  # until a killed controller runs again and the robot is armed


def test_any_client_can_listen_to_everything(robot: AttackedRobot) -> None:
    with NetworkClient(robot.endpoint) as client:
        for key in READABLE_KEYS:
            assert client.read_newest(key)


def test_any_client_can_stop_reset_and_disarm(robot: AttackedRobot) -> None:
    operator = robot.operator

    def wait_for_clock(lifecycle: str) -> None:
        wait_until(lambda: operator.wait_for_next("hal/clock")["lifecycle"] == lifecycle, lifecycle)

    with NetworkClient(robot.endpoint) as client:
        client.subscribe("hal/clock")
        assert client.query("hal/estop", {"requester": "mallory"})[0]["ok"]
        wait_for_clock("estop")
        assert "mallory" in operator.wait_for_next("hal/status")["reason"]
        assert client.request_lifecycle("reset", requester="mallory")["ok"]
        operator.recover_robot()
        assert client.request_lifecycle("disarm", requester="mallory")["ok"]
        wait_for_clock("disarmed")


def control_robot(
    client: NetworkClient, lease_epoch: int, target_rad: float
) -> AbstractContextManager[None]:
    """Answer every tick like a controller, as `schemas/` documents, for as long as the context is open.

    Args:
        client: Client that sends the commands.
        lease_epoch: Epoch of the lease that the client holds.
        target_rad: Target of all joints of the armed robot. Before, the targets are the measured angles.
    """
    sequences = itertools.count(1)

    def answer_tick() -> None:
        clock = client.wait_for_next("hal/clock")
        targets = client.read_newest("sensor/joints")["angle_rad"]
        if clock["lifecycle"] == "armed":
            targets = [target_rad] * len(targets)
        command = client.make_command(
            clock, sequence=next(sequences), lease_epoch=lease_epoch, target=targets
        )
        client.publish("actuator/joints", command)

    return repeat_in_background(answer_tick)


def test_any_client_can_take_lease_and_move_within_limits(robot: AttackedRobot) -> None:
    operator = robot.operator
    description = operator.read_newest("hal/description")
    arm_session = operator.wait_for_next("hal/clock")["arm_session"]
    lease_request = {"action": "acquire", "holder": "mallory", "priority": 255}
    operator.discard_streams()
    with NetworkClient(robot.endpoint) as client:
        client.subscribe("hal/clock", "sensor/joints", "hal/status", "hal/description")
        lease = client.query("hal/lease", lease_request)[0]
        assert lease["ok"], lease
        # The robot is disarmed when its lease gets another holder.
        operator.wait_for_lifecycle("disarmed", 2.0)
        assert operator.wait_for_next("hal/clock")["arm_session"] == arm_session
        with control_robot(client, lease["epoch"], EXTREME_TARGET_RAD):
            wait_until(lambda: operator.read_status()["ready_to_arm"], "ready to arm")
            assert client.request_lifecycle("arm", requester="mallory")["ok"]
            time.sleep(0.5)
            # On a busy computer the client may lose the lease again.
            statuses = operator.list_messages("hal/status")
            assert "mallory" in {status["lease_holder"] for status in statuses}
    applied_setpoints = operator.list_messages("hal/applied")
    assert any(setpoints["sequence"] is not None for setpoints in applied_setpoints)
    assert find_limit_violations(description, applied_setpoints) == []
    operator.recover_robot()


def test_forged_description_misleads_neither_host_nor_services(robot: AttackedRobot) -> None:
    """A restarted controller uses the description of its own host, although a client publishes another one."""
    operator = robot.operator
    description = operator.read_newest("hal/description")
    extreme_limits = {
        "angle_min_rad": -1e4,
        "angle_max_rad": 1e4,
        "speed_limit_rad_s": 1e5,
        "torque_limit_nm": 1e5,
    }
    forged_description = {
        **description,
        "joints": [{**joint, **extreme_limits} for joint in description["joints"]],
        "max_step_rad": 10.0,
    }
    forged_payload = wire.encode(forged_description)
    operator.discard_streams()
    with NetworkClient(robot.endpoint) as client:
        publisher = client.publish_latched("hal/description", forged_description)
        # The restarted controller reads the description again.
        os.kill(robot.run.part("control"), signal.SIGKILL)
        with repeat_in_background(lambda: publisher.put(forged_payload), FORGERY_PERIOD_S):
            operator.wait_for_lifecycle("fault")
            operator.recover_robot(RESTART_TIMEOUT_S)
            time.sleep(0.5)
    assert find_limit_violations(description, operator.list_messages("hal/applied")) == []


def test_impostor_blocks_confirmation_but_not_the_stop(robot: AttackedRobot) -> None:
    refusal: dict[str, Any] = {
        "ok": False,
        "reason": "no",
        "refusal": "wrong_state",
        "epoch": 0,
        "lifecycle": "armed",
    }
    with NetworkClient(robot.endpoint) as impostor:
        impostor.answer_queries("hal/estop", refusal)
        impostor.answer_queries("hal/lifecycle", refusal)
        start_s = time.monotonic()
        stop = robot.run.run_tool("estop")
        assert robot.operator.wait_for_emergency_stop(start_s, 3.0), stop.printed
        # The stop port of the robot confirms the stop.
        assert stop.code == 0, stop.printed
        assert "WARNING: 2 answered in its name" in stop.printed
        assert robot.run.run_tool("robot", "reset").code == 1


def test_any_client_can_release_the_lease_which_stops_robot(robot: AttackedRobot) -> None:
    operator = robot.operator
    release = {
        "action": "release",
        "holder": operator.read_status()["lease_holder"],
        "epoch": operator.wait_for_next("hal/clock")["lease_epoch"],
    }
    with NetworkClient(robot.endpoint) as client:
        client.query("hal/lease", release)
    operator.wait_for_stop(1.0)
    operator.recover_robot()
