"""`snakesim param` lists, reads and sets the parameters of a running controller."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from snakesim_hal.base.process import get_user_name
from snakesim_testing.runs.command import CompletedRun, RunningCommand, running_armed_snakesim
from snakesim_testing.runs.in_process_command import snakesim

pytestmark = pytest.mark.e2e

RUN_ARGUMENTS = (
    "peg_row",
    "--duration",
    "600",
    "--set",
    "rate_hz=50",
    "--clock-mode",
    "realtime",
    "--stay",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    """Run an armed robot for all tests of this file."""
    with running_armed_snakesim(
        tmp_path_factory.mktemp("param") / "run", *RUN_ARGUMENTS
    ) as started:
        yield started


@pytest.fixture
def run_param(run: RunningCommand, tmp_path: Path) -> Callable[..., CompletedRun]:
    """Return a function that runs `snakesim param` for the robot, or for another robot by its name."""

    def run_command(*arguments: str, robot: str | None = None) -> CompletedRun:
        selection = () if robot is None else ("--namespace", robot)
        return snakesim("param", *arguments, *selection, "--endpoint", run.endpoint, cwd=tmp_path)

    return run_command


def test_param_list_has_unit_range_and_meaning(run_param: Callable[..., CompletedRun]) -> None:
    listed = run_param("list")
    assert listed.code == 0
    assert listed.out.startswith("controller obstacle_triplet, 26 parameters, ")
    row = next(line for line in listed.out.splitlines() if "control.gap_m " in line)
    meaning = "Maximum gap between the skin and an obstacle that is chosen as a push-point."
    expected_row = f"control.gap_m 0.06 m >= 0, <= 1 {meaning}"
    assert row.split() == expected_row.split()


def test_param_set_changes_value_and_names_requester(
    run_param: Callable[..., CompletedRun],
) -> None:
    assert run_param("get", "control.propulsion_n").out == "35.0\n"
    completed = run_param("set", "control.propulsion_n=30", "control.stall_s=2")
    assert completed.code == 0, completed.err
    assert f"control.propulsion_n: 35.0 -> 30.0 N, by {get_user_name()}, tick " in completed.out
    assert "control.stall_s: 1.0 -> 2.0 s, by " in completed.out
    assert run_param("get", "control.propulsion_n").out == "30.0\n"
    assert f"set by {get_user_name()} at " in run_param("list").out.splitlines()[0]


@pytest.mark.parametrize(
    ("value", "code", "expected_text"),
    [
        (
            "control.propulsion=30",
            2,
            "has no parameter 'control.propulsion'; did you mean `control.propulsion_n`?",
        ),
        (
            "control.gap_m=-1",
            1,
            "`controllers.obstacle_triplet.gap_m` = -1 m is not allowed; expected a number >= 0",
        ),
        ("control.gap_m", 2, "give section.key=value"),
    ],
)
def test_param_set_with_invalid_value_changes_nothing(
    run_param: Callable[..., CompletedRun], value: str, code: int, expected_text: str
) -> None:
    list_before = run_param("list").out
    refused = run_param("set", "control.stall_s=3", value)
    assert refused.code == code, refused.err
    assert expected_text in refused.err, refused.err
    assert run_param("list").out == list_before


def test_param_of_missing_robot_names_it(run_param: Callable[..., CompletedRun]) -> None:
    absent = run_param("list", robot="mamba")
    assert absent.code == 1
    assert "no robot named mamba on " in absent.err
