"""Measures drives of every type: their host is frozen, a drive fails, or their bus fails.

The robot runs at 50 Hz, which emulated drives of every type achieve on a busy computer. Times within a host are counted
in its control periods.
"""

import contextlib
import json
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.scenario import RunConfig, write_config
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_operator.run.processes import children
from snakesim_testing.harness.wait import wait_until
from verification.faults.drives_process import READY
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import (
    START_TIMEOUT_S,
    ProcessRobot,
    make_config,
    recover_robot,
    start_robot,
)
from verification.faults.row import InjectionTrial, MeasurementRequest
from verification.faults.rows import modules

RATE_HZ = 50.0
PERIOD_MS = 1000.0 / RATE_HZ
FROZEN_S = 1.0
OBSERVED_S = 1.0  # in which no drive may be enabled again
WATCHDOG_MS = 100.0  # of every drive
# A setpoint may be one period old at the signal. A busy computer delays the drives by up to two more.
MAX_OFF_DELAY_MS = WATCHDOG_MS + 3 * PERIOD_MS
WINDING_TIME_CONSTANT_S = 2.0  # so that an overheated winding cools down within a trial
MAX_RETRIES = 10  # of one trial

CAN_CHANNEL = "udp_multicast:239.74.163.9"
MOCAP_ADDRESS = "127.0.0.1:7450"
SERVO_PORT = "servos"  # link to a pseudo terminal, in the working directory

# Overrides that connect the host of each backend to the buses of the separate drives.
BUS_OVERRIDES: dict[str, dict[str, Any]] = {
    "can": {"backend__channels": [CAN_CHANNEL]},
    "odrive": {"backend__channels": [CAN_CHANNEL]},
    "moteus": {"backend__channels": [CAN_CHANNEL]},
    "cia402": {"backend__channels": [CAN_CHANNEL]},
    "dynamixel": {"backend__ports": [SERVO_PORT]},
    "mixed": {
        "backends__odrive__channels": [CAN_CHANNEL],
        "backends__dynamixel__ports": [SERVO_PORT],
    },
}
WATCHDOG_FAULTS = ("drive_fault", "module_watchdog")


def _make_drive_config(backend: str, **overrides: Any) -> RunConfig:
    """Return the configuration of a robot with drives of one type, or of several (`mixed`)."""
    match backend:
        case "mixed":
            overrides["robot"] = "planar13_mixed"
        case "feetech":  # these servos have no torque mode
            overrides["controller"] = "lateral_undulation"
        case _:
            pass
    return make_config(backend, rate_hz=RATE_HZ, **overrides)


def _set_in_motion(
    request: MeasurementRequest,
    robot: ProcessRobot,
    observer: Observer,
    is_ready: Callable[[], bool] = lambda: True,
) -> None:
    """Set the robot in motion, and try again if it stops by itself or is not ready.

    A bus of emulated drives can be late on a busy computer.

    Raises:
        TrialError: The robot stopped by itself MAX_RETRIES times.
    """
    for _ in range(MAX_RETRIES):
        with contextlib.suppress(TrialError):
            robot.set_in_motion(observer)
            if is_ready():
                return
        request.count_retries()
    raise TrialError(f"this machine is too busy: the robot stopped by itself {MAX_RETRIES} times")


# --- the host is frozen --------------------------------------------------------------------------------------------


class SeparateDrives:
    """Emulated drives in a separate process, which records when each of them is enabled and disabled."""

    def __init__(self, folder: Path, config: RunConfig, log: BinaryIO) -> None:
        """Start the process, and wait until its buses are open.

        Args:
            folder: Folder for the configuration and the record of the process.
            config: Configuration of the run.
            log: Open file for the output of the process.
        """
        self._record_path = folder / "drives.record"
        self._output: list[bytes] = []

        def on_output(output: bytes) -> None:
            self._output.append(output)
            log.write(output)

        config_path = folder / "drives.json"
        write_config(config, config_path)
        command = ["verification.faults.drives_process", str(config_path), str(self._record_path)]
        command += ["--pose", MOCAP_ADDRESS]
        self._child = children.start_child("drives", command, on_output)
        wait_until(lambda: READY in self._read_output(), "the drives", START_TIMEOUT_S)

    def _read_output(self) -> str:
        """Return everything that the process printed. Raise TrialError if it has ended."""
        ending = self._child.describe_exit()
        if ending is not None:
            raise TrialError(ending)
        return b"".join(self._output).decode(errors="replace")

    def read_changes(self) -> list[tuple[int, list[bool]]]:
        """Return every recorded change, oldest first.

        Returns:
            The time of each change by the monotonic clock in ns, and for each joint whether its drive is enabled.
        """
        lines = self._record_path.read_text().splitlines(keepends=True)
        return [tuple(json.loads(line)) for line in lines if line.endswith("\n")]

    def are_all_enabled(self) -> bool:
        """Return whether every drive is enabled now."""
        _, enabled = self.read_changes()[-1]
        return all(enabled)

    def close(self) -> None:
        """Stop the process of the drives."""
        children.stop_children([self._child])


