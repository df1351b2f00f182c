"""Host, services and router run as separate programs, as on the machines of a lab, and may start in any order."""

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


@pytest.mark.heavy
def test_programs_started_in_any_order_equal_one_run(lab: LabPrograms) -> None:
    for name in SERVICES[:2]:
        lab.start_service(name)
    other_control = lab.start_service("control", "--set", "mission.speed_m_s=0.3")
    first_host = lab.start_host("never-armed")
    control_log = lab.folder / "service-control.log"
    wait_until(
        lambda: "control: waiting for the network" in control_log.read_text(), "control waits"
    )
    router = lab.start("start", "router", str(lab.router_file))
    wait_until(
        lambda: "DIFFERS: `mission.speed_m_s` is 0.3 on " in lab.run_operator_command("status").out,
        "the difference",
    )
    refusal = lab.run_operator_command("robot", "arm", "planar13", "sim").err
    assert "not armed: " in refusal, refusal
    assert f"(control, process {other_control.pid})" in refusal, refusal
    other_control.kill()
    lab.start_service("control")
    wait_until(
        lambda: (
            "next: `snakesim robot arm planar13 sim --session "
            in lab.run_operator_command("status").out
        ),
        "ready to arm",
    )
    status = lab.run_operator_command("status").out
    assert all(f"  process {name}: " in status for name in ("host", *SERVICES)), status
    assert "DIFFERS" not in status
    first_host.send_signal(signal.SIGKILL)  # at tick 0, where the next host also starts
    first_host.wait()
    second_host = lab.start_host("second")
    lab.wait_until_armed()
    assert second_host.wait(60) == 0, (lab.folder / "host-triplet.log").read_text()
    _, summary = command.run_to_summary(lab.folder / "alone", *SCENARIO)
    assert RunRecord.load(lab.folder / "second").host.command_digest == summary.command_digest
    router.send_signal(signal.SIGINT)
    assert router.wait(10) == -signal.SIGINT  # a shell shows this exit code as 130


@pytest.mark.slow
def test_operator_command_takes_network_from_option_or_environment(
    lab: LabPrograms, monkeypatch: pytest.MonkeyPatch
) -> None:
    (endpoint,) = read_session(lab.session).endpoints
    monkeypatch.setenv("SNAKESIM_SESSION", str(lab.session))
    for result in (
        lab.run_operator_command("robot", "disarm"),
        command.snakesim("robot", "disarm", cwd=lab.folder),
    ):
        assert result.code == 1
        assert f"no robot on {endpoint}" in result.err
    with_endpoint = command.snakesim(
        "robot", "disarm", "--endpoint", find_free_endpoint(), cwd=lab.folder
    )
    assert with_endpoint.code == 1
    assert endpoint not in with_endpoint.err
    with_both = lab.run_operator_command("estop", "--router", "tcp/127.0.0.1:7447")
    assert with_both.code == 2, with_both.err
    assert "--router and --session" in with_both.err
