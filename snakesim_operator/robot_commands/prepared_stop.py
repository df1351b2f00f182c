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
from snakesim_hal.base.workers import BackgroundThread
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_hal.network.stop_port import Address, StopAnswer, StopRequester
from snakesim_hal.wire import keys
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.robot_commands.stop import (
    STOP_TIMEOUT_S,
    RobotAddress,
    are_all_stopped,
    combine_results,
    describe_results,
    find_local_stop_ports,
    find_remote_stop_ports,
    request_stop_at_port,
    stop_robots,
)
from snakesim_operator.robot_commands.stop_by_query import request_stop_over_session
from snakesim_operator.robot_commands.stop_result import StopResult

SELF_TEST_PERIOD_S = 1.0
# A robot counts as ready to be stopped for this long after a test that succeeded.
SELF_TEST_VALIDITY_S = 3.0
HOST_RESPONSE_TIMEOUT_S = 1.0  # for the robot's host to answer a test over the network
# For the network, once the stop port has confirmed: then only a warning of an impostor is awaited.
CONFIRMATION_TIMEOUT_S = 1.5
STUCK_TIMEOUT_S = 30.0  # a stop that is under way for longer than any limit of its parts
WAITING_FOR_ROBOT = "waiting for the robot"
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class StopReadiness:
    """Whether a stop would reach the robot now, by the newest self-test."""

    is_ready: bool
    text: str  # "ready", or what is missing


@dataclass(frozen=True)
class _SelfTest:
    """The newest self-test of one way of stopping the robot: by datagrams, or over the network."""

    completed_s: float
    problem: str  # empty if it succeeded

    def explain_problem(self, now_s: float) -> str:
        """Return the reason why this way of stopping may fail now; empty if its self-test is recent and succeeded."""
        if self.problem:
            return self.problem
        age_s = now_s - self.completed_s
        if age_s > SELF_TEST_VALIDITY_S:
            return f"the last self-test that succeeded was {age_s:.0f} s ago"
        return ""


NOT_TESTED = _SelfTest(completed_s=-SELF_TEST_VALIDITY_S, problem="not tested yet")


@dataclass(frozen=True)
class _PortResults:
    """Results of the stop ports."""

    local_results: tuple[StopResult, ...] = ()  # of ports on this computer
    remote_results: tuple[StopResult, ...] = ()  # of ports on other computers