def measure_frozen_host(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Freeze the host for FROZEN_S while the robot moves. The drives run in a separate process.

    Yields:
        Trials whose value is the number of drives that were enabled again before the reset.
    """
    _keep_multicast_on_loopback()
    config = _make_drive_config(
        request.backend, backend__pose_listen=MOCAP_ADDRESS, **BUS_OVERRIDES[request.backend]
    )
    max_off_delay_ms = 0.0
    with (
        contextlib.chdir(request.folder),
        (request.folder / "drives.log").open("ab", buffering=0) as log,
        contextlib.closing(SeparateDrives(request.folder, config, log)) as drives,
        # The port of the servos must exist before the configuration is completed.
        start_robot(request, validate_and_complete_config(config)) as (robot, observer),
    ):
        for _ in range(request.trials):
            _set_in_motion(request, robot, observer, drives.are_all_enabled)
            trial, off_delay_ms = _run_frozen_host_trial(robot, observer, drives)
            max_off_delay_ms = max(max_off_delay_ms, off_delay_ms)
            yield trial
    request.add_note(
        f"the real host process at {RATE_HZ:g} Hz, drives in a process of their own on "
        f"{_describe_buses(request.backend)}; "
        f"from the signal until every drive was off: at most {max_off_delay_ms:.0f} ms"
    )


def _run_frozen_host_trial(
    robot: ProcessRobot, observer: Observer, drives: SeparateDrives
) -> tuple[InjectionTrial, float]:
    """Freeze the host once. Return the trial, and the time from the signal to the last drive that was off, in ms."""
    freeze_ns = robot.send_signal("host", signal.SIGSTOP)
    try:
        time.sleep(FROZEN_S)
        changes = [change for change in drives.read_changes() if change[0] > freeze_ns]
    finally:
        resume_ns = robot.send_signal("host", signal.SIGCONT)
    off_delay_ms = (changes[-1][0] - freeze_ns) / 1e6 if changes else 0.0
    failures: list[str] = []
    if not changes or any(changes[-1][1]):
        failures.append(f"still enabled after {FROZEN_S:g} s: {changes}")
    elif off_delay_ms > MAX_OFF_DELAY_MS:
        failures.append(f"off only after {off_delay_ms:.0f} ms")
    observer.wait_for_fault(resume_ns)
    observer.listen_for(OBSERVED_S)
    if observer.get_lifecycle() != "fault":
        failures.append(f"not latched: {observer.describe_status()}")
    unreported = _list_unreported_joints(observer)
    if unreported:
        failures.append(f"not reported: {', '.join(unreported)}")
    enabled_again = _count_enabled_drives(drives, resume_ns)
    return recover_robot(observer, float(enabled_again), failures), off_delay_ms


def _list_unreported_joints(observer: Observer) -> list[str]:
    """Return the joints for which the status reports no stop by a watchdog."""
    assert observer.status is not None
    reported = {fault.joint for fault in observer.status.faults if fault.what in WATCHDOG_FAULTS}
    joint_names = [joint.name for joint in observer.get_description().joints]
    return [name for name in joint_names if name not in reported]


def _count_enabled_drives(drives: SeparateDrives, since_ns: int) -> int:
    """Return how many drives were enabled at any time after a time."""
    states = [enabled for at_ns, enabled in drives.read_changes() if at_ns > since_ns]
    return sum(any(drive_states) for drive_states in zip(*states, strict=True))


def _describe_buses(backend: str) -> str:
    names = [name for values in BUS_OVERRIDES[backend].values() for name in values]
    return " and ".join(
        "a pseudo terminal" if name == SERVO_PORT else "UDP multicast" for name in names
    )


def _keep_multicast_on_loopback() -> None:
    """Route multicast over the loopback interface of this network namespace, which has no other interface."""
    for command in (
        "link set lo up",
        "link set lo multicast on",
        "route replace 239.0.0.0/8 dev lo",
    ):
        subprocess.run(["ip", *command.split()], check=True, capture_output=True, timeout=10)


# --- a drive or its bus fails --------------------------------------------------------------------------------------


def measure_injected_fault(
    kind: str, fault_names: Mapping[str, Sequence[str]], request: MeasurementRequest
) -> Iterator[InjectionTrial]:
    """Inject a fault into the host, whose process also emulates the drives.

    Args:
        kind: Kind of the fault. It concerns a random joint, or the first bus.
        fault_names: Names that the driver may report, by backend, or by `others`.
        request: Measurement to make.

    Yields:
        Trials whose value is the time from the beginning of the fault to the stop mode, in ms.
    """
    rng = random.Random(9)
    overrides = {"robot__heat__time_constant_s": WINDING_TIME_CONSTANT_S}
    config = validate_and_complete_config(_make_drive_config(request.backend, **overrides))
    expected_names = fault_names.get(request.backend, fault_names["others"])
    with start_robot(request, config) as (robot, observer):
        joint_count = len(observer.get_description().joints)
        for _ in range(request.trials):
            _set_in_motion(request, robot, observer)
            is_bus_fault = kind in modules.BUS_KINDS
            target = "bus_1" if is_bus_fault else f"joint_{rng.randrange(joint_count) + 1}"
            injection = FaultInjection(kind, target)
            yield modules.run_injection_trial(observer, injection, expected_names, PERIOD_MS)
    request.add_note(
        f"the real host process at {RATE_HZ:g} Hz, drives emulated in it; counted in its periods"
    )
