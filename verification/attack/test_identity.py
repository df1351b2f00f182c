"""A2: an impostor answers in the name of the robot.

No tool believes the first of several answers, or an answer that the state of the robot does not confirm.
"""

import contextlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from verification.attack.client import NetworkClient, make_zenoh_config
from verification.attack.command import HOLD_POSE_FOR_AN_HOUR, run_snakesim, start_run
from verification.attack.effort import FULL_EFFORT, choose_effort
from verification.attack.robot import AttackedRobot, connect_operator
from verification.attack.robot_operator import Operator
from verification.attack.tools.processes import freeze_process
from verification.attack.tools.stop_datagrams import open_false_stop_port

REPETITIONS = range(choose_effort(1, 5))


def make_answer(lifecycle: str, reason: str) -> dict[str, Any]:
    """Return the answer with which a robot confirms a request."""
    return {"ok": True, "reason": reason, "refusal": None, "epoch": 0, "lifecycle": lifecycle}


DISARM_ANSWER = make_answer("disarmed", "disarmed on request")
RESET_ANSWER = make_answer("disarmed", "reset; arm to move again")
ESTOP_ANSWER = make_answer("estop", "emergency stop by root; reset it to continue")
ARM_ANSWER = make_answer("armed", "armed, commanded by control")


@dataclass(frozen=True, kw_only=True)
class ImpostorTrial:
    """A tool that an impostor tries to deceive."""

    arguments: tuple[str, ...]  # of the `snakesim` command
    key: str  # of the request
    state_before: str
    false_answer: dict[str, Any]
    state_after: str  # that the robot itself must reach


TRIALS = {
    "disarm": ImpostorTrial(
        arguments=("robot", "disarm"),
        key="hal/lifecycle",
        state_before="armed",
        false_answer=DISARM_ANSWER,
        state_after="disarmed",
    ),
    "reset": ImpostorTrial(
        arguments=("robot", "reset"),
        key="hal/lifecycle",
        state_before="estop",
        false_answer=RESET_ANSWER,
        state_after="disarmed",
    ),
    "estop": ImpostorTrial(
        arguments=("estop",),
        key="hal/estop",
        state_before="armed",
        false_answer=ESTOP_ANSWER,
        state_after="estop",
    ),
    "arm": ImpostorTrial(
        arguments=("robot", "arm", "planar13", "sim"),
        key="hal/lifecycle",
        state_before="disarmed",
        false_answer=ARM_ANSWER,
        state_after="armed",
    ),
}


@contextmanager
def impersonate(
    robot: AttackedRobot, key: str, false_answer: dict[str, Any]
) -> Iterator[NetworkClient]:
    """Answer all requests on a key in the name of the robot."""
    with NetworkClient(robot.endpoint) as impostor:
        impostor.answer_queries(key, false_answer)
        yield impostor


def freeze_host(robot: AttackedRobot) -> AbstractContextManager[None]:
    """Stop the process of the HAL host for as long as the context is open."""
    return freeze_process(robot.run.part("host"))


def bring_into_state(operator: Operator, lifecycle: str) -> None:
    """Bring an armed robot into a lifecycle state."""
    if lifecycle == "estop":
        operator.request_emergency_stop()
    elif lifecycle == "disarmed":
        operator.disarm_robot()
    operator.wait_for_lifecycle(lifecycle)


