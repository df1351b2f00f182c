"""A4: an emergency stop cannot be shut out. What floods or occupies the network must not keep it away."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from snakesim_testing.harness.endpoint import find_free_endpoint
from verification.attack.command import snakesim, steering
from verification.attack.effort import FULL, Record, effort
from verification.attack.means import datagrams
from verification.attack.means.floods import end, flood, half_open
from verification.attack.robot import AttackedRobot
from verification.attack.stranger import HostTime

COMMAND_S = 5.0  # from typing `snakesim estop` to the stop, the start of a Python process included
QUERY_S = 0.5  # from a query, or a datagram, to the stop
FLOODED_S = float(effort(1, 5))  # before the stop is asked for
TICKS_S = 1.0  # the host must not stand still for longer, whoever comes and goes
TIMES = range(effort(1, 5))

Flood = Callable[[AttackedRobot], AbstractContextManager[object]]


def flooding(kind: str, amount: int, process_count: int = 1) -> Flood:
    return lambda robot: flood(robot.run.home, kind, robot.endpoint, amount, process_count)


FLOODS: dict[str, Flood] = {
    "half_open": lambda robot: half_open(robot.endpoint, effort(150, 2000)),
    "idle_sessions": flooding("idle", 300, 4),
    "half_open_and_idle": lambda robot: _both(
        FLOODS["half_open"](robot), FLOODS["idle_sessions"](robot)
    ),
    "lease_queries": flooding("lease", 10_000, 2),
    "noise_queries": flooding("noise", 10_000, 2),
    "all_queries": lambda robot: _both(
        FLOODS["lease_queries"](robot), FLOODS["noise_queries"](robot)
    ),
    "garbage": flooding("garbage", effort(10_000, 30_000)),
    "readers": flooding("readers", 1000),
}
SHUTS = ("half_open", "idle_sessions", "half_open_and_idle")  # new connections out


@contextmanager
def _both(
    one: AbstractContextManager[object], two: AbstractContextManager[object]
) -> Iterator[None]:
    with one, two:
        yield


@pytest.mark.parametrize("_time", TIMES)
@pytest.mark.parametrize("name", FLOODS if FULL else ("half_open", "lease_queries"))
def test_a4_the_command_stops_the_robot_under(
    robot: AttackedRobot, name: str, _time: int, record_property: Record
) -> None:
    operator = robot.operator
    with FLOODS[name](robot):
        time.sleep(FLOODED_S)
        before, asked_s = operator.lifecycle(), time.monotonic()
        ended = robot.run.run_tool("estop")
        try:
            took_s = operator.stopped_at(asked_s, COMMAND_S) - asked_s
        except AssertionError:
            raise AssertionError(f"not stopped, exit code {ended.code}: {ended.printed}") from None
    record_property(
        "stopped after", f"{took_s:.2f} s from `snakesim estop`, {before} before, exit {ended.code}"
    )
    assert took_s < COMMAND_S, ended.printed
    assert "nobody listens" not in ended.printed, ended.printed
    # There the robot is stopped, and the tool may have had no status to confirm it by.
    if name not in SHUTS:
        assert ended.code == 0 and "planar13: stopped" in ended.printed, ended.printed


@pytest.mark.parametrize("_time", TIMES)
@pytest.mark.parametrize("by", ["query", pytest.param("datagram", marks=pytest.mark.slow)])
def test_a4_a_stop_is_immediate_while_a_thousand_readers_leave(
    robot: AttackedRobot, by: str, _time: int, record_property: Record
) -> None:
    """Zenoh holds up the whole network meanwhile, so the host's own ticks tell when the joints were made safe."""
    operator = robot.operator
    with flood(robot.run.home, "readers", robot.endpoint, 1000) as (readers,):
        operator.recover(40.0)
        operator.forget()
        time.sleep(0.5)
        host, known = HostTime(operator), {fault["tick"] for fault in operator.status()["faults"]}
        end(readers)
        asked_s = time.monotonic()
        if by == "query":
            operator.ask("hal/estop", {"requester": "operator"}, 10.0)
        else:
            assert datagrams.ask(robot.endpoint, datagrams.stop(), 10.0) is not None, "no answer"
        operator.stopped_at(asked_s, 10.0)
    faults = [
        fault for fault in operator.next("hal/status")["faults"] if fault["tick"] not in known
    ]
    stopped_s = (
        min(host.of(fault["tick"]) for fault in faults if fault["what"] == "estop") - asked_s
    )
    safe_s = (
        min(host.of(fault["tick"]) for fault in faults if fault["what"] != "service_lost") - asked_s
    )
    lost_s = host.lost_s(operator)
    record_property(
        "safe after",
        f"{1000 * safe_s:.0f} ms, stopped after {1000 * stopped_s:.0f} ms, {1000 * lost_s:.0f} ms lost",
    )
    assert safe_s < QUERY_S, faults
    assert by == "query" or stopped_s < QUERY_S, faults
    assert lost_s < TICKS_S, "the host stood still"


