"""Drives of every type: their host is frozen, and what goes wrong with one of them or with their bus.

At 50 Hz, which emulated drives of every type keep on a busy computer. Times within a host are measured in its periods.
"""

import contextlib
import json
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.scenario import RunConfig, write_config
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_operator.run import children
from snakesim_testing.harness.wait import wait_until
from verification.faults.drives_process import READY
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import START_LIMIT_S, ProcessRobot, configuration, recovered, robot
from verification.faults.row import InjectionTrial, MeasurementRequest
from verification.faults.rows import modules

RATE_HZ = 50.0
PERIOD_MS = 1000.0 / RATE_HZ
FROZEN_S = 1.0
WATCHED_S = 1.0  # for drives that are enabled again
# A watchdog, the period that a setpoint may be old, and a busy computer.
OFF_MS = 100.0 + 3 * PERIOD_MS
COOLS_IN_S = 2.0  # time constant of the windings, so that a trial need not wait for minutes
MAX_RETRIES = 10  # of one trial
BUS = "udp_multicast:239.74.163.9"
POSE = "127.0.0.1:7450"
SERVOS = "servos"
BUSES: dict[str, dict[str, Any]] = {
    "can": {"backend__channels": [BUS]},
    "odrive": {"backend__channels": [BUS]},
    "moteus": {"backend__channels": [BUS]},
    "cia402": {"backend__channels": [BUS]},
    "dynamixel": {"backend__ports": [SERVOS]},
    "mixed": {"backends__odrive__channels": [BUS], "backends__dynamixel__ports": [SERVOS]},
}
WATCHDOGS = ("drive_fault", "module_watchdog")


def robot_of(backend: str, **dotted: Any) -> RunConfig:
    """The triplet with drives of one type, or of several."""
    changes: dict[str, Any] = {}
    match backend:
        case "mixed":
            changes["robot"] = "planar13_mixed"
        case "feetech":  # These servos have no torque mode.
            changes["controller"] = "lateral_undulation"
        case _:
            pass
    return configuration(backend, rate_hz=RATE_HZ, **changes, **dotted)


# --- the host's process is frozen ------------------------------------------------------------------------------


class DrivesOutside:
    """Emulated drives in a process of their own."""

    def __init__(self, folder: Path, config: RunConfig, log: Any) -> None:
        self._notes = folder / "drives.notes"
        self._words: list[bytes] = []

        def keep(words: bytes) -> None:
            self._words.append(words)
            log.write(words)

        write_config(config, folder / "drives.json")
        module = [
            "verification.faults.drives_process",
            str(folder / "drives.json"),
            str(self._notes),
            "--pose",
            POSE,
        ]
        self._child = children.start_child("drives", module, keep)
        wait_until(lambda: READY in self.output(), "the drives", START_LIMIT_S)

    def output(self) -> str:
        """What the process printed."""
        if (ending := self._child.describe_exit()) is not None:
            raise TrialError(ending)
        return b"".join(self._words).decode(errors="replace")

    def changes(self) -> list[tuple[int, list[bool]]]:
        """When which drives were enabled, oldest first; by the monotonic clock."""
        lines = self._notes.read_text().splitlines(keepends=True)
        return [tuple(json.loads(line)) for line in lines if line.endswith("\n")]

    def enabled(self) -> list[bool]:
        """Which are now."""
        return self.changes()[-1][1]

    def close(self) -> None:
        """End it."""
        children.stop_children([self._child])


