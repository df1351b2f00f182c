"""A bus in a thread of its own, so that a slow bus delays neither the host nor other buses.

The host waits for a bus only if the bus answered in time before. Otherwise its joints keep their last values, whose age
grows. Of several setpoints the newest is sent, and none that is older than a lease: a bus without newer setpoints
switches its drives off. If the bus cannot send that either, the drives stop by their own watchdogs.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from snakesim_drivers.kit.bus import BusSpec, InlineBus, select_bus_findings
from snakesim_drivers.kit.drive_guard import NO_DRIVES
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

WAIT_SLICES = 6  # remaining_slices of the time that the host waits: a computer that pauses then loses one slice only

_log = logging.getLogger("snakesim.drivers")


class _QueuedCommand(NamedTuple):
    """A command that waits to be sent."""

    command: BusCommand
    queued_s: float  # time.monotonic


class ThreadedBus(InlineBus):
    """An `InlineBus` whose own thread alone uses the drives from `start` on. The host calls the public methods."""

    def __init__(
        self,
        spec: BusSpec,
        joints: Sequence[Joint],
        clock_ns: Callable[[], int],
        period_ns: int,
        lease_ns: int,
        max_wait_s: float,
    ) -> None:
        """Open a bus that a thread of its own will use; `start` starts the thread.

        Args:
            spec: The bus, with its joints, its watchdog time, and the function that opens it.
            joints: All joints of the robot, from tail to head.
            clock_ns: Function that returns the driver's time in ns.
            period_ns: Duration of the robot's control cycle.
            lease_ns: Age from which setpoints are no longer valid.
            max_wait_s: Maximum duration that the host waits for a reading.
        """
        super().__init__(spec, joints, clock_ns, period_ns)
        self._lease_s = lease_ns * 1e-9
        self._wait_slice_s = max_wait_s / WAIT_SLICES
        self._thread: threading.Thread | None = None

        # Used by the bus thread alone.
        # When the setpoints in use were queued; None: no drive is enabled.
        self._setpoint_time_s: float | None = None

        # Shared by both threads, and guarded by the condition.
        self._condition = threading.Condition()
        self._is_close_requested = False
        # The first error of a cycle, and whether the host has got it; later cycles usually fail in the same way.
        self._bus_error: Exception | None = None
        self._is_bus_error_reported = False
        self._close_error: Exception | None = None
        # Readings.
        self._published_readings = DriveReadings([joints[j] for j in spec.joints], clock_ns)
        # Also which drives are not ready yet.
        self._published_readings.copy_from(self.readings, range(len(spec.joints)))
        # When a reading was requested; None: it is complete.
        self._request_time_s: float | None = None
        # Requested again during a reading: a slow bus reads again at once.
        self._is_next_reading_requested = False
        self._read_duration_s = 0.0
        self._is_slow = False
        # Commands.
        self._queued_command: _QueuedCommand | None = None
        self._drives_to_reset = NO_DRIVES
        self._new_findings: list[FaultFinding] = []

    # --- called by the host's thread --------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread in the first control cycle; it inherits the scheduling priority of the host's thread."""
        if self._thread is None:
            self._thread = threading.Thread(
                target=self._run, name=f"bus {self.spec.name}", daemon=True
            )
            self._thread.start()

    def request_reading(self) -> bool:
        with self._condition:
            if self._request_time_s is not None:
                self._is_next_reading_requested = True
                return False
            if self._read_duration_s <= WAIT_SLICES * self._wait_slice_s:
                self._is_slow = False
            self._request_time_s = time.monotonic()
            self._condition.notify_all()
            return True

    def wait_for_reading(self, remaining_slices: int) -> int:
        with self._condition:
            while remaining_slices > 0 and self._request_time_s is not None and not self._is_slow:
                was_notified = self._condition.wait(self._wait_slice_s)
                if not was_notified:
                    remaining_slices -= 1
            self._is_slow = self._request_time_s is not None
        return remaining_slices

    def copy_readings_to(self, robot_readings: DriveReadings) -> None:
        with self._condition:
            self._raise_bus_error()
            robot_readings.copy_from(self._published_readings, self.spec.joints)

    def send(self, command: BusCommand) -> None:
        """Queue setpoints, which the bus thread sends as soon as it is free. They replace older queued ones."""
        with self._condition:
            self._queued_command = _QueuedCommand(command, time.monotonic())
            self._condition.notify_all()

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Request that the bus thread clears the errors of these drives before it sends the next setpoints."""
        with self._condition:
            self._drives_to_reset |= joints
            # Findings of drives are from before the reset.
            self._new_findings = select_bus_findings(self._new_findings)
            self._condition.notify_all()

    def poll(self) -> None:
        """Do nothing, because the bus thread receives by itself."""

    def list_findings(self) -> list[FaultFinding]:
        """Return what was found wrong since the last call, each time that setpoints were sent."""
        with self._condition:
            self._raise_bus_error()
            findings = self._new_findings
            self._new_findings = []
            return findings

    def request_close(self) -> None:
        """Request that the bus thread sends what is queued, switches its drives off, closes the bus and ends."""
        with self._condition:
            self._is_close_requested = True
            self._request_time_s = None
            self._condition.notify_all()

    def close(self, deadline_s: float) -> None:
        """Wait until the thread has ended. A thread that hangs is left: then the drives stop by their watchdogs.

        Raises:
            BackendError: The bus cannot be closed, or it has failed and the host has not got this error yet.
        """
        if self._thread is None:
            self.drives.close()
            return
        self._thread.join(max(deadline_s - time.monotonic(), 0.0))
        if self._thread.is_alive():
            _log.warning(
                "%s: still busy; it is left, and its drives stop by their own watchdogs",
                self.spec.name,
            )
            return
        with self._condition:
            if self._close_error is not None:
                raise self._close_error
            if not self._is_bus_error_reported:
                self._raise_bus_error()

    def _raise_bus_error(self) -> None:
        if self._bus_error is not None:
            self._is_bus_error_reported = True
            raise self._bus_error

    # --- in the bus thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Run cycles in the bus thread until closing is requested, then close the drives.

        An error in a cycle switches the drives off, and is stored for the host, which ends the run.
        """
        is_last_cycle = False
        while not is_last_cycle:
            # Read it before the cycle, because the last cycle still sends what was queued.
            is_last_cycle = self._is_close_requested
            try:
                self._run_cycle()
            except Exception as error:  # noqa: BLE001 - the host ends the run; this thread continues, to stop drives
                with self._condition:
                    self._bus_error = self._bus_error or error
                    self._request_time_s = None
                    self._condition.notify_all()
                with contextlib.suppress(Exception):
                    self._switch_off_drives()
        try:
            self.drives.close()
        except Exception as error:  # noqa: BLE001 - raised by `close`
            with self._condition:
                self._close_error = error

    def _run_cycle(self) -> None:
        """Wait for requests of the host and execute them, in the bus thread.

        In this order: reset faults, send new setpoints or switch drives off whose setpoints have expired, and read.
        Commands come before a reading, because a reading takes longer.
        """
        with self._condition:
            self._condition.wait_for(self._has_work, self._setpoint_time_left_s())
            is_reading_requested = self._request_time_s is not None
            drives_to_reset = self._drives_to_reset
            self._drives_to_reset = NO_DRIVES
            queued = self._queued_command
            self._queued_command = None
            may_send_setpoints = queued is not None and self._may_send_setpoints(queued)
        if drives_to_reset:
            super().reset_faults(drives_to_reset)
        match self._choose_action(queued, may_send_setpoints=may_send_setpoints):
            case "send" if queued is not None:
                self._send_now(queued)
            case "switch_off":
                self._switch_off_drives()
            case _:
                pass
        if is_reading_requested:
            self._read_and_publish()

    def _has_work(self) -> bool:
        return (
            self._request_time_s is not None
            or self._is_close_requested
            or self._queued_command is not None
            or bool(self._drives_to_reset)
        )

    def _may_send_setpoints(self, queued: _QueuedCommand) -> bool:
        """Return whether these setpoints may be sent: they are younger than a lease, and the bus has not failed."""
        age_s = time.monotonic() - queued.queued_s
        return age_s <= self._lease_s and self._bus_error is None

    def _choose_action(
        self, queued: _QueuedCommand | None, *, may_send_setpoints: bool
    ) -> Literal["send", "switch_off", "nothing"]:
        """Return what this cycle sends. A command that stops all drives is sent however old it is.

        Args:
            queued: Newest command of the host; None if there is no new one.
            may_send_setpoints: Whether the setpoints of `queued` are still valid.
        """
        if queued is not None:
            stops_all_drives = not queued.command.enabled_drives
            if may_send_setpoints or stops_all_drives:
                return "send"
            return "switch_off"
        if self._setpoint_time_left_s() == 0:
            return "switch_off"
        return "nothing"

    def _setpoint_time_left_s(self) -> float | None:
        """Return the time until the drives have to be switched off, or None if no drive follows setpoints."""
        if self._setpoint_time_s is None:
            return None
        return max(self._setpoint_time_s + self._lease_s - time.monotonic(), 0.0)

    def _send_now(self, queued: _QueuedCommand) -> None:
        """Send a command, remember the time of its setpoints, and publish the findings."""
        super().send(queued.command)
        self._setpoint_time_s = queued.queued_s if queued.command.enabled_drives else None
        self.drives.poll()
        self._publish_findings()

    def _switch_off_drives(self) -> None:
        """Switch all drives off. If any was enabled, all stay off until the operator resets the resulting fault."""
        self._setpoint_time_s = None
        self._recover_from_pause()
        if self._guard.note_drives_released():
            lease_ms = 1e3 * self._lease_s
            cause = f"{self.spec.name}: no setpoints for {lease_ms:.0f} ms, one lease: its drives were switched off"
            self._findings_after_pause.append(FaultFinding("no_setpoints", cause))
        count = len(self.spec.joints)
        zeros = np.zeros(count)
        passive = [JointMode.PASSIVE] * count
        super().send(
            BusCommand(NO_DRIVES, passive, zeros, zeros, may_enable=False, emergency=False)
        )
        self.drives.poll()
        self._publish_findings()

    def _publish_findings(self) -> None:
        """Collect the findings of drives and bus, and store them for the host."""
        findings = self._collect_findings()
        with self._condition:
            if self._drives_to_reset:  # a reset is due: findings of drives are from before it
                findings = select_bus_findings(findings)
            self._new_findings += findings

    def _read_and_publish(self) -> None:
        """Read all drives, store the readings for the host, and note how long it took."""
        time.sleep(self.injected_delay_s)
        super().request_reading()
        with self._condition:
            self._published_readings.copy_from(self.readings, range(len(self.spec.joints)))
            if self._request_time_s is not None:
                now_s = time.monotonic()
                self._read_duration_s = now_s - self._request_time_s
                self._request_time_s = now_s if self._is_next_reading_requested else None
                self._is_next_reading_requested = False
            self._condition.notify_all()
