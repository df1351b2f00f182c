"""One bus with its drives, operated by the thread that calls it.

Lockstep runs use `InlineBus`; `threaded_bus.ThreadedBus` does the same in a thread of its own.

Drives stop by themselves while a driver is away. After a pause in which a watchdog may have expired, a bus first reads
the state of every drive, and only then sends anything; see `drive_guard`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_drivers.kit.drive_guard import RESET_GRACE_CYCLES, DriveGuard
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.robot_file.joints import Joint

# After a longer pause of the driver, as a fraction of the watchdog timeout, watchdogs of drives may have expired.
MAX_PAUSE_WATCHDOG_FRACTION = 0.5
MAX_READS_AFTER_PAUSE = 3  # the computer may pause again while the states are read


@dataclass(frozen=True)
class BusSpec:
    """Drives that share a wire, and how to open it."""

    name: str  # such as can0
    joints: tuple[int, ...]  # indices in the robot
    # Gets the readings of these drives; raises ConfigError and BackendError.
    open: Callable[[DriveReadings], Drives]
    decimation: int = 1  # control cycles from one reading of this bus to the next
    watchdog_s: float = 0.1  # watchdog timeout of its drives


class InlineBus:
    """A bus whose methods work at once, in the calling thread. Joints are numbered by their place on the bus."""

    def __init__(
        self, spec: BusSpec, joints: Sequence[Joint], clock_ns: Callable[[], int], period_ns: int
    ) -> None:
        """Open one bus of the robot, and guard its drives against pauses of the driver.

        Args:
            spec: The bus, with its joints, its watchdog time, and the function that opens it.
            joints: All joints of the robot, from tail to head.
            clock_ns: Function that returns the driver's time in ns.
            period_ns: Duration of the robot's control cycle.

        Raises:
            ConfigError: The settings do not suit the bus.
            BackendError: The bus cannot be opened.
        """
        self.spec = spec
        self.readings = DriveReadings([joints[j] for j in spec.joints], clock_ns)
        self.drives = spec.open(self.readings)
        # (enabled drives, may_enable, emergency) of the newest command; None before the first one.
        self.last_sent_selection: tuple[frozenset[int], bool, bool] | None = None
        self.injected_delay_s = 0.0  # injected delay of every reading; only a `ThreadedBus` uses it

        max_pause_ns = round(MAX_PAUSE_WATCHDOG_FRACTION * spec.watchdog_s * 1e9)
        reset_grace_period_ns = RESET_GRACE_CYCLES * spec.decimation * period_ns
        self._max_pause_ns = max_pause_ns
        self._guard = DriveGuard(
            clock_ns, watchdog_timeout_ns=max_pause_ns, reset_grace_period_ns=reset_grace_period_ns
        )
        # Found after a pause, before any setpoint was sent.
        self._findings_after_pause: list[FaultFinding] = []

    def start(self) -> None:
        """Prepare for control cycles. Called in each of them."""

    def request_reading(self) -> bool:
        """Read all drives. Returns False if the bus is still busy with an earlier request."""
        if not self._recover_from_pause():
            self._read_drives()
        return True

    def wait_for_reading(self, remaining_slices: int) -> int:
        """Wait until the requested reading is complete.

        Args:
            remaining_slices: Number of time slices that the host can still wait in this control cycle.

        Returns:
            The number of time slices that are left afterwards.
        """
        return remaining_slices

    def copy_readings_to(self, robot_readings: DriveReadings) -> None:
        """Copy the last readings of this bus into those of the robot.

        Raises:
            BackendError: The bus has failed.
        """
        robot_readings.copy_from(self.readings, self.spec.joints)

    def send(self, command: BusCommand) -> None:
        """Send setpoints. They replace earlier ones that are not sent yet."""
        self._recover_from_pause()
        enabled_drives = self._guard.select_drives_to_enable(
            self._select_ready_drives(command), may_enable=command.may_enable
        )
        self.drives.send_setpoints(command._replace(enabled_drives=enabled_drives))

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the errors of these drives before the next setpoints are sent."""
        self._recover_from_pause()
        self._guard.reset(joints)
        self.drives.reset_faults(joints)
        if self.drives.start_up is not None:
            self.drives.start_up.reset(joints)

    def poll(self) -> None:
        """Receive what has arrived."""
        self.drives.poll()

    def list_findings(self) -> list[FaultFinding]:
        """Return what is wrong with the drives and the bus.

        Raises:
            BackendError: The bus has failed.
        """
        return self._collect_findings()

    def request_close(self) -> None:
        """Announce that `close` follows, so that all buses of a robot can stop at the same time."""

    def close(self, deadline_s: float) -> None:
        """Switch the drives off and close the bus.

        Args:
            deadline_s: Time of `time.monotonic` after which a bus that hangs is left alone.

        Raises:
            BackendError: The bus cannot be closed.
        """
        del deadline_s
        self.drives.close()

    # --- for the thread that operates the bus -----------------------------------------------------------------

    def _recover_from_pause(self) -> bool:
        """Read all drives if the driver was paused for so long that watchdogs of drives may have expired.

        The states have to be read before anything is sent: the next command that switches a drive off or clears its
        errors would also clear a stop that the drive has latched during the pause. What is found is stored, and
        returned by the next call of `list_findings`.

        Returns:
            True if there was a pause and the drives were read; False if nothing was done.
        """
        self._guard.mark_active()
        if not self._guard.was_paused:
            return False
        for _ in range(MAX_READS_AFTER_PAUSE):
            self._guard.mark_states_read()
            self.drives.poll()  # drops what drives sent before the pause: it does not show their current state
            self.readings.require_check(range(len(self.spec.joints)))
            self._read_drives()
            self._guard.mark_active()
            if not self._guard.was_paused:
                break
        self._findings_after_pause = self._collect_findings()
        return True

    def _read_drives(self) -> None:
        """Read all drives, and request also the states of those that were silent for long; continue their start-up."""
        silent_drives = [
            i
            for i in range(len(self.spec.joints))
            if self.readings.compute_age_ns(i) > self._max_pause_ns
        ]
        self.readings.require_check(silent_drives)
        self.readings.start_request()
        self.drives.read()
        if self.drives.start_up is not None:
            self.drives.start_up.update()
        self._guard.mark_active()

    def _select_ready_drives(self, command: BusCommand) -> frozenset[int]:
        """Return the drives that a command enables and whose start-up is finished.

        An emergency stop aborts all start-up steps that are in progress.
        """
        start_up = self.drives.start_up
        if start_up is None:
            return command.enabled_drives
        if command.emergency:
            start_up.abort("emergency stop")
        return frozenset(i for i in command.enabled_drives if start_up.is_ready(i))

    def _collect_findings(self) -> list[FaultFinding]:
        """Return what is wrong with the drives and the bus, and keep the concerned drives off until a reset."""
        findings = [*self._findings_after_pause, *self.drives.list_findings()]
        if self.drives.start_up is not None:
            findings += self.drives.start_up.list_findings()
        self._findings_after_pause = []
        self._guard.note_findings(findings)
        return findings


def select_bus_findings(findings: list[FaultFinding]) -> list[FaultFinding]:
    """Return those findings that concern the bus as a whole rather than one drive."""
    return [finding for finding in findings if finding.joint is None]
