"""All buses of a robot, each with its own drives and, in real time, in a thread of its own.

In every control cycle, or in every n-th one (`decimation`), a bus reads its drives and sends their setpoints. In
lockstep the host's thread operates one bus after the other, so that a run is the same each time.
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from snakesim_drivers.kit.bus import BusSpec, InlineBus
from snakesim_drivers.kit.drive_settings import compute_response_timeout_s
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.kit.threaded_bus import WAIT_SLICES, ThreadedBus
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.scenario import RunConfig

# The host's wait for a bus, in answer limits of its drives: the bus itself takes time too.
MAX_WAIT_RESPONSE_TIMEOUTS = 1.2
CLOSE_TIMEOUT_S = 2.0  # for all buses together, before those that hang are left


class RobotBuses(Drives):
    """All buses of a robot, as one `Drives`. Joints are numbered as in the robot."""

    def __init__(
        self,
        config: RunConfig,
        readings: DriveReadings,
        specs: Sequence[BusSpec],
        clock_ns: Callable[[], int],
        advance_time: Callable[[int], None] | None = None,
    ) -> None:
        """Open all buses of a robot; if one cannot be opened, close the others.

        Args:
            config: Configuration of the run, with the robot and the settings of its backend.
            readings: The readings of the whole robot, which this object fills.
            specs: The buses, which together have every joint once.
            clock_ns: Function that returns the driver's time in ns.
            advance_time: Function that advances the driver's time by a number of ns, for the start-up in lockstep.
                None if time passes by itself.

        Raises:
            ConfigError: The settings do not suit a bus.
            BackendError: A bus cannot be opened.
        """
        self._readings = readings
        self._advance_time = advance_time
        self._period_ns = config.period_ns
        self._cycle_count = 0
        self.buses: list[InlineBus] = []
        try:
            for spec in specs:
                self.buses.append(_open_bus(config, spec, clock_ns))
        except BaseException:
            self.close()  # only needs `buses`, with those that were opened
            raise
        # Whether all drives are emulated, so that no real motor moves.
        self.emulated = all(bus.drives.emulated for bus in self.buses)

    def bring_up(self) -> None:
        """Bring up one bus after the other, and report what is wrong with all of them in one error."""
        errors: list[BackendError] = []
        for bus in self.buses:
            try:
                bus.drives.bring_up()
            except BackendError as error:
                errors.append(error)
        if errors:
            lines = [line for error in errors for line in error.lines]
            distinct_lines = dict.fromkeys(lines)
            raise BackendError(*distinct_lines, code=errors[0].code)
        if self._advance_time is not None:
            self._run_start_up(self._advance_time)
        for bus in self.buses:
            self._readings.copy_from(bus.readings, bus.spec.joints)

    def read(self) -> None:
        """Request readings from all buses that are due, and wait for those that are quick."""
        requested: list[InlineBus] = []
        for bus in self.buses:
            bus.start()
            if self._is_due(bus) and bus.request_reading():
                requested.append(bus)
        remaining_slices = WAIT_SLICES
        for bus in requested:
            remaining_slices = bus.wait_for_reading(remaining_slices)
        for bus in self.buses:
            bus.copy_readings_to(self._readings)

    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints on all buses that are due in this cycle, and on buses whose set of enabled drives changes.

        A change does not wait for the decimation of the bus, so that drives are stopped at once. The end of this call
        is the end of the control cycle.

        Args:
            command: Setpoints of all joints of the robot, and which of their drives are enabled.
        """
        for bus in self.buses:
            joints = list(bus.spec.joints)
            enabled_on_bus = _to_bus_indices(bus, command.enabled_drives)
            selection = (enabled_on_bus, command.may_enable, command.emergency)
            if self._is_due(bus) or bus.last_sent_selection != selection:
                bus.last_sent_selection = selection
                bus_command = BusCommand(
                    enabled_drives=enabled_on_bus,
                    modes=[command.modes[j] for j in joints],
                    targets=command.targets[joints],
                    limits_nm=command.limits_nm[joints],
                    may_enable=command.may_enable,
                    emergency=command.emergency,
                )
                bus.send(bus_command)
        self._cycle_count += 1

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the errors of these joints' drives, each on its bus."""
        for bus in self.buses:
            joints_on_bus = _to_bus_indices(bus, joints)
            if joints_on_bus:
                bus.reset_faults(joints_on_bus)

    def list_findings(self) -> list[FaultFinding]:
        """Return what is wrong on all buses, with joints numbered as in the robot."""
        findings: list[FaultFinding] = []
        for bus in self.buses:
            for finding in bus.list_findings():
                if finding.joint is None:
                    findings.append(finding)
                else:
                    findings.append(replace(finding, joint=bus.spec.joints[finding.joint]))
        return findings

    def poll(self) -> None:
        """Receive what has arrived on all buses."""
        for bus in self.buses:
            bus.poll()

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end an injected fault of a bus, by its number in the robot, or of a drive on a bus.

        Returns:
            True if the fault can be injected here; False for real drives and for an unknown joint.

        Raises:
            ConfigError: The robot has no bus of this number.
        """
        match injection.target_type:
            case "bus":
                return self._inject_into_bus(injection, begins=begins)
            case "joint":
                return self._inject_into_drive(injection, begins=begins)
            case _:
                return False

    def close(self) -> None:
        """Close all buses within a common time limit. A bus that hangs does not delay the other ones.

        Raises:
            BackendError: A bus cannot be closed.
        """
        for bus in self.buses:
            bus.request_close()
        deadline_s = time.monotonic() + CLOSE_TIMEOUT_S
        with contextlib.ExitStack() as closing:
            for bus in self.buses:
                closing.callback(bus.close, deadline_s)

    # --- inside -----------------------------------------------------------------------------------------------

    def _run_start_up(self, advance_time: Callable[[int], None]) -> None:
        """Run the start-up of all drives to its end, in lockstep: later, time is paused until the robot is armed.

        A drive whose start-up fails is not ready, as in real time.

        Args:
            advance_time: Function that advances the driver's time by a number of ns.
        """
        while any(
            bus.drives.start_up is not None and bus.drives.start_up.can_continue()
            for bus in self.buses
        ):
            advance_time(self._period_ns)
            for bus in self.buses:
                bus.request_reading()
                bus.poll()

    def _is_due(self, bus: InlineBus) -> bool:
        return self._cycle_count % bus.spec.decimation == 0

    def _inject_into_bus(self, injection: FaultInjection, *, begins: bool) -> bool:
        number = injection.target_index
        if not 0 <= number < len(self.buses):
            raise ConfigError(
                f"there is no {injection.target}; this robot has bus_1 to bus_{len(self.buses)}",
                code="injection/unknown-target",
            )
        bus = self.buses[number]
        if injection.kind == "slow":
            delay_s = injection.amount or 0.0
            bus.injected_delay_s = delay_s if begins else 0.0
            return True
        local_injection = replace(injection, target="bus_1")  # `Drives` number their own bus 1
        return bus.drives.inject(local_injection, begins=begins)

    def _inject_into_drive(self, injection: FaultInjection, *, begins: bool) -> bool:
        for bus in self.buses:
            if injection.target_index in bus.spec.joints:
                # Targets count from 1.
                local_number = bus.spec.joints.index(injection.target_index) + 1
                return bus.drives.inject(
                    replace(injection, target=f"joint_{local_number}"), begins=begins
                )
        return False


def _open_bus(config: RunConfig, spec: BusSpec, clock_ns: Callable[[], int]) -> InlineBus:
    joints = config.robot.joint_table
    if config.clock_mode == "lockstep":
        return InlineBus(spec, joints, clock_ns, config.period_ns)
    max_wait_s = MAX_WAIT_RESPONSE_TIMEOUTS * compute_response_timeout_s(config)
    return ThreadedBus(spec, joints, clock_ns, config.period_ns, config.lease_ns, max_wait_s)


def _to_bus_indices(bus: InlineBus, joints: frozenset[int]) -> frozenset[int]:
    """Convert joint indices of the robot to indices on a bus, without the joints that are on other buses."""
    return frozenset(i for i, joint in enumerate(bus.spec.joints) if joint in joints)
