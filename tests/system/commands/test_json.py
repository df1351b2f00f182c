"""With `--json`, `status`, `scenarios` and `config` print one line with the content of the table and a code."""

import json
from typing import Any

import msgspec
import pytest

from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import RobotDescription, RobotStatus
from snakesim_operator.cli import main
from snakesim_testing.hal.small_robots import make_description, make_status
from snakesim_testing.harness.endpoint import find_free_endpoint


def test_scenarios_and_configurations(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenario", "list", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert sorted(reported["robots"]) == list_shipped_names("robots")
    assert reported["scenarios"]["triplet"]
    assert main(["config", "triplet", "--json", "--set", "robot.limits.torque_nm=3"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["robot.limits.torque_nm"] == {
        "value": 3,
        "origin": "--set robot.limits.torque_nm=3",
    }


def test_the_state_of_a_robot_and_that_there_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = find_free_endpoint()
    assert main(["status", "--json", "--endpoint", endpoint]) == 1
    assert json.loads(capsys.readouterr().out) == {"robots": [], "silent": []}
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        session.declare_latched_publisher(keys.STATUS, RobotStatus).put(
            make_status(lifecycle="disarmed")
        )
        assert main(["status", "--json", "--endpoint", endpoint]) == 0
    (robot,) = json.loads(capsys.readouterr().out)["robots"]
    assert (robot["namespace"], robot["impostor"], robot["status"]["lifecycle"]) == (
        "worm",
        False,
        "disarmed",
    )
    assert robot["emulated"] is None  # its host has not described it


@pytest.mark.parametrize(
    ("described", "said"),
    [
        ({"emulated": True}, "  EMULATED: nothing real moves (backend lag)"),
        (
            {"emulated": True, "hardware": "vcan0"},
            "  EMULATED: nothing real moves (backend lag on vcan0)",
        ),
        ({"emulated": False, "hardware": "can0"}, "  REAL: motors move (backend lag on can0)"),
        (
            {"emulated": True, "host": "another"},
            "  UNKNOWN whether motors move: the host has not described the robot",
        ),
        (None, "  UNKNOWN whether motors move: the host has not described the robot"),
    ],
)
def test_status_and_top_say_whether_something_real_moves(
    capsys: pytest.CaptureFixture[str], described: dict[str, Any] | None, said: str
) -> None:
    """In the second line of a robot; a description of another host counts nothing."""
    endpoint = find_free_endpoint()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        session.declare_latched_publisher(keys.STATUS, RobotStatus).put(make_status())
        if described is not None:
            robot = msgspec.structs.replace(make_description(), **described)
            session.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(robot)
        main(["status", "--endpoint", endpoint])
        assert capsys.readouterr().out.splitlines()[1].startswith(said)
        if described is None or "host" not in described:
            assert main(["topic", "rate", "--once", "--endpoint", endpoint]) == 0
            assert capsys.readouterr().out.startswith(f"worm: {said.strip()}")


def test_json_isolated_joint_is_reported_with_how_to_recover(
    capsys: pytest.CaptureFixture[str],
) -> None:
    endpoint = find_free_endpoint()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        lost = make_status(lifecycle="disarmed", isolated=["joint_3"], ready_to_arm=True)
        session.declare_latched_publisher(keys.STATUS, RobotStatus).put(lost)
        assert main(["status", "--endpoint", endpoint]) == 0
    said = capsys.readouterr().out
    assert "isolated: joint_3; passive until a reset" in said
    assert "to end the isolation of joint_3" in said
    assert "or, without: `snakesim robot arm worm lag" in said
