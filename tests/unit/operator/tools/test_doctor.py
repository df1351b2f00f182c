"""`snakesim doctor`: a verdict on everything, and what to type where something is missing."""

import json
import os
import socket

import pytest

from snakesim_operator.cli import main
from snakesim_operator.tools.network_findings import ports, routers
from snakesim_operator.tools.targets import RobotSelection
from tests.harness.endpoint import free_endpoint

WHAT = {"Python", "packages", "OpenGL", "CAN", "KVM", "wake-ups", "wall clock", "priority", "memory lock", "disk"}


def test_it_checks_everything_and_leaves_this_process_as_it_was(capsys: pytest.CaptureFixture[str]) -> None:
    before = os.sched_getscheduler(0)
    assert main(["doctor", "--json", "--endpoint", free_endpoint()]) == 1, "nobody answers there"
    reported = json.loads(capsys.readouterr().out)
    assert {finding["what"] for finding in reported["findings"]} >= WHAT
    assert not reported["ok"] and reported["findings"][-1]["state"] == "fail"
    for finding in reported["findings"]:
        assert finding["state"] in ("ok", "warn", "fail") and finding["detail"]
        assert finding["state"] == "ok" or finding["fix"] or finding["what"] == "KVM"
    assert os.sched_getscheduler(0) == before


def test_an_endpoint_that_is_not_zenoh_is_a_failure_within_seconds() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        (finding,) = routers(RobotSelection(f"tcp/127.0.0.1:{mute.getsockname()[1]}"))
    assert finding.state == "fail" and finding.fix


def test_the_default_port_is_free_or_has_a_user() -> None:
    (finding,) = ports()
    assert finding.what == "port 7447" and finding.state in ("ok", "warn")
