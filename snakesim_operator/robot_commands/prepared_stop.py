"""Stops one robot with sockets and threads that were opened in advance, and tests them regularly.

A program that opens sockets, files or a session only when it has to stop a robot cannot stop it once its file table is
full. Here the datagram socket to the robot's stop port, the network session, three threads and all modules exist from
the start. A stop opens no file; only if both prepared ways fail, the search of `snakesim estop` is tried as well.
"""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import closing
from dataclasses import dataclass
from typing import TypeVar

from snakesim_hal.base.errors import NotConnectedError, RefusedError, SnakesimError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.base.workers import Worker
from snakesim_hal.network.session import Link, Session
from snakesim_hal.network.stop_port import Address, StopAnswer, StopRequester
from snakesim_hal.wire import keys
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.robot_commands.stop import (
    LIMIT_S,
    Named,
    all_stopped,
    combine_results,
    describe_results,
    estop,
    local_stop_ports,
    stop_at_port,
    stop_ports_elsewhere,
)
from snakesim_operator.robot_commands.stop_by_query import ask_session
from snakesim_operator.robot_commands.stop_result import StopResult

TEST_EVERY_S = 1.0
TEST_VALID_S = 3.0  # a robot counts as ready to be stopped for this long after a test that succeeded
PRESENT_S = 1.0  # for the robot's host to answer a test over the network
CONFIRM_S = 1.5  # for the network, once the stop port has confirmed: then only a warning of an impostor is awaited
STUCK_S = 30.0  # a stop that is under way for longer than any limit of its parts
WAITING = "waiting for the robot"
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class StopReadiness:
    """Whether a stop would reach the robot now, by the newest self-test."""

    ready: bool
    text: str  # "ready", or what is missing


@dataclass(frozen=True)
class _Test:
    """The newest self-test of one way."""

    at_s: float = -TEST_VALID_S
    problem: str = "not tested yet"

    def why_not(self, now_s: float) -> str:
        """Return why this way cannot be relied on; empty when it can."""
        if self.problem:
            return self.problem
        age_s = now_s - self.at_s
        if age_s > TEST_VALID_S:
            return f"the last self-test that succeeded was {age_s:.0f} s ago"
        return ""


@dataclass(frozen=True)
class _PortResults:
    """What the stop ports answered."""

    here: tuple[StopResult, ...] = ()  # those of this computer
    there: tuple[StopResult, ...] = ()


