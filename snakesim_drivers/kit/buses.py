"""All buses of a robot, each with its own drives and, in real time, in a thread of its own.

In every control cycle, or in every n-th one (`decimation`), a bus reads its drives and sends their setpoints. In
lockstep the host's thread operates one bus after the other, so that a run is the same each time.
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from snakesim_drivers.kit.bus import BusSpec, InlineBus
from snakesim_drivers.kit.drive_settings import answer_limit_s
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.kit.threaded_bus import WAIT_SLICES, ThreadedBus
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.scenario import RunConfig

MAX_WAIT_ANSWER_LIMITS = 1.2  # the host's wait for a bus, in answer limits of its drives: the bus itself takes time too
CLOSE_LIMIT_S = 2.0  # for all buses together, before those that hang are left


class Buses(Drives):
    """All buses of a robot, as one `Drives`. Joints are numbered as in the robot."""

    def __init__(
        self,
        config: RunConfig,
        readings: DriveReadings,
        specs: Sequence[BusSpec],
        clock_ns: Callable[[], int],
        pass_time: Callable[[int], None] | None = None,
    ) -> None:
        """Open all buses of a robot; if one cannot be opened, close the others.

        Args:
            config: Configuration of the run, with the robot and the settings of its backend.
            readings: The readings of the whole robot, which this object fills.
            specs: The buses, which together have every joint once.
            clock_ns: Returns the driver's time.
            pass_time: In lockstep, lets the driver's time pass by some ns, for start-up; None: time passes by itself.

        Raises:
            ConfigError: the settings do not suit a bus.
            BackendError: a bus cannot be opened.
        """
        self._readings = readings
        self._pass_time = pass_time
        self._period_ns = config.period_ns
        self._cycles = 0
        self.buses: list[InlineBus] = []
        try:
            for spec in specs:
                self.buses.append(_open_bus(config, spec, clock_ns))
        except BaseException:
            self.close()
            raise
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
        if self._pass_time is not None:
            self._run_start_up(self._pass_time)
        for bus in self.buses:
            self._readings.copy_from(bus.readings, bus.spec.joints)

    def read(self) -> None:
        """Request readings from all buses that are due, and wait for those that are quick."""
        requested: list[InlineBus] = []
        for bus in self.buses:
            bus.start()
            if self._is_due(bus) and bus.request_reading():
                requested.append(bus)
        slices = WAIT_SLICES
        for bus in requested:
            slices = bus.wait_for_reading(slices)
        for bus in self.buses:
            bus.copy_readings_to(self._readings)

    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints on all buses that are due in this cycle, and at once where drives begin to follow or stop.

        Args:
            command: Setpoints of all joints of the robot, and which of them follow.
        """
        for bus in self.buses:
            joints = list(bus.spec.joints)
            following_here = _local_indices(bus, command.following)
            selection = (following_here, command.may_enable, command.emergency)
            if self._is_due(bus) or bus.last_selection != selection:
                bus.last_selection = selection
                command_here = BusCommand(
                    following=following_here,
                    modes=[command.modes[j] for j in joints],
                    targets=command.targets[joints],
                    limits_nm=command.limits_nm[joints],
                    may_enable=command.may_enable,
                    emergency=command.emergency,
                )
                bus.send(command_here)
        self._cycles += 1

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear the errors of these joints' drives, each on its bus."""
        for bus in self.buses:
            joints_here = _local_indices(bus, joints)
            if joints_here:
                bus.reset_faults(joints_here)

    def findings(self) -> list[Finding]:
        """Return what is wrong on all buses, with joints numbered as in the robot."""
        findings: list[Finding] = []
        for bus in self.buses:
            for finding in bus.findings():
                if finding.joint is None:
                    findings.append(finding)
                else:
                    findings.append(replace(finding, joint=bus.spec.joints[finding.joint]))
        return findings

    def poll(self) -> None:
        """Receive what has arrived on all buses."""
        for bus in self.buses:
            bus.poll()

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end a fault of a bus, by its number in the robot, or of a drive on a bus.

        Returns:
            Whether this fault can be injected here; False for real drives, and for an unknown target.
        """
        match injection.target_type:
            case "bus":
                return self._inject_into_bus(injection, begins=begins)
            case "joint":
                return self._inject_into_drive(injection, begins=begins)
            case _:
                return False

    def close(self) -> None:
        """Close all buses. None waits for another that hangs.

        Raises:
            BackendError: a bus cannot be closed.
        """
        for bus in self.buses:
            bus.request_close()
        deadline_s = time.monotonic() + CLOSE_LIMIT_S
        with contextlib.ExitStack() as closing:
            for bus in self.buses:
                closing.callback(bus.close, deadline_s)

    # --- inside -----------------------------------------------------------------------------------------------

    def _run_start_up(self, pass_time: Callable[[int], None]) -> None:
        """In lockstep, run the start-up of all drives to its end: later their time is paused until the robot is armed.

        A drive whose start-up fails is not ready, as in real time.
        """
        while any(bus.drives.start_up is not None and bus.drives.start_up.can_continue() for bus in self.buses):
            pass_time(self._period_ns)
            for bus in self.buses:
                bus.request_reading()
                bus.poll()

    def _is_due(self, bus: InlineBus) -> bool:
        return self._cycles % bus.spec.decimation == 0

    def _inject_into_bus(self, injection: Injection, *, begins: bool) -> bool:
        number = injection.number
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
        only_bus = replace(injection, target="bus_1")  # its `Drives` know no other
        return bus.drives.inject(only_bus, begins=begins)

    def _inject_into_drive(self, injection: Injection, *, begins: bool) -> bool:
        for bus in self.buses:
            if injection.number in bus.spec.joints:
                local_number = bus.spec.joints.index(injection.number) + 1
                return bus.drives.inject(replace(injection, target=f"joint_{local_number}"), begins=begins)
        return False


def _open_bus(config: RunConfig, spec: BusSpec, clock_ns: Callable[[], int]) -> InlineBus:
    joints = config.robot.joint_table
    if config.clock_mode == "lockstep":
        return InlineBus(spec, joints, clock_ns, config.period_ns)
    max_wait_s = MAX_WAIT_ANSWER_LIMITS * answer_limit_s(config)
    return ThreadedBus(spec, joints, clock_ns, config.period_ns, config.lease_ns, max_wait_s)


def _local_indices(bus: InlineBus, joints: frozenset[int]) -> frozenset[int]:
    """Return the indices on a bus of those of the robot's joints that are on it."""
    return frozenset(i for i, joint in enumerate(bus.spec.joints) if joint in joints)
