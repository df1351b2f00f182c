"""Unknown nodes on the network: clients that imitate services, hosts, robots or routers change nothing."""

import time
from pathlib import Path

import pytest
import zenoh

from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.attack.client import NetworkClient
from verification.attack.command import HOLD_POSE, start_run
from verification.attack.effort import RecordProperty, choose_effort
from verification.attack.robot import AttackedRobot, connect_operator
from verification.attack.terminal_output import EVIL_TEXT, assert_output_is_safe

STOP_COMMAND_TIMEOUT_S = 20.0
MAX_STOP_TIME_S = 3.0  # from the start of the command to the stop
MAX_ALIVE_SERVICES = 64  # that a status lists


# --- liveliness tokens ------------------------------------------------------------------------------------------------


def test_many_service_tokens_change_nothing(robot: AttackedRobot) -> None:
    health = robot.record_health()
    # 5000 tokens at once delay Zenoh for longer than a lease.
    token_count = choose_effort(200, 1000)
    with NetworkClient(robot.endpoint) as attacker:
        for i in range(token_count):
            attacker.declare_token(f"alive/service_{i}")
        robot.assert_stays("armed", 1.0)
        alive = robot.operator.wait_for_next("hal/status")["alive"]
        assert len(alive) <= MAX_ALIVE_SERVICES and "control" in alive, alive
    robot.assert_stays("armed", 0.5)
    robot.assert_unharmed(health)


def test_service_token_that_flaps_stops_nothing(robot: AttackedRobot) -> None:
    for name in ("control", "guidance", "hal") * choose_effort(3, 100):
        with NetworkClient(robot.endpoint) as attacker:
            attacker.declare_token(f"alive/{name}")
            time.sleep(0.05)
    robot.assert_stays("armed", 0.5)
    robot.operator.disarm_robot()
    robot.operator.recover_robot()


def test_false_robots_do_not_keep_a_stop_from_real_one(
    robot: AttackedRobot, record_property: RecordProperty
) -> None:
    with NetworkClient(robot.endpoint) as attacker:
        tokens = [
            attacker.session.liveliness().declare_token(f"robot_{i}/alive/hal")
            for i in range(choose_effort(100, 1000))
        ]
        start_s = time.monotonic()
        command = robot.run.run_tool("estop", timeout_s=STOP_COMMAND_TIMEOUT_S)
        stop_time_s = robot.operator.wait_for_emergency_stop(start_s, 5.0) - start_s
        for token in tokens:
            token.undeclare()
    record_property(
        "stopped after",
        f"{stop_time_s:.2f} s, the command ended after {command.duration_s:.2f} s",
    )
    assert stop_time_s < MAX_STOP_TIME_S
    assert command.duration_s < STOP_COMMAND_TIMEOUT_S
    assert "planar13: stopped" in command.printed, command.printed
    assert command.code == 1, "robots that do not answer are no success"


def test_false_hosts_neither_stop_robot_nor_hide_a_stop(robot: AttackedRobot) -> None:
    health = robot.record_health()
    operator = robot.operator
    name_endings = (EVIL_TEXT.replace("/", ""), "x" * 60)
    with NetworkClient(robot.endpoint) as attacker:
        for i in range(choose_effort(100, 2000)):
            attacker.declare_token(f"hal/host/{i:04}{name_endings[i % 2]}")
        robot.assert_stays("armed", 1.0)
        attacker.query("hal/estop", {"requester": "mallory"})
        operator.wait_for_lifecycle("estop")
        status = operator.wait_for_next("hal/status")
        assert "mallory" in status["reason"], status["reason"]
        faults = [fault["what"] for fault in status["faults"]]
        assert "estop" in faults, f"the status does not list the stop among its faults: {faults}"
        assert_output_is_safe(robot, "")
    robot.assert_unharmed(health)


def test_a_false_host_does_not_end_a_run(tmp_path: Path) -> None:
    with (
        start_run(tmp_path, *HOLD_POSE, "--duration", "4") as run,
        connect_operator(run) as operator,
    ):
        operator.wait_for_lifecycle("armed")
        with NetworkClient(run.endpoint) as attacker:
            attacker.declare_token("hal/host/another")
            code = run.end()
    assert code == 0, f"exit code {code}: {run.printed()[-600:]}"


# --- Zenoh nodes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["router", pytest.param("peer", marks=pytest.mark.slow)])
def test_unknown_router_or_peer_changes_nothing(robot: AttackedRobot, mode: str) -> None:
    health = robot.record_health()
    listen = find_free_endpoint()
    with NetworkClient(robot.endpoint, mode=mode, listen=listen) as attacker:
        attacker.read_newest("hal/clock")
        robot.assert_stays("armed", 1.0)
        assert robot.run.run_tool("estop").code == 0
    robot.operator.recover_robot()
    robot.assert_unharmed(health)


def test_zenoh_of_the_host_cannot_be_configured(robot: AttackedRobot) -> None:
    """A Zenoh router has an administration space. No client can read its configuration or write there."""
    new_endpoint = find_free_endpoint()
    configuration = {
        "listen/endpoints": f'["{new_endpoint}"]',
        "transport/unicast/max_sessions": "1",
        "adminspace/permissions/write": "true",
    }
    with NetworkClient(robot.endpoint) as attacker:
        readable_keys = [
            str(reply.ok.key_expr)
            for reply in attacker.session.get("@/**", timeout=1.0)
            if reply.ok is not None
        ]
        for router_id in attacker.session.info.routers_zid():
            for name, value in configuration.items():
                attacker.session.put(f"@/{router_id}/router/config/{name}", value)
        time.sleep(0.5)
        with pytest.raises(zenoh.ZError):
            NetworkClient(new_endpoint, timeout_s=0.5)
        # The maximum number of sessions is unchanged.
        with NetworkClient(robot.endpoint) as second_client:
            assert second_client.wait_for_next("hal/clock")["lifecycle"] == "armed"
    readable_configuration = [key for key in readable_keys if "config" in key]
    assert not readable_configuration, f"any client can read {readable_keys}"
