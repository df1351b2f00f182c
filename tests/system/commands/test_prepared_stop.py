"""A prepared stop opens its connections in advance, survives every error, and tests itself."""

import contextlib
import errno
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.network.session import ConnectionSettings
from snakesim_hal.network.stop_port import Reply, StopRequester, open_stop_port, start_stop_server
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.robot_commands import prepared_stop
from snakesim_operator.robot_commands.prepared_stop import WAITING_FOR_ROBOT, PreparedStop
from snakesim_operator.robot_commands.stop_result import StopResult
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

LOOPBACK = "127.0.0.1"
FILE_TABLE_FULL = OSError(errno.EMFILE, "Too many open files")


class FakeSession:
    """A session on which the robot's host is present, or listing its tokens fails."""

    def __init__(self) -> None:
        self.present_keys = ["alive/hal"]
        self.error: Exception | None = None
        self.may_answer = threading.Event()
        self.may_answer.set()

    def list_tokens(self, _pattern: str, _timeout_s: float) -> list[str]:
        self.may_answer.wait(10.0)
        if self.error is not None:
            raise self.error
        return self.present_keys

    def create_subsession(self) -> Any:
        return SimpleNamespace(close=lambda: None)  # It has no subscriptions.


class StopBench:
    """A robot with a stop port on this computer, and a prepared stop of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, port_socket: socket.socket) -> None:
        self.port: int = port_socket.getsockname()[1]
        self.stop_requesters: list[str] = []
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.log: list[tuple[str, str]] = []
        self.registry_error: OSError | None = None
        start_stop_server(port_socket, "worm", self._answer_stop)
        ports = {(LOOPBACK, self.port): ("tcp/127.0.0.1:9", "worm")}

        def find_ports(_selection: RobotSelection) -> Any:
            if self.registry_error is not None:
                raise self.registry_error
            return ports

        monkeypatch.setattr(prepared_stop, "find_local_stop_ports", find_ports)
        monkeypatch.setattr(prepared_stop, "request_stop_over_session", self._request_over_session)
        monkeypatch.setattr(prepared_stop, "stop_robots", self._search_robots)
        self.network_error: Exception | None = None
        self.search_count = 0
        self.stop = PreparedStop(
            RobotSelection("tcp/127.0.0.1:9", "worm"),
            ConnectionSettings("tcp/127.0.0.1:9", "worm"),
            self._record_log,
        )

    def _answer_stop(self, requester: str, reply: Reply) -> None:
        self.stop_requesters.append(requester)
        self.may_answer.wait(10.0)
        reply("emergency stop")

    def _request_over_session(
        self, _session: Any, _connection: ConnectionSettings, _limit_s: float
    ) -> list[StopResult]:
        if self.network_error is not None:
            raise self.network_error
        return []

    def _search_robots(self, _selection: RobotSelection, _print_line: Callable[[str], None]) -> int:
        self.search_count += 1
        raise FILE_TABLE_FULL

    def _record_log(self, requester: str, text: str) -> None:
        self.log.append((requester, text))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[StopBench]:
    """Open a stop port, and prepare a stop that has found it."""
    with open_stop_port(LOOPBACK, 0) as port_socket:
        stop_bench = StopBench(monkeypatch, port_socket)
        wait_until(lambda: stop_bench.stop._list_ports(), "the stop port", 5.0)
        yield stop_bench
        stop_bench.stop.close()


def test_prepared_stop_works_with_full_file_table_and_broken_network(
    bench: StopBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.stop.use_session(FakeSession())  # pyright: ignore[reportArgumentType]
    bench.registry_error = FILE_TABLE_FULL
    bench.network_error = KeyError("unexpected")

    def fail_to_open_socket(*_: object, **__: object) -> socket.socket:
        raise FILE_TABLE_FULL

    monkeypatch.setattr(socket, "socket", fail_to_open_socket)
    for _ in range(2):
        assert bench.stop.stop_and_wait("anna") == "worm: stopped: emergency stop (tcp/127.0.0.1:9)"
    assert bench.search_count == 0
    assert bench.log[0] == ("anna", "worm: stopped: emergency stop (tcp/127.0.0.1:9)")


def test_prepared_stop_requested_during_a_stop_starts_another(bench: StopBench) -> None:
    bench.may_answer.clear()
    first_stop = bench.stop.request_stop("anna")
    wait_until(lambda: bench.stop_requesters, "the first stop", 5.0)
    later_stops: list[Future[str]] = [
        bench.stop.request_stop(f"viewer {number}") for number in range(100)
    ]
    assert not first_stop.done()
    assert len({id(future) for future in later_stops}) == 1
    assert bench.stop.check_readiness().text.startswith("a stop has been under way")
    bench.may_answer.set()
    assert later_stops[0].result(5.0).startswith("worm: stopped")
    assert first_stop.done()
    assert len(bench.log) == 2
    assert bench.log[1][0].startswith("viewer 0, viewer 1, ")


def test_prepared_stop_of_unreachable_robot_explains_the_failure(
    bench: StopBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.stop.use_session(FakeSession())  # pyright: ignore[reportArgumentType]
    bench.network_error = ValueError("no session")

    def fail_to_stop(*_: object) -> None:
        raise NotConnectedError("closed")

    monkeypatch.setattr(StopRequester, "request_stop", fail_to_stop)
    with raises_error(RefusedError, code="robot/not-confirmed"):
        bench.stop.stop_and_wait("anna")
    monkeypatch.undo()
    monkeypatch.setattr(prepared_stop, "request_stop_over_session", lambda *_: [])
    assert bench.stop.stop_and_wait("anna").startswith("worm: stopped"), "the next stop failed"


def test_prepared_stop_readiness_is_result_of_recent_self_test(
    bench: StopBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepared_stop, "SELF_TEST_PERIOD_S", 0.02)
    assert bench.stop.check_readiness() == prepared_stop.StopReadiness(
        is_ready=True, text=WAITING_FOR_ROBOT
    )
    session = FakeSession()
    session.may_answer.clear()
    bench.stop.use_session(session)  # pyright: ignore[reportArgumentType]

    def wait_for_readiness(is_ready: bool, text: str) -> None:
        def has_readiness() -> bool:
            bench.stop.start_self_test_if_due()
            readiness = bench.stop.check_readiness()
            return readiness.is_ready == is_ready and text in readiness.text

        wait_until(has_readiness, text, 5.0)

    assert bench.stop.check_readiness().text == WAITING_FOR_ROBOT
    wait_for_readiness(False, "not tested yet")  # The first self-test takes too long.
    session.may_answer.set()
    wait_for_readiness(True, "ready")
    assert bench.stop_requesters == [], "a self-test stopped the robot"
    session.present_keys = []
    wait_for_readiness(False, "the robot's host does not answer")
    session.error = FILE_TABLE_FULL
    wait_for_readiness(False, "OSError: [Errno 24] Too many open files")
    session.error = None
    session.present_keys = ["alive/hal"]
    wait_for_readiness(True, "ready")
    monkeypatch.setattr(prepared_stop, "SELF_TEST_VALIDITY_S", 0.05)
    time.sleep(0.1)
    assert "the last self-test that succeeded was" in bench.stop.check_readiness().text


def test_stop_requester_of_closed_port_reports_no_answer() -> None:
    with (
        contextlib.closing(StopRequester()) as requester,
        open_stop_port(LOOPBACK, 0) as port_socket,
    ):
        address = (LOOPBACK, port_socket.getsockname()[1])
        requester.open_sockets([address])
        requester.require_open_port(address)
        port_socket.close()
        with raises_error(NotConnectedError, code="network/no-answer"):
            requester.require_open_port(address)
