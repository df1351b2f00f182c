"""A4: no flood and no occupied connection prevents an emergency stop.

The tests stop the robot by the command `snakesim estop`, by a query on a session that exists already, and by a datagram
to the stop port. They record how long each stop took.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.attack.command import run_snakesim
from verification.attack.effort import FULL_EFFORT, RecordProperty, choose_effort
from verification.attack.robot import AttackedRobot
from verification.attack.robot_operator import HostTickTimes
from verification.attack.terminal_output import find_control_characters
from verification.attack.tools.floods import open_silent_connections, run_flooders
from verification.attack.tools.processes import kill_process
from verification.attack.tools.stop_datagrams import (
    flood_stop_port,
    make_stop_datagram,
    open_false_stop_port,
    send_until_answered,
)

# From the start of `snakesim estop` to the stop. Starting Python takes part of this time.
MAX_COMMAND_STOP_S = 5.0
MAX_REQUEST_STOP_S = 0.5  # from a query or a datagram to the stop
MAX_HOST_PAUSE_S = 1.0  # for which clients that come and go may keep the host from running
FLOOD_DURATION_S = float(choose_effort(1, 5))  # before the stop is requested
SILENT_CONNECTIONS = choose_effort(150, 2000)
SUBSCRIBERS = 1000
MAX_ANSWER_BYTES = 1024  # otherwise a small datagram causes a large answer, to any forged sender
REPETITIONS = range(choose_effort(1, 5))

Flood = Callable[[AttackedRobot], AbstractContextManager[object]]


def make_flood(kind: str, amount: int, process_count: int = 1) -> Flood:
    """Return a flood by processes of `tools/flooder.py`."""
    return lambda robot: run_flooders(robot.run.home, kind, robot.endpoint, amount, process_count)


def occupy_connections(robot: AttackedRobot) -> AbstractContextManager[object]:
    """Open connections to the robot without sending anything on them."""
    return open_silent_connections(robot.endpoint, SILENT_CONNECTIONS)


def combine_floods(first: Flood, second: Flood) -> Flood:
    """Return a flood that consists of two others."""

    @contextmanager
    def run_both(robot: AttackedRobot) -> Iterator[None]:
        with first(robot), second(robot):
            yield

    return run_both


IDLE_SESSIONS = make_flood("idle", 300, 4)
LEASE_QUERIES = make_flood("lease", 10_000, 2)
NOISE_QUERIES = make_flood("noise", 10_000, 2)
FLOODS: dict[str, Flood] = {
    "half_open": occupy_connections,
    "idle_sessions": IDLE_SESSIONS,
    "half_open_and_idle": combine_floods(occupy_connections, IDLE_SESSIONS),
    "lease_queries": LEASE_QUERIES,
    "noise_queries": NOISE_QUERIES,
    "all_queries": combine_floods(LEASE_QUERIES, NOISE_QUERIES),
    "garbage": make_flood("garbage", choose_effort(10_000, 30_000)),
    "readers": make_flood("readers", SUBSCRIBERS),
}
# During these, the network accepts no new session, and a command may get no status that confirms the stop.
OCCUPYING_FLOODS = ("half_open", "idle_sessions", "half_open_and_idle")


# --- by command and by query ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("_repetition", REPETITIONS)
@pytest.mark.parametrize("flood", FLOODS if FULL_EFFORT else ("half_open", "lease_queries"))
def test_a4_the_command_stops_the_robot_under(
    robot: AttackedRobot, flood: str, _repetition: int, record_property: RecordProperty
) -> None:
    operator = robot.operator
    with FLOODS[flood](robot):
        time.sleep(FLOOD_DURATION_S)
        state_before = operator.read_lifecycle()
        start_s = time.monotonic()
        command = robot.run.run_tool("estop")
        try:
            stop_s = operator.wait_for_emergency_stop(start_s, MAX_COMMAND_STOP_S) - start_s
        except AssertionError:
            raise AssertionError(
                f"not stopped, exit code {command.code}: {command.printed}"
            ) from None
    record_property(
        "stopped after",
        f"{stop_s:.2f} s from `snakesim estop`, {state_before} before, exit {command.code}",
    )
    assert stop_s < MAX_COMMAND_STOP_S, command.printed
    assert "nothing listens" not in command.printed, command.printed
    if flood not in OCCUPYING_FLOODS:
        assert command.code == 0, command.printed
        assert "planar13: stopped" in command.printed, command.printed


@pytest.mark.parametrize("_repetition", REPETITIONS)
@pytest.mark.parametrize("request_by", ["query", pytest.param("datagram", marks=pytest.mark.slow)])
def test_a4_stop_is_immediate_while_a_thousand_subscribers_leave(
    robot: AttackedRobot, request_by: str, _repetition: int, record_property: RecordProperty
) -> None:
    """Zenoh delays the whole network meanwhile. So the ticks of the host show when the joints were made safe."""
    operator = robot.operator
    with run_flooders(robot.run.home, "readers", robot.endpoint, SUBSCRIBERS) as processes:
        operator.recover_robot(40.0)
        operator.discard_streams()
        time.sleep(0.5)
        tick_times = HostTickTimes(operator)
        ticks_of_old_faults = {fault["tick"] for fault in operator.read_status()["faults"]}
        kill_process(processes[0])
        request_s = time.monotonic()
        if request_by == "query":
            operator.request_emergency_stop(10.0)
        else:
            answer = send_until_answered(robot.endpoint, make_stop_datagram(), 10.0)
            assert answer is not None, "no answer"
        operator.wait_for_emergency_stop(request_s, 10.0)
    faults = [
        fault
        for fault in operator.wait_for_next("hal/status")["faults"]
        if fault["tick"] not in ticks_of_old_faults
    ]
    # Every fault but `service_lost` makes the joints safe; that one only reports the end of a service.
    stop_ticks = [fault["tick"] for fault in faults if fault["what"] == "estop"]
    safe_ticks = [fault["tick"] for fault in faults if fault["what"] != "service_lost"]
    stopped_s = tick_times.time_of_tick(min(stop_ticks)) - request_s
    safe_s = tick_times.time_of_tick(min(safe_ticks)) - request_s
    lost_s = tick_times.measure_lost_time(operator)
    record_property(
        "safe after",
        f"{1000 * safe_s:.0f} ms, stopped after {1000 * stopped_s:.0f} ms, {1000 * lost_s:.0f} ms lost",
    )
    assert safe_s < MAX_REQUEST_STOP_S, faults
    if request_by == "datagram":
        assert stopped_s < MAX_REQUEST_STOP_S, faults
    assert lost_s < MAX_HOST_PAUSE_S, "the host did not run for this time"


# --- by datagram to the stop port, which is not part of the Zenoh network ---------------------------------------------


def test_a4_datagram_stops_the_robot_and_names_its_sender(
    robot: AttackedRobot, record_property: RecordProperty
) -> None:
    requester = "the bench's red button"
    start_s = time.monotonic()
    answer = send_until_answered(robot.endpoint, make_stop_datagram(requester), 2.0)
    assert answer is not None, "no answer from the stop port"
    stop_s = robot.operator.wait_for_emergency_stop(start_s, 2.0) - start_s
    record_property("stopped after", f"{1000 * stop_s:.0f} ms from the datagram")
    assert stop_s < MAX_REQUEST_STOP_S
    assert requester in robot.operator.wait_for_next("hal/status")["reason"]
    assert len(answer) < MAX_ANSWER_BYTES, "the answer is many times longer than the datagram"


@pytest.mark.parametrize("flood", FLOODS if FULL_EFFORT else ("lease_queries",))
def test_a4_a_datagram_stops_the_robot_under(
    robot: AttackedRobot, flood: str, record_property: RecordProperty
) -> None:
    with FLOODS[flood](robot):
        time.sleep(FLOOD_DURATION_S)
        start_s = time.monotonic()
        answer = send_until_answered(robot.endpoint, make_stop_datagram(), 2.0)
        stop_s = robot.operator.wait_for_emergency_stop(start_s, 2.0) - start_s
    record_property("stopped after", f"{1000 * stop_s:.0f} ms from the datagram")
    assert answer is not None
    assert stop_s < MAX_REQUEST_STOP_S


def test_a4_flood_of_wrong_datagrams_blocks_no_right_one(
    robot: AttackedRobot, record_property: RecordProperty
) -> None:
    health = robot.record_health()
    with flood_stop_port(robot.endpoint) as sent_count:
        time.sleep(float(choose_effort(2, 10)))
        reason = robot.operator.read_reason()
        assert not reason.startswith("emergency stop"), reason
        start_s = time.monotonic()
        answer = send_until_answered(robot.endpoint, make_stop_datagram(), 3.0)
        assert answer is not None, f"no answer after {sent_count[0]} wrong datagrams"
        stop_s = robot.operator.wait_for_emergency_stop(start_s, 2.0) - start_s
    record_property(
        "stopped after",
        f"{1000 * stop_s:.0f} ms from the datagram, among {sent_count[0]} wrong ones",
    )
    # The kernel may drop the first datagram, which is then sent again.
    assert stop_s < 2 * MAX_REQUEST_STOP_S
    robot.assert_unharmed(health)


def test_a4_datagram_sender_name_is_harmless_and_printed_safely(robot: AttackedRobot) -> None:
    health = robot.record_health()
    requesters = (
        b"",
        b"\xff\xfe\x80",
        b"\x1b[2J\r\nplanar13: armed",
        b"x" * 65,
        b"x" * 60_000,
        "é".encode() * 64,
    )
    for requester in requesters:
        send_until_answered(robot.endpoint, make_stop_datagram(requester), 0.2)
    printed = robot.run.run_tool("status").printed + robot.run.printed()
    assert not find_control_characters(printed), printed
    assert "\nplanar13: armed" not in printed.partition("planar13: ")[2], printed
    answer = send_until_answered(robot.endpoint, make_stop_datagram("a later requester"), 2.0)
    assert answer is not None, "the stop port no longer answers"
    robot.assert_unharmed(health)


@pytest.mark.parametrize("knows_nonce", [False, True], ids=["wrong_nonce", "right_nonce"])
def test_a4_false_answer_by_datagram_does_not_confirm_a_stop(
    robot: AttackedRobot, knows_nonce: bool
) -> None:
    endpoint = find_free_endpoint()
    with open_false_stop_port(endpoint, knows_nonce=knows_nonce):
        command = run_snakesim(robot.run.home, "estop", "--endpoint", endpoint)
    assert command.code == 1, command.printed
    assert "planar13: stopped\n" not in command.printed, command.printed


def test_a4_a_stop_keeps_trying_while_connections_are_occupied(robot: AttackedRobot) -> None:
    with contextlib.ExitStack() as connections:
        connections.enter_context(occupy_connections(robot))
        # After 1.5 s the command tries to connect.
        release = threading.Timer(1.5, connections.close)
        release.start()
        start_s = time.monotonic()
        command = robot.run.run_tool("estop")
        release.join()
    assert robot.operator.wait_for_emergency_stop(start_s, 1.0), command.printed
    assert command.code == 0, command.printed
