"""A3: a real robot refuses to inject faults, even if a client publishes that the robot is emulated."""

import os
import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from snakesim_testing.harness.wait import wait_until
from verification.attack.client import NetworkClient
from verification.attack.command import HOLD_POSE_FOR_AN_HOUR, start_run
from verification.attack.robot import AttackedRobot, connect_operator
from verification.attack.tools import wire
from verification.attack.tools.repetition import repeat_in_background

REAL_ROBOT = Path(__file__).parent / "robot_side" / "real_robot.py"
FORGERY_PERIOD_S = 0.05
RECOVERY_TIMEOUT_S = 40.0  # after the control process was killed
FAULT_REQUESTS = (
    ("fault/run", {"kind": "kill", "target": "control"}),
    ("fault/run", {"kind": "freeze", "target": "navigation", "for_s": 5.0}),
    ("fault/run", {"kind": "stop", "target": "guidance"}),
    ("fault/control", {"kind": "hang", "target": "control", "for_s": 1.0}),
    ("fault/control", {"kind": "drop", "target": "sensor/joints", "for_s": 1.0, "amount": 1.0}),
    ("fault/hal", {"kind": "drop", "target": "actuator/joints", "for_s": 1.0, "amount": 1.0}),
    ("fault/hal", {"kind": "overheat", "target": "joint_3", "for_s": 1.0}),
)


@pytest.fixture(scope="module")
def real_robot(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[AttackedRobot, NetworkClient]]:
    """A robot that counts as real, and a client that publishes from the beginning that it is emulated."""
    home = tmp_path_factory.mktemp("real_robot")
    backend = ("--backend", f"{REAL_ROBOT}:RealRobot", "--unchecked")
    with (
        start_run(home, *HOLD_POSE_FOR_AN_HOUR, *backend) as run,
        connect_operator(run) as operator,
    ):
        description = operator.read_newest("hal/description")
        assert description["emulated"] is False
        with (
            NetworkClient(run.endpoint) as attacker,
            forge_description(attacker, {**description, "emulated": True}),
        ):
            operator.recover_robot()
            # A restarted service may read the forged description of its robot.
            os.kill(run.part("control"), signal.SIGKILL)
            wait_until(lambda: "control" not in run.parts(), "the end of control")
            wait_until(lambda: "control" in run.parts(), "the restart of control")
            operator.recover_robot(RECOVERY_TIMEOUT_S)
            yield AttackedRobot(run, operator), attacker


def forge_description(
    attacker: NetworkClient, description: dict[str, Any]
) -> AbstractContextManager[None]:
    """Publish a description again and again, for as long as the context is open."""
    publisher = attacker.publish_latched("hal/description", description)

    def publish_both_ways() -> None:
        attacker.publish("hal/description", description)
        publisher.put(wire.encode(description))

    return repeat_in_background(publish_both_ways, FORGERY_PERIOD_S)


def test_a3_forged_description_causes_no_fault_on_real_robot(
    real_robot: tuple[AttackedRobot, NetworkClient],
) -> None:
    robot, attacker = real_robot
    health = robot.record_health()
    for key, request in FAULT_REQUESTS:
        answers = attacker.query(key, request)
        assert answers, f"no answer on {key}"
        assert all(not answer["ok"] for answer in answers), f"{request}: {answers}"
    robot.assert_stays("armed", 0.5)
    robot.assert_unharmed(health)
    assert not robot.operator.read_status()["injected"]


def test_a3_faults_of_a_simulator_are_open_to_any_client(robot: AttackedRobot) -> None:
    """Any client can inject faults into a simulator, which causes a stop or a restart and no more."""
    with NetworkClient(robot.endpoint) as attacker:
        kill_guidance = {"kind": "kill", "target": "guidance"}
        kill_unknown = {"kind": "kill", "target": "no such process"}
        assert attacker.query("fault/run", kill_guidance)[0]["ok"]
        assert not attacker.query("fault/run", kill_unknown)[0]["ok"]
    robot.run.wait_for("guidance was ended by SIGKILL")
    robot.operator.recover_robot()