# --- by UDP, beside the endpoint ------------------------------------------------------------------------------------


def test_a4_datagram_stops_the_robot_and_names_its_sender(
    robot: AttackedRobot, record_property: Record
) -> None:
    asked_s = time.monotonic()
    answer = datagrams.ask(robot.endpoint, datagrams.stop("the bench's red button"), 2.0)
    assert answer is not None, "no answer at the endpoint's UDP port"
    took_s = robot.operator.stopped_at(asked_s, 2.0) - asked_s
    record_property("stopped after", f"{1000 * took_s:.0f} ms from the datagram")
    assert took_s < QUERY_S
    assert "the bench's red button" in robot.operator.next("hal/status")["reason"]
    assert len(answer) < 1024, "a datagram must not be answered by many times its size"


@pytest.mark.parametrize("name", FLOODS if FULL else ("lease_queries",))
def test_a4_a_datagram_stops_the_robot_under(
    robot: AttackedRobot, name: str, record_property: Record
) -> None:
    with FLOODS[name](robot):
        time.sleep(FLOODED_S)
        asked_s = time.monotonic()
        answer = datagrams.ask(robot.endpoint, datagrams.stop(), 2.0)
        took_s = robot.operator.stopped_at(asked_s, 2.0) - asked_s
    record_property("stopped after", f"{1000 * took_s:.0f} ms from the datagram")
    assert answer is not None and took_s < QUERY_S


def test_a4_flood_of_wrong_datagrams_blocks_no_right_one(
    robot: AttackedRobot, record_property: Record
) -> None:
    before = robot.health()
    with datagrams.flood(robot.endpoint) as sent:
        time.sleep(float(effort(2, 10)))
        assert not robot.operator.status()["reason"].startswith("emergency stop"), (
            robot.operator.status()["reason"]
        )
        asked_s = time.monotonic()
        answer = datagrams.ask(robot.endpoint, datagrams.stop(), 3.0)
        assert answer is not None, f"no answer after {sent[0]} wrong datagrams"
        took_s = robot.operator.stopped_at(asked_s, 2.0) - asked_s
    record_property(
        "stopped after", f"{1000 * took_s:.0f} ms from the datagram, {sent[0]} wrong ones beside it"
    )
    assert took_s < 2 * QUERY_S  # it may be among those that the kernel drops, and is sent again
    robot.unharmed(before)


def test_a4_datagram_sender_name_is_harmless_and_printed_safely(robot: AttackedRobot) -> None:
    before = robot.health()
    for who in (
        b"",
        b"\xff\xfe\x80",
        b"\x1b[2J\r\nplanar13: armed",
        b"x" * 65,
        b"x" * 60_000,
        "é".encode() * 64,
    ):
        datagrams.ask(robot.endpoint, datagrams.stop(who), 0.2)
    printed = robot.run.run_tool("status").printed + robot.run.printed()
    assert not steering(printed), printed
    assert "\nplanar13: armed" not in printed.partition("planar13: ")[2], printed
    assert datagrams.ask(robot.endpoint, datagrams.stop("after it"), 2.0) is not None, (
        "no answer any more"
    )
    robot.unharmed(before)


@pytest.mark.parametrize("knows_nonce", [False, True], ids=["wrong_nonce", "right_nonce"])
def test_a4_false_answer_by_datagram_does_not_confirm_a_stop(
    robot: AttackedRobot, knows_nonce: bool
) -> None:
    endpoint = find_free_endpoint()
    with datagrams.false_port(endpoint, knows_nonce=knows_nonce):
        ended = snakesim(robot.run.home, "estop", "--endpoint", endpoint)
    assert ended.code == 1, ended.printed
    assert "planar13: stopped\n" not in ended.printed, ended.printed


def test_a4_a_stop_keeps_trying_while_the_network_is_shut(robot: AttackedRobot) -> None:
    with contextlib.ExitStack() as shut:
        shut.enter_context(half_open(robot.endpoint, effort(150, 2000)))
        opens = threading.Timer(1.5, shut.close)  # the tool is at it by then
        opens.start()
        asked_s = time.monotonic()
        ended = robot.run.run_tool("estop")
        opens.join()
    assert robot.operator.stopped_at(asked_s, 1.0) and ended.code == 0, ended.printed
