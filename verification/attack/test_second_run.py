"""A1, A14: a second run beside a robot that is not its own; and tools that must find every robot of a machine."""

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest
import zenoh

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from verification.attack.command import HOLDING, STANDING, Run, running, snakesim
from verification.attack.effort import effort
from verification.attack.machine import lifecycles, machine_of_its_own
from verification.attack.robot import AttackedRobot, joined
from verification.attack.stranger import NetworkStranger, settings

SHORT = (*HOLDING, "--duration", "1")
TIMES = range(effort(1, 4))


def stays_disarmed(operator: NetworkStranger, home: Path, *network: str) -> None:
    """A second run starts on the network of a disarmed robot; it must refuse, and the robot must stay as it is."""
    armings = operator.next("hal/clock")["arm_session"]
    operator.forget()
    out = str(home / "second")
    second = snakesim(home, "run", *SHORT, "--backend", "sim", "--out", out, *network)
    seen = {heard.message["lifecycle"] for heard in operator.heard("hal/clock")}
    assert "armed" not in seen and operator.next("hal/clock")["arm_session"] == armings, (
        second.printed
    )
    assert second.code in (1, 2), second.printed
    assert "planar13" in second.printed, f"the live robot is not named: {second.printed}"
    assert "Traceback" not in second.printed


@pytest.mark.parametrize("_time", TIMES)
def test_a1_second_run_on_a_router_does_not_arm_robot(
    routed: AttackedRobot, tmp_path: Path, _time: int
) -> None:
    routed.operator.stand_by()
    stays_disarmed(routed.operator, tmp_path, "--router", routed.endpoint)


def test_a1_second_run_at_same_endpoint_does_not_arm_robot(
    robot: AttackedRobot, tmp_path: Path
) -> None:
    robot.operator.stand_by()
    stays_disarmed(robot.operator, tmp_path, "--endpoint", robot.endpoint)


@pytest.mark.slow
def test_a1_second_run_at_router_endpoint_does_not_arm_robot(tmp_path: Path) -> None:
    """Nobody holds the router's UDP port, so only that somebody listens there can tell the second run."""
    endpoint = find_free_endpoint()
    with (
        zenoh.open(settings("", "router", listen=endpoint)),
        running(tmp_path, *STANDING, "--router", endpoint, endpoint=endpoint) as first,
        joined(first) as operator,
    ):
        operator.recover()
        operator.stand_by()
        stays_disarmed(operator, tmp_path / "elsewhere", "--endpoint", endpoint)
        operator.recover()


def test_a1_phantom_robot_only_keeps_a_run_from_starting(
    routed: AttackedRobot, tmp_path: Path
) -> None:
    operator = routed.operator
    with NetworkStranger(routed.endpoint, "mamba") as stranger:
        stranger.seem_alive("alive/hal")
        stranger.latch("hal/status", {**operator.status(), "robot": "mamba"})
        stranger.latch("hal/description", {**operator.newest("hal/description"), "robot": "mamba"})
        second = snakesim(
            *(tmp_path, "run", *SHORT, "--set", 'robot="mamba"', "--router", routed.endpoint),
            *("--out", str(tmp_path / "second")),
        )
    assert second.code in (1, 2) and "mamba" in second.printed, second.printed
    operator.recover()


@pytest.mark.parametrize("_time", TIMES)
def test_a1_two_runs_started_together_have_a_network_each(tmp_path: Path, _time: int) -> None:
    with (
        machine_of_its_own() as machine,
        running(tmp_path, *SHORT, name="one", endpoint=None, inside=machine) as one,
        running(tmp_path, *SHORT, name="two", endpoint=None, inside=machine) as two,
    ):
        codes = one.end(), two.end()
        assert codes == (0, 0), one.printed() + two.printed()
        assert one.endpoint != two.endpoint, f"both met at {one.endpoint}"


@pytest.mark.slow
def test_a14_stop_without_arguments_names_every_robot_and_its_result(tmp_path: Path) -> None:
    with (
        machine_of_its_own() as machine,
        running(tmp_path, *STANDING, name="one", endpoint=None, inside=machine) as one,
        running(tmp_path, *STANDING, name="two", endpoint=None, inside=machine) as two,
    ):
        is_armed(machine, one)
        is_armed(machine, two)
        frozen = two.part("host")
        os.kill(frozen, signal.SIGSTOP)
        stopped = snakesim(tmp_path, "estop", inside=machine)
        assert lifecycles(machine, one.endpoint) == ["estop"], stopped.printed
        assert stopped.code == 1 and named(one, stopped.printed) and named(two, stopped.printed), (
            stopped.printed
        )
        os.kill(frozen, signal.SIGCONT)
        stopped = snakesim(tmp_path, "estop", inside=machine)
        assert [lifecycles(machine, run.endpoint) for run in (one, two)] == [
            ["estop"],
            ["estop"],
        ], stopped.printed
        assert stopped.code == 0 and stopped.printed.count("stopped") == 2, stopped.printed
        assert named(one, stopped.printed) and named(two, stopped.printed), stopped.printed
        status = snakesim(tmp_path, "status", inside=machine)
        assert status.printed.count("planar13: estop") == 2, status.printed


def named(run: Run, said: str) -> bool:
    """Both robots have one name: what tells them apart is where they are."""
    return run.endpoint.rpartition(":")[2] in said or str(run.out) in said


def is_armed(inside: Sequence[str], run: Run) -> None:
    wait_until(lambda: lifecycles(inside, run.endpoint) == ["armed"], f"{run.out.name} armed")
