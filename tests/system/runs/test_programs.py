"""Host, services and router as programs of their own, as on the machines of a lab: any order, and again at will."""

import signal

import pytest

from snakesim_hal.network.session_file import read_session
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.lab_programs import SCENARIO, LabPrograms

pytestmark = pytest.mark.e2e

SERVICES = ("guidance", "navigation", "control")


def test_programs_started_in_any_order_equal_one_run(lab: LabPrograms) -> None:
    for name in SERVICES[:2]:
        lab.start_service(name)
    other_goal = lab.start_service("control", "--set", "mission.speed_m_s=0.3")
    first = lab.start_host("never-armed")
    waited = lab.folder / "service-control.log"
    wait_until(lambda: "control: waiting for the network" in waited.read_text(), "control waits")
    router = lab.start("start", "router", str(lab.router_file))
    wait_until(
        lambda: "DIFFERS: `mission.speed_m_s` is 0.3 on " in lab.run_operator_command("status").out,
        "the difference",
    )
    refused = lab.run_operator_command("robot", "arm", "planar13", "sim").err
    assert "not armed: " in refused and f"(control, process {other_goal.pid})" in refused, refused
    other_goal.kill()
    lab.start_service("control")
    wait_until(
        lambda: (
            "next: `snakesim robot arm planar13 sim --session "
            in lab.run_operator_command("status").out
        ),
        "ready to arm",
    )
    said = lab.run_operator_command("status").out
    assert (
        all(f"  process {name}: " in said for name in ("host", *SERVICES)) and "DIFFERS" not in said
    ), said
    first.send_signal(signal.SIGKILL)  # at tick 0, where the next host begins as well
    first.wait()
    second = lab.start_host("second")
    lab.wait_until_armed()
    assert second.wait(60) == 0, (lab.folder / "host-triplet.log").read_text()
    _, alone = command.run_to_summary(lab.folder / "alone", *SCENARIO)
    assert RunRecord.load(lab.folder / "second").host.command_digest == alone.command_digest
    router.send_signal(signal.SIGINT)
    assert router.wait(10) == -signal.SIGINT  # which a shell shows as 130


@pytest.mark.slow
def test_an_operator_names_the_network_once_by_flag_or_environment(
    lab: LabPrograms, monkeypatch: pytest.MonkeyPatch
) -> None:
    (endpoint,) = read_session(lab.session).endpoints
    monkeypatch.setenv("SNAKESIM_SESSION", str(lab.session))
    for ended in (
        lab.run_operator_command("robot", "disarm"),
        command.snakesim("robot", "disarm", cwd=lab.folder),
    ):
        assert ended.code == 1
        assert f"no robot on {endpoint}" in ended.err
    elsewhere = command.snakesim(
        "robot", "disarm", "--endpoint", find_free_endpoint(), cwd=lab.folder
    )
    assert elsewhere.code == 1
    assert endpoint not in elsewhere.err
    ended = lab.run_operator_command("estop", "--router", "tcp/127.0.0.1:7447")
    assert ended.code == 2 and "--router and --session" in ended.err, ended.err
