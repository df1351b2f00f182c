"""Measures attacks on the network: an emergency stop must still arrive, and a second run must not arm the robot."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import EstopRequest, JointMode, LifecycleRequest
from verification.attack.tools.floods import open_silent_connections, run_flooders
from verification.attack.tools.processes import kill_process
from verification.attack.tools.stop_datagrams import (
    flood_stop_port,
    make_stop_datagram,
    send_until_answered,
)
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import ProcessRobot, recover_robot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

# Sizes of the floods.
HALF_OPEN_CONNECTIONS = 300
IDLE_SESSIONS = 1000
IDLE_PROCESSES = 4
LEASE_QUERIES = 10_000
LEASE_PROCESSES = 2
GARBAGE_SAMPLES = 10_000
LEAVING_READERS = 300

CONFIRMATION_TIMEOUT_S = 10.0  # of an emergency stop
ARMING_TIMEOUT_S = 60.0  # under a flood
MAX_ARMING_ATTEMPTS = 20  # until the host itself reports that it is armed
RATE_HZ = 50
STATIONARY_ROBOT = {"controller": "hold", "rate_hz": RATE_HZ}
OBSERVED_S = 0.1  # before a trial, so that the newest state of the robot is known
SECOND_RUN_TIMEOUT_S = 60.0

Flood = Callable[[ProcessRobot], AbstractContextManager[object]]
"""Floods the network of a robot as long as the returned context lives."""


# --- an emergency stop under a flood -------------------------------------------------------------------------------


def _make_process_flood(kind: str, amount: int, process_count: int) -> Flood:
    """Return a flood by processes of `verification.attack.tools.flooder`. amount: of each process."""

    def start_flood(robot: ProcessRobot) -> AbstractContextManager[object]:
        return run_flooders(robot.folder, kind, robot.endpoint, amount, process_count)

    return start_flood


FLOODS: dict[str, Flood] = {
    "half_open": lambda robot: open_silent_connections(robot.endpoint, HALF_OPEN_CONNECTIONS),
    "idle": _make_process_flood("idle", IDLE_SESSIONS // IDLE_PROCESSES, IDLE_PROCESSES),
    "lease": _make_process_flood("lease", LEASE_QUERIES, LEASE_PROCESSES),
    "garbage": _make_process_flood("garbage", GARBAGE_SAMPLES, 1),
    "datagrams": lambda robot: flood_stop_port(robot.endpoint),
}


def measure_stop_under_flood(
    flood_name: str, request: MeasurementRequest
) -> Iterator[InjectionTrial]:
    """Request an emergency stop while the network is flooded.

    Args:
        flood_name: Key of FLOODS.
        request: Measurement to make.

    Yields:
        Trials whose value is the time from the request to the setpoints of the stop, in ms.
    """
    with (
        start_robot(request, **STATIONARY_ROBOT) as (robot, observer),
        FLOODS[flood_name](robot),
    ):
        for number in range(request.trials):
            _wait_until_armed(request, robot, observer)
            yield _run_stop_trial(robot, observer, by_datagram=number % 2 == 1)
    _add_stop_note(request)


def measure_stop_while_readers_leave(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Request an emergency stop just after many readers of every key have left at the same time.

    Yields:
        Trials whose value is the time from the request to the setpoints of the stop, in ms.
    """
    with start_robot(request, **STATIONARY_ROBOT) as (robot, observer):
        for number in range(request.trials):
            with run_flooders(robot.folder, "readers", robot.endpoint, LEAVING_READERS) as (
                readers,
            ):
                _wait_until_armed(request, robot, observer)
                kill_process(readers)
                yield _run_stop_trial(robot, observer, by_datagram=number % 2 == 1)
    _add_stop_note(request)


def _add_stop_note(request: MeasurementRequest) -> None:
    request.add_note(
        "requested in turn by a query on a session that was there before, and by a datagram; 50 Hz, controller `hold`; "
        "reported over the host's private channel, and a period (20 ms) added, in which the setpoints go out"
    )