class PreparedStop:
    """Stops the robot at one link. Every method may be called from any thread, and none but `stop` waits."""

    def __init__(
        self,
        selection: RobotSelection,
        connection: ConnectionSettings,
        on_result: Callable[[str, str], None] = lambda *_: None,
    ):
        """Prepare an emergency stop, which then needs no time to open sockets or to start threads.

        Args:
            selection: Selects the robot for the search of `snakesim estop`.
            connection: How this process connects to the robot.
            on_result: Called after each stop with its requesters and its result in words, by another thread.
        """
        self._selection = selection
        self._connection = connection
        self._on_result = on_result
        self._user = get_user_name()  # looked up in a file
        # Threads.
        self._coordinator_thread = BackgroundThread("stop")
        self._datagram_thread = BackgroundThread("stop datagrams")
        self._network_thread = BackgroundThread("stop network")
        # What they use. The requester belongs to the thread of the datagrams.
        self._datagram_requester = StopRequester()
        self._local_ports: dict[Address, RobotAddress] = {}
        self._remote_ports: dict[Address, RobotAddress] = {}
        self._session: Session | None = None
        self._session_start_s = 0.0  # when the session could first be used
        # Requests that wait for the next stop, which begins after the present one.
        self._lock = threading.Lock()
        self._pending_requesters: list[str] = []
        self._pending_stop: Future[str] | None = None
        self._stop_start_s: float | None = None  # the present stop
        # Self-tests.
        self._port_self_test = NOT_TESTED
        self._network_self_test = NOT_TESTED
        self._running_self_tests: list[Future[None]] = []
        self._last_self_test_s = -SELF_TEST_PERIOD_S
        self.start_self_test_if_due()

    def use_session(self, session: Session) -> None:
        """Use a session for stops over the network from now on, and test it at once."""
        self._session_start_s = time.monotonic()
        self._session = session
        self._network_thread.submit(self._test_network)

    def request_stop(self, requester: str) -> "Future[str]":
        """Request a stop of the robot, and return without waiting for the result.

        Requests during a running stop are combined to one stop after it.

        Args:
            requester: Name of the person or program that requests the stop.

        Returns:
            A future with the result in words. It raises RefusedError if the robot has not confirmed the stop.
        """
        with self._lock:
            self._pending_requesters.append(requester)
            if self._pending_stop is None:
                self._pending_stop = self._coordinator_thread.submit(
                    self._stop_for_pending_requests
                )
            return self._pending_stop

    def stop_and_wait(self, requester: str) -> str:
        """Stop the robot, wait for the result, and return it in words. Raises RefusedError if it is not confirmed."""
        return self.request_stop(requester).result()

    def close(self) -> None:
        """End the threads, after a stop that is running."""
        self._coordinator_thread.close()
        self._network_thread.close()
        self._datagram_thread.submit(self._datagram_requester.close)
        self._datagram_thread.close()

    # --- the self-test

    def start_self_test_if_due(self) -> None:
        """Start a self-test in the threads that stop the robot, if the last one has ended and is a period ago."""
        now_s = time.monotonic()
        if now_s - self._last_self_test_s < SELF_TEST_PERIOD_S or not all(
            test.done() for test in self._running_self_tests
        ):
            return
        self._last_self_test_s = now_s
        self._running_self_tests = [
            self._datagram_thread.submit(self._test_ports),
            self._network_thread.submit(self._test_network),
        ]

    def check_readiness(self) -> StopReadiness:
        """Return whether a stop would reach the robot, by the newest self-test.

        Without a session, and until the first self-test over it has ended, this program waits for the robot.
        """
        now_s = time.monotonic()
        began_s = self._stop_start_s
        if began_s is not None:
            stuck = now_s - began_s > STUCK_TIMEOUT_S
            return StopReadiness(
                not stuck, f"a stop has been under way for {now_s - began_s:.0f} s"
            )
        if self._session is None or self._is_first_network_test_running(now_s):
            return StopReadiness(True, WAITING_FOR_ROBOT)
        without_network = self._network_self_test.explain_problem(now_s)
        if without_network:
            also = "; it is also sent to the robot's stop port" if self._list_ports() else ""
            return StopReadiness(
                False, f"a stop over the network is not ready: {without_network}{also}"
            )
        without_port = self._port_self_test.explain_problem(now_s) if self._list_ports() else ""
        if without_port:
            return StopReadiness(True, f"ready over the network only: {without_port}")
        return StopReadiness(True, "ready")

    def _is_first_network_test_running(self, now_s: float) -> bool:
        """Return whether no self-test over the network has ended yet, and the first one still has time."""
        is_untested = self._network_self_test is NOT_TESTED
        return is_untested and now_s - self._session_start_s < HOST_RESPONSE_TIMEOUT_S

    def _list_ports(self) -> dict[Address, RobotAddress]:
        return self._local_ports | self._remote_ports

    def _test_ports(self) -> None:
        """Find the stop ports, keep sockets for them, and send each of them a test. Runs in the datagram thread."""
        problem = ""
        try:
            local = find_local_stop_ports(self._selection)
            elsewhere = find_remote_stop_ports(self._selection, local)
            self._datagram_requester.open_sockets([*local, *elsewhere])
            self._local_ports = local
            self._remote_ports = elsewhere
        except OSError as error:  # no file is left: the addresses and sockets of before stay
            problem = "" if self._list_ports() else f"the stop port is not known: {error.strerror}"
        try:
            for address in self._list_ports():
                self._datagram_requester.require_open_port(address)
        except NotConnectedError as error:
            problem = str(error)
        self._port_self_test = _SelfTest(time.monotonic(), problem)

    def _test_network(self) -> None:
        """Test a round trip to the robot's host over the session that a stop uses. Runs in the network thread."""
        session = self._session
        if session is None:
            return
        try:
            problem = (
                ""
                if session.list_tokens(keys.alive_key("hal"), HOST_RESPONSE_TIMEOUT_S)
                else "the robot's host does not answer"
            )
        except Exception as error:
            self._network_self_test = _SelfTest(
                time.monotonic(), f"{type(error).__name__}: {error}"[:200]
            )
            raise
        self._network_self_test = _SelfTest(time.monotonic(), problem)

    # --- the stop

    def _stop_for_pending_requests(self) -> str:
        """Stop the robot for all pending requests, and report the result. Runs in the coordinator thread.

        Returns:
            The result in words.

        Raises:
            RefusedError: The robot has not confirmed the stop.
        """
        with self._lock:
            requesters = ", ".join(dict.fromkeys(self._pending_requesters))
            self._pending_requesters.clear()
            self._pending_stop = None
        self._stop_start_s = time.monotonic()
        try:
            stopped, text = self._stop_in_all_ways()
        except Exception as error:
            self._on_result(requesters, f"unexpected error: {type(error).__name__}: {error}")
            raise
        finally:
            self._stop_start_s = None
        self._on_result(requesters, text)
        if not stopped:
            raise RefusedError(text, code="robot/not-confirmed")
        return text

    def _stop_in_all_ways(self) -> tuple[bool, str]:
        """Stop the robot by datagrams and over the network at once; if neither succeeds, as `snakesim estop` does.

        Returns:
            Whether every selected robot has confirmed the stop, and the result in words.
        """
        pending_port_results = self._datagram_thread.submit(self._request_stop_at_ports)
        pending_network_results = self._network_thread.submit(self._request_stop_over_network)
        full_timeout_s = STOP_TIMEOUT_S + HOST_RESPONSE_TIMEOUT_S
        port_results, port_problems = _wait_for_result(
            pending_port_results, full_timeout_s, _PortResults()
        )
        # A local stop port cannot be forged. Once it has confirmed the stop, the network can only add a warning.
        is_confirmed = are_all_stopped(port_results.local_results)
        network_timeout_s = CONFIRMATION_TIMEOUT_S if is_confirmed else full_timeout_s
        network_results, network_problems = _wait_for_result(
            pending_network_results, network_timeout_s, []
        )
        results = combine_results(
            port_results.local_results, port_results.remote_results, network_results
        )
        lines = describe_results(results, port_results.local_results, network_results)
        if are_all_stopped(results):
            return True, "; ".join(lines)
        search_lines: list[str] = []
        try:
            stopped = stop_robots(self._selection, search_lines.append) == 0
        except (SnakesimError, OSError, RuntimeError) as error:  # no file, or no thread, is left
            return False, "; ".join([*lines, *port_problems, *network_problems, f"search: {error}"])
        return stopped, "; ".join(search_lines)

    def _request_stop_at_ports(self) -> _PortResults:
        def request(address: Address) -> StopAnswer | None:
            return self._datagram_requester.request_stop(address, self._user, STOP_TIMEOUT_S)

        local_results = [
            request_stop_at_port(request, address, robot)
            for address, robot in self._local_ports.items()
        ]
        remote_results = [
            request_stop_at_port(request, address, robot)
            for address, robot in self._remote_ports.items()
        ]
        # A closed port has no result.
        return _PortResults(
            tuple(result for result in local_results if result is not None),
            tuple(result for result in remote_results if result is not None),
        )

    def _request_stop_over_network(self) -> list[StopResult]:
        session = self._session
        if session is None:
            return []
        with closing(session.create_subsession()) as part:
            return request_stop_over_session(part, self._connection, STOP_TIMEOUT_S)


def _wait_for_result(
    pending: "Future[ResultT]", timeout_s: float, default: ResultT
) -> tuple[ResultT, list[str]]:
    """Wait for one way of stopping the robot. Its error does not end the stop, but becomes a line of the result.

    Args:
        pending: Future result of this way.
        timeout_s: Time to wait for the result.
        default: Result if this way fails or does not end in time.

    Returns:
        The result, and the errors as text; without an error, the second is empty.
    """
    try:
        error = pending.exception(timeout_s)
    except FutureTimeoutError:
        return default, []
    if error is not None:
        return default, [f"{type(error).__name__}: {error}"]
    return pending.result(), []
