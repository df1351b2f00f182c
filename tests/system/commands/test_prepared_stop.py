"""A stop whose means exist before they are needed: it opens nothing, survives any error, and tests itself."""

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
FULL = OSError(errno.EMFILE, "Too many open files")


class Network:
    """A session on which the robot's host answers, or does not."""

    def __init__(self) -> None:
        self.present_keys = ["alive/hal"]
        self.error: Exception | None = None

    def list_tokens(self, _pattern: str, _timeout_s: float) -> list[str]:
        if self.error is not None:
            raise self.error
        return self.present_keys

    def create_subsession(self) -> Any:
        return SimpleNamespace(close=lambda: None)  # nothing is subscribed to


class Bench:
    """A robot with a stop port on this computer, and a prepared stop of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, opened: socket.socket) -> None:
        self.port: int = opened.getsockname()[1]
        self.asked: list[str] = []
        self.go_on = threading.Event()
        self.go_on.set()
        self.log: list[tuple[str, str]] = []
        self.registry_error: OSError | None = None
        start_stop_server(opened, "worm", self._take)
        robot = {(LOOPBACK, self.port): ("tcp/127.0.0.1:9", "worm")}

        def registry(_where: RobotSelection) -> Any:
            if self.registry_error is not None:
                raise self.registry_error
            return robot

        monkeypatch.setattr(prepared_stop, "find_local_stop_ports", registry)
        monkeypatch.setattr(prepared_stop, "request_stop_over_session", self._ask_session)
        monkeypatch.setattr(prepared_stop, "stop_robots", self._search)
        self.network_error: Exception | None = None
        self.searched = 0
        self.stop = PreparedStop(
            RobotSelection("tcp/127.0.0.1:9", "worm"),
            ConnectionSettings("tcp/127.0.0.1:9", "worm"),
            self._note,
        )

    def _take(self, who: str, reply: Reply) -> None:
        self.asked.append(who)
        self.go_on.wait(10.0)
        reply("emergency stop")

    def _ask_session(
        self, _session: Any, _link: ConnectionSettings, _limit_s: float
    ) -> list[StopResult]:
        if self.network_error is not None:
            raise self.network_error
        return []

    def _search(self, _where: RobotSelection, say: Callable[[str], None]) -> int:
        self.searched += 1
        raise FULL

    def _note(self, who: str, text: str) -> None:
        self.log.append((who, text))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    with open_stop_port(LOOPBACK, 0) as opened:
        made = Bench(monkeypatch, opened)
        wait_until(lambda: made.stop._list_ports(), "the stop port", 5.0)
        yield made
        made.stop.close()


def test_prepared_stop_works_with_full_file_table_and_broken_network(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.stop.use_session(Network())  # pyright: ignore[reportArgumentType]
    bench.registry_error, bench.network_error = FULL, KeyError("unexpected")

    def no_socket(*_: object, **__: object) -> socket.socket:
        raise FULL

    monkeypatch.setattr(socket, "socket", no_socket)
    for _ in range(2):
        assert bench.stop.stop_and_wait("anna") == "worm: stopped: emergency stop (tcp/127.0.0.1:9)"
    assert bench.searched == 0
    assert bench.log[0] == ("anna", "worm: stopped: emergency stop (tcp/127.0.0.1:9)")


def test_prepared_stop_requested_during_a_stop_starts_another(bench: Bench) -> None:
    bench.go_on.clear()
    first = bench.stop.request_stop("anna")
    wait_until(lambda: bench.asked, "the first stop", 5.0)
    later: list[Future[str]] = [
        bench.stop.request_stop(f"viewer {number}") for number in range(100)
    ]
    assert not first.done()
    assert len({id(future) for future in later}) == 1
    assert bench.stop.check_readiness().text.startswith("a stop has been under way")
    bench.go_on.set()
    assert later[0].result(5.0).startswith("worm: stopped")
    assert first.done()
    assert len(bench.log) == 2
    assert bench.log[1][0].startswith("viewer 0, viewer 1, ")


def test_prepared_stop_of_unreachable_robot_explains_the_failure(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.stop.use_session(Network())  # pyright: ignore[reportArgumentType]
    bench.network_error = ValueError("no session")

    def closed(*_: object) -> None:
        raise NotConnectedError("closed")

    monkeypatch.setattr(StopRequester, "request_stop", closed)
    with raises_error(RefusedError, code="robot/not-confirmed"):
        bench.stop.stop_and_wait("anna")
    monkeypatch.undo()
    monkeypatch.setattr(prepared_stop, "request_stop_over_session", lambda *_: [])
    assert bench.stop.stop_and_wait("anna").startswith("worm: stopped"), "the next one is taken"


def test_prepared_stop_ready_reflects_a_test_made_now(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepared_stop, "SELF_TEST_PERIOD_S", 0.02)
    assert bench.stop.check_readiness() == prepared_stop.StopReadiness(
        is_ready=True, text=WAITING_FOR_ROBOT
    )
    network = Network()
    bench.stop.use_session(network)  # pyright: ignore[reportArgumentType]

    def says(ready: bool, words: str) -> None:
        def said() -> bool:
            bench.stop.start_self_test_if_due()
            found = bench.stop.check_readiness()
            return found.is_ready == ready and words in found.text

        wait_until(said, words, 5.0)

    assert not bench.stop.check_readiness().is_ready, "not tested yet"
    says(True, "ready")
    assert bench.asked == [], "a test stops nothing"
    network.present_keys = []
    says(False, "the robot's host does not answer")
    network.error = FULL
    says(False, "OSError: [Errno 24] Too many open files")
    network.error, network.present_keys = None, ["alive/hal"]
    says(True, "ready")
    monkeypatch.setattr(prepared_stop, "SELF_TEST_VALIDITY_S", 0.05)
    time.sleep(0.1)
    assert "the last self-test that succeeded was" in bench.stop.check_readiness().text


def test_a_test_of_a_closed_stop_port_says_so() -> None:
    with contextlib.closing(StopRequester()) as requester, open_stop_port(LOOPBACK, 0) as opened:
        address = (LOOPBACK, opened.getsockname()[1])
        requester.open_sockets([address])
        requester.require_open_port(address)
        opened.close()
        with raises_error(NotConnectedError, code="network/no-answer"):
            requester.require_open_port(address)