def _wait_until_armed(request: MeasurementRequest, robot: ProcessRobot, observer: Observer) -> None:
    """Arm the robot, and repeat this until the host reports that it is armed over its private channel.

    Raises:
        TrialError: The robot was not armed after MAX_ARMING_ATTEMPTS.
    """
    for _ in range(MAX_ARMING_ATTEMPTS):
        if observer.get_lifecycle() != "armed":
            observer.arm(ARMING_TIMEOUT_S)
        observer.listen_for(OBSERVED_S + robot.random.random() / RATE_HZ)
        if robot.host_watch.get_lifecycle() == "armed":
            return
        request.count_retries()
    raise TrialError(f"the robot was not armed under the flood: {observer.describe_status()}")


def _run_stop_trial(
    robot: ProcessRobot, observer: Observer, *, by_datagram: bool
) -> InjectionTrial:
    """Request an emergency stop once, and wait until the host reports it over its private channel.

    Args:
        robot: An armed robot.
        observer: Its observer.
        by_datagram: Request the stop by a datagram, instead of by a query.
    """
    confirmations: list[bool] = []

    def request_stop() -> None:
        if by_datagram:
            datagram = make_stop_datagram("operator")
            answer = send_until_answered(robot.endpoint, datagram, CONFIRMATION_TIMEOUT_S)
            confirmations.append(answer is not None)
        else:
            answer = observer.send_request(keys.ESTOP, EstopRequest(requester="operator"))
            confirmations.append(answer.ok)

    request_ns = time.monotonic_ns()
    requesting = threading.Thread(target=request_stop, daemon=True)
    requesting.start()
    stop = robot.host_watch.wait_for_status(
        lambda status: status.lifecycle != "armed", request_ns, "a stop"
    )
    robot.host_watch.wait_for_status(
        lambda status: status.lifecycle == "estop", request_ns, "the emergency stop"
    )
    requesting.join(CONFIRMATION_TIMEOUT_S)
    failures: list[str] = []
    if True not in confirmations:
        failures.append("the client that requested the stop got no confirmation")
    # The setpoints of the stop are sent at most one period after the status.
    period_ns = observer.get_description().period_ns
    delay_ms = (stop.at_ns - request_ns + period_ns) / 1e6
    return recover_robot(observer, delay_ms, failures)


# --- a second run --------------------------------------------------------------------------------------------------


def measure_second_run(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Start a second `snakesim run` on the network of a robot that an operator has disarmed.

    Yields:
        Trials whose value is the number of setpoints that were not passive.
    """
    with start_robot(request) as (robot, observer):
        for number in range(request.trials):
            yield _run_second_run_trial(robot, observer, number)
        request.add_note(
            "in turn on the robot's network (`--router`) and at its endpoint (`--endpoint`)"
        )


def _run_second_run_trial(robot: ProcessRobot, observer: Observer, number: int) -> InjectionTrial:
    """Start a second run once. number: of the trial, decides how the second run finds the network."""
    if observer.get_lifecycle() != "armed":
        observer.arm()
    observer.send_request(keys.LIFECYCLE, LifecycleRequest(action="disarm", requester="bench"))
    observer.wait_until(lambda: observer.get_lifecycle() == "disarmed", "disarmed")
    observer.listen_for(OBSERVED_S)
    observer.forget()
    second_run = _start_second_run(robot, number)
    observer.listen()
    failures: list[str] = []
    is_refused = second_run.returncode in (1, 2)
    if not is_refused or robot.config.robot.name not in second_run.stdout:
        failures.append(
            f"the second run ended with {second_run.returncode}: {second_run.stdout[-300:]}"
        )
    if observer.get_lifecycle() != "disarmed":
        failures.append(f"the robot is {observer.describe_status()}")
    active_count = sum(
        set(received.message.mode) != {JointMode.PASSIVE} for received in observer.applied
    )
    return InjectionTrial(value=float(active_count), failure="; ".join(failures))


def _start_second_run(robot: ProcessRobot, number: int) -> subprocess.CompletedProcess[str]:
    """Run `snakesim run triplet` on the network of a robot, and wait until it ends."""
    network_option = "--router" if number % 2 else "--endpoint"
    command = [sys.executable, "-m", "snakesim_operator", "run", "triplet"]
    command += ["--clock-mode", "realtime", "--duration", "1"]
    command += [network_option, robot.endpoint]
    command += ["--out", str(robot.folder / f"second{number}")]
    return subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=SECOND_RUN_TIMEOUT_S,
    )
