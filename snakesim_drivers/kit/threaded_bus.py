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

from snakesim_drivers.kit.bus import BusSpec, InlineBus, bus_findings
from snakesim_drivers.kit.drive_guard import NO_DRIVES
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode

WAIT_SLICES = 6  # slices of the time that the host waits: a computer that pauses then loses one slice only

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
        """Open a bus that a thread of its own will use; the thread begins with `start`.

        Args:
            spec: The bus, with its joints, its watchdog time, and the function that opens it.
            joints: All joints of the robot.
            clock_ns: Returns the driver's time.
            period_ns: Duration of the robot's control cycle.
            lease_ns: Time after which setpoints are no longer valid.
            max_wait_s: Maximum time that the host waits for a reading.
        """
        super().__init__(spec, joints, clock_ns, period_ns)
        self._lease_s = lease_ns * 1e-9
        self._slice_s = max_wait_s / WAIT_SLICES
        self._thread: threading.Thread | None = None

        # Used by the bus thread alone.
        self._followed_since_s: float | None = None  # when the setpoints that drives follow were queued; None: none do

        # Shared by both threads, and guarded by the condition.
        self._condition = threading.Condition()
        self._closing = False
        self._error: Exception | None = None
        # Readings.
        self._published = DriveReadings([joints[j] for j in spec.joints], clock_ns)
        self._published.copy_from(self.readings, range(len(spec.joints)))  # also which drives are not ready yet
        self._request_time_s: float | None = None  # when a reading was requested; None: it is complete
        self._request_pending = False  # requested again meanwhile: the bus reads again at once, at its own rate
        self._read_duration_s = 0.0
        self._is_slow = False
        # Commands.
        self._queued: _QueuedCommand | None = None
        self._drives_to_reset = NO_DRIVES
        self._new_findings: list[Finding] = []

    # --- called by the host's thread --------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread in the first control cycle; it inherits the scheduling priority of the host's thread."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"bus {self.spec.name}", daemon=True)
            self._thread.start()

    def request_reading(self) -> bool:
        with self._condition:
            if self._request_time_s is not None:
                self._request_pending = True
                return False
            if self._read_duration_s <= WAIT_SLICES * self._slice_s:
                self._is_slow = False
            self._request_time_s = time.monotonic()
            self._condition.notify_all()
            return True

    def wait_for_reading(self, slices: int) -> int:
        with self._condition:
            while slices > 0 and self._request_time_s is not None and not self._is_slow:
                notified = self._condition.wait(self._slice_s)
                if not notified:
                    slices -= 1
            self._is_slow = self._request_time_s is not None
        return slices

    def copy_readings_to(self, robot_readings: DriveReadings) -> None:
        with self._condition:
            self._raise_error()
            robot_readings.copy_from(self._published, self.spec.joints)

    def send(self, command: BusCommand) -> None:
        """Queue setpoints, which the thread sends as soon as it is free."""
        with self._condition:
            self._queued = _QueuedCommand(command, time.monotonic())
            self._condition.notify_all()

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Let the thread clear the errors of these drives before it sends the next setpoints."""
        with self._condition:
            self._drives_to_reset |= joints
            self._new_findings = bus_findings(self._new_findings)  # findings of drives are from before the reset
            self._condition.notify_all()

    def poll(self) -> None:
        """Do nothing: the thread receives by itself."""

    def findings(self) -> list[Finding]:
        """Return what was found wrong since the last call, each time that setpoints were sent."""
        with self._condition:
            self._raise_error()
            findings = self._new_findings
            self._new_findings = []
            return findings

    def request_close(self) -> None:
        """Let the thread send what is queued, switch its drives off, close the bus and end."""
        with self._condition:
            self._closing = True
            self._error = None
            self._request_time_s = None
            self._condition.notify_all()

    def close(self, deadline_s: float) -> None:
        """Wait until the thread has ended. A thread that hangs is left: then the drives stop by their watchdogs."""
        if self._thread is None:
            self.drives.close()
            return
        self._thread.join(max(deadline_s - time.monotonic(), 0.0))
        if self._thread.is_alive():
            _log.warning("%s: still busy; it is left, and its drives stop by their own watchdogs", self.spec.name)
            return
        with self._condition:
            self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    # --- in the bus thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Run cycles until the bus is closed, then close the drives.

        An error in a cycle switches the drives off, and is passed to the host, which ends the run.
        """
        closing = False
        while not closing:
            closing = self._closing  # read before the cycle: the last cycle still sends what was queued
            try:
                self._run_cycle()
            except Exception as error:  # noqa: BLE001 - the host ends the run; this thread continues, to stop drives
                with self._condition:
                    self._error = self._error or error
                    self._request_time_s = None
                    self._condition.notify_all()
                with contextlib.suppress(Exception):
                    self._switch_off_drives()
        try:
            self.drives.close()
        except Exception as error:  # noqa: BLE001 - raised by `close`
            with self._condition:
                self._error = error

    def _run_cycle(self) -> None:
        """Wait for work and do it, in the bus thread. Commands that stop or move drives come before a reading.

        Work is a request to reset faults, new setpoints, expired setpoints, or a requested reading.
        """
        with self._condition:
            self._condition.wait_for(self._has_work, self._setpoint_time_left_s())
            reading_requested = self._request_time_s is not None
            drives_to_reset = self._drives_to_reset
            self._drives_to_reset = NO_DRIVES
            queued = self._queued
            self._queued = None
            may_move = queued is not None and self._may_move(queued)
        if drives_to_reset:
            super().reset_faults(drives_to_reset)
        match self._choose_action(queued, may_move=may_move):
            case "send" if queued is not None:
                self._send_now(queued)
            case "switch_off":
                self._switch_off_drives()
            case _:
                pass
        if reading_requested:
            self._read_and_publish()

    def _has_work(self) -> bool:
        return (
            self._request_time_s is not None or self._closing or self._queued is not None or bool(self._drives_to_reset)
        )

    def _may_move(self, queued: _QueuedCommand) -> bool:
        """Return whether drives may follow these setpoints: they are younger than a lease, and the bus is intact."""
        age_s = time.monotonic() - queued.queued_s
        return age_s <= self._lease_s and self._error is None

    def _choose_action(
        self, queued: _QueuedCommand | None, *, may_move: bool
    ) -> Literal["send", "switch_off", "nothing"]:
        """Decide what this cycle sends. A command that stops all drives is sent however old it is."""
        if queued is not None:
            stops_all = not queued.command.following
            if may_move or stops_all:
                return "send"
            return "switch_off"
        if self._setpoint_time_left_s() == 0:
            return "switch_off"
        return "nothing"

    def _setpoint_time_left_s(self) -> float | None:
        """Return the time until the drives have to be switched off, or None if no drive follows setpoints."""
        if self._followed_since_s is None:
            return None
        return max(self._followed_since_s + self._lease_s - time.monotonic(), 0.0)

    def _send_now(self, queued: _QueuedCommand) -> None:
        super().send(queued.command)
        self._followed_since_s = queued.queued_s if queued.command.following else None
        self.drives.poll()
        self._publish_findings()

    def _switch_off_drives(self) -> None:
        """Switch all drives off. Drives that were driven stay off until the operator resets the resulting fault."""
        self._followed_since_s = None
        self._recover_from_pause()
        if self._guard.release_drives():
            lease_ms = 1e3 * self._lease_s
            cause = f"{self.spec.name}: no setpoints for {lease_ms:.0f} ms, one lease: its drives were switched off"
            self._early_findings.append(Finding("no_setpoints", cause))
        count = len(self.spec.joints)
        zeros = np.zeros(count)
        passive = [Mode.PASSIVE] * count
        super().send(BusCommand(NO_DRIVES, passive, zeros, zeros, may_enable=False, emergency=False))
        self.drives.poll()
        self._publish_findings()

    def _publish_findings(self) -> None:
        findings = self._collect_findings()
        with self._condition:
            if self._drives_to_reset:  # a reset is due: findings of drives are from before it
                findings = bus_findings(findings)
            self._new_findings += findings

    def _read_and_publish(self) -> None:
        time.sleep(self.injected_delay_s)
        super().request_reading()
        with self._condition:
            self._published.copy_from(self.readings, range(len(self.spec.joints)))
            if self._request_time_s is not None:
                now_s = time.monotonic()
                self._read_duration_s = now_s - self._request_time_s
                self._request_time_s = now_s if self._request_pending else None
                self._request_pending = False
            self._condition.notify_all()
