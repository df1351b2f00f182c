"""Somebody attacks the network: an emergency stop comes through all the same, and a second run arms nothing."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial

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
from verification.faults.robot import ProcessRobot, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

HALF_OPEN, IDLE, READERS, QUERIES, SAMPLES = 300, 1000, 300, 10_000, 10_000
ANSWER_S = 10.0
TRIES = 20  # to find the robot armed under a flood before it is stopped
STANDING = {"controller": "hold", "rate_hz": 50}

Flood = Callable[[ProcessRobot], AbstractContextManager[object]]


def _flooding(kind: str, amount: int, process_count: int) -> Flood:
    return lambda started_robot: run_flooders(
        started_robot.folder, kind, started_robot.endpoint, amount, process_count
    )


FLOODS: dict[str, Flood] = {
    "half_open": lambda started_robot: open_silent_connections(started_robot.endpoint, HALF_OPEN),
    "idle": _flooding("idle", IDLE // 4, 4),
    "lease": _flooding("lease", QUERIES, 2),
    "garbage": _flooding("garbage", SAMPLES, 1),
    "datagrams": lambda started_robot: flood_stop_port(started_robot.endpoint),
}


def stopped_under(name: str, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The value: from the request of the stop to the setpoints of the stop, by the host's private channel."""
    with robot(request, **STANDING) as (started_robot, observer), FLOODS[name](started_robot):
        for number in range(request.trials):
            yield _stopped(request, started_robot, observer, by_datagram=number % 2 == 1)
    _explain(request)


def stopped_while_readers_leave(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """The same, with many readers of everything that leave together just before."""
    with robot(request, **STANDING) as (started_robot, observer):
        for number in range(request.trials):
            with run_flooders(started_robot.folder, "readers", started_robot.endpoint, READERS) as (
                readers,
            ):
                yield _stopped(
                    request,
                    started_robot,
                    observer,
                    by_datagram=number % 2 == 1,
                    before=partial(kill_process, readers),
                )
    _explain(request)


def _explain(request: MeasurementRequest) -> None:
    request.note(
        "requested in turn by a query on a session that was there before, and by a datagram; 50 Hz, controller `hold`; "
        "reported over the host's private channel, and a period (20 ms) added, in which the setpoints go out"
    )


def _stopped(
    request: MeasurementRequest,
    started_robot: ProcessRobot,
    observer: Observer,
    *,
    by_datagram: bool,
    before: Callable[[], object] | None = None,
) -> InjectionTrial:
    for _ in range(TRIES):
        if observer.state() != "armed":
            observer.arm(60.0)
        observer.watch(0.1 + started_robot.random.random() * 0.02)
        if started_robot.host.lifecycle() == "armed":
            break
        request.retry()
    else:
        raise TrialError(f"the robot was not seen armed under the flood: {observer.in_words()}")
    if before is not None:
        before()
    requested_ns = time.monotonic_ns()
    answers: list[object] = []

    def ask() -> None:
        if by_datagram:
            answers.append(
                send_until_answered(
                    started_robot.endpoint, make_stop_datagram("operator"), ANSWER_S
                )
            )
        else:
            answers.append(observer.ask(keys.ESTOP, EstopRequest(requester="operator")).ok)

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    stop = started_robot.host.wait_for_status(
        lambda status: status.lifecycle != "armed", requested_ns, "a stop"
    )
    started_robot.host.wait_for_status(
        lambda status: status.lifecycle == "estop", requested_ns, "the emergency stop"
    )
    asking.join(ANSWER_S)
    period_ns = observer.description().period_ns
    failure = "" if answers and answers[0] else "the stop was not confirmed to who asked for it"
    return recovered(observer, (stop.at_ns - requested_ns + period_ns) / 1e6, failure)


# --- a second run --------------------------------------------------------------------------------------------------


def second_run(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """A person disarmed the robot; a second `snakesim run` starts on its network. The value: setpoints that move."""
    command = [
        sys.executable,
        "-m",
        "snakesim_operator",
        "run",
        "triplet",
        "--clock-mode",
        "realtime",
        "--duration",
        "1",
    ]
    with robot(request) as (started_robot, observer):
        for number in range(request.trials):
            if observer.state() != "armed":
                observer.arm()
            observer.ask(keys.LIFECYCLE, LifecycleRequest(action="disarm", requester="bench"))
            observer.until(lambda: observer.state() == "disarmed", "disarmed")
            observer.watch(0.1)
            observer.forget()
            where = ["--router" if number % 2 else "--endpoint", started_robot.endpoint]
            typed, output = (
                [*command, *where, "--out", str(started_robot.folder / f"second{number}")],
                subprocess.PIPE,
            )
            second = subprocess.run(
                typed, stdout=output, stderr=subprocess.STDOUT, text=True, check=False, timeout=60
            )
            observer.listen()
            failures: list[str] = []
            if (
                second.returncode not in (1, 2)
                or started_robot.config.robot.name not in second.stdout
            ):
                failures.append(
                    f"the second run ended with {second.returncode}: {second.stdout[-300:]}"
                )
            moving = sum(
                any(mode is not JointMode.PASSIVE for mode in h.message.mode)
                for h in observer.applied
            )
            if observer.state() != "disarmed":
                failures.append(f"the robot is {observer.in_words()}")
            yield InjectionTrial(value=float(moving), failure="; ".join(failures))
        request.note(
            "in turn on the robot's network (`--router`) and at its endpoint (`--endpoint`)"
        )
