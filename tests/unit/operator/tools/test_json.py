"""`--json`: one line that a script can read, with the same content and exit code as the table."""

import json

import pytest

from snakesim_hal.model.files import shipped
from snakesim_hal.network.session import Link, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Status
from snakesim_operator.cli import main
from tests.harness.endpoint import free_endpoint
from tests.unit.hal.rig import status


def test_scenarios_and_configurations(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert sorted(reported["robots"]) == shipped("robots") and reported["scenarios"]["triplet"]
    assert main(["config", "triplet", "--json", "--set", "robot.limits.torque_nm=3"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["robot.limits.torque_nm"] == {"value": 3, "origin": "--set robot.limits.torque_nm=3"}


def test_the_state_of_a_robot_and_that_there_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = free_endpoint()
    assert main(["status", "--json", "--endpoint", endpoint]) == 1
    assert json.loads(capsys.readouterr().out) == {"robots": [], "silent": []}
    with open_session(Link(endpoint, "worm", listen=True)) as session:
        session.latched_publisher(keys.STATUS, Status).put(status(lifecycle="disarmed"))
        assert main(["status", "--json", "--endpoint", endpoint]) == 0
    (robot,) = json.loads(capsys.readouterr().out)["robots"]
    assert (robot["namespace"], robot["impostor"], robot["status"]["lifecycle"]) == ("worm", False, "disarmed")
