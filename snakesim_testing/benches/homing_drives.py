"""Emulated drives with homing, holding brakes, limit switches and a safe-torque-off input, and their driver.

They extend the minimal driver and add messages to its protocol. A drive does not know its position after a restart: it
reports 0 rad until it has moved slowly to its index.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_settings import DriveSettings
from snakesim_drivers.kit.drive_type import DriverTypeContext, make_bus_specs_by_port
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.holding_brakes import HoldingBrakes
from snakesim_drivers.kit.limit_switches import LimitSwitches
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.kit.start_up import StartUp, StartUpStep, StepFailedError
from snakesim_drivers.template.minimal_driver import (
    MinimalBackend,
    MinimalDrives,
    MinimalEmulator,
    Report,
)
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

HOMING_RAD_S = 0.05
HOMING_MARGIN_S = 1.6  # homing has failed if it takes longer than its usual time by this margin
RELEASE_S = 0.04  # of a holding brake
ENGAGE_S = 0.02  # of a holding brake


class HomingSettings(DriveSettings, frozen=True, kw_only=True):
    """The settings of the driver type."""

    home_at_start: bool = True
    """Whether the drives may move their joints at the start, to find their zeros."""

    homing_s: float = 0.4
    """Time that the emulated drives need to find their zeros."""


class HomingInputs(NamedTuple):
    """Inputs of a drive, which it reports besides its motion."""

    is_homed: bool
    homing_failed: bool
    safe_torque_off: bool
    at_lower: bool
    at_upper: bool


@dataclass
class HomingState:
    """The homing and the holding brake of a drive. A minimal drive has neither."""

    is_homed: bool = False
    homing_until_us: float | None = None  # None: the drive is not homing
    is_brake_open: bool = False
    brake_closed_us: float = -1e9  # time of the last command to close


class HomingEmulator(MinimalEmulator):
    """Emulates drives with homing and holding brakes.

    Attributes:
        homing_states: Homing and brake of each drive, tail to head.
        dropped_drives: Indices of the drives whose torque went off while their brake did not hold yet.
    """

    def __init__(self, *parts: Any) -> None:
        self.homing_states: list[HomingState] = []
        self.dropped_drives: list[int] = []
        self.homing_us = 0.0  # set by the driver type
        # Indices of the drives that have no index, or whose input is active. Tests change these sets.
        self.without_index: set[int] = set()
        self.torque_off: set[int] = set()
        self.at_lower: set[int] = set()
        self.at_upper: set[int] = set()
        super().__init__(*parts)
        self.homing_states = [HomingState() for _ in self.drives]

    def request_inputs(self, i: int) -> HomingInputs | None:
        """Return the inputs of a drive, or None if it is silent."""
        if self.is_cut or self.body.is_silent(i):
            return None
        failed = i in self.without_index and self.homing_states[i].homing_until_us is None
        return HomingInputs(
            self.homing_states[i].is_homed,
            failed,
            i in self.torque_off,
            i in self.at_lower,
            i in self.at_upper,
        )

    def request_reports(self, i: int) -> list[Report]:
        reports = super().request_reports(i)
        if self.homing_states[i].is_homed:
            return reports
        return [report._replace(angle_rad=0.0) for report in reports]

    def handle_extra_message(
        self, i: int, message: Literal["home", "stop_homing", "open_brake", "close_brake"]
    ) -> None:
        """Carry out a message about homing or the brake, which a minimal drive does not have.

        Args:
            i: Index of the drive.
            message: The message. It is ignored while the bus is cut or the drive restarts.
        """
        if self.is_cut or self.body.is_booting(i):
            return
        state = self.homing_states[i]
        match message:
            case "home":
                state.homing_until_us = self.body.now_us + self.homing_us
                self._drive_motor(i)
            case "stop_homing":
                state.homing_until_us = None
                self._drive_motor(i)
            case "open_brake":
                state.is_brake_open = True
            case "close_brake":
                if state.is_brake_open:
                    state.brake_closed_us = self.body.now_us
                state.is_brake_open = False

    def on_step(self, now_us: float) -> None:
        """End the homing of drives that have reached their index, and keep drives off by their input."""
        super().on_step(now_us)
        for i, state in enumerate(self.homing_states):
            if state.homing_until_us is not None and now_us > state.homing_until_us:
                state.homing_until_us = None
                state.is_homed = i not in self.without_index
                self._drive_motor(i)
            if i in self.torque_off and self.drives[i].enabled:
                self._latch_error(i, "")

    def restart(self, i: int) -> None:
        super().restart(i)
        self.homing_states[i] = HomingState()

    def _drive_motor(self, i: int) -> None:
        if not self.drives[i].enabled:
            self._record_dropped_drive(i)
        if self.homing_states and self.homing_states[i].homing_until_us is not None:
            joint = self.body.joints[i]
            damping = joint.motor.velocity_gain_nm_s_per_rad / joint.drive.gear**2
            limit_nm = joint.limits.torque_nm / joint.drive.gear
            self.body.drive_motor(
                i, JointMode.VELOCITY, HOMING_RAD_S, limit_nm, 0.0, damping, HOMING_RAD_S
            )
            return
        super()._drive_motor(i)

    def _record_dropped_drive(self, i: int) -> None:
        """Record a drive whose torque is off while its brake is open or not closed completely."""
        if not self.homing_states:
            return
        state = self.homing_states[i]
        is_closing = self.body.now_us - state.brake_closed_us < ENGAGE_S * 1e6
        if state.is_brake_open or is_closing:
            self.dropped_drives.append(i)


class HomingDrives(MinimalDrives):
    """The driver of drives with homing and holding brakes."""

    emulator: HomingEmulator

    def __init__(
        self,
        emulator: HomingEmulator,
        joints: Sequence[Joint],
        readings: DriveReadings,
        clock_ns: Callable[[], int],
        period_ns: int,
        *,
        settings: HomingSettings,
    ) -> None:
        """Create the driver of the drives on one bus. Nothing is sent yet.

        Args:
            emulator: The emulated drives, which stand in for a bus.
            joints: Joints of the drives, tail to head.
            readings: Object that stores the values that the drives report.
            clock_ns: Function that returns the driver's time in ns.
            period_ns: Control period in ns.
            settings: Settings of the driver type.
        """
        super().__init__(emulator, joints, readings, clock_ns, period_ns)
        # The inputs that each drive reported last, tail to head; None for a drive that is silent.
        self.inputs: list[HomingInputs | None] = [None] * len(joints)
        self.switches = LimitSwitches(self.labels)
        self.brakes = HoldingBrakes(
            len(joints), release_s=RELEASE_S, engage_s=ENGAGE_S, clock_ns=clock_ns
        )
        homing_step = StartUpStep(
            "homing",
            timeout_s=settings.homing_s + HOMING_MARGIN_S,
            start=lambda i: emulator.handle_extra_message(i, "home"),
            is_done=self.is_homed,
            abort=lambda i: emulator.handle_extra_message(i, "stop_homing"),
            moves_joint=True,
        )
        self.homing = StartUp(
            self.labels, readings, clock_ns, steps=[homing_step], may_move=settings.home_at_start
        )
        # The driver kit runs what `start_up` names. Its type allows None, unlike that of `homing`.
        self.start_up: StartUp | None = self.homing

    def is_homed(self, i: int) -> bool:
        """Return whether a drive knows its position. Raises StepFailedError if it has found no index."""
        inputs = self.inputs[i]
        if inputs is None:
            return False
        if inputs.homing_failed:
            raise StepFailedError("no index found")
        return inputs.is_homed

    def read(self) -> None:
        super().read()
        for i in self.all_drives:
            inputs = self.emulator.request_inputs(i)
            self.inputs[i] = inputs
            if inputs is None:
                continue
            self.switches.record_switches(i, lower=inputs.at_lower, upper=inputs.at_upper)
            self.states.drives[i].safe_torque_off = inputs.safe_torque_off
            if self.homing.is_ready(i) and not inputs.is_homed:
                self.homing.invalidate(i, "position unknown: the drive has restarted")

    def send_setpoints(self, command: BusCommand) -> None:
        enabled = [i for i in self.all_drives if self.states.drives[i].enabled]
        restricted = self.switches.restrict_command(command, self.readings.angle_rad)
        plan = self.brakes.update_brakes(restricted, enabled, self.readings.angle_rad)
        for i in self.all_drives:
            message = "open_brake" if i in plan.released else "close_brake"
            self.emulator.handle_extra_message(i, message)
        super().send_setpoints(plan.command)

    def list_findings(self) -> list[FaultFinding]:
        return [*super().list_findings(), *self.switches.list_findings()]

    def reset_faults(self, joints: frozenset[int]) -> None:
        super().reset_faults(joints)
        self.switches.reset(joints)


class HomingBackend(MinimalBackend):
    """The driver type of drives with homing and holding brakes."""

    Settings = HomingSettings
    name = "homing"

    @classmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        def open_drives(
            port: str, joint_indices: Sequence[int], readings: DriveReadings
        ) -> HomingDrives:
            assert context.body is not None
            joints = [context.joints[j] for j in joint_indices]
            clock_ns = context.clock.now_ns
            emulator = HomingEmulator(context.body, clock_ns, context.settings.watchdog_s)
            period_ns = context.config.period_ns
            emulator.homing_us = context.settings.homing_s * 1e6
            return HomingDrives(
                emulator, joints, readings, clock_ns, period_ns, settings=context.settings
            )

        return make_bus_specs_by_port(context.joints, context.settings, ["memory"], open_drives)
