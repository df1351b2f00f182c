"""A2: somebody answers in the robot's place. Tools must not believe the first answer, nor an answer alone."""

import contextlib
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.attack.command import STANDING, running, snakesim
from verification.attack.effort import FULL, effort
from verification.attack.means import datagrams
from verification.attack.robot import AttackedRobot, joined
from verification.attack.stranger import NetworkStranger, settings

TIMES = range(effort(1, 5))


def lie(lifecycle: str, reason: str) -> dict[str, Any]:
    return {"ok": True, "reason": reason, "refusal": None, "epoch": 0, "lifecycle": lifecycle}


@contextmanager
def impostor(robot: AttackedRobot, key: str, answer: dict[str, Any]) -> Iterator[NetworkStranger]:
    with NetworkStranger(robot.endpoint) as stranger:
        stranger.pretend(key, answer)
        yield stranger


@contextmanager
def frozen_host(robot: AttackedRobot) -> Iterator[None]:
    pid = robot.run.part("host")
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize("_time", TIMES)
@pytest.mark.parametrize(
    ("tool", "before", "lies", "after"),
    [
        ("disarm", "armed", lie("disarmed", "disarmed on request"), "disarmed"),
        ("reset", "estop", lie("disarmed", "reset; arm to move again"), "disarmed"),
        ("estop", "armed", lie("estop", "emergency stop by root; reset it to continue"), "estop"),
        ("arm", "disarmed", lie("armed", "armed, commanded by control"), "armed"),
    ],
    ids=["disarm", "reset", "estop", "arm"],
)
def test_a2_a_second_answer_is_an_impostor(
    routed: AttackedRobot, tool: str, before: str, lies: dict[str, Any], after: str, _time: int
) -> None:
    operator = routed.operator
    if before == "estop":
        operator.ask("hal/estop", {"requester": "operator"})
    elif before == "disarmed":
        operator.stand_by()
    operator.until(lambda: operator.lifecycle() == before, before)
    arguments = {"arm": ["robot", "arm", "planar13", "sim"], "estop": ["estop"]}.get(
        tool, ["robot", tool]
    )
    with impostor(routed, "hal/estop" if tool == "estop" else "hal/lifecycle", lies):
        ended = routed.run.run_tool(*arguments)
    # Confirmed past the network, by the stop port of a run of this user.
    if tool == "estop" and ended.code == 0:
        assert operator.next("hal/clock")["lifecycle"] == "estop", ended.printed
        return
    assert ended.code == 1, (
        f"exit code {ended.code} with the robot in {operator.lifecycle()}: {ended.printed}"
    )
    assert "impostor" in ended.printed, ended.printed
    if tool != "arm":  # whoever sees an impostor may well refuse to arm
        # Not armed in any case: a busy machine may have stopped it before it was asked.
        operator.until(
            lambda: operator.lifecycle() in (after, "fault"),
            f"{after}, as the robot was asked, too",
            3.0,
        )


def test_a2_forged_answer_and_status_do_not_confirm_a_disarm(robot: AttackedRobot) -> None:
    operator = robot.operator
    answer = lie("disarmed", "disarmed on request")
    with impostor(robot, "hal/lifecycle", answer) as stranger:
        forged = {**operator.status(), "lifecycle": "disarmed", "reason": "disarmed on request"}
        stranger.latch("hal/status", forged)
        ended = robot.run.run_tool("robot", "disarm")
    assert ended.code == 1 and "impostor" in ended.printed, (
        f"the robot is {operator.lifecycle()}: {ended.printed}"
    )


@pytest.mark.parametrize("_time", TIMES)
@pytest.mark.parametrize(
    ("tool", "key", "lies", "word"),
    [
        (
            "estop",
            "hal/estop",
            lie("estop", "emergency stop by root; reset it to continue"),
            "planar13: stopped",
        ),
        *[("disarm", "hal/lifecycle", lie("disarmed", "disarmed on request"), "planar13: disarmed")]
        * FULL,
    ],
    ids=["estop", "disarm"][: 1 + FULL],
)
def test_a2_frozen_host_is_not_stopped_by_another_answer(
    routed: AttackedRobot, tool: str, key: str, lies: dict[str, Any], word: str, _time: int
) -> None:
    with impostor(routed, key, lies), frozen_host(routed):
        ended = routed.run.run_tool(*(["estop"] if tool == "estop" else ["robot", tool]))
    assert ended.code == 1 and word not in ended.printed, f"exit code {ended.code}: {ended.printed}"


@pytest.mark.parametrize(
    "how", ["false_stop_port_and_frozen_host", *["impostor", "impostor_and_frozen_host"] * FULL]
)
def test_a2_stop_through_lab_router_is_confirmed_by_robot_alone(tmp_path: Path, how: str) -> None:
    """The command is typed on another computer: all that it knows is the router's address, where anybody may answer."""
    endpoint = find_free_endpoint()
    answer = lie("estop", "emergency stop by root; reset it to continue")
    with (
        zenoh.open(settings("", "router", listen=endpoint)),
        running(tmp_path / "robot", *STANDING, "--router", endpoint, endpoint=endpoint) as run,
        joined(run) as operator,
        contextlib.ExitStack() as lies,
    ):
        operator.recover()
        robot = AttackedRobot(run, operator)
        if how.startswith("impostor"):
            lies.enter_context(impostor(robot, "hal/estop", answer))
        else:
            lies.enter_context(datagrams.false_port(endpoint))
        if "frozen_host" in how:
            lies.enter_context(frozen_host(robot))
        ended = snakesim(tmp_path / "elsewhere", "estop", "--router", endpoint)
        assert ended.code == 1 and "planar13: stopped" not in ended.printed, ended.printed


def test_a2_a_frozen_host_gives_no_answer(routed: AttackedRobot) -> None:
    with frozen_host(routed):
        ended = routed.run.run_tool("estop")
    assert (
        ended.code == 1 and "planar13" in ended.printed and "planar13: stopped" not in ended.printed
    ), ended.printed
