"""A1 and A14: several runs and robots on one computer or network.

A second run never arms the robot of another run. An emergency stop without arguments stops every robot of the computer
and reports each result.
"""

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest
import zenoh

from snakesim_testing.harness.command import CompletedRun, RunningCommand
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from verification.attack.client import NetworkClient, make_zenoh_config
from verification.attack.command import (
    HOLD_POSE,
    HOLD_POSE_FOR_AN_HOUR,
    run_snakesim,
    start_run,
)
from verification.attack.effort import choose_effort
from verification.attack.network_namespace import create_network_namespace, read_lifecycle
from verification.attack.robot import AttackedRobot, connect_operator
from verification.attack.robot_operator import Operator

SHORT_RUN = (*HOLD_POSE, "--duration", "1")
REPETITIONS = range(choose_effort(1, 4))


def assert_second_run_refuses(operator: Operator, home: Path, *network_options: str) -> None:
    """Fail unless a second run on the network of a disarmed robot refuses to start and arms nothing.

    Args:
        operator: Operator of the disarmed robot.
        home: Home folder of the second run.
        *network_options: Options with which the second run finds the network.
    """
    arm_session = operator.wait_for_next("hal/clock")["arm_session"]
    operator.discard_streams()
    out = str(home / "second")
    second_run = run_snakesim(
        home, "run", *SHORT_RUN, "--backend", "sim", "--out", out, *network_options
    )
    lifecycles = {clock["lifecycle"] for clock in operator.list_messages("hal/clock")}
    assert "armed" not in lifecycles, second_run.printed
    assert operator.wait_for_next("hal/clock")["arm_session"] == arm_session, second_run.printed
    assert second_run.code in (1, 2), second_run.printed
    assert "planar13" in second_run.printed, (
        f"the second run does not name the live robot: {second_run.printed}"
    )
    assert "Traceback" not in second_run.printed


@pytest.mark.parametrize("_repetition", REPETITIONS)
def test_a1_second_run_on_a_router_does_not_arm_robot(
    robot_with_router: AttackedRobot, tmp_path: Path, _repetition: int
) -> None:
    robot_with_router.operator.disarm_robot()
    router_option = ("--router", robot_with_router.endpoint)
    assert_second_run_refuses(robot_with_router.operator, tmp_path, *router_option)


def test_a1_second_run_at_same_endpoint_does_not_arm_robot(
    robot: AttackedRobot, tmp_path: Path
) -> None:
    robot.operator.disarm_robot()
    assert_second_run_refuses(robot.operator, tmp_path, "--endpoint", robot.endpoint)


@pytest.mark.slow
def test_a1_second_run_at_router_endpoint_does_not_arm_robot(tmp_path: Path) -> None:
    """No process uses the UDP port of the router. The second run notices only that its TCP port is in use."""
    endpoint = find_free_endpoint()
    with (
        zenoh.open(make_zenoh_config("", "router", listen=endpoint)),
        start_run(
            tmp_path, *HOLD_POSE_FOR_AN_HOUR, "--router", endpoint, endpoint=endpoint
        ) as first_run,
        connect_operator(first_run) as operator,
    ):
        operator.recover_robot()
        operator.disarm_robot()
        assert_second_run_refuses(operator, tmp_path / "elsewhere", "--endpoint", endpoint)
        operator.recover_robot()


def test_a1_phantom_robot_only_keeps_a_run_from_starting(
    robot_with_router: AttackedRobot, tmp_path: Path
) -> None:
    operator = robot_with_router.operator
    endpoint = robot_with_router.endpoint
    status = {**operator.read_status(), "robot": "mamba"}
    description = {**operator.read_newest("hal/description"), "robot": "mamba"}
    mamba_run = (*SHORT_RUN, "--set", 'robot="mamba"', "--router", endpoint)
    with NetworkClient(endpoint, "mamba") as attacker:
        attacker.declare_token("alive/hal")
        attacker.publish_latched("hal/status", status)
        attacker.publish_latched("hal/description", description)
        second_run = run_snakesim(tmp_path, "run", *mamba_run, "--out", str(tmp_path / "second"))
    assert second_run.code in (1, 2), second_run.printed
    assert "mamba" in second_run.printed, second_run.printed
    operator.recover_robot()


@pytest.mark.parametrize("_repetition", REPETITIONS)
def test_a1_two_runs_started_together_have_a_network_each(tmp_path: Path, _repetition: int) -> None:
    with (
        create_network_namespace() as namespace,
        start_run(tmp_path, *SHORT_RUN, name="one", endpoint=None, command_prefix=namespace) as one,
        start_run(tmp_path, *SHORT_RUN, name="two", endpoint=None, command_prefix=namespace) as two,
    ):
        codes = (one.end(), two.end())
        assert codes == (0, 0), one.printed() + two.printed()
        assert one.endpoint != two.endpoint, f"both runs use {one.endpoint}"


@pytest.mark.slow
def test_a14_stop_without_arguments_names_every_robot_and_its_result(tmp_path: Path) -> None:
    with (
        create_network_namespace() as namespace,
        start_run(
            tmp_path, *HOLD_POSE_FOR_AN_HOUR, name="one", endpoint=None, command_prefix=namespace
        ) as one,
        start_run(
            tmp_path, *HOLD_POSE_FOR_AN_HOUR, name="two", endpoint=None, command_prefix=namespace
        ) as two,
    ):
        for run in (one, two):
            wait_until_armed(namespace, run)
        frozen_host = two.part("host")
        os.kill(frozen_host, signal.SIGSTOP)
        first_stop = run_snakesim(tmp_path, "estop", command_prefix=namespace)
        assert read_lifecycle(namespace, one.endpoint) == "estop", first_stop.printed
        assert first_stop.code == 1, first_stop.printed
        assert_runs_are_named(first_stop, one, two)

        os.kill(frozen_host, signal.SIGCONT)
        second_stop = run_snakesim(tmp_path, "estop", command_prefix=namespace)
        lifecycles = [read_lifecycle(namespace, run.endpoint) for run in (one, two)]
        assert lifecycles == ["estop", "estop"], second_stop.printed
        assert second_stop.code == 0, second_stop.printed
        assert second_stop.printed.count("stopped") == 2, second_stop.printed
        assert_runs_are_named(second_stop, one, two)
        status = run_snakesim(tmp_path, "status", command_prefix=namespace)
        assert status.printed.count("planar13: estop") == 2, status.printed


def wait_until_armed(namespace: Sequence[str], run: RunningCommand) -> None:
    """Wait until the robot of a run in a network namespace is armed."""
    wait_until(
        lambda: read_lifecycle(namespace, run.endpoint) == "armed", f"armed robot of {run.out.name}"
    )


def assert_runs_are_named(command: CompletedRun, *runs: RunningCommand) -> None:
    """Fail unless a command printed port or folder of each run. The robots have the same name."""
    for run in runs:
        port = run.endpoint.rpartition(":")[2]
        assert port in command.printed or str(run.out) in command.printed, command.printed
