"""What remains without a router's access control: who reaches the endpoint may do this. Each ends within the limits.

docs/concepts/open-network.md lists it line by line; more of it stands in test_forged.py, test_commands.py and
test_second_run.py.
"""

import itertools
import os
import signal
import time
from contextlib import AbstractContextManager
from typing import Any

from verification.attack.limits import beyond_limits
from verification.attack.means import wire
from verification.attack.means.repeating import repeating
from verification.attack.robot import AttackedRobot
from verification.attack.stranger import NetworkStranger

LISTENED = (
    "sensor/joints",
    "sensor/pose",
    "actuator/joints",
    "hal/clock",
    "hal/status",
    "hal/description",
)


def test_anybody_may_listen_to_everything(robot: AttackedRobot) -> None:
    with NetworkStranger(robot.endpoint) as stranger:
        for key in LISTENED:
            assert stranger.newest(key)


def test_anybody_may_stop_clear_and_disarm(robot: AttackedRobot) -> None:
    with NetworkStranger(robot.endpoint) as stranger:
        stranger.receive("hal/clock")
        assert stranger.ask("hal/estop", {"requester": "mallory"})[0]["ok"]
        robot.operator.until(
            lambda: robot.operator.next("hal/clock")["lifecycle"] == "estop", "estop"
        )
        assert "mallory" in robot.operator.next("hal/status")["reason"]
        assert stranger.request("reset", requester="mallory")["ok"]
        robot.operator.recover()
        assert stranger.request("disarm", requester="mallory")["ok"]
        robot.operator.until(
            lambda: robot.operator.next("hal/clock")["lifecycle"] == "disarmed", "disarmed"
        )


def commanding(
    stranger: NetworkStranger, epoch: int, target: float
) -> AbstractContextManager[None]:
    """A controller of his own: it answers every tick, as schemas/ tells."""
    sequences = itertools.count(1)

    def answer() -> None:
        clock = stranger.next("hal/clock")
        now = stranger.newest("sensor/joints")["angle_rad"]
        wanted = now if clock["lifecycle"] != "armed" else [target] * len(now)
        forged = stranger.command(clock, sequence=next(sequences), lease_epoch=epoch, target=wanted)
        stranger.put("actuator/joints", forged)

    return repeating(answer)


def test_anyone_may_take_lease_and_move_within_limits(robot: AttackedRobot) -> None:
    operator = robot.operator
    about, armings = operator.newest("hal/description"), operator.next("hal/clock")["arm_session"]
    operator.forget()
    with NetworkStranger(robot.endpoint) as stranger:
        stranger.receive("hal/clock", "sensor/joints", "hal/status", "hal/description")
        answer = stranger.ask(
            "hal/lease", {"action": "acquire", "holder": "mallory", "priority": 255}
        )[0]
        assert answer["ok"], answer
        operator.until(
            lambda: operator.lifecycle() == "disarmed", "disarmed, as the lease changes hands", 2.0
        )
        assert operator.next("hal/clock")["arm_session"] == armings
        with commanding(stranger, answer["epoch"], 1e4):
            operator.until(lambda: operator.status()["ready_to_arm"], "ready to arm")
            assert stranger.request("arm", requester="mallory")["ok"]
            time.sleep(0.5)
            # At some time: on a busy computer he may lose it again.
            assert "mallory" in {
                heard.message["lease_holder"] for heard in operator.heard("hal/status")
            }
    rows = [heard.message for heard in operator.heard("hal/applied")]
    assert any(row["sequence"] is not None for row in rows)
    assert beyond_limits(about, rows) == []
    operator.recover()


def test_a_forged_description_misleads_neither_host_nor_services(robot: AttackedRobot) -> None:
    """A controller that is started again while a stranger describes another robot still learns its own."""
    operator = robot.operator
    about = operator.newest("hal/description")
    wild = {
        "angle_min_rad": -1e4,
        "angle_max_rad": 1e4,
        "speed_limit_rad_s": 1e5,
        "torque_limit_nm": 1e5,
    }
    forged = {
        **about,
        "joints": [{**joint, **wild} for joint in about["joints"]],
        "max_step_rad": 10.0,
    }
    operator.forget()
    with NetworkStranger(robot.endpoint) as stranger:
        publisher = stranger.latch("hal/description", forged)
        # So that a controller learns the robot again.
        os.kill(robot.run.part("control"), signal.SIGKILL)
        with repeating(lambda: publisher.put(wire.encode(forged)), 0.02):
            operator.until(lambda: operator.lifecycle() == "fault", "a stop")
            operator.recover(30.0)
            time.sleep(0.5)
    rows = [heard.message for heard in operator.heard("hal/applied")]
    assert beyond_limits(about, rows) == []


def test_impostor_blocks_confirmation_but_not_the_stop(robot: AttackedRobot) -> None:
    answer: dict[str, Any] = {
        "ok": False,
        "reason": "no",
        "refusal": "wrong_state",
        "epoch": 0,
        "lifecycle": "armed",
    }
    with NetworkStranger(robot.endpoint) as stranger:
        stranger.pretend("hal/estop", answer)
        stranger.pretend("hal/lifecycle", answer)
        asked_s = time.monotonic()
        ended = robot.run.run_tool("estop")
        # Its own stop port says so.
        assert robot.operator.stopped_at(asked_s, 3.0) and ended.code == 0, ended.printed
        assert "WARNING: 2 answered in its name" in ended.printed
        assert robot.run.run_tool("robot", "reset").code == 1


def test_anybody_may_release_the_lease_which_stops_the_robot(robot: AttackedRobot) -> None:
    operator = robot.operator
    clock = operator.next("hal/clock")
    with NetworkStranger(robot.endpoint) as stranger:
        release = {
            "action": "release",
            "holder": operator.status()["lease_holder"],
            "epoch": clock["lease_epoch"],
        }
        stranger.ask("hal/lease", release)
    operator.until(lambda: operator.lifecycle() != "armed", "a stop", 1.0)
    operator.recover()
