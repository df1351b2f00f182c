"""`snakesim param` on a robot that runs."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.base.process import get_user_name
from snakesim_testing.runs.command import CompletedRun, RunningCommand, running_armed_snakesim
from snakesim_testing.runs.in_process_command import snakesim

pytestmark = pytest.mark.e2e

LONG = ("peg_row", "--duration", "600", "--set", "rate_hz=50", "--clock-mode", "realtime", "--stay")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    with running_armed_snakesim(tmp_path_factory.mktemp("param") / "run", *LONG) as started:
        yield started


@pytest.fixture
def param(run: RunningCommand, tmp_path: Path):
    def call(*words: str, robot: str | None = None) -> CompletedRun:
        verb, *more = words
        selection = () if robot is None else ("--namespace", robot)
        return snakesim("param", verb, *more, *selection, "--endpoint", run.endpoint, cwd=tmp_path)

    return call


def test_they_are_listed_with_unit_range_and_meaning(param) -> None:
    listed = param("list")
    assert listed.code == 0
    assert listed.out.startswith("controller obstacle_triplet, 26 parameters, ")
    row = next(line for line in listed.out.splitlines() if "control.gap_m " in line)
    meaning = "Maximum gap between the skin and an obstacle that is chosen as a push-point."
    said = f"control.gap_m 0.06 m >= 0, <= 1 {meaning}"
    assert row.split() == said.split()


def test_one_is_read_and_set_and_read_again(param) -> None:
    assert param("get", "control.propulsion_n").out == "35.0\n"
    done = param("set", "control.propulsion_n=30", "control.stall_s=2")
    assert done.code == 0, done.err
    assert f"control.propulsion_n: 35.0 -> 30.0 N, by {get_user_name()}, tick " in done.out
    assert "control.stall_s: 1.0 -> 2.0 s, by " in done.out
    assert param("get", "control.propulsion_n").out == "30.0\n"
    assert f"set by {get_user_name()} at " in param("list").out.splitlines()[0]


@pytest.mark.parametrize(
    ("value", "code", "words"),
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
def test_what_is_not_allowed_changes_nothing(param, value: str, code: int, words: str) -> None:
    before = param("list").out
    refused = param("set", "control.stall_s=3", value)
    assert refused.code == code and words in refused.err, refused.err
    assert param("list").out == before


def test_a_robot_that_is_not_there_is_named(param) -> None:
    absent = param("list", robot="mamba")
    assert absent.code == 1
    assert "no robot named mamba on " in absent.err
