"""A3: faults on request are refused where something real moves, whatever a stranger says of the robot."""

import os
import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from verification.attack.command import STANDING, running
from verification.attack.means import wire
from verification.attack.means.repeating import repeating
from verification.attack.robot import AttackedRobot, joined
from verification.attack.stranger import NetworkStranger

BENCH = Path(__file__).parent / "data" / "bench.py"
EVERY_S = 0.05
ASKED = (
    ("fault/run", {"kind": "kill", "target": "control"}),
    ("fault/run", {"kind": "freeze", "target": "navigation", "for_s": 5.0}),
    ("fault/run", {"kind": "stop", "target": "guidance"}),
    ("fault/control", {"kind": "hang", "target": "control", "for_s": 1.0}),
    ("fault/control", {"kind": "drop", "target": "sensor/joints", "for_s": 1.0, "amount": 1.0}),
    ("fault/hal", {"kind": "drop", "target": "actuator/joints", "for_s": 1.0, "amount": 1.0}),
    ("fault/hal", {"kind": "overheat", "target": "joint_3", "for_s": 1.0}),
)


@pytest.fixture(scope="module")
def real(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[AttackedRobot, NetworkStranger]]:
    """A robot that really moves, and a stranger who says from its first moment on that it does not."""
    home = tmp_path_factory.mktemp("real")
    with (
        running(home, *STANDING, "--backend", f"{BENCH}:Bench", "--unchecked") as run,
        joined(run) as operator,
    ):
        about = operator.newest("hal/description")
        assert about["emulated"] is False
        with (
            NetworkStranger(run.endpoint) as stranger,
            forging(stranger, {**about, "emulated": True}),
        ):
            operator.recover()
            # A service that is started again learns what robot it has from what the stranger says.
            os.kill(run.part("control"), signal.SIGKILL)
            operator.until(lambda: "control" not in run.parts(), "control gone")
            operator.until(lambda: "control" in run.parts(), "control again")
            operator.recover(40.0)
            yield AttackedRobot(run, operator), stranger


def forging(stranger: NetworkStranger, about: dict[str, Any]) -> AbstractContextManager[None]:
    publisher = stranger.latch("hal/description", about)

    def forge() -> None:
        stranger.put("hal/description", about)
        publisher.put(wire.encode(about))

    return repeating(forge, EVERY_S)


def test_a3_forged_description_causes_no_fault_on_real_robot(
    real: tuple[AttackedRobot, NetworkStranger],
) -> None:
    robot, stranger = real
    before = robot.health()
    for key, request in ASKED:
        answers = stranger.ask(key, request)
        assert all(not answer["ok"] for answer in answers), f"{request}: {answers}"
        assert answers, f"nobody answers at {key}"
    robot.stays("armed", 0.5)
    robot.unharmed(before)
    assert not robot.operator.status()["injected"]


def test_a3_faults_are_only_for_simulators_and_permitted_users(robot: AttackedRobot) -> None:
    """What remains: on a simulator anybody may let anything go wrong, which ends in a stop, or a restart."""
    with NetworkStranger(robot.endpoint) as stranger:
        assert stranger.ask("fault/run", {"kind": "kill", "target": "guidance"})[0]["ok"]
        assert not stranger.ask("fault/run", {"kind": "kill", "target": "no such process"})[0]["ok"]
    robot.run.wait_for("guidance was ended by SIGKILL")
    robot.operator.recover()