class PreparedStop:
    """Stops the robot at one link. Every method may be called from any thread, and none but `stop` waits."""

    def __init__(self, where: RobotSelection, link: Link, on_result: Callable[[str, str], None] = lambda *_: None):
        """Prepare an emergency stop, which then needs no time to open sockets or to start threads.

        Args:
            where: Selects the robot for `snakesim estop`.
            link: How this process connects to the robot.
            on_result: Called with the requesters of a stop and its result in words, from another thread.
        """
        self._where = where
        self._link = link
        self._on_result = on_result
        self._user = get_user_name()  # looked up in a file
        # Threads.
        self._coordinator = Worker("stop")
        self._datagrams = Worker("stop datagrams")
        self._network = Worker("stop network")
        # What they use. The requester belongs to the thread of the datagrams.
        self._requester = StopRequester()
        self._local: dict[Address, Named] = {}
        self._elsewhere: dict[Address, Named] = {}
        self._session: Session | None = None
        # Requests that wait for the next stop, which begins after the present one.
        self._lock = threading.Lock()
        self._requesters: list[str] = []
        self._next: Future[str] | None = None
        self._began_s: float | None = None  # the present stop
        # Self-tests.
        self._port_test = _Test()
        self._network_test = _Test()
        self._tests: list[Future[None]] = []
        self._tested_s = -TEST_EVERY_S
        self.test_if_due()

    def connect(self, session: Session) -> None:
        """Use this session for stops over the network from now on."""
        self._session = session

    def request(self, requester: str) -> "Future[str]":
        """Stop the robot. The future has the result in words, or raises RefusedError when it is not stopped."""
        with self._lock:
            self._requesters.append(requester)
            if self._next is None:
                self._next = self._coordinator.submit(self._stop)
            return self._next

    def stop(self, requester: str) -> str:
        """Stop the robot, and wait for the result. Raises RefusedError."""
        return self.request(requester).result()

    def close(self) -> None:
        """End the threads, after the stop that is under way."""
        self._coordinator.close()
        self._network.close()
        self._datagrams.submit(self._requester.close)
        self._datagrams.close()

    # --- the self-test

    def test_if_due(self) -> None:
        """Begin a self-test by the threads that stop, if the last one was a second ago and has ended."""
        now_s = time.monotonic()
        if now_s - self._tested_s < TEST_EVERY_S or not all(test.done() for test in self._tests):
            return
        self._tested_s = now_s
        self._tests = [self._datagrams.submit(self._test_ports), self._network.submit(self._test_network)]

    def readiness(self) -> StopReadiness:
        """Return whether a stop would reach the robot, by the newest self-test."""
        now_s = time.monotonic()
        began_s = self._began_s
        if began_s is not None:
            stuck = now_s - began_s > STUCK_S
            return StopReadiness(not stuck, f"a stop has been under way for {now_s - began_s:.0f} s")
        if self._session is None:
            return StopReadiness(True, WAITING)
        without_network = self._network_test.why_not(now_s)
        if without_network:
            also = "; it is also sent to the robot's stop port" if self._ports() else ""
            return StopReadiness(False, f"a stop over the network is not ready: {without_network}{also}")
        without_port = self._port_test.why_not(now_s) if self._ports() else ""
        if without_port:
            return StopReadiness(True, f"ready over the network only: {without_port}")
        return StopReadiness(True, "ready")

    def _ports(self) -> dict[Address, Named]:
        return self._local | self._elsewhere

    def _test_ports(self) -> None:
        """Find the stop port, keep a socket for it, and send it a test. This runs in the thread of the datagrams."""
        problem = ""
        try:
            local = local_stop_ports(self._where)
            elsewhere = stop_ports_elsewhere(self._where, local)
            self._requester.prepare([*local, *elsewhere])
            self._local = local
            self._elsewhere = elsewhere
        except OSError as error:  # no file is left: the addresses and sockets of before stay
            problem = "" if self._ports() else f"the stop port is not known: {error.strerror}"
        try:
            for address in self._ports():
                self._requester.test(address)
        except NotConnectedError as error:
            problem = str(error)
        self._port_test = _Test(time.monotonic(), problem)

    def _test_network(self) -> None:
        """Test a round trip to the robot's host over the session that a stop uses. This runs in the network thread."""
        session = self._session
        if session is None:
            return
        try:
            problem = "" if session.present(keys.alive_key("hal"), PRESENT_S) else "the robot's host does not answer"
        except Exception as error:
            self._network_test = _Test(time.monotonic(), f"{type(error).__name__}: {error}"[:200])
            raise
        self._network_test = _Test(time.monotonic(), problem)

    # --- the stop

    def _stop(self) -> str:
        """Stop the robot for all requests since the last stop began. This runs in the coordinator's thread."""
        with self._lock:
            requesters = ", ".join(dict.fromkeys(self._requesters))
            self._requesters.clear()
            self._next = None
        self._began_s = time.monotonic()
        try:
            stopped, text = self._stop_by_all_ways()
        except Exception as error:
            self._on_result(requesters, f"unexpected error: {type(error).__name__}: {error}")
            raise
        finally:
            self._began_s = None
        self._on_result(requesters, text)
        if not stopped:
            raise RefusedError(text, code="robot/not-confirmed")
        return text

    def _stop_by_all_ways(self) -> tuple[bool, str]:
        """Return whether every robot is stopped, and the result in words."""
        by_datagrams = self._datagrams.submit(self._ask_ports)
        by_network = self._network.submit(self._ask_network)
        ports, trouble = _result_of(by_datagrams, LIMIT_S + PRESENT_S, _PortResults())
        confirmed = all_stopped(ports.here)
        shown, more_trouble = _result_of(by_network, CONFIRM_S if confirmed else LIMIT_S + PRESENT_S, [])
        results = combine_results(ports.here, ports.there, shown)
        lines = describe_results(results, ports.here, shown)
        if all_stopped(results):
            return True, "; ".join(lines)
        searched: list[str] = []
        try:
            stopped = estop(self._where, searched.append) == 0
        except (SnakesimError, OSError, RuntimeError) as error:  # no file, or no thread, is left
            return False, "; ".join([*lines, *trouble, *more_trouble, f"search: {error}"])
        return stopped, "; ".join(searched)

    def _ask_ports(self) -> _PortResults:
        def request(address: Address) -> StopAnswer | None:
            return self._requester.request_stop(address, self._user, LIMIT_S)

        here = [stop_at_port(request, address, robot) for address, robot in self._local.items()]
        there = [stop_at_port(request, address, robot) for address, robot in self._elsewhere.items()]
        return _PortResults(
            tuple(result for result in here if result is not None),
            tuple(result for result in there if result is not None),
        )

    def _ask_network(self) -> list[StopResult]:
        session = self._session
        if session is None:
            return []
        with closing(session.part()) as part:
            return ask_session(part, self._link, LIMIT_S)


def _result_of(pending: "Future[ResultT]", limit_s: float, otherwise: ResultT) -> tuple[ResultT, list[str]]:
    """Wait for one way. Its error does not end the stop: it becomes a line of the result."""
    try:
        error = pending.exception(limit_s)
    except FutureTimeoutError:
        return otherwise, []
    if error is not None:
        return otherwise, [f"{type(error).__name__}: {error}"]
    return pending.result(), []