@pytest.mark.parametrize("_repetition", REPETITIONS)
@pytest.mark.parametrize("tool", TRIALS)
def test_a2_a_second_answer_is_an_impostor(
    robot_with_router: AttackedRobot, tool: str, _repetition: int
) -> None:
    operator = robot_with_router.operator
    trial = TRIALS[tool]
    bring_into_state(operator, trial.state_before)
    with impersonate(robot_with_router, trial.key, trial.false_answer):
        command = robot_with_router.run.run_tool(*trial.arguments)
    # The stop port of a run of this user, which is not part of the network, may confirm a stop.
    if tool == "estop" and command.code == 0:
        assert operator.wait_for_next("hal/clock")["lifecycle"] == "estop", command.printed
        return
    state = operator.read_lifecycle()
    assert command.code == 1, (
        f"exit code {command.code} with the robot in {state}: {command.printed}"
    )
    assert "impostor" in command.printed, command.printed
    if tool == "arm":
        return  # the tool may refuse to arm because of the impostor
    # The real robot received the request, too. A busy machine may have stopped it before (fault).
    allowed_states = (trial.state_after, "fault")
    wait_until(lambda: operator.read_lifecycle() in allowed_states, trial.state_after, 3.0)


def test_a2_forged_answer_and_status_do_not_confirm_a_disarm(robot: AttackedRobot) -> None:
    operator = robot.operator
    forged_status = {
        **operator.read_status(),
        "lifecycle": "disarmed",
        "reason": DISARM_ANSWER["reason"],
    }
    with impersonate(robot, "hal/lifecycle", DISARM_ANSWER) as impostor:
        impostor.publish_latched("hal/status", forged_status)
        command = robot.run.run_tool("robot", "disarm")
    state = operator.read_lifecycle()
    assert command.code == 1, f"the robot is {state}: {command.printed}"
    assert "impostor" in command.printed, f"the robot is {state}: {command.printed}"


@pytest.mark.parametrize("_repetition", REPETITIONS)
@pytest.mark.parametrize("tool", ["estop", "disarm"] if FULL_EFFORT else ["estop"])
def test_a2_frozen_host_is_not_stopped_by_another_answer(
    robot_with_router: AttackedRobot, tool: str, _repetition: int
) -> None:
    success = {"estop": "planar13: stopped", "disarm": "planar13: disarmed"}[tool]
    trial = TRIALS[tool]
    with (
        impersonate(robot_with_router, trial.key, trial.false_answer),
        freeze_host(robot_with_router),
    ):
        command = robot_with_router.run.run_tool(*trial.arguments)
    assert command.code == 1, f"exit code {command.code}: {command.printed}"
    assert success not in command.printed, command.printed


ROUTER_ATTACKS = ["false_stop_port_and_frozen_host"]
if FULL_EFFORT:
    ROUTER_ATTACKS += ["impostor", "impostor_and_frozen_host"]


@pytest.mark.parametrize("attack", ROUTER_ATTACKS)
def test_a2_stop_through_lab_router_is_confirmed_by_robot_alone(
    tmp_path: Path, attack: str
) -> None:
    """Another computer stops the robot. It knows only the address of the router, where any client may answer."""
    endpoint = find_free_endpoint()
    router_option = ("--router", endpoint)
    with (
        zenoh.open(make_zenoh_config("", "router", listen=endpoint)),
        start_run(
            tmp_path / "robot", *HOLD_POSE_FOR_AN_HOUR, *router_option, endpoint=endpoint
        ) as run,
        connect_operator(run) as operator,
        contextlib.ExitStack() as attacks,
    ):
        operator.recover_robot()
        robot = AttackedRobot(run, operator)
        if attack.startswith("impostor"):
            attacks.enter_context(impersonate(robot, "hal/estop", ESTOP_ANSWER))
        else:
            attacks.enter_context(open_false_stop_port(endpoint))
        if "frozen_host" in attack:
            attacks.enter_context(freeze_host(robot))
        command = run_snakesim(tmp_path / "elsewhere", "estop", *router_option)
        assert command.code == 1, command.printed
        assert "planar13: stopped" not in command.printed, command.printed


def test_a2_a_frozen_host_gives_no_answer(robot_with_router: AttackedRobot) -> None:
    with freeze_host(robot_with_router):
        command = robot_with_router.run.run_tool("estop")
    assert command.code == 1, command.printed
    assert "planar13" in command.printed, command.printed
    assert "planar13: stopped" not in command.printed, command.printed
