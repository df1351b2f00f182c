"""A complete driver type to copy, with emulated drives: replace what uses `emulator` by the protocol of your drives.

See docs/hardware/write-a-driver.md. Try it:

snakesim run scales --backend ./examples/minimal_driver.py:MinimalBackend --duration 3
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from snakesim_drivers.emulation.drive_emulator import BusEnd, DriveEmulator
from snakesim_drivers.emulation.emulated_body import FAULTS, EmulatedBody
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_settings import DriveSettings
from snakesim_drivers.kit.drive_states import DriveStates
from snakesim_drivers.kit.drive_type import (
    DriverTypeBackend,
    DriverTypeContext,
    make_bus_specs_by_port,
)
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import JointMode

# --- the protocol ----------------------------------------------------------------------------------------------


class Setpoint(NamedTuple):
    """What a drive is to do until the next setpoint. It also feeds the watchdog of the drive."""

    mode: JointMode
    target: float  # rad, rad/s or N·m, by the mode
    limit_nm: float


class Report(NamedTuple):
    """What a drive answers to a request."""

    serial: str
    enabled: bool
    error: str  # in words; empty: none
    angle_rad: float
    velocity_rad_s: float
    torque_nm: float
    voltage_v: float
    current_a: float
    motor_c: float
    board_c: float


Message = Setpoint | Literal["enable", "disable", "clear_error"]
NO_SETPOINT = Setpoint(JointMode.PASSIVE, 0.0, 0.0)


# --- the emulated drives ---------------------------------------------------------------------------------------


@dataclass
class EmulatedDrive:
    """The state of one emulated drive, as it is after a restart."""

    enabled: bool = False
    error: str = ""  # stays until it is cleared, and keeps the drive off
    setpoint: Setpoint = NO_SETPOINT
    watchdog_fed_us: float = 0.0  # when the last setpoint came


class MinimalEmulator(DriveEmulator[BusEnd]):
    """The drives of a robot, at the other end of the protocol. In all methods `i` is the index of a drive."""

    def __init__(self, body: EmulatedBody, clock_ns: Callable[[], int], watchdog_s: float) -> None:
        self.drives = [EmulatedDrive() for _ in body.joints]
        self.is_cut = False  # True: nothing passes the bus
        self._watchdog_us = watchdog_s * 1e6
        super().__init__(body, [], clock_ns)

    def __call__(self) -> None:
        """Simulate up to the current time."""
        with self.body.lock:
            self.catch_up()
            self.simulate_to_now()

    def request_reports(self, i: int) -> list[Report]:
        """Return the answers to a request: none of a silent drive, and two if two drives have the same id."""
        if self.is_cut or self.body.is_silent(i):
            return []
        report = Report(
            f"minimal-{i + 1}",
            self.drives[i].enabled,
            self.drives[i].error,
            *self.body.read_shaft(i),
            *self.body.read_supply(i),
            *self.body.read_temperatures(i),
        )
        if self.body.is_duplicated(i):
            return [report, report._replace(serial=f"second-{i + 1}")]
        return [report]

    def handle_message(self, i: int, message: Message) -> None:
        """Execute a message in a drive, unless the bus is cut or the drive is booting."""
        if self.is_cut or self.body.is_booting(i):
            return
        with self.body.lock:
            self.catch_up()
            drive = self.drives[i]
            match message:
                case "enable":
                    drive.enabled = not drive.error
                case "disable":
                    drive.enabled = False
                case "clear_error":
                    drive.error = ""
                case Setpoint():
                    drive.setpoint = message
                    drive.watchdog_fed_us = self.body.now_us
            self._drive_motor(i)

    def on_step(self, now_us: float) -> None:
        """Stop the drives whose watchdog has expired or whose motor is too hot."""
        for i, drive in enumerate(self.drives):
            if drive.enabled and now_us - drive.watchdog_fed_us > self._watchdog_us:
                self._latch_error(i, "an expired watchdog")
            if not drive.error and self.body.is_too_hot(i):
                self._latch_error(i, "an overheated motor")

    def restart(self, i: int) -> None:
        """Put a drive into its state after power-on."""
        self.drives[i] = EmulatedDrive()
        self._drive_motor(i)

    def list_enabled(self) -> list[bool]:
        """Return for each drive whether its motor is on."""
        return [drive.enabled for drive in self.drives]

    def _latch_error(self, i: int, error: str) -> None:
        """Switch a drive off with an error that stays until it is cleared."""
        self.drives[i].error = error
        self.drives[i].enabled = False
        self._drive_motor(i)

    def _drive_motor(self, i: int) -> None:
        """Move the emulated body by the setpoint, with the gains of the joint at the shaft of the drive."""
        setpoint = self.drives[i].setpoint if self.drives[i].enabled else NO_SETPOINT
        joint = self.body.joints[i]
        gear = joint.drive.gear
        stiffness = joint.motor.stiffness_nm_per_rad / gear**2
        damping = joint.motor.damping_nm_s_per_rad / gear**2
        if setpoint.mode == JointMode.VELOCITY:
            damping = joint.motor.velocity_gain_nm_s_per_rad / gear**2
        speed_rad_s = joint.limits.speed_rad_s * gear
        self.body.drive_motor(
            i, setpoint.mode, setpoint.target, setpoint.limit_nm, stiffness, damping, speed_rad_s
        )


# --- the driver ------------------------------------------------------------------------------------------------


class MinimalDrives(Drives):
    """The drives of one bus. `Drives` describes every method."""

    emulated = True  # nothing real moves

    def __init__(
        self,
        emulator: MinimalEmulator,
        joints: Sequence[Joint],
        readings: DriveReadings,
        clock_ns: Callable[[], int],
        period_ns: int,
    ) -> None:
        self.emulator = emulator
        self.readings = readings
        self.all_drives = range(len(joints))
        self.labels = [f"{joint.name} (drive {i + 1})" for i, joint in enumerate(joints)]
        self.states = DriveStates(self.labels, period_ns, clock_ns)
        # That answer for each drive: two are two drives.
        self.serials: list[set[str]] = [set() for _ in joints]

    def bring_up(self) -> None:
        self.read()
        missing = [self.labels[i] for i in self.all_drives if not self.readings.has_reported(i)]
        if missing:
            lines = [f"  {label} does not answer" for label in missing]
            raise BackendError(
                "the robot is not complete; nothing was enabled:", *lines, code="drive/not-complete"
            )
        for i in self.all_drives:
            self.emulator.handle_message(i, "disable")
            self.emulator.handle_message(i, "clear_error")

    def read(self) -> None:
        self.emulator()
        for i in self.all_drives:
            for report in self.emulator.request_reports(i):
                self._store_report(i, report)

    def send_setpoints(self, command: BusCommand) -> None:
        for i in sorted(command.enabled_drives):
            setpoint = Setpoint(
                command.modes[i], float(command.targets[i]), float(command.limits_nm[i])
            )
            self.emulator.handle_message(i, setpoint)
        for i, drive_command in self.states.update_commands(
            command.enabled_drives, emergency=command.emergency
        ):
            match drive_command:
                case "follow":
                    self.emulator.handle_message(i, "enable")
                case "idle" | "stop":
                    self.emulator.handle_message(i, "disable")

    def poll(self) -> None:
        self.emulator()

    def list_findings(self) -> list[FaultFinding]:
        findings = self.states.list_findings()
        if self.emulator.is_cut:
            findings.append(
                FaultFinding("interface_down", "the bus is cut; check the adapter and its cable")
            )
        for i in self.all_drives:
            if len(self.serials[i]) > 1:
                cause = f"{self.labels[i]}: two drives answer, {' and '.join(sorted(self.serials[i]))}; change one id"
                findings.append(FaultFinding("duplicate_node", cause, i))
        return findings

    def reset_faults(self, joints: frozenset[int]) -> None:
        self.states.reset_errors(joints)
        for i in sorted(joints):
            self.serials[i].clear()  # a second drive that is still there answers again
            self.emulator.handle_message(i, "clear_error")

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        if (injection.target_type, injection.kind) == ("bus", "cut"):
            self.emulator.is_cut = begins
            return True
        if injection.target_type != "joint" or injection.kind not in FAULTS:
            return False
        self.emulator.inject(injection, begins=begins)
        return True

    def close(self) -> None:
        for i in self.all_drives:
            self.emulator.handle_message(i, "disable")
        self.emulator.close()

    def _store_report(self, i: int, report: Report) -> None:
        self.serials[i].add(report.serial)
        self.readings.set_identity(i, serial=report.serial, firmware="1.0")
        self.readings.set_motion(i, report.angle_rad, report.velocity_rad_s)
        self.readings.set_torque(i, report.torque_nm)
        self.readings.set_supply(i, report.voltage_v, report.current_a)
        self.readings.set_temperatures(i, report.motor_c, report.board_c)
        self.readings.mark_checked(i)
        self.states.record_report(i, enabled=report.enabled, state="disabled")
        self.states.drives[i].errors = report.error


class MinimalBackend(DriverTypeBackend):
    """The driver type. `DriverTypeBackend` describes every method."""

    Settings = DriveSettings  # a driver of real drives adds its ports
    name = "minimal"

    @classmethod
    def list_ports(cls, settings: Any) -> Sequence[str]:
        return []  # no port: the drives are emulated in this process

    @classmethod
    def list_bus_faults(cls, settings: Any) -> Collection[str]:
        return ["cut"]

    @classmethod
    def check_drives(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        pass  # raise ConfigError here if a joint needs what your drives do not have

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        def open_drives(
            port: str, joint_indices: Sequence[int], readings: DriveReadings
        ) -> MinimalDrives:
            assert context.body is not None  # without ports there is always an emulated body
            joints = [context.joints[j] for j in joint_indices]
            clock_ns = context.clock.now_ns
            emulator = MinimalEmulator(context.body, clock_ns, context.settings.watchdog_s)
            return MinimalDrives(emulator, joints, readings, clock_ns, context.config.period_ns)

        return make_bus_specs_by_port(context.joints, context.settings, ["memory"], open_drives)