def host_frozen(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """SIGSTOP for the host, for 1 s. The value: drives that are enabled at any time before the reset."""
    _use_loopback()
    config = robot_of(request.backend, backend__pose_listen=POSE, **BUSES[request.backend])
    slowest_ms = 0.0
    with (
        contextlib.chdir(request.folder),
        (request.folder / "drives.log").open("ab", buffering=0) as log,
        contextlib.closing(DrivesOutside(request.folder, config, log)) as drives,
        robot(request, validate_and_complete_config(config)) as (
            started_robot,
            observer,
        ),  # once the servos' port is there
    ):
        for _ in range(request.trials):
            _set_in_motion(request, started_robot, observer, lambda: all(drives.enabled()))
            trial, off_ms = _frozen(started_robot, observer, drives)
            slowest_ms = max(slowest_ms, off_ms)
            yield trial
    request.note(
        f"the real host process at {RATE_HZ:g} Hz, drives in a process of their own on {_buses_in_words(request)}; "
        f"from the signal until every drive was off: at most {slowest_ms:.0f} ms"
    )


def _set_in_motion(
    request: MeasurementRequest,
    started_robot: ProcessRobot,
    observer: Observer,
    is_ready: Callable[[], bool] = lambda: True,
) -> None:
    """Repeat a trial if the robot stops by itself: a bus of emulated drives is late on a busy computer."""
    for _ in range(MAX_RETRIES):
        with contextlib.suppress(TrialError):
            started_robot.set_in_motion(observer)
            if is_ready():
                return
        request.retry()
    raise TrialError(f"this machine is too busy: the robot stopped by itself {MAX_RETRIES} times")


def _frozen(
    started_robot: ProcessRobot, observer: Observer, drives: DrivesOutside
) -> tuple[InjectionTrial, float]:
    """Return a trial, and how long after the signal the last drive was off."""
    stopped_ns = started_robot.signal("host", signal.SIGSTOP)
    try:
        time.sleep(FROZEN_S)
        changes = [change for change in drives.changes() if change[0] > stopped_ns]
    finally:
        resumed_ns = started_robot.signal("host", signal.SIGCONT)
    off_ms = (changes[-1][0] - stopped_ns) / 1e6 if changes else 0.0
    failures: list[str] = []
    if not changes or any(changes[-1][1]):
        failures.append(f"still enabled after {FROZEN_S:g} s: {changes}")
    elif off_ms > OFF_MS:
        failures.append(f"off only after {off_ms:.0f} ms")
    observer.first_fault(resumed_ns)
    observer.watch(WATCHED_S)
    if observer.state() != "fault":
        failures.append(f"not latched: {observer.in_words()}")
    failures += _unnamed(observer)
    again = [enabled for at_ns, enabled in drives.changes() if at_ns > resumed_ns]
    value = float(sum(map(any, zip(*again, strict=True)))) if again else 0.0
    return recovered(observer, value, "; ".join(failures)), off_ms


def _unnamed(observer: Observer) -> list[str]:
    """The joints whose watchdog's stop was not reported."""
    assert observer.status is not None
    named = {fault.joint for fault in observer.status.faults if fault.what in WATCHDOGS}
    missing = [joint.name for joint in observer.description().joints if joint.name not in named]
    return [f"not reported: {', '.join(missing)}"] if missing else []


def _buses_in_words(request: MeasurementRequest) -> str:
    buses = [name for values in BUSES[request.backend].values() for name in values]
    return " and ".join(
        "a pseudo terminal" if name == SERVOS else "UDP multicast" for name in buses
    )


def _use_loopback() -> None:
    """Let multicast stay in this network namespace, in which nothing else is."""
    for command in (
        "link set lo up",
        "link set lo multicast on",
        "route replace 239.0.0.0/8 dev lo",
    ):
        subprocess.run(["ip", *command.split()], check=True, capture_output=True, timeout=10)


# --- a drive, or its bus ---------------------------------------------------------------------------------------


def at_host(
    kind: str, expected: dict[str, Sequence[str]], request: MeasurementRequest
) -> Iterator[InjectionTrial]:
    """Inject a fault of joint_N or bus_1 into the host whose process emulates the drives.

    expected: names that the driver of each type gives it. The value: from its beginning to the stop mode.
    """
    rng = random.Random(9)
    config = robot_of(request.backend, robot__heat__time_constant_s=COOLS_IN_S)
    what = expected.get(request.backend, expected["others"])
    with robot(request, validate_and_complete_config(config)) as (
        started_robot,
        observer,
    ):  # as `snakesim run` does
        joints = len(observer.description().joints)
        for _ in range(request.trials):
            _set_in_motion(request, started_robot, observer)
            target = "bus_1" if kind in modules.BUS_KINDS else f"joint_{rng.randrange(joints) + 1}"
            yield modules.injected(observer, FaultInjection(kind, target), what, PERIOD_MS)
    request.note(
        f"the real host process at {RATE_HZ:g} Hz, drives emulated in it; counted in its periods"
    )
