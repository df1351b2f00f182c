"""`status`, `scenario list` and `config` print JSON with `--json`, and `status` names what moves and how to recover."""

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


def test_json_of_scenarios_and_config_has_names_and_origins(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["scenario", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert sorted(listed["robots"]) == list_shipped_names("robots")
    assert listed["scenarios"]["triplet"]
    assert main(["config", "triplet", "--json", "--set", "robot.limits.torque_nm=3"]) == 0
    config = json.loads(capsys.readouterr().out)
    assert config["robot.limits.torque_nm"] == {
        "value": 3,
        "origin": "--set robot.limits.torque_nm=3",
    }


def test_json_status_lists_robot_or_none(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = find_free_endpoint()
    assert main(["status", "--json", "--endpoint", endpoint]) == 1
    assert json.loads(capsys.readouterr().out) == {"robots": [], "silent": []}
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        session.declare_latched_publisher(keys.STATUS, RobotStatus).put(
            make_status(lifecycle="disarmed")
        )
        assert main(["status", "--json", "--endpoint", endpoint]) == 0
    (robot,) = json.loads(capsys.readouterr().out)["robots"]
    assert robot["namespace"] == "worm"
    assert robot["impostor"] is False
    assert robot["status"]["lifecycle"] == "disarmed"
    assert robot["emulated"] is None  # The host has not described the robot.


@pytest.mark.parametrize(
    ("description_changes", "expected_line"),
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
def test_status_and_rate_state_whether_motors_move(
    capsys: pytest.CaptureFixture[str],
    description_changes: dict[str, Any] | None,
    expected_line: str,
) -> None:
    """The second line of a robot states it. The description of another host is ignored."""
    endpoint = find_free_endpoint()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        session.declare_latched_publisher(keys.STATUS, RobotStatus).put(make_status())
        if description_changes is not None:
            description = msgspec.structs.replace(make_description(), **description_changes)
            session.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(description)
        main(["status", "--endpoint", endpoint])
        assert capsys.readouterr().out.splitlines()[1].startswith(expected_line)
        if description_changes is None or "host" not in description_changes:
            assert main(["topic", "rate", "--once", "--endpoint", endpoint]) == 0
            assert capsys.readouterr().out.startswith(f"worm: {expected_line.strip()}")


def test_status_of_isolated_joint_names_commands_to_recover(
    capsys: pytest.CaptureFixture[str],
) -> None:
    endpoint = find_free_endpoint()
    with open_session(ConnectionSettings(endpoint, "worm", listen=True)) as session:
        status = make_status(lifecycle="disarmed", isolated=["joint_3"], ready_to_arm=True)
        session.declare_latched_publisher(keys.STATUS, RobotStatus).put(status)
        assert main(["status", "--endpoint", endpoint]) == 0
    output = capsys.readouterr().out
    assert "isolated: joint_3; passive until a reset" in output
    assert "to end the isolation of joint_3" in output
    assert "or, without: `snakesim robot arm worm lag" in output
